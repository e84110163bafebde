"""Phong's lobe and Lafortune's: their albedo, where they are one, where they are cut."""

from __future__ import annotations

import math

import numpy as np
import pytest

import gonio
from tests.brdf_truth import largest_albedo

make = gonio.brdf.make


def test_lafortune_of_opposite_weights_is_phong() -> None:
    at = (np.array([0.0, 0.4, 1.2]), 0.1, 0.8, np.array([0.0, 2.0, 3.2]))
    for n in (0.5, 30.0, 1e6):
        same = make("lafortune", k_s=0.6, C_xy=-0.7, C_z=0.7, n=n).f_r(*at)
        assert same == pytest.approx(make("phong", k_s=0.6, n=n).f_r(*at), rel=1e-13, abs=1e-300)


@pytest.mark.parametrize("n", [0.0, 1.0, 20.0, 1e6])
def test_albedo_at_normal_incidence_is_the_weight(n: float) -> None:
    for brdf in (make("phong", k_s=0.8, n=n), make("lafortune", k_s=0.8, C_xy=-1.0, C_z=1.0, n=n)):
        got = gonio.directional_albedo(brdf, 0.0, rtol=1e-10)
        assert abs(float(got.value) - 0.8) <= float(got.error) <= 1e-10


def test_energy_is_bounded() -> None:
    for n in (0.0, 3.0, 1e3):
        assert largest_albedo(make("phong", k_s=1.0, n=n)) <= 1.0
        for c_xy, c_z in ((-1.0, 0.8), (1.0, 1.0), (0.3, 1.0)):
            assert largest_albedo(make("lafortune", k_s=1.0, C_xy=c_xy, C_z=c_z, n=n), rtol=1e-5) <= 1.0


def test_the_cut_at_ninety_degrees() -> None:
    """Beyond 90 degrees from its axis a lobe is 0, for n = 0 too."""
    brdf = make("phong", k_s=1.0, n=0.0)
    assert float(brdf.f_r(1.0, 0.0, 1.0, math.pi)) == pytest.approx(1 / math.pi, rel=1e-15)
    assert float(brdf.f_r(1.0, 0.0, 1.0, 0.0)) == 0.0
