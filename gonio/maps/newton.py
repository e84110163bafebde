"""Weighted least squares in two unknowns for very many small problems at once (Levenberg and Marquardt).

References
----------
.. [1] J. J. More, "The Levenberg-Marquardt algorithm: implementation and theory", in Numerical Analysis, Lecture Notes in
   Mathematics 630, Springer, 1978. doi:10.1007/BFb0067700
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Model = Callable[[Array], tuple[Array, Array, Array]]

_MOST_STEPS = 40
_FINE = 1e-11  # of the range: a step below this ends the search
_LONGEST = 0.1  # of the range
_STIFF = 1e8  # damping at which no step helps any more
_NEGLIGIBLE = 1e-6  # of chi squared


def minimise(
    model: Model, start: Array, target: Array, u: Array, lower: Array, upper: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Local minima of chi squared in a box.

    Parameters
    ----------
    model : callable
        Points (n, 2) -> values (n, k), derivatives (n, k, 2), own variances (n, k); the latter count as at the start.
    start : ndarray, shape (n, 2)
    target, u : ndarray, shape (n, k)
        What the values should be, and the standard uncertainty of that.
    lower, upper : ndarray, shape (2,)
        The box.

    Returns
    -------
    at : ndarray, shape (n, 2)
    inside : ndarray of bool, shape (n,)
        False where the minimum lies beyond the box, or the values are not known.
    """
    at, span = np.clip(start, lower, upper), upper - lower
    value, slope, own = model(at)
    weight = 1.0 / (u**2 + own)
    chi = np.sum(weight * (target - value) ** 2, axis=1)
    damping = np.full(len(at), 1e-8)
    pending = np.flatnonzero(np.isfinite(chi))
    for _ in range(_MOST_STEPS):
        if not pending.size:
            break
        matrix, vector = normal_equations(slope[pending], weight[pending], (target - value)[pending])
        step = _damped(matrix, vector, damping[pending])
        step /= np.maximum(1.0, np.max(np.abs(step) / (_LONGEST * span), axis=1))[:, None]
        trial = np.clip(at[pending] + step, lower, upper)
        got, its_slope, _ = model(trial)
        its_chi = np.sum(weight[pending] * (target[pending] - got) ** 2, axis=1)
        better = its_chi < chi[pending]
        index = pending[better]
        at[index], value[index], slope[index], chi[index] = trial[better], got[better], its_slope[better], its_chi[better]
        damping[pending] = np.where(
            better, np.maximum(damping[pending] / 30.0, 1e-14), np.maximum(damping[pending], 1e-4) * 10
        )
        gain = np.sum(step * vector, axis=1)
        moving = np.any(np.abs(step) > _FINE * span, axis=1) & (damping[pending] < _STIFF) & (gain > 1e-16 + 1e-10 * its_chi)
        pending = pending[moving]
    matrix, vector = normal_equations(slope, weight, target - value)
    step = _damped(matrix, vector, np.full(len(at), 1e-14))
    gain = np.sum(step * vector, axis=1)  # what an undamped step would take off chi squared
    edge = np.any(((at <= lower) & (step < 0)) | ((at >= upper) & (step > 0)), axis=1)
    return at, np.isfinite(chi) & (~edge | (gain <= _NEGLIGIBLE))


def normal_equations(slope: Array, weight: Array, residual: Array) -> tuple[Array, Array]:
    """J' W J, shape (n, 2, 2), and J' W r, shape (n, 2)."""
    weighted = slope * weight[..., None]
    return np.einsum("nki,nkj->nij", weighted, slope), np.einsum("nki,nk->ni", weighted, residual)


def covariance(matrix: Array) -> Array:
    """Inverse of J' W J, shape (n, 2, 2); infinite variances where it has none."""
    a, b, c = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 1]
    determinant = a * c - b * b
    singular = ~(determinant > 1e-14 * a * c)
    safe = np.where(singular, 1.0, determinant)
    inverse = np.stack((np.stack((c, -b), axis=-1), np.stack((-b, a), axis=-1)), axis=-2) / safe[:, None, None]
    inverse[singular] = (np.inf, np.nan), (np.nan, np.inf)
    return np.asarray(inverse)


def _damped(matrix: Array, vector: Array, damping: Array) -> Array:
    """Solution of (A + damping diag A) x = b, shape (n, 2); 0 where A is 0."""
    a, b, c = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 1]
    floor = 1e-12 * (a + c)
    a, c = a + damping * a + floor, c + damping * c + floor
    determinant = a * c - b * b
    flat = ~(determinant > 0)
    safe = np.where(flat, 1.0, determinant)
    x = np.stack((c * vector[:, 0] - b * vector[:, 1], a * vector[:, 1] - b * vector[:, 0]), axis=-1) / safe[:, None]
    x[flat] = 0.0
    return np.asarray(x)
