"""One port, many programs that start at once: exactly one gets it, and the others can say who has it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from sim.clock import ScaledClock
from sim.dynamixel.bus import DynamixelBus
from sim.dynamixel.servo import Servo as SimServo
from sim.links import PtyLink
from tests.gates import record

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals need a Unix")

BURST = 20
# A program that waits for the word, opens the port, says how that went, and holds the port until its input ends.
PROGRAM = """
import sys
from drivers.serial_port import open_port
from gonio.errors import DeviceError
print("ready", flush=True)
sys.stdin.readline()
try:
    port = open_port(sys.argv[1], baud=57600)
    print("won", flush=True)
except DeviceError as error:
    print(error, flush=True)
sys.stdin.readline()
"""


@pytest.fixture
def port(tmp_path: Path) -> Iterator[str]:
    link = PtyLink(DynamixelBus([SimServo(1)]), ScaledClock(1.0), tmp_path / "bus")
    yield link.path
    link.close()


def burst(port: str) -> tuple[int, int]:
    """Start `BURST` programs on one port: how many won it, and how many of the others named the winner's process."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    programs = [
        subprocess.Popen(
            [sys.executable, "-c", PROGRAM, port], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )
        for _ in range(BURST)
    ]
    for program in programs:
        assert program.stdout is not None and program.stdout.readline() == "ready\n"
    for program in programs:
        assert program.stdin is not None
        program.stdin.write("go\n")
        program.stdin.flush()
    told = [program.stdout.readline().strip() for program in programs if program.stdout is not None]
    winners = [program.pid for program, line in zip(programs, told, strict=True) if line == "won"]
    for program in programs:
        program.communicate()
    named = sum(f"is in use by process {winners[0]} on" in line for line in told) if winners else 0
    return len(winners), named


def test_one_of_a_burst_wins_and_the_others_name_it(port: str) -> None:
    assert burst(port) == (1, BURST - 1)
    assert burst(port) == (1, BURST - 1)  # it is free again, and nobody names the earlier holder


@pytest.mark.gate
def test_a_thousand_starts(port: str) -> None:
    results = [burst(port) for _ in range(1000 // BURST)]
    good = results.count((1, BURST - 1))
    record(
        f"one port, 1000 starts in bursts of {BURST}",
        f"{good} of {len(results)} bursts with one winner, named by all others",
        "all",
        "-",
        "pytest -m gate tests/closed_loop/test_port_lock.py",
    )
    assert good == len(results)
