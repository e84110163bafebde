r"""The camera's gain and read noise from pairs of equal frames: the photon transfer method.

Light arrives in photons, so the variance of a linear camera grows in proportion to its mean signal, and the slope is
the gain K [DN/e]:

.. math:: \sigma_y^2 = K^2\sigma_d^2 + \tfrac1{12} + K(\mu_y - \mu_{y,\mathrm{dark}}) .

The difference of two frames of the same scene has twice that variance and no fixed pattern. It cannot tell read noise
from dark current noise, and it refuses to fit when the curve is no line.

References
----------
.. [1] EMVA Standard 1288, "Standard for Characterization of Image Sensors and Cameras", release 4.0 Linear, 2021.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gonio.errors import MeasurementError
from gonio.interfaces import Frame

Array = NDArray[np.float64]
QUANTISATION = 1.0 / 12.0
"""Variance of rounding to whole counts [DN^2]."""
FIT_RANGE = 0.7
"""Largest signal, as a fraction of saturation, that enters the fit of the gain."""


@dataclass(frozen=True)
class CameraNoise:
    """Linear camera noise model.

    Attributes
    ----------
    gain_dn_per_e : float
        K [DN/e].
    read_noise_e : float
        sigma_d, standard deviation of the noise without light [e].
    """

    gain_dn_per_e: float
    read_noise_e: float

    @property
    def floor(self) -> float:
        """Variance of a dark pixel, quantisation included [DN^2]."""
        return (self.gain_dn_per_e * self.read_noise_e) ** 2 + QUANTISATION

    def variance(self, signal_dn: Array | float) -> Array:
        """Variance of one pixel [DN^2] at an expected signal above dark [DN], same shape; negative counts as none."""
        return np.asarray(self.floor + self.gain_dn_per_e * np.maximum(signal_dn, 0.0))


@dataclass(frozen=True)
class PhotonTransfer:
    """Result of a photon transfer measurement.

    Attributes
    ----------
    noise : CameraNoise
    u_gain : float
        Standard uncertainty of the gain [DN/e].
    signal, variance : ndarray, shape (n,)
        The curve: mean signal above dark [DN] and temporal variance [DN^2] of each pair.
    used : ndarray of bool, shape (n,)
        Points of the fit.
    saturation_dn : float
        Signal above dark at which the variance is largest, if the curve falls after it; else NaN [DN].
    chi2_per_dof : float
        Of the line.
    """

    noise: CameraNoise
    u_gain: float
    signal: Array
    variance: Array
    used: NDArray[np.bool_]
    saturation_dn: float
    chi2_per_dof: float


def photon_transfer(
    pairs: Sequence[tuple[Frame | Array, Frame | Array]],
    dark: Sequence[float],
    full_scale_dn: float,
    *,
    dark_variance: float | None = None,
    max_chi2_per_dof: float = 10.0,
) -> PhotonTransfer:
    """Gain and read noise from pairs of frames.

    Parameters
    ----------
    pairs : sequence of (frame, frame)
        Two frames, or arrays of shape (height, width) [DN], of the same scene, light and exposure; pairs differ in
        level.
    dark : sequence of float, length n
        Mean dark level of the exposure of each pair [DN].
    full_scale_dn : float
        Counts at saturation [DN].
    dark_variance : float, optional
        Temporal variance without light [DN^2], from a stack of darks. Without it the line's intercept is fitted.
    max_chi2_per_dof : float, optional
        Refuse a curve that is worse.

    Returns
    -------
    PhotonTransfer

    Raises
    ------
    MeasurementError
        If there are too few levels below 70 % of saturation, the slope is not positive, or the curve is no line.

    Notes
    -----
    A variance of N pixels has the relative standard error sqrt(2/(N - 1)). The weights come from the fitted line, not
    from the noisy variances, and are iterated; from the noisy ones the gain would come out too small.
    """
    if len(pairs) != len(dark):
        raise MeasurementError(f"photon transfer: {len(pairs)} pairs but {len(dark)} dark levels; give one for each")
    signal, variance, pixels = (np.empty(len(pairs)) for _ in range(3))
    for k, ((first, second), level) in enumerate(zip(pairs, dark, strict=True)):
        one, two = _counts(first), _counts(second)
        if one.shape != two.shape or one.size < 16:
            raise MeasurementError(
                f"photon transfer: pair {k} has {one.shape} and {two.shape} pixels; give two frames of one shape"
            )
        signal[k] = 0.5 * (one.mean() + two.mean()) - level
        variance[k] = 0.5 * float(np.var(one - two, ddof=1))  # the fixed pattern cancels
        pixels[k] = one.size
    limit = FIT_RANGE * (full_scale_dn - np.asarray(dark, dtype=float))
    used = signal < limit
    parameters = 1 if dark_variance is not None else 2
    if used.sum() < parameters or len(np.unique(signal[used])) < parameters:
        raise MeasurementError(
            f"photon transfer: {int(used.sum())} levels lie below {100 * FIT_RANGE:g} % of {full_scale_dn:g} DN, needed "
            f"are {parameters} different ones; use shorter exposures"
        )
    x, y, n = signal[used], variance[used], pixels[used]
    design = np.stack((x, np.ones_like(x)), axis=1)[:, :parameters]  # (points, parameters)
    target = y if dark_variance is None else y - dark_variance
    model = y
    for _ in range(8):
        sigma = np.maximum(model, QUANTISATION) * np.sqrt(2.0 / (n - 1.0))
        solution, *_ = np.linalg.lstsq(design / sigma[:, None], target / sigma, rcond=None)
        model = design @ solution + (dark_variance or 0.0)
    gain = float(solution[0])
    intercept = float(dark_variance if dark_variance is not None else solution[1])
    dof = len(x) - parameters
    chi2 = float(np.sum(((y - model) / sigma) ** 2) / dof) if dof > 0 else float("nan")
    if not gain > 0.0:
        raise MeasurementError(
            f"photon transfer: the gain comes out as {gain:g} DN/e, not positive; the frames hold too little light, or "
            "they were processed"
        )
    covariance = np.linalg.inv((design / sigma[:, None]).T @ (design / sigma[:, None]))
    if chi2 > max_chi2_per_dof:
        raise MeasurementError(
            f"photon transfer: variance over mean is no line (chi^2 per degree of freedom {chi2:.1f}, limit "
            f"{max_chi2_per_dof:g}); switch gamma, noise filters and automatic settings of the camera off"
        )
    top = int(np.argmax(variance))
    falls = bool(np.any((signal > signal[top]) & (variance < 0.5 * variance[top])))
    return PhotonTransfer(
        noise=CameraNoise(gain, float(np.sqrt(max(intercept - QUANTISATION, 0.0)) / gain)),
        u_gain=float(np.sqrt(covariance[0, 0])),
        signal=signal,
        variance=variance,
        used=used,
        saturation_dn=float(signal[top]) if falls else float("nan"),
        chi2_per_dof=chi2,
    )


def _counts(frame: Frame | Array) -> Array:
    return np.asarray(frame.data if isinstance(frame, Frame) else frame, dtype=float)
