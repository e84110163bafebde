"""Readings of many pixels in the same directions, and their likelihood under one problem.

A row of parameters belongs to one pixel; expected readings and the variance of the model's making come from
`fitting.likelihood.Problem`, the stated variance from the pixel.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fitting.likelihood import Problem
from gonio import jit
from gonio.brdf.elementary import log
from gonio.errors import DatasetError

Array = NDArray[np.float64]


class Readings:
    """Readings of p pixels.

    Parameters
    ----------
    problem : Problem
        Its samples give the n directions, and the uncertainties where `u` is None.
    f_r : ndarray, shape (p, n)
        [1/sr]; NaN where there is none.
    u : ndarray, shape (p, n), optional
        Standard random uncertainty [1/sr].

    Attributes
    ----------
    used : ndarray of int, shape (p,)
        Readings that are not NaN.
    noise : ndarray of bool, shape (d,)
        Which of the parameters are noise.

    Raises
    ------
    DatasetError
        If a shape is wrong, a reading is infinite, or an uncertainty of a reading is not positive.
    """

    def __init__(self, problem: Problem, f_r: Array, u: Array | None = None) -> None:
        n = len(problem.samples)
        f_r = np.ascontiguousarray(f_r, dtype=float)
        if f_r.ndim != 2 or f_r.shape[1] != n:
            raise DatasetError(f"readings have shape {f_r.shape}, needed is (pixels, {n})")
        if np.any(np.isinf(f_r)):
            raise DatasetError("a reading is infinite; make it NaN to leave it out")
        self.problem, self.f_r = problem, f_r
        self.used = np.sum(np.isfinite(f_r), axis=1)
        stated = np.nan_to_num(problem.samples.u_f_r) ** 2  # (n,); 0 where it is inferred
        self.noise = np.array([name.startswith("noise.") for name in problem.space.names])
        self._more = np.zeros((1, n))  # variance [1/sr^2] beyond the problem's own
        if u is not None:
            u = np.asarray(u, dtype=float)
            if u.shape != f_r.shape:
                raise DatasetError(f"uncertainties have shape {u.shape}, needed is {f_r.shape}")
            if np.any(~(u > 0) & np.isfinite(f_r)):
                raise DatasetError("the uncertainty of a reading is not positive; give it, or make the reading NaN")
            self._more = np.where(np.isfinite(f_r), u**2 - stated, 0.0)

    def __len__(self) -> int:
        return len(self.f_r)

    def log_likelihood(self, x: Array, pixel: NDArray[np.int64]) -> tuple[Array, Array]:
        """ln L up to a constant and chi^2, each (w,), of free parameters x (w, d) for the pixels (w,)."""
        mean, var = self.problem.predict(x)
        total, chi2 = np.empty(len(x)), np.empty(len(x))
        _score_kernel(mean, var, self.f_r, self._more, pixel, total, chi2)
        return total, chi2

    def normal_equations(
        self, x: Array, shifted: Array, pixel: NDArray[np.int64], step: float
    ) -> tuple[Array, Array, Array]:
        """Log likelihood (w,), its gradient (w, d) and Fisher's information (w, d, d).

        A noise of about zero enters squared, so its information vanishes there; its diagonal is the observed curvature
        where that is larger.

        Parameters
        ----------
        x : ndarray, shape (w, d)
        shifted : ndarray, shape (w, 2, d, d)
            Parameters with one coordinate after the other a step up, then a step down.
        step : float
            Of the coordinates in which derivatives are wanted.
        """
        w, _, d, _ = shifted.shape
        mean, var = self.problem.predict(x)
        value, chi2 = np.empty(w), np.empty(w)
        _score_kernel(mean, var, self.f_r, self._more, pixel, value, chi2)
        n = mean.shape[1]
        means, variances = self.problem.predict(shifted.reshape(-1, d))
        gradient, fisher = np.zeros((w, d)), np.zeros((w, d, d))
        _normal_kernel(
            mean, var, means.reshape(w, 2, d, n), variances.reshape(w, 2, d, n), self.f_r, self._more, pixel, step,
            self.noise, value, gradient, fisher,
        )  # fmt: skip
        return value, gradient, fisher

    def nearest(self, x: Array) -> NDArray[np.int64]:
        """For each pixel the one of the parameter sets x (b, d) with the largest likelihood."""
        mean, var = self.problem.predict(x)
        out = np.zeros(len(self), dtype=np.int64)
        _nearest_kernel(mean, var, self.f_r, self._more, out)
        return out


def _misfit(mean, var, y, extra):  # type: ignore[no-untyped-def]
    """chi^2 and sum of ln s^2 of one pixel."""
    c, l = 0.0, 0.0
    for j in range(y.size):
        s2 = var[j] + extra[j]
        r = y[j] - mean[j]
        c += r * r / s2 if y[j] == y[j] else 0.0
    for j in range(y.size):
        l += log(var[j] + extra[j]) if y[j] == y[j] else 0.0
    return c, l


_misfit_part = jit.part(_misfit, fastmath=jit.FAST)


def _score(mean, var, f_r, more, pixel, total, chi2):  # type: ignore[no-untyped-def]
    for w in range(mean.shape[0]):
        chi2[w], l = _misfit_part(mean[w], var[w], f_r[pixel[w]], more[pixel[w] if more.shape[0] > 1 else 0])
        total[w] = -0.5 * (chi2[w] + l)


def _nearest(mean, var, f_r, more, out):  # type: ignore[no-untyped-def]
    for p in range(f_r.shape[0]):
        least = math.inf
        for k in range(mean.shape[0]):
            c, l = _misfit_part(mean[k], var[k], f_r[p], more[p if more.shape[0] > 1 else 0])
            if c + l < least:
                least, out[p] = c + l, k


def _normal(mean, var, means, variances, f_r, more, pixel, step, noise, value, gradient, fisher):  # type: ignore[no-untyped-def]
    """means and variances (w, 2, d, n): a step up and a step down of each coordinate."""
    d, n = gradient.shape[1], mean.shape[1]
    slope, spread = np.empty((d, n)), np.empty((d, n))
    for w in range(mean.shape[0]):
        y, extra = f_r[pixel[w]], more[pixel[w] if more.shape[0] > 1 else 0]
        for i in range(d):
            up, down = means[w, 0, i], means[w, 1, i]
            v_up, v_down = variances[w, 0, i], variances[w, 1, i]
            g = 0.0
            for j in range(n):
                s2 = var[w, j] + extra[j]
                known = 1.0 if y[j] == y[j] else 0.0
                s = math.sqrt(s2)
                r = (y[j] - mean[w, j]) / s if y[j] == y[j] else 0.0
                slope[i, j] = known * (up[j] - down[j]) / (2.0 * step * s)  # of the mean, in standard deviations
                spread[i, j] = known * (v_up[j] - v_down[j]) / (2.0 * step * s2)  # of ln s^2
                g += slope[i, j] * r + 0.5 * spread[i, j] * (r * r - 1.0)
            gradient[w, i] = g
        for i in range(d):
            for k in range(i + 1):
                h = 0.0
                for j in range(n):
                    h += slope[i, j] * slope[k, j] + 0.5 * spread[i, j] * spread[k, j]
                fisher[w, i, k] = fisher[w, k, i] = h
            if noise[i]:
                c_up, l_up = _misfit_part(means[w, 0, i], variances[w, 0, i], y, extra)
                c_down, l_down = _misfit_part(means[w, 1, i], variances[w, 1, i], y, extra)
                bend = (2.0 * value[w] + 0.5 * (c_up + l_up + c_down + l_down)) / step**2
                fisher[w, i, i] = max(fisher[w, i, i], bend)


_score_kernel, _nearest_kernel, _normal_kernel = jit.kernel(_score), jit.kernel(_nearest), jit.kernel(_normal)
