"""Whole scans against the simulated rig: protocol bytes, motion, exposures and journal, on a virtual clock.

The truth comes from the simulator, which composes its poses with matrices of its own.
"""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gonio import config
from gonio.errors import (
    ConfigurationError,
    DatasetError,
    DeviceError,
    DeviceTimeoutError,
    HardwareStatusError,
    MeasurementError,
)
from gonio.interfaces import Frame
from gonio.rig import Rig, open_rig
from gonio.scan import Interrupted, Run, create_run, is_complete, remaining, rig_of, scan

RIG = config.default_documents()["rig.toml"].replace("process = true", "process = false")
PLAN = """
[sample]
name = "test"
[poses]
angles_deg = [[0, 30, 0], [20, 20, 180], [40, 30, 180], [50, 40, 180], [60, 10, 180], [70, 20, 120], [30, 60, 90],
              [10, 45, 45], [75, 5, 180], [45, 45, 170]]
[exposure]
darks = 2
[white]
repeats = 2
"""


def begin(path: Path, *, rig: str = RIG, plan: str = PLAN) -> Run:
    return create_run(path, rig, plan, rig_folder=path.parent)[0]


def whole_scan(path: Path) -> Run:
    run = begin(path)
    with open_rig(rig_of(run)) as rig:
        scan(run, rig)
    return run


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory):
    with whole_scan(tmp_path_factory.mktemp("scan") / "run") as run:
        yield run


def test_a_scan_is_complete_and_sound(finished: Run) -> None:
    assert is_complete(finished) and remaining(finished) == 0
    assert finished.verify() == []
    assert finished.complete_poses() == set(range(10))
    assert [b.number for b in finished.blocks("dark")] == [0, 1, 2] and len(finished.blocks("white")) == 2
    labels = [f.label for f in finished.block_frames("white", 1)]
    assert labels == [f"white 1 {r} exposure {e}" for r in range(2) for e in range(3)]
    assert [f.label for f in finished.block_frames("dark", 2)] == ["dark 2 0", "dark 2 1"]
    assert [f.exposure_s for f in finished.frames(4)] == [0.002, 0.016, 0.128]
    truth = json.loads(finished.attributes["truth"])
    assert truth["parameters"]["ggx.alpha"] == 0.2
    assert finished.sessions()[0]["rig"]["axes"]["pan"]["model"] == "XM430-W350"


def test_measured_angles_are_the_encoders(finished: Run) -> None:
    for pose in finished.poses():
        for axis, measured in pose.measured.items():
            counts = pose.counts[axis]
            assert measured == pytest.approx((counts - 2048) * 2 * math.pi / 4096, abs=1e-12)
            assert abs(measured - pose.commanded[axis]) < math.radians(12 * 360 / 4096 + 0.05)
        assert pose.attempts == 1 and pose.lamp_on and pose.health["arm"]["voltage_v"] > 5
    times = [pose.time_s for pose in finished.poses()]
    assert times == sorted(times)
    assert finished.blocks("white")[0].time_s < times[0] and times[-1] < finished.blocks("white")[1].time_s


def test_the_frames_show_what_was_asked_for(finished: Run) -> None:
    dark = np.mean([f.data for f in finished.block_frames("dark", 2)])
    assert dark == pytest.approx(64, abs=2)  # the black level of rig.toml
    x0, y0, w, h = rig_of(finished).camera.roi
    white = finished.block_frames("white", 0)[1].data[y0 : y0 + h, x0 : x0 + w].mean()
    mirror = next(p for p in finished.poses() if math.degrees(p.theta_i) == pytest.approx(20) and p.phi == math.pi)
    lobe = finished.frames(mirror.index)[1].data[y0 : y0 + h, x0 : x0 + w].mean()
    # by the equations of Lambert and GGX (Walter et al. 2007) at the mirror direction, where D = 1/(pi alpha^2):
    # f = albedo/pi + F G/(pi alpha^2)/(4 cos^2), G = 1 to within 1 %; the white: beta/pi with theta_i = 15 degrees
    cos = math.cos(math.radians(20))
    f_lobe = 0.5 / math.pi + 0.06 / (math.pi * 0.2**2) / (4 * cos**2)
    expected = f_lobe * cos / (0.99 / math.pi * math.cos(math.radians(15)))
    assert (lobe - 64) / (white - 64) == pytest.approx(expected, rel=0.05)


def test_two_runs_with_one_seed_are_identical(finished: Run, tmp_path: Path) -> None:
    with whole_scan(tmp_path / "again") as again:
        files = sorted(p.name for p in (finished.path / "frames").iterdir())
        assert files == sorted(p.name for p in (again.path / "frames").iterdir())
        for name in files:
            assert (finished.path / "frames" / name).read_bytes() == (again.path / "frames" / name).read_bytes()
        for one, other in zip(finished.poses(), again.poses(), strict=True):
            assert replace(one, wall_time="") == replace(other, wall_time="")


def test_the_estimate_of_the_duration(tmp_path: Path) -> None:
    run, checked = create_run(tmp_path / "run", RIG, PLAN)
    with run, open_rig(rig_of(run)) as rig:
        result = scan(run, rig)
    assert result.seconds == pytest.approx(checked.seconds, rel=0.2)
    assert (result.poses, result.done, result.repeated, result.saturated) == (10, 10, 0, ())


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_interrupt_stops_and_resume_takes_the_rest(finished: Run, tmp_path: Path, name: str) -> None:
    stages: list[tuple[str, int, int]] = []

    def interrupting(stage: str, done: int, total: int) -> None:
        if (stage, done) == ("poses", 4):
            signal.raise_signal(getattr(signal, name))

    with begin(tmp_path / "run") as run:
        with open_rig(rig_of(run)) as rig:
            with pytest.raises(Interrupted, match="gonio resume"):
                scan(run, rig, progress=interrupting)
            held = {axis: rig.axes[axis].read() for axis in rig.axes}
            rig.clock.sleep(1.0)
            later = {axis: rig.axes[axis].read() for axis in rig.axes}
            assert all(later[axis].position_counts == held[axis].position_counts for axis in held)
            assert rig.lamp.describe()["output"] is False
        assert run.complete_poses() == {0, 1, 2, 3} and remaining(run) == 6 and not is_complete(run)
        kept = (run.path / "frames" / "pose-000002.npy").read_bytes()
    with Run.open(tmp_path / "run") as run, open_rig(rig_of(run), faults=False) as rig:
        result = scan(run, rig, progress=lambda *step: stages.append(step))
        assert result.done == 6 and run.complete_poses() == set(range(10)) and is_complete(run)
        assert (run.path / "frames" / "pose-000002.npy").read_bytes() == kept
        assert ("poses", 4, 10) in stages and ("poses", 10, 10) in stages
        assert not any(stage == "dark" for stage, _, _ in stages)  # there are dark frames already
        assert [b.session for b in run.blocks("white")] == [0, 1, 1]
        times = [p.time_s for p in run.poses()]
        assert times == sorted(times)
        assert run.verify() == []
        assert scan(run, rig).done == 0  # nothing is left
        assert_same_scan(finished, run, interrupted_at=4)


def assert_same_scan(whole: Run, resumed: Run, interrupted_at: int) -> None:
    """What was measured does not depend on the interruption.

    Before it, frames are the same bit by bit. After it the lamp has drifted, by 1e-5 or so, and the axes come to the first
    pose along another way, so that an encoder may rest a count elsewhere; at equal counts the shafts stand within a count
    of each other. Up to 75 degrees a count changes cos theta_i by tan(75 deg) 2 pi / 4096 = 0.6 %, and the lobe of alpha =
    0.2 by less than 1 / alpha of a count, 0.8 %. Two readings of the region of interest differ by their photon noise.
    """
    rig = config.parse_rig(RIG)
    x, y, width, height = rig.camera.roi
    count, gain = 2 * math.pi / 4096, rig.camera.gain_dn_per_e
    for one, other in zip(whole.poses(), resumed.poses(), strict=True):
        first, second = whole.frames(one.index)[1].data, resumed.frames(one.index)[1].data
        if one.index < interrupted_at:
            assert np.array_equal(first, second)
            continue
        away = sum(abs(one.counts[axis] - other.counts[axis]) for axis in one.counts)
        assert away <= 2
        a, b = (f[y : y + height, x : x + width].mean() - rig.camera.offset_dn for f in (first, second))
        noise = math.sqrt(2 * (gain * a + (gain * rig.camera.read_noise_e) ** 2 + 1 / 12) / (width * height)) / a
        moved = (1 + away) * count * (math.tan(one.theta_i) + 1 / 0.2)
        assert abs(math.log(b / a)) < 4 * noise + moved
        neighbour = whole.frames((one.index + 1) % 10)[1].data[y : y + height, x : x + width].mean() - rig.camera.offset_dn
        assert abs(math.log(neighbour / a)) > 2 * (4 * noise + moved)  # so that another pose would be told from this


KILLED = """
    import os, signal
    from gonio.rig import open_rig
    from gonio.scan import Run, rig_of, scan

    def progress(stage, done, total):
        if (stage, done) == ({stage!r}, {done}):
            os.kill(os.getpid(), signal.SIGKILL)

    with Run.open({path!r}) as run, open_rig(rig_of(run)) as rig:
        scan(run, rig, progress=progress)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs kill -9")
def test_kill_9_in_the_middle_of_a_scan(tmp_path: Path) -> None:
    path = tmp_path / "run"
    begin(path).close()
    for stage, done, complete in (("dark", 3, 0), ("poses", 3, 3), ("white", 1, 3)):
        code = textwrap.dedent(KILLED).format(stage=stage, done=done, path=str(path))
        killed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
        assert killed.returncode == -signal.SIGKILL, killed.stderr
        with Run.open(path) as run:
            assert run.complete_poses() == set(range(complete))
            assert run.verify() == []
    with Run.open(path) as run, open_rig(rig_of(run)) as rig:
        assert scan(run, rig).done == 7
        assert run.complete_poses() == set(range(10)) and run.verify() == [] and is_complete(run)


def with_fault(tmp_path: Path, fault: str) -> str:
    (tmp_path / "faults.toml").write_text("[[fault]]\n" + fault)
    return RIG.replace("[sim]", '[sim]\nscenario = "faults.toml"')


@pytest.mark.parametrize(
    ("fault", "error", "text", "kept"),
    [
        ('kind = "silent"\naxis = "pan"\nat_pose = 3', DeviceTimeoutError, "pan", 3),
        ('kind = "overload"\naxis = "tilt"\nat_pose = 5', HardwareStatusError, "overload", 5),
        ('kind = "stuck"\naxis = "arm"\nat_goal_write = 9', DeviceError, "makes no progress", None),
        ('kind = "camera_unplugged"\nafter_frames = 30', DeviceError, "camera is gone", None),
        ('kind = "lamp_out"\nat_pose = 2', MeasurementError, "as dark as the dark frames", 10),
    ],
)
def test_a_fault_ends_in_one_sentence_and_keeps_the_data(
    tmp_path: Path, fault: str, error: type[Exception], text: str, kept: int | None
) -> None:
    with begin(tmp_path / "run", rig=with_fault(tmp_path, fault)) as run:
        with open_rig(rig_of(run)) as rig:
            with pytest.raises(error, match=text) as caught:
                scan(run, rig)
            assert "\n" not in str(caught.value)
            alive = [a for n, a in rig.axes.items() if f'axis = "{n}"' not in fault]
            stopped = [axis.read().position_counts for axis in alive]
            rig.clock.sleep(1.0)
            assert [axis.read().position_counts for axis in alive] == stopped
            assert not any(axis.read().moving for axis in alive)
        assert kept is None or run.complete_poses() == set(range(kept))
        assert run.verify() == []
        with open_rig(rig_of(run), faults=False) as rig:  # repaired
            scan(run, rig)
        assert run.complete_poses() == set(range(10)) and run.verify() == []


def test_a_saturated_white_is_refused_and_kept(tmp_path: Path) -> None:
    plan = PLAN.replace("[exposure]", "[exposure]\nbracket_s = [1.0, 2.0]")
    with begin(tmp_path / "run", plan=plan) as run, open_rig(rig_of(run)) as rig:
        with pytest.raises(MeasurementError, match="every exposure down to 1 s is saturated"):
            scan(run, rig)
        assert run.blocks("white")[0].flags == ("saturated",) and len(run.block_frames("white", 0)) == 4


def test_a_saturated_pose_is_flagged(tmp_path: Path) -> None:
    plan = PLAN.replace("[exposure]", "[exposure]\nbracket_s = [0.04]")
    rig_text = RIG.replace('"ggx.f_0" = 0.06', '"ggx.f_0" = 0.9')
    with begin(tmp_path / "run", plan=plan, rig=rig_text) as run, open_rig(rig_of(run)) as rig:
        result = scan(run, rig)
        mirror = [p.index for p in run.poses() if math.degrees(p.theta_i) == pytest.approx(20)]
        assert set(mirror) <= set(result.saturated) and 0 < len(result.saturated) < 10
        assert all(run.poses()[k].flags == ("saturated",) for k in result.saturated)


class Nudged:
    """A camera beside which somebody pushes the light arm, for the first `times` exposures of one pose."""

    def __init__(self, rig: Rig, times: int) -> None:
        self._rig, self._times = rig, times
        assert rig.camera is not None
        self._camera = rig.camera
        self.name = self._camera.name
        self.describe = self._camera.describe
        self.close = self._camera.close

    def capture(self, exposure_s: float, *, label: str) -> Frame:
        frame = self._camera.capture(exposure_s, label=label)
        if label == "pose 1 exposure 1" and self._times:
            self._times -= 1
            arm = self._rig.axes["arm"]
            arm.move_to(arm.read().angle + math.radians(3.0))
            self._rig.clock.sleep(1.0)
        return frame


def test_a_pose_is_exposed_again_if_an_axis_moved(tmp_path: Path) -> None:
    with begin(tmp_path / "run") as run, open_rig(rig_of(run)) as rig:
        rig.camera = Nudged(rig, 1)
        result = scan(run, rig)
        assert result.repeated == 1
        assert [p.attempts for p in run.poses()] == [1, 2] + [1] * 8
        assert abs(run.poses()[1].measured["arm"] - run.poses()[1].commanded["arm"]) < math.radians(1)
    with begin(tmp_path / "other") as run, open_rig(rig_of(run)) as rig:
        rig.camera = Nudged(rig, 99)
        with pytest.raises(MeasurementError, match=r"axis arm moved by [23]\.\d+ degrees.*3 times"):
            scan(run, rig)
        assert run.complete_poses() == {0}


def test_refusals_before_anything_moves(finished: Run, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="gonio resume"):
        begin(finished.path)
    with pytest.raises(ConfigurationError, match="did you mean"):
        begin(tmp_path / "x", rig=RIG.replace("zero_counts =", "zero_count =", 1))
    assert not (tmp_path / "x").exists()
    with (
        Run.create(tmp_path / "imported", kind="import", documents={}) as run,
        pytest.raises(DatasetError, match="imported"),
    ):
        rig_of(run)
    refused = pytest.raises(DatasetError, match=f"being scanned by process {os.getpid()}")
    with begin(tmp_path / "locked") as run, open_rig(rig_of(run)) as rig, run.lock(), refused:
        scan(run, rig)


def test_white_blocks_in_between(tmp_path: Path) -> None:
    with begin(tmp_path / "run", plan=PLAN + "every = 4\n") as run, open_rig(rig_of(run)) as rig:
        scan(run, rig)
        times = [p.time_s for p in run.poses()]
        blocks = [b.time_s for b in run.blocks("white")]
        assert [sum(t < b for t in times) for b in blocks] == [0, 4, 8, 10]
