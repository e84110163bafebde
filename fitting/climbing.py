r"""Many optima at once: damped Gauss-Newton steps [1]_ towards modes of posteriors of the unbounded coordinates.

The curvature is Fisher's information of the readings, mean and variance, plus that of the prior, so it is never negative;
of three dampings the best is taken. Each row climbs by itself: rows that have arrived are left out of what follows.

References
----------
.. [1] D. W. Marquardt, "An Algorithm for Least-Squares Estimation of Nonlinear Parameters", J. SIAM 11(2), 1963.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from fitting.parameters import Space
from fitting.readings import Readings

Array = NDArray[np.float64]
STEP = 1e-3  # of a coordinate of unit prior width, for slopes by central differences
ITERATIONS = 60
_ENOUGH = 1e-3  # gain in log density that a step may still promise at the mode
_EDGE, _LONGEST = 8.0, 2.0  # of a coordinate; of a step
_TOGETHER = 50_000  # expected readings of one step that are computed together


@dataclass(frozen=True)
class Mode:
    """Optima of w rows.

    Attributes
    ----------
    u : ndarray, shape (w, d)
    log_probability : ndarray, shape (w,)
    factor : ndarray, shape (w, d, d)
        Lower triangular square root of the covariance.
    reached : ndarray of bool, shape (w,)
    """

    u: Array
    log_probability: Array
    factor: Array
    reached: NDArray[np.bool_]

    def log_mass(self) -> Array:
        """Log density plus log volume, (w,): the Laplace approximation of the mass, up to a constant."""
        diagonal = np.einsum("wii->wi", self.factor)
        return np.asarray(self.log_probability + np.sum(np.log(diagonal), axis=1))

    def select(self, rows: NDArray[np.int64]) -> Mode:
        return Mode(*(getattr(self, f.name)[rows] for f in fields(self)))


def climb(given: Readings, space: Space, start: Array, pixel: NDArray[np.int64]) -> Mode:
    """Modes from starts u (w, d), each for one pixel (w,)."""
    rows = max(4, _TOGETHER // given.f_r.shape[1])
    parts = [_climb(given, space, start[a : a + rows], pixel[a : a + rows]) for a in range(0, len(start), rows)]
    return Mode(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Mode)))


def _climb(given: Readings, space: Space, start: Array, pixel: NDArray[np.int64]) -> Mode:
    w, d = start.shape
    u = np.clip(start, -_EDGE, _EDGE)
    value = np.full(w, -np.inf)
    curvature = np.tile(np.eye(d), (w, 1, 1))
    damping = np.full(w, 1e-2)
    reached = np.zeros(w, dtype=bool)
    active = np.arange(w)
    for _ in range(ITERATIONS):
        at = u[active]
        here, gradient, information = _derivatives(given, space, at, pixel[active])
        value[active], curvature[active] = here, information
        best, gain = at, np.zeros(len(active))
        promised = 0.5 * np.sum(gradient * _solve(information, gradient, np.zeros(len(active))), axis=1)
        for factor in (0.1, 1.0, 10.0):
            lam = factor * damping[active]
            step = _solve(information, gradient, lam)
            step *= np.minimum(1.0, _LONGEST / np.maximum(np.max(np.abs(step), axis=1, keepdims=True), 1e-300))
            trial = np.clip(at + step, -_EDGE, _EDGE)
            x, log_prior = space.natural(trial)
            more = log_prior + given.log_likelihood(x, pixel[active])[0] - here
            better = more > gain
            best, gain = np.where(better[:, None], trial, best), np.where(better, more, gain)
            damping[active] = np.where(better, lam, damping[active])
        lost = gain <= 0.0
        damping[active[lost]] *= 100.0
        u[active] = best
        done = (promised < _ENOUGH) & (gain < _ENOUGH)
        reached[active[done]] = True
        active = active[~done & (damping[active] < 1e12)]
        if not len(active):
            break
    return Mode(u, value, _factor(curvature), reached)


def _derivatives(given: Readings, space: Space, u: Array, pixel: NDArray[np.int64]) -> tuple[Array, Array, Array]:
    """Log posterior density (w,), gradient (w, d) and curvature (w, d, d) at u (w, d)."""
    w, d = u.shape
    moved = u[:, None, None] + STEP * np.stack((np.eye(d), -np.eye(d)))  # (w, 2, d, d)
    x, log_prior = space.natural(u)
    shifted, beside = space.natural(moved.reshape(-1, d))
    beside = beside.reshape(w, 2, d)  # the prior is a product: its curvature has a diagonal only
    value, gradient, information = given.normal_equations(x, shifted.reshape(w, 2, d, d), pixel, STEP)
    gradient += (beside[:, 0] - beside[:, 1]) / (2.0 * STEP)
    bend = (2.0 * log_prior[:, None] - beside[:, 0] - beside[:, 1]) / STEP**2
    information[:, np.arange(d), np.arange(d)] += np.maximum(bend, 1e-3)
    return value + log_prior, gradient, information


def _solve(information: Array, gradient: Array, damping: Array) -> Array:
    """Steps (w, d) with the diagonal raised by 1 + damping."""
    d = gradient.shape[1]
    raised = information.copy()
    raised[:, np.arange(d), np.arange(d)] *= 1.0 + damping[:, None]
    return np.asarray(np.linalg.solve(raised, gradient[..., None])[..., 0])


def _factor(curvature: Array) -> Array:
    """Lower triangular square roots of the inverses of positive definite matrices (w, d, d)."""
    return np.asarray(np.linalg.cholesky(np.linalg.inv(curvature)))
