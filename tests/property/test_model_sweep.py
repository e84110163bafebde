"""Every model under every kind of light on a map of 64 x 64 gradients, against the independent evaluation at ten of them."""

from __future__ import annotations

import math

import numpy as np
import pytest

import gonio
from gonio.errors import IntegrationError
from tests.gates import record
from tests.independent import reflected_radiance
from tests.make_problems import BRDFS, MORE, SOURCES
from tests.problems import brightness, make_brdf, make_source

MODELS = ("paper", "ggx 0.1", "phong 50", "clay", *MORE)  # every registered model and choice that has a value
LIGHTS = (
    "beam", "sphere", "tilted sky", "tilted overcast", "sun", "disk 5", "lobe 100", "studio", "map", "smooth map",
    "harmonics",
)  # fmt: skip
RTOL = 1e-6
TRUTH = 1e-10  # relative, of the independent values
NOTHING = 1e-24  # of the source's brightness


def gradients() -> tuple[np.ndarray, np.ndarray]:
    """48 rows evenly over slopes up to 3, and 16 rows of tilts from 60 to 89.9 degrees; shape (64, 64) each."""
    p, q = np.meshgrid(np.linspace(-3.0, 3.0, 64), np.linspace(-3.0, 3.0, 48))
    tilt = np.tan(np.radians(np.append(np.linspace(60.0, 89.0, 15), 89.9)))[:, None]
    phi = 2.0 * np.pi * (np.arange(64) + 0.3) / 64
    return np.concatenate((p, -tilt * np.cos(phi))), np.concatenate((q, -tilt * np.sin(phi)))


def chosen(value: np.ndarray, error: np.ndarray, seed: int) -> np.ndarray:
    """Seven at random, one of the steepest, the brightest, and the one of the largest relative error."""
    rng = np.random.default_rng(seed)
    relative = np.divide(error, value, out=np.zeros_like(error), where=value > 0)
    steep = value.size - 64 + rng.integers(64)
    return np.concatenate((rng.choice(value.size, 7, replace=False), [steep, np.argmax(value), np.argmax(relative)]))


def check(brdf: str, light: str, seed: int) -> tuple[list[str], float]:
    """What is wrong with one map, and its largest error at the ten gradients, relative."""
    p, q = (a.ravel() for a in gradients())
    nothing = NOTHING * brightness(SOURCES[light])
    try:
        got = gonio.reflectance_map(make_brdf(BRDFS[brdf]), make_source(SOURCES[light]), p, q, rtol=RTOL, atol=nothing)
    except IntegrationError as exc:
        return [f"{brdf} / {light}: {exc}"], math.inf
    wrong, worst = [], 0.0
    for k in chosen(got.value, got.error, seed):
        scene = {"brdf": BRDFS[brdf], "source": SOURCES[light], "p": float(p[k]), "q": float(q[k])}
        truth = reflected_radiance(scene, "normal", TRUTH)
        off, slack = abs(float(got.value[k]) - truth), 2 * TRUTH * truth + nothing
        worst = max(worst, off / truth if truth > nothing else 0.0)
        if not (off <= RTOL * truth + slack and off <= got.error[k] + slack):
            said = f"{got.value[k]!r} +- {got.error[k]:.1e}, not {truth!r}"
            wrong.append(f"{brdf} / {light} at ({p[k]:.6g}, {q[k]:.6g}): {said}")
    return wrong, worst


@pytest.mark.gate
@pytest.mark.parametrize("light", LIGHTS)
def test_every_model(light: str) -> None:
    wrong, worst = [], 0.0
    for seed, brdf in enumerate(MODELS):
        found, off = check(brdf, light, seed)
        print(f"{brdf} / {light}: {len(found)} off, largest relative error {off:.0e}", *found, sep="\n", flush=True)
        wrong, worst = wrong + found, max(worst, off)
    record(
        f"every model, light: {light}",
        f"{len(wrong)} of {10 * len(MODELS)} gradients of {len(MODELS)} maps off, largest relative error "
        f"{worst:.0e}",
        "0: within 1e-6 and the reported error, maps of 64 x 64 against an independent evaluation at ten gradients",
        f"0 to {len(MODELS) - 1}",
        "pytest -m gate tests/property/test_model_sweep.py -s",
    )
    assert not wrong


def test_all_models_take_part() -> None:
    """A model added to the library is added here, or to tests/make_problems.py."""
    used = {term["model"] for name in MODELS for term in BRDFS[name]}
    assert used == set(gonio.brdf.families.FAMILIES) - {"specular"}
