"""What can go wrong on a rig, at every stage of a scan: a documented exit code, a safe rig within a second, sound data.

Whole scans on the simulated rig, on a virtual clock. Each fault strikes in each of ten states: while dark frames, white
reference and poses are exposed, from the first to the last, and in mid-move.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from gonio import config
from gonio.errors import GonioError
from gonio.rig import Rig, open_rig
from gonio.scan import create_run, is_complete, rig_of, scan
from sim import port
from sim.dynamixel.servo import Servo as SimServo
from tests.gates import record

RIG = config.default_documents()["rig.toml"].replace("process = true", "process = false")
PLAN = """
[sample]
name = "test"
[poses]
angles_deg = [[0, 30, 0], [20, 20, 180], [40, 30, 180], [60, 10, 180]]
[exposure]
darks = 2
[white]
repeats = 1
"""
# 6 dark frames, 3 of the white, 4 poses of 3 frames, 3 of the white
EXPOSING = [f"after_frames = {n}" for n in (0, 3, 5, 6, 8, 9, 15, 22)]
MOVING = [f"at_goal_write = {n}\nafter_s = 0.1" for n in (2, 5)]  # 0.1 s after a goal was written
ANSWERING = [f"at_reply = {n}" for n in (60, 120)]
SAFE_S = 1.0
OF_ANSWERS = ("drop", "truncate", "corrupt", "duplicate", "delay", "wrong_id")


@dataclass(frozen=True)
class Fault:
    """A fault, and the exit codes in which a scan may end: 0 if gonio gets over it, or it strikes nothing any more."""

    kind: str
    codes: tuple[int, ...]
    axis: str = ""
    more: str = ""


FAULTS = [
    Fault("silent", (3,), "pan"),
    Fault("overload", (3,), "arm"),
    Fault("overheat", (3,), "tilt"),
    Fault("voltage", (3,), "arm"),
    Fault("stuck", (0, 3), "arm"),
    Fault("obstacle", (0, 3), "arm", "ahead_counts = 20"),
    Fault("reboot", (0, 3), "pan"),
    Fault("error_status", (3,), "tilt"),
    Fault("drop", (0,), "arm", "every = 7"),
    Fault("truncate", (0,), "arm", "every = 7"),
    Fault("corrupt", (0,), "pan", "every = 5"),
    Fault("duplicate", (0,), "pan", "every = 3"),
    Fault("delay", (0,), "tilt", "every = 9\ndelay_s = 0.7"),
    Fault("wrong_id", (0,), "arm", "every = 6"),
    Fault("lamp_out", (0, 4)),
    Fault("lamp_silent", (0, 3)),
    Fault("camera_unplugged", (3,)),
    Fault("frame_torn", (0,)),
    Fault("frame_repeated", (0,)),
    Fault("disconnect", (3,)),
]


def servos(rig: Rig) -> dict[str, SimServo]:
    """The simulator's own servos, by axis."""
    line: Any = next(line for name, line in reversed(port._lines.items()) if name.endswith("bus")).device
    return {name: line.servo(axis.id) for name, axis in rig.config.axes.items()}


def still_moving(axes: dict[str, SimServo], now: float) -> list[str]:
    """Axes that move a second after the end."""
    return [n for n, servo in axes.items() if servo.shaft_counts(now + SAFE_S) != servo.shaft_counts(now + SAFE_S + 1.0)]


def end_of(fault: Fault, state: str, folder: Path) -> str:
    """Run a scan with a fault; empty if all is as it must be, else what is not."""
    folder.mkdir()
    text = f'[[fault]]\nkind = "{fault.kind}"\n{state}\n'
    text += f'axis = "{fault.axis}"\n{fault.more}\n' if fault.axis else ""
    (folder / "faults.toml").write_text(text)
    rig_text = RIG.replace("speed = 40.0", 'scenario = "faults.toml"\nspeed = 40.0')
    run, _ = create_run(folder / "run", rig_text, PLAN, rig_folder=folder)
    code, said = 0, ""
    with run:
        try:
            with open_rig(rig_of(run)) as rig:
                axes = servos(rig)
                try:
                    scan(run, rig)
                finally:
                    moving = still_moving(axes, rig.clock.now())
        except GonioError as error:
            code, said = error.exit_code, str(error)
        wrong = [] if code in fault.codes else [f"exit code {code}"]
        wrong += [f"{axis} moves" for axis in moving] + run.verify()
        if code == 0 and not is_complete(run):
            wrong.append("it ends without an error, and poses are missing")
        if code and said.count(". ") > 1:
            wrong.append("several sentences")
    return f"{fault.kind} {state!r}: {', '.join(wrong)}: {said}" if wrong else ""


def states(fault: Fault) -> list[str]:
    if not fault.axis:
        return [*EXPOSING, "after_frames = 1", "after_frames = 20"]
    return EXPOSING + (ANSWERING if fault.kind in OF_ANSWERS else ["at_instruction = 50", "at_instruction = 90"]
                       if fault.kind == "error_status" else MOVING)  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.kind)
def test_a_fault_in_the_middle_of_a_scan(fault: Fault, tmp_path: Path) -> None:
    assert end_of(fault, "after_frames = 9", tmp_path / "scan") == ""


@pytest.mark.gate
def test_the_whole_matrix(tmp_path: Path) -> None:
    cells = [(fault, state) for fault in FAULTS for state in states(fault)]
    wrong = [w for k, (fault, state) in enumerate(cells) if (w := end_of(fault, state, tmp_path / str(k)))]
    print("\n".join(wrong))
    record(
        f"{len(FAULTS)} faults in 10 states of a scan each",
        f"{len(wrong)} of {len(cells)} do not end as documented",
        "0: documented exit code, all axes at rest within 1 s, data that verify",
        "1",
        "pytest -m gate tests/closed_loop/test_fault_matrix.py -s",
    )
    assert not wrong
