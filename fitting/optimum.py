r"""The modes of a posterior: many starts, least squares, Newton, and the Laplace approximation at each.

The likelihood of a narrow lobe has local maxima: a lobe between the sampled directions fits nothing. So least squares
starts from several widths, ln alpha = -4 to -0.3, each with the best of many prior draws of the other parameters. The linear
coefficients are no unknowns of it: for any others they are solved for, within their ranges (variable projection [1]_). The
exact posterior (variance of the model, priors, Jacobians) is then climbed from each solution by damped Newton steps with
finite differences. All trial points of a step are evaluated in one call of the compiled likelihood.

This finds where to start and how wide; it is no substitute for sampling.

References
----------
.. [1] G. H. Golub, V. Pereyra, SIAM J. Numer. Anal. 10(2), 1973; D. P. O'Leary, B. W. Rust, Comput. Optim. Appl. 54, 2013.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fitting.likelihood import SCALE, Problem
from fitting.linear import coefficients, columns, products, solve_in_box
from gonio.errors import ConvergenceError

Array = NDArray[np.float64]
LN_WIDTHS = (-4.0, -3.0, -2.0, -1.0, -0.3)
PRIOR_DRAWS = 256
WIDEST = 1.5
_EDGE = 6.0


@dataclass(frozen=True)
class Mode:
    """One maximum of the posterior density of u.

    Attributes
    ----------
    u : ndarray, shape (d,)
    log_probability : float
    covariance : ndarray, shape (d, d)
        Laplace approximation, in u.
    """

    u: Array
    log_probability: float
    covariance: Array

    @property
    def log_mass(self) -> float:
        """Logarithm of the probability under the mode, up to a constant common to all modes."""
        return self.log_probability + 0.5 * float(np.linalg.slogdet(self.covariance)[1])


def find(problem: Problem, rng: np.random.Generator, *, ratio: float = 10.0, most: int = 4) -> tuple[Mode, ...]:
    """Modes of the posterior, the one with the most mass first.

    Parameters
    ----------
    problem : Problem
    rng : numpy.random.Generator
    ratio : float
        Modes whose log mass is lower than the best one's by more than this are left out.
    most : int
        Number of distinct least-squares solutions that are climbed.

    Raises
    ------
    ConvergenceError
        If the posterior density is zero wherever it was tried; the message names the parameter or the sample.
    """
    projected = _Projected(problem)
    solutions = sorted((projected.least_squares(v) for v in projected.starts(rng)), key=lambda s: s[0])
    distinct: list[Array] = []
    for cost, u in solutions:
        if cost <= 20.0 * solutions[0][0] + 20.0 and all(np.max(np.abs(u - v)) > 0.05 for v in distinct):
            distinct.append(u)
    tops = [_noise_start(problem, u) for u in distinct[:most]]
    modes = [climb(problem.log_probability, u, _first_scale(problem, u)) for u in tops]
    found = _best(modes, ratio)
    if not found:
        raise ConvergenceError(_blame(problem, distinct[0]))
    return found


def _best(modes: list[Mode | None], ratio: float) -> tuple[Mode, ...]:
    """Those with enough mass, without repetitions, the one with the most mass first."""
    reached = sorted((m for m in modes if m is not None), key=lambda m: -m.log_mass)
    kept: list[Mode] = []
    for m in reached:
        apart = (_distance(m, k) > 1.0 for k in kept)
        if m.log_mass >= reached[0].log_mass - ratio and all(apart):
            kept.append(m)
    return tuple(kept)


def _distance(m: Mode, k: Mode) -> float:
    step = m.u - k.u
    return math.sqrt(float(step @ np.linalg.solve(k.covariance, step)))


def project(modes: Sequence[Mode], kept: list[int], density: Callable[[Array], Array]) -> tuple[Mode, ...]:
    """Modes of a density of some of the coordinates, starting from the modes of all; at least one, the best first."""
    starts = [(m.u[kept], m.covariance[np.ix_(kept, kept)]) for m in modes]
    found = [climb(density, u, np.asarray(np.linalg.cholesky(covariance))) for u, covariance in starts]
    return _best(found, 10.0) or tuple(Mode(u, 0.0, covariance) for u, covariance in starts[:1])


class _Projected:
    """The least-squares problem of the parameters that are not linear."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        priors = problem.space.priors
        self.linear = coefficients(problem, lambda i: priors[i].bounded)
        self.space = problem.space.without([c.name for c in self.linear])
        self._bounds = tuple(np.array([getattr(priors[c.place], key) for c in self.linear]) for key in ("lower", "upper"))
        self._weight = _weights(problem)
        self._shared = np.array([name.startswith("shared.") for name in self.space.names], dtype=bool)

    def _solved(self, full: Array) -> tuple[Array, ...]:
        lower, upper = self._bounds
        made = products(self.problem, self.linear, full, lower, self.problem.samples.f_r, self._weight)
        return solve_in_box(np.nan_to_num(made, nan=1e100, posinf=1e100, neginf=-1e100), lower, lower, upper)

    def _pull(self, u: Array) -> Array:
        """Of the priors on shared errors; a weak one keeps the others finite."""
        return np.asarray(np.where(self._shared, 1.0, 0.05) * u)

    def starts(self, rng: np.random.Generator) -> list[Array]:
        """One start per combination of widths: the best of many prior draws with those widths."""
        names, priors = self.space.names, self.space.priors
        if not names:
            return [np.empty(0)]
        width = [
            i for i, (name, q) in enumerate(zip(names, priors, strict=True))
            if name in self.problem.model_names and (q.logarithmic or name.endswith(".alpha"))
        ]  # fmt: skip
        combinations = list(itertools.product(LN_WIDTHS, repeat=len(width)))
        if len(combinations) > 16:
            combinations = [combinations[i] for i in sorted(rng.choice(len(combinations), 16, replace=False))]
        found = []
        for combination in combinations:
            x = self.space.draw(rng, PRIOR_DRAWS)
            for i, name in enumerate(names):
                if name not in self.problem.model_names:  # shared errors start at 0, noise at a guess
                    x[:, i] = 0.0 if self._shared[i] else _guess(self.problem, name)
            for i, ln_width in zip(width, combination, strict=True):
                q = priors[i]
                value = math.exp(ln_width)
                x[:, i] = value if q.lower < value < q.upper else q.draw(rng, PRIOR_DRAWS)
            u = self.space.unbounded(x)
            left = self.problem.in_parts(self._solved, self.space.full(x))[1]
            cost = left + np.sum(self._pull(u) ** 2, axis=1)
            found.append(np.clip(u[int(np.argmin(np.where(np.isfinite(cost), cost, np.inf)))], -_EDGE, _EDGE))
        return found

    def _residuals(self, u: Array) -> Array:
        """(w, n + d): weighted residuals with the best coefficients, and the pull of the priors."""
        x, _ = self.space.natural(u)
        c = self.problem.in_parts(self._solved, self.space.full(x))[0]
        known, by = columns(self.problem, self.linear, self.space.full(x))
        residual = (self.problem.samples.f_r - known - np.einsum("wnk,wk->wn", by, c)) * self._weight
        both = np.concatenate((residual, self._pull(u)), axis=1)
        return np.asarray(np.nan_to_num(both, nan=1e10, posinf=1e10, neginf=-1e10))

    def least_squares(self, start: Array) -> tuple[float, Array]:
        """Least sum of squares from a start, and all parameters of the problem there, unbounded."""
        from scipy.optimize import least_squares

        d, h = len(start), 1e-5

        def jacobian(u: Array) -> Array:
            r = self._residuals(np.vstack((u + h * np.eye(d), u - h * np.eye(d))))
            return np.asarray((r[:d] - r[d:]).T / (2 * h))

        at, cost = start, 0.5 * float(np.sum(self._residuals(start[None]) ** 2))
        if d:
            found = least_squares(
                lambda u: self._residuals(u[None])[0], start, jac=jacobian, bounds=(-_EDGE - 1, _EDGE + 1), max_nfev=60
            )
            at, cost = found.x, float(found.cost)
        x = np.empty((1, len(self.problem.space)))
        places = [c.place for c in self.linear]
        others, _ = self.space.natural(at[None])
        x[:, [i for i in range(x.shape[1]) if i not in places]] = others
        x[:, places] = self._solved(self.space.full(others))[0]
        u = np.clip(self.problem.space.unbounded(x), -_EDGE, _EDGE)[0]
        u[[i for i in range(x.shape[1]) if i not in places]] = at
        return 2.0 * cost, u


def _guess(problem: Problem, name: str) -> float:
    q = problem.space.priors[problem.space.names.index(name)]
    values = {"noise.relative": 0.05, "noise.discrepancy": 0.02, SCALE: 1.0}
    value = values.get(name, 0.01 * q.b)
    return min(max(value, q.lower), q.upper)


def _weights(problem: Problem) -> Array:
    """One over a rough standard deviation of each reading; for the start only, the likelihood never uses readings so."""
    y, u = problem.samples.f_r, problem.samples.u_f_r
    floor = 0.01 * float(np.sqrt(np.mean(y**2)))
    sigma = np.hypot(np.where(np.isnan(u), floor, u), 0.05 * np.abs(y))
    return np.asarray(1.0 / np.where(sigma > 0, sigma, 1.0))


def _residuals(problem: Problem, u: Array) -> Array:
    """(w, n + d): weighted residuals and the pull of the priors on shared errors; a weak pull keeps the others finite."""
    x, _ = problem.space.natural(u)
    pull = np.where([name.startswith("shared.") for name in problem.space.names], 1.0, 0.05)
    residual = (problem.samples.f_r - problem.predict(x)[0]) * _weights(problem)
    return np.nan_to_num(np.concatenate((residual, pull * u), axis=1), nan=1e10, posinf=1e10, neginf=-1e10)


def _noise_start(problem: Problem, u: Array) -> Array:
    """Put the noise parameters on the best point of a coarse grid; the rest stays."""
    space = problem.space
    noise = [i for i, name in enumerate(space.names) if name.startswith("noise.")]
    if not noise:
        return u
    levels = [np.geomspace(max(space.priors[i].lower, 1e-9) * 1.5, space.priors[i].upper * 0.7, 12) for i in noise]
    grid = np.array(list(itertools.product(*levels)))
    x = np.repeat(space.natural(u[None])[0], len(grid), axis=0)
    x[:, noise] = grid
    trial = space.unbounded(x)
    others = [i for i in range(len(u)) if i not in noise]
    trial[:, others] = u[others]
    return np.asarray(trial[int(np.argmax(problem.log_probability(trial)))])


def climb(density: Callable[[Array], Array], u: Array, scale: Array, iterations: int = 60) -> Mode | None:
    """Damped Newton on a log density, in coordinates scaled to its width; None where the density is zero.

    Parameters
    ----------
    density : callable
        (w, d) -> (w,).
    u : ndarray, shape (d,)
        Start.
    scale : ndarray, shape (d, d)
        Square root of a guess at the covariance.
    """
    d = len(u)
    value = float(density(u[None])[0])
    if not math.isfinite(value):
        return None
    damping = np.concatenate(([0.0], np.geomspace(1e-2, 1e4, 7)))
    shrink = np.array([2.0, 1.0, 0.5, 0.25, 0.1, 0.03])
    for iteration in range(iterations):
        gradient, hessian = _derivatives(density, u, scale, value)
        w, q = np.linalg.eigh(-hessian)
        steps = []
        for lam in damping:
            curvature = np.maximum(np.abs(w), 1e-3) + lam
            steps.append(q @ ((q.T @ gradient) / curvature))
        z = (np.array(steps)[:, None, :] * shrink[None, :, None]).reshape(-1, d)
        length = np.linalg.norm(z, axis=1, keepdims=True)
        z *= np.minimum(1.0, 30.0 / np.maximum(length, 1e-300))
        trial = np.clip(u + z @ scale.T, -40.0, 40.0)
        found = density(trial)
        best = int(np.argmax(found))
        gain = float(found[best]) - value
        if gain > 0:
            u, value = trial[best], float(found[best])
        scale = scale @ (q / np.sqrt(np.clip(w, 0.05, 1e6)))  # unit curvature next time
        scale = _bounded(scale)
        if gain < 1e-3 and np.all(np.abs(w - 1.0) < 0.5):
            break
        if gain <= 0 and iteration > 20:
            break
    _, hessian = _derivatives(density, u, scale, value)
    w, q = np.linalg.eigh(-hessian)
    factor = _bounded(scale @ (q / np.sqrt(np.clip(w, 0.05, 1e6))))
    return Mode(u, value, factor @ factor.T)


def _first_scale(problem: Problem, u: Array) -> Array:
    """Square root of a covariance from the least-squares Jacobian; noise parameters get 0.3 of their size."""
    d, h = len(u), 1e-4
    r = _residuals(problem, np.vstack((u + h * np.eye(d), u - h * np.eye(d))))
    jacobian = (r[:d] - r[d:]).T / (2 * h)
    normal = jacobian.T @ jacobian
    noise = np.array([name.startswith("noise.") for name in problem.space.names])
    normal[noise] = normal[:, noise] = 0.0
    normal += np.diag(np.where(noise, 10.0 / np.maximum(np.abs(u), 1e-6) ** 2, 1e-2))
    w, q = np.linalg.eigh(normal)
    return _bounded(q / np.sqrt(np.maximum(w, 1e-12)))


def _bounded(scale: Array) -> Array:
    """The same ellipsoid with no axis longer than `WIDEST`."""
    a, s, b = np.linalg.svd(scale)
    return np.asarray((a * np.minimum(s, WIDEST)) @ b)


def _derivatives(density: Callable[[Array], Array], u: Array, scale: Array, value: float) -> tuple[Array, Array]:
    """Gradient and Hessian of the log posterior in z, u + scale z, by central differences on the scale of its width."""
    d, h = len(u), 0.2
    pairs = [(i, j) for i in range(d) for j in range(i)]
    eye = h * np.eye(d)
    corners = np.array([eye[i] + eye[j] for i, j in pairs]).reshape(-1, d)
    z = np.vstack((eye, -eye, corners, -corners))
    f = density(u + z @ scale.T)
    f = np.where(np.isfinite(f), f, value - 1e6)
    plus, minus = f[:d], f[d : 2 * d]
    gradient = (plus - minus) / (2 * h)
    hessian = np.diag((plus + minus - 2 * value) / h**2)
    m = len(pairs)
    for (i, j), pp, mm in zip(pairs, f[2 * d : 2 * d + m], f[2 * d + m :], strict=True):
        mixed = (pp + mm - plus[i] - minus[i] - plus[j] - minus[j] + 2 * value) / (2 * h**2)
        hessian[i, j] = hessian[j, i] = mixed
    return np.asarray(gradient), hessian


def _blame(problem: Problem, u: Array) -> str:
    """Which parameter or sample makes the posterior density zero at u."""
    x, log_prior = problem.space.natural(u[None])
    if not np.isfinite(log_prior[0]):
        for name, q, value in zip(problem.space.names, problem.space.priors, x[0], strict=True):
            if not np.isfinite(q.log_density(np.array([value]))[0]):
                return f"no start is possible: the prior of {name} is zero at {value:g}; widen it or fix the parameter"
    mean, var = problem.predict(x)
    y = problem.samples.f_r
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        term = (y - mean[0]) ** 2 / var[0]
    worst = int(np.argmax(np.where(np.isfinite(term), term, np.inf)))
    named = max(problem.model_names, key=lambda name: _leverage(problem, u, worst, name))
    return (
        f"no start is possible: with {named} = {x[0][problem.space.names.index(named)]:g} sample {worst} should read "
        f"{mean[0, worst]:g} 1/sr and reads {y[worst]:g} 1/sr; check the sample or fix {named}"
    )


def _leverage(problem: Problem, u: Array, sample: int, name: str) -> float:
    i = problem.space.names.index(name)
    moved = np.repeat(u[None], 2, axis=0)
    moved[1, i] += 0.1
    mean = problem.predict(problem.space.natural(moved)[0])[0][:, sample]
    change = abs(float(mean[1] - mean[0]))
    return change if math.isfinite(change) else math.inf
