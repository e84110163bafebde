"""Caps and fields as adaptive quadrature takes them: region of directions, radiance, and what is known of its structure."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gonio.brdf.base import Term
from gonio.fields import EnvironmentMap, Field, Lobes
from gonio.integrate.adaptive import GRAZING, Counter, Light, Region, integrate
from gonio.integrate.frames import Elements
from gonio.source import Cap

Array = NDArray[np.float64]
Index = NDArray[np.intp]
_BROAD = 0.1  # width of a lobe [rad]


def over_cap(
    term: Term, cap: Cap, elements: Elements, *, rtol: float, atol: float, about_normal: bool, effort: Counter
) -> tuple[Array, Array]:
    """Reflected radiance of each element due to one term and one cap: `integrate` with the cap's radiance."""
    axis, profile = elements.local(cap.axis), cap.profile

    def radiance(directions: Array, element: Index) -> Array:
        if profile is None:
            return np.full(len(directions), cap.radiance)
        return np.asarray(cap.radiance * profile(np.einsum("ij,ij->i", directions, axis[element])))

    region = Region(axis, cap.half_angle, about_normal)
    return integrate(term, elements.viewer(), region, Light(radiance), rtol=rtol, atol=atol, effort=effort)


def over_field(
    term: Term,
    field: Field,
    elements: Elements,
    *,
    rtol: float,
    atol: float,
    effort: Counter,
    about_normal: bool | None = None,
) -> tuple[Array, Array]:
    """Reflected radiance of each element due to one term and one field; its peaks, texels or detail are declared.

    Polar coordinates about the normal, or else about the field's own pole; by default the pole for an environment map, whose
    rows are rings about it, unless the view is grazing and the lobe broad, when more circles lie along the horizon; the
    normal for the others.
    """
    if about_normal is None and isinstance(field, EnvironmentMap):
        value, error = np.zeros(len(elements)), np.zeros(len(elements))
        grazing = (elements.cos_theta < GRAZING) & ((term.lobe_width() or 1.0) >= _BROAD)  # a narrow one is a streak
        for local in (False, True):
            some = np.flatnonzero(grazing == local)
            value[some], error[some] = over_field(
                term, field, elements.select(some), rtol=rtol, atol=atol, effort=effort, about_normal=local
            )
        return value, error
    n = len(elements)
    # (n, 3, 3), from viewer-oriented to local
    turn = np.stack([elements.local(axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))], axis=-1)

    def radiance(directions: Array, element: Index) -> Array:
        return field.at(np.einsum("ij,ijk->ik", directions, turn[element]))

    light = Light(radiance)
    region = Region(turn[:, :, 2], math.pi, about_normal is not False)
    if isinstance(field, Lobes):
        lit = field.amplitude > 0
        peaks = np.einsum("nij,fj->nfi", turn, field.axes()[lit])
        light = light._replace(peaks=peaks, widths=1.0 / np.sqrt(np.maximum(field.kappa[lit], 1.0)))
    elif isinstance(field, EnvironmentMap):  # panels between rows, cells between columns
        rows, columns = field.samples.shape
        phi = np.unique(np.mod((np.arange(columns) + 0.5) * (2.0 * np.pi / columns), np.pi).round(12))
        circles = [(0.0, 0.0, 1.0, (i + 0.5) * math.pi / rows) for i in range(rows)]
        circles += [(-math.sin(f), math.cos(f), 0.0, math.pi / 2) for f in phi]
        fixed = np.array(circles)
        centres = np.einsum("nij,fj->nfi", turn, fixed[:, :3])
        light = light._replace(planes=np.concatenate((centres, np.tile(fixed[None, :, 3:], (n, 1, 1))), axis=2))
    else:
        light = light._replace(detail=field.detail)
    return integrate(term, elements.viewer(), region, light, rtol=rtol, atol=atol, effort=effort)
