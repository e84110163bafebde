r"""Pareto-smoothed importance sampling: weights that can be trusted, and the number that says whether they can.

The largest importance ratios are replaced by quantiles of a generalised Pareto distribution fitted to them [1]_, by the
method of [2]_. Its shape k-hat tells how many draws a given accuracy takes: up to 0.5 the central limit theorem holds as
usual, up to `limit` estimates are still useful, above it they are not, whatever the number of draws.

Ratios come from anywhere: a proposal (`fitting` then samples by importance) or a left-out reading (`fitting.compare`).

References
----------
.. [1] A. Vehtari, D. Simpson, A. Gelman, Y. Yao, J. Gabry, "Pareto Smoothed Importance Sampling", JMLR 25(72), 2024.
.. [2] J. Zhang, M. A. Stephens, "A New and Efficient Estimation Method for the Generalized Pareto Distribution",
   Technometrics 51(3), 2009. doi:10.1198/tech.2009.08017
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gonio import jit

Array = NDArray[np.float64]
GOOD = 0.5  # k-hat up to which the variance of the weights is finite
_FEWEST = 5  # ratios in the tail that a fit needs


def limit(draws: int) -> float:
    """k-hat up to which that many draws are enough for a useful estimate: min(1 - 1 / log10(draws), 0.7), [1]_."""
    return min(1.0 - 1.0 / math.log10(max(draws, 11)), 0.7)


def tail_length(draws: int, relative_efficiency: float = 1.0) -> int:
    """Ratios that are taken for the tail: a fifth of the draws or 3 sqrt(draws / relative efficiency), the smaller."""
    return math.ceil(min(0.2 * draws, 3.0 * math.sqrt(draws / relative_efficiency)))


def smooth(log_ratios: Array, relative_efficiency: float = 1.0) -> tuple[Array, Array]:
    r"""Smoothed, normalised weights of rows of importance ratios.

    Parameters
    ----------
    log_ratios : ndarray, shape (..., s)
        Logarithms of target over proposal, up to a constant per row. -inf is a weight of zero.
    relative_efficiency : float
        Effective sample size of the draws over s: below 1 for a Markov chain's.

    Returns
    -------
    log_weights : ndarray, shape (..., s)
        Logarithms of weights that sum to 1. Rows without a finite ratio: equal weights.
    k_hat : ndarray, shape (...)
        Shape of the tail. -inf where all of it is equal; +inf where fewer than 5 ratios are left to fit, or none is finite.

    Examples
    --------
    Draws of rate 2 for an exponential of rate 1: the ratios' tail is Pareto's with k = 1/2.

    >>> x = -np.log((np.arange(100000) + 0.5) / 100000) / 2
    >>> round(float(smooth(x)[1]), 2)
    0.5
    """
    given = np.asarray(log_ratios, dtype=float)
    rows = given.reshape(-1, given.shape[-1])
    s = rows.shape[1]
    top = np.max(rows, axis=1, keepdims=True, initial=-np.inf)
    known = np.isfinite(top[:, 0])
    shifted = np.where(known[:, None], rows - np.where(known[:, None], top, 0.0), 0.0)
    k_hat = np.full(len(rows), np.inf)
    m = tail_length(s, relative_efficiency)
    if m >= _FEWEST and s > m:
        order = np.argpartition(shifted, s - m - 1, axis=1)[:, s - m - 1 :]
        found = np.take_along_axis(shifted, order, axis=1)
        inner = np.argsort(found, axis=1)
        order, found = np.take_along_axis(order, inner, axis=1), np.take_along_axis(found, inner, axis=1)
        tail = np.ascontiguousarray(found[:, 1:])
        _tail_kernel(np.ascontiguousarray(found[:, 0]), tail, k_hat)
        np.put_along_axis(shifted, order[:, 1:], tail, axis=1)
        k_hat[~known] = np.inf
    total = np.log(np.sum(np.exp(shifted), axis=1, keepdims=True))
    return (shifted - total).reshape(given.shape), k_hat.reshape(given.shape[:-1])


def effective(log_weights: Array) -> Array:
    """Effective number of draws of normalised weights (..., s): 1 / sum w^2."""
    return np.asarray(1.0 / np.sum(np.exp(2.0 * log_weights), axis=-1))


def _smooth_tails(cut, tail, k_hat):  # type: ignore[no-untyped-def]
    """Replace sorted log ratios above a cut, relative to the largest, by quantiles of the fit: cut (w,), tail (w, m)."""
    m = tail.shape[1]
    trials = 30 + int(math.sqrt(m))
    x, theta, profile = np.empty(m), np.empty(trials), np.empty(trials)
    for w in range(tail.shape[0]):
        edge = math.exp(cut[w])
        for j in range(m):
            x[j] = math.exp(tail[w, j]) - edge
        quartile = x[int(m / 4 + 0.5) - 1]
        if not x[m - 1] > 0.0:
            k_hat[w] = -math.inf
            continue
        if not quartile > 0.0:  # most of the tail ties with the cut
            k_hat[w] = math.inf
            continue
        best = -math.inf
        for i in range(trials):
            theta[i] = 1.0 / x[m - 1] + (1.0 - math.sqrt(trials / (i + 0.5))) / (3.0 * quartile)
            if theta[i] == 0.0:  # an exponential tail: the limit
                theta[i] = 1e-30 / x[m - 1]
            k = 0.0
            for j in range(m):
                k += math.log1p(-theta[i] * x[j])
            k /= m
            profile[i] = m * (math.log(-theta[i] / k) - k - 1.0)
            best = max(best, profile[i])
        mass, mean = 0.0, 0.0
        for i in range(trials):
            weight = math.exp(profile[i] - best)
            mass += weight
            mean += weight * theta[i]
        mean /= mass
        k = 0.0
        for j in range(m):
            k += math.log1p(-mean * x[j])
        k /= m
        sigma = -k / mean
        k = (k * m + 5.0) / (m + 10.0)  # a weak prior towards 1/2, for short tails
        k_hat[w] = k
        for j in range(m):
            log_rest = math.log1p(-(j + 0.5) / m)
            above = -sigma * log_rest if abs(k) < 1e-12 else sigma * math.expm1(-k * log_rest) / k
            tail[w, j] = min(math.log(edge + above), 0.0)


_tail_kernel = jit.kernel(_smooth_tails)
