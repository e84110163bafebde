r"""A bracket of exposures becomes one rate of counts [DN/s] with its variance.

Counts above dark, S_k, at exposure t_k have the variance of the EMVA 1288 linear model,

.. math:: v_k = K^2\sigma_d^2 + \tfrac1{12} + K S_k , \qquad x_k = S_k / t_k,

and the best rate weighs the x_k by t_k^2 / v_k. If S_k in v_k were the noisy reading itself, exposures that happen to
read low would weigh more and the result would be too small, by per cents at low signal; so v_k is computed from the
estimated rate and iterated. Whether an exposure is saturated is likewise decided from the predicted level.

The module refuses exposures without a dark of their own, and cameras that say they are not linear. It corrects
neither glare nor curvature.

References
----------
.. [1] EMVA Standard 1288, "Standard for Characterization of Image Sensors and Cameras", release 4.0 Linear, 2021.
.. [2] M. Granados et al., "Optimal HDR reconstruction with linear digital cameras", CVPR 2010.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gonio.calibration import CameraNoise, Dark, crop
from gonio.errors import MeasurementError
from gonio.interfaces import Frame

Array = NDArray[np.float64]
HEADROOM = 0.95
"""A level above this fraction of saturation counts as saturated."""


@dataclass(frozen=True)
class Merged:
    """Result of `merge_bracket`.

    Attributes
    ----------
    rate : ndarray, shape (...)
        [DN/s]; NaN where every exposure is saturated. Negative values are kept.
    variance : ndarray, shape (...)
        Variance of the rate, noise alone [DN^2/s^2].
    weight : ndarray, shape (k, ...)
        Normalised weights of the exposures; 0 where saturated.
    """

    rate: Array
    variance: Array
    weight: Array


def merge_bracket(
    signal: ArrayLike,
    exposure_s: ArrayLike,
    floor: ArrayLike,
    gain_dn_per_e: float,
    largest_signal: ArrayLike,
    *,
    pixels: int = 1,
    usable: ArrayLike = True,
    iterations: int = 5,
) -> Merged:
    """Combine exposures with inverse-variance weights from the estimated rate.

    Parameters
    ----------
    signal : array_like, shape (k, ...)
        Counts above dark [DN], of pixels or of the mean of `pixels` pixels.
    exposure_s : array_like, shape (k,)
        [s].
    floor : array_like, shape (k,)
        Variance of one dark pixel, quantisation included [DN^2].
    gain_dn_per_e : float
        K [DN/e].
    largest_signal : array_like, shape broadcast to (k, ...)
        An exposure counts as saturated where its predicted signal exceeds this [DN].
    pixels : int
        How many pixels a value of `signal` averages.
    usable : array_like of bool, shape broadcast to (k, ...)
        False excludes an exposure for other reasons.
    iterations : int

    Returns
    -------
    Merged

    Notes
    -----
    Unbiased to 0.2 % except for a single pixel within the noise of `largest_signal`: there the noise itself decides which
    exposures count, which biases by up to a third of the noise of the next shorter one. `read_bracket` decides for the
    whole region, which is free of it.
    """
    s = np.asarray(signal, dtype=float)
    column = (len(s),) + (1,) * (s.ndim - 1)
    t = np.asarray(exposure_s, dtype=float).reshape(column)
    f = np.broadcast_to(np.asarray(floor, dtype=float), (len(s),)).reshape(column)
    limit = np.broadcast_to(np.asarray(largest_signal, dtype=float), s.shape)
    allowed = np.broadcast_to(np.asarray(usable, dtype=bool), s.shape)
    shortest = int(np.argmin(t))
    rate = s[shortest] / t[shortest]
    for _ in range(iterations):
        expected = np.maximum(rate, 0.0) * t  # (k, ...)
        ok = allowed & (expected < limit)
        weight = np.where(ok, pixels * t**2 / (f + gain_dn_per_e * expected), 0.0)
        total = weight.sum(axis=0)
        some = total > 0.0
        rate = np.where(some, (weight * s / t).sum(axis=0) / np.where(some, total, 1.0), rate)
    safe = np.where(some, total, 1.0)
    return Merged(
        rate=np.where(some, rate, np.nan),
        variance=np.where(some, 1.0 / safe, np.nan),
        weight=weight / safe,
    )


@dataclass(frozen=True)
class Reading:
    """The mean rate over the region of interest, from one bracket.

    Attributes
    ----------
    rate : float
        [DN/s]; NaN if every exposure is saturated.
    u_rate : float
        Standard uncertainty from the noise of these frames [DN/s].
    u_dark : float
        Standard uncertainty from the mean dark levels [DN/s]; readings with the same darks share this error.
    time_s : float
        Rig time [s]: middle of the exposures, weighted as they are.
    exposure_s, signal, variance : ndarray, shape (k,)
        Each exposure, ascending: time [s], mean signal above dark [DN], variance of that mean [DN^2].
    used : ndarray of bool, shape (k,)
        Not saturated.

    Notes
    -----
    Fixed differences between pixels (PRNU) are not in u_rate: sample and white are seen by the same pixels.
    """

    rate: float
    u_rate: float
    u_dark: float
    time_s: float
    exposure_s: Array
    signal: Array
    variance: Array
    used: NDArray[np.bool_]


def read_bracket(
    frames: Sequence[Frame], darks: Mapping[float, Dark], noise: CameraNoise, roi: tuple[int, int, int, int] | None
) -> Reading:
    """Read the mean rate of a region from a bracket of frames.

    Parameters
    ----------
    frames : sequence of Frame
        One or more exposures of one unmoved scene.
    darks : mapping of exposure time [s] to Dark
        Cropped to the same region.
    noise : CameraNoise
        Gain, and the noise floor for darks that are too few to tell it.
    roi : tuple of int or None
        x0, y0, width, height [pixel].

    Raises
    ------
    MeasurementError
        If a frame has no dark of its exposure and gain, or its camera is not linear.
    """
    if not frames:
        raise MeasurementError("a bracket holds no frame: scan that pose again")
    ordered = sorted(frames, key=lambda frame: frame.exposure_s)
    stacks = [_dark_of(frame, darks) for frame in ordered]
    counts = np.stack([crop(frame, roi) for frame in ordered])  # (k, height, width)
    level = np.stack([np.broadcast_to(dark.mean, counts.shape[1:]) for dark in stacks])
    t = np.array([frame.exposure_s for frame in ordered])
    saturation = np.array([float(frame.saturation_dn) for frame in ordered])[:, None, None]
    floor = np.array([noise_floor(dark, noise) for dark in stacks])
    signal = counts - level
    pixels = counts[0].size

    # Pixel by pixel first, only to see which exposures saturate anywhere in the region.
    whole = counts < saturation
    image = merge_bracket(signal, t, floor, noise.gain_dn_per_e, HEADROOM * saturation - level, usable=whole)
    known = np.isfinite(image.rate).all()
    predicted = level + image.rate * t[:, None, None]
    used = (whole & (predicted < HEADROOM * saturation)).all(axis=(1, 2)) if known else np.zeros(len(t), dtype=bool)

    mean = signal.mean(axis=(1, 2))
    merged = merge_bracket(mean, t, floor, noise.gain_dn_per_e, np.inf, pixels=pixels, usable=used)
    rate = float(merged.rate)
    expected = np.maximum(rate if np.isfinite(rate) else mean / t, 0.0) * t
    middle = np.array([frame.timestamp_s - 0.5 * frame.exposure_s for frame in ordered])
    dark_share = merged.weight / t * np.sqrt([dark.mean_variance for dark in stacks])
    return Reading(
        rate=rate,
        u_rate=float(np.sqrt(merged.variance)),
        u_dark=float(np.sqrt(np.sum(dark_share**2))),
        time_s=float(np.sum(merged.weight * middle)) if used.any() else float(middle.mean()),
        exposure_s=t,
        signal=mean,
        variance=(floor + noise.gain_dn_per_e * expected) / pixels,
        used=used,
    )


def noise_floor(dark: Dark, noise: CameraNoise) -> float:
    """Variance of one dark pixel [DN^2]: of the dark stack where it is known to about 10 %, else the nominal one."""
    return dark.frame_variance if dark.degrees_of_freedom >= 200 and dark.frame_variance > 0.0 else noise.floor


def _dark_of(frame: Frame, darks: Mapping[float, Dark]) -> Dark:
    if not frame.linear:
        raise MeasurementError(f"frame {frame.label!r} is not linear in light: switch the camera's gamma off")
    for exposure_s, dark in darks.items():
        if abs(exposure_s - frame.exposure_s) <= 1e-6 * frame.exposure_s:
            if dark.gain != frame.gain:
                raise MeasurementError(
                    f"frame {frame.label!r} has gain {frame.gain:g}, its dark frames {dark.gain:g}: keep one gain in a run"
                )
            return dark
    known = ", ".join(f"{t:g} s" for t in darks) or "none"
    raise MeasurementError(
        f"frame {frame.label!r} has an exposure of {frame.exposure_s:g} s and no dark frames of it (there are: {known}); "
        "take darks with every exposure of the bracket"
    )
