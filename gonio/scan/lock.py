"""A lock on a run's folder, so that two processes never scan into one run.

The operating system's file lock ends with its process, however that ends, so nothing stale is left to clear; the file
itself stays, and only says who held the lock last.
"""

from __future__ import annotations

import json
import os
import socket
import time
from pathlib import Path
from typing import IO

from gonio.errors import DatasetError


class RunLock:
    """A context that holds the lock.

    Raises
    ------
    DatasetError
        On entering, if another process holds it.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: IO[str] | None = None

    def __enter__(self) -> RunLock:
        try:
            file = self._path.open("a+", encoding="utf-8")
        except OSError as error:
            raise DatasetError(
                f"{self._path} cannot be written: {error.strerror}; check the folder's permissions"
            ) from error
        try:
            _lock(file)
        except OSError:
            file.seek(0)
            owner = file.read(1000)
            file.close()
            raise DatasetError(
                f"{self._path.parent} is being scanned by {_who(owner)}; wait for it to end, or stop it with Ctrl-C"
            ) from None
        file.seek(0)
        file.truncate()
        json.dump({"host": socket.gethostname(), "pid": os.getpid(), "since": time.strftime("%Y-%m-%dT%H:%M:%S%z")}, file)
        file.flush()
        self._file = file
        return self

    def __exit__(self, *exc: object) -> None:
        if self._file is not None:
            self._file.close()  # releases the lock
            self._file = None


def _lock(file: IO[str]) -> None:
    if os.name == "nt":
        import msvcrt

        file.seek(10_000)  # beyond the text, which others may read
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined,unused-ignore]
    else:
        import fcntl

        fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)


def _who(text: str) -> str:
    try:
        owner = json.loads(text)
        return f"process {owner['pid']} on {owner['host']} since {owner['since']}"
    except (ValueError, KeyError, TypeError):
        return "another process"
