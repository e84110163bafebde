"""The contracts of `gonio.contracts` on every implementation there is, and on a bench with --hardware RIG.TOML.

On hardware each axis moves to both ends of the middle third of its range: see that nothing is in the way.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from drivers.opencv_camera import OpenCVCamera
from drivers.scpi_lamp import ManualLamp
from gonio import contracts
from gonio.config import RigConfig, default_documents, load_rig, parse_rig
from gonio.errors import DeviceError
from gonio.interfaces import Axis, AxisGroup, AxisReading, Camera, Frame, Lamp
from gonio.rig import Rig, WallClock, open_rig

RIG = parse_rig(default_documents()["rig.toml"])
PLACES = ["in this process", "served", "hardware"]


@pytest.fixture(scope="module", params=PLACES)
def rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    config: RigConfig = RIG
    if request.param == "hardware":
        file = request.config.getoption("--hardware")
        if file is None:
            pytest.skip("no --hardware RIG.TOML")
        config = load_rig(file)
    else:
        if request.param == "served" and sys.platform == "win32":
            pytest.skip("pseudo-terminals need a Unix")
        assert config.sim is not None
        config = replace(config, sim=replace(config.sim, process=request.param == "served"))
    with open_rig(config, ask=lambda text: None) as opened:
        yield opened


@pytest.mark.parametrize("name", ["arm", "pan", "tilt"])
def test_axes(rig: Rig, name: str) -> None:
    axis = rig.axes[name]
    assert isinstance(axis, Axis)
    third = (axis.limits.upper - axis.limits.lower) / 3.0
    assert contracts.axis(axis, axis.limits.lower + third, axis.limits.upper - third, rig.clock) == []


def test_axes_together(rig: Rig) -> None:
    assert isinstance(rig.group, AxisGroup)
    thirds = {name: (axis.limits.upper - axis.limits.lower) / 3.0 for name, axis in rig.axes.items()}
    ranges = {n: (rig.axes[n].limits.lower + third, rig.axes[n].limits.upper - third) for n, third in thirds.items()}
    assert contracts.axis_group(rig.group, ranges, rig.clock) == []


def test_camera_of_a_rig(rig: Rig) -> None:
    if rig.camera is None:
        pytest.skip("a rig without a camera")
    assert isinstance(rig.camera, Camera)
    assert contracts.camera(rig.camera, rig.config.camera.exposures_s, rig.clock) == []


def test_lamp_of_a_rig(rig: Rig) -> None:
    assert isinstance(rig.lamp, Lamp)
    assert contracts.lamp(rig.lamp) == []


def test_a_lamp_switched_by_hand() -> None:
    assert contracts.lamp(ManualLamp(lambda text: None)) == []


def test_opencv_on_image_files(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    for k in range(2):
        cv2.imwrite(str(tmp_path / f"frame_{k:04d}.png"), rng.integers(0, 4096, (24, 32)).astype(np.uint16))
    camera = OpenCVCamera(
        str(tmp_path / "frame_%04d.png"), backend="images", clock=WallClock(), exposure="fixed", fixed_exposure_s=0.01,
        bit_depth=12, linear=True,
    )  # fmt: skip
    assert contracts.camera(camera, [0.01], WallClock()) == []


# --- the contracts themselves find what is broken ------------------------------------------------------------------------


class Careless:
    """A camera that does all that it should not."""

    name = ""

    def describe(self) -> dict[str, Any]:
        return {"settings": {1, 2}}

    def capture(self, exposure_s: float, *, label: str) -> Frame:
        return Frame(np.full((2, 3), 300, dtype=np.uint16), 1.0, 0.0, 0.0, 8, True, 255, "x")

    def close(self) -> None: ...


class Runaway:
    """An axis that takes every goal, and is always there."""

    name = "runaway"
    limits = RIG.axes["arm"]

    def __init__(self) -> None:
        self.angle = 0.0

    def check(self, angle: float) -> None: ...

    def move_to(self, angle: float) -> None:
        self.angle = angle + 0.1

    def settled(self) -> bool:
        return True

    def read(self) -> AxisReading:
        return AxisReading(self.angle, 0, 0, 0.0, False)

    def stop(self) -> None: ...

    def describe(self) -> dict[str, object]:
        return {}


class Herd:
    """Axes of which the second never arrives; they take every goal."""

    def __init__(self) -> None:
        self.goals = {"a": 0.0, "b": 0.0}

    def move_to(self, goals: Mapping[str, float]) -> None:
        self.goals |= goals

    def settled(self, names: Collection[str]) -> dict[str, bool]:
        return {name: name == "a" for name in names}

    def read(self) -> dict[str, AxisReading]:
        a, b = self.goals["a"], 0.0
        return {"a": AxisReading(a, 0, round(1e3 * a), 0.0, False), "b": AxisReading(b, 0, 0, 0.0, True)}


class Boundless:
    """A lamp that takes every level."""

    name = "lamp"

    def describe(self) -> dict[str, object]:
        return {"level": math.nan}

    def set_output(self, on: bool) -> None: ...

    def set_level(self, fraction: float) -> None: ...

    def close(self) -> None: ...


def test_breaches_are_told() -> None:
    told = "\n".join(contracts.camera(Careless(), [0.01], WallClock()))
    for breach in (
        "no name", "not JSON-compatible", "bit_depth = 8 does not hold counts up to 300", "gain = 0.0", "label 'x'",
        "exposure_s = 1 where 0.01", "outside the call", "does not rise", "an exposure of nan s is taken",
    ):  # fmt: skip
        assert breach in told
    told = "\n".join(contracts.axis(Runaway(), -0.5, 0.5, WallClock()))  # type: ignore[arg-type]
    assert "its goal was -28.6479 deg" in told and "is taken; it must raise LimitError" in told
    told = "\n".join(contracts.axis_group(Herd(), {"a": (-0.5, 0.5), "b": (-0.5, 0.5)}, WallClock(), timeout_s=0.05))
    for breach in (
        "b is not settled 0.05 s after", "b reads 0.00 deg at rest, its goal was 28.6479 deg", "b at nan is taken",
        "one goal was refused changed a goal",
    ):  # fmt: skip
        assert breach in told
    assert "a reads" not in told
    told = "\n".join(contracts.lamp(Boundless()))
    assert "a level of 1.01 is taken; it must raise ConfigurationError" in told and "not JSON-compatible" in told


def test_errors_of_a_device_pass_through() -> None:
    class Dead(Careless):
        def capture(self, exposure_s: float, *, label: str) -> Frame:
            raise DeviceError("no frame")

    with pytest.raises(DeviceError, match="no frame"):
        contracts.camera(Dead(), [0.01], WallClock())
