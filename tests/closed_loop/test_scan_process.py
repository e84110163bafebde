"""A scan against the simulator in a process of its own: pseudo-terminals, a socket, and processes that die."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import pytest

from gonio import config
from gonio.errors import ConfigurationError, DeviceError
from gonio.rig import open_rig
from gonio.scan import Run, create_run, rig_of, scan

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs pseudo-terminals")

RIG = config.default_documents()["rig.toml"]
PLAN = """
[sample]
name = "test"
[poses]
angles_deg = [[0, 30, 0], [20, 20, 180], [40, 30, 180], [50, 40, 180]]
[exposure]
darks = 2
[white]
repeats = 1
"""


def gone(pid: int | None) -> bool:
    assert pid is not None
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


def test_simulator_dies_and_the_scan_is_resumed(tmp_path: Path) -> None:
    run, _ = create_run(tmp_path / "run", RIG, PLAN)
    with run:
        with open_rig(rig_of(run)) as rig:
            first = rig.simulator_pid
            assert first is not None

            def pull_the_plug(stage: str, done: int, total: int) -> None:
                if (stage, done) == ("poses", 2):
                    os.kill(first, signal.SIGKILL)

            with pytest.raises(DeviceError) as caught:
                scan(run, rig, progress=pull_the_plug)
            assert caught.value.exit_code == 3 and "\n" not in str(caught.value)
        assert gone(first)
        assert run.complete_poses() == {0, 1}
    with Run.open(tmp_path / "run") as run:
        with open_rig(rig_of(run)) as rig:
            second = rig.simulator_pid
            result = scan(run, rig)
        assert gone(second)
        assert result.done == 2 and run.complete_poses() == {0, 1, 2, 3}
        assert run.verify() == []
        assert [s["resumed"] for s in run.sessions()] == [False, True]


def test_what_is_wrong_with_the_truth_is_the_simulators_to_say() -> None:
    rig = config.parse_rig(RIG.replace('"ggx.alpha" = 0.2', '"ggx.alfa" = 0.2'))
    with pytest.raises(ConfigurationError, match=r"the simulator does not start: .*alfa"), open_rig(rig):
        raise AssertionError("it must not open")
