"""The figures as Markdown tables, and docs/benchmarks.md with its picture."""

from __future__ import annotations

import datetime
import importlib.util
import math
import os
import platform
import re
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

from tests.benchmarks.accuracy import BY_HAND, CORES, LEVELS, SHOWN, Result, Run
from tests.benchmarks.band import Band
from tests.benchmarks.kernels import REFERENCE_NS, Speeds
from tests.benchmarks.scenes import Scene
from tests.benchmarks.size import Cost
from tests.benchmarks.start import Start
from tests.benchmarks.targets import TARGETS, Time

DOCS = Path(__file__).parents[2] / "docs"
PICTURE = "images/benchmark.png"
TITLES = {
    "verdicts": "Promises", "accuracy": "Run time against error", "targets": "Maps that gonio promises",
    "size": "Size of the map", "kernels": "One evaluation", "models": "Every model", "start": "Start",
    "band": "Band of a posterior", "rig": "Simulated rig", "bus": "Servo line", "fit": "A posterior",
}  # fmt: skip
Row = Sequence[str]


def table(head: Row, rows: Sequence[Row]) -> str:
    lines = ["| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *rows)]
    return "\n".join(lines) + "\n"


def seconds(value: float) -> str:
    """Two digits and a unit that a human reads."""
    if not math.isfinite(value):
        return "-"
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)):
        if value >= size or unit == "us":
            return f"{_two(value / size)} {unit}"
    return ""


def _two(value: float) -> str:
    if not math.isfinite(value):
        return "-"
    if value >= 1e5:
        return f"{value:.0e}".replace("e+0", "e")
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"


def machine() -> str:
    """One paragraph: what ran where, and what else was going on."""
    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        name = next((l.split(":", 1)[1].strip() for l in info.read_text().splitlines() if l.startswith("model name")), name)
    known = ("numpy", "scipy", "numba", "mitsuba", "emcee", "numpyro")
    packages = ", ".join(f"{p} {version(p)}" for p in known if importlib.util.find_spec(p) is not None)
    load = f"; load average at the start {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    today = datetime.datetime.now(datetime.UTC).date().isoformat()
    return f"{name}, {CORES} cores, Python {platform.python_version()}, {packages}, {today}{load}."


def write_sections(introduction: str, fresh: Mapping[str, str]) -> None:
    """Put sections into the page: their texts by name, each beginning with its title; the others stay as they are."""
    path = DOCS / "benchmarks.md"
    older = re.split(r"\n(?=## )", path.read_text(encoding="utf-8"))[1:] if path.exists() else []
    texts = {text.split("\n", 1)[0]: f"\n{text.rstrip()}\n" for text in older}
    texts |= {f"## {TITLES[name]}": text for name, text in fresh.items()}
    path.write_text(introduction + "".join(texts.get(f"## {title}", "") for title in TITLES.values()), encoding="utf-8")


def cell(run: Run | None) -> str:
    """Time and evaluations per gradient."""
    if run is None:
        return "-"
    about = "~" if run.program == "gonio" and run.scaled else ""
    return f"{about}{seconds(run.seconds)} · {_count(run.evaluations)}"


def _count(value: float) -> str:
    for unit, size in (("M", 1e6), ("k", 1e3)):
        if value >= size:
            return f"{_two(value / size)}{unit}"
    return _two(value)


def kernels(speeds: Speeds) -> str:
    rows = [
        ["gonio, lambertian + ggx into one array", f"{speeds.gonio:.2f}"],
        ["gonio, `brdf.evaluate`", f"{speeds.evaluate:.2f}"],
        ["NumPy", f"{speeds.numpy:.2f}"],
    ]
    if speeds.c_evaluate is not None and speeds.c_integrate is not None:
        rows += [
            [f"C, the same ({speeds.compiler} -O3 -march=native -ffast-math)", f"{speeds.c_evaluate:.2f}"],
            ["C, sum over the nodes of a quadrature", f"{speeds.c_integrate:.2f}"],
        ]
    text = table(["kernel", "ns per evaluation, one core"], rows)
    if speeds.ratio is None:
        return text + "\nNo C compiler here: no ratio, and the targets are not scaled.\n"
    return text + (
        f"\ngonio / C: {speeds.ratio:.2f}. The targets were set on a machine where the C sum takes {REFERENCE_NS} ns; their "
        f"times are scaled by {speeds.factor:.2f} to this one.\n"
    )


def one_result(result: Result) -> str:
    """All programs of one scene against the error reached."""
    rows = []
    for program in result.programs():
        runs = [result.fastest(program, level) for level in LEVELS]
        if any(runs) or program != BY_HAND:
            rows.append([program, *(cell(run) for run in runs)])
    lost = [r for r in result.runs if r.program == "gonio" and r.remark]
    note = "".join(f"\ngonio at rtol {r.setting}: {r.remark}, true error {r.error:.1e}.\n" for r in lost)
    head = [f"**{result.scene.name}**", *(f"{level:.0e}".replace("e-0", "e-") for level in LEVELS)]
    return table(head, rows) + note


def summary(results: Sequence[Result]) -> str:
    """One line per scene."""
    rows = []
    for r in results:
        ratio, name = r.ratio(1e-6)
        shown = "-" if math.isnan(ratio) else f"{'' if name else '> '}{_two(ratio)}"
        cells = [cell(r.fastest("gonio", level)) for level in LEVELS]
        rows.append([r.scene.name, *cells, shown, name or "none got there"])
    head = ["scene", *(f"{level:.0e}".replace("e-0", "e-") for level in LEVELS), "best peer / gonio at 1e-6", "best peer"]
    return table(head, rows)


def sizes(costs: dict[Scene, list[Cost]]) -> str:
    rows = [
        [scene.name, f"{c.n}^2", seconds(c.seconds), _two(c.nanoseconds), f"{c.memory:.1f}"]
        for scene, found in costs.items()
        for c in found
    ]
    return table(["scene, rtol 1e-6", "gradients", "time", "ns per gradient", "memory / output"], rows)


def start(s: Start) -> str:
    said = "and says that it compiles" if s.says_so else "without a word"
    rows = [
        [f"`gonio map scene.toml`, first ever run, {said}", seconds(s.first), "-"],
        ["`gonio map scene.toml`, new process, kernels cached", seconds(s.cold), seconds(s.cold_processor)],
        ["`gonio --help`", seconds(s.help), "-"],
    ]
    return table(["command", "wall time", "of it on the processor"], rows)


def bands(found: Sequence[Band]) -> str:
    rows = [
        [f"ggx 0.2 + {b.light}", str(b.draws), f"{b.n}^2", _two(b.banded), _two(b.single), f"{b.single / b.banded:.1f}",
         f"{b.error:.0e}"]
        for b in found
    ]  # fmt: skip
    head = ["scene, rtol 1e-4", "draws", "gradients", "ns per draw and gradient", "as single maps", "gain", "error / width"]
    return table(head, rows)


def times(found: Sequence[Time], factor: float) -> str:
    rows = []
    for t in found:
        limit = t.limit * factor
        shown = seconds(t.seconds) if math.isfinite(t.seconds) else "late"
        rtol = f"{t.target.rtol:.0e}".replace("e-0", "e-")
        rows.append([t.scene.name, rtol, shown, seconds(t.limit), seconds(limit), t.verdict(factor)])
    return table(["map of 256 x 256", "rtol", "time", "target", "scaled to here", ""], rows)


def verdicts(
    speeds: Speeds,
    results: Sequence[Result],
    found: Sequence[Time],
    costs: dict[Scene, list[Cost]],
    began: Start,
    *,
    quick: bool,
) -> str:
    """Every promise, what was measured, and whether it is kept."""
    rows: list[Row] = []

    def judge(what: str, limit: str, measured: str, kept: bool | str) -> None:
        rows.append([what, limit, measured, kept if isinstance(kept, str) else "pass" if kept else "MISS"])

    for target in TARGETS:
        apart = target.limit != target.limit_sharp
        for sharp in (False, True) if apart else (False,):
            group = [t for t in found if t.target is target and (not apart or (t.scene.surface == "ggx 0.02") == sharp)]
            if not group:
                continue
            worst = max(group, key=lambda t: t.seconds)
            limit = worst.limit * speeds.factor
            shown = seconds(worst.seconds) if math.isfinite(worst.seconds) else "late"
            judge(
                f"256 x 256 under {target.name}{', alpha = 0.02' if sharp else ''}",
                f"{seconds(worst.limit)}, here {seconds(limit)}", f"{shown} ({worst.scene.name})",
                next((t for t in group if t.refused), worst).verdict(speeds.factor),
            )  # fmt: skip
    demands = {t.scene: t for t in found if t.scene.kind != "collimated"}
    asked = [(r, demands[r.scene]) for r in results if r.scene in demands]
    for glossy, demanded in ((True, 100.0), (False, 3.0)):
        for n in (256, 64):
            ratios = [_ratio(r, t, n) for r, t in asked if r.scene.glossy or not glossy]
            if ratios:
                least, scene, name = min(ratios)
                what = f"ratio to the best peer at the target's error, {'glossy' if glossy else 'anywhere'}, {n} x {n}"
                judge(what, f">= {demanded:.0f}", f"{_two(least)} ({scene}, {name})", least >= demanded)
    for but, what in (((BY_HAND,), "the same"), ((), "the same, scripts that know the disk included")):
        every = [(*r.ratio(level, but), r.scene.name, level) for r, _ in asked for level in LEVELS[:5]]
        if every := [x for x in every if x[1]]:
            least, name, scene, level = min(every)
            shown = f"{_two(least)} ({scene}, {name}, at {level:.0e})"
            judge(f"{what}, at every error from 1e-2 to 1e-8, 64 x 64", ">= 3", shown, least >= 3.0)
    large = [(c, scene) for scene, group in costs.items() for c in group if c.n == 4096]
    if large:
        slowest = max(large, key=lambda c: c[0].nanoseconds)
        limit = 60.0 * speeds.factor
        judge(
            "4096 x 4096", f"60 ns, here {_two(limit)} ns per gradient",
            f"{_two(slowest[0].nanoseconds)} ns ({slowest[1].name})", slowest[0].nanoseconds <= limit,
        )  # fmt: skip
        most = max(large, key=lambda c: c[0].memory)
        judge("memory, 4096 x 4096", "<= 3 x output", f"{most[0].memory:.1f} ({most[1].name})", most[0].memory <= 3.0)
    late = [scene.name for scene, group in costs.items() if group and group[-1].n < 4096]
    if late and not quick:
        judge("4096 x 4096 within a minute", "all scenes", "late: " + ", ".join(late), False)
    if speeds.ratio is not None:
        judge("ggx + lambertian against C", "<= 1.3", f"{speeds.ratio:.2f}", speeds.ratio <= 1.3)
    cold = f"{seconds(began.cold)} ({seconds(began.cold_processor)} of processor)"
    judge("cold start of `gonio map`", "1.5 s", cold, began.cold <= 1.5)
    judge("first ever run, and says that it compiles", "20 s", seconds(began.first), began.first <= 20.0 and began.says_so)
    lies = dict.fromkeys(r.scene.name for r in results for x in r.runs if x.remark == "understated")
    judge("errors understated", "none", ", ".join(lies) or "none", not lies)
    return table(["promise", "limit", "measured", ""], rows)


def _ratio(result: Result, time: Time, n: int) -> tuple[float, str, str]:
    """Of the best peer's time to gonio's at the target's error (0: gonio does not reach it), the scene, and the peer."""
    own = result.fastest("gonio", time.target.rtol)
    ratio, name = result.ratio(time.target.rtol, (BY_HAND,))
    if own is None or math.isnan(ratio):
        return 0.0, result.scene.name, "gonio does not get there"
    if n == 256:  # a peer's time grows with the number of gradients
        ratio *= 16.0 * own.seconds / time.seconds
    return ratio, result.scene.name, name or "more than all peers tried"


def picture(results: Sequence[Result], path: Path) -> None:
    """Time against error, one panel per scene."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    shown = [r for r in results if r.scene in SHOWN] or list(results)
    columns = 4 if len(shown) > 4 else 2
    rows = math.ceil(len(shown) / columns)
    figure, axes = plt.subplots(rows, columns, figsize=(3.6 * columns, 3.0 * rows), sharex=True, sharey=True, squeeze=False)
    names = [n for n in dict.fromkeys(p for r in shown for p in r.programs()) if n != "gonio"]
    colours = dict(zip(names, plt.get_cmap("tab10").colors, strict=False))  # type: ignore[attr-defined]
    for panel, result in zip(axes.flat, shown, strict=False):
        for program in result.programs():
            runs = sorted((r for r in result.runs if r.program == program and r.error >= 0), key=lambda r: r.seconds)
            x, y = [r.seconds for r in runs], [min(max(r.error, 1e-13), 2.0) for r in runs]
            own = program == "gonio"
            panel.loglog(
                x, y, marker="o" if own else ".", ms=5 if own else 4, lw=2.2 if own else 1.0, label=program,
                color="black" if own else colours[program], zorder=3 if own else 2,
            )  # fmt: skip
        panel.set_title(result.scene.name, fontsize=9)
        panel.grid(alpha=0.3)
    for panel in axes.flat[len(shown) :]:
        panel.set_visible(False)
    for panel in axes[-1]:
        panel.set_xlabel("s per map of 64 x 64")
    for panel in axes[:, 0]:
        panel.set_ylabel("largest relative error")
    handles = {l: h for panel in axes.flat for h, l in zip(*panel.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="lower center", ncol=5, fontsize=8, frameon=False)
    figure.tight_layout(rect=(0, 0.03 + 0.02 * math.ceil(len(handles) / 5), 1, 1))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
    plt.close(figure)
