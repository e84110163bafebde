"""JSON from outside: small enough, no NaN and no infinity, no key twice, not nested without end."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gonio import files
from gonio.errors import DatasetError


def read(path: Path) -> dict[str, Any]:
    """The object of a JSON file, or a `DatasetError`."""
    text = "\n".join(files.read_lines(path))

    def refuse(name: str) -> float:
        raise ValueError(f"{name} is no JSON number")

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict(pairs)
        if len(found) != len(pairs):
            twice = next(k for k, _ in pairs if [p[0] for p in pairs].count(k) > 1)
            raise ValueError(f"the key {files.shown(twice)} stands twice")
        return found

    try:
        data = json.loads(text, parse_constant=refuse, object_pairs_hook=once)
    except json.JSONDecodeError as error:
        raise DatasetError(f"{path}, line {error.lineno}: not JSON ({error.msg}); the file is cut or damaged") from error
    except RecursionError as error:
        raise DatasetError(f"{path}: JSON nested without end is refused") from error
    except ValueError as error:
        raise DatasetError(f"{path}: {error}; correct the file") from error
    if not isinstance(data, dict):
        raise DatasetError(f"{path}: the file holds no JSON object; it is of another kind")
    return data


def member(path: Path, data: dict[str, Any], name: str, kind: type) -> Any:
    """A member that must be there and of that kind."""
    value = data.get(name)
    if not isinstance(value, kind) or isinstance(value, bool):
        words = {"dict": "an object", "list": "a list", "str": "a text"}[kind.__name__]
        raise DatasetError(f"{path}: {files.shown(name)} must be {words}, and is {'missing' if name not in data else 'not'}")
    return value


def numbers(path: Path, values: list[Any], name: str) -> NDArray[np.float64]:
    """A list of finite numbers as an array (n,)."""
    for k, value in enumerate(values):
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise DatasetError(f"{path}: value {k} of {name} is not a number; correct the file")
    try:
        out = np.array([float(v) for v in values])
    except OverflowError as error:
        raise DatasetError(f"{path}: a value of {name} is too large for a number; correct the file") from error
    if not np.all(np.isfinite(out)):
        raise DatasetError(f"{path}: value {int(np.argmin(np.isfinite(out)))} of {name} is not finite; correct the file")
    return out
