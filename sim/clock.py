"""Rig time, virtual or scaled; both clocks satisfy `gonio.interfaces.Clock`.

With a `VirtualClock` nothing waits: whoever would wait moves the time on instead, so a scan of hours takes seconds and
happens the same way twice. It is for one thread; two threads that both move one virtual time disagree about it.
With a `ScaledClock` the wall's clock runs, faster by a factor.
"""

from __future__ import annotations

import time

from gonio.errors import ParameterError


class VirtualClock:
    """Time that moves only when somebody waits, in integer nanoseconds.

    Parameters
    ----------
    start_s : float, optional
        Time at the start [s].
    """

    def __init__(self, start_s: float = 0.0) -> None:
        self._ns = round(start_s * 1e9)

    @property
    def now_ns(self) -> int:
        """The time [ns]."""
        return self._ns

    def now(self) -> float:
        """The time [s]."""
        return self._ns * 1e-9

    def sleep(self, seconds: float) -> None:
        """Move the time on by `seconds` [s]; a wait of 0 or less is none."""
        if seconds > 0.0:
            self._ns += round(seconds * 1e9)

    def advance_to(self, seconds: float) -> None:
        """Move the time on to `seconds` [s]; never back."""
        self._ns = max(self._ns, round(seconds * 1e9))


class ScaledClock:
    """The wall's monotonic clock, started at 0 and run `speed` times as fast.

    Parameters
    ----------
    speed : float, optional
        Rig seconds per wall second.
    start_ns : int, optional
        When it showed 0, on the system's monotonic clock [ns], which all processes share; now by default.

    Raises
    ------
    ParameterError
        If `speed` is not positive.
    """

    def __init__(self, speed: float = 1.0, start_ns: int | None = None) -> None:
        if not speed > 0.0:
            raise ParameterError(f"The simulator's speed is {speed}; it must be above 0 rig seconds per wall second.")
        self.speed = float(speed)
        self.start_ns = time.monotonic_ns() if start_ns is None else start_ns

    def now(self) -> float:
        """Rig seconds since it showed 0 [s]."""
        return (time.monotonic_ns() - self.start_ns) * 1e-9 * self.speed

    def sleep(self, seconds: float) -> None:
        """Wait `seconds` of rig time [s]."""
        if seconds > 0.0:
            time.sleep(seconds / self.speed)
