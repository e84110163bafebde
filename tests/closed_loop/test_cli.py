"""The ``gonio`` command as a newcomer meets it: a process of its own, its words, its exit codes."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from gonio.config import default_documents, small_plan

ROOT = Path(__file__).parents[2]
EC1 = ROOT / "tests" / "data" / "optics-blacks" / "AnoBlackEC1onAlum.bsdf"
needs_terminals = pytest.mark.skipif(sys.platform == "win32", reason="needs pseudo-terminals")


def gonio(*arguments: object, code: int = 0) -> subprocess.CompletedProcess[str]:
    """Run the command; its exit code must be `code`, and no traceback may be seen."""
    command = [sys.executable, "-m", "gonio.cli.main", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=ROOT, stdin=subprocess.DEVNULL)
    assert done.returncode == code, (done.returncode, done.stdout[-2000:], done.stderr[-2000:])
    assert "Traceback" not in done.stdout + done.stderr
    return done


def small_rig(folder: Path, **changes: str) -> Path:
    """rig.toml and a plan of some 40 poses; `changes` replaces text in rig.toml."""
    text = default_documents()["rig.toml"]
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    (folder / "rig.toml").write_text(text)
    (folder / "plan.toml").write_text(small_plan())
    return folder


def test_help_is_quick_because_it_loads_nothing_heavy() -> None:
    script = (
        "import sys; from gonio.cli.main import main; code = main(['--help']); "
        "heavy = {'numpy', 'scipy', 'numba', 'cv2', 'emcee', 'matplotlib', 'xarray'} & set(sys.modules); "
        "sys.exit(code or bool(heavy))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0
    assert "resume" in done.stdout


def test_version() -> None:
    assert gonio("--version").stdout.startswith("gonio, version ")


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["scam"], 2, "did you mean 'scan'"),
        (["fit"], 2, "Missing argument"),
        (["fit", "no-such-run", "--model", "ggx"], 6, "has no run"),
        (["map", "no-such-scene.toml", "--out", "x.nc"], 2, "no-such-scene.toml"),
        (["import", "pyproject.toml", "--out", "runs/never"], 6, "no format that gonio knows"),
        (["models", "gxx"], 2, "did you mean 'ggx'"),
        (["rig", "check", "pyproject.toml"], 2, "pyproject.toml"),
    ],
)
def test_an_error_is_one_sentence_with_an_exit_code(arguments: list[str], code: int, words: str) -> None:
    assert words in gonio(*arguments, code=code).stderr
    as_json = json.loads(gonio(*arguments, "--json", code=code).stdout)
    assert as_json["exit_code"] == code and words in as_json["error"]


def test_init_writes_files_that_run_and_overwrites_none(tmp_path: Path) -> None:
    gonio("init", tmp_path / "lab")
    assert "already" in gonio("init", tmp_path / "lab", code=2).stderr
    lab = tmp_path / "lab"
    told = json.loads(
        gonio("scan", lab / "plan.toml", "--rig", lab / "rig.toml", "--out", tmp_path / "r", "--dry-run", "--json").stdout
    )
    assert told["poses"] >= 300 and not (tmp_path / "r").exists()
    gonio("map", lab / "scene.toml", "--out", tmp_path / "map.nc", "--explain")


@pytest.fixture(scope="module")
def measured_run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A measured OpticStudio file through import, table, fit, map, export and report."""
    folder = tmp_path_factory.mktemp("ec1")
    gonio("import", EC1, "--out", folder / "run")
    gonio("table", folder / "run")
    yield folder


def test_measured_data_to_map_and_export(measured_run: Path) -> None:
    run = measured_run / "run"
    fit = json.loads(gonio("fit", run, "--model", "lambertian+ggx", "--seed", 3, "--json").stdout)
    assert fit["converged"] is True
    assert set(fit["parameters"]["ggx.alpha"]) == {"mean", "sd", "q025", "q16", "median", "q84", "q975"}
    assert "noise.relative" in fit["parameters"]  # the file states no uncertainty, so it is inferred
    for use in ("table", "fit"):
        scene = measured_run / f"{use}.toml"
        scene.write_text(
            f'[brdf]\nrun = "{run.as_posix()}"\nuse = "{use}"\n[[source]]\nkind = "hemispherical"\nradiance = 1.0\n'
            "[grid]\nn = 33\nrtol = 1e-3\n"
        )
        told = json.loads(gonio("map", scene, "--out", measured_run / f"{use}.nc", "--json").stdout)
        assert 0 < told["smallest"] < told["largest"] < 0.2  # a black: it reflects a few per cent of a sky of radiance 1
    for form in ("merl", "netcdf", "csv"):
        out = measured_run / f"out.{form}"
        gonio("export", run, "--format", form, "--out", out)
        assert out.stat().st_size > 1000
    again = json.loads(gonio("import", measured_run / "out.csv", "--out", measured_run / "again", "--json").stdout)
    assert again["samples"] == 647  # 4 x 19 x 12 cells less those below the horizon, the repeats of specular, and 59 zeros
    gonio("report", run)
    assert (run / "report.html").stat().st_size > 100_000 and (run / "figures" / "residuals.png").exists()


@needs_terminals
def test_killed_in_mid_scan_and_resumed_nothing_is_lost_or_repeated(tmp_path: Path) -> None:
    """kill -9 of the host when the journal has ten poses; the rest is taken by resume, each pose once."""
    lab = small_rig(tmp_path)
    command = [sys.executable, "-m", "gonio.cli.main", "scan", str(lab / "plan.toml"), "--rig", str(lab / "rig.toml")]
    process = subprocess.Popen([*command, "--out", str(tmp_path / "run")], cwd=ROOT, stdout=subprocess.DEVNULL)
    journal = tmp_path / "run" / "run.sqlite"
    woken = threading.Event()
    while process.poll() is None:
        woken.wait(0.02)
        if journal.exists() and len(_poses(journal)) >= 10:
            os.kill(process.pid, signal.SIGKILL)
            break
    assert process.wait() == -signal.SIGKILL
    before = _poses(journal)
    assert 10 <= len(before) < 42
    gonio("verify", tmp_path / "run")
    told = json.loads(gonio("resume", tmp_path / "run", "--json").stdout)
    after = _poses(journal)
    assert {k: after[k] for k in before} == before  # kept as they were
    assert len(after) == told["poses"] and told["taken"] == told["poses"] - len(before)
    gonio("verify", tmp_path / "run")
    gonio("reduce", tmp_path / "run")


def _poses(journal: Path) -> dict[int, str]:
    try:
        with sqlite3.connect(f"file:{journal}?mode=ro", uri=True, timeout=5) as db:
            return dict(db.execute("SELECT idx, record FROM pose"))
    except sqlite3.OperationalError:  # being made
        return {}


@needs_terminals
@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ('axis = "pan"\nkind = "silent"\nat_pose = 5', "pan"),
        ('axis = "tilt"\nkind = "error_status"\nat_pose = 5', "tilt"),
        ('axis = "arm"\nkind = "overload"\nat_pose = 5', "overload"),
        ('kind = "camera_unplugged"\nat_pose = 5', "camera"),
    ],
)
def test_a_failing_device_ends_in_one_sentence_with_the_data_kept(tmp_path: Path, fault: str, words: str) -> None:
    (tmp_path / "faults.toml").write_text(f"[[fault]]\n{fault}\n")
    lab = small_rig(tmp_path, **{"[sim]": f'[sim]\nscenario = "{(tmp_path / "faults.toml").as_posix()}"'})
    done = gonio("scan", lab / "plan.toml", "--rig", lab / "rig.toml", "--out", tmp_path / "run", code=3)
    sentence = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert len(sentence) == 1 and words in sentence[0]
    assert len(_poses(tmp_path / "run" / "run.sqlite")) >= 4
    gonio("verify", tmp_path / "run")


@needs_terminals
def test_sim_serve_answers_to_the_vendor_s_sdk(tmp_path: Path) -> None:
    from dynamixel_sdk import PacketHandler, PortHandler

    command = [sys.executable, "-m", "gonio.cli.main", "sim", "serve", "--pty", str(tmp_path / "bus")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line.startswith("ready ") and json.loads(line[6:])["bus"] == str(tmp_path / "bus")
        port = PortHandler(str(tmp_path / "bus"))
        port.setBaudRate(1_000_000)
        model, result, error = PacketHandler(2.0).ping(port, 1)
        port.closePort()
        process.terminate()
        assert process.wait(10) == 0
    assert (model, result, error) == (1020, 0, 0)
