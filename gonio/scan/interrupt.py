"""Ctrl-C, SIGTERM and SIGHUP during a scan: the first one asks the engine to stop now, the second one ends at once.

A handler only sets an event: no byte is sent to a device from inside a handler, where a transaction may be half done.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")


class Interrupted(KeyboardInterrupt):
    """A scan was stopped on request: the axes hold, the data are kept. Exit code `gonio.errors.EXIT_INTERRUPTED`."""


class Interrupts:
    """The event, and which signal set it."""

    def __init__(self) -> None:
        self.event = threading.Event()
        self.name = "a request"

    def check(self, what: str) -> None:
        """Raise `Interrupted` if a stop was asked for.

        Parameters
        ----------
        what : str
            Says what is kept, and what to do next.
        """
        if self.event.is_set():
            raise Interrupted(f"stopped by {self.name}: the axes hold, {what}")


@contextmanager
def interrupts() -> Iterator[Interrupts]:
    """Handle the signals in this context, if it is the main thread's; the earlier handlers come back after it."""
    state = Interrupts()
    previous: dict[int, Any] = {}

    def handler(number: int, frame: FrameType | None) -> None:
        state.name = "Ctrl-C" if number == signal.SIGINT else signal.Signals(number).name
        if state.event.is_set():
            raise KeyboardInterrupt
        state.event.set()

    if threading.current_thread() is threading.main_thread():
        for name in _SIGNALS:
            number = getattr(signal, name, None)
            # a signal that the parent has told this process to ignore (nohup) stays ignored
            if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
                previous[number] = signal.signal(number, handler)
    try:
        yield state
    finally:
        for number, earlier in previous.items():
            signal.signal(number, earlier)
