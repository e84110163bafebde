"""SCATMECH (T. A. Germer, NIST), by its Python interface pySCATMECH: polarised scattering models in double precision.

It was written for scatter from optics and shares nothing with renderers. Its azimuth is 0 towards the mirror; light is
unpolarised unless said otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from gonio.brdf import BRDF, make
from gonio.geometry import unit_vector
from tests.conformance.third_party import Array, Comparison, directions

PROGRAM = "pySCATMECH"
ROUNDING = "rounding; angles go in, not vectors"
NO_FILM = {"stack": "No_StackModel"}


def _numbers(index: complex) -> dict[str, str]:
    return {"lambda": "0.6328", "substrate": f"({index.real!r},{index.imag!r})", "type": "0"}


def _compare(
    theirs: str, brdf: BRDF, model: str, given: dict[str, str], limit: float, limited_by: str, **how: Any
) -> Comparison:
    return Comparison(PROGRAM, theirs, brdf, lambda: _values(brdf, model, given, **how), limit, limited_by)


def _values(
    brdf: BRDF, model: str, given: dict[str, str], *, s_polarised: bool = False, scale_free: bool = False
) -> tuple[Array, Array]:
    """Both programs' values; in the plane of incidence if s-polarised; theirs scaled to gonio's mean if scale-free."""
    from pySCATMECH.brdf import BRDF_Model

    theta_i, theta_r, dphi = directions()
    if s_polarised:
        dphi = np.where(np.cos(dphi) < 0.0, np.pi, 0.0)
    light = {"inc": [1, 1, 0, 0], "sens": [0.5, 0.5, 0, 0]} if s_polarised else {}
    scattering = BRDF_Model(model, given)
    geometries = zip(theta_i.tolist(), theta_r.tolist(), (dphi - np.pi).tolist(), strict=True)
    theirs = np.array([scattering.BRDF(i, r, phi, **light) for i, r, phi in geometries])
    ours = brdf.evaluate(unit_vector(theta_i, 0.0), unit_vector(theta_r, dphi))
    return ours, theirs * (np.mean(ours / theirs) if scale_free else 1.0)


def _facets(index: complex, slopes: dict[str, str]) -> dict[str, str]:
    return {**_numbers(index), **slopes, **NO_FILM, "shadow": "Torrance_Sparrow_Shadow_Function"}


def _medium(phase: dict[str, str], w: float) -> dict[str, str]:
    """A deep layer without a surface; phase function and single-scattering albedo."""
    at = "phase_function"
    inner = {at + "." + key: value for key, value in phase.items()}
    share = {f"{at}.log_absorption": repr(math.log1p(-w)), f"{at}.log_scattering": repr(math.log(w))}
    return {**_numbers(1.0), "depoll": "0", "depolc": "0", at: "Unpolarized_Phase_Function", **inner, **share, **NO_FILM}


def comparisons() -> Iterator[Comparison]:
    yield _compare(
        "Lambertian", make("lambertian", albedo=0.37), "Lambertian_BRDF_Model",
        {**_numbers(1.5), "reflectance": "Table_Reflectance", "reflectance.table": "0.37"}, 1e-15, "rounding",
    )  # fmt: skip
    glass, metal = {"fresnel": "dielectric", "n": 1.5}, {"fresnel": "conductor", "n": 0.2, "k": 3.5}
    for fresnel, index in ((glass, 1.5), (metal, 0.2 + 3.5j)):
        for alpha in (0.05, 0.35, 1.0):
            yield _compare(
                "Shadowed_Facet, Gaussian slopes, Torrance_Sparrow",
                make("microfacet", k_s=1.0, alpha=alpha, distribution="beckmann", shadowing="v_groove", **fresnel),
                "Shadowed_Facet_BRDF_Model",
                _facets(index, {"sdf": "Gaussian_Slope_Distribution_Function", "sdf.s": repr(alpha)}),
                1e-12, ROUNDING,
            )  # fmt: skip
            # ellipsoids of revolution are Trowbridge and Reitz's facets; one on each pi / alpha^2 of area normalises them
            ellipsoids = {"sdf": "Ellipsoid_Slope_Distribution_Function", "sdf.rz": "1", "sdf.rx": repr(1.0 / alpha)}
            yield _compare(
                "Shadowed_Facet, ellipsoids, Torrance_Sparrow",
                make("microfacet", k_s=1.0, alpha=alpha, distribution="ggx", shadowing="v_groove", **fresnel),
                "Shadowed_Facet_BRDF_Model",
                _facets(index, {**ellipsoids, "sdf.ry": repr(1.0 / alpha), "sdf.density": repr(alpha * alpha / math.pi)}),
                1e-12, ROUNDING,
            )  # fmt: skip
    yield _compare(
        "First_Diffuse, isotropic", make("lommel_seeliger", w=0.6), "First_Diffuse_BRDF_Model",
        _medium({"phase_function": "Isotropic_Phase_Function"}, 0.6), 1e-12, ROUNDING,
    )  # fmt: skip
    for g in (0.4, -0.4, 0.9, -0.9):
        w = 1e-13  # little light is scattered twice, and none counts
        yield _compare(
            f"First_Diffuse, Henyey_Greenstein g = {g:g}",
            make("hapke", w=w, b=abs(g), c=-math.copysign(1.0, g), B_0=0.0, h=0.05, theta_bar=0.0),
            "First_Diffuse_BRDF_Model",
            _medium({"phase_function": "Henyey_Greenstein_Phase_Function", "phase_function.g": repr(g)}, w),
            1e-11, "light scattered twice, w = 1e-13",
        )  # fmt: skip
    for n in (1.2, 1.5, 2.5):
        given = {**_numbers(n), "reflectance": "Table_Reflectance", "reflectance.table": "0.5", **NO_FILM}
        plastic = make("plastic", albedo=0.5, n=n)
        yield _compare(
            "Diffuse_Subsurface", plastic, "Diffuse_Subsurface_BRDF_Model", given, 5e-4,
            "its integral of the internal reflectance",
        )  # fmt: skip
        yield _compare(
            "Diffuse_Subsurface, that integral taken out", plastic, "Diffuse_Subsurface_BRDF_Model", given, 1e-12, ROUNDING,
            scale_free=True,
        )  # fmt: skip
    for c in (1.0, 1.7, 4.0):
        # its A is that of the two-dimensional spectrum, its C gonio's C + 1; at an index of 1e9 a metal is perfect
        a, b = 1e-6, 20.0
        spectrum = math.exp(math.lgamma(0.5 * (c + 1.0)) - math.lgamma(0.5 * c)) / (2.0 * math.sqrt(math.pi)) * a * b
        psd = {"psd": "ABC_PSD_Function", "psd.A": repr(spectrum), "psd.B": repr(b), "psd.C": repr(c + 1.0)}
        yield _compare(
            "Microroughness, ABC, s-polarised, in the plane of incidence",
            make("k_correlation", A=a, B=b, C=c, wavelength_um=0.6328), "Microroughness_BRDF_Model",
            {**_numbers(1e9), **psd}, 1e-6, "its mirror of finite index, 1e9", s_polarised=True,
        )  # fmt: skip
