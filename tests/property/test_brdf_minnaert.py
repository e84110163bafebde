"""Minnaert's law: its albedo in closed form."""

from __future__ import annotations

import math

import pytest

import gonio

make = gonio.brdf.make


@pytest.mark.parametrize("k", [0.5, 1.0, 2.0])
def test_albedo_in_closed_form(k: float) -> None:
    """2 rho mu_r^(k - 1) / (k + 1): above 1 for k < 1, as nothing bounds it."""
    for mu in (1.0, 0.4, 1e-3):
        got = gonio.directional_albedo(make("minnaert", albedo=0.8, k=k), math.acos(mu))
        truth = 2 * 0.8 * math.cos(math.acos(mu)) ** (k - 1) / (k + 1)
        assert abs(float(got.value) - truth) <= float(got.error) + 1e-15 * truth
        assert float(got.error) <= 1e-6 * truth
