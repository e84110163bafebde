"""A program that is told to stop, or dies, in the middle of a move: the arm stops and holds, by the simulator's own log.

The servos are in this process, on a pseudo-terminal and the wall's clock; `gonio rig move` is another process.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from gonio.config import default_documents
from sim.clock import ScaledClock
from sim.dynamixel.bus import DynamixelBus
from sim.dynamixel.packet import Instruction
from sim.dynamixel.servo import Servo as SimServo
from sim.links import PtyLink, Pump

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals and signals need a Unix")

GOAL = 116
WITHIN_S = 0.1
WATCHDOG_S = 0.5
ENVIRONMENT = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}


class Bench:
    """Three servos, served by a thread."""

    def __init__(self, folder: Path) -> None:
        self.clock = ScaledClock(1.0)
        self.servos = {k: SimServo(k, initial_counts=2048.0) for k in (1, 2, 3)}
        self.line = DynamixelBus(list(self.servos.values()))
        self._pump = Pump(PtyLink(self.line, self.clock, folder / "bus"))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._pump.run, args=(self._stop.is_set, 0.002), daemon=True)
        self._thread.start()
        text = default_documents()["rig.toml"]
        text = re.sub(r'^port = "sim"(.*0" or)', f'port = "{folder / "bus"}"\\1', text, flags=re.MULTILINE)
        text = re.sub(r'^port = "sim"', 'port = ""', text, flags=re.MULTILINE)
        text = re.sub(r'^kind = "scpi"', 'kind = "manual"', text, flags=re.MULTILINE)
        text = re.sub(r'^kind = "sim"', 'kind = "none"', text, flags=re.MULTILINE)
        text = text.replace("timeout_s = 0.5 ", f"watchdog_s = {WATCHDOG_S}\ntimeout_s = 0.5 ")
        self.file = folder / "rig.toml"
        self.file.write_text(text)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._pump.close()

    def speed(self) -> float:
        """Of the arm [counts/s]."""
        t = self.clock.now()
        return (self.servos[1].shaft_counts(t) - self.servos[1].shaft_counts(t - 0.01)) / 0.01

    def goals(self, since_s: float) -> list[tuple[float, int]]:
        """When the arm's goal was written after an instant, and what with."""
        found = []
        for moment, packet in list(self.line.log):
            if moment < since_s or packet.id != 1 or packet.instruction != Instruction.WRITE:
                continue
            if int.from_bytes(packet.params[:2], "little") == GOAL:
                found.append((moment, int.from_bytes(packet.params[2:6], "little", signed=True)))
        return found


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    bench = Bench(tmp_path)
    yield bench
    bench.close()


def moving(bench: Bench) -> subprocess.Popen[str]:
    """`gonio rig move` to 90 degrees, which takes 1.7 s, once the arm is at full speed."""
    command = [sys.executable, "-m", "gonio.cli.main", "rig", "move", str(bench.file), "arm", "90"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=ENVIRONMENT)
    while bench.speed() < 600.0:  # of 683 counts/s
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(0.002)
        assert process.returncode is None, process.communicate()
    return process


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_signal_stops_the_arm_at_once(bench: Bench, name: str) -> None:
    process = moving(bench)
    signalled_s = bench.clock.now()
    process.send_signal(getattr(signal, name))
    _, told = process.communicate()
    assert process.returncode == 130
    assert f"stopped by {'Ctrl-C' if name == 'SIGINT' else name}: the axes hold" in told
    (moment, goal), *_ = bench.goals(signalled_s)
    assert moment - signalled_s <= WITHIN_S
    assert abs(goal - bench.servos[1].shaft_counts(moment)) < 0.02 * 683.0 + 2.0  # where it was, not more than 20 ms ago
    assert all(servo.torque for servo in bench.servos.values())
    rest = bench.servos[1].shaft_counts(bench.clock.now() + 10.0)  # where it comes to rest, by the simulator's profile
    assert abs(rest - goal) <= 12.0 and rest < 2048 + 90 * 4096 / 360 - 100


def test_a_dead_program_is_noticed_by_the_servo_itself(bench: Bench) -> None:
    process = moving(bench)
    killed_s = bench.clock.now()
    process.kill()
    process.communicate()
    assert bench.goals(killed_s) == []
    late_s = killed_s + WATCHDOG_S + WITHIN_S
    where = bench.servos[1].shaft_counts(late_s)  # nothing is said to it any more: the simulator runs ahead by itself
    assert where == bench.servos[1].shaft_counts(late_s + 5.0)
    assert where < 2048 + 90 * 4096 / 360 - 100
    assert bench.servos[1].torque
