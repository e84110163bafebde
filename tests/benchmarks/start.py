"""Wall time of ``gonio map scene.toml``: the first ever run, a cold start on a cached installation, and the map alone."""

from __future__ import annotations

import importlib.resources
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Start:
    """Seconds.

    Attributes
    ----------
    first : float
        With an empty kernel cache.
    says_so : bool
        Whether the first run told that it compiled.
    cold : float
        New process, kernels in the cache; best of several.
    cold_processor : float
        Processor time of it: what the wall time would be on an idle machine, at best.
    help : float
        ``gonio --help``.
    """

    first: float
    says_so: bool
    cold: float
    cold_processor: float
    help: float


def measure(*, quick: bool) -> Start:
    """The scene that ``gonio init`` writes, plus a sky."""
    scene = importlib.resources.files("gonio.config").joinpath("defaults/scene.toml").read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sky = '[[source]]\nkind = "hemispherical"\nradiance = 0.1\n\n[grid]'
        (folder / "scene.toml").write_text(scene.replace("[grid]", sky, 1), encoding="utf-8")
        environment = os.environ | {"NUMBA_CACHE_DIR": str(folder / "cache")}

        def run(*arguments: str) -> tuple[float, float, str]:
            command = [sys.executable, "-m", "gonio.cli.main", *arguments]
            start, before = time.perf_counter(), os.times()
            done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
            after = os.times()
            busy = after.children_user - before.children_user + after.children_system - before.children_system
            return time.perf_counter() - start, busy, done.stdout + done.stderr

        arguments = ("map", str(folder / "scene.toml"), "--out", str(folder / "map.nc"))
        first, _, text = run(*arguments)
        rounds = 3 if quick else 7
        cold = [run(*arguments)[:2] for _ in range(rounds)]
        return Start(
            first, "compil" in text, min(wall for wall, _ in cold), min(busy for _, busy in cold),
            min(run("--help")[0] for _ in range(rounds)),
        )  # fmt: skip
