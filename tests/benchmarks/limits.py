"""A limit on the wall time of a computation, where the platform has timers; elsewhere there is none."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator
from types import FrameType


class LateError(Exception):
    """The time ran out."""


@contextlib.contextmanager
def at_most(seconds: float) -> Iterator[None]:
    """Raise `LateError` in the main thread once the time is over and Python has its turn again."""
    if not hasattr(signal, "setitimer"):
        yield
        return

    def stop(number: int, frame: FrameType | None) -> None:
        raise LateError

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
