"""Maps of so many gradients that a disk's R is read from polynomials: against the rule itself, gradient by gradient."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

import gonio
from gonio.integrate import quadtree
from gonio.integrate.grid import Gradients
from gonio.integrate.methods import _MANY
from gonio.integrate.plan import Method

Array = NDArray[np.float64]
make_brdf, make_source = gonio.brdf.make, gonio.source.make
SIDE = math.isqrt(_MANY) + 1
WIDE = math.radians(5.0)


def paint(alpha: float) -> gonio.BRDF:
    return make_brdf("lambertian", albedo=0.5) + make_brdf("ggx", k_s=1.0, alpha=alpha, f_0=0.04)


@pytest.mark.parametrize(
    ("brdf", "theta", "half_angle", "rtol"),
    [
        (paint(0.1), math.radians(40), WIDE, 1e-6),
        (paint(0.02), math.radians(70), WIDE, 1e-5),
        (paint(0.3), math.radians(110), WIDE, 1e-3),
        (make_brdf("lambertian", albedo=0.8), math.radians(25), math.radians(0.25), 1e-9),
    ],
)
def test_a_large_map_is_what_its_gradients_are_one_by_one(
    brdf: gonio.BRDF, theta: float, half_angle: float, rtol: float
) -> None:
    source = make_source("disk", theta=theta, phi=0.7, half_angle=half_angle, radiance=2.0)
    axis, rng = np.linspace(-3.0, 3.0, SIDE), np.random.default_rng(1)
    large = gonio.reflectance_map(brdf, source, axis[None, :], axis[:, None], rtol=rtol)
    assert all("polynomials" in step.reason for step in large.plan if step.method is not Method.LAMBERT)
    rows, columns = rng.integers(0, SIDE, (2, 4000))
    one = gonio.reflectance_map(brdf, source, axis[columns], axis[rows], rtol=max(1e-3 * rtol, 1e-11))
    assert not any("polynomials" in step.reason for step in one.plan)
    value, error = large.value[rows, columns], large.error[rows, columns]
    assert np.all(np.abs(value - one.value) <= error + one.error)
    assert np.all(error <= 1.001 * rtol * value)
    assert np.array_equal(value == 0.0, one.value == 0.0) and np.any(value == 0.0)


def test_the_result_does_not_depend_on_threads_and_steep_gradients_have_a_place() -> None:
    source = make_source("disk", theta=0.8, phi=-2.0, half_angle=WIDE, radiance=1.0)
    axis = np.sinh(np.linspace(-20.0, 20.0, SIDE))
    axis[-1] = math.inf
    one, two = (
        gonio.reflectance_map(paint(0.2), source, axis[None, :], 0.3 * axis[:-1, None], rtol=1e-4, threads=n) for n in (1, 2)
    )
    assert np.array_equal(one.value, two.value) and np.array_equal(one.error, two.error)
    assert np.all(np.isfinite(one.value))
    few = gonio.reflectance_map(paint(0.2), source, axis, 0.3 * axis[::-1][1:2], rtol=1e-7)
    again = gonio.reflectance_map(paint(0.2), source, axis[None, :], np.full((SIDE, 1), 0.3 * axis[-2]), rtol=1e-4)
    assert np.all(np.abs(again.value[0] - few.value) <= again.error[0] + few.error)


def test_what_no_polynomial_describes_is_left_to_the_rule() -> None:
    """A sample that jumps along a line: squares on the line stay open, none claims what it cannot know."""
    source = make_source("disk", theta=0.6, phi=0.0, half_angle=0.05, radiance=1.0)
    axis = np.linspace(-0.4, 0.4, 1024)
    grid = Gradients(axis[None, :], axis[:, None])

    def jump(p: Array, q: Array) -> tuple[Array, Array]:
        value = np.where(p > 0.1, 2.0, 1.0) + 0.1 * np.sin(p + 2.0 * q * q)
        return value, 1e-9 * value

    tree = quadtree.build(source.parts[0], 10.0, grid, jump, 1e-6)  # type: ignore[arg-type]
    value, error = np.zeros(grid.size), np.zeros(grid.size)
    left = np.concatenate([tree.add(grid, tile, 1e-6, value, error)[1] for tile in grid.tiles()])
    p, q = (np.broadcast_to(a, grid.shape).ravel() for a in (grid.p, grid.q))
    truth = np.where(p > 0.1, 2.0, 1.0) + 0.1 * np.sin(p + 2.0 * q * q)
    read = np.ones(grid.size, dtype=bool)
    read[left] = False
    assert 0.5 * grid.size < read.sum() < grid.size
    assert np.all(np.abs(value - truth)[read] <= error[read]) and np.all(error[read] <= 1e-6 * truth[read])
    assert np.all(value[left] == 0.0)
