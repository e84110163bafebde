"""XML from outside as a small tree: no DOCTYPE, so no entities and no outside files; not too deep, not too large."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from gonio import files
from gonio.errors import DatasetError

DEEPEST = 40
MOST_ELEMENTS = 20_000


@dataclass
class Element:
    """One element: its name without namespace prefix, text, children in order."""

    name: str
    pieces: list[str] = field(default_factory=list)
    children: list[Element] = field(default_factory=list)

    @property
    def text(self) -> str:
        """The character data, stripped."""
        return "".join(self.pieces).strip()

    def find(self, name: str) -> Element | None:
        """The first child of that name, in any case of letters."""
        return next((child for child in self.children if child.name.lower() == name.lower()), None)

    def words(self, name: str) -> str:
        """Text of the child of that name, empty if there is none."""
        child = self.find(name)
        return "" if child is None else child.text

    def all(self, name: str) -> Iterator[Element]:
        """Every element of that name below this one."""
        for child in self.children:
            if child.name.lower() == name.lower():
                yield child
            yield from child.all(name)


def parse(path: Path) -> Element:
    """The root element, or a `DatasetError` with the line."""
    data = files.read_bytes(path, files.LARGEST_TEXT)
    root = Element("")
    stack = [root]
    count = 0
    parser = expat.ParserCreate()
    parser.buffer_text = True

    def start(name: str, _attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        if len(stack) > DEEPEST or count > MOST_ELEMENTS:
            raise DatasetError(f"{path}, line {parser.CurrentLineNumber}: XML too deep or with too many elements is refused")
        element = Element(name.rpartition(":")[2])
        stack[-1].children.append(element)
        stack.append(element)

    def doctype(*_: object) -> None:
        raise DatasetError(f"{path}, line {parser.CurrentLineNumber}: a DOCTYPE is refused; remove it from the file")

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _name: stack.pop()
    parser.CharacterDataHandler = lambda text: stack[-1].pieces.append(text)
    parser.StartDoctypeDeclHandler = doctype
    parser.EntityDeclHandler = doctype
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise DatasetError(
            f"{path}, line {error.lineno}: not XML ({expat.ErrorString(error.code)}); it is damaged"
        ) from error
    except ValueError as error:  # an encoding that Python does not have
        raise DatasetError(f"{path}: not XML ({error}); save it as UTF-8") from error
    return root.children[0]
