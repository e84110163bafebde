"""gonio rig and gonio doctor as a person uses them, on a simulated bench that is served on pseudo-terminals."""

from __future__ import annotations

import json
import os
import pty
import re
import select
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from drivers.dynamixel import Bus
from drivers.dynamixel import registers as reg
from gonio.cli.main import main
from gonio.config import default_documents, parse_rig
from gonio.errors import ConfigurationError
from gonio.rig import service
from sim import port
from sim.clock import VirtualClock
from sim.dynamixel.bus import DynamixelBus
from sim.dynamixel.servo import Servo as SimServo

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals need a Unix")

ENVIRONMENT = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
Verb = Callable[..., tuple[int, str, str]]
Line = Callable[..., tuple[service.BusAt, dict[int, SimServo]]]
GONIO = [sys.executable, "-m", "gonio.cli.main"]


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The rig file of a simulator in a process of its own, without a camera."""
    folder = tmp_path_factory.mktemp("rig")
    text = default_documents()["rig.toml"]
    text = text.replace("velocity_deg_s = 60.0", "velocity_deg_s = 200.0").replace("s2 = 300.0", "s2 = 1500.0")
    (folder / "sim.toml").write_text(text)
    command = [*GONIO, "sim", "serve", "--pty", str(folder / "bus"), "--lamp-pty", str(folder / "lamp")]
    command += ["--rig", str(folder / "sim.toml"), "--speed", "1"]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=ENVIRONMENT)
    assert process.stdout is not None and process.stdout.readline().startswith("ready")
    text = re.sub(r'^port = "sim"(.*0" or)', f'port = "{folder / "bus"}"\\1', text, flags=re.MULTILINE)
    text = re.sub(r'^port = "sim"', f'port = "{folder / "lamp"}"', text, flags=re.MULTILINE)
    text = re.sub(r'^kind = "sim"', 'kind = "none"', text, flags=re.MULTILINE)
    text += '\n[park]\narm_deg = 12.0\npan_deg = 3.0\ntilt_deg = 2.0\n'
    text += '\n[[zone]]\nname = "lamp over the tilted stage"\narm_deg = [70, 100]\ntilt_deg = [20, 45]\n'
    text = text.replace("timeout_s = 0.5 ", "timeout_s = 2.0\nwatchdog_s = 2.5 ")  # the computer may be busy
    (folder / "rig.toml").write_text(text)
    yield folder / "rig.toml"
    process.terminate()
    process.communicate()


@pytest.fixture
def gonio(served: Path, capsys: pytest.CaptureFixture[str]) -> Verb:
    """Run a verb on the rig file: exit code, output, errors."""

    def run(*words: str) -> tuple[int, str, str]:
        capsys.readouterr()
        code = main([served.as_posix() if word == "RIG" else word for word in words])
        shown = capsys.readouterr()
        return code, shown.out, shown.err

    return run


def test_check_and_doctor(gonio: Verb) -> None:
    code, out, _ = gonio("rig", "check", "RIG")
    assert code == 0 and "XM430-W350" in out and "all devices answer" in out  # and puts the settings into the servos
    code, out, err = gonio("doctor", "RIG")
    assert "axis arm (id 1): XM430-W350, firmware" in out and "simulated lamp" in out
    assert not [line for line in out.splitlines() if line.startswith("WRONG") and ("axis" in line or "lamp" in line)], out
    assert code in (0, 3) and "Traceback" not in err


def test_doctor_tells_a_setting_that_differs(gonio: Verb, served: Path) -> None:
    gonio("rig", "check", "RIG")
    text = served.read_text()
    limited = served.with_name("limited.toml")
    limited.write_text(text.replace("u_zero_deg = 0.1 ", "current_limit_a = 1.0\nu_zero_deg = 0.1 ", 1))
    code, out, _ = gonio("doctor", limited.as_posix())
    assert code == 3 and "12.0 V; Current Limit is 1193, rig.toml means 371" in out
    assert f"mend it: gonio rig setup {limited.as_posix()}" in out


def test_home_move_and_park(gonio: Verb) -> None:
    assert gonio("rig", "home", "RIG")[0] == 0
    code, out, _ = gonio("rig", "move", "RIG", "arm", "-20.5", "--json")
    told = json.loads(out)
    assert code == 0 and abs(told["arm_deg"] + 20.5) < 1.1 and abs(told["pan_deg"] - 15.0) < 1.1
    code, out, _ = gonio("rig", "park", "RIG", "--json")
    told = json.loads(out)
    assert code == 0 and [abs(told[f"{a}_deg"] - b) < 1.1 for a, b in (("arm", 12), ("pan", 3), ("tilt", 2))] == [True] * 3


def test_limits_and_zones_are_said_before_anything_moves(gonio: Verb) -> None:
    gonio("rig", "park", "RIG")
    code, _, err = gonio("rig", "move", "RIG", "arm", "150")
    assert code == 3 and "Axis arm was asked for 150.000 deg, its limits are -100 to 100 deg; nothing was sent" in err
    assert gonio("rig", "move", "RIG", "tilt", "30")[0] == 0
    code, _, err = gonio("rig", "move", "RIG", "arm", "80")
    assert code == 3 and "leads through the zone 'lamp over the tilted stage'" in err
    _, out, _ = gonio("rig", "move", "RIG", "pan", "4", "--json")
    assert abs(json.loads(out)["arm_deg"] - 12.0) < 1.1
    code, _, err = gonio("rig", "move", "RIG", "arm", "nan")
    assert code == 2 and "give a number" in err
    assert gonio("rig", "park", "RIG")[0] == 0


def test_watch_and_dump(gonio: Verb) -> None:
    code, out, _ = gonio("rig", "watch", "RIG", "--count", "2", "--interval", "0.05")
    lines = out.splitlines()
    assert code == 0 and len(lines) == 2
    assert re.match(r"arm -?\d+\.\d+ deg -?\d+\.\d+ A \d+ C \d+\.\d V  pan .* tilt .* lamp (on|off)$", lines[0]), lines[0]
    code, out, _ = gonio("rig", "dump", "RIG")
    tables = tomllib.loads(out)
    assert code == 0 and list(tables) == ["arm", "pan", "tilt"]
    assert tables["arm"]["Model Number"] == 1020 and tables["pan"]["ID"] == 2 and len(tables["tilt"]) > 50
    assert abs(tables["arm"]["Present Position"] - tables["arm"]["Goal Position"]) <= 12


def test_stop_from_another_terminal(gonio: Verb, served: Path) -> None:
    gonio("rig", "move", "RIG", "arm", "-60")
    mover = subprocess.Popen(
        [*GONIO, "rig", "move", str(served), "arm", "65"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=ENVIRONMENT,
    )  # fmt: skip
    lock = service.holder_of(parse_rig(served.read_text()))
    while lock != mover.pid:  # until it has the port
        assert mover.poll() is None
        lock = service.holder_of(parse_rig(served.read_text()))
    code, out, _ = gonio("rig", "stop", "RIG")
    assert code == 0 and f"process {mover.pid} has stopped; the axes hold" in out
    _, told = mover.communicate()
    assert mover.returncode == 130 and "the axes hold" in told
    _, out, _ = gonio("rig", "dump", "RIG")
    arm = tomllib.loads(out)["arm"]
    assert arm["Torque Enable"] == 1
    code, out, _ = gonio("rig", "stop", "RIG")  # and with nobody there
    assert code == 0 and out.strip() == "the axes hold"


def test_jog_by_keys(gonio: Verb, served: Path) -> None:
    gonio("rig", "park", "RIG")
    pid, terminal = pty.fork()
    if pid == 0:
        os.execve(sys.executable, [*GONIO, "rig", "jog", str(served)], ENVIRONMENT)
    seen = ""

    def read_until(pattern: str) -> str:
        nonlocal seen
        while not re.search(pattern, seen):
            assert select.select([terminal], [], [], 60.0)[0], seen
            seen += os.read(terminal, 4096).decode()
        text, seen = seen, ""
        return text

    read_until(r">arm +1[12]\.\d\d")
    os.write(terminal, b"\x1b[C")
    read_until(r"to 1[23]\.\d\d")
    os.write(terminal, b"p")
    read_until(r">pan")
    os.write(terminal, b"\x1b[A\x1b[A")
    for _ in range(6):  # 15 degrees each, until the limit is met
        os.write(terminal, b"\x1b[C")
    read_until(r"its limits are -80 to 80 deg|to 1[0-9]\.")
    os.write(terminal, b" ")
    read_until("stopped")
    os.write(terminal, b"q")
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    os.close(terminal)
    gonio("rig", "park", "RIG")


def test_jog_needs_a_terminal(gonio: Verb) -> None:
    code, _, err = gonio("rig", "jog", "RIG")
    assert code == 2 and "needs a terminal" in err


# --- setup: servos as they come out of the box, on a virtual clock -------------------------------------------------------


@pytest.fixture
def line() -> Iterator[Line]:
    """Servos on a line, and a way to open it at a rate."""

    def make(*ids: int, baud_code: int = 1) -> tuple[service.BusAt, dict[int, SimServo]]:
        clock = VirtualClock()
        servos = {k: SimServo(k, baud_code=baud_code) for k in ids}
        url = port.attach("setup", DynamixelBus(list(servos.values())), clock)
        return lambda baud: Bus(url, clock=clock, baud=baud, now=clock.now), servos

    yield make
    port.detach("setup")


RIG = parse_rig(default_documents()["rig.toml"])


def test_a_new_servo_gets_id_rate_and_limits(line: Line) -> None:
    make, servos = line(1)
    found = service.survey(make)
    assert found == [service.Found(57_600, 1, 1020, "XM430-W350", found[0].firmware)]
    changes = service.plan_changes(RIG, make, found, axis="pan")
    listed = {change.register: (change.now, change.new) for change in changes}
    assert listed["ID"] == (1, 2) and listed["Baud Rate"] == (1, 3) and listed["Return Delay Time"] == (250, 0)
    service.apply(RIG, make, changes)
    assert servos[1].id == 2 and servos[1].baud_code == 3
    again = service.survey(make)
    assert [(f.baud, f.id) for f in again] == [(1_000_000, 2)]
    assert service.plan_changes(RIG, make, again, axis="pan") == []
    with make(1_000_000) as bus:
        assert bus.read(2, reg.MIN_POSITION_LIMIT) == round(2048 - 80 * 4096 / 360)


def test_setup_does_not_guess(line: Line) -> None:
    make, _ = line(1, 5)
    found = service.survey(make)
    with pytest.raises(ConfigurationError, match=r"axis pan: no servo has id 2; servos found: id 1 .*id 5 .*--axis pan"):
        service.plan_changes(RIG, make, found)
    with pytest.raises(ConfigurationError, match="--axis tilt needs one servo on the line, 2 answer"):
        service.plan_changes(RIG, make, found, axis="tilt")


def test_setup_on_the_command_line(gonio: Verb) -> None:
    gonio("rig", "check", "RIG")
    code, out, _ = gonio("rig", "setup", "RIG", "--yes")
    assert code == 0 and "every servo is as rig.toml says; nothing is written" in out
