"""Run time against true error, gonio and its peers on the same scenes in the same run.

The unit is one map of 64 x 64 gradients in [-3, 3]. gonio computes all of it, on all cores; its error is the largest over
the sample of pixels in `scenes`. Peers run on one core and on a few of these pixels; their time is scaled to the map and to
the cores as if they scaled perfectly, and the pixels that they were spared could only add to their error.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

import gonio
from gonio.errors import IntegrationError
from gonio.integrate import MapValues
from tests.benchmarks import mitsuba_peer, peers
from tests.benchmarks.limits import LateError, at_most
from tests.benchmarks.scenes import AXIS, FAINT, N, Scene, load_truths, relative_error, sample, scenes, truths

Array = NDArray[np.float64]
LEVELS = (1e-2, 1e-3, 1e-4, 1e-6, 1e-8, 1e-10)
CORES = os.cpu_count() or 1
BY_HAND = "numpy, Gauss on the disk"
SHOWN = (  # scenes on which scipy has its turn, and which the picture shows
    Scene("lambert", "sky"), Scene("ggx 0.1", "sky"), Scene("ggx 0.02", "sky"), Scene("oren_nayar", "sky"),
    Scene("lambert", "vmf"), Scene("phong 50", "vmf"), Scene("ggx 0.1", "vmf"), Scene("ggx 0.02", "vmf"),
    Scene("ggx 0.1", "disk 5"), Scene("ggx 0.02", "disk 5"), Scene("ggx 0.02", "disk 0.25"), Scene("ggx 0.1", "map"),
    Scene("lambert", "sphere"), Scene("lambert", "map"), Scene("ggx 0.02", "map"), Scene("ggx 0.3", "vmf"),
)  # fmt: skip
QUICK = (Scene("lambert", "sky"), Scene("ggx 0.02", "vmf"), Scene("ggx 0.1", "disk 5"))


@dataclass(frozen=True)
class Run:
    """One program at one setting on one scene.

    Attributes
    ----------
    seconds : float
        Per map of 64 x 64.
    error : float
        Largest relative error over the pixels tried; NaN if there is no result.
    evaluations : float
        Of f_r, per gradient.
    scaled : bool
        Timed on a part of the map.
    remark : str
        ``"refused"`` (gonio raised, and said how far it got), ``"understated"`` (true error above the reported one),
        ``"late"``.
    """

    program: str
    setting: str
    seconds: float
    error: float
    evaluations: float
    scaled: bool = True
    remark: str = ""


@dataclass
class Result:
    """All runs on a scene."""

    scene: Scene
    runs: list[Run] = field(default_factory=list)

    def fastest(self, program: str, level: float) -> Run | None:
        """The cheapest run of a program whose true error is at most `level`."""
        good = [r for r in self.runs if r.program == program and r.error <= level]
        return min(good, key=lambda r: r.seconds, default=None)

    def best_peer(self, level: float, but: tuple[str, ...] = ()) -> Run | None:
        """The cheapest of all the others."""
        found = [self.fastest(name, level) for name in self.programs() if name != "gonio" and name not in but]
        return min((r for r in found if r is not None), key=lambda r: r.seconds, default=None)

    def programs(self) -> list[str]:
        return list(dict.fromkeys(r.program for r in self.runs))

    def ratio(self, level: float, but: tuple[str, ...] = ()) -> tuple[float, str]:
        """Best peer's time over gonio's at that true error, and its name; a lower bound, with ``""``, if no peer got there.

        NaN if gonio did not.
        """
        own, peer = self.fastest("gonio", level), self.best_peer(level, but)
        if own is None:
            return np.nan, ""
        if peer is None:
            tried = [r.seconds for r in self.runs if r.program != "gonio" and r.program not in but and r.seconds > 0]
            return max(tried, default=np.nan) / own.seconds, ""
        return peer.seconds / own.seconds, peer.program


def measure(*, quick: bool, chosen: str = "") -> Iterator[Result]:
    """All scenes whose name contains `chosen`, one after another."""
    kept = load_truths()
    for scene in [s for s in scenes() if chosen in s.name] if chosen else (list(QUICK) if quick else scenes()):
        true = truths(scene, kept)
        result = Result(scene, run_gonio(scene, true, quick))
        if scene.kind == "collimated":
            result.runs.append(_by_formula(scene, true))
        else:
            result.runs += _product_rules(scene, true, 0.05 if quick else 0.25)
            whole = scene in SHOWN and not quick
            result.runs += _scipy(scene, true, 1.5 if whole else 0.35 if quick else 0.7, whole=whole)
            if scene.surface == "lambert" and scene.light in ("sphere", "map"):
                for setting, seconds, error, samples in mitsuba_peer.measure(scene, true):
                    result.runs.append(Run("mitsuba", setting, seconds / CORES, error, samples))
        yield result


def run_gonio(scene: Scene, true: Array, quick: bool) -> list[Run]:
    """gonio at rising demands; on the sample only once the whole map takes longer than the limit."""
    limit_s = 3.0 if quick else 10.0
    brdf, source, pixels = scene.brdf(), scene.source(), sample()
    runs: list[Run] = []
    _timed(brdf, source, AXIS[pixels[:2, 1]], AXIS[pixels[:2, 0]], 0.1)  # kernels compile once per installation, not here
    scaled = False
    for rtol in (1e-2, 1e-4, 1e-6, 1e-8) if quick else LEVELS:
        if not scaled:
            try:
                with at_most(limit_s):
                    got, seconds, remark = _best_of(7, brdf, source, rtol)
                value, error = got.value[*pixels.T], got.error[*pixels.T]
            except LateError:
                scaled = True
        if scaled:
            try:
                with at_most(limit_s):
                    got, seconds, remark = _timed(brdf, source, AXIS[pixels[:, 1]], AXIS[pixels[:, 0]], rtol)
            except LateError:
                break
            value, error, seconds = got.value, got.error, seconds * N * N / len(pixels)
        seen = true > FAINT * np.max(true)
        low = np.abs(value - true)[seen] > error[seen] + scene.uncertainty * true[seen]
        evaluations = sum(step.effort.evaluations for step in got.plan) / got.value.size
        remark = "understated" if np.any(low) else remark
        runs.append(Run("gonio", f"{rtol:g}", seconds, relative_error(value, true), evaluations, scaled, remark))
        if seconds > 8 * limit_s:
            break
    return runs


def _best_of(rounds: int, brdf: gonio.BRDF, source: gonio.source.Source, rtol: float) -> tuple[MapValues, float, str]:
    """The whole map, as often as fits into a second."""
    best = _timed(brdf, source, AXIS[None, :], AXIS[:, None], rtol)
    spent = best[1]
    for _ in range(rounds - 1):
        if spent > 0.5:
            break
        answer = _timed(brdf, source, AXIS[None, :], AXIS[:, None], rtol)
        spent, best = spent + answer[1], min(best, answer, key=lambda a: a[1])
    return best


def _timed(brdf: gonio.BRDF, source: gonio.source.Source, p: Array, q: Array, rtol: float) -> tuple[MapValues, float, str]:
    start, remark = time.perf_counter(), ""
    try:
        got = gonio.reflectance_map(brdf, source, p, q, rtol=rtol)
    except IntegrationError as exc:
        if not isinstance(exc.best, MapValues):
            raise
        got, remark = exc.best, "refused"
    return got, time.perf_counter() - start, remark


def _gradients(which: NDArray[np.intp]) -> Array:
    return np.stack((AXIS[sample()[which, 1]], AXIS[sample()[which, 0]]), axis=-1)


def _run(program: str, setting: str, answer: peers.Answer, true: Array) -> Run:
    remark = "late" if answer.late else ""
    seconds = answer.seconds * N * N / CORES
    return Run(program, setting, seconds, relative_error(answer.values, true), answer.evaluations, True, remark)


def _product_rules(scene: Scene, true: Array, limit_s: float) -> list[Run]:
    """NumPy's rules with more and more nodes, until a gradient takes too long or nothing is left to gain."""
    rules: dict[str, Callable[[int, Array], peers.Answer]] = {
        "numpy, midpoint": lambda n, at: peers.product_rule(scene, at, peers.midpoint(n)),
        "numpy, Gauss": lambda n, at: peers.product_rule(scene, at, peers.gauss(n)),
    }
    if scene.kind == "disk":
        rules[BY_HAND] = lambda n, at: peers.disk_rule(scene, at, n)
    runs, at = [], _gradients(np.arange(len(true)))
    for program, rule in rules.items():
        for n in (4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512):
            rule(n, at[:1])
            answers = [rule(n, at) for _ in range(3 if n < 64 else 1)]
            best = min(answers, key=lambda a: a.seconds)
            runs.append(_run(program, f"{n} x {2 * n}", best, true))
            if runs[-1].error < 1e-12 or best.seconds * len(true) > limit_s:
                break
    return runs


def _scipy(scene: Scene, true: Array, limit_s: float, *, whole: bool) -> list[Run]:
    """dblquad and cubature, at most `limit_s` for each setting; not `whole`: split by hand only, which is the better one."""
    tried = np.array([0, 1, 2, 3, 4, 5, 12, 13])  # six by chance; the sun's mirror image and its terminator
    order = np.concatenate((tried, np.setdiff1d(np.arange(len(true)), tried)))
    runs = []
    for program, peer in (("dblquad", peers.dblquad), ("cubature", peers.cubature)):
        for split in (True, False) if whole else (True,):
            for rtol in (1e-3, 1e-6, 1e-9) if whole else (1e-3, 1e-6):
                answer = peer(scene, _gradients(tried), rtol, split=split, limit_s=limit_s)
                runs.append(_run(f"{program}, {'split' if split else 'full'}", f"{rtol:g}", answer, true[order]))
                if answer.late or runs[-1].error < 1e-12:
                    break
    return runs


def _by_formula(scene: Scene, true: Array) -> Run:
    """A beam is a delta function that no quadrature sees: the formula of 14a in NumPy, on the whole map."""
    light = scene.data["source"][0]
    st, ct = np.sin(light["theta"]), np.cos(light["theta"])
    f_r = scene.f_r(np)

    def solve() -> Array:
        p, q = AXIS[None, :], AXIS[:, None]
        slope = np.hypot(p, q)
        c = 1.0 / np.sqrt(1.0 + slope * slope)
        s, cp, sp = slope * c, -p / slope, -q / slope
        ahead = st * (np.cos(light["phi"]) * cp + np.sin(light["phi"]) * sp)
        across = st * (np.sin(light["phi"]) * cp - np.cos(light["phi"]) * sp)
        zi = np.maximum(ahead * s + ct * c, 0.0)
        value: Array = light["irradiance"] * f_r(ahead * c - ct * s, across, zi, -s, c) * zi
        return value

    value, best = solve(), np.inf
    for _ in range(20):
        start = time.perf_counter()
        solve()
        best = min(best, time.perf_counter() - start)
    return Run("numpy, formula 14a", "", best / CORES, relative_error(value[*sample().T], true), 1.0, False)
