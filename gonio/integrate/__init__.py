r"""The shared integrator: reflected radiance of a BRDF under a source.

.. math:: L_r = \int f_r(\omega_i, \omega_r)\,L_i(\omega_i)\,\max(0, \cos\theta_i)\,\mathrm{d}\omega_i

R(p, q), scene radiance and albedo all come from here (memo, section 13). `plan` chooses; nothing that a scene does not
need is computed.

References
----------
.. [1] B. K. P. Horn, R. W. Sjoberg, "Calculating the Reflectance Map", MIT AI Memo 498, 1978.
"""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gonio import jit
from gonio.brdf.base import BRDF
from gonio.errors import GeometryError, ParameterError
from gonio.fields import Field
from gonio.integrate import closed_forms, viewpoint
from gonio.integrate.frames import Elements
from gonio.integrate.grid import Gradients
from gonio.integrate.lights import over_field
from gonio.integrate.methods import Run
from gonio.integrate.plan import Method, plan
from gonio.integrate.quadrature import integrate_cap
from gonio.integrate.results import Estimate, MapValues, insist
from gonio.source import Collimated, Source, uniform

__all__ = ["Estimate", "MapValues", "directional_albedo", "plan", "reflectance_map", "scene_radiance"]

Array = NDArray[np.float64]


def reflectance_map(
    brdf: BRDF,
    source: Source,
    p: ArrayLike,
    q: ArrayLike,
    rtol: float = 1e-6,
    atol: float = 0.0,
    *,
    tangent: ArrayLike | None = None,
    viewer: tuple[float, float] | None = None,
    threads: int | None = None,
) -> MapValues:
    r"""Reflectance map R(p, q): scene radiance as a function of the surface gradient.

    Parameters
    ----------
    brdf : BRDF
    source : Source
        Viewer-oriented; the viewer looks along -z from far away.
    p, q : array_like, shapes broadcast to (...)
        Surface gradient dz/dx, dz/dy [1].
    rtol, atol : float, optional
        Relative and absolute [W m^-2 sr^-1] error requested.
    tangent : array_like, broadcasts with p and q, optional
        For an anisotropic BRDF: how far its x axis is rotated about the normal [rad], counter-clockwise seen from outside,
        from the surface's direction (1, 0, p), that is along x.
    viewer : (theta, phi), optional
        Direction of a distant viewer off the z axis [rad], in the coordinates of source and gradients; R is 0 where the
        surface faces away. Fields then cost a quadrature per gradient.
    threads : int, optional
        All cores by default. The result does not depend on it.

    Returns
    -------
    MapValues
        ``.value``, ``.error`` of shape (...), ``.impulses``, ``.plan``.

    Raises
    ------
    GeometryError
        If a gradient is NaN or both of its components are infinite.
    ParameterError
        If the BRDF is anisotropic and `tangent` is missing.
    IntegrationError
        If the tolerance is not met; ``exc.best`` is the `MapValues` reached, with its errors.

    Examples
    --------
    A Lambertian surface under a hemispherical sky (memo, 14c):

    >>> import gonio
    >>> paper, sky = gonio.brdf.make("lambertian", albedo=1.0), gonio.source.make("hemispherical", radiance=1.0)
    >>> round(float(reflectance_map(paper, sky, 0.75, 1.0).value), 12) == round((1 + 1 / math.sqrt(2.5625)) / 2, 12)
    True
    """
    if not (math.isfinite(rtol) and rtol > 0 and math.isfinite(atol) and atol >= 0):
        raise ParameterError(f"rtol = {rtol:g} and atol = {atol:g}: rtol must be positive, atol zero or positive")
    if tangent is not None:
        p, q, tangent = (np.asarray(a, dtype=float) for a in np.broadcast_arrays(p, q, tangent))
    if viewer is not None:
        p, q = (np.asarray(a, dtype=float) for a in np.broadcast_arrays(p, q))
        return viewpoint.seen_from(viewer, brdf, source, p, q, rtol, atol, tangent)
    gradients = Gradients(p, q)
    if tangent is not None or not all(term.model.isotropic for term in brdf.terms):
        viewpoint.with_grain(brdf, gradients.elements(), None if tangent is None else np.ravel(tangent))  # may complain
    value, error = np.zeros(gradients.size), np.zeros(gradients.size)
    impulses: list[tuple[float, float, float]] = []
    steps = plan(brdf, Source.of(source))
    run = Run(gradients, None if tangent is None else np.ravel(tangent), rtol, atol / max(1, len(steps)), threads, steps)
    for step in sorted(steps, key=lambda s: s.method is Method.RINGS):  # these use what is left of the tolerance
        start = time.perf_counter() - jit.getting_ready_s()
        if step.method is Method.IMPULSE:
            assert isinstance(step.part, Collimated)
            impulses += closed_forms.mirror_beam(step.term, step.part)
        elif step.method is not Method.ZERO:
            step.error = run.add(step, value, error)
        step.seconds = max(0.0, time.perf_counter() - jit.getting_ready_s() - start)
    bound = not viewpoint.depends_on_user(brdf, Source.of(source))
    result = MapValues(value.reshape(gradients.shape), error.reshape(gradients.shape), impulses, steps, error_is_bound=bound)
    return insist(result, rtol, atol)


def scene_radiance(
    brdf: BRDF,
    source: Source,
    theta_n: ArrayLike,
    phi_n: ArrayLike,
    *,
    form: str = "local",
    rtol: float = 1e-6,
    tangent: ArrayLike | None = None,
) -> Estimate:
    """The general integral of the memo's section 13 by quadrature, in either of its two forms.

    The closed forms are not used: this is the path they are checked against. `reflectance_map` is the way to a result.

    Parameters
    ----------
    brdf : BRDF
        Without delta functions.
    source : Source
        Without beams.
    theta_n, phi_n : array_like, shapes broadcast to (...)
        Polar angles of the surface normal [rad], 0 <= theta_n < pi/2.
    form : {"local", "viewer"}
        Polar coordinates about the surface normal, or about the axis of each part of the source, which for uniform and
        hemispherical sources and for radiance fields is the viewer's.
    rtol : float, optional
        Relative error requested.
    tangent : array_like, broadcasts with theta_n and phi_n, optional
        As for `reflectance_map`, for an anisotropic BRDF.

    Returns
    -------
    Estimate
        [W m^-2 sr^-1], shape (...).
    """
    if form not in ("local", "viewer"):
        raise ParameterError(f"form = {form!r}; the memo has two: 'local' and 'viewer'")
    theta, phi = np.broadcast_arrays(np.asarray(theta_n, dtype=float), np.asarray(phi_n, dtype=float))
    if tangent is not None:
        theta, phi, tangent = np.broadcast_arrays(theta, phi, np.asarray(tangent, dtype=float))
    if not np.all((theta >= 0) & (theta <= np.pi / 2)):
        raise GeometryError("theta_n must be within 0 and 90 degrees")
    upright = Elements.from_polar(theta.ravel(), phi.ravel())
    grained = viewpoint.with_grain(brdf, upright, None if tangent is None else np.ravel(tangent))
    source = Source.of(source)
    value, error = np.zeros(len(upright)), np.zeros(len(upright))
    for step in plan(brdf, source):
        elements = upright if step.term.model.isotropic else grained
        if isinstance(step.part, Collimated):
            raise ParameterError("a collimated beam is a delta function: its integral is closed form 14a, not a quadrature")
        by_quadrature: Any = over_field if isinstance(step.part, Field) else integrate_cap
        v, e = by_quadrature(
            step.term, step.part, elements, rtol=rtol, atol=0.0, about_normal=form == "local", effort=step.effort
        )
        value, error = value + v, error + e
    bound = not viewpoint.depends_on_user(brdf, source)
    return Estimate(value.reshape(theta.shape), error.reshape(theta.shape), error_is_bound=bound)


def directional_albedo(brdf: BRDF, theta_r: ArrayLike, *, rtol: float = 1e-6) -> Estimate:
    r"""Directional-hemispherical reflectance, by reciprocity also hemispherical-directional.

    Parameters
    ----------
    brdf : BRDF
    theta_r : array_like, shape (...)
        Polar angle of the fixed direction from the normal [rad], 0 <= theta_r < pi/2.
    rtol : float, optional
        Relative error requested.

    Returns
    -------
    Estimate
        rho [1], shape (...).

    Notes
    -----
    A surface under a uniform source of radiance 1 shows rho at theta_n = theta_r, so this is one map under another name.

    Examples
    --------
    A rough metal without multiple scattering loses light; at alpha = 1 exactly ln 2 of it (f_0 = 1):

    >>> import gonio
    >>> metal = gonio.brdf.make("ggx", k_s=1.0, alpha=1.0, f_0=1.0)
    >>> round(float(directional_albedo(metal, 0.0, rtol=1e-12).value), 12) == round(1 - math.log(2), 12)
    True
    """
    theta = np.asarray(theta_r, dtype=float)
    if not np.all((theta >= 0) & (theta < np.pi / 2)):
        raise GeometryError("theta_r must be within 0 and 90 degrees, 90 excluded")
    flat = reflectance_map(brdf, uniform(1.0), np.tan(theta.ravel()), 0.0, rtol=rtol)
    return Estimate(flat.value.reshape(theta.shape), flat.error.reshape(theta.shape), error_is_bound=flat.error_is_bound)
