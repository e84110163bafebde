"""What every axis, camera and lamp must do, as checks that run on any of them: built in, simulated, plugged in, on a bench.

Each check tries a device and returns what it broke, one sentence each; an empty list is a pass. The author of a camera
plug-in runs `camera` on it (docs/howto-add-a-camera.md). `axis` and `axis_group` move axes within the ranges they are given,
`lamp` switches the lamp. They know the interfaces of `gonio.interfaces` and nothing else.
"""

from __future__ import annotations

import functools
import itertools
import json
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from gonio.errors import ConfigurationError, GonioError, LimitError
from gonio.interfaces import Axis, AxisGroup, Camera, Clock, Frame, Lamp

_POLL_S = 0.02
_NOT_EXPOSURES = (0.0, -1.0, math.nan, math.inf)
_NOT_LEVELS = (-0.01, 1.01, math.nan)


def camera(device: Camera, exposures_s: Sequence[float], clock: Clock) -> list[str]:
    """Take a few frames with each exposure, and some that must be refused; the camera is closed at the end.

    Parameters
    ----------
    device : Camera
    exposures_s : sequence of float
        Exposures that it offers, ascending [s].
    clock : Clock
        Of the rig, in which frames carry their times.
    """
    broken = _described(device.name, device.describe)
    frames: list[Frame] = []
    for exposure_s in exposures_s:
        for repeat in range(2):
            label = f"contract {exposure_s:g} {repeat}"
            before_s = clock.now()
            frame = device.capture(exposure_s, label=label)
            broken += _frame(frame, exposure_s, label, before_s, clock.now())
            frames.append(frame)
    if len({frame.data.shape for frame in frames}) > 1:
        broken.append("frames differ in shape")
    if any(b.timestamp_s <= a.timestamp_s for a, b in itertools.pairwise(frames)):
        broken.append("timestamp_s does not rise from frame to frame")
    means = [float(np.mean([f.data.mean() for f in frames[2 * k : 2 * k + 2]])) for k in range(len(exposures_s))]
    noise = max(float(f.data.std()) for f in frames) / math.sqrt(frames[0].data.size)
    if any(b < a - 6.0 * noise for a, b in itertools.pairwise(means)):
        broken.append(f"a longer exposure gives a darker frame: means {', '.join(f'{m:.1f}' for m in means)} DN")
    take = functools.partial(device.capture, label="contract")
    for wrong in _NOT_EXPOSURES:
        broken += _refuses(functools.partial(take, wrong), GonioError, f"an exposure of {wrong} s")
    device.close()
    device.close()  # a second time does nothing
    return broken


def _frame(frame: Frame, exposure_s: float, label: str, before_s: float, after_s: float) -> list[str]:
    broken = []
    if frame.data.ndim != 2 or frame.data.dtype != np.uint16:
        broken.append(f"data is {frame.data.dtype} of shape {frame.data.shape}; it must be uint16 (height, width)")
    if not 8 <= frame.bit_depth <= 16 or int(frame.data.max(initial=0)) >= 2**frame.bit_depth:
        broken.append(f"bit_depth = {frame.bit_depth} does not hold counts up to {frame.data.max(initial=0)}")
    if not 0 < frame.saturation_dn < 2**frame.bit_depth:
        broken.append(f"saturation_dn = {frame.saturation_dn} is not within {frame.bit_depth} bits")
    if not math.isclose(frame.exposure_s, exposure_s, rel_tol=0.5):
        broken.append(f"exposure_s = {frame.exposure_s:g} where {exposure_s:g} was asked for")
    if not frame.gain > 0.0:
        broken.append(f"gain = {frame.gain}; it must be above 0")
    if frame.label != label:
        broken.append(f"label {frame.label!r} where {label!r} was given")
    if not before_s <= frame.timestamp_s <= after_s:
        broken.append(f"timestamp_s = {frame.timestamp_s:.4f} is outside the call, {before_s:.4f} to {after_s:.4f}")
    return broken


def axis(device: Axis, lower: float, upper: float, clock: Clock, *, timeout_s: float = 60.0) -> list[str]:
    """Move to both ends of a range and stop half-way; the axis ends near `lower`, holding.

    Parameters
    ----------
    device : Axis
        Connected.
    lower, upper : float
        A range within its limits, at least 5 degrees wide, in which nothing is in the way [rad].
    clock : Clock
        Of the rig.
    timeout_s : float, optional
        For each move, in rig time [s].
    """
    broken = _described(device.name, device.describe)
    near = math.radians(1.5)
    limits = device.limits
    for end in (lower, upper):
        device.move_to(end)
        if not _settles(device, clock, timeout_s):
            broken.append(f"it is not settled {timeout_s:g} s after move_to({math.degrees(end):g} deg)")
        reading = device.read()
        if abs(reading.angle - end) > near or reading.moving:
            broken.append(f"at rest it reads {math.degrees(reading.angle):.2f} deg, its goal was {math.degrees(end):g} deg")
    here = device.read()
    for beyond in (limits.upper + 0.1, limits.lower - 0.1, math.nan):
        broken += _refuses(functools.partial(device.move_to, beyond), LimitError, f"move_to({math.degrees(beyond):g} deg)")
        broken += _refuses(functools.partial(device.check, beyond), LimitError, f"check({math.degrees(beyond):g} deg)")
    if device.read().goal_counts != here.goal_counts:
        broken.append("a move that was refused changed the goal")
    device.move_to(lower)
    clock.sleep(0.25 * abs(upper - lower) / limits.velocity)
    device.stop()
    if not _settles(device, clock, timeout_s):
        broken.append("it does not come to rest after stop()")
    stopped = device.read()
    clock.sleep(0.5)
    if device.read().position_counts != stopped.position_counts:
        broken.append("it still moves after stop()")
    device.move_to(lower)
    if not _settles(device, clock, timeout_s):
        broken.append("it does not go on after stop()")
    return broken


def axis_group(
    group: AxisGroup, ranges: Mapping[str, tuple[float, float]], clock: Clock, *, timeout_s: float = 60.0
) -> list[str]:
    """Move all axes together to both ends of their ranges; they end near the upper ones.

    Parameters
    ----------
    group : AxisGroup
    ranges : mapping of axis name to (float, float)
        Within the limits of each axis, in which nothing is in the way [rad].
    clock : Clock
        Of the rig.
    timeout_s : float, optional
        For each move, in rig time [s].
    """
    broken = []
    near = math.radians(1.5)
    for which in (0, 1):
        goals = {name: ends[which] for name, ends in ranges.items()}
        group.move_to(goals)
        waiting, end_s = list(goals), clock.now() + timeout_s
        while waiting and clock.now() < end_s:
            clock.sleep(_POLL_S)
            waiting = [name for name, settled in group.settled(waiting).items() if not settled]
        broken += [f"{name} is not settled {timeout_s:g} s after move_to" for name in waiting]
        readings = group.read()
        for name, goal in goals.items():
            angle = readings[name].angle
            if abs(angle - goal) > near or readings[name].moving:
                broken.append(f"{name} reads {math.degrees(angle):.2f} deg at rest, its goal was {math.degrees(goal):g} deg")
    before = {name: reading.goal_counts for name, reading in group.read().items()}
    names = list(ranges)
    beyond = {names[0]: ranges[names[0]][0], names[-1]: math.nan}
    broken += _refuses(functools.partial(group.move_to, beyond), LimitError, f"move_to with {names[-1]} at nan")
    if {name: reading.goal_counts for name, reading in group.read().items()} != before:
        broken.append("a move of which one goal was refused changed a goal")
    return broken


def _settles(device: Axis, clock: Clock, timeout_s: float) -> bool:
    end_s = clock.now() + timeout_s
    while not device.settled():
        if clock.now() > end_s:
            return False
        clock.sleep(_POLL_S)
    return True


def lamp(device: Lamp) -> list[str]:
    """Switch, set levels, and some that must be refused; the lamp is off and closed at the end."""
    broken = _described(device.name, device.describe)
    for level in (0.5, 1.0):
        device.set_level(level)
    for on in (True, True, False, False, True):
        device.set_output(on)
    for wrong in _NOT_LEVELS:
        broken += _refuses(functools.partial(device.set_level, wrong), ConfigurationError, f"a level of {wrong}")
    device.set_output(False)
    device.close()
    device.close()
    return broken


def _described(name: str, describe: Callable[[], Mapping[str, object]]) -> list[str]:
    broken = [] if isinstance(name, str) and name else ["it has no name"]
    try:
        json.dumps(dict(describe()), allow_nan=False)
    except (TypeError, ValueError) as error:
        broken.append(f"describe() is not JSON-compatible: {error}")
    return broken


def _refuses(action: Callable[[], object], error: type[GonioError], what: str) -> list[str]:
    """Whether something that must not be done raises the error that it should."""
    try:
        action()
    except error:
        return []
    except Exception as other:  # noqa: BLE001 - any other one is the breach that is told
        return [f"{what} raises {type(other).__name__}, not {error.__name__}"]
    return [f"{what} is taken; it must raise {error.__name__}"]


