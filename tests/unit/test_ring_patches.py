"""Reading a map from patches: against the series it was made of, at the bound that comes with it; and what is left over."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from gonio.integrate.grid import Gradients
from gonio.integrate.ring_patches import Room, Table, patches

Array = NDArray[np.float64]
LOWER, UPPER = 0.2, 0.7


def made_up_series(waves: int) -> Array:
    """Sixteen terms in tau that fall to 1e-7, waves that fall to 1e-7."""
    rng = np.random.default_rng(waves)
    amplitude = np.exp(-16.0 * np.arange(waves) / waves)[None, None] * 10.0 ** (-7.0 * np.arange(16) / 15.0)[:, None, None]
    series = rng.normal(size=(16, 2, waves)) * amplitude
    series[0, 0, 0], series[:, 1, 0] = 5.0, 0.0
    return np.asarray(series)


def exact(series: Array, tau: Array, phi: Array) -> Array:
    x = (2.0 * tau - LOWER - UPPER) / (UPPER - LOWER)
    waves = np.einsum("nk,kpm->npm", np.polynomial.chebyshev.chebvander(x, 15), series)
    turns = np.outer(phi, np.arange(series.shape[2]))
    return np.asarray((waves[:, 0] * np.cos(turns) + waves[:, 1] * np.sin(turns)).sum(axis=1))


def gradients(tau: Array, phi: Array) -> Gradients:
    slope = 2.0 * tau / (1.0 - tau * tau)
    return Gradients(-slope * np.cos(phi), -slope * np.sin(phi))


@pytest.mark.parametrize("waves", [3, 17, 60])
@pytest.mark.parametrize("negligible", [1e-3, 1e-6, 1e-9])
def test_values_are_within_the_bound(waves: int, negligible: float) -> None:
    series, rng = made_up_series(waves), np.random.default_rng(1)
    tau, phi = rng.uniform(LOWER, UPPER, 3000), rng.uniform(-math.pi, math.pi, 3000)
    tau[:2], phi[2:6] = (LOWER, UPPER), (0.0, math.pi, -math.pi, 0.5 * math.pi)
    piece = patches(series, negligible)
    assert piece.error <= negligible
    table = Table.of(np.array([LOWER, UPPER]), np.array([piece.error]), [piece])
    value, error = np.zeros(3000), np.zeros(3000)
    table.add(gradients(tau, phi), (0, 3000), 1.0, 0.0, value, error)
    assert np.max(np.abs(value - exact(series, tau, phi))) <= piece.error + 1e-13
    assert np.all(error == piece.error)


def test_pieces_of_different_resolution_and_what_misses_the_tolerance() -> None:
    series, middle = made_up_series(20), 0.5 * (LOWER + UPPER)
    x = np.cos(np.pi * (np.arange(16) + 0.5) / 16)
    inverse = np.linalg.inv(np.polynomial.chebyshev.chebvander(x, 15))
    halves = [
        np.tensordot(inverse @ np.polynomial.chebyshev.chebvander(0.5 * (x + side), 15), series, axes=1) for side in (-1, 1)
    ]
    table = Table.of(
        np.array([LOWER, middle, UPPER]), np.array([1e-9, 1e-2]), [patches(halves[0], 1e-9), patches(halves[1], 1e-2)]
    )
    tau, phi = np.linspace(LOWER, UPPER, 501), np.linspace(-9.0, 9.0, 501)
    value, error = np.full(501, 3.0), np.full(501, 1e-6)
    worst, missed = table.add(gradients(tau, phi), (0, 501), 1e-3, 0.0, value, error)
    assert missed.size and np.all(value[missed] == 3.0) and np.all(error[missed] == 1e-6)
    rest, its_error = value[missed], error[missed]
    table.add(gradients(tau[missed], phi[missed]), (0, missed.size), 1e-3, math.inf, rest, its_error)
    value[missed], error[missed] = rest, its_error
    off = np.abs(value - 3.0 - exact(series, tau, phi))
    assert np.all(off <= error)
    expected = np.flatnonzero((tau > middle) & (1e-3 * np.maximum(np.abs(value - 3.0), 0.5 * 3.0) < 1e-2))
    assert np.array_equal(missed, expected)
    assert worst < 1e-3


def test_steep_and_flat_gradients() -> None:
    """0, tiny, huge and infinite slopes: azimuth and tau stay finite, and are those of the limit."""
    piece = patches(made_up_series(9), 1e-9)
    table = Table.of(np.array([0.0, 1.0]), np.array([piece.error]), [piece])
    p = np.array([1e-320, 1e8, 1e150, math.inf, 1e308, -math.inf, 0.0, 2.0, 2.0])
    q = np.array([0.0, 1e8, 1e150, 5.0, 1e308, -1.0, -1e200, 0.0, 0.0])
    value, error = np.zeros(9), np.zeros(9)
    table.add(Gradients(p, q), (0, 9), 1.0, 0.0, value, error)
    assert np.all(np.isfinite(value))
    assert value[1] == pytest.approx(value[2], abs=1e-6) and value[2] == pytest.approx(value[4], abs=1e-9)
    other = np.zeros(3)
    table.add(Gradients(np.array([1e12, -1e12, 0.0]), np.array([0.0, 0.0, -1e12])), (0, 3), 1.0, 0.0, other, np.zeros(3))
    assert np.allclose(value[[3, 5, 6]], other, rtol=0.0, atol=1e-9)


def test_room_knows_the_range_and_the_least_tolerance() -> None:
    axis = np.linspace(-2.0, 2.0, 64)
    grid = Gradients(axis[None, :], axis[:, None])
    slope = np.hypot(grid.p, grid.q).ravel()
    tau = slope / (1.0 + np.sqrt(1.0 + slope**2))
    value, error = 1.0 + slope, np.full(grid.size, 1e-7)
    room = Room(grid, 1e-4, 1e-6, value, error, 1)
    assert room.lowest == pytest.approx(tau.min(), rel=1e-14) and room.highest == pytest.approx(tau.max(), rel=1e-14)
    spare = np.maximum(1e-6, 0.5 * (1e-4 * value - error))
    inside = (tau > 0.3) & (tau < 0.4)
    assert room.smallest(0.3, 0.4) == pytest.approx(spare[inside].min(), rel=0.02)
