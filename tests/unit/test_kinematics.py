"""Kinematics against rotation matrices written out here, mpmath derivatives, and geometries known by hand.

Conventions under test: camera at +z, arm about y, specimen R_y(pan) R_x(tilt), local frame (t, b, n).
"""

from __future__ import annotations

import mpmath
import numpy as np
import pytest

from gonio import kinematics
from gonio.errors import GeometryError
from gonio.interfaces import AxisLimits

DEG = np.pi / 180


def matrices(arm, pan, tilt):
    """World vectors by explicit rotations; nothing is shared with the code under test."""

    def r_y(a):
        return np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])

    def r_x(a):
        return np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])

    frame = r_y(pan) @ r_x(tilt)  # columns t, b, n
    lamp = r_y(arm) @ np.array([0, 0, 1])
    return frame.T @ lamp, frame.T @ np.array([0, 0, 1])


def test_forward_agrees_with_rotation_matrices():
    rng = np.random.default_rng(1)
    joints = rng.uniform(-np.pi, np.pi, (200, 3))
    omega_i, omega_r = kinematics.forward(*joints.T)
    expected = [matrices(*row) for row in joints]
    np.testing.assert_allclose(omega_i, [e[0] for e in expected], atol=4e-16)
    np.testing.assert_allclose(omega_r, [e[1] for e in expected], atol=4e-16)


def test_mirror_pose_has_the_mirror_azimuth():
    theta_i, phi_i, theta_r, phi_r = kinematics.four_angles(70 * DEG, 35 * DEG, 0.0)
    assert theta_i == pytest.approx(35 * DEG, abs=1e-15)
    assert theta_r == pytest.approx(35 * DEG, abs=1e-15)
    assert kinematics.phi_difference(phi_i, phi_r) == np.pi


def test_tilt_alone_moves_camera_and_lamp_alike():
    """With arm = pan = 0 both stand in the same direction, tilted towards +b by a positive tilt."""
    omega_i, omega_r = kinematics.forward(0.0, 0.0, 0.3)
    np.testing.assert_array_equal(omega_i, omega_r)
    np.testing.assert_allclose(omega_i, [0.0, np.sin(0.3), np.cos(0.3)])


def test_in_plane_geometries_need_no_tilt_and_have_two_solutions():
    for dphi in (0.0, np.pi, -np.pi, 3 * np.pi, 1.2 + np.pi - 1.2):
        found = kinematics.inverse(20 * DEG, 55 * DEG, dphi)
        assert np.all(found.tilt[found.distinct] == 0.0)
        assert found.distinct.sum() == 2
    assert kinematics.inverse(20 * DEG, 55 * DEG, np.pi).separation == pytest.approx(75 * DEG, abs=1e-15)
    assert kinematics.inverse(20 * DEG, 55 * DEG, 0.0).separation == pytest.approx(35 * DEG, abs=1e-15)


def test_normal_incidence_and_normal_view_are_exact():
    lamp = kinematics.inverse(0.0, 40 * DEG, 0.7).joints()
    assert [j.arm for j in lamp] == [j.pan for j in lamp]
    assert [j.pan for j in lamp] == pytest.approx([40 * DEG, -40 * DEG], abs=1e-16)
    assert all(j.tilt == 0.0 for j in lamp)
    camera = kinematics.inverse(40 * DEG, 0.0, 0.7).joints()
    assert all(j.pan == 0.0 and j.tilt == 0.0 for j in camera)
    assert [j.arm for j in camera] == pytest.approx([40 * DEG, -40 * DEG], abs=1e-16)


def test_lamp_and_camera_in_line_is_reported():
    found = kinematics.inverse([0.5, 0.0, 0.5], [0.5, 0.0, 0.5], [0.0, 1.0, 0.1])
    np.testing.assert_array_equal(found.singular, [True, True, False])
    assert not found.distinct[:2].any()
    assert np.all(np.isnan(found.arm[:2]))
    assert np.all(np.isfinite(found.arm[2]))
    assert kinematics.reach(0.5, 0.5, 0.0, {}).solutions == ()
    assert "in line" in kinematics.reach(0.5, 0.5, 0.0, {}).reasons[0]


def test_four_solutions_for_a_geometry_out_of_plane():
    found = kinematics.inverse(50 * DEG, 30 * DEG, 100 * DEG)
    joints = found.joints()
    assert len({tuple(np.round(j, 12)) for j in joints}) == 4
    signs = []
    for j in joints:
        theta_i, phi_i, theta_r, phi_r = kinematics.four_angles(*j)
        assert (theta_i, theta_r) == pytest.approx((50 * DEG, 30 * DEG), abs=1e-14)
        signs.append(round(float(kinematics.phi_difference(phi_i, phi_r)) / DEG))
    assert signs[0] == signs[3] and signs[1] == signs[2]
    assert sorted(set(signs)) == [100, 260]


def test_jacobian_against_high_precision_derivatives():
    mpmath.mp.dps = 30

    def component(which, k, arm, pan, tilt):
        world = [mpmath.sin(arm), 0, mpmath.cos(arm)] if which == 0 else [0, 0, 1]
        t = [mpmath.cos(pan), 0, -mpmath.sin(pan)]
        n = [mpmath.sin(pan) * mpmath.cos(tilt), -mpmath.sin(tilt), mpmath.cos(pan) * mpmath.cos(tilt)]
        b = [n[1] * t[2] - n[2] * t[1], n[2] * t[0] - n[0] * t[2], n[0] * t[1] - n[1] * t[0]]
        return sum(x * y for x, y in zip(world, (t, b, n)[k], strict=True))

    rng = np.random.default_rng(2)
    for joints in rng.uniform(-1.4, 1.4, (4, 3)):
        analytic = kinematics.jacobian(*joints)
        for which in (0, 1):
            for k in range(3):
                for j in range(3):
                    order = tuple(int(m == j) for m in range(3))
                    exact = mpmath.diff(
                        lambda *q, w=which, c=k: component(w, c, *q), tuple(float(x) for x in joints), order
                    )
                    assert analytic[which][k, j] == pytest.approx(float(exact), abs=1e-14)


def test_jacobian_keeps_its_shape_and_unit_length():
    d_i, d_r = kinematics.jacobian(np.zeros((4, 5)), 0.2, 0.1)
    assert d_i.shape == d_r.shape == (4, 5, 3, 3)
    omega_i, omega_r = kinematics.forward(np.zeros((4, 5)), 0.2, 0.1)
    np.testing.assert_allclose(np.einsum("...k,...kj->...j", omega_i, d_i), 0.0, atol=1e-16)
    np.testing.assert_allclose(np.einsum("...k,...kj->...j", omega_r, d_r), 0.0, atol=1e-16)


def limits(arm=100, pan=80, tilt=45):
    return {n: AxisLimits(-a * DEG, a * DEG, 1.0) for n, a in (("arm", arm), ("pan", pan), ("tilt", tilt))}


def test_reach_gives_reasons_with_both_numbers():
    near = kinematics.reach(30 * DEG, 32 * DEG, 0.0, limits(), g_min=8 * DEG)
    assert near.solutions == ()
    assert "2.00 deg" in near.reasons[0] and "8.00 deg" in near.reasons[0]
    far = kinematics.reach(60 * DEG, 60 * DEG, np.pi, limits())
    assert far.solutions == () and "arm 120.00 deg is outside -100.00 to 100.00 deg" in far.reasons[0]
    steep = kinematics.reach(60 * DEG, 60 * DEG, 60 * DEG, limits())
    assert steep.solutions == () and all("tilt" in r for r in steep.reasons)
    good = kinematics.reach(20 * DEG, 40 * DEG, 90 * DEG, limits(), g_min=8 * DEG)
    assert len(good.solutions) == 4 and good.reasons == ()


def test_obstacles_sees_the_back_of_the_specimen():
    assert any("lamp" in r and "behind" in r for r in kinematics.obstacles(80 * DEG, -20 * DEG, 0.0, {}))
    assert any("camera" in r for r in kinematics.obstacles(80 * DEG, 95 * DEG, 0.0, {}))
    assert kinematics.obstacles(80 * DEG, 40 * DEG, 0.0, {}) == ()


@pytest.mark.parametrize("bad", [(np.pi / 2, 0.1, 0.0), (0.1, -0.1, 0.0), (0.1, np.nan, 0.0), (0.1, 0.1, np.inf)])
def test_inverse_refuses_what_no_pose_can_realise(bad):
    with pytest.raises(GeometryError):
        kinematics.inverse(*bad)


def test_forward_refuses_nan():
    with pytest.raises(GeometryError, match="pan"):
        kinematics.forward(0.0, np.nan, 0.0)


def test_joints_of_many_geometries_is_refused():
    with pytest.raises(GeometryError, match="one geometry"):
        kinematics.inverse([0.1, 0.2], 0.3, 1.0).joints()
