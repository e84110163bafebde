r"""Importance sampling from a mixture of Student's t about the modes: the fast path of a fit.

A posterior of many samples is nearly Gaussian in the walked coordinates. Draws of t distributions with 5 degrees of freedom
about its modes, weighted with the ratio of the densities, are then worth most of their number, and independent; a chain
needs ten or more steps for each. A share of the draws comes from a three times wider mixture, so that a tail which the modes
do not show is found. If the weights say that the shape is off, as of a curved ridge, a mixture of more components is fitted
to the draws, a few times over [1]_; draws that served so are not used again.

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
_PILOT, _ROUNDS = 1000, 7
_COPIES = 2  # draws that are kept for each that they are worth: drawing again then costs a third, not a half
_POOR = 0.25  # share of draws that count below which another proposal is fitted
_FITTED, _STEPS = 1000, 12  # draws and steps of a fit
_EACH = 10.0  # effective draws for each coordinate of a component
_MOST = 50  # proposals for each effective draw wanted


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

    @classmethod
    def fitted(cls, u: Array, count: int, rng: np.random.Generator) -> Mixture:
        """With shares, means and scales of draws u (n, d) of equal weight: expectation maximisation from a random start."""
        n, d = u.shape
        spread = np.cov(u.T).reshape(d, d)
        least = 1e-4 * spread + 1e-12 * np.trace(spread) / d * np.eye(d)  # of a component that sees copies of one draw
        means = u[rng.choice(n, count, replace=False)]
        found = cls(np.full(count, 1.0 / count), means, np.repeat(np.linalg.cholesky(spread + least)[None], count, axis=0))
        for _ in range(_STEPS):
            densities = found.log_densities(u)
            part = np.exp(densities - np.logaddexp.reduce(densities, axis=1)[:, None])
            mass = part.sum(axis=0) + 1e-9
            means = (part.T @ u) / mass[:, None]
            apart = u[:, None, :] - means  # (n, m, d)
            scale = np.einsum("nm,nmi,nmj->mij", part, apart, apart) / mass[:, None, None] + least
            found = cls(mass / mass.sum(), means, np.linalg.cholesky(scale))
        return found


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
    proposal, used, n = Mixture.about(modes), 0, _PILOT
    for number in range(_ROUNDS):
        each = math.ceil(n / batches)
        parts = [_propose(target, proposal, each, child) for child in rng.spawn(batches)]
        used += each * batches
        log_weights = np.concatenate([w for _, w, _ in parts])
        smoothed, k_hat = psis.smooth(log_weights)
        worth = float(psis.effective(smoothed)) if np.isfinite(log_weights).any() else 0.0
        if k_hat <= psis.GOOD and worth >= effective:
            return _collected(parts, smoothed, _COPIES * effective // batches, float(k_hat), worth, used, rng)
        if worth == 0.0:
            return None
        share = worth / (each * batches)
        if k_hat > psis.GOOD or share < _POOR:
            u = np.concatenate([u for u, _, _ in parts])
            # a component needs draws that are not copies of a few
            levelled = _levelled(smoothed, _EACH * u.shape[1])
            most = int(float(psis.effective(levelled)) / (_EACH * u.shape[1]))
            u = u[_again(np.exp(levelled), _FITTED, rng)]
            proposal = Mixture.fitted(u, max(1, min(len(modes) + number, most)), rng)
        # as many as are needed if the next proposal is as good as this one or one of `_POOR`
        n = min(math.ceil(1.2 * effective / max(share, _POOR)), 2 * n if k_hat > psis.GOOD else _MOST * effective)
    return None


def _collected(
    parts: Sequence[tuple[Array, Array, Drawn]], smoothed: Array, count: int, k_hat: float, worth: float, used: int,
    rng: np.random.Generator,
) -> Weighted:  # fmt: skip
    """`count` draws of equal weight from each part."""
    each = len(parts[0][1])
    chosen = [_again(np.exp(smoothed[b * each : (b + 1) * each]), count, rng) for b in range(len(parts))]
    draws = np.array([drawn.x[rows] for (_, _, drawn), rows in zip(parts, chosen, strict=True)])
    log_posterior = np.array([drawn.log_posterior[rows] for (_, _, drawn), rows in zip(parts, chosen, strict=True)])
    return Weighted(draws, log_posterior, k_hat, worth, used)


def _propose(target: Target, proposal: Mixture, n: int, rng: np.random.Generator) -> tuple[Array, Array, Drawn]:
    """Draws of the proposal, their log weights, and all parameters."""
    u = proposal.draw(n, rng)
    density, drawn = target.evaluate_and_draw(u, rng)
    return u, density - proposal.log_density(u) + drawn.log_weight, drawn


def _levelled(log_weights: Array, least: float) -> Array:
    """Normalised log weights, raised to a power below 1 if they are worth less than `least` draws: then just that many."""
    power = 1.0
    out = log_weights
    while float(psis.effective(out)) < least and power > 1e-6:
        power *= 0.8
        out = power * log_weights
        out = out - np.logaddexp.reduce(out)
    return np.asarray(out)


def _again(weight: Array, n: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Systematic resampling: indices, in random order; each occurs n times its share of the weight, rounded up or down."""
    at = (np.arange(n) + rng.random()) / n
    cumulative = np.cumsum(weight)
    return np.asarray(rng.permutation(np.searchsorted(cumulative, at * cumulative[-1])))
