"""Held-out samples of simulated materials lie within the table's stated uncertainty as often as it says."""

from __future__ import annotations

import math

import numpy as np
import pytest

import gonio
from gonio.brdf.tabulated import tabulate
from gonio.samples import BRDFSamples
from tests import gates, materials

MATERIALS = {"paint": (0.3, 0.2), "gloss": (0.1, 0.05), "matt": (0.5, 0.5)}


def simulated(brdf: gonio.BRDF, n: int, rng: np.random.Generator) -> BRDFSamples:
    """Samples with noise of 1 % and 1e-4, half of them around the mirror direction, none beyond 75 degrees."""
    limit = math.radians(75)
    theta_i, theta_r = rng.uniform(0, limit, (2, n))
    delta = rng.uniform(0, 2 * np.pi, n)
    near = rng.random(n) < 0.5
    theta_r = np.where(near, np.minimum(np.abs(theta_i + math.radians(20) * rng.standard_normal(n)), limit), theta_r)
    delta = np.mod(np.where(near, np.pi + 0.3 * rng.standard_normal(n), delta), 2 * np.pi)
    f = brdf.f_r(theta_i, 0.0, theta_r, delta)
    u = 0.01 * f + 1e-4
    return BRDFSamples.plain(theta_i, 0.0, theta_r, delta, f + u * rng.standard_normal(n), u)


def held_out(name: str, n: int, seed: int) -> tuple[int, int]:
    """How many of the 10 % held out lie within 95 %, and how many there are."""
    rng = np.random.default_rng(seed)
    samples = simulated(materials.paint(*MATERIALS[name]), n, rng)
    out = rng.random(n) < 0.1
    table, rest = tabulate(samples.select(~out)), samples.select(out)
    wi, wr = rest.omega_i(), rest.omega_r()
    u = np.hypot(table.u_brdf().evaluate(wi, wr), rest.u_f_r)
    within = np.abs(table.brdf().evaluate(wi, wr) - rest.f_r) < 1.96 * u
    return int(np.count_nonzero(within)), int(np.count_nonzero(out))


def test_held_out_samples_of_one_material() -> None:
    within, total = held_out("paint", 1500, seed=7)
    print(f"seed 7: {within} of {total} within 95 %")
    # binomial: three standard deviations around the allowed 93 to 97 %
    spread = 3 * math.sqrt(0.95 * 0.05 / total)
    assert 0.93 - spread < within / total < 0.97 + spread


@pytest.mark.gate
def test_held_out_samples_of_three_materials() -> None:
    seeds = range(1, 11)
    parts = {}
    for name in MATERIALS:
        found = np.sum([held_out(name, 1000, seed) for seed in seeds], axis=0)
        parts[name] = float(found[0] / found[1])
    gates.record(
        "held-out samples within the table's 95 %",
        ", ".join(f"{name} {100 * part:.1f} %" for name, part in parts.items()) + " (10 % of 1000, ten times each)",
        "93 to 97 %",
        f"{seeds[0]} to {seeds[-1]}",
        "pytest -m gate tests/closed_loop/test_table_coverage.py -s",
    )
    assert all(0.93 <= part <= 0.97 for part in parts.values())


@pytest.mark.gate
def test_a_million_samples() -> None:
    from tests.benchmarks.table import million

    seconds, memory, error = million()
    gates.record(
        "10^6 samples to a table",
        f"{seconds:.1f} s, peak memory {memory:.2f} GB, median error {error:.1e} from samples of 5 %",
        "30 s, 2 GB",
        "3, 4",
        "pytest -m gate tests/closed_loop/test_table_coverage.py -s",
    )
    assert seconds < 30 and memory < 2 and error < 5e-3
