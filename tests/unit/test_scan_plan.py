"""Plans: every geometry written is reached exactly, or listed with a reason; moves are short and their times right."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from gonio import config
from gonio.errors import ConfigurationError, DatasetError
from gonio.scan import Plan, check, make_plan
from gonio.scan.plan import AXES, move_seconds

TEXTS = config.default_documents()
RIG = config.parse_rig(TEXTS["rig.toml"])
DEFAULT = config.parse_plan(TEXTS["plan.toml"])
SMALL = config.parse_plan(config.small_plan())


def rotation(axis: str, angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array({"y": [[c, 0, s], [0, 1, 0], [-s, 0, c]], "x": [[1, 0, 0], [0, c, -s], [0, s, c]]}[axis])


def angle(a: np.ndarray, b: np.ndarray) -> float:
    return 2 * math.atan2(float(np.linalg.norm(a - b)), float(np.linalg.norm(a + b)))


def parse(body: str) -> config.PlanConfig:
    return config.parse_plan('[sample]\nname = "x"\n' + body)


@pytest.fixture(scope="module")
def default_plan() -> Plan:
    return make_plan(DEFAULT, RIG)


def test_the_default_plan_is_rich_enough(default_plan: Plan) -> None:
    assert len(default_plan.poses) >= 300
    half = []
    for pose in default_plan.poses:
        light = np.array([math.sin(pose.joints["arm"]), 0.0, math.cos(pose.joints["arm"])])
        normal = rotation("y", pose.joints["pan"]) @ rotation("x", pose.joints["tilt"]) @ [0, 0, 1]
        view = np.array([0.0, 0.0, 1.0])
        half.append((angle(normal, (light + view) / np.linalg.norm(light + view)), angle(light, view) / 2))
    theta_h, theta_d = np.degrees(np.array(half)).T
    assert np.sum(theta_h < 20) >= 100  # where GGX with alpha = 0.2 is above 1/15 of its peak
    assert np.sum((theta_h < 20) & (theta_d > 40)) >= 20  # where Schlick's term begins to rise
    assert np.sum(theta_h > 25) >= 60  # where it is below 1/25, and the diffuse part prevails
    assert max(math.degrees(p.theta_i) for p in default_plan.poses) >= 75


def test_the_joints_realise_the_geometry(default_plan: Plan) -> None:
    # rotation matrices written out here; phi from the projections of both directions onto the surface
    for pose in default_plan.poses:
        light = rotation("y", pose.joints["arm"]) @ [0, 0, 1]
        frame = rotation("y", pose.joints["pan"]) @ rotation("x", pose.joints["tilt"])
        local_i, local_r = frame.T @ light, frame.T @ [0, 0, 1]
        assert math.acos(local_i[2]) == pytest.approx(pose.theta_i, abs=2e-8)
        assert math.acos(local_r[2]) == pytest.approx(pose.theta_r, abs=2e-8)
        if min(pose.theta_i, pose.theta_r) > 1e-6:
            phi = math.atan2(local_r[1], local_r[0]) - math.atan2(local_i[1], local_i[0])
            assert math.cos(phi) == pytest.approx(math.cos(pose.phi), abs=1e-9)


def test_nothing_is_dropped_in_silence(default_plan: Plan) -> None:
    written = sum(len(g.first) * len(g.second) * len(g.third) for g in DEFAULT.grids)
    assert len(default_plan.poses) + len(default_plan.left_out) + default_plan.repeated == written
    assert all(left_out.reasons for left_out in default_plan.left_out)
    assert [p.index for p in default_plan.poses] == list(range(len(default_plan.poses)))


def test_joints_stay_within_limits_with_room_for_the_approach(default_plan: Plan) -> None:
    for axis in AXES:
        joints = np.degrees([p.joints[axis] for p in default_plan.poses])
        assert joints.min() >= math.degrees(RIG.axes[axis].lower) + 2.0 - 1e-9
        assert joints.max() <= math.degrees(RIG.axes[axis].upper) + 1e-9
    assert min(abs(p.joints["arm"]) for p in default_plan.poses) >= RIG.g_min - 1e-12


def test_all_four_solutions_are_used(default_plan: Plan) -> None:
    signs = [(p.joints["arm"] > 0, p.joints["tilt"] > 0) for p in default_plan.poses if p.joints["tilt"] != 0]
    share = [signs.count(s) / len(signs) for s in itertools.product((True, False), repeat=2)]
    assert min(share) > 0.15


def test_short_order_is_shorter(default_plan: Plan) -> None:
    as_written = make_plan(config.parse_plan(TEXTS["plan.toml"].replace('order = "short"', 'order = "file"')), RIG)

    def path(plan: Plan) -> float:
        joints = np.array([[p.joints[a] for a in AXES] for p in plan.poses])
        return float(np.sum(move_seconds(joints[:-1], joints[1:], RIG.axes)))

    def key(p):
        return round(p.theta_i, 9), round(p.theta_r, 9), round(p.phi, 9)

    assert sorted(map(key, as_written.poses)) == sorted(map(key, default_plan.poses))
    assert path(default_plan) < 0.7 * path(as_written)


def test_a_very_large_plan_is_ordered_too() -> None:
    body = (
        f"[[grid]]\ntheta_i_deg = {list(range(10, 70, 2))}\ntheta_r_deg = {list(range(5, 45, 2))}\n"
        f"phi_deg = {list(range(90, 181, 10))}\n"
    )
    plan = make_plan(parse(body), RIG)
    assert len(plan.poses) > 5000
    joints = np.array([[p.joints[a] for a in AXES] for p in plan.poses])
    shuffled = np.random.default_rng(1).permutation(joints)
    assert np.abs(np.diff(joints[:, 0])).sum() < 0.05 * np.abs(np.diff(shuffled[:, 0])).sum()


def test_half_angle_grid() -> None:
    plan = make_plan(parse("[[grid]]\ntheta_h_deg = [0, 10]\ntheta_d_deg = [30]\nphi_d_deg = [0, 180]\n"), RIG)
    found = sorted((round(math.degrees(p.theta_i), 9), round(math.degrees(p.theta_r), 9)) for p in plan.poses)
    assert found == [(20, 40), (30, 30), (40, 20)]  # in the plane of incidence the half vector is the mean direction
    assert all(p.phi == math.pi for p in plan.poses)
    assert plan.repeated == 1  # the mirror condition has no phi_d


def test_reasons() -> None:
    body = (
        "[poses]\nangles_deg = [[30, 0, 0], [85, 10, 180], [40, 40, 0], [22, 20, 0], [60, 50, 180], [60, 60, 90], "
        "[30, 0, 90]]\n[scan]\ntheta_max_deg = 80\n"
    )
    checked = check(make_plan(parse(body), RIG), parse(body), RIG)
    assert len(checked.plan.poses) == 1 and checked.plan.repeated == 1
    assert sorted((kind, count) for kind, count, _ in checked.reasons()) == [
        ("beyond the limits of arm", 1), ("beyond the limits of tilt", 1), ("the light arm would hide the sample", 2),
        ("too steep for lamp or camera", 1),
    ]  # fmt: skip
    listing = checked.as_dict()
    assert listing["left_out"] == 5 and len(listing["list_left_out"]) == 5
    assert listing["list_left_out"][0]["reasons"] == ["theta_i 85.00 deg is beyond theta_max_deg 80.00"]
    with pytest.raises(ConfigurationError, match="none of the plan's 1 geometries"):
        make_plan(parse("[poses]\nangles_deg = [[40, 40, 0]]\n"), RIG)


def test_move_times_of_the_trapezoidal_profile() -> None:
    v, a, settle = 60.0, 300.0, 0.05  # degrees
    up = math.radians(90)
    assert move_seconds([0, 0, 0], [up, 0, 0], RIG.axes) == pytest.approx(90 / v + v / a + settle, rel=1e-12)
    short = math.radians(3)
    assert move_seconds([0, 0, 0], [0, short, 0], RIG.axes) == pytest.approx(2 * math.sqrt(3 / a) + settle, rel=1e-12)
    # downwards it overshoots by 2 degrees and comes back
    both = (92 / v + v / a + settle) + (2 * math.sqrt(2 / a) + settle)
    assert move_seconds([up, 0, 0], [0, 0, 0], RIG.axes) == pytest.approx(both, rel=1e-12)
    # the slowest axis counts
    assert move_seconds([0, 0, 0], [up, short, 0], RIG.axes) == move_seconds([0, 0, 0], [up, 0, 0], RIG.axes)


def test_preflight_counts_and_refuses() -> None:
    plan = make_plan(SMALL, RIG)
    assert 30 <= len(plan.poses) <= 50
    checked = check(plan, SMALL, RIG)
    assert checked.white_blocks == 2
    assert checked.frames == (len(plan.poses) + 2 * 4 + 8) * 3
    assert checked.seconds == pytest.approx(checked.move_s + checked.expose_s + checked.reference_s)
    # the simulated rig hurries 40 times; what the computer itself has to do takes its time
    assert checked.wall_s == pytest.approx(checked.seconds / 40 + 0.025 * len(plan.poses))
    every = config.parse_plan(config.small_plan().replace("every = 0", "every = 10"))
    assert check(plan, every, RIG).white_blocks == 2 + (len(plan.poses) - 1) // 10
    narrow = config.parse_rig(TEXTS["rig.toml"].replace("upper_deg = 100.0", "upper_deg = 50.0"))
    with pytest.raises(ConfigurationError, match=r"pose \d+ cannot be taken: arm .* is outside"):
        check(plan, SMALL, narrow)


def test_the_list_of_poses_is_kept_exactly(default_plan: Plan) -> None:
    assert Plan.from_json(default_plan.to_json()).poses == default_plan.poses
    for text in ("", "[[1, 2]]", '[["a", 0, 0, 0, 0, 0, 0]]', "{}x", "[[0, 0, 0, 0, 0, 0, 0, 0]]"):
        with pytest.raises(DatasetError, match="list of poses"):
            Plan.from_json(text)
