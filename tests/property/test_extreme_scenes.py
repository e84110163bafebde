"""Scenes that nobody would photograph, see `tests.extreme`: finite, never silently black, honest about their errors.

CI takes a slice; `make gates` runs 10^5 scenes, and 1,000 against a second opinion.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

import gonio
from gonio.errors import IntegrationError
from tests.extreme import DEGREE, Scene, fault, scenes, solve, sweeps
from tests.gates import record
from tests.independent import reflected_radiance
from tests.problems import brightness, make_brdf, make_source

FOUND = Path(__file__).parents[1] / "data" / "found_scenes.json"


@settings(max_examples=200, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
@given(scene=scenes())
def test_extreme_scenes_are_finite_and_never_silently_black(scene: Scene) -> None:
    wrong = fault(scene)
    assert not wrong, (wrong, scene)


EVERYWHERE = [
    {"model": "lambertian", "albedo": 0.5},
    {"model": "ggx", "k_s": 1.0, "alpha": 1e-4, "f_0": 0.5},
    {"model": "oren_nayar", "albedo": 0.5, "sigma": 0.5},
    {"model": "phong", "k_s": 1.0, "n": 2.0},
    {
        "model": "microfacet",
        "k_s": 1.0,
        "alpha": 0.2,
        "distribution": "beckmann",
        "f_0": 0.5,
        "shadowing": "smith_separable",
    },
    {"model": "microfacet", "k_s": 1.0, "alpha": 0.2, "distribution": "ggx", "f_0": 0.5, "shadowing": "v_groove"},
]


@pytest.mark.parametrize("term", EVERYWHERE, ids=lambda term: term.get("distribution", term["model"]))
def test_models_seen_along_the_surface_tend_to_a_limit(term: dict[str, object]) -> None:
    """An infinite slope is seen at a cosine of 1e-150: the limit, not the 0 of a view from below."""
    brdf, lamp = make_brdf([term]), np.array([0.6, 0.0, 0.8])
    near, limb = (float(brdf.evaluate(lamp, np.array([-1.0, 0.0, cosine]))) for cosine in (1e-20, 1e-150))
    assert limb == pytest.approx(near, rel=1e-12) and limb > 0.0


def test_a_metal_seen_along_the_surface_loses_nothing() -> None:
    """There the facets that the viewer sees hide no light from each other: of a uniform source's radiance 1 all comes back.

    The lobe is a wedge, ever thinner towards the viewer's mirror direction, that nodes at its own width would step over.
    """
    for alpha in (1e-4, 1e-2):
        metal = {"model": "ggx", "k_s": 1.0, "alpha": alpha, "f_0": 1.0}
        value, error = solve({"brdf": [metal], "source": [{"kind": "uniform", "radiance": 1.0}], "p": -1e150, "q": 0.0})
        assert abs(value - 1.0) <= error < 1e-6


@pytest.mark.gate
def test_a_hundred_thousand_extreme_scenes() -> None:
    done = sweeps(100)
    scenes_run, faults = sum(row["scenes"] for row in done), sum(len(row["faults"]) for row in done)
    different, seconds = (sum(row[of] for row in done) for of in ("different", "seconds"))
    record(
        "extreme scenes",
        f"{faults} of {scenes_run} scenes ({different} different ones within their thousands) with a crash, a NaN or a "
        f"silent zero; {seconds:.0f} s of a core",
        "10^5 scenes without crash, NaN or silent zero",
        "0 to 99",
        "pytest -m gate tests/property/test_extreme_scenes.py -k thousand_extreme_scenes -s",
    )
    assert scenes_run >= 100_000 and not faults


# --- honest errors ------------------------------------------------------------------------------------------------------

ROUNDING = 1e-9  # by which two codes may differ in double precision, lobes of 1e-4 seen at grazing angles included
FEW, MANY = 100, 1000


def random_scene(rng: np.random.Generator) -> Scene:
    """As `scenes`, drawn without search, and without what a second opinion in double precision cannot resolve."""

    def log(lower: float, upper: float) -> float:
        return float(np.exp(rng.uniform(np.log(lower), np.log(upper))))

    def direction() -> dict[str, float]:
        return {"theta": float(np.arccos(rng.uniform(-0.9, 1.0))), "phi": float(rng.uniform(0, 6.28))}

    brdf = [
        {"model": "lambertian", "albedo": 0.5},
        {"model": "ggx", "k_s": 1.0, "alpha": log(1e-4, 1.0), "f_0": 0.04},
        {"model": "ggx", "k_s": 1.0, "alpha": log(1e-2, 1.0), "f_0": 1.0},
        {"model": "phong", "k_s": 0.5, "n": log(0.5, 1e4)},
        {"model": "oren_nayar", "albedo": 0.8, "sigma": float(rng.uniform(0, 1))},
    ][rng.integers(5)]
    axis = tuple(float(x) for x in rng.normal(size=3))
    source = [
        {"kind": "uniform", "radiance": 1.0},
        {"kind": "hemispherical", "radiance": 1.0, "axis": (0.0, 0.0, 1.0)},
        {"kind": "hemispherical", "radiance": 1.0, "axis": axis},
        {"kind": "overcast", "zenith_radiance": 1.0, "axis": axis},
        {"kind": "disk", "radiance": 1.0, "half_angle": log(1e-3, 90.0) * DEGREE, **direction()},
        {"kind": "disk", "radiance": 1.0, "half_angle": log(0.1, 90.0) * DEGREE, **direction()},
        {"kind": "lobes", "amplitude": 1.0, "kappa": log(0.1, 1e5), **direction()},
        {"kind": "environment_map", "radiance": np.round(rng.exponential(size=(3, 5)) ** 3, 3).tolist()},
    ][min(7, rng.integers(15) // 2)]
    tilt, azimuth = float(rng.choice((rng.uniform(0, 1.5), math.pi / 2 - log(1e-5, 0.1)))), float(rng.uniform(0, 6.28))
    if "theta" in source and rng.random() < 0.6:  # mirrored, at the terminator, or with its rim there, all but for a little
        off, theta = float(rng.choice((-1, 1))) * log(1e-6, 0.3), float(source["theta"])  # type: ignore[arg-type]
        off += float(rng.choice((-1, 0, 1))) * float(source.get("half_angle", 0.0))  # type: ignore[arg-type]
        turned = (theta / 2 if rng.random() < 0.5 else theta - math.pi / 2) + off
        if abs(turned) < math.pi / 2 - 1e-5:
            tilt, azimuth = turned, float(source["phi"])  # type: ignore[arg-type]
    p, q = -math.tan(tilt) * math.cos(azimuth), -math.tan(tilt) * math.sin(azimuth)
    return {"brdf": [brdf], "source": [source], "p": p, "q": q}


def complaint(scene: Scene, rtol: float) -> str:
    """Empty if the reported error covers the difference from the second opinion."""
    return judge(scene, *solve(scene, rtol), rtol)


def judge(scene: Scene, value: float, error: float, rtol: float) -> str:
    truth = reflected_radiance(scene, "normal", 1e-11)
    slack = ROUNDING * truth + 1e-24 * brightness(scene["source"])
    if abs(value - truth) <= error + slack:
        return ""
    second = reflected_radiance(scene, "other", 1e-11)  # is the second opinion sure?
    if abs(value - truth) <= error + slack + 2 * abs(second - truth):
        return ""
    return f"{value!r} with error {error:.1e} at rtol {rtol:g}, truth {truth!r} ({second!r}): {scene}"


def complaints(count: int, seed: int) -> list[str]:
    rng = np.random.default_rng(seed)
    return [c for k in range(count) if (c := complaint(random_scene(rng), (1e-3, 1e-6, 1e-9)[k % 3]))]


def map_complaints(count: int, seed: int) -> list[str]:
    """As `complaints` where tables and interpolation serve: a map around each gradient, four of its pixels checked."""
    rng = np.random.default_rng(seed)
    found = []
    for k in range(count):
        scene, rtol = random_scene(rng), (1e-3, 1e-6)[k % 2]
        brdf, source = make_brdf(scene["brdf"]), make_source(scene["source"])
        p = np.append(scene["p"] * (1 + rng.normal(scale=0.02, size=40)), rng.normal(scale=2.0, size=40))
        q = np.append(scene["q"] * (1 + rng.normal(scale=0.02, size=40)), rng.normal(scale=2.0, size=40))
        try:
            got = gonio.reflectance_map(brdf, source, p, q, rtol=rtol)
        except IntegrationError as exc:
            got = exc.best  # type: ignore[assignment]
        for j in rng.choice(80, 4, replace=False):
            pixel = {**scene, "p": float(p[j]), "q": float(q[j])}
            found.append(judge(pixel, float(got.value[j]), float(got.error[j]), rtol))
    return [c for c in found if c]


def test_errors_of_extreme_scenes_are_honest() -> None:
    wrong = complaints(FEW, seed=1)
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("found", json.loads(FOUND.read_text(encoding="utf-8")), ids=lambda found: found["brdf"][0]["model"])
def test_scenes_that_once_deceived(found: Scene) -> None:
    """Scenes whose error was understated by an earlier version, or that it did not finish."""
    for rtol in (found["rtol"], 1e-3, 1e-6):
        assert not complaint({k: v for k, v in found.items() if k != "rtol"}, rtol)


def test_errors_of_maps_are_honest() -> None:
    wrong = map_complaints(6, seed=3)
    assert not wrong, "\n".join(wrong)


@pytest.mark.gate
def test_errors_of_a_thousand_extreme_scenes_are_honest() -> None:
    wrong = complaints(MANY, seed=2) + map_complaints(MANY // 4, seed=4)
    print("\n".join(wrong))
    record(
        "honest errors of extreme scenes",
        f"{len(wrong)} of {MANY} gradients and {MANY} pixels of maps understated",
        "0: the reported error covers the difference from an independent integration",
        "2, 4",
        "pytest -m gate tests/property/test_extreme_scenes.py -s",
    )
    assert not wrong
