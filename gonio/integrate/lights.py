"""Caps and fields as adaptive quadrature takes them: region of directions, radiance, and what is known of its structure."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.brdf.base import Term
from gonio.brdf.elementary import exp
from gonio.fields import EnvironmentMap, Field, Lobes
from gonio.integrate.adaptive import GRAZING, Counter, Light, Region, integrate
from gonio.integrate.frames import Elements
from gonio.source import Cap

Array = NDArray[np.float64]
Index = NDArray[np.intp]
_BROAD = 0.1  # width of a lobe [rad]


def over_cap(
    term: Term, cap: Cap, elements: Elements, *, rtol: float, atol: float, about_normal: bool, effort: Counter,
    threads: int = 1,
) -> tuple[Array, Array]:  # fmt: skip
    """Reflected radiance of each element due to one term and one cap: `integrate` with the cap's radiance."""
    axis, profile = elements.local(cap.axis), cap.profile

    def radiance(directions: Array, element: Index) -> Array:
        if profile is None:
            return np.full(directions.shape[:2], cap.radiance)
        return np.asarray(cap.radiance * profile(np.einsum("ikj,ij->ik", directions, axis[element])))

    region = Region(axis, cap.half_angle, about_normal)
    cores = 1 if term.model.own else threads  # who knows what a user's function can stand
    return integrate(term, elements.viewer(), region, Light(radiance), rtol=rtol, atol=atol, effort=effort, cores=cores)


def over_field(
    term: Term,
    field: Field,
    elements: Elements,
    *,
    rtol: float,
    atol: float | Array,
    effort: Counter,
    about_normal: bool | None = None,
    threads: int = 1,
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
                term, field, elements.select(some), rtol=rtol, atol=np.broadcast_to(atol, len(elements))[some],
                effort=effort, about_normal=local, threads=threads,
            )  # fmt: skip
        return value, error
    n = len(elements)
    # (n, 3, 3), from viewer-oriented to local
    turn = np.stack([elements.local(axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))], axis=-1)

    def radiance(directions: Array, element: Index) -> Array:
        turned = np.empty_like(directions)
        _turned(directions, element, turn, turned)
        return field.at(turned.reshape(-1, 3))

    light = Light(radiance)
    region = Region(turn[:, :, 2], math.pi, about_normal is not False)
    if isinstance(field, Lobes):
        lit = field.amplitude > 0
        amplitude, kappa = field.amplitude[lit], field.kappa[lit]
        peaks = np.einsum("nij,fj->nfi", turn, field.axes()[lit])

        def of_lobes(directions: Array, element: Index) -> Array:
            out = np.empty(directions.shape[:2])
            _lobes(directions, element, peaks, amplitude, kappa, out)
            return out

        light = Light(of_lobes, peaks, 2.0 / np.sqrt(np.maximum(kappa, 1.0)))
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
    return integrate(term, elements.viewer(), region, light, rtol=rtol, atol=atol, effort=effort, cores=threads)


def _all_turned(directions, element, turn, out):  # type: ignore[no-untyped-def]
    for c in range(len(directions)):
        m = turn[element[c]]
        for k in range(directions.shape[1]):
            x, y, z = directions[c, k, 0], directions[c, k, 1], directions[c, k, 2]
            for j in range(3):
                out[c, k, j] = x * m[0, j] + y * m[1, j] + z * m[2, j]


def _all_lobes(directions, element, peaks, amplitude, kappa, out):  # type: ignore[no-untyped-def]
    """Radiance of lobes about `peaks` (n, f, 3), of each direction about those of its element."""
    for c in range(len(directions)):
        row, line = directions[c], out[c]
        line[:] = 0.0
        for f in range(len(kappa)):
            mx, my, mz = peaks[element[c], f, 0], peaks[element[c], f, 1], peaks[element[c], f, 2]
            a, half = amplitude[f], -0.5 * kappa[f]
            for k in range(len(line)):
                x, y, z = row[k, 0] - mx, row[k, 1] - my, row[k, 2] - mz
                line[k] += a * exp(half * (x * x + y * y + z * z))  # mu.w - 1, without cancellation


_turned = jit.kernel(_all_turned)
_lobes = jit.kernel(_all_lobes, apart=True)
