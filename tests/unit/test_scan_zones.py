"""Zones of collision: no pose in one, no way through one, however the axes hurry or lag."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gonio import config
from gonio.config import ZoneConfig
from gonio.errors import ConfigurationError, LimitError
from gonio.scan import check, make_plan, zones
from gonio.scan.plan import AXES

TEXT = config.default_documents()["rig.toml"]
RIG = config.parse_rig(TEXT)
SMALL = config.parse_plan(config.small_plan())
OVERSHOOT = math.radians(2.0)


def rig(*given: dict[str, tuple[float, float]]) -> config.RigConfig:
    """The default rig with zones, their ranges in degrees."""
    named = [
        ZoneConfig(f"zone {k}", {axis: (math.radians(a), math.radians(b)) for axis, (a, b) in ranges.items()})
        for k, ranges in enumerate(given)
    ]
    return replace(RIG, zones=tuple(named))


def at(arm: float, pan: float, tilt: float) -> dict[str, float]:
    return {axis: math.radians(angle) for axis, angle in zip(AXES, (arm, pan, tilt), strict=True)}


def test_without_a_zone_all_axes_move_at_once() -> None:
    assert zones.stages(at(0, 0, 0), at(50, 20, 10), RIG) == [at(50, 20, 10)]


def test_around_a_zone_in_the_order_that_avoids_it() -> None:
    """Where the arm is low and the stage tilted they meet: the arm first, then the tilt, and back the other way round."""
    bench = rig({"arm": (-20, 40), "tilt": (20, 45)})
    there = zones.stages(at(0, 0, 0), at(60, 0, 30), bench)
    assert [list(part) for part in there] == [["arm"], ["tilt"]]
    back = zones.stages(at(60, 0, 30), at(0, 0, 0), bench)
    assert [list(part) for part in back] == [["tilt"], ["arm"]]


def test_no_order_helps() -> None:
    bench = rig({"arm": (20, 30)})
    with pytest.raises(LimitError, match=r"from arm 0.00, pan 0.00, .* to arm 60.00, .* the zone 'zone 0' \(arm 20 to 30"):
        zones.stages(at(0, 0, 0), at(60, 0, 0), bench)


ANGLE = st.floats(-60.0, 60.0)
POINT = st.tuples(ANGLE, ANGLE, ANGLE)
BOX = st.dictionaries(
    st.sampled_from(AXES), st.tuples(ANGLE, ANGLE).map(lambda r: (min(r), max(r))), min_size=1, max_size=3
)


@settings(max_examples=150, deadline=None)
@given(start=POINT, goal=POINT, boxes=st.lists(BOX, max_size=3), seed=st.integers(0, 2**31))
def test_no_way_meets_a_zone_whatever_the_axes_speeds(
    start: tuple[float, ...], goal: tuple[float, ...], boxes: list[dict[str, tuple[float, float]]], seed: int
) -> None:
    bench, rng = rig(*boxes), np.random.default_rng(seed)
    here = at(*start)
    try:
        parts = zones.stages(here, at(*goal), bench)
    except LimitError:
        assert boxes
        return
    for part in parts:
        there = here | part
        for _ in range(200):  # each axis anywhere on its own way, the overshoot below the goal included
            joints = {a: rng.uniform(min(here[a], there[a] - OVERSHOOT), max(here[a], there[a])) for a in AXES}
            for zone in bench.zones:
                assert not all(low <= joints[a] <= high for a, (low, high) in zone.ranges.items())
        here = there
    assert here == pytest.approx(at(*goal), abs=1e-8)


def test_poses_in_a_zone_are_left_out_and_say_so() -> None:
    free, bench = make_plan(SMALL, RIG), rig({"tilt": (15, 45)}, {"tilt": (-45, -15)})
    plan = make_plan(SMALL, bench)
    assert 0 < len(plan.poses) <= len(free.poses)
    assert all(abs(pose.joints["tilt"]) < math.radians(15) for pose in plan.poses)
    assert any("lies in the zone 'zone 0' (tilt 15 to 45 deg)" in r for out in plan.left_out for r in out.reasons)
    check(plan, SMALL, bench)
    with pytest.raises(ConfigurationError, match="lies in the zone"):
        check(free, SMALL, bench)


def test_zones_in_the_rig_file() -> None:
    text = TEXT + '\n[[zone]]\nname = "lamp over stage"\narm_deg = [70, 100]\ntilt_deg = [20, 45]\n'
    (zone,) = config.parse_rig(text).zones
    assert zone.name == "lamp over stage"
    assert zone.ranges["tilt"] == (pytest.approx(math.radians(20)), pytest.approx(math.radians(45)))
    for wrong, message in (
        ('name = "x"', "names no axis"),
        ('name = "x"\narm_deg = [30, 20]', "must go from low to high"),
        ('name = "x"\nlamp_deg = [30, 40]', "lamp_deg"),
        ("arm_deg = [20, 30]", "name"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            config.parse_rig(TEXT + f"\n[[zone]]\n{wrong}\n")
