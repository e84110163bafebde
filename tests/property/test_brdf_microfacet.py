"""Microfacet models: limits of their tails, E(1) = 1 - ln 2, energy, names."""

from __future__ import annotations

import math

import pytest

import gonio
from tests.brdf_truth import largest_albedo, pairs

make = gonio.brdf.make


def test_limits_of_the_tails() -> None:
    """std and gtr of gamma = 2 are ggx; std of gamma = 1e6 is beckmann to 1/gamma; gtr runs through gamma = 1 smoothly."""
    at = pairs()
    no = {"fresnel": "none", "k_s": 1.0}
    for alpha in (0.02, 0.4, 1.0):
        ggx = make("microfacet", distribution="ggx", alpha=alpha, **no).evaluate(*at)
        for distribution in ("std", "gtr"):
            same = make("microfacet", distribution=distribution, alpha=alpha, gamma=2.0, **no).evaluate(*at)
            assert same == pytest.approx(ggx, rel=1e-13)
        beckmann = make("microfacet", distribution="beckmann", alpha=alpha, **no).evaluate(*at)
        near = make("microfacet", distribution="std", alpha=alpha, gamma=1e6, **no).evaluate(*at)
        core = beckmann > 1e-3 * beckmann.max()
        assert near[core] == pytest.approx(beckmann[core], rel=1e-4)
        below, one, above = (
            make("microfacet", distribution="gtr", alpha=alpha, gamma=g, **no).evaluate(*at)
            for g in (1 - 1e-7, 1.0, 1 + 1e-7)
        )
        assert 0.5 * (below + above) == pytest.approx(one, rel=1e-11)


def test_one_minus_ln_two() -> None:
    metal = make("microfacet", k_s=1, alpha=1, distribution="ggx", fresnel="none", shadowing="smith")
    assert float(gonio.directional_albedo(metal, 0.0, rtol=1e-12).value) == pytest.approx(1 - math.log(2), abs=1e-13)


def test_choices_share_their_model_and_are_named() -> None:
    one = make("microfacet", k_s=1, alpha=0.1, distribution="gtr", gamma=1.5, fresnel="conductor", n=0.2, k=3.0)
    two = make("microfacet", k_s=0.5, alpha=0.2, distribution="gtr", gamma=2.5, fresnel="conductor", n=0.3, k=2.0)
    assert one.terms[0].model is two.terms[0].model
    assert one.name == "microfacet[distribution=gtr,fresnel=conductor]"
    assert gonio.brdf.parse(one.name)[0] is one.terms[0].model
    assert list(one.parameters()) == [f"microfacet.{x}" for x in ("k_s", "alpha", "gamma", "n", "k")]


# --- energy ---------------------------------------------------------------------------------------------------------------


def test_energy_is_bounded() -> None:
    assert largest_albedo(make("beckmann", k_s=1.0, alpha=0.5, f_0=1.0)) <= 1.0
    grooves = make("microfacet", k_s=1.0, alpha=0.4, distribution="beckmann", fresnel="none", shadowing="v_groove")
    assert largest_albedo(grooves, rtol=1e-4) <= 1.0
