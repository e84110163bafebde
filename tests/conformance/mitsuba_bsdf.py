"""Mitsuba 3 (W. Jakob et al., EPFL), a renderer: its surface models in single precision.

Its rough surfaces have separable shadowing, Beckmann's with a rational fit of Smith's function; its plastic a polynomial for
the internal reflectance. Where these are all that differs, a second comparison puts them in gonio's place.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from gonio.brdf import BRDF, make
from gonio.geometry import unit_vector
from tests.conformance.third_party import Array, Comparison, directions

PROGRAM = "mitsuba"
SINGLE = "single precision"
Factor = Callable[[Array, Array], Array]


def _vectors() -> tuple[Array, Array]:
    """omega_i, omega_r (n, 3), rounded as Mitsuba will."""
    theta_i, theta_r, dphi = directions()
    pair = unit_vector(theta_i, 0.0), unit_vector(theta_r, dphi)
    omega_i, omega_r = (w.astype(np.float32).astype(float) for w in pair)
    return omega_i, omega_r


def _compare(
    theirs: str, brdf: BRDF, bsdf: Callable[[], dict[str, Any]], limit: float, limited_by: str, factor: Factor | None = None
) -> Comparison:
    def values() -> tuple[Array, Array]:
        import mitsuba

        mitsuba.set_variant("scalar_rgb")
        omega_i, omega_r = _vectors()
        loaded, at, how = mitsuba.load_dict(bsdf()), mitsuba.SurfaceInteraction3f(), mitsuba.BSDFContext()
        found = []
        for wi, wr in zip(omega_i.tolist(), omega_r.tolist(), strict=True):
            at.wi = mitsuba.Vector3f(*wi)
            found.append(loaded.eval(how, at, mitsuba.Vector3f(*wr))[0] / wr[2])
        ours = brdf.evaluate(omega_i, omega_r)
        return ours * (1.0 if factor is None else factor(omega_i, omega_r)), np.array(found)

    return Comparison(PROGRAM, theirs, brdf, values, limit, limited_by)


def _grey(value: float) -> dict[str, Any]:
    return {"type": "rgb", "value": [value] * 3}


def _rational(alpha: float) -> Factor:
    """Walter et al., EGSR 2007: the rational fit of 1 / (1 + Lambda) of Beckmann's facets, over the function itself."""
    from scipy.special import erfcx

    def one(w: Array) -> Array:
        sine = np.hypot(w[:, 0], w[:, 1])
        y = np.divide(w[:, 2], alpha * sine, out=np.full(len(w), np.inf), where=sine > 0.0)
        low = np.minimum(y, 1.6)
        fit = np.where(y < 1.6, low * (3.535 + 2.181 * low) / (1.0 + low * (2.276 + 2.577 * low)), 1.0)
        few = np.minimum(y, 20.0)
        return fit * (1.0 + 0.5 * np.exp(-few * few) * (1.0 / (few * np.sqrt(np.pi)) - erfcx(few)))

    return lambda omega_i, omega_r: one(omega_i) * one(omega_r)


def _polynomial(albedo: float, n: float) -> Factor:
    """Mitsuba's own internal reflectance in place of the exact one."""

    def factor(omega_i: Array, omega_r: Array) -> Array:
        import mitsuba

        from gonio.brdf.plastic import diffuse_reflectance

        exact = 1.0 - (1.0 - diffuse_reflectance(n)) / (n * n)
        theirs = float(mitsuba.fresnel_diffuse_reflectance(1.0 / n))
        return np.full(len(omega_i), (1.0 - albedo * exact) / (1.0 - albedo * theirs))

    return factor


def comparisons() -> Iterator[Comparison]:
    yield _compare(
        "diffuse", make("lambertian", albedo=0.37), lambda: {"type": "diffuse", "reflectance": _grey(0.37)}, 2e-7, SINGLE
    )
    surfaces: list[tuple[str, dict[str, Any], Callable[[], dict[str, Any]]]] = [
        ("roughconductor, a perfect mirror", {"fresnel": "none"}, lambda: {"type": "roughconductor", "material": "none"}),
        (
            "roughconductor", {"fresnel": "conductor", "n": 0.2, "k": 3.5},
            lambda: {"type": "roughconductor", "eta": _grey(0.2), "k": _grey(3.5)},
        ),
        (
            "roughdielectric, what it reflects", {"fresnel": "dielectric", "n": 1.5},
            lambda: {"type": "roughdielectric", "int_ior": 1.5, "ext_ior": 1.0},
        ),
    ]  # fmt: skip
    for name, fresnel, surface in surfaces:
        for alpha in (0.05, 0.35, 0.8):
            for distribution in ("ggx", "beckmann"):

                def bsdf(
                    surface: Callable[[], dict[str, Any]] = surface, distribution: str = distribution, alpha: float = alpha
                ) -> dict[str, Any]:
                    return {**surface(), "distribution": distribution, "alpha": alpha}

                theirs = f"{name}, {distribution}"
                brdf = make(
                    "microfacet", k_s=1.0, alpha=alpha, distribution=distribution, shadowing="smith_separable", **fresnel
                )
                if distribution == "ggx":
                    yield _compare(theirs, brdf, bsdf, 2e-5, SINGLE)
                else:
                    yield _compare(theirs, brdf, bsdf, 1e-2, "its rational fit of Smith's function")
                    yield _compare(f"{theirs}, with that fit in gonio's place", brdf, bsdf, 2e-5, SINGLE, _rational(alpha))
    for n in (1.2, 1.5, 2.5):
        plastic = make("plastic", albedo=0.5, n=n)

        def painted(n: float = n) -> dict[str, Any]:
            base = {"diffuse_reflectance": _grey(0.5), "specular_reflectance": _grey(0.0), "nonlinear": True}
            return {"type": "plastic", "int_ior": n, "ext_ior": 1.0, **base}

        theirs = "plastic, diffuse part"
        yield _compare(theirs, plastic, painted, 5e-3, "its polynomial for the internal reflectance")
        yield _compare(
            f"{theirs}, with that polynomial in gonio's place", plastic, painted, 2e-5, SINGLE, _polynomial(0.5, n)
        )
