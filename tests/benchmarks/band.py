"""Cost of the band of a posterior: the map of many parameter sets against as many maps."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

import gonio
from gonio import maps
from tests.benchmarks.scenes import Scene

LIGHTS = ("beam", "sky", "disk 5")


@dataclass(frozen=True)
class Band:
    """Nanoseconds per draw and gradient.

    Attributes
    ----------
    banded, single : float
        Within a band; as a map of its own at the same tolerance.
    error : float
        Largest error of an end of the band, relative to the width of the band.
    """

    light: str
    draws: int
    n: int
    banded: float
    single: float
    error: float


def measure(light: str, *, quick: bool) -> Band:
    """Draws of lambertian + ggx scattered by a few per cent, as a posterior's are."""
    draws, n = (40, 64) if quick else (200, 256)
    rng = np.random.default_rng(3)
    brdfs = [
        gonio.brdf.make("lambertian", albedo=0.5 * (1 + 0.02 * a))
        + gonio.brdf.make("ggx", k_s=1.0, alpha=0.2 * (1 + 0.03 * b), f_0=0.05 * (1 + 0.05 * c))
        for a, b, c in rng.normal(size=(draws, 3))
    ]
    source, axis = Scene("ggx 0.1", light).source(), np.linspace(-3, 3, n)
    maps.compute(brdfs[0], source, axis[::16], axis[::16], rtol=1e-4, draws=brdfs[:5], tolerant=True)
    single = np.inf
    for brdf in brdfs[:3]:
        start = time.perf_counter()
        gonio.reflectance_map(brdf, source, axis[None, :], axis[:, None], rtol=1e-4)
        single = min(single, time.perf_counter() - start)
    start = time.perf_counter()
    made, _ = maps.compute(brdfs[0], source, axis, axis, rtol=1e-4, draws=brdfs, tolerant=True)
    whole = time.perf_counter() - start - single
    assert made.band is not None and made.band_error is not None
    width = made.band[1] - made.band[0]
    error = float(np.max(np.divide(made.band_error, width, out=np.zeros_like(width), where=width > 0.0)))
    return Band(light, draws, n, whole / (draws * n * n) * 1e9, single / (n * n) * 1e9, error)
