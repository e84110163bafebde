"""Oren and Nayar's two formulas beside each other, and where the full one is cut off."""

from __future__ import annotations

import math

import mpmath

import gonio

make = gonio.brdf.make


def test_dark_and_steep_is_never_negative() -> None:
    brdf = make("oren_nayar", albedo=0.05, sigma=1.2, variant="full")
    assert float(brdf.f_r(1.5, 0.0, 1.5, math.pi)) == 0.0
    assert float(make("oren_nayar", albedo=0.05, sigma=0.66, variant="full").f_r(1.57, 0.0, 1.57, math.pi)) > 0.0


def test_the_variants_are_two_names_for_nearly_one_surface() -> None:
    """The qualitative formula leaves out interreflection and C_3: for a dark surface it follows the full one to 5 %."""
    for theta_i, theta_r, dphi in ((0.2, 0.9, 0.3), (0.7, 0.4, 2.5), (0.5, 0.5, 1.5)):
        both = [
            float(make("oren_nayar", albedo=0.05, sigma=0.35, variant=v).f_r(theta_i, 0.0, theta_r, dphi))
            for v in ("full", "qualitative")
        ]
        assert mpmath.almosteq(both[0], both[1], rel_eps=0.05) and both[0] != both[1]
