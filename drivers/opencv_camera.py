"""A camera behind ``cv2.VideoCapture``, as an instrument: nothing automatic, everything read back, no stale frame.

OpenCV's properties mean something else in every backend and are often ignored without a word. So the backend is forced
by name; a setting counts only if it reads back; exposure is converted to and from the backend's unit; frames that began
before the call are thrown away (`drivers.opencv_stream`); and shape, type and bit depth of what arrives are checked. A
camera whose automatic exposure cannot be switched off is refused, unless its exposure is declared fixed.

It does not linearise, subtract darks or average; whether counts are proportional to light is declared by the user and
contradicted where the camera's gamma control says otherwise. A sequence of image files (backend ``images``) is a camera
too: one with a fixed exposure that nobody can change.

References: OpenCV videoio (docs.opencv.org, VideoCaptureProperties); V4L2, "Camera Control Reference"
(V4L2_CID_EXPOSURE_ABSOLUTE, 100 us); DirectShow CameraControlProperty (exposure, log2 seconds).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from drivers.opencv_stream import NoFrameError, Stream
from gonio.errors import ConfigurationError, DeviceError, MeasurementError
from gonio.interfaces import Clock, Frame

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

logger = logging.getLogger(__name__)

_INTERVAL_S = 1.0 / 30.0  # of a camera that does not say
_CONTRAST_DN = 2.0
_SAME = 1e-6  # relative; a fixed exposure is the one asked for
_AUTOMATIC = (0.75, 2.0, 3.0)  # V4L2: as old drivers say it, shutter priority, aperture priority


@dataclass(frozen=True)
class Backend:
    """How one backend of OpenCV counts.

    Attributes
    ----------
    constant : str
        Name in cv2.
    unit : {"100 us", "log2 s", None}
        Of CAP_PROP_EXPOSURE; None where it cannot be set.
    manual : tuple of float
        Values of CAP_PROP_AUTO_EXPOSURE that mean manual, by the age of the driver.
    answers : bool
        CAP_PROP_AUTO_EXPOSURE can be read back. DirectShow has no such answer: there, setting an exposure makes it
        manual (opencv issue 17019).
    live : bool
        Frames pass by whether read or not, so the ones in the queue are old.
    """

    constant: str
    unit: Literal["100 us", "log2 s"] | None
    manual: tuple[float, ...] = ()
    answers: bool = True
    live: bool = True


BACKENDS = {
    "v4l2": Backend("CAP_V4L2", "100 us", (1.0, 0.25)),
    "dshow": Backend("CAP_DSHOW", "log2 s", (0.0, 0.25), answers=False),
    "msmf": Backend("CAP_MSMF", "log2 s", (0.0, 0.25), answers=False),
    "avfoundation": Backend("CAP_AVFOUNDATION", None),
    "ffmpeg": Backend("CAP_FFMPEG", None),
    "images": Backend("CAP_IMAGES", None, live=False),
}


class OpenCVCamera:
    """A camera; satisfies `gonio.interfaces.Camera`.

    Parameters
    ----------
    device : int or str
        Index, path or URL; for ``images`` a pattern such as ``"dark_%04d.png"``.
    backend : str
        One of `BACKENDS`; never guessed.
    clock : Clock
        Rig time, for the frames' time stamps.
    name : str, optional
        As messages call it.
    exposure : {"manual", "fixed"}, optional
        ``"fixed"``: nobody sets it; `fixed_exposure_s` says what it is.
    fixed_exposure_s : float, optional
        Exposure time of every frame [s]; needed with ``"fixed"``.
    width, height : int, optional
        Frame size to ask for [pixel]; else the camera's.
    fourcc : str, optional
        Pixel format to ask for, e.g. ``"Y16 "``.
    gain : float, optional
        Gain to ask for, in the camera's own unit.
    bit_depth : int, optional
        Significant bits of a count; by default those of the data type.
    saturation_dn : int, optional
        Count at and above which a pixel is saturated; by default the largest of `bit_depth`.
    linear : bool, optional
        The user's word that counts are proportional to light.
    channel : int, optional
        Which channel to keep of data with several; they are refused without.
    stale_frames : int, optional
        Frames thrown away before each one that is kept, after the driver's queue is empty: those that were under way. By
        default 6 until `measure_late` knows better, and 0 for image files.
    open_capture : callable, optional
        ``cv2.VideoCapture``, or what offers the same methods.

    Raises
    ------
    ConfigurationError
        If the options contradict each other.
    DeviceError
        If the camera cannot be opened, or does not take a setting.
    """

    def __init__(
        self,
        device: int | str,
        *,
        backend: str,
        clock: Clock,
        name: str = "camera",
        exposure: Literal["manual", "fixed"] = "manual",
        fixed_exposure_s: float | None = None,
        width: int | None = None,
        height: int | None = None,
        fourcc: str | None = None,
        gain: float | None = None,
        bit_depth: int | None = None,
        saturation_dn: int | None = None,
        linear: bool = False,
        channel: int | None = None,
        stale_frames: int | None = None,
        open_capture: Callable[[int | str, int], Any] | None = None,
    ) -> None:
        import cv2

        self._cv2 = cv2
        self._name = name
        self._device = device
        self._clock = clock
        if backend not in BACKENDS:
            raise ConfigurationError(f"Camera backend {backend!r} is not known; one of {', '.join(BACKENDS)}.")
        self._backend_name = backend
        self._backend = BACKENDS[backend]
        self._fixed_s = self._check_exposure(exposure, fixed_exposure_s)
        self._bit_depth = bit_depth
        self._saturation_dn = saturation_dn
        self._linear = linear
        self._channel = channel
        self._shape: tuple[int, int] | None = None
        self._settings: dict[str, float] = {}
        self._exposure_value: float | None = None  # last set, in the backend's unit
        if linear and fourcc is not None and fourcc.upper().startswith("MJP"):
            raise ConfigurationError(f"{self._label}: {fourcc} is compressed and never linear; use a raw format.")
        opener = cv2.VideoCapture if open_capture is None else open_capture
        self._capture: Any = opener(device, getattr(cv2, self._backend.constant))
        try:
            if not self._capture.isOpened():
                raise DeviceError(
                    f"{self._label} cannot be opened with backend {backend}; check that it is plugged in, that no other "
                    "program uses it, and the device's name."
                )
            self._set_up(width, height, fourcc, gain)
            rate = float(self._capture.get(cv2.CAP_PROP_FPS))
            interval_s = 1.0 / rate if 1.0 <= rate <= 1000.0 else _INTERVAL_S
            self._stream = Stream(
                self._capture, clock, live=self._backend.live, interval_s=interval_s, late=stale_frames
            )
        except BaseException:
            self.close()
            raise

    def _check_exposure(self, exposure: str, fixed_s: float | None) -> float | None:
        if exposure not in ("manual", "fixed"):
            raise ConfigurationError(f"{self._label}: exposure {exposure!r} must be manual or fixed.")
        if exposure == "fixed":
            if fixed_s is None or not fixed_s > 0.0:
                raise ConfigurationError(f"{self._label}: a fixed exposure needs fixed_exposure_s [s], above 0.")
            return fixed_s
        if self._backend.unit is None:
            raise ConfigurationError(
                f"{self._label}: backend {self._backend_name} cannot set an exposure; "
                'write exposure = "fixed" and fixed_exposure_s, or use a backend that can.'
            )
        if fixed_s is not None:
            raise ConfigurationError(f'{self._label}: fixed_exposure_s = {fixed_s:g} s goes with exposure = "fixed" only.')
        return None

    def _set_up(self, width: int | None, height: int | None, fourcc: str | None, gain: float | None) -> None:
        cv2 = self._cv2
        if fourcc is not None:
            if len(fourcc) != 4:
                raise ConfigurationError(f"{self._label}: fourcc {fourcc!r} must have four letters (pad with spaces).")
            self._require("pixel format", cv2.CAP_PROP_FOURCC, float(cv2.VideoWriter.fourcc(*fourcc)))
        for what, prop, value in (
            ("width", cv2.CAP_PROP_FRAME_WIDTH, width),
            ("height", cv2.CAP_PROP_FRAME_HEIGHT, height),
        ):
            if value is not None:
                self._require(what, prop, float(value))
        if not self._backend.live:
            return
        self._prefer("convert_rgb", cv2.CAP_PROP_CONVERT_RGB, 0.0)  # counts as they come
        self._prefer("buffer_size", cv2.CAP_PROP_BUFFERSIZE, 1.0)
        self._prefer("auto_white_balance", cv2.CAP_PROP_AUTO_WB, 0.0)
        self._prefer("sharpness", cv2.CAP_PROP_SHARPNESS, 0.0)
        self._prefer("backlight_compensation", cv2.CAP_PROP_BACKLIGHT, 0.0)
        if self._backend_name == "v4l2":
            accepted = self._prefer("gamma", cv2.CAP_PROP_GAMMA, 100.0)  # hundredths
            found = float(self._capture.get(cv2.CAP_PROP_GAMMA))
            if self._linear and not accepted and found > 0.0:
                raise DeviceError(
                    f"{self._label} keeps gamma {found:g}, linear needs 100; switch its gamma off or write linear = false."
                )
        if self._backend.manual:
            self._manual_exposure()
        if gain is not None:
            self._require("gain", cv2.CAP_PROP_GAIN, gain)

    def _manual_exposure(self) -> None:
        prop = self._cv2.CAP_PROP_AUTO_EXPOSURE
        accepted = [value for value in self._backend.manual if self._capture.set(prop, value)]
        found = float(self._capture.get(prop))
        # a camera whose exposure is declared fixed may have no such control, but it may not say that it is automatic
        refused = found in _AUTOMATIC if self._fixed_s is not None else found not in self._backend.manual
        if self._backend.answers and refused:
            raise DeviceError(
                f"{self._label} keeps its automatic exposure on (property reads {found:g}, manual is "
                f"{' or '.join(f'{v:g}' for v in self._backend.manual)}); switch it off with the maker's tool, or use "
                "another camera: a measurement needs exposures that it knows."
            )
        self._settings["auto_exposure"] = found
        logger.info("%s: manual exposure accepted as %s, reads %g", self._label, accepted, found)

    def _prefer(self, what: str, prop: int, value: float) -> bool:
        """Ask for a setting that not every camera has; its value is recorded as it reads back."""
        taken = bool(self._capture.set(prop, value))
        found = float(self._capture.get(prop))
        self._settings[what] = found
        return taken and found == value

    def _require(self, what: str, prop: int, value: float) -> None:
        """Set and read back, or refuse."""
        taken = bool(self._capture.set(prop, value))
        found = float(self._capture.get(prop))
        if not taken or not math.isclose(found, value, rel_tol=_SAME):
            raise DeviceError(f"{self._label} keeps {what} {found:g}, {value:g} was set; choose one that it offers.")
        self._settings[what.replace(" ", "_")] = found

    # -- Camera

    @property
    def name(self) -> str:
        """As messages call it."""
        return self._name

    def capture(self, exposure_s: float, *, label: str) -> Frame:
        """Expose a fresh frame that began after this call.

        Parameters
        ----------
        exposure_s : float
            Exposure time [s]. The camera takes its nearest step; `Frame.exposure_s` is what it read back.
        label : str
            Names the frame.

        Raises
        ------
        DeviceError
            If the exposure does not read back, no frame comes, or the frame is not what it should be.
        """
        if not (math.isfinite(exposure_s) and exposure_s > 0.0):
            raise ConfigurationError(f"{self._label}: exposure {exposure_s:g} s must be above 0.")
        earlier = self._exposure_value
        actual_s = self._set_exposure(exposure_s)
        try:
            data, taken_s = self._stream.fresh(changed=self._exposure_value != earlier)
        except NoFrameError:
            raise self._no_frame() from None
        counts, bit_depth = self._counts(data)
        full = 2**bit_depth - 1
        gain = float(self._settings.get("gain", math.nan))
        return Frame(
            data=counts,
            exposure_s=actual_s,
            gain=1.0 if math.isnan(gain) else gain,
            timestamp_s=taken_s,
            bit_depth=bit_depth,
            linear=self._linear,
            saturation_dn=full if self._saturation_dn is None else self._saturation_dn,
            label=label,
            metadata={
                "backend": self._backend_name,
                "stream_position_ms": float(self._capture.get(self._cv2.CAP_PROP_POS_MSEC)),
                "stale_frames_discarded": self._stream.late,
                "exposure_requested_s": exposure_s,
            },
        )

    def measure_late(self, light: Callable[[bool], object], exposure_s: float) -> int:
        """Find with a light that is switched how many frames show the past, and throw that many away from now on.

        Parameters
        ----------
        light : callable
            Switches the light and returns when it has; it is on afterwards.
        exposure_s : float
            At which the light makes a difference [s].

        Returns
        -------
        int
            Frames thrown away before each one that is kept.

        Raises
        ------
        MeasurementError
            If frames do not show whether the light is on.
        DeviceError
            If the camera sends none.
        """
        light(False)
        dark = self.capture(exposure_s, label="light off").data
        light(True)
        lit = self.capture(exposure_s, label="light on").data
        means, spread = [float(d.mean()) for d in (dark, lit)], float(max(dark.std(), lit.std())) / math.sqrt(dark.size)
        if means[1] - means[0] < max(_CONTRAST_DN, 10.0 * spread):
            raise MeasurementError(
                f"{self._label} does not show whether the light is on ({means[0]:.1f} and {means[1]:.1f} counts at "
                f"{exposure_s:g} s); put something bright before it, or expose longer."
            )
        middle = 0.5 * (means[0] + means[1])
        try:
            late = self._stream.measure_late(light, lambda data: bool(self._counts(data)[0].mean() > middle))
        except NoFrameError:
            raise self._no_frame() from None
        logger.info("%s: %d frames are thrown away before each that counts", self._label, late)
        return late

    def describe(self) -> dict[str, object]:
        """Identity and settings for the run's metadata (JSON-compatible)."""
        return {
            "name": self._name,
            "kind": "opencv",
            "device": self._device,
            "backend": self._backend_name,
            "opencv": str(self._cv2.__version__),
            "exposure": "manual" if self._fixed_s is None else "fixed",
            "linear": self._linear,
            "stale_frames": self._stream.late,
            "settings": dict(self._settings),
        }

    def close(self) -> None:
        """Release the camera; a second time does nothing."""
        self._capture.release()

    # -- exposure

    def _set_exposure(self, exposure_s: float) -> float:
        """Exposure time as read back [s]."""
        if self._fixed_s is not None:
            if not math.isclose(exposure_s, self._fixed_s, rel_tol=_SAME):
                raise ConfigurationError(
                    f"{self._label} has a fixed exposure of {self._fixed_s:g} s, {exposure_s:g} s was asked for; "
                    "write exposures_s to match."
                )
            return self._fixed_s
        value = self._to_unit(exposure_s)
        prop = self._cv2.CAP_PROP_EXPOSURE
        if value != self._exposure_value:
            self._exposure_value = None
            taken = bool(self._capture.set(prop, value))
            found = float(self._capture.get(prop))
            if not taken or found != value:
                raise DeviceError(
                    f"{self._label} does not take an exposure of {exposure_s:g} s: {value:g} ({self._backend.unit}) was "
                    f"set, {found:g} reads back; choose one within its range, and no longer than its frame interval."
                )
            self._exposure_value = value
        return self._to_seconds(value)

    def _to_unit(self, exposure_s: float) -> float:
        """Nearest step of the backend, never 0."""
        if self._backend.unit == "100 us":
            return float(max(1, round(exposure_s / 1e-4)))
        return float(round(math.log2(exposure_s)))

    def _to_seconds(self, value: float) -> float:
        return value * 1e-4 if self._backend.unit == "100 us" else 2.0**value

    # -- frames

    def _counts(self, data: NDArray[Any]) -> tuple[NDArray[np.uint16], int]:
        """One channel of counts, shape (height, width), and its significant bits."""
        import numpy as np

        if data.dtype not in (np.uint8, np.uint16):
            raise DeviceError(f"{self._label} sends {data.dtype} pixels, gonio takes 8 or 16 bits; choose another format.")
        if data.ndim == 3 and data.shape[2] > 1:
            if self._channel is None or not 0 <= self._channel < data.shape[2]:
                raise DeviceError(
                    f"{self._label} sends {data.shape[2]} channels and channel is {self._channel}; "
                    f"write channel = 0 to {data.shape[2] - 1}, or ask for a monochrome format by fourcc."
                )
            data = data[:, :, self._channel]
        elif data.ndim == 3:
            data = data[:, :, 0]
        if data.ndim != 2:
            raise DeviceError(f"{self._label} sends data of shape {data.shape}, not an image; choose another format.")
        shape = (int(data.shape[0]), int(data.shape[1]))
        if self._shape is None:
            self._shape = shape
        elif shape != self._shape:
            raise DeviceError(
                f"{self._label} sends {shape[1]} x {shape[0]} pixels after {self._shape[1]} x {self._shape[0]}; "
                "look for another program that changes it."
            )
        container = 8 * data.dtype.itemsize
        bit_depth = container if self._bit_depth is None else self._bit_depth
        largest = int(data.max(initial=0))
        if bit_depth > container or largest >= 2**bit_depth:
            raise DeviceError(
                f"{self._label} sends {container}-bit pixels up to {largest}, bit_depth says {bit_depth} bits "
                f"(up to {2**bit_depth - 1}); correct bit_depth in rig.toml."
            )
        return np.ascontiguousarray(data, dtype=np.uint16), bit_depth

    def _no_frame(self) -> DeviceError:
        if not self._backend.live:
            return DeviceError(f"{self._label} has no more images; it needs one file for every frame of the scan.")
        return DeviceError(f"{self._label} sends no frame; check the cable, and that no other program uses it.")

    @property
    def _label(self) -> str:
        return f"{self._name.capitalize()} ({self._device})"
