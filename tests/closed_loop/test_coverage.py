"""Do the intervals mean what they say? Whole runs on the simulated rig, from servo counts to posterior, against its truth.

Rationale: each seed draws the bench's hidden errors (axis zeros, white reference) from the priors that rig.toml declares,
and all noise; then about 95 % of the 95 % intervals must hold the truth. A scan runs in this process on a virtual clock.
"""

from __future__ import annotations

import json
import multiprocessing
import re
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from fitting import fit
from gonio.config import default_documents, parse_rig, small_plan
from gonio.formats import csv
from gonio.posterior import Posterior
from gonio.radiometry import reduce_run
from gonio.rig import open_rig
from gonio.samples import BRDFSamples
from gonio.scan import create_run, rig_of, scan
from tests.gates import record

NAMES = ("lambertian.albedo", "ggx.alpha", "ggx.f_0")


def measured(seed: int, folder: Path) -> tuple[BRDFSamples, dict[str, float]]:
    """Samples of a small scan, and the truth behind them."""
    text = re.sub(r"(?m)^seed = \d+", f"seed = {seed}", default_documents()["rig.toml"])
    text = re.sub(r"(?m)^process = true", "process = false", text)
    run, _ = create_run(folder / f"run-{seed}", text, small_plan())
    with run:
        with open_rig(rig_of(run)) as rig:
            scan(run, rig)
        samples = reduce_run(run, parse_rig(text))
        run.write_samples(samples)
        truth = json.loads(run.attributes["truth"])["parameters"]
        return run.read_samples(), truth


def posterior_of(seed: int, folder: Path) -> tuple[Posterior, dict[str, float]]:
    samples, truth = measured(seed, folder)
    return fit(samples, "lambertian+ggx", seed=seed), truth


def held(seed: int) -> list[tuple[bool, bool, float]]:
    """For each parameter: is the truth inside the 95 % interval, inside the 68 % interval, and the pull."""
    with TemporaryDirectory() as folder:
        posterior, truth = posterior_of(seed, Path(folder))
    assert posterior.diagnostics["converged"]
    summary = posterior.summary()
    out = []
    for name in NAMES:
        s, t = summary[name], truth[name]
        out.append((s["q025"] <= t <= s["q975"], s["q16"] <= t <= s["q84"], (s["mean"] - t) / s["sd"]))
    return out


def test_a_few_runs_hold_the_truth() -> None:
    """The slice for every change. Three of 12 intervals at 95 % missing would happen once in 50 such slices by chance; the
    pulls must not exceed what 12 normal numbers show once in 10^4."""
    found = [one for seed in range(1, 5) for one in held(seed)]
    assert sum(not inside for inside, _, _ in found) <= 3
    assert max(abs(pull) for _, _, pull in found) < 4.3


def test_two_runs_with_one_seed_are_byte_identical(tmp_path: Path) -> None:
    files, draws = [], []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        samples, _ = measured(7, tmp_path / name)
        csv.write(tmp_path / f"{name}.csv", samples)
        files.append((tmp_path / f"{name}.csv").read_bytes())
        draws.append(fit(samples, "lambertian+ggx", seed=7).draws.tobytes())
    assert files[0] == files[1]
    assert draws[0] == draws[1]


@pytest.mark.gate
def test_coverage_over_200_seeds() -> None:
    seeds = range(1000, 1200)
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        found = np.array(pool.map(held, seeds, chunksize=5))  # (seed, parameter, 3)
    inside95, inside68, pulls = found[:, :, 0], found[:, :, 1], found[:, :, 2]
    share = float(inside95.mean())
    each = [
        f"{name} {inside95[:, k].mean():.3f} (68 %: {inside68[:, k].mean():.3f}, pulls {pulls[:, k].mean():+.2f} "
        f"+- {pulls[:, k].std():.2f})"
        for k, name in enumerate(NAMES)
    ]
    record(
        "coverage of 95 % intervals, 200 small scans on the virtual clock",
        f"{share:.3f}: {', '.join(each)}",
        "0.91 to 0.98",
        "1000 to 1199",
        "pytest -m gate tests/closed_loop/test_coverage.py",
    )
    assert 0.91 <= share <= 0.98
