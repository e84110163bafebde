"""Nanoseconds per evaluation of every registered model, against the same formula in C, on one core; and what it takes to
compile all of them.

The formulas in C are models.c. Times are compared only of formulas that agree to 1e-10. A model without its counterpart in C
is listed with its time alone.
"""

from __future__ import annotations

import ctypes
import functools
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gonio.brdf import BRDF, Model, Term
from gonio.brdf.kernels import accumulate
from tests.benchmarks import page
from tests.benchmarks.kernels import SIZE, _directions, build
from tests.registered import compiled, typical

PROMISED = 1.5  # of gonio's time to C's
AGREEMENT = 1e-10
COMPILE_SECONDS = 180.0
ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Speed:
    """Nanoseconds per evaluation.

    Attributes
    ----------
    c : float or None
        None where models.c has no such formula, or none that agrees, or there is no compiler.
    differs : float
        Largest difference of gonio and C, relative to the largest value; nan without C.
    jacobian : float
        Of all derivatives; nan where there is no parameter.
    """

    name: str
    gonio: float
    c: float | None
    differs: float
    jacobian: float

    @property
    def ratio(self) -> float:
        return math.nan if self.c is None else self.gonio / self.c


def c_name(model: Model) -> str:
    """As models.c calls it: ``oren_nayar_full``; a flag by its own name."""
    return "_".join([model.name, *(key if value == "true" else value for key, value in model.choices.items())])


def measure(seconds: float = 0.15) -> list[Speed]:
    """Every model, gonio and C in turns, so that a busy machine is unfair to neither; the best of many rounds counts."""
    rng = np.random.default_rng(0)
    w_i, w_r = _directions(rng), _directions(rng)
    found = []
    n = ctypes.c_long(SIZE)
    with tempfile.TemporaryDirectory() as folder:
        library = build(Path(folder), "models.c")
        for model in compiled():
            p, out, filled = typical(model), np.zeros(SIZE), np.zeros(SIZE)
            kernel, brdf, differs = accumulate(model), BRDF([Term(model, p)]), math.nan
            runs: dict[str, Callable[[], object]] = {"gonio": functools.partial(kernel, w_i, w_r, p, 1.0, out)}
            loop = None if library is None else getattr(library, f"{c_name(model)}_loop", None)
            if loop is not None:
                *at, to = (a.ctypes.data_as(ctypes.c_void_p) for a in (w_i, w_r, p, filled))
                in_c = functools.partial(loop, *at, ctypes.c_double(1.0), to, n)
                in_c()
                runs["gonio"]()
                differs = float(np.max(np.abs(filled - out)) / np.max(out))
                if differs <= AGREEMENT:
                    runs["c"] = in_c
            best = _turns(runs, seconds)
            slopes = _turns({"all": functools.partial(brdf.jacobian, w_i, w_r)}, 0.3 * seconds)["all"]
            found.append(Speed(model.expression, best["gonio"], best.get("c"), differs, slopes))
    return found


def report(found: Sequence[Speed], cold: Compilation) -> str:
    """The figures as a table, what was promised and what is kept."""
    rows = []
    for s in found:
        c = "-" if s.c is None else f"{s.c:.2f}"
        ratio = "-" if s.c is None else f"{s.ratio:.2f}{'' if s.ratio <= PROMISED else ' MISS'}"
        if s.differs > AGREEMENT:
            ratio = f"values differ by {s.differs:.0e}"
        rows.append([s.name, f"{s.gonio:.2f}", c, ratio, f"{s.jacobian:.1f}"])
    compared = [s for s in found if s.c is not None]
    kept = [s for s in compared if s.ratio <= PROMISED]
    head = ["model", "ns per evaluation, one core", "C, the same formula", "gonio / C", "all derivatives, ns"]
    return page.table(head, rows) + (
        f"\n{len(kept)} of {len(compared)} formulas that were compared are within {PROMISED} times C"
        f" (promised: all). Parameters are at the medians of their priors.\n"
        f"\nThe whole suite - every model evaluated, differentiated, and under a beam, a uniform and a hemispherical source "
        f"and a disk - is {cold.kernels} kernels. From an empty cache they take {cold.processor:.0f} s of processor time "
        f"(promised: {COMPILE_SECONDS:.0f} s; {'pass' if cold.processor <= COMPILE_SECONDS else 'MISS'}); {cold.processes} "
        f"processes side by side had them ready in {cold.clock:.0f} s.\n"
    )


def _turns(runs: dict[str, Callable[[], object]], seconds: float) -> dict[str, float]:
    best = dict.fromkeys(runs, np.inf)
    for run in runs.values():
        run()
    end, rounds = time.perf_counter() + seconds * len(runs), 0
    while time.perf_counter() < end or rounds < 5:
        rounds += 1
        for name, run in runs.items():
            start = time.perf_counter()
            run()
            best[name] = min(best[name], (time.perf_counter() - start) / SIZE * 1e9)
    return best


_COMPILE = """
import sys, time
from tests.benchmarks.models import compile_all
print(compile_all(*map(int, sys.argv[1:])), time.process_time())
"""


@dataclass(frozen=True)
class Compilation:
    """Of all kernels, by processes that share a cache which was empty.

    Attributes
    ----------
    kernels : int
    processor, clock : float
        Seconds, of all processes together and until the last was done.
    processes : int
    """

    kernels: int
    processor: float
    clock: float
    processes: int


def compile_all(first: int, step: int) -> int:
    """Use every `step`-th model under every rule of the integrator; how many kernels had to be compiled."""
    import gonio
    from gonio import jit

    sources = [
        gonio.source.make("collimated", theta=0.5, phi=0.3),
        gonio.source.make("uniform", radiance=1.0),
        gonio.source.make("hemispherical", radiance=1.0),
        gonio.source.make("disk", theta=0.6, phi=0.2, half_angle=0.1, radiance=1.0),
    ]
    p, up, slanted = np.linspace(-2.0, 2.0, 5), np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.6, 0.8])
    for model in compiled()[first::step]:
        brdf = BRDF([Term(model, typical(model))])
        brdf.evaluate(up, slanted)
        brdf.jacobian(up, slanted)
        for source in sources:
            gonio.reflectance_map(brdf, source, p[:, None], p, rtol=1e-2)
    return jit.compiled_count()


def compile_cold() -> Compilation:
    """One process for each core, all models among them."""
    processes = os.cpu_count() or 1
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {"NUMBA_CACHE_DIR": folder}
        start = time.perf_counter()
        running = [
            subprocess.Popen(
                [sys.executable, "-c", _COMPILE, str(first), str(processes)],
                env=environment, cwd=ROOT, stdout=subprocess.PIPE, text=True,
            )
            for first in range(processes)
        ]  # fmt: skip
        answers = [process.communicate()[0].split()[-2:] for process in running]
        clock = time.perf_counter() - start
    if any(process.returncode for process in running):
        raise RuntimeError("a process that compiles the kernels failed; its message is above")
    return Compilation(sum(int(a[0]) for a in answers), sum(float(a[1]) for a in answers), clock, processes)
