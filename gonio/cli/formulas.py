r"""Formulas of docstrings in plain characters, for the terminal: ``\frac{\rho}{\pi}\mu_i`` becomes ``rho/pi mu_i``.

Knows as much of TeX as the models' docstrings use. A command that it does not know is written as its name.
"""

from __future__ import annotations

import re

_WRITTEN = {
    "cdot": " . ", "quad": "   ", "qquad": "   ", "le": "<=", "ge": ">=", "in": " in ", "infty": "infinity",
    ",": " ", ";": " ", " ": " ", "!": "",
}  # fmt: skip
_DROPPED = {"bigl", "bigr", "Bigl", "Bigr", "left", "right", "text", "mathrm"}
_TOKEN = re.compile(r"\\[A-Za-z]+|\\.|\s+|[A-Za-z]+|[\d.]+|.", re.DOTALL)
_SIMPLE = re.compile(r"[\w.]+")
_ONE_THING = re.compile(r"[\w.]+(\^\w+)?|[A-Za-z]\w*\([^()]*\)")
_FUNCTION = re.compile(r"(sin|cos|tan|cot|ln)(\^\w+)? *$")


def plain(text: str) -> str:
    """The docstring with its math directives and roles in plain characters."""
    text = text.replace("``", "")
    text = re.sub(r"(?m)^( *)\.\. math::(.*\n(?:\1 +.*\n|\s*\n)*)", lambda m: f"{m[1]}{_lines(m[2])}", text + "\n")
    return re.sub(r":math:`([^`]*)`", lambda m: formula(m[1]), text)


def _lines(block: str) -> str:
    first, _, rest = block.partition("\n")
    shown = formula(f"    {first.strip()}\n{rest}" if first.strip() else f"\n{rest}")
    return "\n".join(line.rstrip() for line in shown.split("\n"))


def formula(tex: str) -> str:
    """A formula in plain characters."""
    text = _Reader(tex).until("").rstrip(" ")
    return re.sub(r"(?<=\S) {2,}", lambda m: "  " if len(m[0]) > 2 else " ", text)


class _Reader:
    """Reads one formula from left to right."""

    def __init__(self, tex: str) -> None:
        self.tokens: list[str] = _TOKEN.findall(tex)
        self.at = 0
        self.cases = False

    def until(self, end: str) -> str:
        """All up to a closing token, which is read too."""
        out, fraction = "", False
        while self.at < len(self.tokens):
            token = self.tokens[self.at]
            if token == end:
                self.at += 1
                break
            text, word = self.one()
            out = _joined(out + " " if fraction and text[:1] in ("(", "[") else out, text, word)
            fraction = word and "/" in text if text else fraction
        return out

    def one(self) -> tuple[str, bool]:
        """The next token with its arguments, and whether it is a word of its own."""
        token = self.tokens[self.at]
        self.at += 1
        if token == "{":
            return self.until("}"), False
        if token in "^_":
            value = self.argument()
            return token + (value if _SIMPLE.fullmatch(value) else f"({value})"), False
        if token == "&":
            return (" for " if self.cases else ""), False
        if not token.startswith("\\"):
            return token, False
        return self.command(token[1:])

    def argument(self) -> str:
        while self.at < len(self.tokens) and self.tokens[self.at].isspace():
            self.at += 1
        token = self.tokens[self.at] if self.at < len(self.tokens) else ""
        if len(token) > 1 and token[0] != "\\":  # of letters or digits without braces, the first
            self.tokens[self.at : self.at + 1] = [token[0], token[1:]]
        return self.one()[0].strip() if token else ""

    def command(self, name: str) -> tuple[str, bool]:
        if name in ("frac", "tfrac", "dfrac"):
            top, bottom = self.argument(), self.argument()
            return f"{_enclosed(top, sums_only=True)}/{_enclosed(bottom)}", True
        if name == "sqrt":
            return f"sqrt({self.argument()})", True
        if name == "bar":
            return f"{self.argument()}_bar", True
        if name in ("begin", "end"):
            self.argument()
            self.cases = name == "begin"
            return ("{" if self.cases else "}"), False
        if name == "\\":
            return (";" if self.cases else ""), False
        if name in _DROPPED:
            return "", False
        if name in _WRITTEN or not name.isalpha():
            return _WRITTEN.get(name, name), False
        return name, True


def _joined(before: str, after: str, word: bool) -> str:
    """The two, with a space where letters would run together; a fraction that a function takes, in parentheses."""
    if word and "/" in after and _FUNCTION.search(before):
        return f"{before.rstrip()}({after})"
    close = before[-1:].isalnum() or before[-1:] in (")", "]")
    named = before[-1:] != "_" and re.search(r"[A-Za-z]{2,}\w*$", before) is not None
    apart = (word and close) or (named and after[:1].isalnum())
    return f"{before} {after}" if apart and after[:1] not in ("", " ") else before + after


def _enclosed(term: str, *, sums_only: bool = False) -> str:
    """In parentheses, unless it is one thing; of numerators, unless it is a product."""
    depth, sums = 0, False
    for k, c in enumerate(term):
        depth += (c in "([{") - (c in ")]}")
        sums |= depth == 0 and c in "+-" and k > 0
    whole = term.startswith("(") and not re.search(r"^\([^()]*\).", term) and term.endswith(")")
    one = _ONE_THING.fullmatch(term) is not None or whole or (sums_only and not sums)
    return term if one else f"({term})"
