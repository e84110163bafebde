"""Other people's clients against ``gonio sim serve``, as their users call them.

rustypot has a Protocol 2.0 of its own, in Rust; lerobot drives arms through the SDK. Each is skipped where it is not
installed: rustypot comes with the extra ``clients``, lerobot needs torch and comes by itself. For bluesky see
tests/closed_loop/test_bluesky.py.
"""

from __future__ import annotations

import json
import subprocess
import sys
from contextlib import contextmanager

import pytest

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs pseudo-terminals")

BUSY_HOST_S = 30.0  # never waited for unless something is wrong


@contextmanager
def served(tmp_path, model="XM430-W350"):
    """What the ready line says."""
    config = {
        "axes": {name: {"id": k, "model": model} for k, name in enumerate(("arm", "pan", "tilt"), start=1)},
        "sim": {"speed": 50.0, "truth": {"errors": False, "backlash_deg": 0.0}},
    }
    path = tmp_path / "rig.json"
    path.write_text(json.dumps(config))
    command = [sys.executable, "-m", "gonio.cli.main", "sim", "serve", "--rig", str(path), "--pty", str(tmp_path / "bus")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield json.loads(process.stdout.readline().removeprefix("ready "))
        finally:
            process.terminate()
            assert process.wait(BUSY_HOST_S) == 0


def test_rustypots_usual_calls(tmp_path):
    rustypot = pytest.importorskip("rustypot")
    with served(tmp_path, "XL430-W250") as ready:
        bus = rustypot.Xl430PyController(ready["bus"], 1_000_000, BUSY_HOST_S)
        ids = [1, 2, 3]
        assert [bus.ping(id) for id in ids] == [True] * 3
        assert bus.read_model_number(1) == [1060]
        assert bus.sync_read_present_position(ids) == [2048] * 3
        bus.sync_write_torque_enable(ids, [True] * 3)
        bus.sync_write_goal_position(ids, [1500, 2500, 3000])
        found = [0, 0, 0]
        while any(bus.sync_read_moving(ids)) or found == [2048] * 3 or found == [0, 0, 0]:
            found = bus.sync_read_present_position(ids)
        assert bus.sync_read_present_position(ids) == pytest.approx([1500, 2500, 3000], abs=4)
        assert bus.read_present_temperature(1) == [31]
        bus.close()


def test_lerobots_usual_calls(tmp_path):
    motors = pytest.importorskip("lerobot.motors", exc_type=ImportError)
    dynamixel = pytest.importorskip("lerobot.motors.dynamixel", exc_type=ImportError)
    with served(tmp_path, "XL330-M288") as ready:
        names = {
            name: motors.Motor(k, "xl330-m288", motors.MotorNormMode.DEGREES)
            for k, name in enumerate(("shoulder", "elbow", "wrist"), start=1)
        }
        bus = dynamixel.DynamixelMotorsBus(ready["bus"], names)
        bus.connect()  # opens the port and looks for all motors with their models
        assert bus.broadcast_ping() == {1: 1200, 2: 1200, 3: 1200}
        bus.configure_motors()
        bus.disable_torque()
        for name in names:
            bus.write("Operating_Mode", name, dynamixel.OperatingMode.EXTENDED_POSITION.value)
        homings = bus.set_half_turn_homings()
        assert set(homings.values()) == {2047 - 2048}
        assert bus.sync_read("Present_Position", normalize=False) == dict.fromkeys(names, 2047)
        calibration = bus.read_calibration()
        bus.write_calibration(calibration)
        assert bus.is_calibrated
        bus.enable_torque()
        goals = {"shoulder": 1000, "elbow": -500, "wrist": 3000}
        bus.sync_write("Goal_Position", goals, normalize=False)
        found = {}
        while found != pytest.approx(goals, abs=4):
            found = bus.sync_read("Present_Position", normalize=False)
        bus.disconnect()
