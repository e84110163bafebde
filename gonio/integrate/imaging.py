r"""Light on a surface, and light on the image plane of a camera (memo, section 9).

A lens of diameter d, its image plane at the distance f behind it, turns the radiance L of what it sees at the angle alpha
off its axis into the irradiance

.. math:: E = L\,\frac{\pi}{4}\left(\frac{d}{f}\right)^2\cos^4\alpha ,

as long as L does not change over the lens. If it does, a glossy surface next to a wide lens, L is the mean over the
directions to the lens, weighted by the cosine at the surface. Losses in the lens and vignetting are no part of this.

References
----------
.. [1] B. K. P. Horn, R. W. Sjoberg, MIT AI Memo 498, 1978, section 9.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gonio.brdf import make
from gonio.brdf.base import BRDF
from gonio.errors import GeometryError, IntegrationError, ParameterError
from gonio.integrate import reflectance_map
from gonio.integrate.cap import unit_rule
from gonio.integrate.frames import Elements
from gonio.integrate.results import Estimate, MapValues
from gonio.integrate.tails import NOTHING
from gonio.source import Collimated, Source

Array = NDArray[np.float64]
_RINGS = (1, 2, 3, 5, 8, 12)  # of viewing directions over the lens; twice as many plus two around each


def irradiance(source: Source, p: ArrayLike, q: ArrayLike, *, rtol: float = 1e-6) -> Estimate:
    r"""Irradiance of surface elements, :math:`E = \int L_i \max(0, \cos\theta_i)\,\mathrm{d}\omega_i`.

    Parameters
    ----------
    source : Source
    p, q : array_like, shapes broadcast to (...)
        Surface gradient dz/dx, dz/dy [1].
    rtol : float, optional
        Relative error requested.

    Returns
    -------
    Estimate
        [W m^-2], shape (...).

    Notes
    -----
    A white diffuse surface shows E / pi, so this is one map under another name.

    Examples
    --------
    >>> import gonio
    >>> sky = gonio.source.make("hemispherical", radiance=1.0)
    >>> round(float(irradiance(sky, 0.0, 0.0).value) / math.pi, 12)
    1.0
    """
    white = reflectance_map(make("lambertian", albedo=1.0), source, p, q, rtol=rtol)
    return Estimate(math.pi * white.value, math.pi * white.error, error_is_bound=white.error_is_bound)


def image_irradiance(
    brdf: BRDF,
    source: Source,
    p: ArrayLike,
    q: ArrayLike,
    *,
    diameter: float,
    focal_length: float,
    alpha: ArrayLike = 0.0,
    distance: float = math.inf,
    tangent: ArrayLike | None = None,
    rtol: float = 1e-6,
) -> Estimate:
    r"""Irradiance of the image plane where it shows surface elements.

    Parameters
    ----------
    brdf : BRDF
    source : Source
        Viewer-oriented: z points to the centre of the lens.
    p, q : array_like, shapes broadcast to (...)
        Surface gradient [1].
    diameter, focal_length : float
        Of the lens, and from the lens to the image plane; same unit.
    alpha : array_like, broadcasts with p and q, optional
        Angle between the ray to the lens and the lens's axis [rad].
    distance : float, optional
        From the surface to the lens, along its axis; same unit. Infinite: L as for a distant viewer. Finite: L averaged
        over the cone that has the lens's solid angle, :math:`\pi d^2 \cos^3\alpha / (4 z^2)`.
    tangent : array_like, optional
        As for `gonio.reflectance_map`.
    rtol : float, optional
        Relative error requested.

    Returns
    -------
    Estimate
        [W m^-2], shape (...).

    Raises
    ------
    ParameterError
        If a length is not positive, or a mirror shows a beam: a delta function has no irradiance here.
    IntegrationError
        If `rtol` is not met; ``exc.best`` is the estimate reached.
    """
    if not (math.isfinite(diameter) and diameter > 0 and math.isfinite(focal_length) and focal_length > 0):
        raise ParameterError(f"diameter = {diameter:g}, focal_length = {focal_length:g}: both must be finite and positive")
    if not distance > 0:
        raise ParameterError(f"distance = {distance:g} from surface to lens must be positive, or infinite")
    angle = np.asarray(alpha, dtype=float)
    if not np.all((angle >= 0) & (angle < math.pi / 2)):
        raise GeometryError("alpha must be within 0 and 90 degrees, 90 excluded")
    if any(t.model.delta for t in brdf.terms) and any(isinstance(s, Collimated) for s in Source.of(source).parts):
        raise ParameterError("a mirror shows a beam as a delta function; give the beam a size, a disk")
    arrays = np.broadcast_arrays(*(np.asarray(a, dtype=float) for a in (p, q, 0.0 if tangent is None else tangent)), angle)
    p_, q_, grain, angle = arrays
    given = None if tangent is None else grain
    factor = 0.25 * math.pi * (diameter / focal_length) ** 2 * np.cos(angle) ** 4
    if math.isinf(distance):
        seen = reflectance_map(brdf, source, p_, q_, rtol=rtol, tangent=given)
        return Estimate(factor * seen.value, factor * seen.error, error_is_bound=seen.error_is_bound)
    half_angle = np.arctan(0.5 * diameter / distance * np.cos(angle) ** 1.5)
    value, error, bound = np.zeros(p_.shape), np.full(p_.shape, np.inf), True
    for width in np.unique(half_angle):
        same = half_angle == width
        value[same], error[same], bound = _lens_mean(
            brdf, source, p_[same], q_[same], None if given is None else given[same], float(width), rtol
        )
    result = Estimate(factor * value, factor * error, error_is_bound=bound)
    if np.any(error > rtol * np.abs(value) * (1 + 1e-9) + NOTHING):
        raise IntegrationError(
            f"radiance changes too fast over the lens for rtol = {rtol:.1e}; the largest relative error is "
            f"{float(np.max(error / np.maximum(np.abs(value), 1e-300))):.1e}; ask for a larger one or use exc.best",
            result,
        )
    return result


def _lens_mean(
    brdf: BRDF, source: Source, p: Array, q: Array, tangent: Array | None, half_angle: float, rtol: float
) -> tuple[Array, Array, bool]:
    """Mean radiance over the directions within `half_angle` of z, weighted by their cosine at the surface; (n,) each."""
    e = Elements.from_gradient(p, q)
    normal = np.stack((e.sin_theta * e.cos_phi, e.sin_theta * e.sin_phi, e.cos_theta), axis=-1)
    totals: list[Array] = []
    for rings in _RINGS:
        x, w = unit_rule(rings)
        # d omega = d(1 - cos t) d phi: Gauss in the first, equal steps in the second
        depth = 2.0 * math.sin(0.5 * half_angle) ** 2
        theta = 2.0 * np.arcsin(np.sqrt(0.5 * depth * x))
        azimuths = 2 * rings + 2
        total, weight, inner = np.zeros(len(p)), np.zeros(len(p)), np.zeros(len(p))
        bound = True
        for t, part in zip(theta, w, strict=True):
            for phi in 2.0 * np.pi * (np.arange(azimuths) + 0.5) / azimuths:
                v = np.array([math.sin(t) * math.cos(phi), math.sin(t) * math.sin(phi), math.cos(t)])
                cosine = part * np.maximum(0.0, normal @ v)
                try:
                    seen = reflectance_map(
                        brdf, source, p, q, rtol=0.3 * rtol, tangent=tangent, viewer=(float(t), float(phi))
                    )
                except IntegrationError as exc:
                    if not isinstance(exc.best, MapValues):
                        raise
                    seen = exc.best
                total, weight, inner = total + cosine * seen.value, weight + cosine, inner + cosine * seen.error
                bound = seen.error_is_bound
        mean = np.divide(total, weight, out=np.zeros_like(total), where=weight > 0)
        inner = np.divide(inner, weight, out=np.zeros_like(total), where=weight > 0)
        totals.append(mean)
        if len(totals) > 1:
            error = np.abs(totals[-1] - totals[-2]) + inner
            if np.all(error <= rtol * np.abs(mean)):
                break
    return totals[-1], error, bound
