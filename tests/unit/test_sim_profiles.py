"""Positions over time of a simulated servo, read over its bus, against the profiles that the manual draws.

Source: ROBOTIS e-Manual, XM430-W350, "What is the Profile", "Profile Acceleration(108)", "Profile Velocity(112)". The
expected curves are written out from the manual's times t1, t2, t3 and share no code with the simulator.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable

import pytest

from sim.dynamixel import Servo
from tests.dynamixel_host import GOAL, MODE, MOVING, MOVING_STATUS, PROFILE_ACCELERATION, PROFILE_VELOCITY, TORQUE, Host

PULSES_PER_MS = 0.229 * 4096 / 60_000  # one unit of velocity
PULSES_PER_MS2 = 214.577 * 4096 / 3600 / 1e6  # one unit of acceleration
POSITION_TRAJECTORY, VELOCITY_TRAJECTORY = 140, 136
Curve = Callable[[float], float]


def manuals_profile(distance: float, v: int, a: int) -> tuple[int, float, Curve]:
    """(profile bits, t3 [ms], pulses after t [ms]) of a move from rest."""
    if v == 0:
        return 0, 0.0, lambda t: distance
    speed = v * PULSES_PER_MS
    if a == 0:
        t3 = distance / speed
        return 1, t3, lambda t: min(speed * t, distance)
    t1 = speed / (a * PULSES_PER_MS2)  # the manual's 64 V / A
    if distance > speed * t1:
        bits, t2 = 3, distance / speed  # the manual's 64 distance / V
    else:  # it never gets to V: a triangle whose height follows from the distance
        bits, t1 = 2, math.sqrt(distance / (a * PULSES_PER_MS2))
        t2 = t1
    t3 = t1 + t2
    top = distance / t2

    def pulses(t: float) -> float:
        t = min(t, t3)
        risen, fallen = min(t, t1), max(t - t2, 0.0)
        return top * (t - risen + risen**2 / (2 * t1) - fallen**2 / (2 * t1))

    return bits, t3, pulses


def manuals_times(distance: float, total: int, rising: int) -> tuple[float, Curve]:
    """(t3 [ms], pulses after t [ms]) of a time-based profile."""
    t1, t3 = min(rising, total / 2), total
    top = distance / (t3 - t1)

    def pulses(t: float) -> float:
        t = min(t, t3)
        risen, fallen = min(t, t1), max(t - (t3 - t1), 0.0)
        ramp = (risen**2 - fallen**2) / (2 * t1) if t1 else 0.0
        return top * (t - risen + ramp)

    return t3, pulses


def host_with(v: int, a: int, *, mode: int = 4, drive_mode: int = 0) -> Host:
    host = Host(Servo(1, initial_counts=1000.0))
    host.write(MODE, mode)
    host.write(10, drive_mode)
    host.write(PROFILE_ACCELERATION, a)
    host.write(PROFILE_VELOCITY, v)
    host.write(TORQUE, 1)
    return host


def check(host: Host, distance: int, bits: int, t3: float, pulses: Curve) -> None:
    """Position within one pulse, its end within one millisecond, velocity within one unit, bits all the way."""
    start = host.t
    host.write(GOAL, 1000 + distance)
    sign = int(math.copysign(1, distance))
    for k in range(41):
        t = t3 * k / 40 * 1.05
        host.t = start + 1e-3 * t
        assert abs(host.read(POSITION_TRAJECTORY, 4, signed=True) - (1000 + sign * pulses(t))) <= 1.0
        if 0.0 < t < t3 - 2.0:
            slope = sign * (pulses(t + 1e-3) - pulses(t - 1e-3)) / 2e-3 / PULSES_PER_MS
            assert abs(host.read(VELOCITY_TRAJECTORY, 4, signed=True) - slope) <= 1.0
        assert (host.read(MOVING_STATUS, 1) >> 4) == bits
    for t, ongoing in ((t3 - 1.0, 1), (t3 + 1.0, 0)):
        if t > 0.0:
            host.t = start + 1e-3 * t
            assert host.read(MOVING_STATUS, 1) >> 1 & 1 == ongoing
            assert host.read(MOVING, 1) >= ongoing
    host.t = start + 1e-3 * t3 + 10.0  # a step is over at once, the motor is not
    assert host.read(POSITION_TRAJECTORY, 4, signed=True) == 1000 + distance
    assert (host.read(VELOCITY_TRAJECTORY, 4, signed=True), host.read(MOVING, 1)) == (0, 0)


@pytest.mark.parametrize("seed", range(12))
def test_velocity_based_profiles(seed: int) -> None:
    """Trapezoids, triangles, rectangles and steps, both ways, short and long, by seed."""
    rng = random.Random(seed)
    v = 0 if seed == 0 else rng.randint(1, 200)
    a = 0 if seed in (1, 2) else rng.choice((rng.randint(1, 20), rng.randint(20, 2000)))
    distance = rng.choice((-1, 1)) * rng.choice((rng.randint(5, 100), rng.randint(100, 20_000)))
    bits, t3, pulses = manuals_profile(abs(distance), v, a)
    check(host_with(v, a), distance, bits, t3, pulses)


def test_all_shapes_are_among_the_seeds() -> None:
    host = host_with(100, 10)
    shapes = []
    for v, a, distance in ((0, 10, 500), (100, 0, 500), (100, 10, 100), (100, 10, 5000)):
        bits, _, _ = manuals_profile(distance, v, a)
        host.write(PROFILE_ACCELERATION, a)
        host.write(PROFILE_VELOCITY, v)
        host.move(host.read(GOAL, 4) + distance, 30.0)
        assert host.read(MOVING_STATUS, 1) >> 4 == bits
        shapes.append(bits)
    assert shapes == [0, 1, 2, 3]


@pytest.mark.parametrize(("v", "a", "distance"), [(200, 40, 2000), (100, 1, 30_000), (50, 5, 1000)])
def test_times_are_those_of_the_manuals_rounded_formula(v: int, a: int, distance: int) -> None:
    """t1 = 64 V / A and t2 = 64 distance / V: the manual rounds 64.03 and 63.97; within 0.1 % and a millisecond."""
    host = host_with(v, a)
    host.write(GOAL, 1000 + distance)
    t3 = 64 * v / a + 64 * distance / v
    for t, ongoing in ((t3 * 0.999 - 1, 1), (t3 * 1.001 + 1, 0)):
        host.t = 1e-3 * t
        assert host.read(MOVING_STATUS, 1) >> 1 & 1 == ongoing


@pytest.mark.parametrize(("total", "rising"), [(1000, 250), (1000, 500), (1000, 900), (800, 0), (30_000, 1)])
@pytest.mark.parametrize("distance", [900, -1500])
def test_time_based_profiles(total: int, rising: int, distance: int) -> None:
    """Expected: it takes Profile Velocity milliseconds whatever the distance; the rise is cut to half of that."""
    host = host_with(total, rising, drive_mode=4)
    t3, pulses = manuals_times(abs(distance), total, rising)
    bits = 1 if rising == 0 else 3 if rising < total / 2 else 2
    host.write(GOAL, 1000 + distance)
    for k in range(1, 41):
        t = t3 * k / 40
        host.t = 1e-3 * t
        wanted = 1000 + math.copysign(pulses(t), distance)
        assert abs(host.read(POSITION_TRAJECTORY, 4, signed=True) - wanted) <= 1.0
        assert host.read(MOVING_STATUS, 1) >> 4 == bits or rising == total / 2
    host.t = 1e-3 * (t3 + 1)
    assert host.read(MOVING_STATUS, 1) >> 1 & 1 == 0


def test_a_new_goal_overrides_velocity_without_a_jump() -> None:
    """Expected: position and velocity go on from where they were; a slower profile brakes to its own velocity."""
    host = host_with(200, 20)
    host.write(GOAL, 9000)
    host.t = 1.0
    before = (host.read(POSITION_TRAJECTORY, 4), host.read(VELOCITY_TRAJECTORY, 4))
    host.write(PROFILE_VELOCITY, 50)
    host.t = 1.001
    assert host.read(VELOCITY_TRAJECTORY, 4) == before[1]  # only a new goal makes a new profile
    host.write(GOAL, 9500)
    host.t = 1.002
    after = (host.read(POSITION_TRAJECTORY, 4), host.read(VELOCITY_TRAJECTORY, 4))
    assert abs(after[0] - before[0] - 2 * 200 * PULSES_PER_MS) <= 1.5
    assert before[1] - after[1] <= 1
    host.t = 1.001 + 1e-3 * 64.03 * 150 / 20 + 0.01
    assert host.read(VELOCITY_TRAJECTORY, 4) == 50
    host.t = 1.1
    host.write(GOAL, 1000)  # and turns round
    host.t = 100.0
    assert host.read(POSITION_TRAJECTORY, 4) == 1000


def test_the_shaft_follows_and_says_when_it_cannot() -> None:
    """Rationale: a profile faster than the motor leaves it behind. Expected: bit 3, and 46 rev/min meanwhile."""
    host = host_with(1000, 0)
    host.write(GOAL, 1000 + 20_000)
    host.t = 1.0
    assert host.read(MOVING_STATUS, 1) >> 3 & 1 == 1
    assert host.read(128, 4) == round(46 / 0.229)
    host.t = 60.0
    assert host.read(MOVING_STATUS, 1) & 0b1001 == 0b0001


def test_the_mode_of_velocity_ramps_and_keeps_its_speed() -> None:
    """Expected: Profile Acceleration alone; Velocity Trajectory ends at the goal, Moving says so, no goal bits."""
    host = host_with(20, 10, mode=1)
    host.write(104, -150)
    t1 = 150 * PULSES_PER_MS / (10 * PULSES_PER_MS2) * 1e-3
    host.t = 0.5 * t1
    assert host.read(VELOCITY_TRAJECTORY, 4, signed=True) == pytest.approx(-75, abs=1)
    assert host.read(128, 4, signed=True) == pytest.approx(-75, abs=1)
    host.t = t1 + 10.0
    assert (host.read(VELOCITY_TRAJECTORY, 4, signed=True), host.read(128, 4, signed=True)) == (-150, -150)
    wanted = 1000 - 150e3 * PULSES_PER_MS * (10.0 + 0.5 * t1)
    assert host.position() == pytest.approx(wanted, abs=1)
    assert (host.read(MOVING, 1), host.read(MOVING_STATUS, 1)) == (1, 0b110000)
    host.write(104, 0)
    host.t += t1 + 0.001
    assert (host.read(128, 4), host.read(MOVING, 1)) == (0, 0)
