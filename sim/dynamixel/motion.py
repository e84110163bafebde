"""Motion profiles in closed form: position and speed at any time, without ticks.

A profile starts at any position and speed, so that a new goal during a move continues from where the shaft is. It
knows constant accelerations only; no jerk limit, no load.

References
----------
ROBOTIS e-Manual, XM430-W350, "What is the Profile", https://emanual.robotis.com/docs/en/dxl/x/xm430-w350/
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

COUNTS_PER_TURN = 4096
VELOCITY_UNIT = 0.229 * COUNTS_PER_TURN / 60.0  # one unit of a velocity register: 0.229 rev/min [counts/s]
ACCELERATION_UNIT = 214.577 * COUNTS_PER_TURN / 3600.0  # one unit: 214.577 rev/min^2 [counts/s^2]

Shape = Literal["step", "rectangle", "triangle", "trapezoid"]


@dataclass(frozen=True)
class Segment:
    """A stretch of constant acceleration, beginning `start` seconds after the motion [s, counts, counts/s, counts/s^2]."""

    start: float
    position: float
    velocity: float
    acceleration: float


@dataclass(frozen=True)
class Motion:
    """A move, evaluated at any time from its start on.

    Attributes
    ----------
    start : float
        Time at which it begins [s].
    goal : float
        Where it ends [counts].
    duration : float
        How long it takes [s].
    shape : str
        Of its speed over time.
    segments : tuple of Segment
    final_velocity : float
        With which it goes on when its profile is over [counts/s].
    """

    start: float
    goal: float
    duration: float
    shape: Shape
    segments: tuple[Segment, ...]
    final_velocity: float = 0.0

    @property
    def end(self) -> float:
        """When its profile is over [s]."""
        return self.start + self.duration

    def done(self, time: float) -> bool:
        """Whether its profile is over."""
        return time - self.start >= self.duration

    def at(self, time: float) -> tuple[float, float]:
        """Position [counts] and speed [counts/s] at `time` [s]."""
        elapsed = max(time - self.start, 0.0)
        if elapsed >= self.duration:
            return self.goal + self.final_velocity * (elapsed - self.duration), self.final_velocity
        segment = self.segments[0]
        for candidate in self.segments[1:]:
            if candidate.start > elapsed:
                break
            segment = candidate
        tau = elapsed - segment.start
        # x = x0 + v0 tau + a tau^2 / 2
        position = segment.position + tau * (segment.velocity + 0.5 * segment.acceleration * tau)
        return position, segment.velocity + segment.acceleration * tau

    def turning_times(self) -> tuple[float, ...]:
        """Times at which the direction reverses [s]."""
        times = []
        ends = [segment.start for segment in self.segments[1:]] + [self.duration]
        for segment, end in zip(self.segments, ends, strict=False):
            if segment.acceleration != 0.0:
                tau = -segment.velocity / segment.acceleration
                if 0.0 < tau < end - segment.start:
                    times.append(self.start + segment.start + tau)
        return tuple(times)


def rest(time: float, position: float) -> Motion:
    """Standing still at `position` [counts] since `time` [s]."""
    return Motion(time, position, 0.0, "step", ())


def spin(time: float, position: float, velocity: float, wanted: float, acceleration: float) -> Motion:
    """Change the speed from `velocity` to `wanted` [counts/s] at `acceleration` (may be infinite), and keep it."""
    if math.isinf(acceleration) or velocity == wanted:
        return Motion(time, position, 0.0, "step", (), wanted)
    duration = abs(wanted - velocity) / acceleration
    ramp = Segment(0.0, position, velocity, math.copysign(acceleration, wanted - velocity))
    return Motion(time, position + 0.5 * (velocity + wanted) * duration, duration, "trapezoid", (ramp,), wanted)


def limits_of_times(distance: float, total: float, rising: float) -> tuple[float, float]:
    """Speed [counts/s] and acceleration [counts/s^2] of a time-based profile; both may be infinite.

    Parameters
    ----------
    distance : float
        From rest to rest [counts].
    total, rising : float
        The manual's t3 and t1 [s]; t1 counts as at most half of t3. 0 for an infinite speed or acceleration.

    Notes
    -----
    A trapezoid of speed v covers v (t3 - t1), and a = v / t1.
    """
    rising = min(rising, 0.5 * total)
    if total <= 0.0 or distance == 0.0:
        return math.inf, math.inf
    speed = abs(distance) / (total - rising)
    return speed, speed / rising if rising > 0.0 else math.inf


def stopping_point(position: float, velocity: float, acceleration: float) -> float:
    """Where something at `position` with `velocity` stops when it brakes at `acceleration` (may be infinite)."""
    return position + velocity * abs(velocity) / (2.0 * acceleration)


def plan(time: float, position: float, velocity: float, goal: float, speed: float, acceleration: float) -> Motion:
    """Move from `position` and `velocity` at `time` to rest at `goal`.

    Parameters
    ----------
    time : float
        Start [s].
    position, goal : float
        [counts]
    velocity : float
        At the start [counts/s]; dropped if `acceleration` is infinite.
    speed : float
        Largest speed [counts/s]; infinite for a step.
    acceleration : float
        [counts/s^2]; infinite for a rectangle.

    Returns
    -------
    Motion

    Notes
    -----
    Along the direction d of the goal as seen from the stopping point, with D = d (goal - position), u = d velocity,
    acceleration a and peak speed w = sqrt(a D + u^2 / 2), capped at `speed`: the time to the peak is abs(w - u) / a, and
    w / a from the peak to rest; what distance remains is run at w. From rest, with registers V and A, these are the
    manual's t1 = 64 V / A ms and t2 - t1 = 64 D / V ms - t1.
    """
    if math.isinf(speed):
        return Motion(time, goal, 0.0, "step", ())
    if math.isinf(acceleration):
        distance = abs(goal - position)
        direction = math.copysign(1.0, goal - position)
        return Motion(time, goal, distance / speed, "rectangle", (Segment(0.0, position, direction * speed, 0.0),))

    direction = math.copysign(1.0, goal - stopping_point(position, velocity, acceleration))
    distance = direction * (goal - position)
    u = direction * velocity
    peak = math.sqrt(max(acceleration * distance + 0.5 * u * u, 0.0))
    shape: Shape = "triangle"
    if peak > speed:
        peak, shape = speed, "trapezoid"
    first = math.copysign(acceleration, peak - u)
    t_first = (peak - u) / first
    t_last = peak / acceleration
    d_first = t_first * 0.5 * (u + peak)
    d_last = t_last * 0.5 * peak
    t_cruise = (distance - d_first - d_last) / peak if shape == "trapezoid" else 0.0
    t_cruise = max(t_cruise, 0.0)
    d_cruise = t_cruise * peak
    cruise_from = position + direction * d_first
    brake_from = position + direction * (d_first + d_cruise)
    segments = (
        Segment(0.0, position, velocity, direction * first),
        Segment(t_first, cruise_from, direction * peak, 0.0),
        Segment(t_first + t_cruise, brake_from, direction * peak, -direction * acceleration),
    )
    return Motion(time, goal, t_first + t_cruise + t_last, shape, segments)
