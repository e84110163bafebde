"""Zones of joint angles in which parts of a rig would collide: no pose lies in one, no way leads through one.

A zone is a box of joint angles. The axes of a rig run at their own speeds and go beyond a goal to come back from one side,
so on its way from one pose to the next the rig may be anywhere in the box between the two, and the approach's overshoot
beyond. If that box meets a zone, the axes move one after another, in an order that meets none; if there is none, the move
is refused before a byte is sent. Pure geometry; it moves nothing.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping

from gonio.config import AxisConfig, RigConfig, ZoneConfig
from gonio.config.axis import COUNTS_PER_TURN
from gonio.errors import LimitError

Range = tuple[float, float]
_NEAR = 1e-9  # [rad]


def reasons(joints: Mapping[str, float], rig: RigConfig) -> tuple[str, ...]:
    """Why a pose [rad] cannot be taken: the zones in which the rig would be on its last approach. Empty if it can."""
    swept = _swept(joints, joints, rig.axes)
    return tuple(f"it lies in the zone {zone.name!r} ({_told(zone)})" for zone in _met(swept, rig.zones))


def stages(start: Mapping[str, float], goal: Mapping[str, float], rig: RigConfig) -> list[dict[str, float]]:
    """Goals on the way from one setting of the joints to another, all of which are safe.

    Parameters
    ----------
    start, goal : mapping of axis name to float
        Joint angles [rad].
    rig : RigConfig

    Returns
    -------
    list of dict of str to float
        Each with the axes that move in it: all of them at once in a single one, if no zone is in the way.

    Raises
    ------
    LimitError
        If every order of the axes leads through a zone.
    """
    met = _met(_swept(start, goal, rig.axes), rig.zones)
    if not met:
        return [dict(goal)]
    moving = [axis for axis in rig.axes if abs(goal[axis] - start[axis]) > _NEAR]
    for order in itertools.permutations(moving) if moving else ():
        here = dict(start)
        for axis in order:
            there = here | {axis: goal[axis]}
            if _met(_swept(here, there, rig.axes), rig.zones):
                break
            here = there
        else:
            return [{axis: goal[axis]} for axis in order]
    raise LimitError(
        f"the way from {_at(start)} to {_at(goal)} degrees leads through the zone {met[0].name!r} ({_told(met[0])}), in "
        "every order of the axes; nothing was sent: take a pose in between, or correct [[zone]] in rig.toml"
    )


def _swept(start: Mapping[str, float], goal: Mapping[str, float], axes: Mapping[str, AxisConfig]) -> dict[str, Range]:
    """Ranges in which the axes may be on the way [rad]; one that stands stays where it is."""
    swept = {}
    for name, axis in axes.items():
        low, high = min(start[name], goal[name]), max(start[name], goal[name])
        slack = axis.tolerance_counts * 2 * math.pi / COUNTS_PER_TURN
        if axis.approach == "up":
            low -= axis.overshoot
        elif axis.approach == "down":
            high += axis.overshoot
        swept[name] = (low - slack, high + slack)
    return swept


def _met(swept: Mapping[str, Range], zones: Iterable[ZoneConfig]) -> list[ZoneConfig]:
    return [
        zone
        for zone in zones
        if all(swept[axis][0] <= high and low <= swept[axis][1] for axis, (low, high) in zone.ranges.items())
    ]


def _told(zone: ZoneConfig) -> str:
    return ", ".join(
        f"{axis} {math.degrees(low):g} to {math.degrees(high):g} deg" for axis, (low, high) in zone.ranges.items()
    )


def _at(joints: Mapping[str, float]) -> str:
    return ", ".join(f"{axis} {math.degrees(angle):.2f}" for axis, angle in joints.items())
