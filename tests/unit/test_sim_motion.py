"""Motion profiles against the manual's formulas and against Newton."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sim.dynamixel import motion
from sim.dynamixel.motion import ACCELERATION_UNIT, VELOCITY_UNIT
from sim.dynamixel.shaft import Shaft


def test_trapezoid_has_the_manuals_times() -> None:
    """t1 = 64 V / A ms and t3 = t1 + 64 distance / V ms, in register units (the factor is 64 within 0.1 %)."""
    v, a, distance = 200, 40, 2000
    move = motion.plan(0.0, 1000.0, 0.0, 1000.0 + distance, v * VELOCITY_UNIT, a * ACCELERATION_UNIT)
    assert move.shape == "trapezoid"
    assert move.segments[1].start == pytest.approx(64e-3 * v / a, rel=1e-3)
    assert move.duration == pytest.approx(64e-3 * v / a + 64e-3 * distance / v, rel=1e-3)


def test_trapezoid_at_given_times() -> None:
    # 100 counts at 20 counts/s with 10 counts/s^2: 2 s of acceleration over 20 counts, 3 s at speed, 2 s of braking.
    move = motion.plan(5.0, 0.0, 0.0, -100.0, 20.0, 10.0)
    wanted = [(5, 0, 0), (6, -5, -10), (7, -20, -20), (8.5, -50, -20), (10, -80, -20), (11, -95, -10), (12, -100, 0)]
    for time, position, velocity in wanted:
        assert move.at(time) == pytest.approx((position, velocity), abs=1e-12)
    assert not move.done(11.999)
    assert move.done(12.0)
    assert move.at(4.0) == (0.0, 0.0)


def test_triangle_rectangle_and_step() -> None:
    triangle = motion.plan(0.0, 0.0, 0.0, 40.0, 100.0, 10.0)
    assert (triangle.shape, triangle.duration, triangle.at(2.0)) == ("triangle", 4.0, (20.0, 20.0))
    rectangle = motion.plan(0.0, 10.0, 7.0, 0.0, 5.0, math.inf)
    assert (rectangle.shape, rectangle.duration, rectangle.at(1.0)) == ("rectangle", 2.0, (5.0, -5.0))
    step = motion.plan(0.0, 0.0, 0.0, 9.0, math.inf, 10.0)
    assert (step.shape, step.at(0.0)) == ("step", (9.0, 0.0))


@pytest.mark.parametrize("velocity", [-30.0, -5.0, 0.0, 5.0, 15.0, 30.0])
@pytest.mark.parametrize("goal", [-80.0, -3.0, 0.0, 3.0, 80.0])
def test_a_new_goal_continues_from_position_and_speed(velocity: float, goal: float) -> None:
    """No jump in position or speed, never more than the acceleration, and the goal at the end."""
    move = motion.plan(1.0, 0.0, velocity, goal, 20.0, 10.0)
    assert move.at(1.0) == pytest.approx((0.0, velocity))
    step = move.duration / 4000
    before = move.at(1.0)
    for k in range(1, 4001):
        now = move.at(1.0 + k * step)
        assert abs(now[1] - before[1]) <= 10.0 * step * (1 + 1e-6) + 1e-9
        assert now[0] - before[0] == pytest.approx(0.5 * (now[1] + before[1]) * step, abs=2e-3 * step * 20.0 + 1e-9)
        before = now
    assert move.at(1.0 + move.duration * (1 - 1e-9)) == pytest.approx((goal, 0.0), abs=1e-5)
    turns = move.turning_times()
    assert all(abs(move.at(turn)[1]) < 1e-9 for turn in turns)


def _shaft(**changes: object) -> Shaft:
    settings: dict[str, object] = {"fastest": 3000.0, "backlash": 4.0, "friction": (0.0, 0.0), "seed": "1"}
    return Shaft(0.0, **(settings | changes))  # type: ignore[arg-type]


def test_the_link_lags_by_half_the_play_on_the_side_it_came_from() -> None:
    shaft = _shaft()
    shaft.go(0.0, 100, 100.0, 1000.0)
    assert shaft.link(50.0) == 98.0
    shaft.go(50.0, 0, 100.0, 1000.0)
    assert shaft.link(100.0) == 2.0


def test_a_reversal_smaller_than_the_play_does_not_move_the_link() -> None:
    shaft = _shaft()
    shaft.go(0.0, 100, 100.0, 1000.0)
    shaft.go(50.0, 97, 100.0, 1000.0)
    assert (shaft.at(100.0)[0], shaft.link(100.0)) == (97.0, 98.0)
    shaft.go(100.0, 95, 100.0, 1000.0)
    assert (shaft.at(150.0)[0], shaft.link(150.0)) == (95.0, 97.0)


def test_the_link_remembers_an_overshoot() -> None:
    """Braking past the goal drags the link along, and coming back leaves it there if the play allows."""
    shaft = _shaft(backlash=400.0)
    shaft.go(0.0, 1000, 100.0, 50.0)
    position, velocity = shaft.at(5.0)
    shaft.go(5.0, round(position), 100.0, 50.0)
    furthest = motion.stopping_point(position, velocity, 50.0)
    assert shaft.at(60.0)[0] == round(position)
    assert shaft.link(60.0) == pytest.approx(furthest - 200.0)


def test_friction_stops_short_on_the_side_of_the_approach() -> None:
    shaft = _shaft(friction=(0.2, 3.0), backlash=0.0)
    shaft.go(0.0, 500, 1000.0, 1000.0)
    assert 0.2 <= 500 - shaft.at(100.0)[0] <= 3.0
    shaft.go(100.0, 900, 1000.0, 1000.0)
    shaft.go(200.0, 500, 1000.0, 1000.0)
    assert 0.2 <= shaft.at(300.0)[0] - 500 <= 3.0


def test_friction_is_the_same_along_the_same_way_and_differs_along_another() -> None:
    """The rounding errors of two poses at one goal are independent, and a resumed scan soon meets the same ones again."""

    def rest(*goals: int) -> float:
        shaft = _shaft(friction=(0.2, 3.0), backlash=0.0)
        for k, goal in enumerate(goals):
            shaft.go(100.0 * k, goal, 1000.0, 1000.0)
        return shaft.at(100.0 * len(goals))[0]

    assert rest(900, 100, 400, 500) == rest(-700, 100, 400, 500)
    ways = {rest(start, 400, 500) for start in range(-1000, 0, 50)}
    assert len(ways) == 20 and np.std(list(ways)) > 0.4  # uniform over 2.8 counts: 0.8


def test_a_goal_within_friction_moves_nothing() -> None:
    shaft = _shaft(friction=(2.0, 2.0))
    shaft.go(0.0, 500, 1000.0, 1000.0)
    shaft.go(100.0, 499, 1000.0, 1000.0)
    assert shaft.at(200.0)[0] == 498.0
    shaft.go(200.0, 498, 1000.0, 1000.0)
    assert shaft.at(300.0)[0] == 498.0
