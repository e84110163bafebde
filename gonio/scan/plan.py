"""From a plan file to poses: which geometries, with which joint angles, in which order.

For an isotropic sample up to four settings of the joints give one geometry. They are used in turn, because an error of an
axis' zero shifts them in different directions and shows itself only so. What cannot be reached is listed with its reasons
and never dropped in silence. The plan of a run is made once and kept with it; a resumed scan does not plan again.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gonio import geometry, halfdiff, kinematics
from gonio.config import AxisConfig, PlanConfig, RigConfig
from gonio.errors import ConfigurationError, DatasetError
from gonio.interfaces import AxisLimits
from gonio.scan import zones

Array = NDArray[np.float64]
AXES = kinematics.AXES
SETTLE_S = 0.05  # two equal readings this far apart end a move (see drivers)
_GREEDY_LIMIT = 5000  # poses; beyond, the search for the nearest one takes longer than it saves


@dataclass(frozen=True)
class Pose:
    """One setting of the rig: its number, the geometry [rad] with phi = phi_r - phi_i, and the joint angles [rad]."""

    index: int
    theta_i: float
    theta_r: float
    phi: float
    joints: Mapping[str, float]


@dataclass(frozen=True)
class LeftOut:
    """A geometry [rad] that is not measured, and why not."""

    theta_i: float
    theta_r: float
    phi: float
    reasons: tuple[str, ...]


@dataclass(frozen=True)
class Plan:
    """Poses in the order in which they are taken, and the geometries that are not.

    Attributes
    ----------
    poses : tuple of Pose
    left_out : tuple of LeftOut
    repeated : int
        How many geometries were written more than once (such as one of normal incidence at several phi).
    """

    poses: tuple[Pose, ...]
    left_out: tuple[LeftOut, ...]
    repeated: int

    def to_json(self) -> str:
        """The poses as text, exact, to be kept with a run."""
        return json.dumps([[p.index, p.theta_i, p.theta_r, p.phi, *(p.joints[a] for a in AXES)] for p in self.poses])

    @classmethod
    def from_json(cls, text: str) -> Plan:
        """The poses of a text written by `to_json`; what was left out is not in it.

        Raises
        ------
        DatasetError
            If the text holds no poses.
        """
        try:
            rows = [[int(row[0]), *(float(v) for v in row[1:])] for row in json.loads(text)]
            if any(len(row) != 4 + len(AXES) for row in rows):
                raise ValueError("a row has the wrong length")
        except (ValueError, TypeError, IndexError, KeyError, RecursionError) as error:
            raise DatasetError(f"the run's list of poses cannot be read ({error}); run `gonio verify`") from error
        poses = (Pose(int(r[0]), r[1], r[2], r[3], dict(zip(AXES, r[4:], strict=True))) for r in rows)
        return cls(tuple(poses), (), 0)


def make_plan(plan: PlanConfig, rig: RigConfig) -> Plan:
    """The poses of a plan on a rig.

    Raises
    ------
    ConfigurationError
        If none of them can be reached.
    """
    limits = approach_limits(rig.axes)
    found: list[Pose] = []
    left_out: list[LeftOut] = []
    seen: set[tuple[int, int, int]] = set()
    repeated = 0
    for theta_i, theta_r, phi in _geometries(plan):
        key = _canonical(theta_i, theta_r, phi)
        if key in seen:
            repeated += 1
            continue
        seen.add(key)
        reasons = _too_steep(theta_i, theta_r, plan.theta_max)
        if reasons:
            left_out.append(LeftOut(theta_i, theta_r, phi, reasons))
            continue
        reach = kinematics.reach(theta_i, theta_r, phi, limits, g_min=rig.g_min)
        reasons, solutions = reach.reasons, []
        for joints in (solution._asdict() for solution in reach.solutions):
            against = zones.reasons(joints, rig)
            reasons += against
            if not against:
                solutions.append(joints)
        if not solutions:
            left_out.append(LeftOut(theta_i, theta_r, phi, reasons))
            continue
        found.append(Pose(len(found), theta_i, theta_r, phi, solutions[len(found) % len(solutions)]))
    if not found:
        first = left_out[0].reasons[0] if left_out else "there are none"
        raise ConfigurationError(
            f"none of the plan's {len(left_out)} geometries can be reached; of the first: {first}. Change plan.toml or the "
            "limits in rig.toml"
        )
    if plan.order == "short":
        start = np.array([getattr(rig.white, axis) for axis in AXES])
        order = _short_order(np.array([[p.joints[a] for a in AXES] for p in found]), start, rig.axes)
        found = [found[k] for k in order]
    numbered = (Pose(n, p.theta_i, p.theta_r, p.phi, p.joints) for n, p in enumerate(found))
    return Plan(tuple(numbered), tuple(left_out), repeated)


def approach_limits(axes: Mapping[str, AxisConfig]) -> dict[str, AxisLimits]:
    """Limits within which every goal can be approached from its one side: an overshoot must fit in before it."""
    limits = {}
    for name, axis in axes.items():
        lower = axis.lower + (axis.overshoot if axis.approach == "up" else 0.0)
        upper = axis.upper - (axis.overshoot if axis.approach == "down" else 0.0)
        limits[name] = AxisLimits(lower, upper, axis.velocity)
    return limits


def move_seconds(start: ArrayLike, goal: ArrayLike, axes: Mapping[str, AxisConfig]) -> Array:
    """Time that a move of all axes takes, from profile math.

    Parameters
    ----------
    start, goal : array_like, shapes broadcast to (..., 3)
        Joint angles, in the order of `AXES` [rad].

    Returns
    -------
    ndarray, shape (...)
        [s], with the second leg of a one-sided approach and the time to see that the axis stands.
    """
    delta = np.asarray(goal, dtype=float) - np.asarray(start, dtype=float)
    longest = np.zeros(delta.shape[:-1])
    for k, name in enumerate(AXES):
        axis, d = axes[name], delta[..., k]
        wrong_way = {"up": d < axis.overshoot, "down": -d < axis.overshoot, "any": np.zeros(d.shape, bool)}[axis.approach]
        wrong_way = wrong_way & (d != 0.0)
        side = -1.0 if axis.approach == "up" else 1.0
        direct = _profile_seconds(np.abs(d), axis) + SETTLE_S
        first = _profile_seconds(np.abs(d + side * axis.overshoot), axis) + SETTLE_S
        second = _profile_seconds(np.asarray(axis.overshoot), axis) + SETTLE_S
        longest = np.maximum(longest, np.where(wrong_way, first + second, direct))
    return longest


def _profile_seconds(distance: Array, axis: AxisConfig) -> Array:
    """Trapezoidal profile: d/v + v/a, or 2 sqrt(d/a) if the full speed is not reached."""
    v, a = axis.velocity, axis.acceleration
    return np.where(distance >= v * v / a, distance / v + v / a, 2.0 * np.sqrt(distance / a))


def _geometries(plan: PlanConfig) -> Iterator[tuple[float, float, float]]:
    """theta_i, theta_r, phi_r - phi_i of all that the plan asks for, as written."""
    for grid in plan.grids:
        first, second, third = (a.ravel() for a in np.meshgrid(grid.first, grid.second, grid.third, indexing="ij"))
        if grid.kind == "half":
            omega_i, omega_r = halfdiff.directions(first, 0.0, second, third)
            (theta_i, phi_i), (theta_r, phi_r) = geometry.angles(omega_i), geometry.angles(omega_r)
            phi = geometry.wrap(phi_r - phi_i)
            phi = np.where(np.abs(phi - np.pi) < 1e-12, np.pi, phi)
            # at theta_h = 0 both angles are theta_d, and no rounding error may say otherwise
            theta_i, theta_r = (np.where(np.abs(t - second) < 1e-14, second, t) for t in (theta_i, theta_r))
        else:
            theta_i, theta_r, phi = first, second, third
        yield from zip(theta_i.tolist(), theta_r.tolist(), phi.tolist(), strict=True)
    yield from plan.poses


def _canonical(theta_i: float, theta_r: float, phi: float) -> tuple[int, int, int]:
    """A key that geometries share if an isotropic sample cannot tell them apart."""
    folded = abs(math.remainder(phi, 2 * math.pi))
    if min(theta_i, theta_r) < 1e-9:
        folded = 0.0
    return round(theta_i * 1e9), round(theta_r * 1e9), round(folded * 1e9)


def _too_steep(theta_i: float, theta_r: float, theta_max: float) -> tuple[str, ...]:
    reasons = []
    for what, theta in (("theta_i", theta_i), ("theta_r", theta_r)):
        if theta >= math.pi / 2 - 1e-9:
            reasons.append(f"{what} {math.degrees(theta):.2f} deg is below the sample's horizon")
        elif theta > theta_max + 1e-9:
            reasons.append(f"{what} {math.degrees(theta):.2f} deg is beyond theta_max_deg {math.degrees(theta_max):.2f}")
    return tuple(reasons)


def _short_order(joints: Array, start: Array, axes: Mapping[str, AxisConfig]) -> list[int]:
    """Always on to the pose that is nearest in time; with very many poses in lines of equal arm angle, to and fro."""
    if len(joints) > _GREEDY_LIMIT:
        stripe = np.round(joints[:, 0] / math.radians(2.0)).astype(int)
        keys = np.where(stripe % 2 == 0, joints[:, 1], -joints[:, 1])
        return [int(k) for k in np.lexsort((joints[:, 2], keys, stripe))]
    left = np.ones(len(joints), dtype=bool)
    order: list[int] = []
    here = start
    for _ in range(len(joints)):
        seconds = np.where(left, move_seconds(here, joints, axes), np.inf)
        nearest = int(np.argmin(seconds))
        order.append(nearest)
        left[nearest] = False
        here = joints[nearest]
    return order
