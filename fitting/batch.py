r"""Many small fits at once: pixels, wavelengths or materials that were seen in the same directions.

Every pixel has a posterior of its own, with the likelihood and the priors of `fitting.likelihood` and
`fitting.parameters`, and without a chain:

1. the prior is represented by a bank of parameter sets whose readings are computed once; the best of each width of lobe
   are where a pixel starts;
2. damped Gauss-Newton steps [1]_ in the unbounded coordinates, all pixels of a tile at once;
3. the Laplace approximation at the best mode, as a t distribution of 5 degrees of freedom, is the proposal of an
   importance sampling from the exact posterior, with Pareto-smoothed weights [2]_ (`fitting.psis`). So intervals are not
   those of a Gaussian. Where k-hat is above 1/2 or few draws count, the proposal is moved to the weighted mean and
   covariance and the draw is repeated.

The points of the proposal are the same for every pixel (a scrambled Sobol sequence of a fixed seed [3]_), and no step looks
at another pixel: a pixel's numbers do not depend on the tile, the process or the machine that computed it.

A pixel that this cannot do has a status above 0 (`STATUS`); `fitting.fit` can. A shared error counts in each pixel's
interval as if the pixel were alone, so errors of neighbours are correlated. Nothing is read or written here.

References
----------
.. [1] D. W. Marquardt, "An Algorithm for Least-Squares Estimation of Nonlinear Parameters", J. SIAM 11(2), 1963.
.. [2] A. Vehtari et al., "Pareto Smoothed Importance Sampling", JMLR 25(72), 2024.
.. [3] A. B. Owen, "Scrambling Sobol' and Niederreiter-Xing Points", J. Complexity 14(4), 1998.
"""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting import psis
from fitting.climbing import Mode, climb
from fitting.likelihood import Problem
from fitting.readings import Readings
from gonio import brdf
from gonio.errors import ParameterError
from gonio.samples import BRDFSamples

Array = NDArray[np.float64]
QUANTILES = (0.025, 0.16, 0.5, 0.84, 0.975)
STATUS = ("good", "no readings", "no optimum reached", "more than one mode", "weights not to be trusted")
BANK = 1024  # parameter sets that stand for the prior
STARTS = 4  # widths of lobe to start from
FREEDOM = 5.0  # of the proposal: tails heavier than a posterior's
ROUNDS = 4  # times that a proposal is moved
ENOUGH = 0.2  # effective draws over draws: a proposal that fits less well may have missed a curved valley altogether
_TOGETHER = 200_000  # expected readings that are computed together: they stay in the cache
_RIVAL = 3.0  # a second mode whose log mass is no lower than this below the best one's counts


@dataclass(frozen=True)
class Job:
    """What is fitted, the same for every pixel.

    Attributes
    ----------
    samples : BRDFSamples, of n samples
        Directions and shared errors; `u_f_r` where no other is given with the readings. Its readings only set the scale of
        the prior of ``noise.absolute``, where uncertainties are unknown.
    model : str
        Models joined by ``+``.
    free : tuple of str
    fix : mapping of str to float
    priors : mapping of str to tuple
        As in `fitting.fit`.
    shared : bool
        Infer the shared errors; False takes them as exactly 0.
    draws : int
        Per pixel.
    discrepancy : bool
        Infer a relative discrepancy of the model, too.
    """

    samples: BRDFSamples
    model: str
    free: tuple[str, ...] = ()
    fix: Mapping[str, float] = field(default_factory=dict)
    priors: Mapping[str, Sequence[object]] = field(default_factory=dict)
    shared: bool = True
    draws: int = 512
    discrepancy: bool = False

    def __post_init__(self) -> None:
        if self.draws < 64:
            raise ParameterError(f"draws = {self.draws} are too few to judge weights by; choose 64 or more")

    def digest(self) -> str:
        """A hash of all that the result depends on, but the readings."""
        options = [self.model, self.free, dict(self.fix), dict(self.priors), self.shared, self.draws, self.discrepancy]
        text = json.dumps(options, sort_keys=True, default=list)
        text += repr([(e.name, e.u, e.u_sample, e.unit) for e in self.samples.shared])
        known = hashlib.sha256(text.encode())
        for f in fields(self.samples):
            array = getattr(self.samples, f.name)
            if isinstance(array, np.ndarray):
                known.update(np.ascontiguousarray(array).tobytes())
        return known.hexdigest()

    def engine(self) -> Engine:
        """What computes, made once per process."""
        key = self.digest()
        if key not in _engines:
            _engines.clear()
            _engines[key] = Engine(self)
        return _engines[key]

    def fit(self, readings: Array, u: Array | None = None) -> Estimates:
        """Posterior of each pixel; see `Engine.fit`."""
        return self.engine().fit(readings, u)


_engines: dict[str, Engine] = {}


@dataclass(frozen=True)
class Draws:
    """Weighted draws from the posteriors of p pixels.

    Attributes
    ----------
    x : ndarray, shape (p, s, d)
        In natural units.
    log_weights : ndarray, shape (p, s)
        Normalised.
    k_hat : ndarray, shape (p,)
    mode : ndarray, shape (p, d)
        Natural values at the largest density of the unbounded coordinates.
    chi2 : ndarray, shape (p,)
        At the mode.
    used : ndarray of int, shape (p,)
        Readings that are not NaN.
    status : ndarray of int8, shape (p,)
        Place in `STATUS`.
    """

    x: Array
    log_weights: Array
    k_hat: Array
    mode: Array
    chi2: Array
    used: NDArray[np.int64]
    status: NDArray[np.int8]


@dataclass(frozen=True)
class Estimates:
    """What is kept of p posteriors of d parameters. Where there were no readings, numbers are NaN.

    Attributes
    ----------
    names : tuple of str, length d
    mean, sd, contraction : ndarray, shape (p, d)
        In natural units; contraction is 1 - variance after / before, in ln x for priors of a scale.
    quantiles : ndarray, shape (p, d, 5)
        At `QUANTILES`.
    chi2_per_n, k_hat, effective : ndarray, shape (p,)
        chi^2/N at the mode, with inferred noise counted in; shape of the weights' tail; effective number of draws.
    status : ndarray of int8, shape (p,)
        Place in `STATUS`.
    """

    names: tuple[str, ...]
    mean: Array
    sd: Array
    contraction: Array
    quantiles: Array
    chi2_per_n: Array
    k_hat: Array
    effective: Array
    status: NDArray[np.int8]

    def __len__(self) -> int:
        return len(self.status)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All arrays by name."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "names"}


class Engine:
    """Fits pixels of one job.

    Parameters
    ----------
    job : Job

    Raises
    ------
    ParameterError
        If a name of the job is unknown or a value outside its range.
    """

    def __init__(self, job: Job) -> None:
        self.job = job
        self.problem = Problem(
            job.samples, brdf.parse(job.model), free=job.free, fix=dict(job.fix), priors=dict(job.priors),
            shared=job.shared, discrepancy=job.discrepancy,
        )  # fmt: skip
        self.space = self.problem.space
        self.names = self.space.names
        self._bank = _bank(self.problem)
        self._prior_sd = np.array([q.sd() for q in self.space.priors])

    def fit(self, readings: Array, u: Array | None = None) -> Estimates:
        """Posterior of each pixel.

        Parameters
        ----------
        readings : ndarray, shape (p, n)
            f_r [1/sr]; NaN where a pixel has none.
        u : ndarray, shape (p, n), optional
            Standard random uncertainty [1/sr], in place of the job's. It is taken as it stands, so it must not have been
            computed from the noisy readings.

        Raises
        ------
        DatasetError
            If a shape is wrong, or an uncertainty of a reading is not positive.
        """
        d = self.draw(readings, u)
        weights = np.exp(d.log_weights)
        mean = np.einsum("ps,psd->pd", weights, d.x)
        sd = np.sqrt(np.einsum("ps,psd->pd", weights, (d.x - mean[:, None]) ** 2))
        quantiles = weighted_quantiles(d.x, weights, QUANTILES)
        estimates = Estimates(
            self.names, mean, sd, self._contraction(d.x, weights), quantiles, d.chi2 / np.maximum(d.used, 1),
            d.k_hat, psis.effective(d.log_weights), d.status,
        )  # fmt: skip
        for array in estimates.arrays().values():
            if array.dtype.kind == "f":
                array[d.status == STATUS.index("no readings")] = np.nan
        return estimates

    def draw(self, readings: Array, u: Array | None = None) -> Draws:
        """Weighted draws from the posterior of each pixel; parameters as for `fit`."""
        given = Readings(self.problem, readings, u)
        p, s, d = len(given), self.job.draws, len(self.space)
        mode, rival = self._best(given)
        x, log_weights, k_hat = self._weigh(given, np.arange(p), mode.u, mode.factor)
        for _ in range(ROUNDS):
            poor = np.flatnonzero(((k_hat > psis.GOOD) | (psis.effective(log_weights) < ENOUGH * s)) & (given.used > 0))
            if not len(poor):
                break
            unbounded = self.space.unbounded(x[poor].reshape(-1, d)).reshape(len(poor), s, d)
            centre, factor = _moments(unbounded, log_weights[poor])
            again = self._weigh(given, poor, centre, factor)
            better = psis.effective(again[1]) > psis.effective(log_weights[poor])
            for old, new in zip((x, log_weights, k_hat), again, strict=True):
                old[poor[better]] = new[better]
        # draws that stay within a part of the Laplace approximation have not followed a curved valley to its ends
        spread = _moments(self.space.unbounded(x.reshape(-1, d)).reshape(p, s, d), log_weights)[1]
        short = np.any((_variances(spread) < 0.5 * _variances(mode.factor)) & ~given.noise, axis=1)  # noise is folded
        status = np.zeros(p, dtype=np.int8)
        trusted = psis.limit(s)
        for name, true in (
            ("weights not to be trusted", ~(k_hat <= trusted) | (psis.effective(log_weights) < ENOUGH * s) | short),
            ("more than one mode", rival),
            ("no optimum reached", ~mode.reached & ~(k_hat <= psis.GOOD)),
            ("no readings", given.used == 0),
        ):
            status[true] = STATUS.index(name)
        natural = self.space.natural(mode.u)[0]
        chi2 = given.log_likelihood(natural, np.arange(p))[1]
        return Draws(x, log_weights, k_hat, natural, chi2, given.used, status)

    def _best(self, given: Readings) -> tuple[Mode, NDArray[np.bool_]]:
        """The mode with the most mass for each pixel, and whether another one has nearly as much."""
        p, d = len(given), len(self.space)
        groups, u, x = self._bank
        chosen = np.stack([group[given.nearest(x[group])] for group in groups], axis=1)  # (p, starts)
        k = chosen.shape[1]
        found = climb(given, self.space, u[chosen.ravel()], np.repeat(np.arange(p), k))
        mass = found.log_mass().reshape(p, k)
        best = np.argmax(mass, axis=1)
        row = np.arange(p) * k + best
        mode = found.select(row)
        at = self.space.unbounded(self.space.natural(found.u)[0]).reshape(p, k, d)  # a folded coordinate has two signs
        centre = at[np.arange(p), best]
        away = (at - centre[:, None]) * np.where(centre * mode.u < 0, -1.0, 1.0)[:, None]
        steps = np.linalg.solve(mode.factor[:, None], away[..., None])[..., 0]  # in units of the best's width
        apart = np.sqrt(np.sum(steps**2, axis=2)) > 2.0 * np.sqrt(FREEDOM)
        heavy = mass > mass[np.arange(p), best][:, None] - _RIVAL
        return mode, np.any(apart & heavy & found.reached.reshape(p, k), axis=1)

    def _weigh(self, given: Readings, pixel: NDArray[np.int64], centre: Array, factor: Array) -> tuple[Array, Array, Array]:
        """Draws x (p, s, d) from t distributions, their smoothed weights (p, s) and k-hat (p,)."""
        z, log_q = _points(len(self.space), self.job.draws)
        s, d = z.shape
        x, total = np.empty((len(pixel) * s, d)), np.empty(len(pixel) * s)
        step = max(1, _TOGETHER // len(self.job.samples))
        for a in range(0, len(total), step):
            cut = slice(a, a + step)
            row, draw = np.divmod(np.arange(a, min(a + step, len(total))), s)
            u = centre[row] + np.einsum("rij,rj->ri", factor[row], z[draw])
            x[cut], log_prior = self.space.natural(u)
            total[cut] = log_prior + given.log_likelihood(x[cut], pixel[row])[0]
        ratio = np.where(np.isfinite(total), total, -np.inf).reshape(-1, s) - log_q
        x = x.reshape(-1, s, d)
        return x, *psis.smooth(ratio)

    def _contraction(self, x: Array, weights: Array) -> Array:
        out = np.empty((len(x), len(self.names)))
        for i, q in enumerate(self.space.priors):
            value = np.log(x[:, :, i]) if q.logarithmic else x[:, :, i]
            mean = np.sum(weights * value, axis=1, keepdims=True)
            variance = np.sum(weights * (value - mean) ** 2, axis=1)
            out[:, i] = 1.0 - variance / self._prior_sd[i] ** 2
        return out


def _bank(problem: Problem) -> tuple[list[NDArray[np.int64]], Array, Array]:
    """Parameter sets for the prior, from a Sobol sequence in the unbounded coordinates: groups of places, u and x (b, d).

    Groups are by the first width of a lobe; shared errors are 0 and noise is at a guess.
    """
    from scipy.special import ndtri
    from scipy.stats import qmc

    space, d = problem.space, len(problem.space)
    u = ndtri(np.clip(qmc.Sobol(d, scramble=True, rng=np.random.default_rng(7)).random(BANK), 1e-9, 1 - 1e-9))
    for i, name in enumerate(space.names):
        if name.startswith("shared."):
            u[:, i] = 0.0
    x = space.natural(u)[0]
    width = next((i for i, q in enumerate(space.priors) if space.names[i] in problem.model_names and q.logarithmic), None)
    if width is None:
        return [np.arange(BANK)], u, x
    return [np.asarray(group) for group in np.array_split(np.argsort(x[:, width]), STARTS)], u, x


@functools.lru_cache(maxsize=8)
def _points(d: int, s: int) -> tuple[Array, Array]:
    """Points of a t distribution, (s, d), of covariance scale 1, and their log density up to a constant."""
    from scipy.special import ndtri
    from scipy.stats import chi2, qmc

    v = np.clip(qmc.Sobol(d + 1, scramble=True, rng=np.random.default_rng(11)).random(s), 1e-12, 1 - 1e-12)
    z = ndtri(v[:, :d]) * np.sqrt(FREEDOM / chi2.ppf(v[:, d:], FREEDOM))
    return z, -0.5 * (FREEDOM + d) * np.log1p(np.sum(z**2, axis=1) / FREEDOM)


def _moments(u: Array, log_weights: Array) -> tuple[Array, Array]:
    """Weighted means (p, d) and square roots of covariances (p, d, d) of u (p, s, d)."""
    w = np.exp(log_weights)
    mean = np.einsum("ps,psd->pd", w, u)
    away = u - mean[:, None]
    covariance = np.einsum("ps,psi,psj->pij", w, away, away)
    scale = np.sqrt(np.einsum("pii->pi", covariance)) + 1e-9
    correlation = covariance / (scale[:, :, None] * scale[:, None, :]) + 1e-6 * np.eye(u.shape[2])
    return mean, scale[:, :, None] * np.linalg.cholesky(correlation)


def _variances(factor: Array) -> Array:
    """Diagonals (p, d) of the covariances of square roots (p, d, d)."""
    return np.asarray(np.sum(factor**2, axis=2))


def weighted_quantiles(x: Array, weights: Array, at: Sequence[float]) -> Array:
    """Quantiles of weighted draws: x (p, s, d), weights (p, s) -> (p, d, len(at))."""
    p, _, d = x.shape
    out = np.empty((p, d, len(at)))
    order = np.argsort(x, axis=1)
    for i in range(d):
        value = np.take_along_axis(x[:, :, i], order[:, :, i], axis=1)
        w = np.take_along_axis(weights, order[:, :, i], axis=1)
        middle = np.cumsum(w, axis=1) - 0.5 * w
        for j, q in enumerate(at):
            above = np.clip(np.sum(middle < q, axis=1), 1, x.shape[1] - 1)
            row = np.arange(p)
            low, high = middle[row, above - 1], middle[row, above]
            share = np.clip((q - low) / np.maximum(high - low, 1e-300), 0.0, 1.0)
            out[:, i, j] = value[row, above - 1] + share * (value[row, above] - value[row, above - 1])
    return out
