"""The simulator's own process, through the vendor's SDK, pyserial and the camera's socket, and how it ends."""

from __future__ import annotations

import json
import math
import os
import signal
import socket
import subprocess
import sys
from contextlib import contextmanager

import numpy as np
import pytest
import serial
from dynamixel_sdk import COMM_SUCCESS, PacketHandler, PortHandler

from gonio.errors import ConfigurationError, DeviceError
from gonio.interfaces import Camera
from sim.camera import SocketCamera
from sim.serve import Simulation

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs pseudo-terminals")

BUSY_HOST_S = 30.0  # never waited for unless something is wrong


class PatientPort(PortHandler):
    """The SDK's port, with a margin for a busy host."""

    def setPacketTimeout(self, packet_length):
        self.setPacketTimeoutMillis(10_000.0)


@contextmanager
def served(*options):
    """A simulator process: (process, what its ready line says)."""
    command = [sys.executable, "-m", "sim.serve", "--parent", *map(str, options)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as p:
        try:
            line = p.stdout.readline()
            assert line.startswith("ready {"), p.stderr.read()
            yield p, json.loads(line.removeprefix("ready "))
        finally:
            p.stdin.close()
            p.wait(BUSY_HOST_S)


def write_config(folder, **truth):
    """A rig.json for a bench without errors."""
    path = folder / "rig.json"
    path.write_text(json.dumps({"sim": {"speed": 200.0, "truth": {"errors": False, "backlash_deg": 0.0, **truth}}}))
    return path


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    folder = tmp_path_factory.mktemp("serve")
    config = write_config(folder, lamp_drift_per_hour=0.0)
    with served("--config", config, "--pty", folder / "bus", "--tcp", 0) as (_, ready):
        yield ready


def lamp_says(port, line):
    with serial.Serial(port, timeout=BUSY_HOST_S) as lamp:
        lamp.write(line)
        return lamp.readline()


def test_the_sdk_pings_every_servo_on_the_named_terminal(rig):
    port, packets = PatientPort(rig["bus"]), PacketHandler(2.0)
    assert port.setBaudRate(1_000_000)
    assert rig["bus"].endswith("/bus")
    for servo_id in (1, 2, 3):
        assert packets.ping(port, servo_id) == (1020, COMM_SUCCESS, 0)  # XM430-W350's model number
    port.closePort()


def test_the_same_servos_answer_over_tcp(rig):
    with serial.serial_for_url(rig["tcp"], timeout=BUSY_HOST_S) as line:
        line.write(bytes.fromhex("fffffd000103000119 4e".replace(" ", "")))  # the manual's ping of ID 1
        reply = line.read(14)
    assert reply[:9] == bytes.fromhex("fffffd000107005500") and int.from_bytes(reply[9:11], "little") == 1020


def test_light_on_the_white_follows_the_arm_that_the_sdk_moves(rig):
    """Rationale: bus, world, lamp and camera are one bench.

    Expected: the white's signal goes with the cosine of the arm's measured angle, at the middle of the image.
    """
    assert lamp_says(rig["lamp"], b"*IDN?\n").startswith(b"gonio,")
    assert lamp_says(rig["lamp"], b"OUTP ON;OUTP?\n") == b"1\n"
    camera = SocketCamera(rig["camera"])
    assert isinstance(camera, Camera)
    camera.mount("white")
    port, packets = PatientPort(rig["bus"]), PacketHandler(2.0)
    port.setBaudRate(1_000_000)
    packets.write1ByteTxRx(port, 1, 64, 1)
    signal_at = {}
    for goal in (2048, 2048 + 683):  # 0 and 60 degrees
        assert packets.write4ByteTxRx(port, 1, 116, goal) == (COMM_SUCCESS, 0)
        while packets.read1ByteTxRx(port, 1, 122)[0] or abs(packets.read4ByteTxRx(port, 1, 132)[0] - goal) > 12:
            continue  # each poll is a round trip; the shaft stops within friction of its goal
        angle = (packets.read4ByteTxRx(port, 1, 132)[0] - 2048) * 2 * math.pi / 4096
        frames = [camera.capture(0.016, label=f"white {goal} {k}") for k in range(8)]
        signal_at[angle] = np.mean([f.data[56:64, 76:84] for f in frames]) - 64.0
    port.closePort()
    camera.close()
    (a0, s0), (a1, s1) = signal_at.items()
    assert s1 / s0 == pytest.approx(math.cos(a1) / math.cos(a0), rel=0.005)


def test_its_noise_is_that_of_the_same_seed_in_this_process(rig):
    camera = SocketCamera(rig["camera"])
    camera.mount("trap")
    remote = camera.capture(0.016, label="dark 1 3")
    camera.close()
    here = Simulation().camera.capture(0.016, label="dark 1 3")
    np.testing.assert_array_equal(remote.data, here.data)
    assert (remote.label, remote.exposure_s, remote.bit_depth) == ("dark 1 3", 0.016, 12)


def test_the_camera_refuses_and_goes_on(rig):
    camera = SocketCamera(rig["camera"])
    with pytest.raises(DeviceError, match="cannot expose for 100 s"):
        camera.capture(100.0, label="x")
    with pytest.raises(ConfigurationError, match="no specimen 'mirror'"):
        camera.mount("mirror")
    assert camera.describe()["speed"] == 200.0
    assert camera.truth()["zero_deg"] == {"arm": 0.0, "pan": 0.0, "tilt": 0.0}
    camera.close()
    assert camera.capture(0.001, label="again").label == "again"  # connects anew
    camera.close()


def test_a_picture_that_cannot_be_computed_is_refused_in_one_sentence(tmp_path):
    """Rationale: the refusal comes in the middle of an exposure; the simulator must not end with it."""
    config = write_config(tmp_path, **{"lens_radius_mm": 90.0, "ggx.alpha": 0.001})
    with served("--config", config) as (process, ready):
        assert lamp_says(ready["lamp"], b"OUTP ON;OUTP?\n") == b"1\n"
        camera = SocketCamera(ready["camera"])
        for _ in range(2):
            with pytest.raises(ConfigurationError, match="too large for so narrow a lobe"):
                camera.capture(0.001, label="x")
        camera.close()
        assert process.poll() is None


def test_clients_may_come_and_go(rig):
    """Rationale: a descriptor that is free again must not confuse the loop."""
    for k in range(20):
        camera = SocketCamera(rig["camera"])
        assert camera.capture(0.001, label=f"visit {k}").data.shape == (120, 160)
        camera.close()


def test_a_large_frame_arrives_whole(tmp_path):
    """Rationale: it does not fit the socket's buffers, so the simulator has to send it in parts."""
    with served("--config", write_config(tmp_path, width=2048, height=1024)) as (_, ready):
        camera = SocketCamera(ready["camera"])
        assert camera.capture(0.001, label="large").data.shape == (1024, 2048)
        camera.close()


def test_an_unplugged_camera_ends_in_one_sentence(tmp_path):
    scenario = tmp_path / "faults.toml"
    scenario.write_text('[[fault]]\nkind = "camera_unplugged"\nat_pose = 1\n')
    with served("--scenario", scenario) as (_, ready):
        camera = SocketCamera(ready["camera"])
        camera.capture(0.001, label="pose 0 exposure 0")
        for _ in range(2):  # the second finds nobody listening
            with pytest.raises(DeviceError, match="is gone"):
                camera.capture(0.001, label="pose 1 exposure 0")


def test_the_bus_returns_under_another_name(tmp_path):
    """Rationale: a USB adapter that was pulled comes back as another terminal."""
    scenario = tmp_path / "faults.toml"
    elsewhere = tmp_path / "elsewhere"
    scenario.write_text(f'[[fault]]\nkind = "disconnect"\nat_pose = 1\nfor_s = 2.0\nreturn_as = "{elsewhere}"\n')
    ping = bytes.fromhex("fffffd0001030001194e")
    with served("--scenario", scenario, "--pty", tmp_path / "bus", "--tcp", 0, "--speed", 20) as (process, ready):
        host, port = ready["tcp"].removeprefix("socket://").split(":")
        with socket.create_connection((host, int(port)), BUSY_HOST_S) as line:
            line.sendall(ping)
            assert len(line.recv(14)) == 14
            camera = SocketCamera(ready["camera"])
            camera.capture(0.001, label="pose 1 exposure 0")
            assert not os.path.lexists(tmp_path / "bus")
            assert line.recv(1) == b""  # the end of the connection
        back = json.loads(process.stdout.readline().removeprefix("returned "))
        assert back["bus"] == str(elsewhere)
        with serial.Serial(back["bus"], 1_000_000, timeout=BUSY_HOST_S) as line:
            line.write(ping)
            assert len(line.read(14)) == 14
        camera.close()


def test_the_truth_of_every_frame_is_written(tmp_path):
    log = tmp_path / "truth.jsonl"
    with served("--config", write_config(tmp_path), "--log", log, "--mjpeg", 0, "--pace") as (_, ready):
        assert ready["mjpeg"].startswith("http://127.0.0.1:")
        camera = SocketCamera(ready["camera"])
        camera.capture(0.001, label="pose 0 exposure 0")
        camera.close()
        (entry,) = (json.loads(line) for line in log.read_text().splitlines())
    assert (entry["label"], entry["specimen"]) == ("pose 0 exposure 0", "sample")
    assert entry["angles_deg"] == {name: pytest.approx(0.0, abs=1e-9) for name in ("arm", "pan", "tilt")}


def test_it_stops_when_standard_input_ends_and_takes_its_link_away(tmp_path):
    with served("--pty", tmp_path / "bus", "--lamp-pty", tmp_path / "lamp") as (process, ready):
        assert os.path.lexists(tmp_path / "bus") and ready["lamp"] == str(tmp_path / "lamp")
    assert process.returncode == 0
    assert list(tmp_path.iterdir()) == []


def test_it_stops_when_its_parent_is_killed():
    """Rationale: nothing tells it; only the pipe breaks. It holds this pipe's other end, which ends with it."""
    code = (
        "import subprocess, sys; "
        "subprocess.Popen([sys.executable, '-m', 'sim.serve', '--parent'], stdin=subprocess.PIPE).wait()"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as parent:
        ready = json.loads(parent.stdout.readline().removeprefix("ready "))
        SocketCamera(ready["camera"]).close()
        parent.kill()
        rest, _ = parent.communicate(timeout=BUSY_HOST_S)
    assert rest == ""
    with pytest.raises(DeviceError, match="is gone"):
        SocketCamera(ready["camera"])


def test_ctrl_c_is_left_to_the_parent_and_sigterm_obeyed(tmp_path):
    with served("--pty", tmp_path / "bus") as (process, ready):
        process.send_signal(signal.SIGINT)
        SocketCamera(ready["camera"]).close()  # still answers
        process.send_signal(signal.SIGTERM)
        assert process.wait(BUSY_HOST_S) == 0
    assert not os.path.lexists(tmp_path / "bus")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[sim]\nspeed = "fast"', "[sim] speed must be a number"),
        ("[axes.arm]\nid = 2", "each axis needs an id of its own"),
        ('[axes.arm]\nmodel = "MX-28"', "is not simulated"),
        ("[sim", "cannot be parsed"),
    ],
)
def test_a_wrong_file_ends_in_one_sentence_and_code_2(tmp_path, text, message):
    path = tmp_path / "rig.toml"
    path.write_text(text)
    command = [sys.executable, "-m", "sim.serve", "--config", path]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=BUSY_HOST_S)
    assert done.returncode == 2 and done.stdout == ""
    assert message in done.stderr and done.stderr.count("\n") == 1
