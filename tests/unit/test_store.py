"""The run on disk: exact, guarded by hashes, and never lost by ``kill -9`` at any point of a commit."""

from __future__ import annotations

import math
import shutil
import signal
import sqlite3
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from gonio.errors import DatasetError
from gonio.interfaces import Frame
from gonio.samples import BRDFSamples, SharedError
from gonio.scan import BlockRecord, PoseRecord, Run
from gonio.scan.journal import DATABASE

DOCUMENTS = {"rig.toml": "[rig]\nname = 'µ'\n", "plan.toml": "# plan\n"}


def frame(label: str, seed: int = 1) -> Frame:
    data = np.random.default_rng(seed).integers(0, 4096, (6, 8), dtype=np.uint16)
    return Frame(data, 0.016, 1.0, 12.25, 12, True, 4095, label, {"temperature_c": 31.5})


def record(index: int) -> PoseRecord:
    joints = {"arm": 0.1 * index, "pan": -1 / 3, "tilt": 1e-17}
    return PoseRecord(
        index, 0.5, 0.25, math.pi, joints, joints, {"arm": 2048, "pan": 1, "tilt": 4095}, 17.3, 0,
        flags=("saturated",), health={"arm": {"temperature_c": 40.0, "current_a": math.nan}},
    )  # fmt: skip


def commit(run: Run, index: int) -> None:
    run.commit_pose(record(index), [frame(f"pose {index} exposure {e}", 10 * index + e) for e in range(3)])


def samples(n: int = 5) -> BRDFSamples:
    rng = np.random.default_rng(4)
    theta_i, theta_r = rng.uniform(0, 1.5, (2, n))
    u = rng.uniform(0, 1, n)
    u[:1] = np.nan
    shared = (SharedError("scale", 0.005), SharedError("arm", 0.1, 1 / 3, "rad"))
    return BRDFSamples(
        theta_i, rng.uniform(0, 6, n), theta_r, rng.uniform(0, 6, n), rng.normal(size=n), u, np.arange(n), shared,
        rng.normal(size=(n, 3, 2)), rng.normal(size=(n, 3, 2)), rng.normal(size=(n, 2)), {"quantity": "brdf", "ä": "ö"},
    )  # fmt: skip


@pytest.fixture
def run(tmp_path: Path):
    with Run.create(tmp_path / "run", kind="scan", documents=DOCUMENTS, attributes={"seed": "7"}) as made:
        yield made


def test_what_is_written_is_read(run: Run) -> None:
    for index in (3, 0):
        commit(run, index)
    dark = BlockRecord("dark", 1, {}, 3.5, 0, (0.016,), 2, False, wall_time="2020-01-01T00:00:00Z")
    run.commit_block(dark, [frame(f"dark 1 {k}") for k in range(2)])
    assert run.begin_session({"firmware": {"arm": 45}}) == 0
    assert run.begin_session({"x": math.nan}) == 1
    path = run.path
    run.close()
    with Run.open(path) as again:
        assert again.kind == "scan" and again.attributes == {"kind": "scan", "seed": "7"}
        assert again.documents == DOCUMENTS and again.document("plan.toml") == "# plan\n"
        assert again.complete_poses() == {0, 3}
        first, second = again.poses()
        assert first.index == 0
        assert second.measured == record(3).measured and second.flags == ("saturated",)
        assert math.isnan(second.health["arm"]["current_a"]) and second.health["arm"]["temperature_c"] == 40.0
        frames = again.frames(3)
        assert [f.label for f in frames] == [f"pose 3 exposure {e}" for e in range(3)]
        assert all(np.array_equal(f.data, frame("", 30 + e).data) for e, f in enumerate(frames))
        assert (frames[0].exposure_s, frames[0].linear, frames[0].metadata) == (0.016, True, {"temperature_c": 31.5})
        assert again.blocks("dark") == [dark] and again.blocks("white") == []
        assert len(again.block_frames("dark", 1)) == 2
        assert again.sessions() == [{"firmware": {"arm": 45}}, {"x": None}]
        assert again.verify() == []


def test_samples_come_back_bit_by_bit(run: Run) -> None:
    assert not run.has_samples()
    with pytest.raises(DatasetError, match="gonio reduce"):
        run.read_samples()
    for n in (5, 0, 7):  # the last one counts
        run.write_samples(samples(n))
    got, put = run.read_samples(), samples(7)
    for name in ("theta_i", "phi_i", "theta_r", "phi_r", "f_r", "u_f_r", "pose", "d_omega_i", "d_omega_r", "d_ln_f"):
        assert getattr(got, name).tobytes() == getattr(put, name).tobytes()
        assert getattr(got, name).dtype == getattr(put, name).dtype
        assert getattr(got, name).flags.writeable
    assert got.shared == put.shared and got.attributes == put.attributes


def test_a_pose_is_never_written_twice(run: Run) -> None:
    commit(run, 1)
    before = run.frames(1)[0].data.copy()
    with pytest.raises(DatasetError, match="committed before"):
        run.commit_pose(record(1), [frame("other", 99)])
    with pytest.raises(DatasetError, match="committed before"):  # a label that is taken
        run.commit_pose(record(2), [frame("pose 1 exposure 0", 99)])
    assert run.complete_poses() == {1}
    assert np.array_equal(run.frames(1)[0].data, before)
    with pytest.raises(DatasetError, match="not completed"):
        run.frames(2)


def test_refusals(run: Run, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="gonio resume"):
        Run.create(run.path, kind="scan", documents={})
    with pytest.raises(DatasetError, match="has no run"):
        Run.open(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(DatasetError, match="cannot be made"):
        Run.create(tmp_path / "file", kind="scan", documents={})
    other = tmp_path / "other"
    other.mkdir()
    (other / DATABASE).write_bytes(b"no database at all" * 100)
    with pytest.raises(DatasetError, match="damaged or no run"):
        Run.open(other)
    (other / DATABASE).unlink()
    db = sqlite3.connect(other / DATABASE)
    db.execute("CREATE TABLE x (y)")
    db.close()
    with pytest.raises(DatasetError, match="another program"):
        Run.open(other)
    run.close()
    db = sqlite3.connect(run.path / DATABASE)
    db.execute("PRAGMA user_version=99")
    db.close()
    with pytest.raises(DatasetError, match="schema version 99"):
        Run.open(run.path)


def test_frames_of_different_shape_are_refused(run: Run) -> None:
    odd = Frame(np.zeros((2, 2), np.uint16), 0.1, 1.0, 0.0, 12, True, 4095, "odd")
    with pytest.raises(DatasetError, match="of one shape"):
        run.commit_pose(record(0), [frame("a"), odd])
    assert run.complete_poses() == set()


@pytest.mark.parametrize("damage", ["flip", "missing", "truncated"])
def test_verify_finds_a_damaged_frame(run: Run, damage: str) -> None:
    commit(run, 0)
    commit(run, 1)
    file = run.path / "frames" / "pose-000001.npy"
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    if damage == "missing":
        file.unlink()
    else:
        file.write_bytes(content if damage == "flip" else content[:-2])
    problems = run.verify()
    assert len(problems) == 1 and "pose-000001.npy" in problems[0]
    with pytest.raises(DatasetError, match=r"pose-000001\.npy"):
        run.frames(1)
    run.frames(0)


@pytest.mark.parametrize(
    ("sql", "found"),
    [
        ("UPDATE pose SET record = replace(record, '17.3', '17.4')", "pose 0 was changed"),
        ("UPDATE document SET text = 'x' WHERE name = 'rig.toml'", "document rig.toml was changed"),
        ("DELETE FROM frame WHERE position = 2", "3 frames were taken, it has 3, 2 are listed"),
        ("DELETE FROM file", "the journal lacks its entry"),
        ("UPDATE frame SET record = replace(record, '0.016', '0.032')", "was changed"),
    ],
)
def test_verify_finds_a_changed_row(run: Run, sql: str, found: str) -> None:
    commit(run, 0)
    db = sqlite3.connect(run.path / DATABASE)
    db.execute(sql)
    db.commit()
    db.close()
    problems = run.verify()
    assert problems and found in problems[0]
    if "pose" in sql:
        with pytest.raises(DatasetError, match="gonio verify"):
            run.poses()


def test_two_processes_cannot_scan_into_one_run(run: Run) -> None:
    code = f"from gonio.scan import Run\nwith Run.open({str(run.path)!r}) as run, run.lock(): print('got it')"
    with run.lock():
        other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
        assert other.returncode != 0 and "is being scanned by process" in other.stderr
        assert run.complete_poses() == set()  # readers are served meanwhile
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert other.stdout == "got it\n"


KILLED = """
    import os, signal, sys
    sys.path.insert(0, {folder!r})
    from test_store_parts import commit
    from gonio.scan import Run, frames

    point, path = {point!r}, {path!r}

    def die(*args):
        os.kill(os.getpid(), signal.SIGKILL)

    run = Run.open(path)
    commit(run, 0)
    print("acknowledged 0", flush=True)
    if point == "after fsync":
        import pathlib
        pathlib.Path.replace = lambda self, target: die()
    elif point == "half a frame":
        os.fsync = die
    elif point == "after rename":
        frames.sync_folder = die
    elif point == "before commit":
        real = run._journal.transaction
        import contextlib
        @contextlib.contextmanager
        def transaction():
            with real() as db:
                yield db
                die()
        run._journal.transaction = transaction
    commit(run, 1)
    print("acknowledged 1", flush=True)
    die()
"""


@pytest.mark.parametrize("point", ["half a frame", "after fsync", "after rename", "before commit", "after commit"])
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs kill -9")
def test_kill_9_loses_and_repeats_nothing(run: Run, tmp_path: Path, point: str) -> None:
    run.write_samples(samples())
    run.close()
    shutil.copy(__file__, tmp_path / "test_store_parts.py")
    code = textwrap.dedent(KILLED).format(folder=str(tmp_path), point=point, path=str(run.path))
    killed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    acknowledged = {int(line.split()[1]) for line in killed.stdout.splitlines()}
    assert acknowledged == ({0, 1} if point == "after commit" else {0})
    with Run.open(run.path) as again:
        assert again.complete_poses() == acknowledged
        assert again.verify() == []
        assert again.read_samples().f_r.tobytes() == samples().f_r.tobytes()
        if 1 not in acknowledged:  # it can be taken again
            commit(again, 1)
        assert np.array_equal(again.frames(1)[2].data, frame("", 12).data)
        with again.lock():
            assert again.verify() == []
