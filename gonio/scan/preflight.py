"""Before the first motion: every pose against limits and obstacles, the way between them, time and disk space.

It opens no device. What it finds is data; the command line prints it.
"""

from __future__ import annotations

import itertools
import math
import re
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from gonio import kinematics
from gonio.config import PlanConfig, RigConfig
from gonio.errors import ConfigurationError
from gonio.scan import zones
from gonio.scan.plan import AXES, LeftOut, Plan, Pose, approach_limits, move_seconds

_OUTSIDE = re.compile(r"(\w+) [-+.\d]+ deg is outside")
_FRAME_OVERHEAD_S = 0.005  # reading a frame out; cameras that need more say so only when they run
HOST_S = 0.025
"""Assumed for bus, camera and disk at each pose, on the wall's clock; a laptop needs 15 to 30 ms."""


@dataclass(frozen=True)
class Preflight:
    """What a scan would do.

    Attributes
    ----------
    plan : Plan
    exposures_s : tuple of float
    move_s, expose_s, reference_s : float
        Rig time of the moves, of the poses' exposures, and of dark and white frames [s].
    white_blocks : int
    frames : int
        Of all kinds.
    bytes : int
        That the frames need on disk.
    host_s : float
        Of the computer's own work: bus, camera and disk, on the wall's clock [s]; an assumption.
    speed : float
        Rig seconds per wall second.
    """

    plan: Plan
    exposures_s: tuple[float, ...]
    move_s: float
    expose_s: float
    reference_s: float
    white_blocks: int
    frames: int
    bytes: int
    host_s: float
    speed: float

    @property
    def seconds(self) -> float:
        """Of motion, exposures and rest, in rig time [s]; a simulated rig may hurry through them, `speed` times as fast."""
        return self.move_s + self.expose_s + self.reference_s

    @property
    def wall_s(self) -> float:
        """Of the whole scan, on the wall's clock [s]."""
        return self.seconds / self.speed + self.host_s

    def reasons(self) -> list[tuple[str, int, LeftOut]]:
        """Why geometries are left out: the kind of reason, how many have it, and the first one."""
        first: dict[str, LeftOut] = {}
        count: Counter[str] = Counter()
        for left_out in self.plan.left_out:
            kind = _kind(left_out.reasons)
            count[kind] += 1
            first.setdefault(kind, left_out)
        return [(kind, number, first[kind]) for kind, number in count.most_common()]

    def as_dict(self) -> dict[str, Any]:
        """JSON-compatible, angles in degrees."""
        return {
            "poses": len(self.plan.poses),
            "left_out": len(self.plan.left_out),
            "repeated": self.plan.repeated,
            "duration_s": self.seconds,
            "host_s": self.host_s,
            "wall_s": self.wall_s,
            "move_s": self.move_s,
            "expose_s": self.expose_s,
            "reference_s": self.reference_s,
            "exposures_s": list(self.exposures_s),
            "white_blocks": self.white_blocks,
            "frames": self.frames,
            "bytes": self.bytes,
            "reasons": [{"reason": kind, "count": number} for kind, number, _ in self.reasons()],
            "list": [
                {"index": p.index, **_degrees(p), **{f"{axis}_deg": math.degrees(p.joints[axis]) for axis in AXES}}
                for p in self.plan.poses
            ],
            "list_left_out": [{**_degrees(o), "reasons": list(o.reasons)} for o in self.plan.left_out],
        }


def check(plan: Plan, config: PlanConfig, rig: RigConfig) -> Preflight:
    """Check every pose of a plan against a rig, and estimate time and space.

    Raises
    ------
    ConfigurationError
        If a pose is beyond a limit or behind an obstacle, as in a run whose rig has been changed; nothing has moved.
    LimitError
        If the way between two poses leads through a zone; nothing has moved.
    """
    limits = approach_limits(rig.axes)
    for pose in plan.poses:
        arm, pan, tilt = (pose.joints[a] for a in AXES)
        against = kinematics.obstacles(arm, pan, tilt, limits, g_min=rig.g_min) + zones.reasons(pose.joints, rig)
        if against:
            raise ConfigurationError(f"pose {pose.index} cannot be taken: {'; '.join(against)}; plan it anew for this rig")
    exposures = config.bracket_s or rig.camera.exposures_s
    repeats = config.white_repeats or rig.white.repeats
    bracket_s = sum(exposures) + _FRAME_OVERHEAD_S * len(exposures)
    white = np.array([getattr(rig.white, axis) for axis in AXES])
    joints = np.array([[p.joints[a] for a in AXES] for p in plan.poses])  # (n, 3)
    n = len(plan.poses)
    every = config.white_every
    visits = [0, *(range(every, n, every) if every else ()), n]  # a white block before the pose of that number
    path = np.concatenate([np.vstack((white, joints[a:b])) for a, b in itertools.pairwise(visits)] + [white[None]])
    if rig.zones:
        for start, goal in itertools.pairwise(path):
            zones.stages(dict(zip(AXES, start, strict=True)), dict(zip(AXES, goal, strict=True)), rig)
    move_s = float(np.sum(move_seconds(path[:-1], path[1:], rig.axes)))
    dark_s = config.darks * bracket_s
    frames = (n + len(visits) * repeats + config.darks) * len(exposures)
    return Preflight(
        plan=plan,
        exposures_s=tuple(exposures),
        move_s=move_s + len(path) * rig.settle_s,
        expose_s=n * bracket_s,
        reference_s=dark_s + len(visits) * repeats * bracket_s + rig.lamp.warm_up_s,
        white_blocks=len(visits),
        frames=frames,
        bytes=frames * rig.camera.width * rig.camera.height * 2,
        host_s=n * HOST_S,
        speed=rig.sim.speed if rig.simulated and rig.sim else 1.0,
    )


def _degrees(where: Pose | LeftOut) -> dict[str, float]:
    return {f"{name}_deg": math.degrees(getattr(where, name)) for name in ("theta_i", "theta_r", "phi")}


def _kind(reasons: tuple[str, ...]) -> str:
    """The common part of the reasons of one geometry: what is in the way, without numbers."""
    text = " ".join(reasons)
    if "horizon" in text or "theta_max" in text or "behind the surface" in text:
        return "too steep for lamp or camera"
    if "lies in the zone" in text:
        return "in a zone of collision"
    if "hides" in text or "in line" in text:
        return "the light arm would hide the sample"
    outside = dict.fromkeys(_OUTSIDE.findall(text))
    return f"beyond the limits of {' or '.join(outside)}" if outside else "cannot be reached"
