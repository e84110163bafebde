"""Oren and Nayar's full formula: 40 digits, limits, refusals; the qualitative one beside it on the same grid."""

from __future__ import annotations

import math

import mpmath
from hypothesis import given, settings
from mpmath import cos, mpf, pi, sin, tan

import gonio
from tests.brdf_truth import Geometry, check_refusals, compare, parameter_sets, reciprocity

make = gonio.brdf.make
SIGMAS = (0.0, 1e-8, 0.1, 0.35, 0.66)


def full(g: Geometry, albedo: mpf, sigma: mpf) -> mpf:
    """Oren & Nayar 1994: the two terms L1 and L2 of the functional approximation; below 0 it is cut off."""
    s2 = sigma**2
    alpha, beta = max(g.theta_i, g.theta_r), min(g.theta_i, g.theta_r)
    c_1 = 1 - s2 / (2 * (s2 + mpf("0.33")))
    c_2 = mpf("0.45") * s2 / (s2 + mpf("0.09"))
    c_2 *= sin(alpha) if cos(g.dphi) >= 0 else sin(alpha) - (2 * beta / pi) ** 3
    c_3 = mpf("0.125") * s2 / (s2 + mpf("0.09")) * (4 * alpha * beta / pi**2) ** 2
    one = c_1 + cos(g.dphi) * c_2 * tan(beta) + (1 - abs(cos(g.dphi))) * c_3 * tan((alpha + beta) / 2)
    two = mpf("0.17") * albedo * s2 / (s2 + mpf("0.13")) * (1 - cos(g.dphi) * (2 * beta / pi) ** 2)
    return max(mpf(0), albedo / pi * (one + two))


def qualitative(g: Geometry, albedo: mpf, sigma: mpf) -> mpf:
    """Oren & Nayar 1994, the qualitative model."""
    s2 = sigma**2
    a, b = 1 - s2 / (2 * (s2 + mpf("0.33"))), mpf("0.45") * s2 / (s2 + mpf("0.09"))
    alpha, beta = max(g.theta_i, g.theta_r), min(g.theta_i, g.theta_r)
    return albedo / pi * (a + b * max(mpf(0), cos(g.dphi)) * sin(alpha) * tan(beta))


def test_at_forty_digits() -> None:
    sets = [{"albedo": 1.0, "sigma": s} for s in SIGMAS] + [{"albedo": 0.0, "sigma": 0.3}, {"albedo": 0.3, "sigma": 0.5}]
    # where the formula passes through 0 no relative accuracy is left: the last sigmas with an albedo that keeps it away
    steep = [{"albedo": 0.9, "sigma": s} for s in (0.9, 0.5 * math.pi)]
    assert compare("oren_nayar", full, [{**s, "variant": "full"} for s in sets + steep], thin=2) <= 1e-12
    assert compare("oren_nayar", qualitative, sets + steep, thin=2) <= 1e-12


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


@settings(max_examples=100, deadline=None)
@given(parameter_sets("oren_nayar", variant="full"))
def test_reciprocal_and_finite(parameters: dict[str, float]) -> None:
    assert reciprocity(make("oren_nayar", **parameters), count=200) <= 1e-11  # see the test above on passing through 0


@settings(max_examples=50, deadline=None)
@given(parameter_sets("oren_nayar"))
def test_the_qualitative_one_too(parameters: dict[str, float]) -> None:
    assert reciprocity(make("oren_nayar", **parameters), count=200) <= 1e-13


def test_refusals() -> None:
    check_refusals("oren_nayar", {"albedo": 0.5, "sigma": 0.3}, variant="full")
