r"""What the fit left over: measured minus expected reading, in units of its standard uncertainty.

The expected reading is the one of `gonio.samples`: the model at the fitted parameters, in directions and on a scale
corrected by the fitted shared errors. Here nothing is fitted, and nothing is judged but by numbers: chi2/N with the range
that a right model with right uncertainties gives.

References
----------
.. [1] JCGM 100:2008 (GUM), 5.1.2: combination of independent standard uncertainties.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gonio.brdf.base import BRDF
from gonio.samples import BRDFSamples

Array = NDArray[np.float64]
_STEP = 1e-5  # of the central difference in a shared error [rad or 1]: f_r changes smoothly over arc seconds


@dataclass(frozen=True)
class Residuals:
    """Residuals of samples against a model.

    Attributes
    ----------
    expected : ndarray, shape (n,)
        Expected reading [1/sr].
    u : ndarray, shape (n,)
        Standard uncertainty of one reading [1/sr], shared errors not included; NaN where nobody knows it.
    pull : ndarray, shape (n,)
        (f_r - expected) / u [1].
    relative : ndarray, shape (n,)
        f_r / expected - 1 [1]; NaN where nothing is expected.
    """

    expected: Array
    u: Array
    pull: Array
    relative: Array

    @property
    def chi2_per_n(self) -> float:
        """Mean square of the pulls that exist, NaN without one."""
        known = self.pull[np.isfinite(self.pull)]
        return float(np.mean(known**2)) if known.size else float("nan")


def expected_reading(samples: BRDFSamples, brdf: BRDF, shared: Array | None = None) -> Array:
    """Reading that the model expects for each sample.

    Parameters
    ----------
    samples : BRDFSamples
        n samples with K shared errors.
    brdf : BRDF
    shared : ndarray, shape (K,), optional
        Values of the shared errors, zeros by default.

    Returns
    -------
    ndarray, shape (n,)
        [1/sr].
    """
    delta = np.zeros(len(samples.shared)) if shared is None else np.asarray(shared, dtype=float)
    omega_i = _measured_unit(samples.omega_i() + samples.d_omega_i @ delta)
    omega_r = _measured_unit(samples.omega_r() + samples.d_omega_r @ delta)
    return brdf.evaluate(omega_i, omega_r) * np.exp(samples.d_ln_f @ delta)


def residuals(samples: BRDFSamples, brdf: BRDF, values: Mapping[str, float] | None = None) -> Residuals:
    """Residuals against a model.

    Parameters
    ----------
    samples : BRDFSamples
    brdf : BRDF
        The fitted model.
    values : mapping of str to float, optional
        Fitted nuisance parameters by name: ``shared.<name>`` [unit of the shared error], ``noise.relative`` [1],
        ``noise.absolute`` [1/sr] and ``noise.discrepancy`` [1]. Absent ones are 0.

    Returns
    -------
    Residuals
    """
    given = dict(values or {})
    delta = np.array([given.get(f"shared.{error.name}", 0.0) for error in samples.shared])
    expected = expected_reading(samples, brdf, delta)
    relative, absolute, discrepancy = (given.get(f"noise.{n}", 0.0) for n in ("relative", "absolute", "discrepancy"))
    inferred = relative > 0.0 or absolute > 0.0
    unknown = np.isnan(samples.u_f_r)
    # u^2 = u_f_r^2, or (r f)^2 + a^2 where it is unknown, + sum_k (df/d delta_k u_sample_k)^2 + (epsilon f)^2
    variance = np.where(unknown, (relative * expected) ** 2 + absolute**2 if inferred else np.nan, samples.u_f_r**2)
    variance += (discrepancy * expected) ** 2
    for k, error in enumerate(samples.shared):
        if error.u_sample > 0.0:
            step = np.zeros_like(delta)
            step[k] = _STEP
            slope = expected_reading(samples, brdf, delta + step) - expected_reading(samples, brdf, delta - step)
            variance += (slope / (2.0 * _STEP) * error.u_sample) ** 2
    u = np.sqrt(variance)
    with np.errstate(divide="ignore", invalid="ignore"):
        pull = np.where(u > 0.0, (samples.f_r - expected) / u, np.nan)
        ratio = np.where(expected > 0.0, samples.f_r / expected - 1.0, np.nan)
    return Residuals(expected, u, pull, ratio)


def verdict(chi2_per_n: float, n: int, *, noise: str = "stated", discrepancy: bool = False) -> str:
    """What chi2/N means for the reader, in one sentence.

    A right model with right uncertainties gives chi2/N = 1 with a standard deviation of sqrt(2/N); within four of them,
    and between 0.7 and 1.5 in any case, nothing is said against it.

    Parameters
    ----------
    chi2_per_n : float
        With the uncertainties as stated, or as inferred where there are none.
    n : int
        Number of samples.
    noise : str, optional
        ``"inferred"`` if no sample states an uncertainty, so that chi2/N is near 1 whatever the model.
    discrepancy : bool, optional
        The fit has inferred a discrepancy of the model, which its intervals contain.
    """
    if not np.isfinite(chi2_per_n):
        return "chi2/N is not known, as the samples carry no uncertainty: the fit has not been tested against them."
    if noise == "inferred":
        return f"chi2/N = {chi2_per_n:.3g} by construction, as the noise was inferred: it does not test the model."
    margin = 4.0 * np.sqrt(2.0 / max(n, 1))
    if chi2_per_n > max(1.5, 1.0 + margin):
        consequence = (
            "The intervals and bands contain an inferred discrepancy of the model."
            if discrepancy
            else "The intervals and bands are those of a wrong model and too narrow: do not quote them."
        )
        return (
            f"chi2/N = {chi2_per_n:.3g}, expected 1: the model does not describe the samples within their uncertainties. "
            f"{consequence} Try another model, or look for a fault of the measurement."
        )
    if chi2_per_n < min(0.7, 1.0 - margin):
        return (
            f"chi2/N = {chi2_per_n:.3g}, expected 1: the samples scatter less than their uncertainties say. The intervals "
            "and bands are wider than they need be; check the noise model."
        )
    return f"chi2/N = {chi2_per_n:.3g}: the model describes the samples within their uncertainties."


def is_sound(sentence: str) -> bool:
    """True of a `verdict` that has nothing against the fit."""
    return "the model describes the samples" in sentence


def _measured_unit(vector: Array) -> Array:
    """Unit vectors; a direction that was measured was above the horizon and stays there."""
    vector[:, 2] = np.maximum(vector[:, 2], 1e-9)
    return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))
