"""Parameters that models declare as linear are, for every registered model; least squares in a box."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fitting.linear import solve_in_box
from gonio import brdf

EXPRESSIONS = [
    *(name for name, model in brdf.models().items() if not model.delta),
    "oren_nayar[variant=full]", "ward[variant=duer]", "ward[variant=gmd]", "microfacet[fresnel=dielectric]",
    "microfacet[distribution=beckmann,shadowing=v_groove]",
]  # fmt: skip


def values_of(model, rng):
    """Parameters from their priors, but for angles and widths that are not extreme."""
    out = {}
    for p in model.parameters:
        kind, a, b = p.prior
        value = rng.uniform(a, b) if kind == "uniform" else math.exp(rng.normal(a, min(b, 0.3)))
        out[p.name] = min(max(value, p.lower), p.upper)
    return out


@pytest.mark.parametrize("expression", EXPRESSIONS)
def test_what_is_declared_linear_is_linear(expression):
    (model,) = brdf.parse(expression)
    rng = np.random.default_rng(3)
    theta_i, theta_r, phi = rng.uniform(0.1, 1.2, 40), rng.uniform(0.1, 1.2, 40), rng.uniform(0, 2 * math.pi, 40)

    def f_r(values):
        return brdf.BRDF([brdf.Term(model, model.values(values))]).f_r(theta_i, 0.0, theta_r, phi)

    for p in model.parameters:
        if p.name in (*model.factors, *model.affine):
            given = values_of(model, rng)
            low, middle, high = (f_r(given | {p.name: x}) for x in (0.0, 0.3, 1.0))
            assert middle == pytest.approx(0.7 * low + 0.3 * high, rel=1e-9, abs=1e-14), p.name
            assert (p.name in model.factors) == bool(np.all(low == 0.0)), p.name
    if "k_s" in [p.name for p in model.parameters]:
        assert model.factors == ("k_s",)


def test_light_scattered_again_is_not_linear_in_the_facets_reflectance():
    (model,) = brdf.parse("microfacet[multiple_scattering=true]")
    assert (model.factors, model.affine) == (("k_s",), ())


def test_least_squares_in_a_box_meets_its_conditions():
    """Karush, Kuhn and Tucker: no slope inside, a slope outwards at a bound; random problems of 1 to 4 coefficients."""
    rng = np.random.default_rng(4)
    for p in (1, 2, 3, 4):
        b, y = rng.standard_normal((20, 30, p)), rng.standard_normal((20, 30))
        about, lower, upper = np.full(p, 0.05), np.zeros(p), np.full(p, 0.2)
        rows = np.concatenate(((y - b @ about)[:, None], b.transpose(0, 2, 1)), axis=1)
        c, left = solve_in_box(np.tril(rows @ rows.transpose(0, 2, 1)), about, lower, upper)
        slope = np.einsum("wnp,wn->wp", b, y - np.einsum("wnp,wp->wn", b, c))
        assert np.all((c >= 0) & (c <= 0.2))
        inside = (c > 1e-9) & (c < 0.2 - 1e-9)
        assert np.all(np.abs(slope[inside]) < 1e-7)
        assert np.all(slope[c <= 1e-9] < 1e-7)
        assert np.all(slope[c >= 0.2 - 1e-9] > -1e-7)
        assert left == pytest.approx(np.sum((y - np.einsum("wnp,wp->wn", b, c)) ** 2, axis=1), rel=1e-10)
