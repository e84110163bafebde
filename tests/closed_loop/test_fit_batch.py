"""gonio fit-batch from a Zarr cube to a Zarr folder: interrupted, damaged, on a cluster whose worker dies."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import shutil
import signal
import time

import numpy as np
import pytest

from gonio.cli.main import main
from tests.gates import record
from tests.unit.test_fitting_batch import JOB, plastics

zarr = pytest.importorskip("zarr")
SHAPE = (12, 5)


def cube(path, shape=SHAPE, seed=21):
    """A cube of plastics; returns the truth (p, 3)."""
    s = JOB.samples
    truth, readings, u = plastics(seed, int(np.prod(shape)), s)
    group = zarr.create_group(path)
    arrays = {"brdf": readings.T.reshape(len(s), *shape), "brdf_standard_error": u.T.reshape(len(s), *shape)}
    arrays |= {name: getattr(s, name) for name in ("theta_i", "phi_i", "theta_r", "phi_r")}
    for name, array in arrays.items():
        group.create_array(name, shape=array.shape, dtype=array.dtype)[...] = array
    return truth


def fit(data, out, *more):
    given = ["--tile", "5", *more]
    given = [str(data), "--model", "lambertian+ggx", "--out", str(out), *given]
    return main(["fit-batch", *given])


def content(path):
    return {name: np.asarray(array[...]).tobytes() for name, array in zarr.open_group(path, mode="r").arrays()}


def test_a_cube_is_fitted_and_a_begun_one_gone_on_with(tmp_path, capsys):
    truth = cube(tmp_path / "cube.zarr")
    out = tmp_path / "fits.zarr"
    assert fit(tmp_path / "cube.zarr", out, "--processes", "1") == 0
    whole = content(out)
    group = zarr.open_group(out, mode="r")
    assert group.attrs["parameters"] == ["lambertian.albedo", "ggx.alpha", "ggx.f_0"]
    mean, sd = (np.asarray(group[name][...]).reshape(-1, 3) for name in ("mean", "sd"))
    good = np.asarray(group["status"][...]).ravel() == 0
    assert good.sum() >= 58
    assert np.max(np.abs(mean - truth)[good] / sd[good]) < 5.0

    # as after a crash: one tile never written, one written by half
    again = zarr.open_group(out, mode="r+")
    again["done"][3] = [-1, -1]
    again["mean"][7, 2] = 0.5
    capsys.readouterr()
    assert fit(tmp_path / "cube.zarr", out, "--processes", "1") == 0
    assert "10 of 12 tiles were there already" in capsys.readouterr().out
    assert content(out) == whole


def test_other_options_and_other_folders_are_not_mixed_up(tmp_path, capsys):
    cube(tmp_path / "cube.zarr", (1, 2))
    out = tmp_path / "fits.zarr"
    assert fit(tmp_path / "cube.zarr", out) == 0
    assert fit(tmp_path / "cube.zarr", out, "--fix", "ggx.f_0=0.04") == 2
    assert "holds another fit (job differs)" in capsys.readouterr().err
    assert fit(tmp_path / "cube.zarr", tmp_path) == 2
    assert "exists and holds no fit" in capsys.readouterr().err
    shutil.rmtree(tmp_path / "cube.zarr" / "theta_r")
    assert fit(tmp_path / "cube.zarr", tmp_path / "other.zarr") == 6
    assert "there is no theta_r" in capsys.readouterr().err


def test_a_shared_scale_of_a_cube_widens_its_pixels(tmp_path):
    cube(tmp_path / "cube.zarr", (1, 2))
    assert fit(tmp_path / "cube.zarr", tmp_path / "alone.zarr", "--processes", "1") == 0
    group, n = zarr.open_group(tmp_path / "cube.zarr", mode="r+"), len(JOB.samples)
    for name, array in (("d_omega_i", np.zeros((n, 3, 1))), ("d_omega_r", np.zeros((n, 3, 1))), ("d_ln_f", np.ones((n, 1)))):
        group.create_array(name, shape=array.shape, dtype=array.dtype)[...] = array
    group.attrs["shared_errors"] = [{"name": "scale", "u": 0.05}]
    assert fit(tmp_path / "cube.zarr", tmp_path / "shared.zarr", "--processes", "1") == 0
    alone, shared = (zarr.open_group(tmp_path / f"{name}.zarr", mode="r") for name in ("alone", "shared"))
    assert shared.attrs["parameters"][-1] == "shared.scale"
    albedo, sd, sd_alone = (np.asarray(a[...])[0, :, 0] for a in (shared["mean"], shared["sd"], alone["sd"]))
    assert np.all(sd > 3 * sd_alone)
    assert sd == pytest.approx(0.05 * albedo, rel=0.25)  # a little less where the range of albedo ends


def test_channels_of_a_file_are_pixels(tmp_path):
    """Three channels of noise-free paper in CSV, uncertainty unknown."""
    theta = np.linspace(0.0, 70.0, 20)
    rows = "\n".join(f"{t:.3f},0,30,180,{0.1 / np.pi},{0.4 / np.pi},{0.8 / np.pi}" for t in theta)
    data = tmp_path / "paper.csv"
    data.write_text(f"theta_i_deg,phi_i_deg,theta_r_deg,phi_r_deg,f_r_red,f_r_green,f_r_blue\n{rows}\n", encoding="utf-8")
    out = tmp_path / "fits.zarr"
    assert main(["fit-batch", str(data), "--model", "lambertian", "--quantity", "brdf", "--out", str(out)]) == 0
    mean = np.asarray(zarr.open_group(out, mode="r")["mean"][...])
    assert mean[:, 0] == pytest.approx([0.1, 0.4, 0.8], rel=1e-3)


@contextlib.contextmanager
def two_workers(distributed):
    """A cluster of two processes, which may take its time to close on a busy machine."""
    cluster = distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=60)
    try:
        yield cluster
    finally:
        cluster.close(timeout=300)


@pytest.mark.filterwarnings("ignore")  # of Dask, about a worker that died
def test_a_cluster_gives_the_same_bytes_though_a_worker_dies(tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed")
    cube(tmp_path / "cube.zarr")
    assert fit(tmp_path / "cube.zarr", tmp_path / "here.zarr", "--processes", "1") == 0

    from gonio.cli import cubes

    written, killed = cubes.ZarrSink.write, []
    with two_workers(distributed) as cluster:

        def write(self, start, stop, estimates):
            if not killed:
                killed.append(cluster.workers[0].process.pid)
                os.kill(killed[0], signal.SIGKILL)
            written(self, start, stop, estimates)

        monkeypatch.setattr(cubes.ZarrSink, "write", write)
        assert fit(tmp_path / "cube.zarr", tmp_path / "there.zarr", "--scheduler", cluster.scheduler_address) == 0
    assert killed
    assert content(tmp_path / "here.zarr") == content(tmp_path / "there.zarr")


def test_emcee_confirms_a_pixel(tmp_path, capsys):
    cube(tmp_path / "cube.zarr", (1, 2))
    assert fit(tmp_path / "cube.zarr", tmp_path / "fits.zarr", "--processes", "1", "--validate", "1", "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["validated"], told["computed"]) == (1, 1)
    assert 0.0 < told["largest_shift"] < 0.15


def test_no_scheduler_is_one_sentence(tmp_path, capsys):
    pytest.importorskip("distributed")
    cube(tmp_path / "cube.zarr", (1, 2))
    began = time.monotonic()
    assert fit(tmp_path / "cube.zarr", tmp_path / "out.zarr", "--scheduler", "tcp://127.0.0.1:9") == 3
    assert "no Dask scheduler answers at tcp://127.0.0.1:9" in capsys.readouterr().err
    assert time.monotonic() - began < 60


def _processor_s():
    return sum(sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


@pytest.mark.gate
@pytest.mark.filterwarnings("ignore")
def test_100_000_pixels_on_two_cores_and_on_a_cluster_whose_worker_dies_half_way(tmp_path, monkeypatch):
    """50 samples per pixel; coverage of the truth by 95 % intervals, seconds, and the same bytes from Dask."""
    distributed = pytest.importorskip("distributed")
    truth = cube(tmp_path / "cube.zarr", (100, 1000), seed=7)
    arguments = ("--tile", "1000", "--processes", "2")
    JOB.fit(np.full((1, 50), 0.2), np.full((1, 50), 0.01))  # kernels are there
    wall, processor = time.perf_counter(), _processor_s()
    assert fit(tmp_path / "cube.zarr", tmp_path / "here.zarr", *arguments) == 0
    wall, processor = time.perf_counter() - wall, _processor_s() - processor
    group = zarr.open_group(tmp_path / "here.zarr", mode="r")
    q = np.asarray(group["quantiles"][...]).reshape(-1, 3, 5)
    good = np.asarray(group["status"][...]).ravel() == 0
    cover = np.mean((q[:, :, 0] <= truth) & (truth <= q[:, :, 4]), axis=0)
    shown = ", ".join(f"{c:.4f}" for c in cover)
    record(
        "many pixels", f"{wall:.0f} s wall, {processor:.0f} s of processor, load {os.getloadavg()[0]:.1f}; 95 % coverage "
        f"of albedo, alpha, f_0: {shown}; {np.sum(~good)} of 100,000 pixels not trusted",
        "100 s on two idle cores; 0.93 to 0.97", "7", "pytest -m gate -s tests/closed_loop/test_fit_batch.py",
    )  # fmt: skip
    assert np.all((cover >= 0.93) & (cover <= 0.97))

    from gonio.cli import cubes

    written, count = cubes.ZarrSink.write, []
    with two_workers(distributed) as cluster:

        def write(self, start, stop, estimates):
            count.append(start)
            if len(count) == 50:
                os.kill(cluster.workers[0].process.pid, signal.SIGKILL)
            written(self, start, stop, estimates)

        monkeypatch.setattr(cubes.ZarrSink, "write", write)
        given = ("--tile", "1000", "--scheduler", cluster.scheduler_address)
        assert fit(tmp_path / "cube.zarr", tmp_path / "there.zarr", *given) == 0
    here, there = content(tmp_path / "here.zarr"), content(tmp_path / "there.zarr")
    different = [name for name in here if here[name] != there[name]]
    record(
        "many pixels, cluster", f"100,000 pixels in 100 tiles, a worker killed after 50: {len(different)} arrays differ",
        "identical", "7", "pytest -m gate -s tests/closed_loop/test_fit_batch.py",
    )  # fmt: skip
    assert not different
