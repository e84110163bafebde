"""The general integral of the memo's section 13 in its two forms, every model under every source.

Rationale: the local form lays its rings about the surface normal, the viewer form about the axis of the source; they share
no node and no edge, so that what they agree on is the integral. Delta functions (beams, mirrors) have closed forms, tested
with those of sections 14 and 15.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

import gonio
from gonio.brdf.tabulated import from_brdf
from gonio.integrate import scene_radiance

make, make_source = gonio.brdf.make, gonio.source.make
Array = NDArray[np.float64]


def satin(alpha: float) -> gonio.BRDF:
    return make("lambertian", albedo=0.4) + make("ggx", k_s=1.0, alpha=alpha, f_0=0.04)


def glossy(wi: Array, wr: Array) -> Array:
    h = wi + wr
    return 0.2 * (h[..., 2] ** 2 / np.sum(h * h, axis=-1)) ** 4


MODELS = {
    "lambertian": make("lambertian", albedo=0.8),
    "ggx 0.3": make("ggx", k_s=1.0, alpha=0.3, f_0=0.04),
    "ggx 0.02": make("ggx", k_s=1.0, alpha=0.02, f_0=0.04),
    "phong 0": make("phong", k_s=0.7, n=0.0),
    "phong 1.5": make("phong", k_s=0.7, n=1.5),
    "phong 1e4": make("phong", k_s=0.7, n=1e4),
    "oren_nayar": make("oren_nayar", albedo=0.8, sigma=0.4),
    "tabulated": from_brdf(satin(0.3), (8, 6, 4)).brdf(),
    "sum": satin(0.1),
    "function": gonio.brdf.from_function(glossy, lobe_width=0.3, reciprocal=True),
}
ROW, COLUMN = np.meshgrid(np.arange(6), np.arange(8), indexing="ij")
TEXELS = 1.0 + np.sin(1.3 * ROW + 0.7 * COLUMN) ** 2
SOURCES = {
    "uniform": make_source("uniform", radiance=1.0),
    "sky": make_source("hemispherical", radiance=1.0),
    "tilted sky": make_source("hemispherical", radiance=1.0, axis=(0.4, -0.3, 0.8)),
    "overcast": make_source("overcast", zenith_radiance=1.0, axis=(-0.5, 0.2, 0.7)),
    "disk": make_source("disk", theta=0.7, phi=1.0, half_angle=math.radians(5.0), radiance=1.0),
    "wide disk": make_source("disk", theta=0.9, phi=4.0, half_angle=math.radians(60.0), radiance=1.0),
    "lobes": make_source("lobes", amplitude=[1.0, 2.0], kappa=[100.0, 8.0], theta=[0.3, 1.5], phi=[0.0, 2.0]),
    "smooth map": make_source("environment_map", radiance=TEXELS, interpolation="smooth"),
    "bilinear map": make_source("environment_map", radiance=TEXELS),
    "harmonics": make_source("spherical_harmonics", coefficients=[3.0, 0.5, 0.6, 0.2, 0.1, 0.0, 0.3, 0.2, 0.1]),
    "function": gonio.source.Source.from_callable(lambda w: 1.0 + 0.7 * w[:, 0] + 0.2 * w[:, 1] * w[:, 2]),
}
THETA, PHI = np.array([0.35, 0.0, 1.35, 1.5]), np.array([1.0, 0.0, 5.0, 2.0])


LONG = ("sky", "tilted sky", "overcast", "smooth map", "harmonics", "function")  # for tables
PAIRS = [
    pytest.param(model, source, marks=pytest.mark.gate if model == "tabulated" and source in LONG else ())
    for model in MODELS
    for source in SOURCES
]


@pytest.mark.parametrize(("model", "source"), PAIRS)
def test_both_forms_of_section_13_agree(model: str, source: str) -> None:
    rtol = 1e-6 if source == "bilinear map" else 1e-10
    fields = ("lobes", "smooth map", "bilinear map", "harmonics", "function")
    count = 1 if model == "tabulated" else 2 if source in fields else 4
    local, viewer = (
        scene_radiance(MODELS[model], SOURCES[source], THETA[:count], PHI[:count], form=form, rtol=rtol)
        for form in ("local", "viewer")
    )
    off = np.abs(local.value - viewer.value)
    assert np.any(local.value > 0.0)
    assert np.all(off <= rtol * local.value)
    assert np.all(off <= local.error + viewer.error)


def test_errors_of_tables_are_honest() -> None:
    """A table's pieces have borders that no rule knows of; of these gradients orders of rings once agreed by chance."""
    theta = np.array([1.1826430551426066, 0.4547922439374675, 0.2162394190794506])
    table, light = MODELS["tabulated"], SOURCES["uniform"]
    truth = scene_radiance(table, light, theta, 0.0, rtol=1e-8)
    for rtol in (1e-5, 1e-6, 1e-7):
        got = scene_radiance(table, light, theta, 0.0, rtol=rtol)
        assert np.all(np.abs(got.value - truth.value) <= got.error + truth.error)
