"""Somebody else's engine: bluesky's plans drive the rig's devices, against the simulator in a process of its own."""

from __future__ import annotations

import math
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
from bluesky import RunEngine
from bluesky import protocols as p
from bluesky.plan_stubs import mv
from bluesky.plans import count, grid_scan
from bluesky.utils import FailedStatus, Msg, RunEngineInterrupted

import gonio.bluesky
from gonio.config import default_documents, parse_rig
from gonio.errors import LimitError
from gonio.rig import Rig, open_rig


@pytest.fixture(scope="module")
def rig() -> Iterator[Rig]:
    with open_rig(parse_rig(default_documents()["rig.toml"])) as opened:
        yield opened


@pytest.fixture
def bench(rig: Rig) -> SimpleNamespace:
    return gonio.bluesky.devices(rig)


@pytest.fixture
def engine() -> RunEngine:
    return RunEngine(context_managers=[])  # signals stay the test runner's


def events(engine: RunEngine, plan: Any) -> list[dict[str, Any]]:
    """Data of all events of a plan."""
    found: list[dict[str, Any]] = []
    engine(plan, lambda name, document: found.append(document["data"]) if name == "event" else None)
    return found


def test_the_devices_have_bluesky_s_shapes(bench: SimpleNamespace) -> None:
    for axis in (bench.arm, bench.pan, bench.tilt):
        for shape in (p.Movable, p.Readable, p.Locatable, p.Stoppable, p.Checkable, p.Configurable, p.HasHints):
            assert isinstance(axis, shape)
    for shape in (p.Triggerable, p.Readable, p.Configurable, p.HasHints):
        assert isinstance(bench.camera, shape)
    for shape in (p.Movable, p.Readable, p.Stoppable, p.Configurable):
        assert isinstance(bench.lamp, shape)


def test_readings_have_the_keys_that_are_described(bench: SimpleNamespace) -> None:
    bench.camera.trigger().exception(30.0)
    for device in vars(bench).values():
        assert set(device.read()) == set(device.describe())
        assert set(device.read_configuration()) == set(device.describe_configuration())


def test_count(bench: SimpleNamespace, engine: RunEngine) -> None:
    engine(mv(bench.lamp, 1.0))
    found = events(engine, count([bench.camera], num=3))
    assert len(found) == 3
    assert all(frame["camera_mean_dn"] > 0.0 and frame["camera_exposure_s"] == 0.002 for frame in found)


def test_grid_scan_of_two_axes(bench: SimpleNamespace, rig: Rig, engine: RunEngine) -> None:
    plan = grid_scan([bench.camera], bench.arm, 20, 40, 3, bench.pan, 0, 10, 2, snake_axes=True)
    found = events(engine, plan)
    assert [round(x["arm_deg_setpoint"]) for x in found] == [20, 20, 30, 30, 40, 40]
    assert [round(x["pan_deg_setpoint"]) for x in found] == [0, 10, 10, 0, 0, 10]
    assert all(abs(x["arm_deg"] - x["arm_deg_setpoint"]) < 1.1 for x in found)  # measured, not the goal: friction
    assert any(x["arm_deg"] != x["arm_deg_setpoint"] for x in found)
    assert abs(math.degrees(rig.axes["arm"].read().angle) - 40.0) < 1.1


def test_a_limit_is_an_error_before_anything_moves(bench: SimpleNamespace, rig: Rig, engine: RunEngine) -> None:
    before = rig.axes["arm"].read().goal_counts
    with pytest.raises(LimitError, match=r"Axis arm was asked for 150.000 deg, its limits are -100 to 100 deg"):
        bench.arm.check_value(150.0)
    with pytest.raises(LimitError):
        engine(mv(bench.arm, 150.0))
    assert rig.axes["arm"].read().goal_counts == before


def comes_to_rest(rig: Rig, name: str) -> bool:
    """Whether an axis soon holds a goal where it is."""
    for _ in range(200):
        if rig.axes[name].settled():
            return True
        rig.clock.sleep(0.05)
    return False


def test_pause_stops_the_axes_and_resume_goes_on(bench: SimpleNamespace, rig: Rig, engine: RunEngine) -> None:
    engine(mv(bench.arm, -60.0))

    def plan() -> Iterator[Msg]:
        yield Msg("checkpoint")
        yield Msg("set", bench.arm, 60.0, group="move")
        if not paused:
            paused.append(True)
            yield Msg("pause", defer=False)
        yield Msg("wait", group="move")

    paused: list[bool] = []
    with pytest.raises(RunEngineInterrupted):
        engine(plan())
    assert engine.state == "paused" and comes_to_rest(rig, "arm")
    assert math.degrees(rig.axes["arm"].read().angle) < 50.0
    engine.resume()
    assert abs(math.degrees(rig.axes["arm"].read().angle) - 60.0) < 1.1


def test_abort_stops_the_axes(bench: SimpleNamespace, rig: Rig, engine: RunEngine) -> None:
    engine(mv(bench.arm, -60.0))

    def plan() -> Iterator[Msg]:
        yield Msg("checkpoint")
        yield Msg("set", bench.arm, 60.0, group="move")
        yield Msg("pause", defer=False)
        yield Msg("wait", group="move")

    with pytest.raises(RunEngineInterrupted):
        engine(plan())
    engine.abort()
    assert engine.state == "idle" and comes_to_rest(rig, "arm")
    assert math.degrees(rig.axes["arm"].read().angle) < 50.0


def test_a_stopped_move_says_so(bench: SimpleNamespace, engine: RunEngine) -> None:
    engine(mv(bench.pan, 0.0))
    status = bench.pan.set(60.0)
    bench.pan.stop(success=False)
    error = status.exception(30.0)
    assert "Axis pan was stopped on its way to 60 degrees" in str(error) and "failed" in repr(status)
    assert not status.success

    def fails() -> Iterator[Msg]:
        moving = yield Msg("set", bench.pan, 60.0, group="move")
        bench.pan.stop(success=False)
        assert moving is not None
        yield Msg("wait", group="move")

    with pytest.raises(FailedStatus):
        engine(fails())
