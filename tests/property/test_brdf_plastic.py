"""Diffuse base below a smooth surface: constants of diffuse light, nothing lost with the gloss."""

from __future__ import annotations

import functools
import math

import mpmath
import pytest
from mpmath import mpf, sin

import gonio
from gonio.brdf.plastic import diffuse_reflectance
from tests.brdf_formulas import external, fresnel
from tests.brdf_truth import largest_albedo

make = gonio.brdf.make
INDICES = (1.0, 1.0 + 1e-12, 1.0001, 1.05, 1.5, 3.0)


@functools.cache
def internal(n: mpf) -> mpf:
    """Mean of F from within, totally reflected light included, by quadrature over the angle outside."""
    if n == 1:
        return mpf(0)
    # d(sin^2 inside) = d(sin^2 outside) / n^2; beyond the critical angle F = 1
    ends = [0, 0.5, 1, 1.3, 1.45, 1.53, 1.56, 1.568, mpmath.pi / 2]
    return 1 - mpmath.quad(lambda t: (1 - fresnel(t, n)) * sin(2 * t), ends) / n**2


@pytest.mark.parametrize("n", [*INDICES, 1.0 + 1e-7, 1.01, 1.3, 2.0])
def test_diffuse_reflectance_in_closed_form(n: float) -> None:
    truth = external(mpf(n))
    assert abs(diffuse_reflectance(n) - truth) <= 4e-16 + 1e-15 * truth


def test_constants_of_glass() -> None:
    """n = 1.5: 0.0917779593 from outside, 0.5963457597 from within."""
    outside = diffuse_reflectance(1.5)
    assert outside == pytest.approx(0.0917779593, abs=5e-11)
    assert 1 - (1 - outside) / 1.5**2 == pytest.approx(0.5963457597, abs=5e-11)
    assert float(internal(mpf(1.5))) == pytest.approx(1 - (1 - outside) / 1.5**2, abs=1e-12)


def test_lambert_without_a_surface() -> None:
    for n in (1.0, 1.0 + 1e-15):
        assert float(make("plastic", albedo=0.6, n=n).f_r(0.4, 0.0, 1.3, 2.0)) == pytest.approx(0.6 / math.pi, rel=1e-13)


@pytest.mark.parametrize("n", [1.0, 1.0001, 1.05, 1.5, 3.0])
def test_with_its_gloss_nothing_is_lost(n: float) -> None:
    """At albedo 1 what is not reflected at the surface comes out of it: the albedo is 1 - F."""
    for theta in (0.0, 0.9, 1.5, math.radians(89.9)):
        got = gonio.directional_albedo(make("plastic", albedo=1.0, n=n), theta, rtol=1e-9)
        with mpmath.workdps(40):
            truth = float(1 - fresnel(mpf(theta), mpf(n)))
        assert abs(float(got.value) - truth) <= float(got.error) + 1e-14 * truth
        assert float(got.error) <= 1e-9 * truth
    assert largest_albedo(make("plastic", albedo=1.0, n=n)) <= 1.0
