"""Lobes for the second opinion of tests/independent.py: two notations of each model, and where it is narrow or bent.

``by_angles`` takes the incident polar angle and the azimuth u counted from the mirror direction, ``by_vectors`` unit vectors
in viewer's coordinates. Both are written from the primary formulas, and nothing of gonio is used.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Term = dict[str, Any]
HALF_PI = 0.5 * math.pi
MODELS = (
    "blinn_phong", "lafortune", "ward", "ashikhmin_shirley", "abg", "harvey_shack", "k_correlation",
)  # fmt: skip


def _value(term: Term, mu_i: Array, mu_r: float, d2: Array, tangential: Array) -> Array:
    """From the cosines, |beta - beta_0|^2 and the product of the tangential parts of the two directions."""
    model = term["model"]
    if model == "lafortune":
        largest = max(abs(term["C_xy"]), term["C_z"])
        base = np.maximum(0.0, (term["C_xy"] * tangential + term["C_z"] * mu_i * mu_r) / largest)
        return term["k_s"] * (term["n"] + 2) / (2 * math.pi) * base ** term["n"]
    if model == "abg":
        return term["A"] / (term["B"] + np.sqrt(d2) ** term["g"])
    if model == "harvey_shack":
        return term["b_0"] * (1 + d2 / term["l"] ** 2) ** (term["s"] / 2)
    if model == "k_correlation":
        c, wavelength = term["C"], term["wavelength_um"]
        constant = math.gamma((c + 1) / 2) / (2 * math.sqrt(math.pi) * math.gamma(c / 2)) * term["A"] * term["B"]
        spectrum = constant / (1 + term["B"] ** 2 * d2 / wavelength**2) ** ((c + 1) / 2)
        return 16 * math.pi**2 / wavelength**4 * mu_i * mu_r * spectrum
    tan2 = d2 / (mu_i + mu_r) ** 2
    if model == "ward":
        peak = term["k_s"] * np.exp(-tan2 / term["alpha"] ** 2) / (math.pi * term["alpha"] ** 2)
        variant = term.get("variant", "ward")
        if variant == "gmd":
            return peak * (d2 + (mu_i + mu_r) ** 2) / (mu_i + mu_r) ** 4
        return peak / (4 * (np.sqrt(mu_i * mu_r) if variant == "ward" else mu_i * mu_r))
    n = term["n"]
    power = np.exp(-0.5 * n * np.log1p(tan2))
    if model == "blinn_phong":
        return term["k_s"] * (n + 2) * (n + 4) / (8 * math.pi * (2 ** (-n / 2) + n)) * power
    assert model == "ashikhmin_shirley"
    cos_d = 0.5 * np.sqrt(d2 + (mu_i + mu_r) ** 2)
    fresnel = term["R_s"] + (1 - term["R_s"]) * np.maximum(0.0, 1 - cos_d) ** 5
    diffuse = (1 - (1 - mu_i / 2) ** 5) * (1 - (1 - mu_r / 2) ** 5) * 28 * term["R_d"] / (23 * math.pi) * (1 - term["R_s"])
    return diffuse + (n + 1) / (8 * math.pi) * power * fresnel / (cos_d * np.maximum(mu_i, mu_r))


def by_angles(term: Term, surface: Any, theta_i: Array, u: Array) -> Array:
    """f_r for incident polar angle theta_i and azimuth u from the mirror direction."""
    half_sum, half_difference = (theta_i + surface.theta_r) / 2, (theta_i - surface.theta_r) / 2
    product = np.sin(theta_i) * surface.sin_r
    d2 = 4 * np.cos(half_sum) ** 2 * np.sin(half_difference) ** 2 + 4 * product * np.sin(u / 2) ** 2
    return _value(term, np.cos(theta_i), surface.cos_r, d2, -product * np.cos(u))


def by_vectors(term: Term, surface: Any, w: Array) -> Array:
    """f_r for unit vectors w (n, 3); the viewer is (0, 0, 1)."""
    viewer = np.array([0.0, 0.0, 1.0])
    total = w + viewer
    d2 = (total @ surface.tangent) ** 2 + (total @ surface.binormal) ** 2
    tangential = sum((w @ axis) * float(viewer @ axis) for axis in (surface.tangent, surface.binormal))
    mu_i = w @ surface.normal
    return np.where(mu_i > 0, _value(term, np.maximum(mu_i, 1e-300), surface.cos_r, d2, tangential), 0.0)


def features(term: Term, surface: Any) -> list[tuple[Array, float]]:
    """Directions around which it is narrow, and how narrow [rad]."""
    model = term["model"]
    if model == "lafortune":
        return [(_axis(term, surface), 1 / math.sqrt(max(1.0, term["n"])))]
    width = {
        "ward": lambda: term["alpha"],
        "abg": lambda: max(1e-7, term["B"] ** (1 / term["g"])) if term["g"] > 0 else 1.0,
        "harvey_shack": lambda: term["l"],
        "k_correlation": lambda: term["wavelength_um"] / term["B"],
    }.get(model, lambda: 1 / math.sqrt(max(1.0, term["n"])))()
    return [(surface.mirror, min(1.0, width))]


def circles(term: Term, surface: Any) -> list[tuple[Array, float, bool]]:
    """Circles across which a derivative jumps: centre, angular radius, False."""
    if term["model"] == "lafortune":
        return [(_axis(term, surface), HALF_PI, False)]
    if term["model"] == "ashikhmin_shirley" and not surface.flat:
        return [(surface.normal, surface.theta_r, False)]
    return []


def _axis(term: Term, surface: Any) -> Array:
    axis = term["C_z"] * surface.cos_r * surface.normal - term["C_xy"] * surface.sin_r * surface.tangent
    return np.asarray(axis / np.linalg.norm(axis))
