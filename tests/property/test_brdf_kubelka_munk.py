"""Kubelka and Munk's layer: limits, the remission function, closed forms of maps."""

from __future__ import annotations

import math

import pytest

import gonio
from tests.brdf_truth import largest_albedo

make = gonio.brdf.make


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
