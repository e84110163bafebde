"""Brackets of exposures, and what must be true of them before they are kept.

It looks at counts only to see whether they saturate and whether there is light at all; it makes no radiance of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from gonio.errors import MeasurementError
from gonio.interfaces import Camera, Frame

_SAME = 0.1  # relative; cameras set exposures in steps
_DARK_SIGMAS = 5.0
_LEAST_SIGMA_DN = 0.3  # of a rounded count
_TRIES = 3
_NOISY_VALUES = 8  # in a row whose repetition is no chance: darks of 8 bits and saturated rows have fewer


class Exposer:
    """A camera with a bracket and a region of interest.

    Parameters
    ----------
    camera : Camera
    exposures_s : sequence of float
        The bracket [s], ascending.
    roi : (int, int, int, int)
        x0, y0, width, height [pixel].
    check_stop : callable
        Raises if the scan is to stop.

    Attributes
    ----------
    retaken : int
        Frames that held rows of the one before.
    """

    def __init__(
        self,
        camera: Camera,
        exposures_s: Sequence[float],
        roi: tuple[int, int, int, int],
        check_stop: Callable[[], None],
    ) -> None:
        self.exposures_s = tuple(exposures_s)
        self._camera = camera
        self._roi = roi
        self._check_stop = check_stop
        self._last: NDArray[np.uint16] | None = None
        self.retaken = 0

    def bracket(self, label: str) -> list[Frame]:
        """One frame of each exposure, labelled ``"<label> exposure <e>"``."""
        return [self.capture(e, f"{label} exposure {e}") for e in range(len(self.exposures_s))]

    def capture(self, exposure: int, label: str) -> Frame:
        """A frame of the bracket's exposure of that number.

        Noise makes no two rows alike; a frame with rows of the one before, repeated or torn, is taken again.

        Raises
        ------
        DeviceError
            If the camera fails.
        MeasurementError
            If it exposes otherwise than told, sends old rows again and again, or the region of interest lies outside the
            frame.
        """
        for _ in range(_TRIES):
            self._check_stop()
            frame = self._camera.capture(self.exposures_s[exposure], label=label)
            self._check(frame, self.exposures_s[exposure], label)
            old = _old_rows(frame.data, self._last)
            if not old:
                self._last = frame.data
                return frame
            self.retaken += 1
        raise MeasurementError(
            f"{label}: {old} of {len(frame.data)} rows of the frame are those of the frame before, to the last bit, "
            f"{_TRIES} times; see the camera's cable and driver"
        )

    def _check(self, frame: Frame, exposure_s: float, label: str) -> None:
        if not abs(frame.exposure_s - exposure_s) <= _SAME * exposure_s:
            raise MeasurementError(
                f"{label}: the camera exposed for {frame.exposure_s:g} s instead of {exposure_s:g} s; choose exposures_s "
                "that it can set"
            )
        x0, y0, width, height = self._roi
        rows, columns = frame.data.shape
        if x0 + width > columns or y0 + height > rows:
            raise MeasurementError(
                f"{label}: the frame has {columns} x {rows} pixels, the region of interest {list(self._roi)} does not lie "
                "within it; correct roi in rig.toml"
            )

    def saturated(self, frames: Sequence[Frame]) -> bool:
        """Whether none of the frames is free of saturated pixels in the region of interest."""
        return all(bool(np.any(self._region(frame) >= frame.saturation_dn)) for frame in frames)

    def longest_clear(self, bracket: Sequence[Frame]) -> int | None:
        """Number of the longest exposure of a bracket without saturated pixels."""
        clear = [e for e, frame in enumerate(bracket) if not self.saturated([frame])]
        return clear[-1] if clear else None

    def is_dark(self, frame: Frame, darks: Sequence[Frame]) -> bool:
        """Whether a frame shows no light beyond the dark frames of its exposure.

        Its mean over the region must exceed theirs by five standard deviations of one dark pixel.
        """
        dark = np.stack([self._region(d) for d in darks]).astype(float)
        signal = float(np.mean(self._region(frame))) - float(np.mean(dark))
        return signal < _DARK_SIGMAS * max(float(np.std(dark)), _LEAST_SIGMA_DN)

    def _region(self, frame: Frame) -> NDArray[np.uint16]:
        x0, y0, width, height = self._roi
        return frame.data[y0 : y0 + height, x0 : x0 + width]


def _old_rows(data: NDArray[np.uint16], before: NDArray[np.uint16] | None) -> int:
    """Rows that are those of the frame before, to the last bit, and have enough noise for that to mean something."""
    if before is None or before.shape != data.shape:
        return 0
    same = np.flatnonzero((data == before).all(axis=1))
    return sum(len(np.unique(data[row])) >= _NOISY_VALUES for row in same)
