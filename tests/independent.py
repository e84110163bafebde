r"""A second opinion on reflected radiance: its own formulas, its own geometry, its own adaptive quadrature, no gonio code.

.. math:: R = \int f_r\,L_i\,\max(0, \cos\theta_i)\,\mathrm{d}\omega_i

Everything that makes the integrand jump or bend is a circle on the sphere; `tests.independent_rings` integrates over rings
split where circles cut them. Two methods share nothing but this arrangement:

- ``"normal"``: pole at the surface normal, models written in angles, Gauss-Kronrod (21 points);
- ``"other"``: pole at the source's axis or at the mirror direction, models written in vectors, Gauss-Legendre (12 points)
  on a panel against its halves.

A scene is plain data, as in tests/data/problems.json: ``{"brdf": [{"model": "ggx", ...}], "source": [{"kind": "disk",
...}], "p": 0.1, "q": 0.2}``, angles in radians. It is slow and knows only what the tests need.

References
----------
.. [1] B. Walter et al., EGSR 2007; E. Heitz, JCGT 3(2), 2014; C. Schlick, CGF 13(3), 1994 (GGX).
.. [2] M. Oren, S. K. Nayar, SIGGRAPH 1994 (qualitative model). E. P. Lafortune, Y. D. Willems, 1994 (Phong).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests import independent_diffuse, independent_facets, independent_lobes, independent_sources
from tests.independent_pairs import from_angles, from_vectors
from tests.independent_rings import RULES, Arrangement, Rings, angle
from tests.independent_sources import axis, radiance, towards

Array = NDArray[np.float64]
HALF_PI = 0.5 * math.pi


# --- the surface, and models in two notations -------------------------------------------------------------------------


class Surface:
    """A surface element of gradient (p, q) seen from z: normal, mirror direction, cosines, all in viewer's coordinates."""

    def __init__(self, p: float, q: float) -> None:
        slope = math.hypot(p, q)
        self.flat = slope == 0.0
        length = math.hypot(slope, 1.0)
        self.cos_r, self.sin_r = 1.0 / length, slope / length
        self.theta_r = math.atan2(slope, 1.0)
        c, s = (1.0, 0.0) if self.flat else (-p / slope, -q / slope)
        self.normal = np.array([self.sin_r * c, self.sin_r * s, self.cos_r])
        self.tangent = np.array([self.cos_r * c, self.cos_r * s, -self.sin_r])  # mirror = cos_r normal + sin_r tangent
        self.binormal = np.array([-s, c, 0.0])
        self.mirror = self.cos_r * self.normal + self.sin_r * self.tangent


def _others(term: dict[str, Any]) -> Any:
    """The module that has the term's model, None if it is one of those here."""
    return next((m for m in (independent_lobes, independent_diffuse, independent_facets) if m.knows(term)), None)


def _by_angles(term: dict[str, Any], surface: Surface, theta_i: Array, u: Array) -> Array:
    """f_r for incident polar angle theta_i and azimuth u counted from the mirror direction."""
    model = term["model"]
    if (others := _others(term)) is not None:
        return others.value(term, from_angles(surface, theta_i, u))
    si, ci, sr, cr = np.sin(theta_i), np.cos(theta_i), surface.sin_r, surface.cos_r
    if model == "lambertian":
        return np.full(np.broadcast(theta_i, u).shape, term["albedo"] / math.pi)
    if model == "phong":
        n = term["n"]
        return term["k_s"] * (n + 2) / (2 * math.pi) * np.maximum(0.0, ci * cr + si * sr * np.cos(u)) ** n
    if model == "oren_nayar":
        s2 = term["sigma"] ** 2
        larger, smaller = np.maximum(theta_i, surface.theta_r), np.minimum(theta_i, surface.theta_r)
        b = 0.45 * s2 / (s2 + 0.09) * np.maximum(0.0, -np.cos(u)) * np.sin(larger) * np.tan(smaller)
        return term["albedo"] / math.pi * (1 - 0.5 * s2 / (s2 + 0.33) + b)
    assert model == "ggx"
    a = term["alpha"]
    # cos 2 theta_d = cos of the angle between the two directions; tan theta_h from the sum's components
    across = 4 * np.cos((theta_i + surface.theta_r) / 2) ** 2 * np.sin((theta_i - surface.theta_r) / 2) ** 2
    across = across + 4 * si * sr * np.sin(u / 2) ** 2
    tan2_h = across / (ci + cr) ** 2
    cos2_h = 1 / (1 + tan2_h)
    d = 1 / (math.pi * a**2 * cos2_h**2 * (1 + tan2_h / a**2) ** 2)
    cos_d = np.minimum(1.0, np.sqrt(np.maximum(0.0, (across + (ci + cr) ** 2) / 4)))
    fresnel = term["f_0"] + (1 - term["f_0"]) * (1 - cos_d) ** 5
    # G / (cos cos) with Lambda = (sqrt(1 + a^2 tan^2) - 1) / 2
    smith = 2 / (cr * np.hypot(ci, a * si) + ci * math.hypot(cr, a * sr))
    return term["k_s"] * fresnel * d * smith / 4


def _by_vectors(term: dict[str, Any], surface: Surface, w: Array) -> Array:
    """f_r for unit vectors w (n, 3), viewer's coordinates; the viewer is (0, 0, 1)."""
    model = term["model"]
    if (others := _others(term)) is not None:
        with np.errstate(over="ignore", invalid="ignore"):
            return np.where(w @ surface.normal > 0, others.value(term, from_vectors(surface, w)), 0.0)
    mu_i, mu_r = w @ surface.normal, surface.cos_r
    if model == "lambertian":
        return np.full(len(w), term["albedo"] / math.pi)
    if model == "phong":
        n = term["n"]
        aligned = np.maximum(0.0, w @ surface.mirror)
        return term["k_s"] * (n + 2) / (2 * math.pi) * np.exp(n * np.log(np.maximum(aligned, 1e-300)))
    if model == "oren_nayar":
        s2 = term["sigma"] ** 2
        bent = np.maximum(0.0, w[:, 2] - mu_i * mu_r) / np.maximum(mu_i, mu_r)  # sin sin cos(dphi) / cos of the smaller
        return term["albedo"] / math.pi * (1 - 0.5 * s2 / (s2 + 0.33) + 0.45 * s2 / (s2 + 0.09) * bent)
    assert model == "ggx"
    a2 = term["alpha"] ** 2
    total = w + np.array([0.0, 0.0, 1.0])
    h = total / np.linalg.norm(total, axis=1)[:, None]
    nh = h @ surface.normal
    t, b = h @ surface.tangent, h @ surface.binormal
    d = a2 / (math.pi * (a2 * nh**2 + t**2 + b**2) ** 2)
    fresnel = term["f_0"] + (1 - term["f_0"]) * (1 - np.minimum(1.0, h[:, 2])) ** 5
    t, b = w @ surface.tangent, w @ surface.binormal
    root_i, root_r = np.sqrt(mu_i**2 + a2 * (t**2 + b**2)), math.sqrt(mu_r**2 + a2 * surface.sin_r**2)
    return term["k_s"] * fresnel * d / (2 * (mu_r * root_i + mu_i * root_r))


# --- scenes -----------------------------------------------------------------------------------------------------------


def _arrange(term: dict[str, Any], part: dict[str, Any], surface: Surface) -> Arrangement:
    found = Arrangement([(surface.normal, HALF_PI, True)])
    found.circles += independent_sources.circles(part)
    found.features += independent_sources.features(part)
    if (others := _others(term)) is not None:
        found.features += others.features(term, surface)
        found.circles += others.circles(term, surface)
        found.curve = others.curve(term, surface)
    elif term["model"] == "ggx":
        found.features.append((surface.mirror, term["alpha"]))
    elif term["model"] == "phong":
        found.features.append((surface.mirror, 1 / math.sqrt(max(1.0, term["n"]))))
        found.circles.append((surface.mirror, HALF_PI, False))
    elif term["model"] == "oren_nayar" and not surface.flat:
        found.circles += [(surface.normal, surface.theta_r, False), (surface.tangent, HALF_PI, False)]
    return found


def _pole(term: dict[str, Any], part: dict[str, Any], surface: Surface) -> Array:
    """A pole that is not the normal: what is narrowest, else the source's axis, else any direction."""
    narrow = [(1 / math.sqrt(part["kappa"]), axis(part))] if part["kind"] == "lobes" and part["kappa"] > 1 else []
    if part["kind"] == "disk":
        narrow.append((part["half_angle"], axis(part)))
    if (others := _others(term)) is not None:
        narrow += [(2 * width, direction) for direction, width in others.features(term, surface)]
    if term["model"] == "ggx":
        narrow.append((2 * term["alpha"], surface.mirror))
    if term["model"] == "phong":
        narrow.append((2 / math.sqrt(max(1.0, term["n"])), surface.mirror))
    narrow = [(w, d) for w, d in narrow if w < 0.5] + [(1.0, axis(part)), (2.0, towards(1.1, 0.4))]
    for _, direction in sorted(narrow, key=lambda pair: pair[0]):
        if angle(direction, surface.normal) > 1e-3:
            return direction
    return narrow[-1][1]


def _pair(term: dict[str, Any], part: dict[str, Any], surface: Surface, method: str, rtol: float) -> float:
    if part["kind"] == "collimated":
        w = axis(part)
        mu_i = float(w @ surface.normal)
        if mu_i <= 0 or term["model"] == "specular":  # a mirror shows a beam as a delta function of the gradient
            return 0.0
        if method == "other":
            return part["irradiance"] * mu_i * float(_by_vectors(term, surface, w[None])[0])
        across, along = float(w @ surface.binormal), float(w @ surface.tangent)
        theta_i, u = np.array([math.atan2(math.hypot(across, along), mu_i)]), np.array([math.atan2(across, along)])
        return part["irradiance"] * math.cos(theta_i[0]) * float(_by_angles(term, surface, theta_i, u)[0])
    found = _arrange(term, part, surface)
    if term["model"] == "specular":
        direction = surface.mirror[None]
        return term["rho"] * float(np.where(found.inside(direction), radiance(part, direction), 0.0)[0])
    if method == "normal":
        rings = Rings(surface.tangent, surface.normal, found, RULES["normal"])
        return rings.integral(lambda t, u, w: _by_angles(term, surface, t, u) * np.cos(t) * radiance(part, w), rtol)
    pole = _pole(term, part, surface)
    side = min((surface.mirror, surface.normal), key=lambda d: abs(float(d @ pole)))  # azimuth 0, away from the pole
    if abs(float(side @ pole)) > 0.999:
        side = np.roll(pole, 1) + np.array([0.1, 0.0, 0.0])
    rings = Rings(side, pole, found, RULES["other"])
    return rings.integral(
        lambda t, u, w: _by_vectors(term, surface, w) * np.maximum(0.0, w @ surface.normal) * radiance(part, w), rtol
    )


def _single(parts: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Parts with arrays of lobes taken apart."""
    found = []
    for part in parts:
        if part["kind"] == "lobes" and np.ndim(part["kappa"]):
            keys = ("amplitude", "kappa", "theta", "phi")
            for values in zip(*(part[k] for k in keys), strict=True):
                found.append({"kind": "lobes", **dict(zip(keys, values, strict=True))})
        else:
            found.append(part)
    return found


def reflected_radiance(scene: dict[str, Any], method: str, rtol: float = 1e-13) -> float:
    """Scene radiance without delta functions [W m^-2 sr^-1], by method "normal" or "other", each panel to `rtol` of it."""
    surface = Surface(scene["p"], scene["q"])
    return math.fsum(_pair(t, s, surface, method, rtol) for t in scene["brdf"] for s in _single(scene["source"]))
