"""Importance sampling of densities whose moments are known."""

from __future__ import annotations

import numpy as np
import pytest

from fitting import importance, psis
from fitting.marginal import Drawn
from fitting.optimum import Mode


class Density:
    """A target without data: x = u."""

    def __init__(self, density):
        self.density = density

    def evaluate_and_draw(self, u, rng):
        value = self.density(u)
        return value, Drawn(u, np.zeros(len(u)), value)


def standard(d, at=0.0, covariance=None):
    return Mode(np.full(d, float(at)), 0.0, np.eye(d) if covariance is None else covariance)


@pytest.mark.parametrize("d", [2, 3, 6])
def test_moments_of_a_gaussian_with_a_cut(d):
    """A correlated Gaussian cut at 0 along the first axis: mean sqrt(2/pi), variance 1 - 2/pi, the others as they are."""
    density = Density(lambda u: np.where(u[:, 0] > 0, -0.5 * np.sum(u**2, axis=1), -np.inf))
    found = importance.run(density, [standard(d)], seed=1, effective=8000)
    x = found.draws.reshape(-1, d)
    sd = np.full(d, 1.0)
    mean = np.zeros(d)
    mean[0], sd[0] = np.sqrt(2 / np.pi), np.sqrt(1 - 2 / np.pi)
    tolerance = 4 / np.sqrt(0.8 * found.effective)
    assert np.all(np.abs(x.mean(axis=0) - mean) < tolerance * sd)
    assert np.all(np.abs(x.std(axis=0) / sd - 1.0) < tolerance)
    assert found.k_hat <= psis.GOOD
    assert found.effective >= 8000


def test_a_poor_guess_is_adapted():
    """Covariance a tenth and a hundred times the truth, off by one sd: still the right moments."""
    covariance = np.array([[1.0, 0.9], [0.9, 1.0]])
    inverse = np.linalg.inv(covariance)
    density = Density(lambda u: -0.5 * np.einsum("ni,ij,nj->n", u, inverse, u))
    for factor in (0.1, 100.0):
        found = importance.run(density, [standard(2, 1.0, factor * np.eye(2))], seed=2)
        x = found.draws.reshape(-1, 2)
        assert np.cov(x.T) == pytest.approx(covariance, abs=0.09)
        assert np.all(np.abs(x.mean(axis=0)) < 4 / np.sqrt(0.8 * found.effective))


def test_two_modes_keep_their_shares():
    def hills(u):
        return np.logaddexp(np.log(0.2) - 0.5 * (u[:, 0] - 20) ** 2, np.log(0.8) - 0.5 * (u[:, 0] + 20) ** 2)

    found = importance.run(Density(hills), [standard(1, 20.0), standard(1, -20.0)], seed=3)
    assert np.mean(found.draws > 0) == pytest.approx(0.2, abs=4 * 0.4 / np.sqrt(found.effective))


def test_weights_that_cannot_be_trusted_are_refused():
    cauchy = Density(lambda u: -np.sum(3.0 * np.log1p(u[:, :1] ** 2 * 1e4) / 5 + 0.01 * np.log1p(u**2), axis=1))
    assert importance.run(cauchy, [standard(6, 0.0, 1e-4 * np.eye(6))], seed=1) is None
    assert importance.run(Density(lambda u: np.full(len(u), -np.inf)), [standard(2)], seed=1) is None


def test_the_seed_decides_every_draw():
    density = Density(lambda u: -0.5 * np.sum(u**2, axis=1))
    one, two, other = (importance.run(density, [standard(2)], seed=seed) for seed in (1, 1, 2))
    assert one.draws.tobytes() == two.draws.tobytes()
    assert one.draws.tobytes() != other.draws.tobytes()
