"""Nanoseconds per evaluation of the compiled kernels, against the same formula in C and in NumPy, on one core."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import gonio
from gonio.brdf.kernels import sum_kernel
from tests.benchmarks.scenes import Scene

Array = NDArray[np.float64]
FLAGS = ("-O3", "-march=native", "-ffast-math", "-fno-math-errno", "-shared", "-fPIC")
REFERENCE_NS = 2.8  # of `integrate` in C on one core of the machine on which the targets were set
SIZE = 16384  # evaluations per call: the arrays stay in the cache, and what a call costs by itself does not count
ROUGH = {"albedo": 0.5, "k_s": 1.0, "alpha": 0.1, "f_0": 0.04}


@dataclass(frozen=True)
class Speeds:
    """Nanoseconds per evaluation; None without a C compiler.

    Attributes
    ----------
    factor : float
        How much slower (> 1) or faster than the targets' machine this one is, by the C kernel; 1 without a compiler.
    """

    gonio: float
    evaluate: float
    numpy: float
    c_evaluate: float | None
    c_integrate: float | None
    compiler: str

    @property
    def factor(self) -> float:
        return 1.0 if self.c_integrate is None else self.c_integrate / REFERENCE_NS

    @property
    def ratio(self) -> float | None:
        return None if self.c_evaluate is None else self.gonio / self.c_evaluate


def build(folder: Path, name: str = "kernels.c") -> ctypes.CDLL | None:
    """Compile a file of this folder into another folder; None if there is no compiler."""
    compiler = shutil.which("gcc") or shutil.which("cc") or shutil.which("clang")
    if compiler is None:
        return None
    source = Path(__file__).with_name(name)
    target = folder / f"{source.stem}.so"
    subprocess.run([compiler, *FLAGS, str(source), "-o", str(target), "-lm"], check=True)
    return ctypes.CDLL(str(target))


def measure(seconds: float = 0.2) -> Speeds:
    """All kernels, interleaved, so that a busy machine is unfair to none; the best of many rounds counts."""
    rng = np.random.default_rng(0)
    w_i, w_r = _directions(rng), _directions(rng)
    out = np.zeros(SIZE)
    brdf = gonio.brdf.make("lambertian", albedo=ROUGH["albedo"]) + gonio.brdf.make(
        "ggx", k_s=ROUGH["k_s"], alpha=ROUGH["alpha"], f_0=ROUGH["f_0"]
    )
    fused = sum_kernel(brdf.terms)
    assert fused is not None

    def compiled() -> None:
        fused[0](w_i, w_r, fused[1], out)

    scene = Scene("ggx 0.1", "sphere")
    f_r = scene.f_r(np)
    x, y, z = (np.ascontiguousarray(c) for c in w_i.T)
    xr, zr = float(np.hypot(w_r[0, 0], w_r[0, 1])), float(w_r[0, 2])
    runs: dict[str, Callable[[], object]] = {
        "gonio": compiled, "evaluate": lambda: brdf.evaluate(w_i, w_r), "numpy": lambda: f_r(x, y, z, xr, zr),
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        library = build(Path(folder))
        if library is not None:
            library.integrate.restype = ctypes.c_double
            p = np.array(list(ROUGH.values()))
            filled = np.empty(SIZE)
            weights = np.full(SIZE, 1.0 / SIZE)
            n = ctypes.c_long(SIZE)
            at = [a.ctypes.data_as(ctypes.c_void_p) for a in (w_i, w_r, p, filled)]
            columns = [a.ctypes.data_as(ctypes.c_void_p) for a in (x, y, z, weights)]
            runs["c_evaluate"] = lambda: library.evaluate(*at, n)
            runs["c_integrate"] = lambda: library.integrate(*columns, ctypes.c_double(xr), ctypes.c_double(zr), at[2], n)
            runs["c_evaluate"]()
            compiled()
            worst = float(np.max(np.abs(filled - out) / out))
            if not worst < 1e-10:  # a comparison of speeds of two different formulas would be none
                raise AssertionError(f"kernels.c and gonio differ by {worst:.1e}")
        best = _interleaved(runs, seconds)
    compiler = shutil.which("gcc") or shutil.which("cc") or shutil.which("clang") or "none"
    return Speeds(
        best["gonio"], best["evaluate"], best["numpy"], best.get("c_evaluate"), best.get("c_integrate"), Path(compiler).name
    )


def _interleaved(runs: dict[str, Callable[[], object]], seconds: float) -> dict[str, float]:
    best = dict.fromkeys(runs, np.inf)
    for run in runs.values():
        run()
    end = time.perf_counter() + seconds * len(runs)
    while time.perf_counter() < end:
        for name, run in runs.items():
            start = time.perf_counter()
            for _ in range(4):
                run()
            best[name] = min(best[name], (time.perf_counter() - start) / (4 * SIZE) * 1e9)
    return best


def _directions(rng: np.random.Generator) -> Array:
    w = rng.normal(size=(SIZE, 3))
    w[:, 2] = np.abs(w[:, 2]) + 0.01
    return w / np.linalg.norm(w, axis=1, keepdims=True)
