"""Microfacet models: limits of their tails, E(1) = 1 - ln 2, energy, a white furnace, light scattered several times."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest
from mpmath import mpf

import gonio
from tests.brdf_truth import largest_albedo, pairs

make = gonio.brdf.make
DISTRIBUTIONS = {"beckmann": {}, "ggx": {}, "gtr": {"gamma": 1.4}, "std": {"gamma": 2.6}}


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


@pytest.mark.parametrize("distribution", list(DISTRIBUTIONS))
def test_white_furnace(distribution: str) -> None:
    """Facets that reflect all lose nothing once light is followed: the albedo is 1 to the table's error."""
    choices = {"distribution": distribution, "fresnel": "none", "multiple_scattering": True}
    for alpha in (1.0, 0.1):
        brdf = make("microfacet", k_s=1.0, alpha=alpha, **choices, **DISTRIBUTIONS[distribution])
        for theta in (0.0, 1.0, 1.5):
            found = gonio.directional_albedo(brdf, theta, rtol=1e-7)
            assert float(found.value) == pytest.approx(1.0, abs=1e-10 + float(found.error))


def test_multiple_scattering_is_kulla_and_contys() -> None:
    """The added lobe against E from the shared integrator at another tolerance, mean of E and of F by other rules."""
    choices = {"distribution": "ggx", "fresnel": "conductor", "k_s": 1.0, "alpha": 0.6, "n": 0.2, "k": 3.0}
    bare = make("microfacet", distribution="ggx", fresnel="none", k_s=1.0, alpha=0.6)
    x, w = np.polynomial.legendre.leggauss(24)
    x, w = 0.5 * (1 + x), 0.5 * w  # mu = x^2: E has mu ln mu at the horizon
    thetas = [0.2, 1.3, *np.arccos(x * x)]
    albedo = np.array([float(gonio.directional_albedo(bare, t, rtol=1e-10).value) for t in thetas])
    mean = float(np.sum(w * 4 * x**3 * albedo[2:]))
    with mpmath.workdps(20):
        m = mpmath.mpc(0.2, 3.0)

        def reflected(c: mpf) -> mpf:
            root = mpmath.sqrt(m * m - 1 + c * c)
            return c * (abs((c - root) / (c + root)) ** 2 + abs((m * m * c - root) / (m * m * c + root)) ** 2)

        f = float(mpmath.quad(reflected, [0, 0.1, 0.5, 1]))
    lobe = f * f * mean / (1 - f * (1 - mean)) * (1 - albedo[0]) * (1 - albedo[1]) / (math.pi * (1 - mean))
    once = make("microfacet", **choices).f_r(0.2, 0.0, 1.3, 2.0)
    both = make("microfacet", multiple_scattering=True, **choices).f_r(0.2, 0.0, 1.3, 2.0)
    assert float(both - once) == pytest.approx(lobe, rel=1e-8)


def test_energy_is_bounded() -> None:
    assert largest_albedo(make("beckmann", k_s=1.0, alpha=0.5, f_0=1.0)) <= 1.0
    grooves = make("microfacet", k_s=1.0, alpha=0.4, distribution="beckmann", fresnel="none", shadowing="v_groove")
    assert largest_albedo(grooves, rtol=1e-4) <= 1.0
