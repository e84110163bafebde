"""Minnaert's law: 40 digits, limits, refusals."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from mpmath import mpf, pi

import gonio
from tests.brdf_truth import Geometry, check_refusals, compare, parameter_sets, reciprocity

make = gonio.brdf.make


def minnaert(g: Geometry, albedo: mpf, k: mpf) -> mpf:
    """Minnaert 1941."""
    return albedo / pi * (g.mu_i * g.mu_r) ** (k - 1)


def test_at_forty_digits() -> None:
    sets = [{"albedo": 0.7, "k": k} for k in (0.0, 1e-8, 0.37, 1.0, 1.0 + 1e-12, 1.5, 2.0)] + [{"albedo": 0.0, "k": 0.5}]
    assert compare("minnaert", minnaert, sets) <= 1e-12


@pytest.mark.parametrize("k", [0.5, 1.0, 2.0])
def test_albedo_in_closed_form(k: float) -> None:
    """2 rho mu_r^(k - 1) / (k + 1): above 1 for k < 1, as nothing bounds it."""
    for mu in (1.0, 0.4, 1e-3):
        got = gonio.directional_albedo(make("minnaert", albedo=0.8, k=k), math.acos(mu))
        truth = 2 * 0.8 * math.cos(math.acos(mu)) ** (k - 1) / (k + 1)
        assert abs(float(got.value) - truth) <= float(got.error) + 1e-15 * truth
        assert float(got.error) <= 1e-6 * truth


@settings(max_examples=100, deadline=None)
@given(parameter_sets("minnaert"))
def test_reciprocal_and_finite(parameters: dict[str, float]) -> None:
    assert reciprocity(make("minnaert", **parameters), count=200) <= 1e-13


def test_refusals() -> None:
    check_refusals("minnaert", {"albedo": 0.5, "k": 0.5})
