r"""Can a chain be trusted, and does the model describe the data: numbers and sentences.

Walkers of one ensemble depend on each other, so convergence is judged between independent ensembles: the potential scale
reduction compares halves of ensembles [1]_, and the autocorrelation time is that of single walkers about the common mean,
averaged over all walkers, with Sokal's window [2]_. A run that has not converged is a status with advice, not an error.

References
----------
.. [1] A. Vehtari, A. Gelman, D. Simpson, B. Carpenter, P.-C. Buerkner, "Rank-normalization, folding, and localization: an
   improved R-hat", Bayesian Analysis 16(2), 2021. doi:10.1214/20-BA1221
.. [2] A. Sokal, "Monte Carlo Methods in Statistical Mechanics", 1997; J. Goodman, J. Weare, CAMCoS 5(1), 2010.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
RHAT_LIMIT = 1.01
CHI2_LIMIT = 1.5
CONTRACTION_LIMIT = 0.3
CORRELATION_LIMIT = 0.92  # of k_s and n without samples beyond 60 degrees; with some to 70 it is 0.9, and falls


def autocorrelation_time(chain: Array, window: float = 5.0) -> Array:
    r"""Integrated autocorrelation time :math:`\tau = 1 + 2\sum_t\rho_t` in steps.

    Parameters
    ----------
    chain : ndarray, shape (step, walker, d)
        The mean of all is taken off, so walkers that stay apart show as a long time.
    window : float
        The sum ends at the first t that is at least this many tau.

    Returns
    -------
    ndarray, shape (d,)
        At least 1. Too short a chain gives too small a value: trust it where step > 50 tau. For a constant series the
        number of steps, as nothing was learnt.
    """
    steps, walkers, d = chain.shape
    if steps < 2:
        return np.full(d, float(steps))
    size = 1 << (2 * steps - 1).bit_length()
    tau = np.empty(d)
    for i in range(d):
        x = chain[:, :, i] - np.mean(chain[:, :, i])
        power = np.zeros(size // 2 + 1)
        for w in range(0, walkers, 32):
            spectrum = np.fft.rfft(x[:, w : w + 32], n=size, axis=0)
            power += np.sum(spectrum.real**2 + spectrum.imag**2, axis=1)
        rho = np.fft.irfft(power, n=size)[:steps]
        if not rho[0] > 0:
            tau[i] = float(steps)
            continue
        times = 2.0 * np.cumsum(rho / rho[0]) - 1.0
        inside = np.arange(steps) >= window * times
        tau[i] = times[int(np.argmax(inside)) if inside.any() else steps - 1]
    return np.maximum(tau, 1.0)


def split_rhat(draws: Array) -> Array:
    """Rank-normalised split R-hat, the larger of bulk and folded.

    Parameters
    ----------
    draws : ndarray, shape (ensemble, draw, d)
        Draws of independent ensembles, in order of time.

    Returns
    -------
    ndarray, shape (d,)
        Close to 1 where the ensembles agree; NaN for fewer than 4 draws or a constant.
    """
    from scipy.special import ndtri
    from scipy.stats import rankdata

    _, n, d = draws.shape
    half = n // 2
    out = np.full(d, np.nan)
    if half < 2:
        return out
    parts = np.concatenate((draws[:, :half], draws[:, n - half :]))  # (2 m, half, d)
    for i in range(d):
        x = parts[:, :, i]
        values = []
        for y in (x, np.abs(x - np.median(x))):
            # scores as in [1]_, eq. 14
            z = ndtri((rankdata(y.ravel()) - 0.375) / (y.size + 0.25)).reshape(y.shape)
            within = float(np.mean(np.var(z, axis=1, ddof=1)))
            between = float(np.var(np.mean(z, axis=1), ddof=1))
            if within > 0:
                values.append(math.sqrt((half - 1) / half + between / within))
        if values:
            out[i] = max(values)
    return out


def contraction(prior_sd: float, posterior_sd: float) -> float:
    """1 - variance after / variance before, in the parameter's natural coordinate: 0 = the data said nothing, 1 = all."""
    return 1.0 - (posterior_sd / prior_sd) ** 2


def advice(
    *,
    chi2_per_n: float,
    n_samples: int,
    n_parameters: int,
    contractions: dict[str, float],
    noise: str,
    discrepancy: bool,
    acceptance: float,
    outliers: int = 0,
    robust: bool = False,
    scaled: bool = False,
    incidences: int = 2,
) -> list[str]:
    """What a user should know about this fit, one sentence each; nothing if all is well.

    Parameters
    ----------
    chi2_per_n : float
        With the variances as stated (before a discrepancy term).
    n_samples, n_parameters : int
    contractions : dict
        Of the model's parameters.
    noise : str
        ``"stated"``, ``"inferred"`` or ``"mixed"``.
    discrepancy : bool
        A model discrepancy was inferred.
    acceptance : float
        Fraction of accepted moves.
    outliers : int
        Samples far from the model.
    robust : bool
        Student's t was the likelihood.
    scaled : bool
        A common factor of the stated uncertainties was inferred.
    incidences : int
        Different theta_i of the samples.
    """
    said = []
    limit = misfit_limit(n_samples)
    if n_samples < n_parameters:
        said.append(f"{n_samples} samples for {n_parameters} parameters: the priors decide; measure more or fix some")
    if incidences < 2:
        said.append("all samples have one theta_i: for others the fit is what the model's form makes of it; measure at more")
    if noise != "inferred" and chi2_per_n > limit and not (robust and outliers <= 0.05 * n_samples):
        consequence = (
            "the intervals include an inferred model discrepancy (noise.discrepancy)"
            if discrepancy
            else "the intervals include an inferred factor of the uncertainties (noise.scale)"
            if scaled
            else "the intervals are too narrow; allow a discrepancy"
        )
        said.append(
            f"chi2/N = {chi2_per_n:.3g}, expected 1: the model does not describe the data within their stated "
            f"uncertainty; {consequence}; try another model or look for a fault of the measurement"
        )
    if outliers:
        said.append(
            f"{outliers} of {n_samples} samples are more than 5 standard deviations from the model (diagnostics: outliers)"
            + ("; Student's t gives them little weight" if robust else "; look at them, or fit with Student's t")
        )
    expected = noise == "stated" and not (discrepancy or scaled) and n_samples >= 20
    if expected and chi2_per_n < 1.0 - 4.0 * math.sqrt(2.0 / n_samples):
        said.append(f"chi2/N = {chi2_per_n:.3g}, expected 1: the stated uncertainties, and so the intervals, are too large")
    if noise == "inferred":
        said.append(
            "the samples state no uncertainty: the noise was inferred from their scatter about the model, so it includes "
            "what the model misses, and chi2/N is near 1 by construction"
        )
    for name, value in contractions.items():
        if value < CONTRACTION_LIMIT:
            said.append(
                f"the data hardly constrain {name} (contraction {max(value, 0.0):.2f}): its interval is the prior's; "
                "measure where it matters, or fix it"
            )
    if acceptance < 0.05:
        said.append(f"only {acceptance:.1%} of the moves were accepted: the posterior is hard to walk, see the corner plot")
    return said


def misfit_limit(n_samples: int) -> float:
    """chi2/N above which a model is said not to describe the data: 1.5, or 4 sd above 1 for few samples."""
    return max(CHI2_LIMIT, 1.0 + 4.0 * math.sqrt(2.0 / n_samples))


def entangled(names: Sequence[str], draws: Array, shared: Array | None = None) -> list[str]:
    """A sentence for each pair of parameters that the data tell only together.

    What the pair owes to the errors that all samples share, such as the scale of the white reference, is taken out first:
    no other measurement would tell the two apart better.

    Parameters
    ----------
    names : sequence of str, length d
        Of the model's parameters.
    draws : ndarray, shape (s, d)
        Of all of them; ranks are compared, so a curved valley counts.
    shared : ndarray, shape (s, k), optional
        Draws of the shared errors.
    """
    from scipy.stats import rankdata

    if len(names) < 2 or len(draws) < 3:
        return []
    rank = rankdata(draws, axis=0)
    rank = rank - rank.mean(axis=0)
    if shared is not None and shared.shape[1] > 0:
        common = rankdata(shared, axis=0)
        common = common - common.mean(axis=0)
        rank = rank - common @ np.linalg.lstsq(common, rank, rcond=None)[0]
    norm = np.sqrt(np.sum(rank**2, axis=0))
    correlation = (rank.T @ rank) / np.maximum(np.outer(norm, norm), 1e-300)
    return [
        f"the data tell {a} and {b} only together (rank correlation {correlation[i, j]:.2f}): fix one of them, or measure "
        "beyond 70 degrees"
        for i, a in enumerate(names)
        for j, b in enumerate(names[:i])
        if abs(correlation[i, j]) > CORRELATION_LIMIT
    ]
