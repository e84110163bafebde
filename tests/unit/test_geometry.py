"""Memo sections 10 to 12: gradients, normals and the two coordinate systems, against mpmath and against plain vectors."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest

from gonio import geometry
from gonio.errors import GeometryError


def test_gradient_and_normal_are_inverse_of_each_other() -> None:
    rng = np.random.default_rng(1)
    p, q = rng.normal(size=(2, 500)) * 10.0 ** rng.uniform(-8, 8, 500)
    back = geometry.gradient_from_normal(*geometry.normal_from_gradient(p, q))
    scale = np.hypot(p, q)
    # at slope s the angle's last digit is worth (1 + s^2) eps of slope
    assert np.all(np.hypot(back[0] - p, back[1] - q) <= 4e-16 * (scale + 1.0) * (1.0 + scale))


@pytest.mark.parametrize(("p", "q"), [(0.3, -0.7), (-1e-9, 2e-9), (4e7, 1e8), (0.0, -5.0), (-1e150, 1e150)])
def test_normal_of_a_gradient_matches_mpmath(p: float, q: float) -> None:
    with mpmath.workdps(60):
        slope = mpmath.sqrt(mpmath.mpf(p) ** 2 + mpmath.mpf(q) ** 2)
        theta, phi = mpmath.atan2(slope, 1), mpmath.atan2(-mpmath.mpf(q), -mpmath.mpf(p)) % (2 * mpmath.pi)
        cosine, sine = 1 / mpmath.sqrt(1 + slope**2), slope / mpmath.sqrt(1 + slope**2)
    theta_n, phi_n = geometry.normal_from_gradient(p, q)
    assert float(theta_n) == pytest.approx(float(theta), rel=4e-16)
    assert float(phi_n) == pytest.approx(float(phi), rel=4e-16)
    cos_t, sin_t, cos_f, sin_f = geometry.normal_cosines(p, q)
    assert float(cos_t) == pytest.approx(float(cosine), rel=8e-16)
    assert float(sin_t) == pytest.approx(float(sine), rel=8e-16)
    assert (float(cos_f), float(sin_f)) == pytest.approx((math.cos(float(phi)), math.sin(float(phi))), abs=4e-16)


def test_flat_and_infinite_gradients() -> None:
    assert [float(a) for a in geometry.normal_from_gradient(0.0, 0.0)] == [0.0, 0.0]
    assert [float(a) for a in geometry.normal_from_gradient(-0.0, -0.0)] == [0.0, 0.0]
    assert [float(a) for a in geometry.normal_from_gradient(-math.inf, 3.0)] == [math.pi / 2, 0.0]
    assert [float(a) for a in geometry.normal_cosines(3.0, math.inf)] == [0.0, 1.0, 0.0, -1.0]
    assert [float(a) for a in geometry.gradient_from_normal(0.0, 1.2)] == [0.0, 0.0]
    for bad in ((math.nan, 0.0), (math.inf, -math.inf)):
        with pytest.raises(GeometryError):
            geometry.normal_from_gradient(*bad)
    with pytest.raises(GeometryError, match="90"):
        geometry.gradient_from_normal(math.pi / 2, 0.0)


def test_section_12_both_ways_against_vectors() -> None:
    rng = np.random.default_rng(2)
    theta_s, phi_s = np.arccos(rng.uniform(-1, 1, 400)), rng.uniform(0, 2 * np.pi, 400)
    theta_n, phi_n = rng.uniform(0, np.pi / 2, 400), rng.uniform(0, 2 * np.pi, 400)
    theta_i, difference = geometry.local_from_viewer(theta_s, phi_s, theta_n, phi_n)
    s, n = geometry.unit_vector(theta_s, phi_s), geometry.unit_vector(theta_n, phi_n)
    assert np.abs(np.cos(theta_i) - np.sum(s * n, axis=1)).max() < 1e-15 * 4
    # phi_r - phi_i: signed angle about n from the source's to the viewer's tangential component
    view = np.array([0.0, 0.0, 1.0])
    sine = np.sum(n * np.cross(s, np.broadcast_to(view, s.shape)), axis=1)
    cosine = s[:, 2] - np.sum(s * n, axis=1) * n[:, 2]
    turn = np.mod(np.arctan2(sine, cosine) - difference + np.pi, 2 * np.pi) - np.pi
    assert np.abs(turn * np.sin(theta_i) * np.sin(theta_n)).max() < 1e-14
    back = geometry.viewer_from_local(theta_i, difference, theta_n, phi_n)
    assert np.abs(geometry.unit_vector(*back) - s).max() < 2e-15


def test_the_memo_s_mirror_condition() -> None:
    """A source seen in the mirror direction stands at theta_s = 2 theta_n, phi_s = phi_n (memo, 15a)."""
    theta_n, phi_n = 0.4, 2.0
    theta_i, difference = geometry.local_from_viewer(2 * theta_n, phi_n, theta_n, phi_n)
    assert float(theta_i) == pytest.approx(theta_n, rel=1e-15)
    assert float(difference) == pytest.approx(math.pi, rel=1e-15)


def test_azimuths_stay_below_two_pi() -> None:
    assert float(geometry.wrap(-1e-17)) == 0.0
    assert float(geometry.wrap(2 * math.pi)) == 0.0
    _, phi = geometry.angles(np.array([[0.0, 0.0, -1.0], [1.0, -1e-20, 0.0]]))
    assert np.all((phi >= 0) & (phi < 2 * np.pi))
