"""Hapke's model: 40 digits in the papers' own angles and branches, Chandrasekhar's H, limits, refusals."""

from __future__ import annotations

import itertools
import math

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from mpmath import atan, cos, cot, exp, log, mpf, pi, sin, sqrt, tan

import gonio
from tests.brdf_truth import Geometry, check_refusals, compare, parameter_sets, reciprocity

make = gonio.brdf.make
PLAIN = {"b": 0.0, "c": 0.0, "B_0": 0.0, "h": 0.05, "theta_bar": 0.0}


def h_of(version: str, x: mpf, w: mpf) -> mpf:
    """Hapke 1981 and 2002."""
    gamma = sqrt(1 - w)
    if version == "1981":
        return (1 + 2 * x) / (1 + 2 * x * gamma)
    r_0 = (1 - gamma) / (1 + gamma)
    return 1 / (1 - w * x * (r_0 + (1 - 2 * r_0 * x) / 2 * log((1 + x) / x)))


def effective(i: mpf, e: mpf, psi: mpf, theta_bar: mpf) -> tuple[mpf, mpf, mpf]:
    """mu_0e, mu_e and S of Hapke 1984, in the two branches as they are printed."""
    if theta_bar == 0:
        return cos(i), cos(e), mpf(1)
    t = tan(theta_bar)
    chi = 1 / sqrt(1 + pi * t**2)

    def e_1(x: mpf) -> mpf:
        return exp(-2 / pi * cot(theta_bar) * cot(x)) if x > 0 else mpf(0)

    def e_2(x: mpf) -> mpf:
        return exp(-1 / pi * cot(theta_bar) ** 2 * cot(x) ** 2) if x > 0 else mpf(0)

    def eta(x: mpf) -> mpf:
        return chi * (cos(x) + sin(x) * t * e_2(x) / (2 - e_1(x)))

    f = exp(-2 * tan(psi / 2)) if psi < pi else mpf(0)
    half = sin(psi / 2) ** 2
    if i <= e:
        below = 2 - e_1(e) - psi / pi * e_1(i)
        mu_0e = chi * (cos(i) + sin(i) * t * (cos(psi) * e_2(e) + half * e_2(i)) / below)
        mu_e = chi * (cos(e) + sin(e) * t * (e_2(e) - half * e_2(i)) / below)
        seen = cos(i) / eta(i)
    else:
        below = 2 - e_1(i) - psi / pi * e_1(e)
        mu_0e = chi * (cos(i) + sin(i) * t * (e_2(i) - half * e_2(e)) / below)
        mu_e = chi * (cos(e) + sin(e) * t * (cos(psi) * e_2(i) + half * e_2(e)) / below)
        seen = cos(e) / eta(e)
    shadowing = mu_e / eta(e) * cos(i) / eta(i) * chi / (1 - f + f * chi * seen)
    return mu_0e, mu_e, shadowing


def hapke(version: str, g: Geometry, w: mpf, b: mpf, c: mpf, B_0: mpf, h: mpf, theta_bar: mpf) -> mpf:
    """The bidirectional reflectance r over mu_0."""
    mu_0e, mu_e, shadowing = effective(g.theta_i, g.theta_r, g.dphi, theta_bar)
    phase = (1 + c) / 2 * (1 - b**2) / (1 - 2 * b * g.cos_g + b**2) ** 1.5
    phase += (1 - c) / 2 * (1 - b**2) / (1 + 2 * b * g.cos_g + b**2) ** 1.5
    opposition = B_0 / (1 + tan(g.g / 2) / h)
    scattered = (1 + opposition) * phase + h_of(version, mu_0e, w) * h_of(version, mu_e, w) - 1
    return w / (4 * pi) * mu_0e / (mu_0e + mu_e) * scattered * shadowing / cos(g.theta_i)


SETS = [
    {"w": 0.6, "b": 0.3, "c": 0.4, "B_0": 0.0, "h": 0.05, "theta_bar": 0.0},
    {"w": 1.0, "b": 0.0, "c": -1.0, "B_0": 1.0, "h": 1e-5, "theta_bar": 1e-9},
    {"w": 1e-9, "b": 0.999, "c": 0.2, "B_0": 3.0, "h": 10.0, "theta_bar": 1e-4},
    {"w": 0.9, "b": 0.7, "c": 1.0, "B_0": 0.6, "h": 0.05, "theta_bar": 0.02},
    {"w": 0.3, "b": 0.5, "c": -0.3, "B_0": 0.2, "h": 0.5, "theta_bar": 0.35},
    {"w": 1.0, "b": 0.999, "c": -1.0, "B_0": 1.0, "h": 1e-3, "theta_bar": 0.25 * math.pi},
]


@pytest.mark.parametrize("version", ["1981", "2002"])
def test_at_forty_digits(version: str) -> None:
    sets = [{**s, "H": version} for s in SETS]
    assert compare("hapke", lambda g, **p: hapke(version, g, **p), sets, thin=2, digits=60) <= 1e-12


@pytest.mark.gate
def test_at_forty_digits_everywhere() -> None:
    """The whole grid, every combination of the ends of the ranges."""
    ends = {"w": (0.0, 1.0), "b": (0.0, 0.999), "c": (-1.0, 1.0), "B_0": (0.0, 3.0), "h": (1e-5, 10.0)}
    slopes = (0.0, 1e-6, 1e-3, 0.1, 0.25 * math.pi)
    sets = [
        {**dict(zip(ends, values, strict=True)), "theta_bar": t}
        for values in itertools.product(*ends.values())
        for t in slopes
    ]
    assert compare("hapke", lambda g, **p: hapke("1981", g, **p), sets, thin=3, digits=60) <= 1e-12


# --- Chandrasekhar's function ---------------------------------------------------------------------------------------------


def chandrasekhar(x: mpf, w: mpf) -> mpf:
    """ln H = -(x / pi) int_0^inf ln(1 - w atan(t) / t) / (1 + x^2 t^2) dt (Chandrasekhar, Radiative Transfer, 1960)."""

    def integrand(t: mpf) -> mpf:
        left = t * t / 3 if t < 1e-9 else 1 - atan(t) / t
        return log(1 - w + w * left) / (1 + x**2 * t**2)

    return exp(-x / pi * mpmath.quad(integrand, [0, 1e-6, 1e-3, 0.1, 1, 10, 100, mpmath.inf]))


def h_of_model(version: str, x: float, w: float) -> float:
    """Isotropic scatterers, seen along the incident light: f_r = w / (4 pi) H^2 / (2 mu)."""
    mu = np.array([math.sqrt(1 - x * x), 0.0, x])
    return math.sqrt(float(make("hapke", w=w, H=version, **PLAIN).evaluate(mu, mu)) * 8 * math.pi * x / w)


def test_h_at_one() -> None:
    """H(1; 1) = 2.90781; the approximations are good to 4 % and 1 %, the errors that their papers state."""
    assert float(chandrasekhar(mpf(1), mpf(1))) == pytest.approx(2.90781, abs=5e-6)
    assert h_of_model("1981", 1.0, 1.0) == pytest.approx(2.90781, rel=0.04)
    assert h_of_model("2002", 1.0, 1.0) == pytest.approx(2.90781, rel=0.01)


def test_h_everywhere() -> None:
    for x in (0.03, 0.1, 0.3, 0.6, 1.0):
        for w in (0.2, 0.5, 0.9, 0.99, 1.0):
            truth = float(chandrasekhar(mpf(x), mpf(w)))
            assert h_of_model("1981", x, w) == pytest.approx(truth, rel=0.043), (x, w)
            assert h_of_model("2002", x, w) == pytest.approx(truth, rel=0.0105), (x, w)


# --- limits ---------------------------------------------------------------------------------------------------------------


def test_roughness_fades_out() -> None:
    given = {"w": 0.7, "b": 0.3, "c": 0.2, "B_0": 0.5, "h": 0.1}
    at = (np.array([0.0, 0.3, 1.0, 1.4]), 0.0, 0.8, np.array([0.0, 1.0, math.pi, 2.0]))
    smooth = make("hapke", theta_bar=0.0, **given).f_r(*at)
    for theta_bar in (1e-300, 1e-9):
        assert make("hapke", theta_bar=theta_bar, **given).f_r(*at) == pytest.approx(smooth, rel=1e-14)
    assert make("hapke", theta_bar=0.01, **given).f_r(*at) == pytest.approx(smooth, rel=0.02)


def test_opposition_peak() -> None:
    """Single scattering at g = 0 is 1 + B_0 times that without; half of the peak is left at tan(g / 2) = h."""
    given = {"w": 1e-6, "b": 0.0, "c": 0.0, "theta_bar": 0.0, "h": 1e-4}
    peak, flat = make("hapke", B_0=1.0, **given), make("hapke", B_0=0.0, **given)
    at, beside = (0.5, 0.0, 0.5, 0.0), (0.5, 0.0, 0.5 + 2e-4, 0.0)
    assert float(peak.f_r(*at)) == pytest.approx(2 * float(flat.f_r(*at)), rel=1e-5)
    assert float(peak.f_r(*beside)) == pytest.approx(1.5 * float(flat.f_r(*beside)), rel=1e-5)


def test_dark_isotropic_albedo_is_hapkes_own() -> None:
    """Without roughness and peak, for the exact H: rho = 1 - gamma H(mu); H of 2002 is good to 1 %."""
    for w, theta in ((0.3, 0.2), (0.9, 1.0)):
        got = gonio.directional_albedo(make("hapke", w=w, H="2002", **PLAIN), theta)
        exact = 1 - mpmath.sqrt(1 - w) * chandrasekhar(mpf(math.cos(theta)), mpf(w))
        assert float(got.value) == pytest.approx(float(exact), rel=0.02)


@pytest.mark.parametrize("version", ["1981", "2002"])
def test_reciprocal_and_finite(version: str) -> None:
    @settings(max_examples=100, deadline=None)
    @given(parameter_sets("hapke", H=version))
    def check(parameters: dict[str, float]) -> None:
        assert reciprocity(make("hapke", **parameters), count=200) <= 1e-13

    check()


def test_refusals() -> None:
    check_refusals("hapke", {"w": 0.5, **PLAIN})
