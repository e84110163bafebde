"""Kubelka and Munk's layer: 40 digits, Saunderson's limits, refusals."""

from __future__ import annotations

import math

import mpmath
import pytest
from hypothesis import given, settings
from mpmath import mpf, pi

import gonio
from tests.brdf_truth import Geometry, check_refusals, compare, largest_albedo, parameter_sets, reciprocity

make = gonio.brdf.make


def kubelka_munk(g: Geometry, K_over_S: mpf, k_1: float = 0, k_2: float = 0) -> mpf:
    """Kubelka 1948, R_inf = a - b with a = 1 + K/S; Saunderson 1942."""
    a = 1 + K_over_S
    inner = a - mpmath.sqrt(a * a - 1)
    return (k_1 + (1 - k_1) * (1 - k_2) * inner / (1 - k_2 * inner)) / pi


def test_at_forty_digits() -> None:
    plain = [{"K_over_S": k} for k in (0.0, 1e-12, 1e-4, 0.1, 1.0, 1e5, 1e8)]
    coated = [
        {"K_over_S": k, "k_1": k_1, "k_2": k_2}
        for k in (0.0, 1e-12, 0.1, 1e8)
        for k_1, k_2 in ((0.04, 0.6), (0.0, 0.99), (1.0, 0.0))
    ]
    assert compare("kubelka_munk", kubelka_munk, plain + coated, thin=30) <= 1e-12


def test_a_layer_that_absorbs_nothing_returns_all() -> None:
    for surface in ({}, {"k_1": 0.04, "k_2": 0.6}):
        assert float(make("kubelka_munk", K_over_S=0.0, **surface).f_r(0.3, 0, 0.9, 1)) == pytest.approx(
            1 / math.pi, rel=1e-15
        )
        assert largest_albedo(make("kubelka_munk", K_over_S=0.0, **surface)) <= 1.0 + 1e-15
    # remission function: (1 - R)^2 / (2 R) = K / S
    rho = math.pi * float(make("kubelka_munk", K_over_S=0.37).f_r(0.3, 0, 0.9, 1))
    assert (1 - rho) ** 2 / (2 * rho) == pytest.approx(0.37, rel=1e-14)


def test_maps_take_the_closed_form() -> None:
    brdf, sky = make("kubelka_munk", K_over_S=0.37), gonio.source.make("hemispherical", radiance=2.0)
    rho = math.pi * float(brdf.f_r(0.0, 0.0, 0.0, 0.0))
    got = gonio.reflectance_map(brdf, sky, 0.75, 1.0)
    assert float(got.value) == pytest.approx(rho * (1 + 1 / math.sqrt(2.5625)), rel=1e-14)


@settings(max_examples=50, deadline=None)
@given(parameter_sets("kubelka_munk"))
def test_reciprocal_and_finite(parameters: dict[str, float]) -> None:
    assert reciprocity(make("kubelka_munk", **parameters), count=200) <= 1e-13


def test_refusals() -> None:
    check_refusals("kubelka_munk", {"K_over_S": 0.5})
