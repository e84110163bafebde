"""Microfacet models: 40 digits, limits of their shape parameters, energy, a furnace, other programs, refusals."""

from __future__ import annotations

import math
from typing import Any

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mpmath import mpf, pi

import gonio
from gonio.errors import ParameterError
from tests.brdf_truth import Geometry, check_refusals, compare, largest_albedo, pairs, parameter_sets, reciprocity

make = gonio.brdf.make
DISTRIBUTIONS = {"beckmann": {}, "ggx": {}, "gtr": {"gamma": 1.4}, "std": {"gamma": 2.6}}


# --- formulas as printed -------------------------------------------------------------------------------------------------


def density(g: Geometry, distribution: str, alpha: mpf, gamma: mpf | None) -> mpf:
    """D(h), Walter et al. 2007, Burley 2012, Ribardiere et al. 2017."""
    a2, t2, c4 = alpha**2, g.tan2_h, mpmath.cos(g.theta_h) ** 4
    if distribution == "beckmann":
        return mpmath.exp(-t2 / a2) / (pi * a2 * c4)
    if distribution == "ggx":
        return a2 / (pi * c4 * (a2 + t2) ** 2)
    assert gamma is not None
    if distribution == "std":
        return (1 + t2 / ((gamma - 1) * a2)) ** -gamma / (pi * a2 * c4)
    c = gtr_c(alpha, gamma)
    return c / (a2 * mpmath.cos(g.theta_h) ** 2 + mpmath.sin(g.theta_h) ** 2) ** gamma


def gtr_c(alpha: mpf, gamma: mpf) -> mpf:
    if alpha == 1:
        return 1 / pi
    if gamma == 1:
        return (alpha**2 - 1) / (pi * mpmath.log(alpha**2))
    with mpmath.extradps(40):
        return (gamma - 1) * (alpha**2 - 1) / (pi * (1 - alpha ** (2 - 2 * gamma)))


def smith_lambda(theta: mpf, distribution: str, alpha: mpf, gamma: mpf | None) -> mpf:
    """Lambda as an integral over slopes (Heitz 2014), in closed form where the sources have one."""
    if theta == 0:
        return mpf(0)
    cot = mpmath.cot(theta)
    nu = cot / alpha
    if distribution == "beckmann":
        return (mpmath.erf(nu) - 1 + mpmath.exp(-(nu**2)) / (nu * mpmath.sqrt(pi))) / 2
    if distribution == "ggx":
        return (mpmath.sqrt(1 + 1 / nu**2) - 1) / 2
    assert gamma is not None
    if distribution == "std":  # (1/cot) int_cot^inf (q - cot) P_1(q) dq with P_1 of Ribardiere et al.
        x = nu / mpmath.sqrt(gamma - 1)
        norm = mpmath.gamma(gamma - mpf(1) / 2) / (mpmath.sqrt(pi) * mpmath.gamma(gamma - 1))
        tail = mpmath.betainc(gamma - 1, mpf(1) / 2, 0, 1 / (1 + x * x), regularized=True) / 2
        return norm * (1 + x * x) ** (mpf(3) / 2 - gamma) / ((2 * gamma - 3) * x) - tail
    return gtr_lambda(cot, alpha, gamma)


def gtr_lambda(cot: mpf, alpha: mpf, gamma: mpf) -> mpf:
    """(1/cot) int_cot^inf (q - cot) P_1(q) dq of GTR, which has no name; in closed form for gamma = 0, 1, 2, 3."""
    a2 = alpha * alpha
    if gamma in (0, 2):  # D = 1 / pi is GGX of alpha = 1
        return (mpmath.sqrt(1 + (1 if gamma == 0 else a2) / cot**2) - 1) / 2
    c = gtr_c(alpha, gamma)
    if gamma == 1 and alpha != 1:  # P_1 = pi C / (1 - alpha^2) (1 / sqrt(alpha^2 + q^2) - 1 / sqrt(1 + q^2))
        roots = mpmath.sqrt(1 + cot**2) - mpmath.sqrt(a2 + cot**2)
        logarithms = mpmath.asinh(cot) - mpmath.asinh(cot / alpha) - mpmath.log(alpha)
        return pi * c / (1 - a2) * (roots - cot * logarithms) / cot
    if gamma == 3:  # P_1 = C pi / 2 (A^-3/2 + 3/4 (1 - alpha^2) A^-5/2), A = alpha^2 + q^2
        root = mpmath.sqrt(a2 + cot**2)
        low = (root - cot) / a2  # of A^-3/2: its first moment beyond cot less cot times its integral
        high = 1 / (3 * root**3) - cot / (3 * a2**2) * (2 - cot * (3 * a2 + 2 * cot**2) / root**3)
        return c * pi / 2 * (low + mpf(3) / 4 * (1 - a2) * high) / cot

    def p_1(q: mpf) -> mpf:
        a, b = a2 + q * q, 1 + q * q
        return c * pi / 2 * a ** (mpf(1) / 2 - gamma) * b ** (gamma - 2) * mpmath.hyp2f1(2 - gamma, mpf(1) / 2, 2, 1 - a / b)

    with mpmath.workdps(20):  # equal steps of ln(q - cot)
        step = mpf(1) / 10
        steps = [mpmath.exp(step * k) for k in range(-230, 380)]
        return step * mpmath.fsum(x * x * p_1(cot + x) for x in steps) / cot


def fresnel(g: Geometry, kind: str, numbers: dict[str, mpf]) -> mpf:
    c = mpmath.cos(g.g / 2)
    if kind == "none":
        return mpf(1)
    if kind == "schlick":
        with mpmath.extradps(60):
            return numbers["f_0"] + (1 - numbers["f_0"]) * (1 - mpmath.cos(g.g / 2)) ** 5
    m = mpmath.mpc(numbers["n"], numbers.get("k", 0))
    root = mpmath.sqrt(m * m - mpmath.sin(g.g / 2) ** 2)  # m cos(theta_t); Born & Wolf's amplitudes
    r_s, r_p = (c - root) / (c + root), (m * m * c - root) / (m * m * c + root)
    return (abs(r_s) ** 2 + abs(r_p) ** 2) / 2


def shadowing(g: Geometry, kind: str, distribution: str, alpha: mpf, gamma: mpf | None) -> mpf:
    if kind == "v_groove":
        c = mpmath.cos(g.g / 2)
        return min(mpf(1), 2 * g.mu_h * g.mu_i / c, 2 * g.mu_h * g.mu_r / c)
    i, r = (smith_lambda(t, distribution, alpha, gamma) for t in (g.theta_i, g.theta_r))
    return 1 / (1 + i + r) if kind == "smith" else 1 / ((1 + i) * (1 + r))


def formula(distribution: str = "beckmann", fresnel_kind: str = "schlick", hiding: str = "smith") -> Any:
    def f_r(g: Geometry, k_s: mpf, alpha: mpf, gamma: mpf | None = None, **numbers: mpf) -> mpf:
        facets = density(g, distribution, alpha, gamma) * shadowing(g, hiding, distribution, alpha, gamma)
        return k_s * fresnel(g, fresnel_kind, numbers) * facets / (4 * g.mu_i * g.mu_r)

    return f_r


# --- at 40 digits --------------------------------------------------------------------------------------------------------

ALPHAS = [1.0, 0.3, 0.01]


@pytest.mark.parametrize("name", ["ggx", "beckmann"])
def test_shorts_at_forty_digits(name: str) -> None:
    f = formula(name)
    sets = [{"k_s": 0.8, "alpha": a, "f_0": f_0} for a in ALPHAS for f_0 in (0.0, 0.04, 1.0)]
    assert compare(name, f, sets) <= 1e-12
    assert compare(name, f, [{"k_s": 0.8, "alpha": 1e-4, "f_0": f_0} for f_0 in (0.0, 1.0)]) <= 1e-9


@pytest.mark.parametrize(
    ("distribution", "gammas"), [("std", (1.51, 1.75, 2.0, 5.0, 300.0, 1e6)), ("gtr", (0.0, 1.0, 2.0, 3.0))]
)
def test_tails_at_forty_digits(distribution: str, gammas: tuple[float, ...]) -> None:
    f = formula(distribution, "none")
    choices = {"distribution": distribution, "fresnel": "none", "k_s": 1.0}
    for alphas, limit in ((ALPHAS, 1e-12), ([1e-4], 1e-9)):
        sets = [{**choices, "alpha": a, "gamma": gamma} for a in alphas for gamma in gammas]
        assert compare("microfacet", f, sets, thin=6) <= limit


def test_gtr_between_the_closed_forms() -> None:
    """Smith's Lambda of a gamma without a closed form, through G of one direction at normal incidence of the other."""
    for alpha, gamma in ((0.3, 1.4), (0.01, 0.5), (0.3, 8.0)):
        brdf = make("microfacet", distribution="gtr", fresnel="none", k_s=1.0, alpha=alpha, gamma=gamma)
        for theta in (0.3, 1.2, math.radians(89.99)):
            wi, wr = np.array([math.sin(theta), 0.0, math.cos(theta)]), np.array([0.0, 0.0, 1.0])
            with mpmath.workdps(30):
                g = Geometry(wi, wr)
                hidden = gtr_lambda(mpmath.cot(g.theta_i), mpf(alpha), mpf(gamma))
                true = density(g, "gtr", mpf(alpha), mpf(gamma)) / (4 * g.mu_i * (1 + hidden))
            assert float(brdf.evaluate(wi, wr)) == pytest.approx(float(true), rel=1e-12)


@pytest.mark.parametrize(
    ("distribution", "reflectance", "hiding", "numbers"),
    [
        ("ggx", "dielectric", "smith_separable", [{"n": 1.0}, {"n": 1.0001}, {"n": 1.5}, {"n": 5.0}]),
        ("beckmann", "conductor", "v_groove", [{"n": 0.05, "k": 4.0}, {"n": 1.5, "k": 0.0}, {"n": 30.0, "k": 100.0}]),
        ("beckmann", "schlick", "smith_separable", [{"f_0": 0.04}]),
        ("ggx", "schlick", "v_groove", [{"f_0": 0.5}]),
    ],
)
def test_reflectances_and_shadowings_at_forty_digits(
    distribution: str, reflectance: str, hiding: str, numbers: list[dict[str, float]]
) -> None:
    f = formula(distribution, reflectance, hiding)
    choices = {"distribution": distribution, "fresnel": reflectance, "shadowing": hiding}
    sets = [{**choices, "k_s": 0.5, "alpha": a, **n} for a in (0.7, 0.02) for n in numbers]
    assert compare("microfacet", f, sets) <= 1e-12


# --- limits and constants -------------------------------------------------------------------------------------------------


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


# --- any parameters --------------------------------------------------------------------------------------------------------

CHOICES: list[dict[str, Any]] = [
    {"distribution": "ggx", "fresnel": "dielectric", "shadowing": "smith_separable"},
    {"distribution": "beckmann", "fresnel": "conductor", "shadowing": "v_groove"},
    {"distribution": "std", "fresnel": "none"},
    {"distribution": "gtr", "fresnel": "none"},
    {"distribution": "ggx", "fresnel": "none", "multiple_scattering": True},
]


@pytest.mark.parametrize("choices", CHOICES, ids=lambda c: "-".join(str(v) for v in c.values()))
@given(data=st.data(), seed=st.integers(0, 2**31))
@settings(max_examples=10, deadline=None, derandomize=True)
def test_any_parameters(choices: dict[str, Any], data: st.DataObject, seed: int) -> None:
    assert reciprocity(make("microfacet", **data.draw(parameter_sets("microfacet", **choices))), 300, seed) <= 1e-13


@pytest.mark.parametrize("name", ["beckmann", "ggx"])
@given(data=st.data(), seed=st.integers(0, 2**31))
@settings(max_examples=30, deadline=None, derandomize=True)
def test_any_parameters_of_the_shorts(name: str, data: st.DataObject, seed: int) -> None:
    assert reciprocity(make(name, **data.draw(parameter_sets(name))), 300, seed) <= 1e-13


def test_refusals() -> None:
    check_refusals("beckmann", {"k_s": 1.0, "alpha": 0.1, "f_0": 0.5})
    std = {"k_s": 1.0, "alpha": 0.1, "gamma": 3.0, "n": 1.0, "k": 2.0}
    check_refusals("microfacet", std, distribution="std", fresnel="conductor")
    for wrong, words in (
        ({"distribution": "std", "f_0": 0.5}, "needs gamma"),
        ({"f_0": 0.5, "gamma": 2.0}, "no parameter 'gamma'"),
        ({"fresnel": "dielectric", "f_0": 0.5}, "no parameter 'f_0'"),
        ({"distribution": "beckman", "f_0": 0.5}, "did you mean 'beckmann'"),
        ({"shadowing": "v_groove", "multiple_scattering": True, "f_0": 0.5}, "Smith's shadowing only"),
    ):
        with pytest.raises(ParameterError, match=words):
            make("microfacet", k_s=1.0, alpha=0.1, **wrong)
