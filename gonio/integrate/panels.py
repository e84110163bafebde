r"""Gauss-Legendre panels that break where an integrand has a feature, and the general rule for radiance fields.

The sphere above a surface's horizon is covered by rings about a pole. Rings and arcs of rings are cut into panels at the
features that the caller declares: points with a width (a lobe), around which panels grow geometrically, planes
:math:`c\cdot\omega=d` across which the integrand has a kink, and fixed circles and meridians (the rows and columns of a
map); no panel is longer than a given length. On the ring of polar angle t about the pole a plane is met where

.. math:: \cos(\chi-\chi_c) = \frac{d-\cos\gamma\cos t}{\sin\gamma\sin t}

with c at polar angle gamma and azimuth chi_c. Nodes of one surface element at a time: this serves any BRDF and any field,
it is not the fast way.

References
----------
.. [1] B. K. P. Horn, R. W. Sjoberg, MIT AI Memo 498, 1978, section 13.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gonio import jit

Array = NDArray[np.float64]
GROWTH = 3.0
_CAPACITY = 4096  # breakpoints of one range


@jit.model
def insert(points, count, value, lower, upper):  # type: ignore[no-untyped-def]
    """Insert a breakpoint into the sorted list if it is inside and new; returns the new count."""
    slack = 1e-13 * (upper - lower)
    if not (value > lower + slack and value < upper - slack) or count >= points.size:
        return count
    k = count
    while k > 0 and points[k - 1] > value:
        k -= 1
    if (k > 0 and value - points[k - 1] < slack) or (k < count and points[k] - value < slack):
        return count
    for j in range(count, k, -1):
        points[j] = points[j - 1]
    points[k] = value
    return count + 1


@jit.model
def gather(points, count, centre, width, reach, lower, upper):  # type: ignore[no-untyped-def]
    """Insert the centre and centre +- width * growth^k up to `reach`."""
    count = insert(points, count, centre, lower, upper)
    step = width
    while step < reach:
        count = insert(points, count, centre - step, lower, upper)
        count = insert(points, count, centre + step, lower, upper)
        step *= GROWTH
    return count


@jit.model
def subdivide(points, count, lower, upper, longest):  # type: ignore[no-untyped-def]
    """Close the list with its two ends and halve what is longer than `longest`; returns how many edges there are."""
    coarse = np.empty(count + 2)
    coarse[0], coarse[count + 1] = lower, upper
    coarse[1 : count + 1] = points[:count]
    n = 0
    for k in range(count + 1):
        a, b = coarse[k], coarse[k + 1]
        pieces = max(1, math.ceil((b - a) / longest - 1e-9))
        for j in range(pieces):
            if n >= points.size - 1:
                break
            points[n] = a + (b - a) * j / pieces
            n += 1
    points[n] = upper
    return n + 1


def _sphere_nodes(pole, mirror, width, pole_width, planes, rings, columns, shift, longest, x, w, directions, weights):  # type: ignore[no-untyped-def]
    """Fill nodes above the horizon in the local frame (normal +z); how many, or -1 if they do not fit.

    `pole` (3,), `mirror` (3,): the lobe's direction; `width` of the lobe and `pole_width` of the field around the pole, both
    [rad], >= 10 for none; `planes` (k, 4), the horizon first; `rings`: polar angles where panels break; `columns`: meridians
    at shift + 2 pi k / columns, 0 for none; `longest` panel [rad].
    """
    e3x, e3y, e3z = pole[0], pole[1], pole[2]
    # e1 normal to the pole, towards local z where that is possible
    if abs(e3z) < 0.9999:
        e1x, e1y, e1z = -e3z * e3x, -e3z * e3y, 1.0 - e3z * e3z
    else:
        e1x, e1y, e1z = 1.0 - e3x * e3x, -e3x * e3y, -e3x * e3z
    length = math.sqrt(e1x * e1x + e1y * e1y + e1z * e1z)
    e1x, e1y, e1z = e1x / length, e1y / length, e1z / length
    e2x, e2y, e2z = e3y * e1z - e3z * e1y, e3z * e1x - e3x * e1z, e3x * e1y - e3y * e1x
    m1 = mirror[0] * e1x + mirror[1] * e1y + mirror[2] * e1z
    m2 = mirror[0] * e2x + mirror[1] * e2y + mirror[2] * e2z
    m3 = mirror[0] * e3x + mirror[1] * e3y + mirror[2] * e3z
    t_m, chi_m = math.atan2(math.hypot(m1, m2), m3), math.atan2(m2, m1)
    n_planes = planes.shape[0]
    gamma, chi_c, opening = np.empty(n_planes), np.empty(n_planes), np.empty(n_planes)
    for k in range(n_planes):
        c1 = planes[k, 0] * e1x + planes[k, 1] * e1y + planes[k, 2] * e1z
        c2 = planes[k, 0] * e2x + planes[k, 1] * e2y + planes[k, 2] * e2z
        c3 = planes[k, 0] * e3x + planes[k, 1] * e3y + planes[k, 2] * e3z
        gamma[k], chi_c[k] = math.atan2(math.hypot(c1, c2), c3), math.atan2(c2, c1)
        opening[k] = math.acos(min(1.0, max(-1.0, planes[k, 3])))

    start, end = max(0.0, gamma[0] - 0.5 * math.pi), min(math.pi, gamma[0] + 0.5 * math.pi)
    tangents = np.empty(4 * n_planes)
    points = np.empty(_CAPACITY)
    n_t = 0
    for k in range(n_planes):
        tangents[4 * k] = abs(gamma[k] - opening[k])
        tangents[4 * k + 1] = gamma[k] + opening[k]
        tangents[4 * k + 2] = 2.0 * math.pi - gamma[k] - opening[k]
        tangents[4 * k + 3] = start if k == 0 else tangents[4 * k]
        for j in range(3):
            n_t = insert(points, n_t, tangents[4 * k + j], start, end)
    for k in range(rings.size):
        n_t = insert(points, n_t, rings[k], start, end)
    if width < 10.0:
        n_t = gather(points, n_t, t_m, width, math.pi, start, end)
        n_t = gather(points, n_t, end, max(min(width, abs(mirror[2])), 1e-9), 1.0, start, end)
    if pole_width < 10.0:
        n_t = gather(points, n_t, 0.0, pole_width, math.pi, start, end)
        if start > 0.0:  # the field's centre is below the horizon: what is seen is its steep edge
            n_t = gather(points, n_t, start, pole_width * min(1.0, pole_width / math.sin(start)), math.pi, start, end)
    n_t = subdivide(points, n_t, start, end, longest)
    arcs = np.empty(_CAPACITY)
    count = 0
    for panel in range(n_t - 1):
        a, b = points[panel], points[panel + 1]
        smooth = True
        for k in range(4 * n_planes):
            if abs(a - tangents[k]) < 1e-12 or abs(b - tangents[k]) < 1e-12:
                smooth = False
        for i in range(x.size):
            if smooth:
                t, dt = a + (b - a) * x[i], (b - a) * w[i]
            else:  # a plane touches the ring at an end: a square root there, which this makes smooth
                t = a + (b - a) * x[i] * x[i] * (3.0 - 2.0 * x[i])
                dt = (b - a) * 6.0 * x[i] * (1.0 - x[i]) * w[i]
            st, ct = math.sin(t), math.cos(t)
            n_chi = 0
            lower, upper = chi_c[0] - math.pi, chi_c[0] + math.pi
            cut = math.sin(gamma[0]) * st
            whole = math.cos(gamma[0]) * ct >= cut
            if not whole:
                if math.cos(gamma[0]) * ct <= -cut:
                    continue
                reach = math.acos(-math.cos(gamma[0]) * ct / cut)
                lower, upper = chi_c[0] - reach, chi_c[0] + reach
            if width < 10.0:
                scale = max(math.sqrt((t - t_m) ** 2 + (width * max(abs(mirror[2]), 1e-4)) ** 2) / max(st, 1e-30), 1e-10)
                for turn in range(-1, 2):
                    n_chi = gather(arcs, n_chi, chi_m + 2.0 * math.pi * turn, scale, math.pi, lower, upper)
                if not whole:
                    edge = max(min(width, abs(mirror[2])), 1e-9) / max(st, 1e-30)
                    n_chi = gather(arcs, n_chi, lower, edge, math.pi, lower, upper)
                    n_chi = gather(arcs, n_chi, upper, edge, math.pi, lower, upper)
            for k in range(1, n_planes):
                cut = math.sin(gamma[k]) * st
                level = planes[k, 3] - math.cos(gamma[k]) * ct
                if abs(level) < cut:
                    reach = math.acos(level / cut)
                    for turn in range(-1, 2):
                        n_chi = insert(arcs, n_chi, chi_c[k] + reach + 2.0 * math.pi * turn, lower, upper)
                        n_chi = insert(arcs, n_chi, chi_c[k] - reach + 2.0 * math.pi * turn, lower, upper)
            if columns > 0:
                step = 2.0 * math.pi / columns
                first = math.ceil((lower - shift) / step)
                for j in range(columns + 1):
                    n_chi = insert(arcs, n_chi, shift + (first + j) * step, lower, upper)
            n_chi = subdivide(arcs, n_chi, lower, upper, min(longest / max(st, 1e-3), 1.6))
            if count + (n_chi - 1) * x.size > weights.size:
                return -1
            for piece in range(n_chi - 1):
                c0, c1 = arcs[piece], arcs[piece + 1]
                for j in range(x.size):
                    chi = c0 + (c1 - c0) * x[j]
                    u, v = st * math.cos(chi), st * math.sin(chi)
                    zi = u * e1z + v * e2z + ct * e3z
                    if zi <= 0.0:  # rounding at the horizon
                        continue
                    directions[count, 0] = u * e1x + v * e2x + ct * e3x
                    directions[count, 1] = u * e1y + v * e2y + ct * e3y
                    directions[count, 2] = zi
                    weights[count] = st * dt * (c1 - c0) * w[j] * zi
                    count += 1
    return count


sphere_nodes = jit.kernel(_sphere_nodes, fastmath=False)
