r"""Microfacet models for the second opinion of tests/independent.py, written from the primary formulas without gonio.

.. math:: f_r = k_s\,\frac{F D G}{4\mu_i\mu_r} + f_{ms}

Smith's Lambda is an integral over slopes; here it is taken where it has a closed form: Beckmann's, the GGX and Student's
distribution, and GTR with gamma = 1, whose density of slopes is a difference of two simple ones. Multiple scattering is
known in closed form for GGX at alpha = 1 with correlated shadowing, where facets that reflect all are Lommel and Seeliger's
surface of w = 2: :math:`1-E = \mu\ln((1+\mu)/\mu)`, :math:`\bar E = \tfrac43(1-\ln 2)`.

References
----------
.. [1] B. Walter et al., EGSR 2007; E. Heitz, JCGT 3(2), 2014; B. Burley, SIGGRAPH course, 2012 (GTR).
.. [2] M. Ribardiere et al., CGF 36(2), 2017 (Student's t). K. E. Torrance, E. M. Sparrow, JOSA 57(9), 1967 (v-grooves).
.. [3] C. Kulla, A. Conty, SIGGRAPH course, 2017 (multiple scattering). C. Schlick, CGF 13(3), 1994.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from tests.independent_pairs import Circle, Feature, Pair, equal_elevation

Array = NDArray[np.float64]
Term = dict[str, Any]


def _choice(term: Term, key: str) -> str:
    if term["model"] == "beckmann":
        return {"distribution": "beckmann", "fresnel": "schlick", "shadowing": "smith"}[key]
    return str(term.get(key, {"distribution": "beckmann", "fresnel": "schlick", "shadowing": "smith"}[key]))


def _density(term: Term, at: Pair) -> Array:
    """D(h)."""
    a, t2 = term["alpha"], at.tan2_h
    cos2 = 1 / (1 + t2)
    kind = _choice(term, "distribution")
    if kind == "beckmann":
        return np.exp(-t2 / a**2) / (math.pi * a**2 * cos2**2)
    if kind == "ggx":
        return 1 / (math.pi * a**2 * cos2**2 * (1 + t2 / a**2) ** 2)
    gamma = term["gamma"]
    if kind == "std":
        return (1 + t2 / ((gamma - 1) * a**2)) ** -gamma / (math.pi * a**2 * cos2**2)
    if gamma == 1.0:
        c = (a * a - 1) / (math.pi * math.log(a * a))
    else:
        c = (gamma - 1) * (a * a - 1) / (math.pi * (1 - a ** (2 - 2 * gamma)))
    return c / (cos2 * (a * a + t2)) ** gamma


def _lambda(term: Term, mu: Any, sine: Any) -> Any:
    """Smith's Lambda of a direction: the integral of (q - cot) P(q) over slopes q beyond cot theta, over cot theta."""
    a, kind = term["alpha"], _choice(term, "distribution")
    mu, sine = np.asarray(mu, dtype=float), np.maximum(np.asarray(sine, dtype=float), 1e-140)
    cot = mu / sine
    if kind == "ggx":
        return (np.hypot(1.0, a * sine / mu) - 1) / 2
    if kind == "beckmann":
        x = cot / a
        return np.exp(-(x**2)) * (1 / (x * math.sqrt(math.pi)) - special.erfcx(x)) / 2
    gamma = term["gamma"]
    if kind == "std":
        scale2 = (gamma - 1) * a * a
        below = 1 / (1 + cot**2 / scale2)
        height = special.gamma(gamma - 0.5) / special.gamma(gamma - 1) / math.sqrt(math.pi * scale2)
        first = height * scale2 / (2 * gamma - 3) * below ** (gamma - 1.5)
        return first / cot - special.betainc(gamma - 1, 0.5, below) / 2
    assert kind == "gtr" and gamma == 1.0
    near, far = np.hypot(1.0, cot), np.hypot(a, cot)
    first = (1 - a * a) / (near + far)
    tail = np.log1p(first / (cot + far))
    return (first / cot - tail) / (2 * math.log(1 / a))


def _shadowing(term: Term, at: Pair) -> Array:
    """G / (4 mu_i mu_r)."""
    kind = _choice(term, "shadowing")
    if kind == "v_groove":
        lower = np.minimum(at.mu_i, at.mu_r)
        return np.minimum(1.0, 2 * at.mu_h * lower / at.cos_d) / (4 * at.mu_i * at.mu_r)
    incident, reflected = _lambda(term, at.mu_i, at.sin_i), float(_lambda(term, at.mu_r, at.sin_r))
    whole = 1 + incident + reflected if kind == "smith" else (1 + incident) * (1 + reflected)
    return 1 / (4 * at.mu_i * at.mu_r * whole)


def _reflected(term: Term, c: Array) -> Array:
    """Fresnel's F of the facet's cosine."""
    kind = _choice(term, "fresnel")
    if kind == "none":
        return np.ones_like(c)
    if kind == "schlick":
        return term["f_0"] + (1 - term["f_0"]) * (1 - c) ** 5
    m2 = (term["n"] + 1j * (term["k"] if kind == "conductor" else 0.0)) ** 2
    q = np.sqrt(m2 - 1 + c * c)
    return 0.5 * (np.abs((c - q) / (c + q)) ** 2 + np.abs((m2 * c - q) / (m2 * c + q)) ** 2)


def value(term: Term, at: Pair) -> Array:
    """f_r [1/sr]."""
    once = term["k_s"] * _density(term, at) * _reflected(term, at.cos_d) * _shadowing(term, at)
    if not term.get("multiple_scattering", False):
        return once
    assert _choice(term, "distribution") == "ggx" and term["alpha"] == 1.0 and _choice(term, "shadowing") == "smith"
    kind = _choice(term, "fresnel")
    assert kind in ("none", "schlick")
    average, albedo = 1.0 if kind == "none" else term["f_0"] + (1 - term["f_0"]) / 21, 4 / 3 * (1 - math.log(2))
    lost = at.mu_i * np.log1p(1 / at.mu_i) * at.mu_r * math.log1p(1 / at.mu_r)
    again = average**2 * albedo / (1 - average * (1 - albedo)) * lost / (math.pi * (1 - albedo))
    return once + term["k_s"] * again


def knows(term: Term) -> bool:
    return term["model"] in ("beckmann", "microfacet")


def features(term: Term, surface: Any) -> list[Feature]:
    """The lobe."""
    return [(surface.mirror, min(1.0, term["alpha"]))]


def circles(term: Term, surface: Any) -> list[Circle]:
    """Of v-grooves: which direction is the lower one, and where those that it sees begin to hide; a third is no circle."""
    if _choice(term, "shadowing") != "v_groove":
        return []
    return [*equal_elevation(surface), (surface.mirror, math.pi - 2 * surface.theta_r, False)]


def curve(term: Term, surface: Any) -> Any:
    """Of v-grooves, what vanishes where the lower one of the directions begins to be hidden: l^2 - 4 (mu_i + mu_r) mu_i."""
    if _choice(term, "shadowing") != "v_groove":
        return None

    def hidden(w: Array) -> Array:
        mu_i = w @ surface.normal
        return 2 + 2 * w[:, 2] - 4 * (mu_i + surface.cos_r) * mu_i

    return hidden
