"""Scenes that nobody would photograph: hair-thin lobes, lights at the horizon, walls seen edge-on; and a sweep over many.

Whatever the scene, the integrator returns a finite number with its error, if need be with an `IntegrationError` that says
how far it came; a surface that is lit is never silently black.

``python -m tests.extreme 100`` sweeps 100 chunks of 1,000 scenes, each from a seed of its own, and writes a line per chunk
to runs/extreme_scenes.jsonl; chunks already there for the code as it is are not run again.
"""

from __future__ import annotations

import hashlib
import json
import math
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import gonio
from gonio.errors import IntegrationError
from tests.problems import make_brdf, make_source

ROOT = Path(__file__).parents[1]
LOG = ROOT / "runs" / "extreme_scenes.jsonl"
CHUNK = 1000

Scene = dict[str, Any]
DEGREE = math.pi / 180.0


def logs(lower: float, upper: float) -> st.SearchStrategy[float]:
    """Floats spread evenly in the exponent, the ends among them."""
    spread = st.floats(math.log(lower), math.log(upper)).map(lambda x: min(max(math.exp(x), lower), upper))
    return st.one_of(st.sampled_from((lower, upper)), spread)


alphas = logs(1e-4, 1.0)
weights = st.sampled_from((0.0, 0.04, 0.5, 1.0))
terms = st.one_of(
    st.fixed_dictionaries({"model": st.just("lambertian"), "albedo": weights}),
    st.fixed_dictionaries({"model": st.just("ggx"), "k_s": st.just(1.0), "alpha": alphas, "f_0": weights}),
    st.fixed_dictionaries({"model": st.just("ggx"), "k_s": st.just(1.0), "alpha": alphas, "f_0": weights}),
    st.fixed_dictionaries({"model": st.just("phong"), "k_s": weights, "n": logs(0.5, 1e4)}),
    st.fixed_dictionaries({"model": st.just("oren_nayar"), "albedo": weights, "sigma": st.floats(0.0, 1.0)}),
    st.fixed_dictionaries({"model": st.just("specular"), "rho": weights}),
)
special = (0.0, 1e-9, 45 * DEGREE, 90 * DEGREE - 1e-9, 90 * DEGREE, 90 * DEGREE + 1e-9, 135 * DEGREE, math.pi)
polar = st.one_of(st.sampled_from(special), st.floats(0.0, math.pi))
where = {"theta": polar, "phi": st.one_of(st.just(0.0), st.floats(0.0, 6.28))}
texels = st.lists(st.lists(st.sampled_from((0.0, 1e-3, 1.0, 1e6)), min_size=4, max_size=4), min_size=3, max_size=3)
axes = st.sampled_from(((0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (0.3, -0.4, 0.5), (1.0, 0.0, 1e-9)))
parts = st.one_of(
    st.fixed_dictionaries({"kind": st.just("collimated"), "irradiance": st.just(1.0), **where}),
    st.fixed_dictionaries({"kind": st.just("uniform"), "radiance": st.just(1.0)}),
    st.fixed_dictionaries({"kind": st.just("hemispherical"), "radiance": st.just(1.0), "axis": axes}),
    st.fixed_dictionaries({"kind": st.just("overcast"), "zenith_radiance": st.just(1.0), "axis": axes}),
    st.fixed_dictionaries(
        {"kind": st.just("disk"), "radiance": st.just(1.0), "half_angle": logs(1e-4 * DEGREE, 90 * DEGREE), **where}
    ),
    st.fixed_dictionaries({"kind": st.just("lobes"), "amplitude": st.just(1.0), "kappa": logs(1e-3, 1e5), **where}),
    st.fixed_dictionaries(
        {
            "kind": st.just("environment_map"),
            "radiance": texels,
            "interpolation": st.sampled_from(("bilinear", "bilinear", "smooth")),
        }
    ),
)
slope = st.one_of(
    st.sampled_from((0.0, -0.0, 1e-300, -1e-300, 1e8, -1e8, 1e150, -1e150, math.inf, -math.inf)),
    st.floats(-3, 3),
    logs(1e-6, 1e6),
)
gradients = st.tuples(slope, slope).filter(lambda pq: not all(map(math.isinf, pq)))


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    """One or two terms under one or two parts, often with the surface turned to where it is hard."""
    brdf, source = draw(st.lists(terms, min_size=1, max_size=2)), draw(st.lists(parts, min_size=1, max_size=2))
    p, q = draw(gradients)
    turned = draw(st.sampled_from(("free", "free", "mirror", "terminator")))
    if turned != "free" and "theta" in source[0]:  # the first part mirrored, or at the surface's horizon
        theta, phi = source[0]["theta"], source[0]["phi"]
        off = draw(st.sampled_from((0.0, 1e-12, -1e-6, 1e-3, source[0].get("half_angle", -1e-3))))
        tilt = theta / 2 + off if turned == "mirror" else theta - math.pi / 2 + off
        if abs(tilt) < math.pi / 2:
            p, q = -math.tan(tilt) * math.cos(phi), -math.tan(tilt) * math.sin(phi)
    return {"brdf": brdf, "source": source, "p": p, "q": q}


def solve(scene: Scene, rtol: float = 1e-6) -> tuple[float, float]:
    """Value and error, reached or not. All scenes here are possible ones: no other error of gonio's is right."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            brdf, source = make_brdf(scene["brdf"]), make_source(scene["source"])
            got = gonio.reflectance_map(brdf, source, scene["p"], scene["q"], rtol=rtol)
        except IntegrationError as exc:
            if exc.best is None:
                raise
            got = exc.best  # type: ignore[assignment]
    return float(got.value), float(got.error)


def normal(scene: Scene) -> NDArray[np.float64]:
    """Unit normal; of an infinite slope the limit."""
    p, q = scene["p"], scene["q"]
    if math.isinf(p) or math.isinf(q):
        return -np.array([math.copysign(math.isinf(p), p), math.copysign(math.isinf(q), q), 0.0])
    length = math.hypot(1.0, math.hypot(p, q))
    return np.array([-p / length, -q / length, 1.0 / length])


def lit(scene: Scene) -> bool:
    """Whether some light surely reaches the viewer: a term that scatters everywhere, under a part that is well up."""
    everywhere = [t for t in scene["brdf"] if t.get("albedo", 0.0) > 0 or (t["model"] == "ggx" and t["f_0"] > 0)]
    n = normal(scene)
    for part in scene["source"]:
        if part["kind"] in ("uniform", "lobes") and part.get("kappa", 0.0) < 100:
            return bool(everywhere)
        if "theta" in part:
            sine = math.sin(part["theta"])
            w = np.array((sine * math.cos(part["phi"]), sine * math.sin(part["phi"]), math.cos(part["theta"])))
            if float(n @ w) > 1e-6:
                return bool(everywhere)
        if "axis" in part and float(n @ np.array(part["axis"])) > -0.3:
            return bool(everywhere)
    return False


def fault(scene: Scene, rtol: float = 1e-6) -> str:
    """What is wrong with the result, or nothing."""
    try:
        value, error = solve(scene, rtol)
    except Exception as exc:  # noqa: BLE001  any exception is a finding of the sweep, the next scene is to come
        return f"{type(exc).__name__}: {exc}"
    if not (math.isfinite(value) and math.isfinite(error)):
        return f"{value!r} with error {error!r}"
    overshoots = any(part.get("interpolation") == "smooth" for part in scene["source"])  # a smooth map may go below 0
    if error < 0 or (value < 0 and not overshoots):
        return f"negative: {value!r} with error {error!r}"
    return "silent zero" if value == 0 and lit(scene) and not overshoots else ""


# --- the sweep ----------------------------------------------------------------------------------------------------------


def fingerprint() -> str:
    """Of the code that is swept."""
    files = [Path(__file__), *sorted((ROOT / "gonio").rglob("*.py"))]
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[:16]


def sweep(number: int) -> dict[str, Any]:
    """One chunk: how many scenes, how many different ones, the processor's time [s], the slowest, and all faults."""
    found: list[dict[str, Any]] = []
    different: set[str] = set()
    slowest: tuple[float, Scene] = (0.0, {})
    count, start = 0, time.process_time()

    @seed(number)
    @settings(
        max_examples=CHUNK, deadline=None, database=None, phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(scene=scenes())
    def run(scene: Scene) -> None:
        nonlocal count, slowest
        begun = time.process_time()
        wrong = fault(scene)
        took = time.process_time() - begun
        slowest = max(slowest, (took, scene), key=lambda pair: pair[0])
        count += 1
        different.add(repr(scene))
        if wrong:
            found.append({"fault": wrong, "scene": scene})

    run()
    row = {"chunk": number, "scenes": count, "different": len(different), "seconds": time.process_time() - start}
    return {**row, "slowest": slowest, "faults": found}


def sweeps(chunks: int, log: Path = LOG) -> list[dict[str, Any]]:
    """Chunks 0 to `chunks`, run or read from the log; each is told as it is done."""
    code = fingerprint()
    log.parent.mkdir(parents=True, exist_ok=True)
    lines = log.read_text(encoding="utf-8").splitlines() if log.exists() else []
    done = {row["chunk"]: row for row in map(json.loads, lines) if row["code"] == code}
    for number in range(chunks):
        if number not in done:
            done[number] = {"code": code, **sweep(number)}
            with log.open("a", encoding="utf-8") as file:
                file.write(json.dumps(done[number]) + "\n")
        row = done[number]
        took, scene = row["slowest"]
        print(
            f"chunk {number}: {row['scenes']} scenes in {row['seconds']:.0f} s, {len(row['faults'])} faults, "
            f"slowest {took:.1f} s: {scene}", flush=True,
        )  # fmt: skip
        for found in row["faults"]:
            print(f"  {found['fault']}: {found['scene']}", flush=True)
    return [done[number] for number in range(chunks)]


if __name__ == "__main__":
    sweeps(int(sys.argv[1]))
