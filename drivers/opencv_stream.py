"""Frames of a ``cv2.VideoCapture`` that show the present: nothing from a queue, nothing that was under way.

A live camera's driver keeps frames that nobody took and gives those first. They come at once, while a new frame has to be
waited for: the queue is empty when two in a row were. After that some frames more still show the past, those that the
camera, its electronics and the bus had under way. How many is not documented for any camera; `measure_late` finds it with a
light that is switched, and until then a number large for real cameras is assumed. Files are no stream: they come one by one.

It knows neither exposures nor counts.

References: OpenCV issues 13145 and 17019, on buffers that cannot be switched off.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

from gonio.interfaces import Clock

logger = logging.getLogger(__name__)

LATE = 6
"""Frames that may show the past after the queue is empty, until it is measured."""
LATENCY = 4
"""Further frames that a new exposure may take."""
_WAITED = 0.3  # of a frame interval: a frame that took so long was not in a queue
_MOST_QUEUED = 400
_MOST_LATE = 60


class NoFrameError(Exception):
    """The camera sends none."""


class Stream:
    """The frames of a capture.

    Parameters
    ----------
    capture : cv2.VideoCapture
        Or what offers ``grab`` and ``read``.
    clock : Clock
    live : bool
        Frames pass by whether they are read or not.
    interval_s : float
        From frame to frame [s].
    late : int, optional
        Frames thrown away before each one that counts; for a live stream after its queue is empty.
    """

    def __init__(self, capture: Any, clock: Clock, *, live: bool, interval_s: float, late: int | None = None) -> None:
        self.late = (LATE if live else 0) if late is None else late
        self._capture = capture
        self._clock = clock
        self._live = live
        self._interval_s = interval_s

    def fresh(self, *, changed: bool) -> tuple[Any, float]:
        """A frame whose exposure began after this call, and the rig time at which it was there [s].

        Parameters
        ----------
        changed : bool
            The exposure has just been set to another value.

        Raises
        ------
        NoFrameError
            If the camera sends none.
        """
        if self._live:
            self._drain()
        for _ in range(self.late + (LATENCY if changed and self._live else 0)):
            self._grab()
        return self._read()

    def measure_late(self, light: Callable[[bool], object], bright: Callable[[Any], bool]) -> int:
        """Switch the light, count the frames that still show it as it was, and throw that many away from now on.

        Parameters
        ----------
        light : callable
            Switches the light and returns when it has; it must be on when this is called, and is on afterwards.
        bright : callable
            Whether a frame shows the light on.

        Returns
        -------
        int
            Frames thrown away from now on: one more than showed the past, as the next may have begun before.

        Raises
        ------
        NoFrameError
            If the camera sends none, or none that shows the change.
        """
        worst = 0
        for on in (False, True, False, True):
            self._drain()
            light(on)
            for shown in range(_MOST_LATE):
                if bright(self._read()[0]) is on:
                    worst = max(worst, shown)
                    break
            else:
                raise NoFrameError
        self.late = worst + 1
        return self.late

    def _drain(self) -> None:
        """Take what is in the queue."""
        waited = 0
        for _ in range(_MOST_QUEUED):
            before_s = self._clock.now()
            self._grab()
            waited = waited + 1 if self._clock.now() - before_s > _WAITED * self._interval_s else 0
            if waited == 2:
                return
        logger.warning("the camera's queue does not come to an end; its frames come faster than it says")

    def _grab(self) -> None:
        if not self._capture.grab():
            raise NoFrameError

    def _read(self) -> tuple[Any, float]:
        ok, data = self._capture.read()
        if not ok or data is None:
            raise NoFrameError
        return data, self._clock.now()
