"""EON: 40 digits, nothing lost at albedo 1, limits, refusals; and the arctangent that it shares."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from mpmath import acos, mpf, pi

import gonio
from gonio import jit
from gonio.brdf.arctangent import arctan
from tests.brdf_truth import Geometry, check_refusals, compare, parameter_sets, reciprocity

make = gonio.brdf.make
ROUGHNESSES = (0.0, 1e-12, 1e-8, 0.3, 1.0)


def eon(g: Geometry, albedo: mpf, roughness: mpf) -> mpf:
    """Portsmouth, Kutz & Hill 2025: single scattering of Fujii's form, and the compensation of its albedo."""
    r = roughness
    a = 1 / (1 + (mpf(1) / 2 - 2 / (3 * pi)) * r)
    mean = a * (1 + (mpf(2) / 3 - 28 / (15 * pi)) * r)

    def e(theta: mpf) -> mpf:
        mu, s = mpmath.cos(theta), mpmath.sin(theta)
        big_g = s * (acos(mu) - s * mu) + mpf(2) / 3 * (s / mu * (1 - s**3) - s)
        return a + r * a / pi * big_g

    s = mpmath.sin(g.theta_i) * mpmath.sin(g.theta_r) * mpmath.cos(g.dphi)
    t = max(g.mu_i, g.mu_r) if s > 0 else 1
    single = albedo / pi * a * (1 + r * s / t)
    if r == 0:
        return single
    again = albedo**2 * mean / (1 - albedo * (1 - mean))
    return single + again / pi * (1 - e(g.theta_i)) * (1 - e(g.theta_r)) / (1 - mean)


def test_at_forty_digits() -> None:
    sets = [{"albedo": rho, "roughness": r} for r in ROUGHNESSES for rho in (0.0, 0.6, 1.0)]
    assert compare("eon", eon, sets, thin=2, digits=60) <= 1e-12


@pytest.mark.parametrize("roughness", ROUGHNESSES)
def test_nothing_is_lost_at_albedo_one(roughness: float) -> None:
    for theta in (0.0, 0.5, 1.2, math.radians(89.9)):
        got = gonio.directional_albedo(make("eon", albedo=1.0, roughness=roughness), theta, rtol=1e-10)
        assert abs(float(got.value) - 1.0) <= float(got.error) <= 1e-10


def test_lambert_at_roughness_zero() -> None:
    at = (np.array([0.2, 1.0, 1.5]), 0.4, 0.9, np.array([0.1, 2.0, 3.5]))
    assert make("eon", albedo=0.6, roughness=0.0).f_r(*at) == pytest.approx(0.6 / math.pi, rel=1e-15)


@settings(max_examples=100, deadline=None)
@given(parameter_sets("eon"))
def test_reciprocal_and_finite(parameters: dict[str, float]) -> None:
    assert reciprocity(make("eon", **parameters), count=200) <= 1e-13


def test_refusals() -> None:
    check_refusals("eon", {"albedo": 0.5, "roughness": 0.3})


def test_arctangent() -> None:
    def angles(y, x, out):  # type: ignore[no-untyped-def]
        for k in range(out.size):
            out[k] = arctan(y[k], x[k])

    rng = np.random.default_rng(4)
    y, x = 10.0 ** rng.uniform(-8, 0, 4000), 10.0 ** rng.uniform(-8, 0, 4000)
    y, x = np.concatenate((y, rng.random(4000), [0.0, 1.0, 1.0])), np.concatenate((x, rng.random(4000), [1.0, 0.0, 1.0]))
    out = np.empty_like(x)
    jit.kernel(angles)(y, x, out)
    for got, b, a in zip(out, y, x, strict=True):
        assert abs(got - mpmath.atan2(b, a)) <= 4.5e-16 * got
