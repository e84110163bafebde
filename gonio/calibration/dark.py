"""Dark frames: what the camera counts without light, for each exposure time, and how well that is known.

A dark belongs to one exposure time; nothing is interpolated between exposures, because dark current and black level
do not share one law. The lamp must have been off; a stack that holds light is refused.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gonio.errors import ConfigurationError, MeasurementError
from gonio.interfaces import Frame

Array = NDArray[np.float64]
Roi = tuple[int, int, int, int]


@dataclass(frozen=True)
class Dark:
    """A stack of dark frames of one exposure time.

    Attributes
    ----------
    exposure_s : float
        [s].
    mean : ndarray, shape (height, width)
        Mean dark level of each pixel [DN].
    variance : ndarray, shape (height, width)
        Temporal variance of one frame, each pixel [DN^2]: read noise, dark current and quantisation together.
    count : int
        Frames in the stack.
    saturation_dn : int
    gain : float
        Gain setting of the camera.
    """

    exposure_s: float
    mean: Array
    variance: Array
    count: int
    saturation_dn: int
    gain: float

    @property
    def frame_variance(self) -> float:
        """Mean temporal variance of a pixel in one frame [DN^2]; pooled, its relative error is about sqrt(2 / N)."""
        return float(np.mean(self.variance))

    @property
    def degrees_of_freedom(self) -> int:
        """Of `frame_variance`."""
        return (self.count - 1) * self.mean.size

    @property
    def mean_variance(self) -> float:
        """Variance of the region's mean dark level [DN^2]. All frames that use this stack share the error."""
        return self.frame_variance / (self.count * self.mean.size)


def crop(frame: Frame, roi: Roi | None) -> Array:
    """Counts of a region of interest.

    Parameters
    ----------
    frame : Frame
    roi : tuple of int or None
        x0, y0, width, height [pixel]; None for the whole frame.

    Returns
    -------
    ndarray of float, shape (height, width)
        [DN].

    Raises
    ------
    ConfigurationError
        If the region leaves the frame.
    """
    if roi is None:
        return frame.data.astype(float)
    x0, y0, width, height = roi
    rows, columns = frame.data.shape
    if min(x0, y0) < 0 or min(width, height) < 1 or x0 + width > columns or y0 + height > rows:
        raise ConfigurationError(
            f"roi = {list(roi)} (x0, y0, width, height) leaves the frame of {columns} x {rows} pixels; move or shrink it"
        )
    return frame.data[y0 : y0 + height, x0 : x0 + width].astype(float)


def stack_dark(frames: Sequence[Frame], roi: Roi | None = None) -> Dark:
    """Mean and variance of dark frames of one exposure time.

    Parameters
    ----------
    frames : sequence of Frame
        At least two, of one exposure time and gain.
    roi : tuple of int, optional
        x0, y0, width, height [pixel].

    Raises
    ------
    MeasurementError
        If there are fewer than two frames, they differ in exposure or gain, or they are not dark.
    """
    if len(frames) < 2:
        raise MeasurementError(f"{len(frames)} dark frames give no variance: take at least 2, better 16, per exposure")
    first = frames[0]
    for frame in frames:
        if (frame.exposure_s, frame.gain, frame.saturation_dn) != (first.exposure_s, first.gain, first.saturation_dn):
            raise MeasurementError(
                f"dark frames {first.label!r} ({first.exposure_s:g} s, gain {first.gain:g}) and {frame.label!r} "
                f"({frame.exposure_s:g} s, gain {frame.gain:g}) do not belong together: stack them apart"
            )
    counts = np.stack([crop(frame, roi) for frame in frames])  # (count, height, width)
    level = float(np.median(counts))
    if level > 0.5 * first.saturation_dn:
        raise MeasurementError(
            f"the dark frames of {first.exposure_s:g} s read {level:.0f} DN of {first.saturation_dn} DN: they are not "
            "dark; switch the lamp off, cover the rig, and take them again"
        )
    return Dark(
        exposure_s=first.exposure_s,
        mean=counts.mean(axis=0),
        variance=counts.var(axis=0, ddof=1),
        count=len(frames),
        saturation_dn=first.saturation_dn,
        gain=first.gain,
    )


def stack_darks(frames: Iterable[Frame], roi: Roi | None = None) -> dict[float, Dark]:
    """One stack for each exposure time among `frames`, by exposure time [s], shortest first."""
    by_exposure: dict[float, list[Frame]] = {}
    for frame in frames:
        by_exposure.setdefault(frame.exposure_s, []).append(frame)
    return {t: stack_dark(by_exposure[t], roi) for t in sorted(by_exposure)}
