"""Hapke's model: Chandrasekhar's H, limits, the opposition peak."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest
from mpmath import atan, exp, log, mpf, pi

import gonio

make = gonio.brdf.make
PLAIN = {"b": 0.0, "c": 0.0, "B_0": 0.0, "h": 0.05, "theta_bar": 0.0}


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
