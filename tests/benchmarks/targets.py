"""The maps that gonio promises: 256 x 256 gradients in [-3, 3], warm, on all cores."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import gonio
from gonio.errors import IntegrationError
from tests.benchmarks.limits import LateError, at_most
from tests.benchmarks.scenes import Scene, scenes

Array = NDArray[np.float64]
N = 256
AXIS = np.linspace(-3.0, 3.0, N)
LIMIT_S = 6.0


@dataclass(frozen=True)
class Target:
    """A group of scenes and what one of its maps may take, on the machine of the targets [s]."""

    name: str
    lights: tuple[str, ...]
    limit: float
    limit_sharp: float  # for alpha = 0.02
    rtol: float = 1e-6


TARGETS = (
    Target("a beam", ("beam",), 3e-3, 3e-3),
    Target("skies symmetric about the view", ("sphere", "sky", "overcast"), 3e-3, 10e-3),
    Target("a sun of 0.25 degrees", ("disk 0.25",), 5e-3, 5e-3),
    Target("a disk of 5 degrees", ("disk 5",), 25e-3, 60e-3),
    Target("a smooth environment", ("vmf",), 50e-3, 50e-3),
    Target("a bilinear map of 64 x 128, to 1e-4", ("map",), 100e-3, 100e-3, 1e-4),
)


@dataclass(frozen=True)
class Time:
    """Of one scene: best of several [s]; infinite if it took longer than the limit."""

    target: Target
    scene: Scene
    seconds: float
    refused: bool

    def verdict(self, factor: float) -> str:
        """Against the target scaled to this machine, and as it stands."""
        if self.refused:
            return "refused"
        if self.seconds <= self.limit * factor:
            return "pass"
        return "MISS, kept unscaled" if self.seconds <= self.limit else "MISS"

    @property
    def limit(self) -> float:
        return self.target.limit_sharp if self.scene.surface == "ggx 0.02" else self.target.limit


def measure(*, quick: bool) -> Iterator[Time]:
    """All scenes of all targets; quick: half of the surfaces."""
    for target in TARGETS:
        for scene in scenes():
            if scene.light in target.lights and not (quick and scene.surface in ("oren_nayar", "phong 50", "ggx 0.3")):
                yield _time(target, scene, 2.0 if quick else LIMIT_S, 3 if quick else 15)


def _time(target: Target, scene: Scene, limit_s: float, rounds: int) -> Time:
    brdf, source = scene.brdf(), scene.source()
    best, refused = np.inf, False

    def solve(axis: Array) -> bool:
        try:
            gonio.reflectance_map(brdf, source, axis[None, :], axis[:, None], rtol=target.rtol)
        except IntegrationError:
            return True
        return False

    try:
        with at_most(limit_s):
            solve(AXIS[::24])  # kernels compile once per installation, not here
        start = time.perf_counter()
        with at_most(limit_s):
            for _ in range(rounds):
                begun = time.perf_counter()
                refused = solve(AXIS)
                best = min(best, time.perf_counter() - begun)
                if time.perf_counter() - start > 2.0:
                    break
    except LateError:
        pass
    return Time(target, scene, best, refused)
