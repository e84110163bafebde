"""One strict reader of TOML: every key is asked for by name, and what nobody asked for is an error.

It gathers all problems of a document, each with its line, before it raises. It fills no gaps by guessing, and it knows
nothing of what the values mean; the sections are read in the modules beside it.
"""

from __future__ import annotations

import difflib
import math
import re
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from gonio.errors import ConfigurationError

MAX_BYTES = 1_000_000
_REQUIRED: Any = object()
_HEADER = re.compile(r"^\s*\[+\s*([^\[\]#]+?)\s*\]+")
_KEY = re.compile(r"^\s*([A-Za-z0-9_.\-\"' ]+?)\s*=")


def read_document(path: str | Path) -> str:
    """Text of a TOML file.

    Raises
    ------
    ConfigurationError
        If it cannot be read, is larger than 1 MB or is not UTF-8.
    """
    path = Path(path)
    try:
        if path.is_dir():
            raise ConfigurationError(f"{path} is a folder; give a TOML file")
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise ConfigurationError(f"{path} has {size} bytes; a TOML file of gonio has at most {MAX_BYTES} bytes")
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
        if len(raw) > MAX_BYTES:  # no regular file: a device or a pipe without end
            raise ConfigurationError(f"{path} goes on beyond {MAX_BYTES} bytes; give a TOML file")
        return raw.decode("utf-8")
    except FileNotFoundError:
        raise ConfigurationError(f"{path} does not exist; `gonio init DIR` writes commented examples") from None
    except OSError as error:
        raise ConfigurationError(f"{path} cannot be read: {error.strerror or error}; check the path") from error
    except UnicodeDecodeError as error:
        raise ConfigurationError(f"{path} is not UTF-8 at byte {error.start}; save it as UTF-8 text") from error


class Document:
    """A parsed document and the problems found in it.

    Parameters
    ----------
    text : str
    name : str
        What the messages call it, such as ``"rig.toml"``.

    Raises
    ------
    ConfigurationError
        If the text is no TOML.
    """

    def __init__(self, text: str, name: str) -> None:
        self.name = name
        self.problems: list[tuple[int, str]] = []
        if len(text.encode("utf-8", "surrogatepass")) > MAX_BYTES:
            raise ConfigurationError(f"{name} has more than {MAX_BYTES} bytes; a TOML file of gonio is smaller")
        try:
            values = tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            raise ConfigurationError(f"{name} is not valid TOML: {error}; correct that line") from error
        except RecursionError:
            raise ConfigurationError(f"{name} is nested too deeply; gonio's files have at most three levels") from None
        except ValueError as error:  # an integer of thousands of digits
            raise ConfigurationError(f"{name} has a value that cannot be read: {error}; correct it") from error
        if _too_deep(values):
            raise ConfigurationError(f"{name} is nested too deeply; gonio's files have at most three levels")
        self._lines = _line_numbers(text)
        self.root = Table(self, values, "")

    def report(self, place: str, key: str, message: str) -> None:
        """Note a problem of one key of one table."""
        line = self._lines.get((place, key)) or self._lines.get((place, ""))
        where = self.name if line is None else f"{self.name}, line {line}"
        name = f"[{place}] {key}" if place and key else f"[{place}]" if place else key
        self.problems.append((line or 0, f"{where}: {name} {message}".replace(":  ", ": ")))

    def finish(self) -> None:
        """Raise what was found, all at once."""
        if len(self.problems) == 1:
            raise ConfigurationError(self.problems[0][1])
        if self.problems:
            listed = "\n".join(f"  {problem}" for _, problem in sorted(self.problems, key=lambda found: found[0]))
            raise ConfigurationError(f"{self.name} has {len(self.problems)} problems:\n{listed}")


class Table:
    """One table of a document. Each method takes one key; a wrong value is noted and replaced by a harmless one."""

    def __init__(self, document: Document, values: Mapping[str, Any], place: str) -> None:
        self.document = document
        self.place = place
        self._values = values
        self._asked: list[str] = []
        self._optional: list[str] = []

    def __contains__(self, key: str) -> bool:
        self._optional.append(key)  # known, but an error if it is there and nobody reads it
        return key in self._values

    def report(self, key: str, message: str) -> None:
        """Note a problem of `key`."""
        self.document.report(self.place, key, message)

    def number(
        self, key: str, default: Any = _REQUIRED, *, lower: float = -math.inf, upper: float = math.inf, unit: str = "",
        above: float | None = None,
    ) -> float:  # fmt: skip
        """A finite number in [lower, upper], and greater than `above`."""
        value = self._get(key, default)
        number = _number(value)
        if number is None:
            if value is not _REQUIRED:
                self.report(key, f"is {_show(value)}; it must be a finite number{_in(unit)}")
            return max(lower, min(upper, 1.0))
        return self._within(key, number, lower, upper, unit, above)

    def angle(self, key: str, default: Any = _REQUIRED, *, lower: float = -360.0, upper: float = 360.0) -> float:
        """An angle written in degrees, in radians."""
        return math.radians(self.number(key, default, lower=lower, upper=upper, unit="degrees"))

    def integer(
        self, key: str, default: Any = _REQUIRED, *, lower: int = -(2**53), upper: int = 2**53, unit: str = ""
    ) -> int:
        """An integer in [lower, upper]."""
        value = self._get(key, default)
        if isinstance(value, bool) or not isinstance(value, int):
            if value is not _REQUIRED:
                self.report(key, f"is {_show(value)}; it must be a whole number{_in(unit)}")
            return max(lower, min(upper, 1))
        if not lower <= value <= upper:
            self.report(key, f"= {_show(value)} is outside [{lower}, {upper}]{_space(unit)}; choose one inside")
            return lower
        return value

    def flag(self, key: str, default: Any = _REQUIRED) -> bool:
        """``true`` or ``false``."""
        value = self._get(key, default)
        if not isinstance(value, bool):
            if value is not _REQUIRED:
                self.report(key, f"is {_show(value)}; it must be true or false")
            return False
        return value

    def text(self, key: str, default: Any = _REQUIRED, *, choices: Iterable[str] | None = None) -> str:
        """A text that is not empty, one of `choices` if they are given."""
        value = self._get(key, default)
        if not isinstance(value, str) or (value == "" and default != ""):
            if value is not _REQUIRED:
                self.report(key, f"is {_show(value)}; it must be a text in quotes")
            return ""
        known = None if choices is None else list(choices)
        if known is not None and value not in known:
            self.report(key, f"= {_show(value)} is not known{suggestion(value, known)}; choose from: {', '.join(known)}")
            return known[0]
        return value

    def numbers(
        self, key: str, default: Any = _REQUIRED, *, count: int | None = None, lower: float = -math.inf,
        upper: float = math.inf, unit: str = "", above: float | None = None,
    ) -> tuple[float, ...]:  # fmt: skip
        """A list of finite numbers, `count` of them if it is given and at least one otherwise."""
        value = self._get(key, default)
        needed = "one or more numbers" if count is None else f"{count} numbers"
        numbers = [_number(v) for v in value] if isinstance(value, list | tuple) else []
        wrong_count = len(numbers) != count if count is not None else not numbers and value != ()
        if any(n is None for n in numbers) or wrong_count:
            if value is not _REQUIRED:
                self.report(key, f"is {_show(value)}; it must be a list of {needed}{_in(unit)}")
            return (max(lower, min(upper, 1.0)),) * (count or 1)
        return tuple(self._within(key, n, lower, upper, unit, above) for n in numbers if n is not None)

    def integers(self, key: str, default: Any = _REQUIRED, *, count: int, lower: int, upper: int) -> tuple[int, ...]:
        """A list of `count` integers in [lower, upper]."""
        value = self._get(key, default)
        good = isinstance(value, list | tuple) and len(value) == count
        if not good or any(isinstance(v, bool) or not isinstance(v, int) or not lower <= v <= upper for v in value):
            if value is not _REQUIRED:
                self.report(key, f"is {_show(value)}; it must be a list of {count} whole numbers in [{lower}, {upper}]")
            return (lower,) * count
        return tuple(value)

    def texts(self, key: str, default: Any = _REQUIRED) -> tuple[str, ...]:
        """A list of texts."""
        value = self._get(key, default)
        if not isinstance(value, list | tuple) or not all(isinstance(v, str) and v for v in value):
            if value is not _REQUIRED:
                self.report(key, f"is {_show(value)}; it must be a list of texts in quotes")
            return ()
        return tuple(value)

    def angles(
        self, key: str, default: Any = _REQUIRED, *, lower: float = -360.0, upper: float = 360.0, count: int | None = None
    ) -> tuple[float, ...]:
        """A list of angles written in degrees, in radians."""
        return tuple(
            math.radians(v) for v in self.numbers(key, default, count=count, lower=lower, upper=upper, unit="degrees")
        )

    def table(self, key: str, *, required: bool = True) -> Table:
        """A sub-table; an empty one if it is missing and not `required`."""
        self._asked.append(key)
        value = self._values.get(key)
        if value is None and required:
            self.report("", f"needs a table [{self._inner(key)}]")
        if value is not None and not isinstance(value, dict):
            self.report(key, f"is {_show(value)}; it must be a table [{self._inner(key)}]")
        missing = not isinstance(value, dict) and required
        return _Missing(self.document, {}, self._inner(key)) if missing else self._child(value, self._inner(key))

    def tables(self, key: str) -> list[Table]:
        """An array of tables ``[[key]]``; a single table ``[key]`` is an array of one."""
        self._asked.append(key)
        value = self._values.get(key, [])
        if isinstance(value, dict):
            return [self._child(value, self._inner(key))]
        if not isinstance(value, list) or not all(isinstance(v, dict) for v in value):
            self.report(key, f"is {_show(value)}; it must be tables [[{self._inner(key)}]]")
            return []
        return [self._child(v, self._inner(f"{key}.{number}")) for number, v in enumerate(value, 1)]

    def get(self, key: str) -> Any:
        """The value of `key` as it is, None if it is not there."""
        return self._values.get(key)

    def forget(self, key: str) -> None:
        """What is wrong with `key` has been said."""
        self._asked.append(key)

    def items(self, key: str) -> list[Table]:
        """For each number of the list at `key` a table that has it at `key`: what reads one number reads them all."""
        listed = [v for v in self._values[key] if _number(v) is not None]
        return [Table(self.document, {key: v}, self.place) for v in listed]

    def holds_list(self, key: str) -> bool:
        """Whether the value of `key` is a list."""
        return isinstance(self._values.get(key), list)

    def holds_text(self, key: str) -> bool:
        """Whether the value of `key` is a text."""
        return isinstance(self._values.get(key), str)

    def names(self) -> tuple[str, ...]:
        """The keys that are there."""
        return tuple(self._values)

    def free(self) -> dict[str, Any]:
        """The whole table as it is, for somebody else to check; every number in it finite."""
        self._asked.extend(self._values)
        for key, value in self._values.items():
            if not _finite(value):
                self.report(key, f"is {_show(value)}; every number in it must be finite")
        return dict(self._values)

    def free_numbers(self) -> dict[str, float]:
        """Keys not asked for so far as numbers, those of sub-tables joined by a dot: ``{"ggx.alpha": 0.2}``."""
        return {key: value if isinstance(value, float) else math.nan for key, value in self._free("", False).items()}

    def free_values(self) -> dict[str, float | str | bool]:
        """As `free_numbers`, with texts and flags as they are."""
        return self._free("", True)

    def _free(self, prefix: str, choices: bool) -> dict[str, float | str | bool]:
        found: dict[str, float | str | bool] = {}
        for key, value in self._values.items():
            if key in self._asked:
                continue
            if isinstance(value, dict):
                found.update(self.table(key)._free(f"{prefix}{key}.", choices))
            elif choices and isinstance(value, str | bool):
                self._asked.append(key)
                found[prefix + key] = value
            else:
                found[prefix + key] = self.number(key)
        return found

    def finish(self) -> None:
        """Note keys that nobody asked for, with the nearest of those that exist."""
        for key in self._values:
            if key not in self._asked:
                known = [name for name in dict.fromkeys(self._asked + self._optional) if name != key]
                self.report(key, f"is not known here{suggestion(key, known)}; known are: {', '.join(known)}")

    def _get(self, key: str, default: Any) -> Any:
        self._asked.append(key)
        if key in self._values:
            return self._values[key]
        if default is _REQUIRED:
            self.report(key, "is missing; add it")
        return default

    def _inner(self, key: str) -> str:
        return f"{self.place}.{key}" if self.place else key

    def _child(self, value: Any, place: str) -> Table:
        return Table(self.document, value if isinstance(value, dict) else {}, place)

    def _within(self, key: str, number: float, lower: float, upper: float, unit: str, above: float | None) -> float:
        if not lower <= number <= upper:
            self.report(key, f"= {number:g} is outside [{lower:g}, {upper:g}]{_space(unit)}; choose one inside")
            return max(lower, min(upper, number))
        if above is not None and not number > above:
            self.report(key, f"= {number:g} must be greater than {above:g}{_space(unit)}")
            return above + 1.0
        return number


class _Missing(Table):
    """Stands for a required table that is not there, which is one problem and not one for each of its keys."""

    def report(self, key: str, message: str) -> None:
        """Nothing: the missing table has been reported."""


def suggestion(name: str, known: Iterable[str]) -> str:
    """`` (did you mean 'x'?)`` if something similar is known, else an empty text."""
    near = difflib.get_close_matches(name, list(known), 1, 0.55)
    return f" (did you mean {near[0]!r}?)" if near else ""


def _number(value: Any) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def _finite(value: Any) -> bool:
    if isinstance(value, dict):
        return all(_finite(v) for v in value.values())
    if isinstance(value, list):
        return all(_finite(v) for v in value)
    return isinstance(value, str | bool) or _number(value) is not None


def _too_deep(values: Mapping[str, Any], most: int = 16) -> bool:
    """Whether tables and lists are nested more than `most` levels deep: a dotted key may be thousands."""
    level: list[Any] = [values]
    for _ in range(most):
        level = [
            inner for one in level for inner in (one.values() if isinstance(one, dict) else one)
            if isinstance(inner, dict | list)
        ]  # fmt: skip
    return bool(level)


def _show(value: Any) -> str:
    text = repr(value) if not isinstance(value, bool) else str(value).lower()
    return text if len(text) <= 60 else text[:57] + "..."


def _in(unit: str) -> str:
    return f" in {unit}" if unit else ""


def _space(unit: str) -> str:
    return f" {unit}" if unit else ""


def _line_numbers(text: str) -> dict[tuple[str, str], int]:
    """Line of each (table, key) as a person wrote it; (table, "") is its header. Good enough for a message."""
    lines: dict[tuple[str, str], int] = {}
    seen: dict[str, int] = {}
    place = ""
    for number, line in enumerate(text.splitlines(), 1):
        if header := _HEADER.match(line):
            place = header[1].replace('"', "").replace(" ", "")
            if line.lstrip().startswith("[["):
                seen[place] = seen.get(place, 0) + 1
                place = f"{place}.{seen[place]}"
            lines.setdefault((place, ""), number)
        elif key := _KEY.match(line):
            lines.setdefault((place, key[1].strip("\"' ")), number)
    return lines
