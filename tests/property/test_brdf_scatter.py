"""Scatter of polished surfaces (ABg, Harvey-Shack, K-correlation): limits, a spectrum's variance."""

from __future__ import annotations

import math

import numpy as np
import pytest

import gonio

make = gonio.brdf.make


def test_nothing_scatters_nothing() -> None:
    at = (0.3, 0.0, 0.3, np.array([0.0, 1.0, math.pi]))
    for brdf in (
        make("abg", A=0.0, B=1e-12, g=4.0),
        make("harvey_shack", b_0=0.0, l=1e-6, s=-4.0),
        make("k_correlation", A=0.0, B=1e6, C=1.0, wavelength_um=0.01),
    ):
        assert np.all(brdf.f_r(*at) == 0.0)


def test_harvey_shack_and_abg_share_a_case() -> None:
    """b_0 (1 + (d / l)^2)^-1 = b_0 l^2 / (l^2 + d^2)."""
    at = (np.array([0.0, 0.4, 1.2]), 0.1, 0.8, np.array([0.0, 2.0, 3.2]))
    one, other = make("harvey_shack", b_0=3.0, l=0.02, s=-2.0), make("abg", A=3.0 * 0.02**2, B=0.02**2, g=2.0)
    assert one.f_r(*at) == pytest.approx(other.f_r(*at), rel=1e-13)


def test_k_correlation_scatters_the_profiles_variance() -> None:
    """Lit and seen from near the normal, a smooth surface scatters (4 pi rms / wavelength)^2 of the light.

    The profile's one-dimensional spectrum A (1 + (B f)^2)^(-C/2), over f > 0, has the variance rms^2; slopes are kept so
    small that all that is scattered lies near the mirror direction.
    """
    a, b, c, wavelength = 1e-7, 500.0, 3.0, 0.5
    variance = a / b * math.sqrt(math.pi) / 2 * math.gamma((c - 1) / 2) / math.gamma(c / 2)  # int_0^inf
    got = gonio.directional_albedo(make("k_correlation", A=a, B=b, C=c, wavelength_um=wavelength), 0.0, rtol=1e-6)
    assert float(got.value) == pytest.approx((4 * math.pi / wavelength) ** 2 * variance, rel=2e-2)
