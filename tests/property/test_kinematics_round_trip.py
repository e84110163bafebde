"""Geometry -> joints -> geometry, to 1e-9 degrees, for every geometry a goniometer can mean."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from gonio import kinematics

DEG = np.pi / 180
polar = st.floats(0.0, 89.9).map(lambda a: a * DEG)
azimuth = st.floats(-360.0, 360.0).map(lambda a: a * DEG)


@settings(derandomize=True, deadline=None, max_examples=400)
@given(polar, polar, azimuth)
def test_every_solution_realises_the_geometry(theta_i, theta_r, dphi):
    found = kinematics.inverse(theta_i, theta_r, dphi)
    if found.singular:
        assert found.joints() == []
        return
    assert len(found.joints()) in (2, 4)
    for joints in found.joints():
        i, phi_i, r, phi_r = kinematics.four_angles(*joints)
        assert abs(i - theta_i) <= 1e-9 * DEG
        assert abs(r - theta_r) <= 1e-9 * DEG
        if min(theta_i, theta_r) > 1e-3 and found.separation > 1e-3:  # an azimuth near the pole is ill-conditioned
            back = phi_r - phi_i  # its sign is free: an isotropic specimen cannot tell
            assert abs(np.cos(back) - np.cos(dphi)) <= 1e-9 * DEG
            assert abs(abs(np.sin(back)) - abs(np.sin(dphi))) <= 1e-9 * DEG
        assert abs(abs(joints.arm) - found.separation) == 0.0


@settings(derandomize=True, deadline=None, max_examples=300)
@given(st.floats(-170.0, 170.0), st.floats(-89.0, 89.0), st.floats(-89.0, 89.0))
def test_joints_are_among_the_solutions_of_their_own_geometry(arm, pan, tilt):
    joints = np.array([arm, pan, tilt]) * DEG
    i, phi_i, r, phi_r = kinematics.four_angles(*joints)
    if i >= 89.9 * DEG or min(i, r) < 1e-3 or abs(arm) < 0.1:
        return
    found = kinematics.inverse(i, r, kinematics.phi_difference(phi_i, phi_r))
    distance = np.abs(np.stack((found.arm, found.pan, found.tilt), axis=-1) - joints).max(axis=-1)
    assert distance.min() <= 1e-9 * DEG
