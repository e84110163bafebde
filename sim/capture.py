"""The simulated camera behind the surface of ``cv2.VideoCapture``, with the manners of a backend.

A live camera streams whether it is read or not. Its driver keeps the first frames that nobody took, so the next ``read``
is old; a new exposure takes some frames to arrive; automatic exposure is on until it is switched off; exposures have the
backend's unit and never exceed the frame interval. Frames show the bench as it was when they were exposed.

For code that wants OpenCV itself there are image sequences (`write_images`, read with ``CAP_IMAGES``) and `sim.mjpeg`.
Not modelled: white balance, sharpening and denoising (the controls exist and do nothing), USB bandwidth.

References: OpenCV videoio, VideoCaptureProperties; V4L2 "Camera Control Reference" (V4L2_CID_EXPOSURE_ABSOLUTE counts
100 us); DirectShow CameraControlProperty (exposure counts log2 of seconds).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gonio.errors import ConfigurationError, DeviceError
from gonio.interfaces import Clock
from sim.camera import SimulatedCamera

_AUTO_LEVEL = 0.45  # of full scale, that automatic exposure aims at
_SHORTEST_S = 1e-4


@dataclass(frozen=True)
class Profile:
    """How a backend behaves.

    Attributes
    ----------
    buffers : int
        Frames that the driver keeps for a reader who does not come.
    resizable : bool
        ``CAP_PROP_BUFFERSIZE`` can be set.
    latency : int
        Frames that are exposed with the old setting after a new one.
    automatic, manual : float
        Values of ``CAP_PROP_AUTO_EXPOSURE``.
    answers : bool
        It can be read and set; otherwise setting an exposure makes it manual.
    """

    buffers: int
    resizable: bool
    latency: int
    automatic: float
    manual: float
    answers: bool


PROFILES = {
    "v4l2": Profile(4, True, 2, 3.0, 1.0, True),
    "dshow": Profile(2, False, 3, 0.75, 0.25, False),
}
_IDLE_CONTROLS = (cv2.CAP_PROP_AUTO_WB, cv2.CAP_PROP_SHARPNESS, cv2.CAP_PROP_BACKLIGHT)


class SimCapture:
    """A stream of frames of the simulated bench; offers the methods of ``cv2.VideoCapture``.

    Parameters
    ----------
    camera : SimulatedCamera
    clock : Clock
        Reading a frame that is not there yet waits on it.
    profile : {"v4l2", "dshow"}, optional
    """

    def __init__(self, camera: SimulatedCamera, clock: Clock, profile: str = "v4l2") -> None:
        if profile not in PROFILES:
            raise ConfigurationError(f"There is no backend profile {profile!r}; there are {', '.join(PROFILES)}.")
        self._camera = camera
        self._clock = clock
        self._name, self._profile = profile, PROFILES[profile]
        sensor = camera.world.settings.sensor
        self._interval = sensor.frame_interval_s
        self._start = clock.now()
        self._next = 0  # first frame that the driver has not seen
        self._queue: deque[int] = deque()
        self._buffers = self._profile.buffers
        self._grabbed: int | None = None
        self._released = False
        # (frame from which it holds, exposure [s] or None for automatic), the latest last
        self._exposures: deque[tuple[int, float | None]] = deque([(0, None)], 64)
        self._raw = False
        self._gain = 1.0
        self._idle: dict[int, float] = dict.fromkeys(_IDLE_CONTROLS, 1.0)

    # ---- cv2.VideoCapture --------------------------------------------------------------------------------------

    def isOpened(self) -> bool:
        """Whether it can be read."""
        return not self._released

    def release(self) -> None:
        """Close it."""
        self._released = True

    def grab(self) -> bool:
        """Take the oldest frame that the driver has, or wait for one."""
        if self._released or self._camera.unplugged:
            return False
        self._stream()
        if not self._queue:
            self._clock.sleep(self._ends(self._next) - self._clock.now())
            self._queue.append(self._next)
            self._next += 1
        self._grabbed = self._queue.popleft()
        return True

    def retrieve(self) -> tuple[bool, NDArray[Any] | None]:
        """The frame that was grabbed."""
        if self._grabbed is None:
            return False, None
        number = self._grabbed
        exposure = self._exposure(number)
        middle = self._start + number * self._interval + 0.5 * exposure
        counts = self._camera.expose(middle, exposure, f"stream {number}", self._gain)
        sensor = self._camera.world.settings.sensor
        if self._raw:
            return True, counts.astype(np.uint8) if sensor.bit_depth <= 8 else counts
        grey = (counts >> max(sensor.bit_depth - 8, 0)).astype(np.uint8)
        return True, np.repeat(grey[..., None], 3, axis=2)

    def read(self) -> tuple[bool, NDArray[Any] | None]:
        """Grab and retrieve."""
        return self.retrieve() if self.grab() else (False, None)

    def get(self, prop: int) -> float:
        """A property; -1 for one that the backend does not have."""
        sensor = self._camera.world.settings.sensor
        exposure = self._exposures[-1][1]
        gamma = self._camera.chip.gamma
        known = {
            cv2.CAP_PROP_FRAME_WIDTH: float(sensor.width),
            cv2.CAP_PROP_FRAME_HEIGHT: float(sensor.height),
            cv2.CAP_PROP_FOURCC: float(cv2.VideoWriter.fourcc(*("GREY" if sensor.bit_depth <= 8 else "Y16 "))),
            cv2.CAP_PROP_FPS: 1.0 / self._interval,
            cv2.CAP_PROP_CONVERT_RGB: float(not self._raw),
            cv2.CAP_PROP_GAIN: self._gain,
            cv2.CAP_PROP_EXPOSURE: self._unit(self._exposure(self._next) if exposure is None else exposure),
            cv2.CAP_PROP_POS_MSEC: 1e3 * self._ends(self._grabbed) if self._grabbed is not None else 0.0,
        } | self._idle
        if self._profile.resizable:
            known[cv2.CAP_PROP_BUFFERSIZE] = float(self._buffers)
        if self._profile.answers:
            known[cv2.CAP_PROP_AUTO_EXPOSURE] = self._profile.automatic if exposure is None else self._profile.manual
            known[cv2.CAP_PROP_GAMMA] = float(round(100.0 * (gamma or 1.0)))
        return known.get(prop, -1.0)

    def set(self, prop: int, value: float) -> bool:
        """Set a property; False if the backend does not take it."""
        if prop in self._idle:
            self._idle[prop] = value
        elif prop == cv2.CAP_PROP_CONVERT_RGB:
            self._raw = value == 0.0
        elif prop == cv2.CAP_PROP_GAIN and 1.0 <= value <= 16.0:
            self._gain = value
        elif prop == cv2.CAP_PROP_BUFFERSIZE and self._profile.resizable and 1 <= value <= 10:
            self._buffers = int(value)
        elif prop == cv2.CAP_PROP_GAMMA and self._profile.answers and 100 <= value <= 500:
            self._camera.chip.gamma = 0.0 if value == 100 else value / 100.0
        elif prop == cv2.CAP_PROP_AUTO_EXPOSURE and self._profile.answers:
            if value not in (self._profile.automatic, self._profile.manual):
                return False
            automatic = value == self._profile.automatic
            self._later(None if automatic else self._exposure(self._next))
        elif prop == cv2.CAP_PROP_EXPOSURE:
            return self._set_exposure(value)
        else:
            return prop in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FOURCC) and (
                self.get(prop) == value
            )
        return True

    # ---- the stream --------------------------------------------------------------------------------------------

    def _ends(self, number: int) -> float:
        """When a frame is there [s]."""
        return self._start + (number + 1) * self._interval

    def _stream(self) -> None:
        """Let the driver have what came since it was last asked: it keeps the first, and drops what has no buffer."""
        now = self._clock.now()
        done = max(math.floor((now - self._start) / self._interval + 1e-9), self._next)
        while self._next < done and len(self._queue) < self._buffers:
            self._queue.append(self._next)
            self._next += 1
        self._next = done

    def _exposure(self, number: int) -> float:
        """Exposure time of a frame [s]."""
        setting = next((s for first, s in reversed(self._exposures) if first <= number), self._exposures[0][1])
        if setting is not None:
            return setting
        sensor = self._camera.world.settings.sensor
        rate = float(np.mean(self._camera.rate(self._start + number * self._interval))) + sensor.dark_current_e_s
        full_e = (sensor.saturation_dn - sensor.offset_dn) / (self._gain * sensor.gain_dn_per_e)
        return min(max(_AUTO_LEVEL * full_e / max(rate, 1e-9), _SHORTEST_S), self._interval)

    def _unit(self, exposure_s: float) -> float:
        return round(exposure_s / 1e-4) if self._name == "v4l2" else round(math.log2(exposure_s))

    def _set_exposure(self, value: float) -> bool:
        if self._profile.answers and self._exposures[-1][1] is None:
            return False  # automatic: the control is locked
        exposure_s = value * 1e-4 if self._name == "v4l2" else 2.0**value
        if value != round(value) or not _SHORTEST_S <= exposure_s <= self._interval:
            return False
        self._later(exposure_s)
        return True

    def _later(self, setting: float | None) -> None:
        """A new exposure, from the frame on that the camera begins after its latency."""
        now_exposing = math.floor((self._clock.now() - self._start) / self._interval)
        self._exposures.append((now_exposing + self._profile.latency, setting))


def write_images(camera: SimulatedCamera, pattern: str | Path, shots: Iterable[tuple[float, str]]) -> list[Path]:
    """Expose a sequence of 16-bit images, for ``cv2.VideoCapture(pattern, cv2.CAP_IMAGES)``.

    Parameters
    ----------
    camera : SimulatedCamera
    pattern : str or Path
        With one ``%04d`` or the like, of a name that ends in .png or .tiff.
    shots : iterable of (float, str)
        Exposure time [s] and label of each.

    Raises
    ------
    DeviceError
        If a file cannot be written.
    """
    written = []
    for number, (exposure_s, label) in enumerate(shots):
        path = Path(str(pattern) % number)
        frame = camera.capture(exposure_s, label=label)
        if not cv2.imwrite(str(path), frame.data):
            raise DeviceError(f"{path} cannot be written; see whether its folder exists and the disk has room.")
        written.append(path)
    return written
