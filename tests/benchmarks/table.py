"""What a table costs: nanoseconds per evaluation beside scipy's interpolators at equal error, and 10^6 samples to a table.

    python -m tests.benchmarks.table

Times are processor times of one thread, the best of several; a busy machine makes them longer all the same.
"""

from __future__ import annotations

import functools
import math
import resource
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator, RegularGridInterpolator

import gonio
from gonio.brdf.tabulated import from_brdf, tabulate
from gonio.geometry import unit_vector
from gonio.samples import BRDFSamples
from tests import materials

Array = NDArray[np.float64]


def pairs(n: int, seed: int) -> tuple[Array, Array]:
    """Pairs of directions up to 75 degrees, half of them near the mirror direction."""
    rng = np.random.default_rng(seed)
    theta_i, theta_r = np.radians(rng.uniform(0, 75, (2, n)))
    delta = rng.uniform(0, 2 * np.pi, n)
    near = rng.random(n) < 0.5
    theta_r = np.where(near, np.clip(theta_i + 0.2 * rng.standard_normal(n), 0, math.radians(75)), theta_r)
    delta = np.where(near, np.pi + 0.3 * rng.standard_normal(n), delta)
    return unit_vector(theta_i, 0.0), unit_vector(theta_r, delta)


def coordinates(wi: Array, wr: Array) -> Array:
    """theta_h, theta_d and folded phi_d [rad], shape (n, 3): what a user of scipy would compute."""
    theta_h, _, theta_d, phi_d = gonio.halfdiff.half_difference(wi, wr)
    return np.stack((theta_h, theta_d, np.abs(np.mod(phi_d + np.pi / 2, np.pi) - np.pi / 2)), axis=-1)


def nanoseconds(function: Callable[[], object], n: int, repeats: int = 7) -> float:
    best = math.inf
    for _ in range(repeats):
        start = time.thread_time()
        function()
        best = min(best, time.thread_time() - start)
    return best / n * 1e9


def rms(found: Array, truth: Array) -> float:
    return float(np.sqrt(np.mean((found / truth - 1) ** 2)))


def evaluation(alpha: float = 0.2, n: int = 100_000) -> None:
    """Rows of name, nodes, error and nanoseconds."""
    brdf = materials.paint(0.3, alpha)
    wi, wr = pairs(n, 1)
    truth = brdf.evaluate(wi, wr)
    table = from_brdf(brdf)
    ours = table.brdf()
    error = rms(ours.evaluate(wi, wr), truth)
    row("gonio table", table.value.size, error, lambda: ours.evaluate(wi, wr), n)
    for method in ("linear", "cubic"):
        for size in (1.0, 1.5, 2.0, 3.0, 4.5):
            shape = tuple(round(k * size) for k in (48, 32, 16))
            axes = (np.pi / 2 * np.linspace(0, 1, shape[0]) ** 2, *(np.linspace(0, np.pi / 2, k) for k in shape[1:]))
            grid = _on_grid(brdf, axes)
            regular = RegularGridInterpolator(axes, np.log(grid), method=method)
            few = n if method == "linear" else 5000
            peers = rms(_asked(regular, wi[:few], wr[:few]), truth[:few])
            if peers < error or size == 4.5 or method == "cubic":
                ask = functools.partial(_asked, regular, wi[:few], wr[:few])
                row(f"RegularGridInterpolator {method}", grid.size, peers, ask, few)
                break
    for nodes in (5_000, 20_000):
        a, b = pairs(nodes, 2)
        scattered = LinearNDInterpolator(coordinates(a, b), np.log(brdf.evaluate(a, b)))
        found = _asked(scattered, wi[:20_000], wr[:20_000])
        inside = np.isfinite(found)
        ask = functools.partial(_asked, scattered, wi[:20_000], wr[:20_000])
        row("LinearNDInterpolator", nodes, rms(found[inside], truth[:20_000][inside]), ask, 20_000)


def row(name: str, nodes: int, error: float, ask: Callable[[], object], n: int) -> None:
    print(f"{name:<32} {nodes:>9} nodes, rms {error:.1e}, {nanoseconds(ask, n):7.0f} ns")


def _asked(interpolator: Callable[[Array], Array], wi: Array, wr: Array) -> Array:
    return np.asarray(np.exp(interpolator(coordinates(wi, wr))))


def _on_grid(brdf: gonio.BRDF, axes: tuple[Array, ...]) -> Array:
    h, d, p = np.meshgrid(*axes, indexing="ij")
    low = np.cos(h) * np.cos(d) - np.sin(h) * np.sin(d) * np.cos(p) < 0.02
    for _ in range(60):  # below the horizon: back towards the normal
        h, d = np.where(low, 0.95 * h, h), np.where(low, 0.95 * d, d)
        low = np.cos(h) * np.cos(d) - np.sin(h) * np.sin(d) * np.cos(p) < 0.02
    wi, wr = gonio.halfdiff.directions(h, 0.0, d, p)
    return brdf.evaluate(wi, wr)


def million(n: int = 1_000_000) -> tuple[float, float, float]:
    """Seconds, peak memory [GB] and median relative error of a table of n samples of 5 % each."""
    brdf = materials.paint(0.3, 0.2)
    wi, wr = pairs(n, 3)
    f = brdf.evaluate(wi, wr)
    theta_i, theta_r = (np.arccos(w[:, 2]) for w in (wi, wr))
    phi_r = np.mod(np.arctan2(wr[:, 1], wr[:, 0]), 2 * np.pi)
    noisy = f * (1 + 0.05 * np.random.default_rng(4).standard_normal(n))
    samples = BRDFSamples.plain(theta_i, 0.0, theta_r, phi_r, noisy, 0.05 * f)
    start = time.perf_counter()
    table = tabulate(samples)
    seconds = time.perf_counter() - start
    error = float(np.median(np.abs(table.brdf().evaluate(wi[:20_000], wr[:20_000]) / f[:20_000] - 1)))
    return seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, error


if __name__ == "__main__":
    evaluation()
    seconds, memory, error = million()
    print(f"10^6 samples of 5 %: {seconds:.1f} s, peak memory {memory:.2f} GB, median error of the table {error:.1e}")
