"""Reading files that are not ours, and writing files that are either whole or absent.

Size caps come before memory is taken; text is decoded strictly; a number that is not finite is refused with its line.
Nothing here knows a format.
"""

from __future__ import annotations

import math
import os
import secrets
from collections.abc import Callable, Iterable
from pathlib import Path

from gonio.errors import DatasetError

LARGEST_TEXT = 64 * 2**20  # bytes
LARGEST_BINARY = 2 * 2**30  # bytes


def size_of(path: Path, largest: int = LARGEST_BINARY) -> int:
    """Size of a regular file in bytes, or a `DatasetError` if there is none or it is larger than `largest`."""
    try:
        if not path.is_file():
            raise DatasetError(f"{path} is not a file; give the path of a data file")
        size = path.stat().st_size
    except OSError as error:
        raise DatasetError(f"{path} cannot be read: {error.strerror}; check the path and its permissions") from error
    if size > largest:
        raise DatasetError(
            f"{path} has {size} bytes, at most {largest} are read for this format; split or thin the file first"
        )
    return size


def head(path: Path, count: int = 65536) -> bytes:
    """The first bytes of a file."""
    size_of(path, largest=2**62)
    try:
        with path.open("rb") as file:
            return file.read(count)
    except OSError as error:
        raise DatasetError(f"{path} cannot be read: {error.strerror}; check its permissions") from error


def read_bytes(path: Path, largest: int = LARGEST_BINARY) -> bytes:
    """The whole file, at most `largest` bytes."""
    size_of(path, largest)
    try:
        with path.open("rb") as file:
            data = file.read(largest + 1)
    except OSError as error:
        raise DatasetError(f"{path} cannot be read: {error.strerror}; check its permissions") from error
    if len(data) > largest:
        raise DatasetError(f"{path} grew while it was read; copy it first")
    return data


def read_lines(path: Path, largest: int = LARGEST_TEXT) -> list[str]:
    """The lines of a text file in UTF-8, without line ends and byte-order mark."""
    data = read_bytes(path, largest)
    if b"\0" in data:
        raise DatasetError(f"{path} holds zero bytes, so it is no text; check that the file is what its name says")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise DatasetError(f"{path}, line {line}: not UTF-8 text; convert the file to UTF-8") from error
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def number(text: str, where: str) -> float:
    """A finite decimal number, or a `DatasetError` that begins with `where`."""
    try:
        value = float(text) if text.isascii() and "_" not in text else math.nan
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise DatasetError(f"{where}: {shown(text)} is not a finite number; correct or remove the line")
    return value


def numbers(words: Iterable[str], where: str) -> list[float]:
    """`number` of each word."""
    return [number(word, where) for word in words]


def whole(text: str, where: str, largest: int) -> int:
    """A whole number from 1 to `largest`, or a `DatasetError` that begins with `where`."""
    value = int(text) if text.isascii() and text.isdigit() and len(text) < 19 else -1
    if not 1 <= value <= largest:
        raise DatasetError(f"{where}: {shown(text)} is not a count from 1 to {largest}; the file is damaged")
    return value


def shown(text: str, most: int = 40) -> str:
    """Foreign text made fit for one line of a message."""
    return repr(text if len(text) <= most else text[:most] + "...")


def replace_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` make a temporary file beside `path`, flush it to disk and rename it over `path`.

    Raises
    ------
    DatasetError
        If the folder does not exist or cannot be written; `path` is then as it was.
    """
    temporary: Path | None = None
    try:
        temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
        write(temporary)
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        raise DatasetError(f"{path} cannot be written: {error.strerror or error}; check folder and free space") from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
