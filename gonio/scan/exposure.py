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

    def bracket(self, label: str) -> list[Frame]:
        """One frame of each exposure, labelled ``"<label> exposure <e>"``."""
        return [self.capture(e, f"{label} exposure {e}") for e in range(len(self.exposures_s))]

    def capture(self, exposure: int, label: str) -> Frame:
        """A frame of the bracket's exposure of that number.

        Raises
        ------
        DeviceError
            If the camera fails.
        MeasurementError
            If it exposes otherwise than told, or the region of interest lies outside the frame.
        """
        self._check_stop()
        exposure_s = self.exposures_s[exposure]
        frame = self._camera.capture(exposure_s, label=label)
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
        return frame

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
