r"""The modes of a posterior: many starts, least squares, Newton, and the Laplace approximation at each.

The likelihood of a narrow lobe has local maxima: a lobe between the sampled directions fits nothing. So least squares
starts from several widths, ln alpha = -4 to -1, each with the best of many prior draws of the other parameters; the exact
posterior (variance of the model, priors, Jacobians) is then climbed from each by damped Newton steps with finite
differences. All trial points of a step are evaluated in one call of the compiled likelihood.

This finds where to start and how wide; it is no substitute for sampling.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fitting.likelihood import Problem
from gonio.errors import ConvergenceError

Array = NDArray[np.float64]
LN_WIDTHS = (-4.0, -3.0, -2.0, -1.0)
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
    solutions = sorted((_least_squares(problem, u) for u in _starts(problem, rng)), key=lambda s: s[0])
    distinct: list[Array] = []
    for cost, u in solutions:
        if cost <= 20.0 * solutions[0][0] + 20.0 and all(np.max(np.abs(u - v)) > 0.05 for v in distinct):
            distinct.append(u)
    modes = [_climb(problem, _noise_start(problem, u)) for u in distinct[:most]]
    reached = sorted((m for m in modes if m is not None), key=lambda m: -m.log_mass)
    if not reached:
        raise ConvergenceError(_blame(problem, distinct[0]))
    kept: list[Mode] = []
    for m in reached:
        apart = (_distance(m, k) > 1.0 for k in kept)
        if m.log_mass >= reached[0].log_mass - ratio and all(apart):
            kept.append(m)
    return tuple(kept)


def _distance(m: Mode, k: Mode) -> float:
    step = m.u - k.u
    return math.sqrt(float(step @ np.linalg.solve(k.covariance, step)))


def _starts(problem: Problem, rng: np.random.Generator) -> list[Array]:
    """One start per combination of widths: the best of many prior draws with those widths."""
    space = problem.space
    width = [
        i
        for i, (name, q) in enumerate(zip(space.names, space.priors, strict=True))
        if name in problem.model_names and (q.logarithmic or name.endswith(".alpha"))
    ]
    combinations = list(itertools.product(LN_WIDTHS, repeat=len(width)))
    if len(combinations) > 16:
        combinations = [combinations[i] for i in sorted(rng.choice(len(combinations), 16, replace=False))]
    starts = []
    for combination in combinations:
        x = space.draw(rng, PRIOR_DRAWS)
        for i, name in enumerate(space.names):
            if name not in problem.model_names:  # shared errors start at 0, noise at a guess
                x[:, i] = 0.0 if name.startswith("shared.") else _guess(problem, name)
        for i, ln_width in zip(width, combination, strict=True):
            q = space.priors[i]
            value = math.exp(ln_width)
            x[:, i] = value if q.lower < value < q.upper else q.draw(rng, PRIOR_DRAWS)
        u = space.unbounded(x)
        cost = np.sum(_residuals(problem, u) ** 2, axis=1)
        starts.append(np.clip(u[int(np.argmin(np.where(np.isfinite(cost), cost, np.inf)))], -_EDGE, _EDGE))
    return starts


def _guess(problem: Problem, name: str) -> float:
    q = problem.space.priors[problem.space.names.index(name)]
    value = 0.05 if name == "noise.relative" else 0.02 if name == "noise.discrepancy" else 0.01 * q.b
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


def _least_squares(problem: Problem, start: Array) -> tuple[float, Array]:
    from scipy.optimize import least_squares

    d, h = len(start), 1e-5

    def jacobian(u: Array) -> Array:
        r = _residuals(problem, np.vstack((u + h * np.eye(d), u - h * np.eye(d))))
        return np.asarray((r[:d] - r[d:]).T / (2 * h))

    found = least_squares(
        lambda u: _residuals(problem, u[None])[0], start, jac=jacobian, bounds=(-_EDGE - 1, _EDGE + 1), max_nfev=60
    )
    return float(2 * found.cost), np.asarray(found.x)


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


def _climb(problem: Problem, u: Array, iterations: int = 60) -> Mode | None:
    """Damped Newton on the exact log posterior, in coordinates scaled to its width; None where its density is zero."""
    d = len(u)
    value = float(problem.log_probability(u[None])[0])
    if not math.isfinite(value):
        return None
    scale = _first_scale(problem, u)
    damping = np.concatenate(([0.0], np.geomspace(1e-2, 1e4, 7)))
    shrink = np.array([2.0, 1.0, 0.5, 0.25, 0.1, 0.03])
    for iteration in range(iterations):
        gradient, hessian = _derivatives(problem, u, scale, value)
        w, q = np.linalg.eigh(-hessian)
        steps = []
        for lam in damping:
            curvature = np.maximum(np.abs(w), 1e-3) + lam
            steps.append(q @ ((q.T @ gradient) / curvature))
        z = (np.array(steps)[:, None, :] * shrink[None, :, None]).reshape(-1, d)
        length = np.linalg.norm(z, axis=1, keepdims=True)
        z *= np.minimum(1.0, 30.0 / np.maximum(length, 1e-300))
        trial = np.clip(u + z @ scale.T, -40.0, 40.0)
        found = problem.log_probability(trial)
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
    _, hessian = _derivatives(problem, u, scale, value)
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


def _derivatives(problem: Problem, u: Array, scale: Array, value: float) -> tuple[Array, Array]:
    """Gradient and Hessian of the log posterior in z, u + scale z, by central differences on the scale of its width."""
    d, h = len(u), 0.2
    pairs = [(i, j) for i in range(d) for j in range(i)]
    eye = h * np.eye(d)
    corners = np.array([eye[i] + eye[j] for i, j in pairs]).reshape(-1, d)
    z = np.vstack((eye, -eye, corners, -corners))
    f = problem.log_probability(u + z @ scale.T)
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
