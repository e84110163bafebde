r"""Importance sampling from a mixture of Student's t about the modes: the fast path of a fit.

A posterior of many samples is nearly Gaussian in the walked coordinates. Draws of t distributions with 5 degrees of freedom
about its modes, weighted with the ratio of the densities, are then worth most of their number, and independent; a chain
needs ten or more steps for each. A share of the draws comes from a three times wider mixture, so that a tail which the modes
do not show is found. If the first draws say that the shape is off, mean and covariance of each component are fitted to the
weighted draws, a few times over [1]_; draws that served so are not used again.

Whether the weights can be trusted is judged by the tail of their distribution (`fitting.psis`); if not, nothing is returned
and a sampler has to walk. A mode that nobody found is not seen by either.

References
----------
.. [1] O. Cappé, R. Douc, A. Guillin, J.-M. Marin, C. P. Robert, "Adaptive importance sampling in general mixture classes",
   Statistics and Computing 18, 2008.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fitting import psis
from fitting.marginal import Drawn, Target
from fitting.optimum import Mode

Array = NDArray[np.float64]
FREEDOM = 5.0  # of Student's t
_WIDE, _WIDE_SHARE = 3.0, 0.05
_PILOT, _ROUNDS = 1000, 4
_GOOD, _LEAST = 0.3, 0.03  # share of draws that count: enough not to adapt, too few to go on


@dataclass(frozen=True)
class Mixture:
    """A mixture of t distributions: shares (m,), means (m, d), Cholesky factors of their scales (m, d, d)."""

    shares: Array
    means: Array
    factors: Array

    @classmethod
    def about(cls, modes: Sequence[Mode]) -> Mixture:
        """With the Laplace approximation of each mode."""
        mass = np.array([m.log_mass for m in modes])
        share = np.exp(mass - mass.max())
        scale = [np.linalg.cholesky(m.covariance) for m in modes]
        return cls(share / share.sum(), np.array([m.u for m in modes]), np.array(scale))

    def draw(self, n: int, rng: np.random.Generator) -> Array:
        """Draws, shape (n, d)."""
        pick = rng.choice(len(self.shares), size=n, p=self.shares)
        wide = np.where(rng.random(n) < _WIDE_SHARE, _WIDE, 1.0)
        stretch = wide / np.sqrt(rng.chisquare(FREEDOM, n) / FREEDOM)
        z = rng.standard_normal((n, self.means.shape[1])) * stretch[:, None]
        return np.asarray(self.means[pick] + np.einsum("nij,nj->ni", self.factors[pick], z))

    def log_densities(self, u: Array) -> Array:
        """Log density of each component times its share, shape (n, m), up to a common constant."""
        d = u.shape[1]
        out = np.empty((len(u), len(self.shares)))
        for m, (share, mean, factor) in enumerate(zip(self.shares, self.means, self.factors, strict=True)):
            inverse = np.linalg.inv(factor)
            square = np.sum(((u - mean) @ inverse.T) ** 2, axis=1)
            narrow = -0.5 * (FREEDOM + d) * np.log1p(square / FREEDOM)
            wide = -0.5 * (FREEDOM + d) * np.log1p(square / (FREEDOM * _WIDE**2)) - d * math.log(_WIDE)
            both = np.logaddexp(math.log1p(-_WIDE_SHARE) + narrow, math.log(_WIDE_SHARE) + wide)
            with np.errstate(divide="ignore"):
                out[:, m] = both - np.sum(np.log(np.diag(factor))) + np.log(share)
        return out

    def log_density(self, u: Array) -> Array:
        """Log density, shape (n,), up to a constant."""
        return np.asarray(np.logaddexp.reduce(self.log_densities(u), axis=1))

    def adapted(self, u: Array, log_weights: Array) -> Mixture:
        """The mixture with shares, means and scales of weighted draws [1]_; a component without draws stays."""
        densities = self.log_densities(u)
        share = np.exp(log_weights[:, None] + densities - np.logaddexp.reduce(densities, axis=1)[:, None])
        mass = share.sum(axis=0)
        means, factors = self.means.copy(), self.factors.copy()
        d = u.shape[1]
        for m in range(len(mass)):
            if mass[m] ** 2 < 3.0 * d * np.sum(share[:, m] ** 2):  # fewer than 3 d effective draws
                continue
            w = share[:, m] / mass[m]
            means[m] = w @ u
            apart = u - means[m]
            covariance = (w[:, None] * apart).T @ apart
            covariance += 1e-9 * np.trace(covariance) / d * np.eye(d)
            factors[m] = np.linalg.cholesky(covariance)
        return Mixture(np.maximum(mass, 1e-3) / np.maximum(mass, 1e-3).sum(), means, factors)


@dataclass(frozen=True)
class Weighted:
    """What importance sampling gave.

    Attributes
    ----------
    draws : ndarray, shape (batch, draw, d)
        All parameters in natural units, of equal weight: drawn again in proportion to the weights.
    log_posterior : ndarray, shape (batch, draw)
    k_hat : float
        Shape of the tail of the weights.
    effective : float
        What all proposals together are worth, in independent draws.
    proposals : int
    """

    draws: Array
    log_posterior: Array
    k_hat: float
    effective: float
    proposals: int


def run(target: Target, modes: Sequence[Mode], *, seed: int, effective: int = 4000, batches: int = 4) -> Weighted | None:
    """Sample a density by importance; None where it cannot be done so.

    Parameters
    ----------
    target : Target
    modes : sequence of Mode
        Of the target.
    seed : int
        Draws are a function of the seed.
    effective : int
        Effective draws wanted.
    batches : int
        Independent parts into which the draws are cut, so that they can be compared.
    """
    rng = np.random.default_rng(seed)
    proposal = Mixture.about(modes)
    used = 0
    for _ in range(_ROUNDS):
        u, log_weights, _ = _propose(target, proposal, _PILOT, rng)
        used += _PILOT
        smoothed, k_hat = psis.smooth(log_weights)
        share = float(psis.effective(smoothed)) / _PILOT if np.isfinite(log_weights).any() else 0.0
        if k_hat <= psis.GOOD and share > _GOOD:
            break
        if share * _PILOT > 2.0:
            proposal = proposal.adapted(u, smoothed)
    if not (k_hat <= psis.GOOD and share > _LEAST):
        return None
    each = math.ceil(1.15 * effective / batches / share)
    parts = [_propose(target, proposal, each, child) for child in rng.spawn(batches)]
    used += each * batches
    smoothed, k_hat = psis.smooth(np.concatenate([w for _, w, _ in parts]))
    if not k_hat <= psis.GOOD:
        return None
    count = effective // batches
    draws = np.empty((batches, count, parts[0][2].x.shape[1]))
    log_posterior = np.empty((batches, count))
    for b, (_, _, drawn) in enumerate(parts):
        chosen = _again(np.exp(smoothed[b * each : (b + 1) * each]), count, rng)
        draws[b], log_posterior[b] = drawn.x[chosen], drawn.log_posterior[chosen]
    return Weighted(draws, log_posterior, float(k_hat), float(psis.effective(smoothed)), used)


def _propose(target: Target, proposal: Mixture, n: int, rng: np.random.Generator) -> tuple[Array, Array, Drawn]:
    """Draws of the proposal, their log weights, and all parameters."""
    u = proposal.draw(n, rng)
    density, drawn = target.evaluate_and_draw(u, rng)
    return u, density - proposal.log_density(u) + drawn.log_weight, drawn


def _again(weight: Array, n: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Systematic resampling: indices, in random order; each occurs n times its share of the weight, rounded up or down."""
    at = (np.arange(n) + rng.random()) / n
    cumulative = np.cumsum(weight)
    return np.asarray(rng.permutation(np.searchsorted(cumulative, at * cumulative[-1])))
