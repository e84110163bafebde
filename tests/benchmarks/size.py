"""Cost against the size of the map: nanoseconds per gradient, and memory against what is returned."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import gonio
from tests.benchmarks.scenes import Scene

SIZES = (64, 256, 1024, 4096)
SCENES = (Scene("ggx 0.1", "beam"), Scene("ggx 0.1", "sky"), Scene("ggx 0.1", "disk 5"), Scene("ggx 0.1", "vmf"))
LIMIT_S = 60.0


@dataclass(frozen=True)
class Cost:
    """One map, computed in a process of its own after a small one.

    Attributes
    ----------
    seconds : float
        Best of the repetitions.
    memory : float
        Growth of the process's largest resident size over the bytes of value and error together; NaN where the platform
        does not tell.
    """

    n: int
    seconds: float
    memory: float

    @property
    def nanoseconds(self) -> float:
        return self.seconds / self.n**2 * 1e9


def measure(scene: Scene, *, quick: bool) -> list[Cost]:
    """Costs of rising sizes, until one takes too long."""
    costs: list[Cost] = []
    for n in SIZES[:2] if quick else SIZES:
        if costs and costs[-1].seconds * (n / costs[-1].n) ** 2 > (5.0 if quick else LIMIT_S):
            break
        command = [sys.executable, "-m", "tests.benchmarks.size", scene.surface, scene.light, str(n)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=LIMIT_S)
        except subprocess.TimeoutExpired:
            break
        costs.append(Cost(n, *json.loads(done.stdout)))
    return costs


def solve(scene: Scene, n: int) -> tuple[float, float]:
    """Seconds and memory of one size."""
    brdf, source = scene.brdf(), scene.source()
    gonio.reflectance_map(brdf, source, np.linspace(-3, 3, 32)[None, :], np.linspace(-3, 3, 32)[:, None], rtol=1e-6)
    axis = np.linspace(-3, 3, n)
    before, best, grown = _peak(), np.inf, np.nan
    for k in range(5 if n <= 1024 else 2):
        start = time.perf_counter()
        got = gonio.reflectance_map(brdf, source, axis[None, :], axis[:, None], rtol=1e-6)
        seconds = time.perf_counter() - start
        best = min(best, seconds)
        if k == 0:
            grown = (_peak() - before) / (got.value.nbytes + got.error.nbytes)
        del got
        if seconds > 5.0:
            break
    return best, grown


def _peak() -> float:
    """Largest resident size of this process so far [bytes]."""
    status = Path("/proc/self/status")
    if status.exists():  # getrusage would begin with the parent's
        return 1024.0 * next(int(l.split()[1]) for l in status.read_text().splitlines() if l.startswith("VmHWM"))
    try:
        import resource
    except ImportError:  # Windows
        return float("nan")
    return float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) * (1 if sys.platform == "darwin" else 1024)


if __name__ == "__main__":
    print(json.dumps(solve(Scene(sys.argv[1], sys.argv[2]), int(sys.argv[3]))))
