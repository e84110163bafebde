"""The walked coordinates: there and back for any value, any prior."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from fitting.parameters import Declared, Space

PRIORS = st.sampled_from(
    [("uniform", 0.0, 1.0), ("log_normal", math.log(0.2), 0.9), ("normal", 0.4, 0.3), ("log_uniform", 1e-3, 1.0)]
)


@settings(max_examples=100, deadline=None)
@given(PRIORS, st.floats(1e-6, 1.0 - 1e-6))
def test_bounded_values_go_there_and_back(prior, fraction):
    space = Space([Declared("x", 1e-4, 1.0, prior)])
    q = space.priors[0]
    x = q.lower + (q.upper - q.lower) * fraction
    back = space.natural(space.unbounded(np.array([[x]])))[0][0, 0]
    assert abs(back - x) <= 1e-9 * (q.upper - q.lower)


@settings(max_examples=100, deadline=None)
@given(st.floats(-1e3, 1e3), st.floats(1e-6, 1e3), st.floats(-8, 8))
def test_shared_errors_are_walked_in_units_of_their_uncertainty(mean, sd, u):
    space = Space([Declared("x", -math.inf, math.inf, ("normal", mean, sd))])
    x, log_prior = space.natural(np.array([[u]]))
    assert abs(x[0, 0] - (mean + sd * u)) <= 1e-12 * (abs(mean) + sd * abs(u))
    assert abs(log_prior[0] + 0.5 * u * u) <= 1e-6 * (1 + abs(mean) / sd)


@settings(max_examples=100, deadline=None)
@given(st.floats(0.0, 2.9), st.sampled_from([-1.0, 1.0]))
def test_a_noise_has_two_mirror_images(x, sign):
    space = Space([Declared("x", 1e-4, 3.0, ("half_normal", 0.3))])
    u = space.unbounded(np.array([[x + 1e-4]]))
    back, log_prior = space.natural(sign * u)
    assert abs(back[0, 0] - x - 1e-4) < 1e-12
    assert log_prior[0] == space.natural(u)[1][0]
