"""Bands of posteriors: against the quantiles of the maps of all draws, each made by itself."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

import gonio
from gonio.integrate import MapValues, reflectance_map
from gonio.maps.band import _quantiles, band_of
from gonio.maps.simultaneous import band_of_curves

Array = NDArray[np.float64]
make_brdf, make_source = gonio.brdf.make, gonio.source.make
AXIS = np.linspace(-2.0, 2.0, 15)
SIXTY_EIGHT = (0.16, 0.84)
SOURCES = {
    "beam": make_source("collimated", theta=0.7, phi=0.4, irradiance=2.0),
    "sky": make_source("hemispherical", radiance=1.0),
    "disk": make_source("disk", theta=0.6, phi=1.0, half_angle=0.09, radiance=3.0),
}


def rough(rng: np.random.Generator, count: int, spread: float) -> list[gonio.BRDF]:
    """Paint whose albedo, roughness, weight and reflectance scatter."""
    return [
        make_brdf("lambertian", albedo=0.4 * (1 + 0.2 * spread * a))
        + make_brdf("ggx", k_s=0.6 * (1 + 0.5 * spread * b), alpha=0.2 * np.exp(spread * c), f_0=0.05 * np.exp(spread * d))
        for a, b, c, d in np.clip(rng.normal(size=(count, 4)), -3, 3)
    ]


def each(draws: Sequence[gonio.BRDF], source: gonio.source.Source) -> Array:
    return np.array([reflectance_map(draw, source, AXIS[None, :], AXIS[:, None], rtol=1e-7).value for draw in draws])


class Counted:
    """The maps of one scene, at a tolerance; how many were asked for."""

    def __init__(self, source: gonio.source.Source, rtol: float) -> None:
        self.source, self.rtol, self.count = source, rtol, 0

    def __call__(self, brdf: gonio.BRDF) -> MapValues:
        self.count += 1
        return reflectance_map(brdf, self.source, AXIS[None, :], AXIS[:, None], rtol=self.rtol)


@pytest.mark.parametrize("name", SOURCES)
@pytest.mark.parametrize("spread", [0.03, 0.2])
def test_the_error_of_a_band_is_not_below_the_true_one(name: str, spread: float) -> None:
    draws = rough(np.random.default_rng(1), 120, spread)
    maps = Counted(SOURCES[name], 1e-4)
    band = band_of(draws, SIXTY_EIGHT, maps, rtol=1e-4)
    truth = np.quantile(each(draws, SOURCES[name]), SIXTY_EIGHT, axis=0)
    assert np.all(np.abs(band.value - truth) <= band.error + 1e-7 * truth)
    width = truth[1] - truth[0]
    assert np.all(band.error <= 0.05 * width + 3e-4 * truth[1])
    assert band.maps == maps.count <= (30 if spread < 0.1 else 60)


def test_maps_linear_in_their_parameters_are_exact_from_as_many_as_there_are_parameters() -> None:
    rng = np.random.default_rng(2)
    draws = [make_brdf("ggx", k_s=k, alpha=0.3, f_0=f) for k, f in rng.uniform(0.1, 0.9, (50, 2))]
    maps = Counted(SOURCES["beam"], 1e-6)
    band = band_of(draws, (0.0, 0.5, 1.0), maps, rtol=1e-4)
    assert maps.count == 4
    truth = np.quantile(each(draws, SOURCES["beam"]), (0.0, 0.5, 1.0), axis=0)
    assert band.value == pytest.approx(truth, rel=1e-12, abs=1e-14)
    assert np.all(band.error <= 1e-9 * truth[2])


def test_draws_of_different_forms_and_few_draws_have_maps_of_their_own() -> None:
    source, rng = SOURCES["sky"], np.random.default_rng(3)
    mixed = rough(rng, 3, 0.1) + [make_brdf("lambertian", albedo=0.5)]
    for draws in (mixed, mixed[:1], mixed[1:3], [mixed[0]] * 5):
        maps = Counted(source, 1e-6)
        band = band_of(draws, SIXTY_EIGHT, maps, rtol=1e-4)
        truth = np.quantile(each(draws, source), SIXTY_EIGHT, axis=0)
        assert np.all(np.abs(band.value - truth) <= band.error + 1e-7 * truth)
        assert np.all(band.error <= 3e-6 * truth[1])


def test_progress_rises_to_the_number_of_draws() -> None:
    seen: list[int] = []
    band_of(
        rough(np.random.default_rng(4), 40, 0.05),
        SIXTY_EIGHT,
        Counted(SOURCES["sky"], 1e-4),
        rtol=1e-4,
        progress=seen.append,
    )
    assert seen == sorted(seen) and seen[-1] == 40 and seen[0] == 1


@pytest.mark.parametrize("draws", [1, 2, 5, 64, 201])
def test_quantiles_are_those_of_numpy(draws: int) -> None:
    rng = np.random.default_rng(draws)
    weights, parts = rng.normal(size=(draws, 4)), [rng.normal(size=(5, 301)) for _ in range(4)]
    weights[draws // 2] = weights[0]  # two that are always the same
    for part in parts:
        part[1, :100] = 0.0  # all the same
    maps = np.einsum("dk,kij->dij", weights, np.array(parts))
    for wanted in (SIXTY_EIGHT, (0.0, 0.5, 1.0)):
        assert _quantiles(weights, parts, wanted) == pytest.approx(np.quantile(maps, wanted, axis=0), rel=1e-12, abs=1e-12)


def test_the_whole_band_holds_the_whole_map_of_as_many_draws_as_it_says() -> None:
    """As found by single maps of all draws; a pointwise band of 95 % holds far fewer."""
    draws = rough(np.random.default_rng(1), 200, 0.03)
    band = band_of(draws, (0.025, 0.975), Counted(SOURCES["beam"], 1e-4), rtol=1e-4)
    maps = each(draws, SOURCES["beam"])
    slack = 1e-3 * maps
    inside, pointwise = (
        np.mean(np.all((b[0] - slack <= maps) & (maps <= b[1] + slack), axis=(1, 2))) for b in (band.whole, band.value)
    )
    assert 0.94 <= inside <= 0.965
    assert pointwise < 0.93


def test_simultaneous_band_of_a_straight_line_is_scheffe_s() -> None:
    """Lines 5 + a + b x of independent unit normals a and b, over angles all round: c^2 is the chi2 quantile of 2 degrees of
    freedom (Scheffe 1953), so that the band is 5 +- 2.4477 sqrt(1 + x^2)."""
    rng = np.random.default_rng(2)
    x = np.tan(np.linspace(-1.55, 1.55, 61))
    a, b = 0.01 * rng.normal(size=(2, 4000))
    low, high = band_of_curves(5.0 + a[:, None] + b[:, None] * np.clip(x, -40, 40))
    inside = np.abs(x) < 40
    assert (high - 5.0)[inside] == pytest.approx(0.024477 * np.sqrt(1 + x**2)[inside], rel=0.05)
    assert (5.0 - low)[inside] == pytest.approx(0.024477 * np.sqrt(1 + x**2)[inside], rel=0.05)


def test_a_band_of_what_does_not_vary_is_its_value_and_none_goes_below_zero() -> None:
    curves = np.array([[0.0, 1.0, 0.1], [0.0, 1.0, 0.001], [0.0, 1.0, 0.01]])
    band = band_of_curves(curves)
    assert band[:, :2] == pytest.approx(np.array([[0.0, 1.0], [0.0, 1.0]]))
    assert band[0, 2] == 0.0 < band[1, 2]
