"""Diffuse models for the second opinion of tests/independent.py, written from the primary formulas without gonio.

References
----------
.. [1] M. Minnaert, Astrophysical Journal 93, 1941. H. Seeliger, Sitzungsber. Akad. Wiss. Muenchen 18, 1888.
.. [2] B. Hapke, J. Geophys. Res. 86, 1981; Icarus 59, 1984 (roughness); Icarus 157, 2002 (H).
.. [3] P. Kubelka, F. Munk, Z. techn. Phys. 12, 1931. J. L. Saunderson, JOSA 32(12), 1942.
.. [4] M. Oren, S. K. Nayar, SIGGRAPH 1994. J. Portsmouth, P. Kutz, S. Hill, JCGT 14(1), 2025 (EON).
.. [5] L. B. Wolff, JOSA A 11(11), 1994 (a diffuse base below a dielectric surface).
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.independent_pairs import Circle, Feature, Pair, equal_elevation

Array = NDArray[np.float64]
Term = dict[str, Any]
HALF_PI = 0.5 * math.pi


def _minnaert(term: Term, at: Pair) -> Array:
    return term["albedo"] / math.pi * (at.mu_i * at.mu_r) ** (term["k"] - 1)


def _lommel_seeliger(term: Term, at: Pair) -> Array:
    return term["w"] / (4 * math.pi * (at.mu_i + at.mu_r))


def _kubelka_munk(term: Term, at: Pair) -> Array:
    k, k_1, k_2 = term["K_over_S"], term.get("k_1", 0.0), term.get("k_2", 0.0)
    r = 1 / (1 + k + math.sqrt(k * (k + 2)))
    return np.full(at.mu_i.shape, (k_1 + (1 - k_1) * (1 - k_2) * r / (1 - k_2 * r)) / math.pi)


def _hapke(term: Term, at: Pair) -> Array:
    w, b, c, theta_bar = term["w"], term["b"], term["c"], term["theta_bar"]
    cos_g = 1 - at.apart / 2

    def henyey_greenstein(along: Array) -> Array:
        return (1 - b * b) / (1 - 2 * b * along + b * b) ** 1.5

    p = (1 + c) / 2 * henyey_greenstein(cos_g) + (1 - c) / 2 * henyey_greenstein(-cos_g)
    opposition = term["B_0"] / (1 + np.sqrt(at.apart / at.total) / term["h"])

    def big_h(x: Array) -> Array:
        y = math.sqrt(1 - w)
        if term.get("H", "1981") == "1981":
            return (1 + 2 * x) / (1 + 2 * x * y)
        r_0 = (1 - y) / (1 + y)
        return 1 / (1 - w * x * (r_0 + (1 - 2 * r_0 * x) / 2 * np.log((1 + x) / x)))

    mu_0e, mu_e, shadow = (at.mu_i, np.full_like(at.mu_i, at.mu_r), 1.0) if theta_bar == 0 else _rough(theta_bar, at)
    scattered = (1 + opposition) * p + big_h(mu_0e) * big_h(mu_e) - 1
    return w / (4 * math.pi) / at.mu_i * mu_0e / (mu_0e + mu_e) * scattered * shadow


def _rough(theta_bar: float, at: Pair) -> tuple[Array, Array, Array]:
    """Effective cosines of incidence and reflection, and the shadowing S."""
    slope = math.tan(theta_bar)
    chi = 1 / math.sqrt(1 + math.pi * slope**2)
    sines = (at.sin_i, np.full_like(at.sin_i, at.sin_r))
    cosines = (at.mu_i, np.full_like(at.mu_i, at.mu_r))
    with np.errstate(divide="ignore"):
        cots = [cosine / (slope * sine) for cosine, sine in zip(cosines, sines, strict=True)]
    e_1, e_2 = [np.exp(-2 / math.pi * x) for x in cots], [np.exp(-(x**2) / math.pi) for x in cots]
    eta = [chi * (cosines[k] + sines[k] * slope * e_2[k] / (2 - e_1[k])) for k in (0, 1)]
    half2 = np.sin(at.psi / 2) ** 2
    steep = at.theta_i <= at.theta_r  # i <= e

    def pick(k: int, values: Any) -> Array:  # k = 0: of the direction nearer to the normal
        return np.where(steep, values[k], values[1 - k])

    below = 2 - pick(1, e_1) - at.psi / math.pi * pick(0, e_1)
    near = chi * (pick(0, cosines) + pick(0, sines) * slope * (np.cos(at.psi) * pick(1, e_2) + half2 * pick(0, e_2)) / below)
    far = chi * (pick(1, cosines) + pick(1, sines) * slope * (pick(1, e_2) - half2 * pick(0, e_2)) / below)
    f = np.exp(-2 * np.tan(np.minimum(at.psi, math.pi * (1 - 1e-16)) / 2))
    mu_0e, mu_e = np.where(steep, near, far), np.where(steep, far, near)
    shadow = mu_e / eta[1] * at.mu_i / eta[0] * chi / (1 - f + f * chi * pick(0, cosines) / pick(0, eta))
    return mu_0e, mu_e, shadow


def _oren_nayar_full(term: Term, at: Pair) -> Array:
    s2, rho = term["sigma"] ** 2, term["albedo"]
    alpha, beta = np.maximum(at.theta_i, at.theta_r), np.minimum(at.theta_i, at.theta_r)
    cosine = np.cos(at.psi)
    c_1 = 1 - 0.5 * s2 / (s2 + 0.33)
    c_2 = 0.45 * s2 / (s2 + 0.09) * (np.sin(alpha) - np.where(cosine < 0, (2 * beta / math.pi) ** 3, 0.0))
    c_3 = 0.125 * s2 / (s2 + 0.09) * (4 * alpha * beta / math.pi**2) ** 2
    once = c_1 + cosine * c_2 * np.tan(beta) + (1 - np.abs(cosine)) * c_3 * np.tan((alpha + beta) / 2)
    twice = 0.17 * rho * s2 / (s2 + 0.13) * (1 - cosine * (2 * beta / math.pi) ** 2)
    return rho / math.pi * (once + twice)


def _eon(term: Term, at: Pair) -> Array:
    rho, r = term["albedo"], term["roughness"]
    k_1, k_2 = 1 / 2 - 2 / (3 * math.pi), 2 / 3 - 28 / (15 * math.pi)
    a = 1 / (1 + k_1 * r)

    def albedo(mu: Any, s: Any, theta: Any) -> Any:
        g = s * (theta - s * mu) + 2 / 3 * (s * mu * (1 + s + s * s) / (1 + s) - s)  # (1 - s^3) / mu
        return a * (1 + r / math.pi * g)

    mean = a * (1 + k_2 * r)
    bent = np.where(at.dot > 0, at.dot / np.maximum(at.mu_i, at.mu_r), at.dot)
    lost = (1 - albedo(at.mu_i, at.sin_i, at.theta_i)) * (1 - albedo(at.mu_r, at.sin_r, at.theta_r))
    again = rho**2 * mean / (1 - rho * (1 - mean)) * lost / (1 - mean)
    return (rho * a * (1 + r * bent) + again) / math.pi


def fresnel(mu: Any, n: float) -> Any:
    """Reflectance of a dielectric for unpolarised light from outside."""
    q = np.sqrt(n * n - 1 + mu * mu)
    return 0.5 * (((mu - q) / (mu + q)) ** 2 + ((n * n * mu - q) / (n * n * mu + q)) ** 2)


@functools.cache
def mean_fresnel(n: float) -> float:
    """2 times the integral of F mu, by Gauss's rule on panels that shrink towards grazing."""
    x, w = np.polynomial.legendre.leggauss(30)
    edges = np.array([0.0, 0.01, 0.1, 0.3, 0.6, 1.0])
    half = 0.5 * np.diff(edges)[:, None]
    mu = edges[:-1, None] + half * (1 + x)
    return float(np.sum(half * w * 2 * mu * fresnel(mu, n)))


def _plastic(term: Term, at: Pair) -> Array:
    rho, n = term["albedo"], term["n"]
    inside = 1 - (1 - mean_fresnel(n)) / n**2  # by reciprocity of the surface
    through = (1 - fresnel(at.mu_i, n)) * (1 - fresnel(at.mu_r, n))
    return rho / math.pi * through / (n**2 * (1 - rho * inside))


_FORMULAS = {
    "minnaert": _minnaert,
    "lommel_seeliger": _lommel_seeliger,
    "hapke": _hapke,
    "kubelka_munk": _kubelka_munk,
    "oren_nayar": _oren_nayar_full,
    "eon": _eon,
    "plastic": _plastic,
}


def knows(term: Term) -> bool:
    return term["model"] in _FORMULAS and (term["model"] != "oren_nayar" or term.get("variant") == "full")


def value(term: Term, at: Pair) -> Array:
    """f_r [1/sr]."""
    return _FORMULAS[term["model"]](term, at)


def features(term: Term, surface: Any) -> list[Feature]:
    """The opposition peak is a cusp at the viewer's direction; forward scattering crowds at the horizon's near side."""
    if term["model"] != "hapke":
        return []
    found: list[Feature] = [(np.array([0.0, 0.0, 1.0]), min(1.0, term["h"]))] if term["B_0"] > 0 else []
    if term["b"] > 0.5:
        found += [(np.array([0.0, 0.0, 1.0]), 1 - term["b"]), (surface.mirror, 1 - term["b"])]
    return found


def circles(term: Term, surface: Any) -> list[Circle]:
    """Where polar angles or signs change places, and the plane of incidence, in which |psi| has a corner."""
    if surface.flat:
        return []
    if term["model"] == "hapke" and term["theta_bar"] > 0:
        return [*equal_elevation(surface), (surface.binormal, HALF_PI, False)]
    if term["model"] in ("oren_nayar", "eon"):
        return [*equal_elevation(surface), (surface.tangent, HALF_PI, False)]
    return []


def curve(term: Term, surface: Any) -> Any:
    """What vanishes where a derivative jumps elsewhere than at `circles`: nowhere."""
    return None
