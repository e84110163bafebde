"""Published fits: materials with the parameters of a printed row, measured here with a rig's errors, are found again.

Rationale: the rows are what people fit to real surfaces, so they lie where fits must work: weak and narrow lobes, dark soil.
Ward's table: G. J. Ward, "Measuring and modeling anisotropic reflection", SIGGRAPH 1992, table 1 (those of its rows that are
isotropic). Ceres: photometric parameters of the Dawn framing camera's colour mosaics, NASA Planetary Data System, Small
Bodies Node, document photopar_c (the weight of the backward lobe, 0.38, is (1 + c) / 2 here). Expected: 3.5 sd at most.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from fitting import Rule, fit
from gonio import brdf
from tests.measurements import material, measure

ROWS = {
    "white ceramic tile": ("lambertian+ward", {"lambertian.albedo": 0.70, "ward.k_s": 0.050, "ward.alpha": 0.071}, {}),
    "ivory computer plastic": ("lambertian+ward", {"lambertian.albedo": 0.45, "ward.k_s": 0.043, "ward.alpha": 0.13}, {}),
    "plastic laminate": ("lambertian+ward", {"lambertian.albedo": 0.67, "ward.k_s": 0.070, "ward.alpha": 0.092}, {}),
    "Ceres": (
        "hapke",
        {"hapke.w": 0.12, "hapke.b": 0.35, "hapke.c": 2 * 0.38 - 1, "hapke.theta_bar": math.radians(21.0)},
        {"hapke.B_0": 1.6, "hapke.h": 0.06},
    ),
}


@pytest.mark.parametrize("row", list(ROWS))
def test_parameters_are_found_again(row):
    model, truth, held = ROWS[row]
    parts = []
    for one in brdf.parse(model):
        values = {name.split(".")[1]: v for name, v in (truth | held).items() if name.startswith(one.name + ".")}
        parts.append(brdf.make(one.name, **values))
    f_r = material(sum(parts))
    samples, errors = measure(
        np.random.default_rng(list(ROWS).index(row)), f_r, 200, lambda wi, wr: 0.01 * f_r(wi, wr) + 1e-4
    )
    posterior = fit(samples, model, fix=held, seed=1, rule=Rule(effective=2000))
    assert posterior.converged, posterior.diagnostics["status"]
    assert not posterior.diagnostics["discrepancy"]
    for name, value in (truth | errors).items():
        s = posterior.summary()[name]
        assert abs(s["mean"] - value) < 3.5 * s["sd"], (name, s["mean"], value, s["sd"])
