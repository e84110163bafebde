"""Half and difference angles: inverse of each other, and against angles that need no formula."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gonio import halfdiff
from gonio.geometry import unit_vector


def test_round_trip_and_swap() -> None:
    rng = np.random.default_rng(3)
    wi = unit_vector(np.arccos(rng.uniform(0, 1, 500)), rng.uniform(0, 2 * np.pi, 500))
    wr = unit_vector(np.arccos(rng.uniform(0, 1, 500)), rng.uniform(0, 2 * np.pi, 500))
    angles = halfdiff.half_difference(wi, wr)
    back = halfdiff.directions(*angles)
    assert np.abs(back[0] - wi).max() < 4e-15
    assert np.abs(back[1] - wr).max() < 4e-15
    swapped = halfdiff.half_difference(wr, wi)
    assert np.abs(swapped[0] - angles[0]).max() < 1e-15 and np.abs(swapped[2] - angles[2]).max() < 1e-15
    turn = np.mod(swapped[3] - angles[3], 2 * np.pi)
    assert np.abs(turn - np.pi).max() < 1e-12


def test_known_angles() -> None:
    # in the x-z plane half and difference angle are the half difference and half sum of the two polar angles
    angles = halfdiff.half_difference(unit_vector(0.7, 0.0), unit_vector(0.5, math.pi))
    assert [float(a) for a in angles] == pytest.approx([0.1, 0.0, 0.6, 0.0], abs=1e-15)
    # mirror geometry: h = n, where phi_h is undefined
    theta_h, _, theta_d, _ = halfdiff.half_difference(unit_vector(0.6, 0.0), unit_vector(0.6, math.pi))
    assert (float(theta_h), float(theta_d)) == pytest.approx((0.0, 0.6), abs=1e-15)
    # retro-reflection: theta_h = theta_i and theta_d = 0, exactly
    theta_h, phi_h, theta_d, _ = halfdiff.half_difference(unit_vector(0.6, 1.0), unit_vector(0.6, 1.0))
    assert (float(theta_h), float(phi_h), float(theta_d)) == pytest.approx((0.6, 1.0, 0.0), abs=1e-15)
    # beside the mirror direction by 1e-8 rad: theta_h is half of it, to all digits
    theta_h = halfdiff.half_difference(unit_vector(0.6 + 1e-8, 0.0), unit_vector(0.6, math.pi))[0]
    assert float(theta_h) == pytest.approx(0.5e-8, rel=1e-7)
