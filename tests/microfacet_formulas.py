"""Microfacet models as their sources print them, at the digits of the mpmath context: D, F, G and their product."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping

import mpmath
from mpmath import asinh, atan, cos, cot, erf, exp, log, mpf, pi, sin, sqrt

from tests.brdf_truth import Geometry


def formula(distribution: str, fresnel: str, shadowing: str) -> Callable[..., mpf]:
    """``f_r(geometry, k_s, alpha, (gamma), ...)``: Cook & Torrance 1982 with a normalised D."""

    def f_r(at: Geometry, k_s: mpf, alpha: mpf, gamma: mpf | None = None, **numbers: mpf) -> mpf:
        facets = density(at, distribution, alpha, gamma) * hidden(at, shadowing, distribution, alpha, gamma)
        return k_s * reflected(at, fresnel, numbers) * facets / (4 * at.mu_i * at.mu_r)

    return f_r


# --- D --------------------------------------------------------------------------------------------------------------------


def density(at: Geometry, distribution: str, alpha: mpf, gamma: mpf | None) -> mpf:
    """D(h): Walter et al. 2007, eqs. 25 and 33; Burley 2012; Ribardiere et al. 2017."""
    a2, t2, c2 = alpha**2, at.tan2_h, cos(at.theta_h) ** 2
    if distribution == "beckmann":
        return exp(-t2 / a2) / (pi * a2 * c2**2)
    if distribution == "ggx":
        return a2 / (pi * c2**2 * (a2 + t2) ** 2)
    assert gamma is not None
    if distribution == "std":
        return (1 + t2 / ((gamma - 1) * a2)) ** -gamma / (pi * a2 * c2**2)
    return gtr_c(alpha, gamma) / (a2 * c2 + sin(at.theta_h) ** 2) ** gamma


def gtr_c(alpha: mpf, gamma: mpf) -> mpf:
    """Burley's normalisation, and its limits."""
    if alpha == 1:
        return 1 / pi
    if gamma == 1:
        return (alpha**2 - 1) / (pi * log(alpha**2))
    with mpmath.extradps(40):
        return (gamma - 1) * (alpha**2 - 1) / (pi * (1 - alpha ** (2 - 2 * gamma)))


# --- G --------------------------------------------------------------------------------------------------------------------


def hidden(at: Geometry, shadowing: str, distribution: str, alpha: mpf, gamma: mpf | None) -> mpf:
    """G: Heitz 2014, eqs. 98 and 99; Cook & Torrance 1982."""
    if shadowing == "v_groove":
        return min(mpf(1), *(2 * at.mu_h * mu / at.cos_d for mu in (at.mu_i, at.mu_r)))
    i, r = (smith_lambda(t, distribution, alpha, gamma, mpmath.mp.dps) for t in (at.theta_i, at.theta_r))
    return 1 / (1 + i + r) if shadowing == "smith" else 1 / ((1 + i) * (1 + r))


@functools.cache
def smith_lambda(theta: mpf, distribution: str, alpha: mpf, gamma: mpf | None, digits: int) -> mpf:
    """Lambda as an integral over slopes, in closed form where the sources have one; `digits` are those of the context."""
    if theta == 0:
        return mpf(0)
    y = cot(theta)
    nu = y / alpha
    if distribution == "beckmann":
        return (erf(nu) - 1 + exp(-(nu**2)) / (nu * sqrt(pi))) / 2
    if distribution == "ggx":
        return (sqrt(1 + 1 / nu**2) - 1) / 2
    assert gamma is not None
    if distribution == "std":  # (1/cot) int_cot^inf (q - cot) P_1(q) dq with P_1 of Ribardiere et al.
        x = nu / sqrt(gamma - 1)
        norm = mpmath.gamma(gamma - mpf(1) / 2) / (sqrt(pi) * mpmath.gamma(gamma - 1))
        tail = std_tail(x, gamma - 1) / 2
        return norm * (1 + x * x) ** (mpf(3) / 2 - gamma) / ((2 * gamma - 3) * x) - tail
    return gtr_lambda(y, alpha, gamma)


def std_tail(x: mpf, a: mpf) -> mpf:
    """The regularised incomplete beta function I_c(a, 1/2), c = 1 / (1 + x^2).

    mpmath's series for it don't converge for large a near c = 1. There 2 / B(1/2, a) int_x^inf (1 + t^2)^-(a + 1/2) dt is
    integrated over u = (a + 1/2) ln((1 + t^2) / (1 + x^2)), of which the integrand is about exp(-u) / sqrt(u + u_0).
    """
    if a < 1000:
        return mpmath.betainc(a, mpf(1) / 2, 0, 1 / (1 + x * x), regularized=True)
    b, ln = a + mpf(1) / 2, mpmath.log1p(x * x)

    def density(u: mpf) -> mpf:
        return exp(u / b - u) / sqrt(mpmath.expm1(u / b + ln))

    steps = sorted({mpf(0), min(b * ln, mpf(1)), mpf(1), mpf(20), mpf(3 * mpmath.mp.dps)})
    return exp(ln - b * ln) / (b * mpmath.beta(mpf(1) / 2, a)) * mpmath.quad(density, steps)


def gtr_lambda(y: mpf, alpha: mpf, gamma: mpf) -> mpf:
    """That of GTR, which has no name: closed forms for gamma = 0, 1, 2, 3, quadrature to 1e-16 for others.

    With P(t) = C (1 + t^2)^(gamma - 2) (alpha^2 + t^2)^-gamma the density of slopes of size t, the integral over the half
    plane of slopes steeper than y = cot theta along one axis is, in polar coordinates,
    2 / y int_y^inf t P(t) (sqrt(t^2 - y^2) - y acos(y / t)) dt; acos(y / t) = atan x for t = y sqrt(1 + x^2).
    """
    a2 = alpha * alpha
    if gamma in (0, 2):  # D = 1 / pi is GGX of alpha = 1
        return (sqrt(1 + (1 if gamma == 0 else a2) / y**2) - 1) / 2
    c = gtr_c(alpha, gamma)
    if gamma == 1 and alpha != 1:  # P_1 = pi C / (1 - alpha^2) (1 / sqrt(alpha^2 + q^2) - 1 / sqrt(1 + q^2))
        roots = sqrt(1 + y**2) - sqrt(a2 + y**2)
        logarithms = asinh(y) - asinh(y / alpha) - log(alpha)
        return pi * c / (1 - a2) * (roots - y * logarithms) / y
    if gamma == 3:  # P_1 = C pi / 2 (A^-3/2 + 3/4 (1 - alpha^2) A^-5/2), A = alpha^2 + q^2
        root = sqrt(a2 + y**2)
        low = (root - y) / a2  # of A^-3/2: its first moment beyond y less y times its integral
        high = 1 / (3 * root**3) - y / (3 * a2**2) * (2 - y * (3 * a2 + 2 * y**2) / root**3)
        return c * pi / 2 * (low + mpf(3) / 4 * (1 - a2) * high) / y
    with mpmath.workdps(max(32, mpmath.mp.dps)):
        total = mpf(0)
        for x2, weight in _steps()[: 6 * int(10 + 40 + max(0, -log(y)))]:
            t2 = y * y * (1 + x2)
            total += weight * exp((gamma - 2) * log(1 + t2) - gamma * log(a2 + t2))
        return 2 * c * y**2 * total


@functools.cache
def _steps() -> list[tuple[mpf, mpf]]:
    """x^2 and x^2 (x - arctan x) du at steps of 1/6 in u = ln x, from -10; analytic for abs(Im u) < pi / 2."""
    with mpmath.workdps(150):
        steps = [exp(mpf(k) / 6) for k in range(-60, 480)]
        return [(x * x, x * x * (x - atan(x)) / 6) for x in steps]


# --- F --------------------------------------------------------------------------------------------------------------------


def reflected(at: Geometry, fresnel: str, numbers: Mapping[str, mpf]) -> mpf:
    """F at the facet: Schlick 1994; Born & Wolf 1999, section 1.5.2, with a complex index in 14.2."""
    if fresnel == "none":
        return mpf(1)
    if fresnel == "schlick":
        return schlick(at, numbers["f_0"])
    c, m = at.cos_d, mpmath.mpc(numbers["n"], numbers.get("k", 0))
    if m == 1:
        return mpf(0)
    root = sqrt(m * m - sin(at.g / 2) ** 2)  # m cos(theta_t)
    r_s, r_p = (c - root) / (c + root), (m * m * c - root) / (m * m * c + root)
    return (abs(r_s) ** 2 + abs(r_p) ** 2) / 2


def schlick(at: Geometry, f_0: mpf) -> mpf:
    """F in theta_d; with the digits that (1 - cos)^5 loses near 0."""
    with mpmath.extradps(60):
        return f_0 + (1 - f_0) * (1 - cos(at.g / 2)) ** 5
