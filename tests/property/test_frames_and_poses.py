"""Every frame shows the pose that it is filed under, whatever queue and delay the camera has.

The camera is one that shows in its pixels which pose it saw in the middle of its exposure: frames pass whether they are
taken or not, the driver keeps the first that nobody took, and each arrives some frames late.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from typing import Any

import cv2
import numpy as np
import pytest

from drivers.opencv_camera import OpenCVCamera
from sim.clock import VirtualClock
from tests.gates import record

INTERVAL_S = 1.0 / 30.0
LAGS, BUFFERS = (0, 1, 2, 3, 4, 5), (1, 4, 30)
SEED = 7


class Passing:
    """A live camera in the place of ``cv2.VideoCapture``.

    ``lag``: frames from the end of an exposure to its arrival; ``buffers``: frames that the driver keeps.
    """

    def __init__(self, clock: VirtualClock, lag: int, buffers: int) -> None:
        self.clock, self.lag, self.buffers = clock, lag, buffers
        self.poses: list[tuple[float, int]] = [(-math.inf, 0)]  # since when which pose
        self.properties = {cv2.CAP_PROP_AUTO_EXPOSURE: 1.0, cv2.CAP_PROP_EXPOSURE: 20.0, cv2.CAP_PROP_FPS: 30.0}
        self.queue: deque[int] = deque()
        self.next = 0

    def isOpened(self) -> bool:
        return True

    def release(self) -> None: ...

    def get(self, prop: int) -> float:
        return self.properties.get(prop, -1.0)

    def set(self, prop: int, value: float) -> bool:
        if prop in self.properties:
            self.properties[prop] = value
        return prop in self.properties

    def grab(self) -> bool:
        arrived = math.floor(self.clock.now() / INTERVAL_S - self.lag + 1e-9)  # frames that are there by now
        while self.next < arrived and len(self.queue) < self.buffers:
            self.queue.append(self.next)
            self.next += 1
        self.next = max(self.next, arrived)
        if not self.queue:
            self.clock.sleep((self.next + 1 + self.lag) * INTERVAL_S - self.clock.now())
            self.queue.append(self.next)
            self.next += 1
        self.number = self.queue.popleft()
        return True

    def read(self) -> tuple[bool, np.ndarray[Any, Any]]:
        self.grab()
        exposure_s = 1e-4 * self.properties[cv2.CAP_PROP_EXPOSURE]
        began_s = self.number * INTERVAL_S
        seen = next(pose for since, pose in reversed(self.poses) if since <= began_s)
        then = next(pose for since, pose in reversed(self.poses) if since <= began_s + exposure_s)
        return True, np.full((2, 3), seen if seen == then else 0, np.uint16)  # 0: it moved during the exposure


def wrong(poses: int, lag: int, buffers: int, *, measured: bool, blind: int | None = None) -> int:
    """Frames that do not show the pose they were asked for, of so many."""
    clock, rng = VirtualClock(), np.random.default_rng([SEED, lag, buffers])
    passing = Passing(clock, lag, buffers)
    camera = OpenCVCamera(0, backend="v4l2", clock=clock, open_capture=lambda *_: passing, stale_frames=blind)
    if measured:

        def light(on: bool) -> None:
            passing.poses.append((clock.now(), 1000 if on else 1))

        light(True)
        clock.sleep(1.0)
        assert lag + 1 <= camera.measure_late(light, 0.002) <= lag + 2  # those that show the past, and one more
    off = 0
    for pose in range(1, poses + 1):
        clock.sleep(float(rng.exponential(0.3)))
        passing.poses = [*passing.poses[-50:], (clock.now(), pose)]
        for exposure_s in (0.002, 0.002, 0.016)[: 2 if blind is not None else 3]:
            off += not np.all(camera.capture(exposure_s, label="").data == pose)
    return off


@pytest.mark.parametrize("measured", [False, True], ids=["assumed", "measured"])
def test_no_frame_shows_another_pose(measured: bool) -> None:
    for lag, buffers in itertools.product(LAGS, BUFFERS):
        assert wrong(20, lag, buffers, measured=measured) == 0, (lag, buffers)


def test_without_care_they_do() -> None:
    assert wrong(20, 5, 4, measured=False, blind=0) > 5


@pytest.mark.gate
def test_ten_thousand_poses() -> None:
    each = math.ceil(10_000 / (len(LAGS) * len(BUFFERS)))
    settings = list(itertools.product(LAGS, BUFFERS, (False, True)))
    off = sum(wrong(each, lag, buffers, measured=measured) for lag, buffers, measured in settings)
    record(
        "frames and poses, lag 0 to 5, queues of 1, 4 and 30",
        f"{off} wrong of {3 * each * len(settings)} frames at {each * len(settings)} poses",
        "0",
        str(SEED),
        "pytest -m gate tests/property/test_frames_and_poses.py",
    )
    assert off == 0
