"""Photometric stereo against Woodham's linear solution, the closed form of two sources, and its own noise."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.special import chdtri

import gonio
from gonio.errors import DatasetError, ParameterError
from gonio.maps import ReflectanceMap, Status, compute, gradients_of
from gonio.source import Source

AXIS = np.linspace(-3.0, 3.0, 97)
ALBEDO = 0.8
TILT = math.radians(35.0)
PAPER = gonio.brdf.make("lambertian", albedo=ALBEDO)
SATIN = PAPER + gonio.brdf.make("ggx", k_s=1.0, alpha=0.3, f_0=0.04)
PHIS = (0.0, math.radians(120.0), math.radians(240.0))
DIRECTIONS = np.array([[math.sin(TILT) * math.cos(f), math.sin(TILT) * math.sin(f), math.cos(TILT)] for f in PHIS])


def lamps() -> list[Source]:
    return [gonio.source.make("collimated", theta=TILT, phi=f, irradiance=math.pi) for f in PHIS]


@pytest.fixture(scope="module")
def paper() -> list[ReflectanceMap]:
    return [compute(PAPER, lamp, AXIS, AXIS)[0] for lamp in lamps()]


@pytest.fixture(scope="module")
def satin() -> list[ReflectanceMap]:
    return [compute(SATIN, lamp, AXIS, AXIS)[0] for lamp in lamps()]


def ball(n: int = 40) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gradients and normals (n, n, 3) of a ball, NaN where it is steeper than 66 degrees or not there."""
    x = np.linspace(-1.0, 1.0, n)[None, :]
    height = np.sqrt(np.where(x**2 + x.T**2 < 0.84, 1 - x**2 - x.T**2, np.nan))
    return -x / height, -x.T / height, np.stack(np.broadcast_arrays(x, x.T, height), axis=-1)


def shading(normals: np.ndarray) -> np.ndarray:
    """Lambert's law by vectors, shape (3, ...)."""
    return np.moveaxis(ALBEDO * np.maximum(0.0, normals @ DIRECTIONS.T), -1, 0)


# --- against closed forms -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("u", [None, 0.0, 1e-3])
def test_three_sources_and_woodham_s_linear_solution(paper: list[ReflectanceMap], u: float | None) -> None:
    """Where all three are lit, albedo times normal = inverse of the directions times the radiances [Woodham 1980]."""
    p, q, normals = ball()
    radiances = shading(normals)
    got = gradients_of(radiances, paper, u=u)
    there, lit = np.isfinite(p), np.all(radiances > 0.05, axis=0)
    assert np.all(got.status[there] == Status.SOLVED) and np.all(got.status[~there] == Status.UNUSABLE)
    assert np.all(got.count[there] == 1) and got.p.shape == (1, 40, 40) and np.all(np.isnan(got.p[0][~there]))
    n = np.linalg.solve(DIRECTIONS, radiances[:, lit])
    assert np.linalg.norm(n, axis=0) == pytest.approx(np.full(lit.sum(), ALBEDO))
    assert np.abs(got.p[0][lit] + n[0] / n[2]).max() < 1e-8 and np.abs(got.q[0][lit] + n[1] / n[2]).max() < 1e-8
    # in the shadow of one source the linear solution fails; the map knows the shadow
    assert np.sum(there & ~lit) > 50
    assert np.abs(got.p[0][there] - p[there]).max() < 1e-8 and np.abs(got.q[0][there] - q[there]).max() < 1e-8


def two_source_solutions(radiances: np.ndarray) -> np.ndarray:
    """All unit normals with two given Lambertian radiances, shape (2, n, 3): n = a s_1 + b s_2 +- c s_1 x s_2."""
    s_1, s_2 = DIRECTIONS[:2]
    a, b = np.linalg.solve([[1.0, s_1 @ s_2], [s_1 @ s_2, 1.0]], radiances / ALBEDO)
    plane = a[:, None] * s_1 + b[:, None] * s_2
    across = np.cross(s_1, s_2)
    c = np.sqrt(np.maximum(0.0, 1 - np.sum(plane**2, axis=1)) / (across @ across))
    return np.stack((plane + c[:, None] * across, plane - c[:, None] * across))


def test_two_sources_leave_two_gradients(paper: list[ReflectanceMap]) -> None:
    """The second is the mirror image in the plane of the two sources; it counts if it faces the viewer, within the axes."""
    rng = np.random.default_rng(2)
    p, q = rng.uniform(-1.5, 1.5, (2, 3000))
    normals = np.stack((-p, -q, np.ones_like(p)), axis=-1) / np.sqrt(1 + p * p + q * q)[:, None]
    radiances = shading(normals)[:2]
    both = two_source_solutions(radiances)
    slopes = -both[..., :2] / both[..., 2:]
    valid = (both[..., 2] > 0) & np.all(np.abs(slopes) <= 3.0, axis=-1)
    clear = np.all(radiances > 0.02, axis=0) & np.all(np.abs(np.abs(slopes) - 3.0) > 1e-6, axis=(0, 2))
    apart = np.linalg.norm(both[0] - both[1], axis=-1) > 1e-3
    use = clear & apart
    assert use.sum() > 2000 and np.sum(valid[:, use].sum(axis=0) == 2) > 800
    for u in (None, 0.0):
        got = gradients_of(radiances[:, use], paper[:2], u=u)
        assert np.all(got.status == Status.SOLVED) and np.array_equal(got.count, valid[:, use].sum(axis=0))
        expected = np.where(valid[:, use, None], slopes[:, use], np.nan)
        flatter = np.argsort(np.where(valid[:, use], np.hypot(*np.moveaxis(slopes[:, use], -1, 0)), np.inf), axis=0)
        expected = np.take_along_axis(expected, flatter[..., None], axis=0)
        assert np.stack((got.p, got.q), axis=-1) == pytest.approx(expected, abs=1e-8, nan_ok=True)


def test_two_solutions_that_are_nearly_one(paper: list[ReflectanceMap]) -> None:
    """Close to the plane of the sources the two draw together to 4e-3, a fifteenth of a cell, and stay two."""
    s_1, s_2 = DIRECTIONS[:2]
    across = np.cross(s_1, s_2) / np.linalg.norm(np.cross(s_1, s_2))
    middle = (s_1 + s_2) / np.linalg.norm(s_1 + s_2)
    n = np.array([middle + e * across for e in (2e-3, 1e-2, 0.1)])
    n /= np.linalg.norm(n, axis=1)[:, None]
    got = gradients_of(shading(n)[:2], paper[:2], u=0.0)
    assert got.count.tolist() == [2, 2, 2]
    found = np.stack((got.p, got.q), axis=-1)
    expected = -n[:, :2] / n[:, 2:]
    assert np.min(np.abs(found - expected).max(axis=-1), axis=0) == pytest.approx(np.zeros(3), abs=1e-8)


@pytest.mark.parametrize("sources", [2, 3])
def test_a_glossy_ball(satin: list[ReflectanceMap], sources: int) -> None:
    p, q, normals = ball(30)
    there = np.isfinite(p)
    radiances = np.array([one.render_normals(normals).value for one in satin[:sources]])
    got = gradients_of(radiances, satin[:sources])
    lit = np.all(shading(normals)[:sources] > 5e-3, axis=0)
    use = there & (lit if sources == 2 else True)
    assert np.all(got.status[use] == Status.SOLVED) and np.all(got.status[there & ~use] != Status.NO_SOLUTION)
    off = np.hypot(got.p - p, got.q - q)[:, use]
    assert np.nanmin(off, axis=0).max() < 1e-8
    if sources == 3:
        assert np.all(got.count[use] == 1)
    again = np.array([np.full_like(got.p, np.nan)] * sources)
    solved = np.isfinite(got.p)
    for k, one in enumerate(satin[:sources]):  # every solution, not only the right one, has the radiances
        again[k][solved] = one.evaluate(got.p[solved], got.q[solved]).value
    assert np.nanmax(np.abs(again - radiances[:, None])) < 1e-9


def test_skies_instead_of_lamps() -> None:
    """Three hemispheres with tilted axes: R = rho L (1 + n . u) / 2 (memo, 14c), linear again."""
    axis = np.linspace(-2.0, 2.0, 33)
    skies = [gonio.source.make("hemispherical", radiance=2.0, axis=tuple(d)) for d in DIRECTIONS]
    maps = [compute(PAPER, sky, axis, axis)[0] for sky in skies]
    p, q, normals = ball(12)
    flat = np.isfinite(p) & (np.abs(p) < 1.9) & (np.abs(q) < 1.9)
    got = gradients_of(np.moveaxis(ALBEDO * (1 + normals[flat] @ DIRECTIONS.T), -1, 0), maps)
    assert got.p[0] == pytest.approx(p[flat], abs=1e-8) and got.q[0] == pytest.approx(q[flat], abs=1e-8)


def test_maps_from_files_are_as_good_as_their_grid(satin: list[ReflectanceMap], tmp_path: Path) -> None:
    loaded = [ReflectanceMap.load(one.save(tmp_path / f"{k}.nc")) for k, one in enumerate(satin)]
    p, q, normals = ball(30)
    lit = np.all(shading(normals) > 0.02, axis=0)
    radiances = np.array([one.render_normals(normals[lit]).value for one in satin])
    got = gradients_of(radiances, loaded, u=0.0)
    assert np.all(got.status == Status.SOLVED) and np.all(got.count == 1)
    u_p, u_q = got.u()
    off_p, off_q = np.abs(got.p[0] - p[lit]), np.abs(got.q[0] - q[lit])
    assert np.all(off_p < 3 * u_p[0]) and np.all(off_q < 3 * u_q[0])  # the error of interpolation is part of u
    assert max(off_p.max(), off_q.max()) < 1e-3
    with pytest.raises(ParameterError, match="brdf and source"):
        gradients_of(radiances, loaded, method="integrate")


# --- uncertainty --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sources", [2, 3])
def test_the_covariance_covers_what_noise_does(satin: list[ReflectanceMap], sources: int) -> None:
    """3000 noisy copies of one pixel: the 68 and 95 % ellipses hold their share of the true gradients."""
    truth = np.array([-0.5, -0.6])
    exact = np.array([float(one.evaluate(*truth).value) for one in satin[:sources]])
    u = 0.005 * exact
    noisy = exact[:, None] + u[:, None] * np.random.default_rng(4).normal(size=(sources, 3000))
    got = gradients_of(noisy, satin[:sources], u=u[:, None])
    assert np.all(got.status == Status.SOLVED) if sources == 2 else np.mean(got.status == Status.SOLVED) > 0.997
    found = np.stack((got.p, got.q), axis=-1)
    near = np.argmin(np.nan_to_num(np.abs(found - truth).sum(axis=-1), nan=np.inf), axis=0)
    pixel = np.flatnonzero(got.status == Status.SOLVED)
    off = found[near[pixel], pixel] - truth
    squared = np.einsum("ni,nij,nj->n", off, np.linalg.inv(got.covariance[near[pixel], pixel]), off)
    for share in (0.68, 0.95):
        inside = np.mean(squared < chdtri(2, 1 - share))
        assert inside == pytest.approx(share, abs=4 * math.sqrt(share * (1 - share) / 3000))
    if sources == 3:
        assert np.mean(got.chi_squared[0][pixel]) == pytest.approx(1.0, abs=0.1)  # one degree of freedom


def test_noise_where_two_solutions_merge_is_told(satin: list[ReflectanceMap]) -> None:
    """One standard uncertainty from the fold, half of the noisy pixels have two solutions and half have none nearby."""
    exact = np.array([float(one.evaluate(0.45, -0.6).value) for one in satin[:2]])
    u = 0.005 * exact[:, None]
    noisy = exact[:, None] + u * np.random.default_rng(4).normal(size=(2, 400))
    got = gradients_of(noisy, satin[:2], u=u)
    assert np.all((got.count == 2) == (got.status == Status.SOLVED)) and 0.3 < np.mean(got.count == 2) < 0.7
    assert np.all(got.status[got.count == 0] == Status.UNDETERMINED)


def test_what_no_gradient_explains_is_no_solution_as_often_as_promised(paper: list[ReflectanceMap]) -> None:
    exact = np.array([float(one.evaluate(0.2, 0.3).value) for one in paper])
    u = np.full((3, 1), 1e-3)
    noisy = exact[:, None] + u * np.random.default_rng(7).normal(size=(3, 4000))
    for confidence in (0.9, 0.99):
        refused = np.mean(gradients_of(noisy, paper, u=u, confidence=confidence).status == Status.NO_SOLUTION)
        assert refused == pytest.approx(1 - confidence, abs=4 * math.sqrt(confidence * (1 - confidence) / 4000))


def test_the_band_of_the_maps_goes_through_their_jacobian(paper: list[ReflectanceMap]) -> None:
    """A band of 1, 2 and 3 % is a standard uncertainty of that size, whether or not the radiances have one too."""
    share = (0.01, 0.02, 0.03)
    banded = [
        dataclasses.replace(one, band=np.stack(((1 - s) * one.value, (1 + s) * one.value)))
        for one, s in zip(paper, share, strict=True)
    ]
    truth, h = np.array([0.3, 0.4]), 1e-5
    value = np.array([float(one.evaluate(*truth).value) for one in paper])
    slope = np.array(
        [
            [float(m.evaluate(*(truth + d)).value - m.evaluate(*(truth - d)).value) / (2 * h) for d in ((h, 0.0), (0.0, h))]
            for m in paper
        ]
    )
    for u in (0.0, 0.004):
        expected = np.linalg.inv(slope.T @ np.diag(1 / ((share * value) ** 2 + u**2)) @ slope)
        got = gradients_of(value, banded, u=u)
        assert got.covariance[0] == pytest.approx(expected, rel=1e-3) and got.p.shape == (1,)
    assert gradients_of(value, banded).covariance[0] == pytest.approx(
        np.linalg.inv(slope.T @ np.diag(1 / (share * value) ** 2) @ slope), rel=1e-3
    )
    assert np.all(np.isnan(gradients_of(value, paper).covariance))  # nothing is known of the uncertainty


# --- what is no measurement, and what is no problem ---------------------------------------------------------------------


def test_pixels_that_cannot_be_solved_say_why(paper: list[ReflectanceMap]) -> None:
    good = [float(one.evaluate(0.2, 0.3).value) for one in paper]
    cases = {
        Status.SOLVED: [good],
        Status.UNUSABLE: [[math.nan, *good[1:]], [math.inf, *good[1:]], [good[0], 0.95, good[2]]],
        Status.NO_SOLUTION: [
            [0.0, 0.0, 0.0],
            [0.0, 0.0, 0.3],
            [0.9, 0.1, 0.1],
            [0.8, 0.8, 0.8],
            [-0.3, *good[1:]],
            [0.3 * x for x in good],
        ],
        Status.UNDETERMINED: [[float(one.evaluate(1.65, 2.86).value) for one in paper]],  # only the third is not dark
    }
    for status, pixels in cases.items():
        for pixel in pixels:
            for u in (None, 1e-4):
                got = gradients_of(pixel, paper, u=u, saturation=0.92)
                assert got.status == status and got.count == (status is Status.SOLVED), pixel
                assert np.all(np.isnan(got.p)) == np.all(np.isnan(got.chi_squared)) == (got.count == 0)
    for u in (math.nan, -1.0, math.inf):
        assert gradients_of(good, paper, u=[u, 1e-3, 1e-3]).status == Status.UNUSABLE
    assert gradients_of(good, paper, u=5.0).status == Status.UNDETERMINED  # noise larger than the signal


def test_maps_that_tell_nothing(paper: list[ReflectanceMap]) -> None:
    """Twice the same source confines the gradient to a line; a uniform sky does not confine it."""
    value = float(paper[0].evaluate(0.2, 0.3).value)
    assert gradients_of([value, value], [paper[0], paper[0]]).status == Status.UNDETERMINED
    sky, _ = compute(PAPER, gonio.source.make("uniform", radiance=1.0), AXIS, AXIS)
    assert gradients_of([value, ALBEDO], [paper[0], sky]).status == Status.UNDETERMINED
    dark = dataclasses.replace(paper[0], value=0.0 * paper[0].value)
    with pytest.raises(DatasetError, match="dark"):
        gradients_of([value, 0.0], [paper[0], dark])


def test_shapes_and_options(paper: list[ReflectanceMap]) -> None:
    normals = ball(8)[2]
    images = shading(normals)
    whole, row = gradients_of(images, paper), gradients_of(images[:, 3], paper)
    assert whole.p.shape == (1, 8, 8) and whole.covariance.shape == (1, 8, 8, 2, 2) and whole.status.shape == (8, 8)
    assert np.array_equal(whole.p[0, 3], row.p[0], equal_nan=True)
    nothing = gradients_of(np.zeros((3, 0)), paper)
    assert nothing.p.shape == (1, 0) and nothing.count.shape == (0,)
    for wrong in ({"confidence": 1.0}, {"most": 0}, {"u": np.ones((3, 5))}, {"saturation": np.ones(4)}, {"method": "guess"}):
        with pytest.raises(ParameterError):
            gradients_of(images, paper, **wrong)
    with pytest.raises(ParameterError, match="3 maps"):
        gradients_of(images[:2], paper)
    with pytest.raises(ParameterError, match="k >= 2"):
        gradients_of(images[:1], paper[:1])
    other, _ = compute(PAPER, lamps()[0], AXIS[:-1], AXIS)
    with pytest.raises(DatasetError, match="axes"):
        gradients_of(images, [other, *paper[1:]])
