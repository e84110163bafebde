r"""The posterior with its linear coefficients, and a common scale of the noise, integrated out, and their draws back.

With variances that do not depend on them the coefficients c are, given the other parameters q, a Gaussian that the range of
each cuts off. The Gaussian integral over all c is exact; the cut is left to the draws. With flat priors on [l, h]

.. math:: \exp\Bigl(-\frac{\chi^2(q, c)}{2 s^2} - \frac12\sum_k\frac{(c_k-m_k)^2}{s^2\tau_k^2}\Bigr), \qquad
   m = \tfrac12(l+h),\ \tau = 2\,(h-l)/s_0,

extends the posterior to all c and is proper. Its integral is

.. math:: |M|^{-1/2} e^{-\chi^2_{\min}/2}, \qquad M = B^\mathsf{T} W B + \mathrm{diag}(\tau^{-2}),

for s = 1, and :math:`|M|^{-1/2} (\chi^2_{\min})^{-(N-p)/2}` for a scale s of the noise with a density flat in ln s [1]_. A
draw of q, then of s and c given q, is a draw of the extended density; weighted with the inverse of what was put in, at most
:math:`e^{p/32}` for s near s_0, and 0 outside the ranges, it is a draw of the posterior. Nothing is approximate, but
much would be thrown away if much lay outside: then nothing is integrated out, see `of`.

References
----------
.. [1] A. Gelman et al., "Bayesian Data Analysis", 3rd ed., 2013, chapter 14.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fitting.likelihood import SCALE, Problem
from fitting.linear import Coefficient, coefficients, products
from fitting.optimum import Mode
from gonio import jit

Array = NDArray[np.float64]
REACH = 2.0  # tau, in lengths of the range
LEAST_INSIDE = 0.5  # share of the extended density that must lie inside the ranges
LEAST_SURPLUS = 20  # samples beyond the coefficients; with fewer, s can be far from s_0
_TRIALS = 1000


@dataclass(frozen=True)
class Drawn:
    """Draws of all parameters.

    Attributes
    ----------
    x : ndarray, shape (k, d)
        Natural values; meaningless where the weight is 0.
    log_weight : ndarray, shape (k,)
        -inf outside the ranges.
    log_posterior : ndarray, shape (k,)
        Log density of x, up to a constant.
    """

    x: Array
    log_weight: Array
    log_posterior: Array


class Whole:
    """A problem as it is, with nothing integrated out; the counterpart of `Marginal`."""

    marginalised: tuple[str, ...] = ()

    def __init__(self, problem: Problem) -> None:
        self.problem, self.space = problem, problem.space

    def log_probability(self, u: Array) -> Array:
        """Log posterior density of u, up to a constant: (w, d) -> (w,); -inf where it is zero, never NaN."""
        return self.problem.log_probability(u)

    def draw(self, u: Array, rng: np.random.Generator) -> Drawn:
        """All parameters of draws u, shape (w, d)."""
        return self.evaluate_and_draw(u, rng)[1]

    def evaluate_and_draw(self, u: Array, rng: np.random.Generator) -> tuple[Array, Drawn]:
        """Log density of u and all parameters."""
        x, log_prior = self.space.natural(u)
        log_likelihood = self.problem.log_likelihood(x)[0]
        total = log_prior + log_likelihood
        with np.errstate(invalid="ignore"):
            posterior = log_likelihood + self.space.log_density(x)
        return np.where(np.isfinite(total), total, -np.inf), Drawn(x, np.zeros(len(x)), posterior)


def _condition(products, precision, pull, count, scaled, density, hat, factor, chi2):  # type: ignore[no-untyped-def]
    """Integral over the coefficients: products (w, 1 + p, 1 + p), precision (p,), pull (p,) = m - c^0 -> log density (w,),
    most probable step from c^0 (w, p), Cholesky factor of M (w, p, p), least chi^2 (w,), what the prior adds included."""
    p = precision.size
    for w in range(products.shape[0]):
        least, log_det = products[w, 0, 0], 0.0
        l, z = factor[w], hat[w]
        for k in range(p):
            least += precision[k] * pull[k] * pull[k]
            z[k] = products[w, k + 1, 0] + precision[k] * pull[k]
        for k in range(p):
            for i in range(k + 1):
                total = products[w, k + 1, i + 1] + (precision[k] if i == k else 0.0)
                for j in range(i):
                    total -= l[k, j] * l[i, j]
                if i < k:
                    l[k, i] = total / l[i, i]
                else:
                    l[k, k] = math.sqrt(max(total, 1e-12 * precision[k]))
            log_det += 2.0 * math.log(l[k, k])
            for j in range(k):
                z[k] -= l[k, j] * z[j]
            z[k] /= l[k, k]
            least -= z[k] * z[k]
        for k in range(p - 1, -1, -1):
            for j in range(k + 1, p):
                z[k] -= l[j, k] * z[j]
            z[k] /= l[k, k]
        least = max(least, 1e-300)
        chi2[w] = least
        density[w] = -0.5 * log_det - 0.5 * ((count - p) * math.log(least) if scaled else least)


_condition_kernel = jit.kernel(_condition)


class Marginal:
    """A problem with its linear coefficients integrated out.

    Parameters
    ----------
    problem : Problem
        With `fixed_variances`.
    linear : tuple of Coefficient
        Each with a uniform or a normal prior.
    about : ndarray, shape (p,)
        Their values near the optimum.
    scale : float, optional
        ``noise.scale`` near the optimum, to integrate it out as well; all priors of `linear` are then uniform.

    Attributes
    ----------
    space : Space
        Of the parameters that are left.
    marginalised : tuple of str
    """

    def __init__(
        self, problem: Problem, linear: tuple[Coefficient, ...], about: Array, scale: float | None = None
    ) -> None:
        self.problem, self.linear, self._about = problem, linear, about
        self.marginalised = (*(c.name for c in linear), *([SCALE] if scale is not None else []))
        self.space = problem.space.without(self.marginalised)
        self._scaled, at = scale is not None, scale or 1.0
        priors = [problem.space.priors[c.place] for c in linear]
        self._flat = np.array([q.kind == "uniform" for q in priors])
        self._lower, self._upper = (np.array([getattr(q, key) for q in priors]) for key in ("lower", "upper"))
        self._centre = np.array([0.5 * (q.lower + q.upper) if q.kind == "uniform" else q.a for q in priors])
        width = np.array([REACH * (q.upper - q.lower) / at if q.kind == "uniform" else q.b for q in priors])
        self._precision = width**-2.0
        self._root = 1.0 / problem.samples.u_f_r
        self._kept = [i for i, name in enumerate(problem.space.names) if name not in self.marginalised]
        self._scale = problem.space.names.index(SCALE) if self._scaled else -1
        # the place of noise.scale among the declared parameters, and its value where it is held
        self._noise = next(i for i, p in enumerate(problem.space.declared) if p.name == SCALE)

    def _conditioned(self, full: Array) -> tuple[Array, ...]:
        """Log density, most probable step, Cholesky factor, least chi^2, products."""
        w, p = len(full), len(self.linear)
        held = 1.0 if self._scaled else full[:, self._noise] ** -2.0
        made = products(self.problem, self.linear, full, self._about, self.problem.samples.f_r, self._root)
        made = made * np.reshape(held, (-1, 1, 1))
        density, hat, factor, chi2 = np.empty(w), np.empty((w, p)), np.zeros((w, p, p)), np.empty(w)
        n = len(self.problem.samples)
        _condition_kernel(
            made, self._precision, self._centre - self._about, n, self._scaled, density, hat, factor, chi2
        )
        if not self._scaled:
            density -= n * np.log(full[:, self._noise])
        return density, hat, factor, chi2, made

    def log_probability(self, u: Array) -> Array:
        """Log density of u, up to a constant: (w, d) -> (w,); -inf where it is zero, never NaN."""
        x, log_prior = self.space.natural(u)
        total = log_prior + self.problem.in_parts(self._conditioned, self.space.full(x))[0]
        return np.where(np.isfinite(total), total, -np.inf)

    def draw(self, u: Array, rng: np.random.Generator) -> Drawn:
        """All parameters: draws u of the parameters left, shape (w, d), completed by one draw of the others each."""
        return self.evaluate_and_draw(u, rng)[1]

    def evaluate_and_draw(self, u: Array, rng: np.random.Generator) -> tuple[Array, Drawn]:
        """Log density of u as `log_probability`, and draws as `draw`, in one evaluation."""
        x, log_prior = self.space.natural(u)
        density, hat, factor, chi2, made = self.problem.in_parts(self._conditioned, self.space.full(x))
        n, p = len(self.problem.samples), len(self.linear)
        # chi^2_min / s^2 is chi^2-distributed with N - p degrees of freedom
        s = np.sqrt(chi2 / rng.chisquare(n - p, len(u))) if self._scaled else np.ones(len(u))
        z = rng.standard_normal((len(u), p)) * s[:, None]
        for k in range(p - 1, -1, -1):  # L^T step = z
            z[:, k] -= np.sum(factor[:, k + 1 :, k] * z[:, k + 1 :], axis=1)
            z[:, k] /= factor[:, k, k]
        step = hat + z
        c = self._about + step
        all_x = np.empty((len(u), len(self.problem.space)))
        all_x[:, self._kept] = x
        all_x[:, [one.place for one in self.linear]] = c
        if self._scaled:
            all_x[:, self._scale] = s
        inside = np.all((c >= self._lower) & (c <= self._upper), axis=1)
        if self._scaled:
            q = self.problem.space.priors[self._scale]
            inside &= (s >= q.lower) & (s <= q.upper)
        put_in = ((c - self._centre) / s[:, None]) ** 2 @ np.where(self._flat, self._precision, 0.0)
        # ln L = -chi^2(c) / (2 s^2) - N ln s
        whole = made[:, 1:, 1:] + np.tril(made[:, 1:, 1:], -1).transpose(0, 2, 1)
        chi2_c = made[:, 0, 0] - 2.0 * np.sum(made[:, 1:, 0] * step, axis=1) + np.einsum("wk,wkl,wl->w", step, whole, step)
        held = s if self._scaled else self.space.full(x)[:, self._noise]
        with np.errstate(invalid="ignore"):
            posterior = -0.5 * chi2_c / s**2 - n * np.log(held) + self.problem.space.log_density(all_x)
        total = log_prior + density
        return (
            np.where(np.isfinite(total), total, -np.inf),
            Drawn(all_x, np.where(inside, 0.5 * put_in, -np.inf), posterior),
        )


Target = Whole | Marginal


def of(problem: Problem, mode: Mode, rng: np.random.Generator) -> Target:
    """The problem with as much integrated out as is exact and worth it, judged at its best mode.

    Coefficients with a uniform or a normal prior are, if all variances are fixed and if at least half of the extended
    density about the mode lies inside their ranges; ``noise.scale`` as well, if it is free with a density flat in its
    logarithm and the samples are many more than the coefficients.
    """
    space = problem.space
    linear = coefficients(problem, lambda i: space.priors[i].kind in ("uniform", "normal"))
    whole = Whole(problem)
    if not problem.fixed_variances or not linear or len(linear) == len(space):
        return whole
    x = space.natural(mode.u[None])[0][0]
    scale = None
    if SCALE in space.names and len(problem.samples) - len(linear) >= LEAST_SURPLUS:
        i = space.names.index(SCALE)
        if space.priors[i].kind == "log_uniform" and all(space.priors[c.place].kind == "uniform" for c in linear):
            scale = float(x[i])
    if len(linear) + (scale is not None) == len(space):
        scale = None
    target = Marginal(problem, linear, x[[c.place for c in linear]], scale)
    left = [i for i, name in enumerate(space.names) if name not in target.marginalised]
    factor = np.linalg.cholesky(mode.covariance[np.ix_(left, left)])
    u = mode.u[left] + rng.standard_normal((_TRIALS, len(left))) @ factor.T
    inside = np.isfinite(target.draw(u, rng).log_weight)
    return target if np.mean(inside) >= LEAST_INSIDE else whole
