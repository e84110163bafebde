"""A file lock that names its holder, for what only one process may have: a run's folder, a serial port.

The operating system's file lock ends with its process, however that ends, so nothing stale is left to clear; the file
itself stays, and only says who held the lock last. It knows neither runs nor ports.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import time
from pathlib import Path

_PATIENCE_S = 0.5  # for a holder to write its name, which it does right after it has the lock
_STEP_S = 0.005
_NAME_BYTES = 1000


class HeldError(Exception):
    """Another process holds the lock; the message says which: ``process 4711 on bench since 2026-11-28T09:30:00+0100``.

    Attributes
    ----------
    pid : int or None
        Of that process, if it is known and on this machine.
    """

    def __init__(self, message: str, pid: int | None = None) -> None:
        super().__init__(message)
        self.pid = pid


class FileLock:
    """A lock on a path; a context, or `acquire` and `release`.

    Parameters
    ----------
    path : Path
        Of the lock file; it is made if absent. Its folder must exist.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: int | None = None

    def acquire(self) -> FileLock:
        """Take the lock.

        Raises
        ------
        HeldError
            If another process has it.
        OSError
            If the file cannot be opened.
        """
        file = _open(self._path)
        try:
            _lock(file)
        except OSError:
            error = _holder(file)
            os.close(file)
            raise error from None
        owner = {"host": socket.gethostname(), "pid": os.getpid(), "since": time.strftime("%Y-%m-%dT%H:%M:%S%z")}
        with contextlib.suppress(OSError):  # another user's file holds as well, under the name of its last holder
            os.ftruncate(file, 0)
            os.pwrite(file, json.dumps(owner).encode(), 0)
        self._file = file
        return self

    def release(self) -> None:
        """Give it back; a second time does nothing."""
        if self._file is not None:
            with contextlib.suppress(OSError):
                os.ftruncate(self._file, 0)
            os.close(self._file)  # ends the lock
            self._file = None

    def __enter__(self) -> FileLock:
        return self.acquire()

    def __exit__(self, *exc: object) -> None:
        self.release()


def _open(path: Path) -> int:
    flags = os.O_RDWR | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_NOFOLLOW", 0)
    try:
        return os.open(path, flags | os.O_CREAT, 0o666)
    except PermissionError:  # made by another user, in a folder for all
        return os.open(path, flags & ~os.O_RDWR | os.O_RDONLY)


def _lock(file: int) -> None:
    if os.name == "nt":
        import msvcrt

        os.lseek(file, 10 * _NAME_BYTES, os.SEEK_SET)  # beyond the text, which others may read
        msvcrt.locking(file, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined,unused-ignore]
    else:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _holder(file: int) -> HeldError:
    """Who says that it holds the lock; a name that is missing, or that of a process that is gone, is waited for."""
    deadline = time.monotonic() + _PATIENCE_S
    while True:
        try:
            owner = json.loads(os.pread(file, _NAME_BYTES, 0))
            pid, here = int(owner["pid"]), owner["host"] == socket.gethostname()
            if not here or _lives(pid):
                name = f"process {pid} on {owner['host']} since {owner['since']}"
                return HeldError(name, pid if here else None)
        except (OSError, ValueError, KeyError, TypeError):
            pass
        if time.monotonic() > deadline:
            return HeldError("another process")
        time.sleep(_STEP_S)


def _lives(pid: int) -> bool:
    if os.name == "nt":
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True
