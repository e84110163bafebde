"""Blinn and Phong's lobe, Ashikhmin and Shirley's model: albedo in closed form and bounded."""

from __future__ import annotations

import math

import pytest

import gonio
from tests.brdf_truth import largest_albedo

make = gonio.brdf.make


@pytest.mark.parametrize("n", [0.0, 1.0, 20.0, 1e6])
def test_albedo_at_normal_incidence_is_the_weight(n: float) -> None:
    got = gonio.directional_albedo(make("blinn_phong", k_s=0.8, n=n), 0.0, rtol=1e-10)
    assert abs(float(got.value) - 0.8) <= float(got.error) <= 1e-10


def test_diffuse_base_in_closed_form() -> None:
    """With R_s = 0 and the gloss subtracted: R_d (1 - (1 - mu/2)^5), as the mean of that factor is 23/28."""
    for theta in (0.0, 1.0):
        with_base, without = (make("ashikhmin_shirley", R_d=r, R_s=0.0, n=5.0) for r in (0.9, 0.0))
        a, b = (gonio.directional_albedo(m, theta, rtol=1e-9) for m in (with_base, without))
        truth = 0.9 * (1 - (1 - math.cos(theta) / 2) ** 5)
        assert abs(float(a.value - b.value) - truth) <= float(a.error + b.error) + 1e-15


def test_energy_is_bounded() -> None:
    for n in (0.0, 3.0, 1e3):
        assert largest_albedo(make("blinn_phong", k_s=1.0, n=n)) <= 1.0
        for r_d, r_s in ((1.0, 0.0), (1.0, 0.3), (0.0, 1.0)):
            assert largest_albedo(make("ashikhmin_shirley", R_d=r_d, R_s=r_s, n=n), rtol=1e-5) <= 1.0
