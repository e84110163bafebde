"""Lommel and Seeliger's law: its albedo in closed form, Hapke's model of little scattering."""

from __future__ import annotations

import math

import gonio
from tests.brdf_truth import largest_albedo

make = gonio.brdf.make


def test_albedo_in_closed_form() -> None:
    """w / 2 (1 - mu ln((1 + mu) / mu))."""
    brdf = make("lommel_seeliger", w=0.6)
    for theta in (0.0, 1.0, 1.5, math.radians(89.99)):
        mu = math.cos(theta)
        got = gonio.directional_albedo(brdf, theta, rtol=1e-9)
        assert abs(float(got.value) - 0.3 * (1 - mu * math.log1p(1 / mu))) <= float(got.error) <= 1e-9
    assert largest_albedo(make("lommel_seeliger", w=1.0)) < 0.5


def test_it_is_hapke_for_little_scattering() -> None:
    at = (0.3, 0.0, 1.2, 2.0)
    hapke = make("hapke", w=1e-9, b=0.0, c=0.0, B_0=0.0, h=0.1, theta_bar=0.0)
    ratio = float(hapke.f_r(*at)) / float(make("lommel_seeliger", w=1e-9).f_r(*at))
    assert abs(ratio - 1) < 2e-9  # the order of w
