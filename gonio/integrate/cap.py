r"""Quadrature over the directions that light a surface element: a cap of the sphere above the surface's horizon.

.. math:: \int_{\text{cap}\,\cap\,\{n\cdot\omega>0\}} f_r\,L_i\,\cos\theta_i\,\mathrm{d}\omega_i

This is the general integral of the memo's section 13 in both of its forms: polar coordinates about the surface normal,
clipped by the source (local form), or about the source's axis, clipped by the surface's horizon (viewer form, when the
axis is the viewer's). On the ring of polar angle t about the pole, the other boundary, a cap of half angle delta whose
centre is gamma away, cuts out

.. math:: \tan^2\frac{\chi}{2} \le \frac{\sin\frac{\delta+t-\gamma}{2}\,\sin\frac{\delta-t+\gamma}{2}}
                                        {\sin\frac{t+\gamma+\delta}{2}\,\sin\frac{t+\gamma-\delta}{2}} ,

which cancels nowhere. Panels of Gauss-Legendre nodes break where a ring begins or ceases to be cut (there the integrand
behaves like a square root, which the substitution t = a + (b - a)(3 s^2 - 2 s^3) makes smooth), and gather geometrically
around the mirror direction and the horizon at the scale of the model's lobe, so no lobe is too narrow to be seen.

References
----------
.. [1] B. K. P. Horn, R. W. Sjoberg, MIT AI Memo 498, 1978, section 13.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray

from gonio import jit

Array = NDArray[np.float64]
ORDERS = (6, 10, 16, 24, 36, 54)  # nodes per panel; the difference of two rows is the error estimate
_GROWTH = 3.0  # of panel widths away from a lobe


@functools.cache
def unit_rule(order: int) -> tuple[Array, Array]:
    """Gauss-Legendre nodes and weights on [0, 1]."""
    x, w = np.polynomial.legendre.leggauss(order)
    return (x + 1.0) / 2.0, w / 2.0


@jit.model
def _insert(points, count, value, lower, upper):  # type: ignore[no-untyped-def]
    """Insert a breakpoint into the sorted list if it is inside and new; returns the new count."""
    span = upper - lower
    if not (value > lower + 1e-14 * span and value < upper - 1e-14 * span) or count >= points.size:
        return count
    k = count
    while k > 0 and points[k - 1] > value:
        k -= 1
    if (k > 0 and value - points[k - 1] < 1e-14 * span) or (k < count and points[k] - value < 1e-14 * span):
        return count
    for j in range(count, k, -1):
        points[j] = points[j - 1]
    points[k] = value
    return count + 1


@jit.model
def _gather(points, count, centre, width, reach, lower, upper):  # type: ignore[no-untyped-def]
    """Insert centre and centre +- width * growth^k up to `reach`."""
    count = _insert(points, count, centre, lower, upper)
    step = width
    while step < reach:
        count = _insert(points, count, centre - step, lower, upper)
        count = _insert(points, count, centre + step, lower, upper)
        step *= _GROWTH
    return count


def _cap_nodes(cos_n, sin_n, axis, half_angle, about_normal, width, symmetric, x, w, directions, weights):  # type: ignore[no-untyped-def]
    """Fill nodes for one surface element, local frame, viewer at (-sin_n, 0, cos_n); how many, or -1 if they don't fit."""
    half_pi = 0.5 * math.pi
    # pole e3, centre of the clipping cap c, its half angle, and the reach of t
    if about_normal:
        e3x, e3y, e3z = 0.0, 0.0, 1.0
        cx, cy, cz = axis[0], axis[1], axis[2]
        delta, t_end = half_angle, half_pi
    else:
        e3x, e3y, e3z = axis[0], axis[1], axis[2]
        cx, cy, cz = 0.0, 0.0, 1.0
        delta, t_end = half_pi, half_angle
    # gamma between them, and e1 towards c (towards the mirror direction where there is no clip)
    clipped = delta < math.pi
    mx, mz = sin_n, cos_n  # mirror direction (mx, 0, mz)
    kx, ky, kz = e3y * cz - e3z * cy, e3z * cx - e3x * cz, e3x * cy - e3y * cx
    cross = math.sqrt(kx * kx + ky * ky + kz * kz)
    gamma = math.atan2(cross, e3x * cx + e3y * cy + e3z * cz)
    if not clipped or cross < 1e-150:
        cx, cy, cz = mx, 0.0, mz
    along = cx * e3x + cy * e3y + cz * e3z
    e1x, e1y, e1z = cx - along * e3x, cy - along * e3y, cz - along * e3z
    length = math.sqrt(e1x * e1x + e1y * e1y + e1z * e1z)
    if length < 1e-12:  # no azimuth is special: any e1 normal to e3 will do
        if abs(e3y) < 0.9:
            e1x, e1y, e1z = -e3y * e3x, 1.0 - e3y * e3y, -e3y * e3z
        else:
            e1x, e1y, e1z = 1.0 - e3x * e3x, -e3x * e3y, -e3x * e3z
        length = math.sqrt(e1x * e1x + e1y * e1y + e1z * e1z)
    e1x, e1y, e1z = e1x / length, e1y / length, e1z / length
    e2x, e2y, e2z = e3y * e1z - e3z * e1y, e3z * e1x - e3x * e1z, e3x * e1y - e3y * e1x
    # the lobe's centre in these coordinates
    m1, m2, m3 = mx * e1x + mz * e1z, mx * e2x + mz * e2z, mx * e3x + mz * e3z
    t_m, chi_m = math.atan2(math.hypot(m1, m2), m3), math.atan2(m2, m1)
    lobe = width < 10.0

    t_points = np.empty(160)
    n_t = 0
    tangents = (abs(gamma - delta), gamma + delta, 2.0 * math.pi - gamma - delta)
    if clipped:
        for tangent in tangents:
            n_t = _insert(t_points, n_t, tangent, 0.0, t_end)
    if lobe:
        n_t = _gather(t_points, n_t, t_m, width, t_end, 0.0, t_end)
        if clipped:  # where a boundary cuts through the lobe, its square root crosses the lobe within width^2
            for tangent in tangents:
                if abs(tangent - t_m) < 10.0 * width:
                    n_t = _gather(t_points, n_t, tangent, width * width, 3.0 * width, 0.0, t_end)
        if about_normal:  # the layer that the shadowing makes at the horizon, and the one that a grazing view makes
            n_t = _gather(t_points, n_t, half_pi, max(min(width, cos_n), 1e-9), 1.0, 0.0, t_end)
    count = 0
    chi_points = np.empty(160)
    for panel in range(n_t + 1):
        a = 0.0 if panel == 0 else t_points[panel - 1]
        b = t_end if panel == n_t else t_points[panel]
        smooth = True  # a boundary touches the ring at one of this panel's ends
        if clipped:
            for tangent in tangents:
                if abs(a - tangent) < 1e-13 or abs(b - tangent) < 1e-13:
                    smooth = False
        for i in range(x.size):
            if smooth:
                t, dt = a + (b - a) * x[i], (b - a) * w[i]
            else:
                t = a + (b - a) * x[i] * x[i] * (3.0 - 2.0 * x[i])
                dt = (b - a) * 6.0 * x[i] * (1.0 - x[i]) * w[i]
            st, ct = math.sin(t), math.cos(t)
            # the part of the ring inside the clipping cap
            whole, reach = True, math.pi
            if clipped:
                inside = math.sin(0.5 * (delta + t - gamma)) * math.sin(0.5 * (delta - t + gamma))
                beyond = math.sin(0.5 * (t + gamma + delta)) * math.sin(0.5 * (t + gamma - delta))
                if inside <= 0.0:
                    continue
                if beyond > 0.0:
                    whole = False
                    reach = 2.0 * math.atan2(math.sqrt(inside), math.sqrt(beyond))
            if symmetric:
                lower, upper = 0.0, reach
            elif whole:
                lower, upper = chi_m - math.pi, chi_m + math.pi
            else:
                lower, upper = -reach, reach
            n_chi = _insert(chi_points, 0, 0.5 * (lower + upper), lower, upper)
            if whole and not lobe:
                n_chi = _insert(chi_points, n_chi, lower + 0.25 * (upper - lower), lower, upper)
                n_chi = _insert(chi_points, n_chi, lower + 0.75 * (upper - lower), lower, upper)
            if lobe:
                if about_normal:
                    spread = (st - sin_n) ** 2 + (width * (ct + cos_n)) ** 2
                    scale = math.sqrt(spread / max(st * sin_n, 1e-30))
                else:
                    scale = math.sqrt((t - t_m) ** 2 + (width * max(cos_n, 1e-4)) ** 2) / max(st, 1e-30)
                scale = max(scale, 1e-10)
                n_chi = _gather(chi_points, n_chi, chi_m, scale, math.pi, lower, upper)
                if not whole:
                    n_chi = _gather(chi_points, n_chi, chi_m - 2.0 * math.pi, scale, math.pi, lower, upper)
                    n_chi = _gather(chi_points, n_chi, chi_m + 2.0 * math.pi, scale, math.pi, lower, upper)
                    if not about_normal:  # horizon of the surface
                        edge = max(min(width, cos_n), 1e-9) / max(st, 1e-30)
                        n_chi = _gather(chi_points, n_chi, upper, edge, reach, lower, upper)
                        if not symmetric:
                            n_chi = _gather(chi_points, n_chi, lower, edge, reach, lower, upper)
            if count + (n_chi + 1) * x.size > weights.size:
                return -1
            for piece in range(n_chi + 1):
                c0 = lower if piece == 0 else chi_points[piece - 1]
                c1 = upper if piece == n_chi else chi_points[piece]
                for j in range(x.size):
                    chi = c0 + (c1 - c0) * x[j]
                    u, v = st * math.cos(chi), st * math.sin(chi)
                    zi = u * e1z + v * e2z + ct * e3z
                    if zi <= 0.0:  # rounding at the horizon
                        continue
                    directions[count, 0] = u * e1x + v * e2x + ct * e3x
                    directions[count, 1] = u * e1y + v * e2y + ct * e3y
                    directions[count, 2] = zi
                    weight = st * dt * (c1 - c0) * w[j] * zi
                    weights[count] = 2.0 * weight if symmetric else weight
                    count += 1
    return count


cap_nodes = jit.kernel(_cap_nodes, fastmath=False)
