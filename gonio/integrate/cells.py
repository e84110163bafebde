r"""Cells of a cap of directions, cut along every plane in which an integrand may have an edge.

The surface's horizon, the rim of a source and the kinks that a BRDF declares are planes c . w = cos(delta), circles on the
sphere. In polar coordinates (t, chi) about a pole, a circle whose centre is gamma away crosses the ring t at

.. math:: \chi = \chi_c \pm 2\arctan\sqrt{\frac{\sin\frac{\delta+t-\gamma}{2}\,\sin\frac{\delta-t+\gamma}{2}}
                                            {\sin\frac{t+\gamma+\delta}{2}\,\sin\frac{t+\gamma-\delta}{2}}} .

Panels in t end where a circle touches a ring and where two circles meet; inside a panel the circles keep their order, and
the strip between two neighbours is a cell without edges. Where a circle touches, the substitution 3 s^2 - 2 s^3 takes the
square root out. Nothing here knows what is integrated.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gonio import jit

Array = NDArray[np.float64]
MOST_PLANES = 16
_GROWTH = 8.0  # of panels away from a square root outside them
_NEAR = 1e-9  # points that close outside a boundary count as on it

# Gauss-Kronrod 7, 15 (R. Piessens et al., QUADPACK, Springer 1983), on [0, 1]
_X = (0.991455371120812639206854697526329, 0.949107912342758524526189684047851, 0.864864423359769072789712788640926,
      0.741531185599394439863864773280788, 0.586087235467691130294144691693315, 0.405845151377397166906606412076961,
      0.207784955007898467600689403773245, 0.0)  # fmt: skip
_K = (0.022935322010529224963732008058970, 0.063092092629978553290700663189204, 0.104790010322250183839876322541518,
      0.140653259715525918745189590510238, 0.169004726639267902826583426598550, 0.190350578064785409913256402421014,
      0.204432940075298892414161999234649, 0.209482141084727828012999174891714)  # fmt: skip
_G = (0.0, 0.129484966168869693270611432679082, 0.0, 0.279705391489276667901467771423780, 0.0,
      0.381830050505118944950369775488975, 0.0, 0.417959183673469387755102040816327)  # fmt: skip
NODES = np.array([0.5 - 0.5 * x for x in _X] + [0.5 + 0.5 * x for x in _X[-2::-1]])
KRONROD = 0.5 * np.array(_K + _K[-2::-1])
GAUSS = 0.5 * np.array(_G + _G[-2::-1])

# columns of a base cell: panel in t, whether to take the square root out, then plane (-1: none), side and offset in chi of
# its lower and its upper edge
COLUMNS = 9


@jit.model
def reach(t, gamma, delta):  # type: ignore[no-untyped-def]
    """Half of the part of ring t inside a circle [rad]: 0 if none, pi if all."""
    inside = math.sin(0.5 * (delta + t - gamma)) * math.sin(0.5 * (delta - t + gamma))
    beyond = math.sin(0.5 * (t + gamma + delta)) * math.sin(0.5 * (t + gamma - delta))
    if inside <= 0.0:
        return 0.0
    if beyond <= 0.0:
        return math.pi
    return 2.0 * math.atan2(math.sqrt(inside), math.sqrt(beyond))


@jit.model
def _edge(t, circles, plane, side, offset):  # type: ignore[no-untyped-def]
    if plane < 0:
        return offset
    j = int(plane)
    return offset + circles[j, 2] + side * reach(t, circles[j, 0], circles[j, 1])


@jit.model
def _add(points, count, t, t_end):  # type: ignore[no-untyped-def]
    """Insert t into the sorted breakpoints if it is inside and new; returns the new count."""
    if not (t > 1e-13 * t_end and t < t_end * (1.0 - 1e-13)):
        return count
    k = count
    while k > 0 and points[k - 1] > t:
        k -= 1
    if (k > 0 and t - points[k - 1] < 1e-13 * t_end) or (k < count and points[k] - t < 1e-13 * t_end):
        return count
    for j in range(count, k, -1):
        points[j] = points[j - 1]
    points[k] = t
    return count + 1


@jit.model
def _allowed(x, y, z, axis, rim):  # type: ignore[no-untyped-def]
    return z >= -_NEAR and axis[0] * x + axis[1] * y + axis[2] * z >= rim - _NEAR


def _build(axis, half_angle, about_normal, planes, counts, frames, circles, cells, owner):  # type: ignore[no-untyped-def]
    """Fill the base cells of each element; how many, or -1 if they don't fit.

    `planes` (n, m, 4) holds c and delta, of which the first `counts` (n,) of an element count; with a clip, plane 0 is it.
    `frames` (n, 3, 3) receives e1, e2, e3 and `circles` (n, m, 3) gamma, delta and chi of the planes.
    """
    two_pi = 2.0 * math.pi
    total = 0
    room = 8 + 4 * planes.shape[1] * planes.shape[1]
    points, ends = np.empty(room + 40 * (8 + 4 * planes.shape[1])), np.empty(room + 2)
    touch = np.empty(8 + 4 * planes.shape[1])
    order = np.empty((2 * planes.shape[1] + 2, 4))
    rim = math.cos(half_angle)
    for k in range(axis.shape[0]):
        e = frames[k]
        if about_normal:
            e[2, 0], e[2, 1], e[2, 2] = 0.0, 0.0, 1.0
            t_end, clipped = 0.5 * math.pi, half_angle < math.pi
        else:
            e[2, 0], e[2, 1], e[2, 2] = axis[k, 0], axis[k, 1], axis[k, 2]
            t_end, clipped = half_angle, True
        # e1 is any direction normal to the pole
        if abs(e[2, 0]) < 0.6:
            sx, sy, sz = 1.0, 0.0, 0.0
        else:
            sx, sy, sz = 0.0, 1.0, 0.0
        along = sx * e[2, 0] + sy * e[2, 1] + sz * e[2, 2]
        sx, sy, sz = sx - along * e[2, 0], sy - along * e[2, 1], sz - along * e[2, 2]
        norm = math.sqrt(sx * sx + sy * sy + sz * sz)
        e[0, 0], e[0, 1], e[0, 2] = sx / norm, sy / norm, sz / norm
        e[1, 0] = e[2, 1] * e[0, 2] - e[2, 2] * e[0, 1]
        e[1, 1] = e[2, 2] * e[0, 0] - e[2, 0] * e[0, 2]
        e[1, 2] = e[2, 0] * e[0, 1] - e[2, 1] * e[0, 0]
        n_t, n_touch, m = 0, 0, counts[k]
        for j in range(m):
            c = planes[k, j]
            u = c[0] * e[0, 0] + c[1] * e[0, 1] + c[2] * e[0, 2]
            v = c[0] * e[1, 0] + c[1] * e[1, 1] + c[2] * e[1, 2]
            w = c[0] * e[2, 0] + c[1] * e[2, 1] + c[2] * e[2, 2]
            across = math.hypot(u, v)
            gamma, delta = math.atan2(across, w), c[3]
            chi = math.atan2(v, u) if across > 0.0 else 0.0
            circles[k, j, 0], circles[k, j, 1], circles[k, j, 2] = gamma, delta, chi
            for side in (-1.0, 1.0):  # where the circle touches a ring
                turn = gamma + side * delta
                h = math.sin(turn)
                x = h * (math.cos(chi) * e[0, 0] + math.sin(chi) * e[1, 0]) + math.cos(turn) * e[2, 0]
                y = h * (math.cos(chi) * e[0, 1] + math.sin(chi) * e[1, 1]) + math.cos(turn) * e[2, 1]
                z = h * (math.cos(chi) * e[0, 2] + math.sin(chi) * e[1, 2]) + math.cos(turn) * e[2, 2]
                t = abs(turn) if turn <= math.pi else two_pi - turn
                if (clipped and j == 0) or gamma <= 1e-9 or _allowed(x, y, z, axis[k], rim):
                    n_t = _add(points, n_t, t, t_end)
                    if gamma > 1e-9 and t > 1e-12:
                        touch[n_touch] = t
                        n_touch += 1
            for i in range(j):  # where two circles meet
                b = planes[k, i]
                dot = b[0] * c[0] + b[1] * c[1] + b[2] * c[2]
                det = 1.0 - dot * dot
                if det < 1e-14:
                    continue
                d_b, d_c = math.cos(b[3]), math.cos(c[3])
                f_b, f_c = (d_b - dot * d_c) / det, (d_c - dot * d_b) / det
                off = (1.0 - f_b * d_b - f_c * d_c) / det
                if off < 0.0:
                    continue
                off = math.sqrt(off)
                for side in (-1.0, 1.0):
                    x = f_b * b[0] + f_c * c[0] + side * off * (b[1] * c[2] - b[2] * c[1])
                    y = f_b * b[1] + f_c * c[1] + side * off * (b[2] * c[0] - b[0] * c[2])
                    z = f_b * b[2] + f_c * c[2] + side * off * (b[0] * c[1] - b[1] * c[0])
                    if _allowed(x, y, z, axis[k], rim):
                        u = x * e[0, 0] + y * e[0, 1] + z * e[0, 2]
                        v = x * e[1, 0] + y * e[1, 1] + z * e[1, 2]
                        w = x * e[2, 0] + y * e[2, 1] + z * e[2, 2]
                        n_t = _add(points, n_t, math.atan2(math.hypot(u, v), w), t_end)
        known = n_t
        ends[0], ends[n_t + 1] = 0.0, t_end
        for i in range(n_t):
            ends[i + 1] = points[i]
        for j in range(n_touch):  # a square root that begins just outside a long panel: grade that panel towards it
            for i in range(known + 2):
                if abs(ends[i] - touch[j]) < 1e-12:
                    for side in (-1, 1):
                        if 0 <= i + 2 * side <= known + 1:
                            step = _GROWTH * (ends[i + side] - ends[i])
                            while step != 0.0 and side * (ends[i + 2 * side] - ends[i] - step) > 0.0:
                                n_t = _add(points, n_t, ends[i] + step, t_end)
                                step *= _GROWTH
        for panel in range(n_t + 1):
            a = 0.0 if panel == 0 else points[panel - 1]
            b_end = t_end if panel == n_t else points[panel]
            eased = 0.0
            for j in range(n_touch):
                if abs(touch[j] - a) < 1e-12 or abs(touch[j] - b_end) < 1e-12:
                    eased = 1.0
            t = 0.5 * (a + b_end)
            width, first, base = math.pi, 0, 0.0
            if clipped:
                width = reach(t, circles[k, 0, 0], circles[k, 0, 1])
                base, first = circles[k, 0, 2], 1
                if width == 0.0:
                    continue
            # edges by rising azimuth relative to the clip's centre: position, plane, side, offset
            n_e = 0
            for j in range(first, m):
                half = reach(t, circles[k, j, 0], circles[k, j, 1])
                if half == 0.0 or half == math.pi:
                    continue
                for side in (-1.0, 1.0):
                    chi = circles[k, j, 2] + side * half
                    turns = -two_pi * math.floor((chi - base + math.pi) / two_pi)
                    at = chi + turns - base
                    if abs(at) >= width:
                        continue
                    i = n_e
                    while i > 0 and order[i - 1, 0] > at:
                        for q in range(4):
                            order[i, q] = order[i - 1, q]
                        i -= 1
                    order[i, 0], order[i, 1], order[i, 2], order[i, 3] = at, j, side, turns
                    n_e += 1
            if total + n_e + 3 > cells.shape[0]:
                return -1
            if width < math.pi or n_e == 0:
                parts = n_e + 1
            else:
                parts = n_e
            for i in range(parts):
                row = cells[total]
                row[0], row[1], row[2] = a, b_end, eased
                if width < math.pi:
                    if i == 0:
                        row[3], row[4], row[5] = 0, -1.0, 0.0
                    else:
                        row[3], row[4], row[5] = order[i - 1, 1], order[i - 1, 2], order[i - 1, 3]
                    if i == n_e:
                        row[6], row[7], row[8] = 0, 1.0, 0.0
                    else:
                        row[6], row[7], row[8] = order[i, 1], order[i, 2], order[i, 3]
                elif n_e == 0:
                    row[3], row[4], row[5] = -1, 0.0, base - math.pi
                    row[6], row[7], row[8] = -1, 0.0, base + math.pi
                else:
                    last = i == n_e - 1
                    j = 0 if last else i + 1
                    row[3], row[4], row[5] = order[i, 1], order[i, 2], order[i, 3]
                    row[6], row[7], row[8] = order[j, 1], order[j, 2], order[j, 3] + (two_pi if last else 0.0)
                owner[total] = k
                total += 1
    return total


def _place(cells, owner, circles, base, box, feature, widths, ways):  # type: ignore[no-untyped-def]
    """Which cells are too large for a feature near them: 1 split across t, 2 across chi, 3 both, 0 leave.

    `feature` (n, f, 2) holds t and chi of each element's features, `widths` (n, f) their half widths. A cell is to be
    split while it is larger than twice the width and nearer than half its size; a feature with t < 0 is everywhere.
    """
    two_pi = 2.0 * math.pi
    for r in range(base.size):
        row, k = cells[base[r]], owner[base[r]]
        t0, t1 = 0.0, 0.0
        low, high, breadth = 1e300, -1e300, 0.0
        for side in range(2):
            u = box[r, side]
            s = u * u * (3.0 - 2.0 * u) if row[2] > 0.0 else u
            t = row[0] + (row[1] - row[0]) * s
            lo = _edge(t, circles[k], row[3], row[4], row[5])
            hi = _edge(t, circles[k], row[6], row[7], row[8])
            low, high = min(low, lo + (hi - lo) * box[r, 2]), max(high, lo + (hi - lo) * box[r, 3])
            breadth = max(breadth, (hi - lo) * (box[r, 3] - box[r, 2]))
            if side == 0:
                t0 = t
            else:
                t1 = t
        ways[r] = 0
        for f in range(feature.shape[1]):
            t_f = feature[k, f, 0]
            largest = math.sin(min(max(0.5 * math.pi, t0), t1))
            # what the edges shift in chi from one end to the other shrinks with t
            extent_t, extent_chi = max(t1 - t0, (high - low - breadth) * largest), breadth * largest
            extent = max(extent_t, extent_chi)
            if extent <= 2.0 * widths[k, f]:
                continue
            d_t = max(0.0, max(t0 - t_f, t_f - t1))
            chi = feature[k, f, 1] - two_pi * math.floor((feature[k, f, 1] - 0.5 * (low + high) + math.pi) / two_pi)
            d_chi = max(0.0, max(low - chi, chi - high)) * min(math.sin(max(t_f, 0.0)), largest)
            if t_f < 0.0 or math.hypot(d_t, d_chi) <= 0.5 * extent:
                ways[r] |= 1 if extent_t > 3.0 * extent_chi else (2 if extent_chi > 3.0 * extent_t else 3)


@jit.model
def _turn(y):  # type: ignore[no-untyped-def]
    """sin and cos of an angle in [-pi, pi], from the series of its half; no branch and no call, so that loops vectorise."""
    x = 0.5 * y
    x2 = x * x
    odd = x * (1.0 + x2 * (-1 / 6 + x2 * (1 / 120 + x2 * (-1 / 5040 + x2 * (1 / 362880 + x2 * (-1 / 39916800 + x2 * (
        1 / 6227020800 + x2 * (-1 / 1307674368000 + x2 * (1 / 355687428096000 - x2 / 121645100408832000)))))))))  # fmt: skip
    even = 1.0 + x2 * (-1 / 2 + x2 * (1 / 24 + x2 * (-1 / 720 + x2 * (1 / 40320 + x2 * (-1 / 3628800 + x2 * (
        1 / 479001600 + x2 * (-1 / 87178291200 + x2 * (1 / 20922789888000 + x2 * (
        -1 / 6402373705728000 + x2 / 2432902008176640000)))))))))  # fmt: skip
    return 2.0 * odd * even, 1.0 - 2.0 * odd * odd


def _fill(cells, owner, circles, frames, base, box, x, directions, weights):  # type: ignore[no-untyped-def]
    """Nodes of each cell, 15 x 15: directions (c, 15, 15, 3) in the local frame, cos theta_i times the area element."""
    for r in range(base.size):
        row, k = cells[base[r]], owner[base[r]]
        e = frames[k]
        du, dv = box[r, 1] - box[r, 0], box[r, 3] - box[r, 2]
        for i in range(x.size):
            u = box[r, 0] + du * x[i]
            if row[2] > 0.0:
                s, ds = u * u * (3.0 - 2.0 * u), 6.0 * u * (1.0 - u)
            else:
                s, ds = u, 1.0
            t = row[0] + (row[1] - row[0]) * s
            dt = (row[1] - row[0]) * ds * du
            lo = _edge(t, circles[k], row[3], row[4], row[5])
            hi = _edge(t, circles[k], row[6], row[7], row[8])
            st, ct = math.sin(t), math.cos(t)
            area = st * dt * max(0.0, hi - lo) * dv
            middle, spread = lo + (hi - lo) * (box[r, 2] + 0.5 * dv), (hi - lo) * dv
            a, b = st * math.cos(middle), st * math.sin(middle)
            x0, y0, z0 = a * e[0, 0] + b * e[1, 0], a * e[0, 1] + b * e[1, 1], a * e[0, 2] + b * e[1, 2]
            x1, y1, z1 = a * e[1, 0] - b * e[0, 0], a * e[1, 1] - b * e[0, 1], a * e[1, 2] - b * e[0, 2]
            x2, y2, z2 = ct * e[2, 0], ct * e[2, 1], ct * e[2, 2]
            for j in range(x.size):
                sine, cosine = _turn(spread * (x[j] - 0.5))
                z = cosine * z0 + sine * z1 + z2
                directions[r, i, j, 0] = cosine * x0 + sine * x1 + x2
                directions[r, i, j, 1] = cosine * y0 + sine * y1 + y2
                directions[r, i, j, 2] = z
                weights[r, i, j] = area * z if z > 0.0 else 0.0


def _sums(values, weights, out):  # type: ignore[no-untyped-def]
    """Sums of values (c, 15, 15) over each cell by both rules, by the coarser along t, and by the coarser along chi."""
    for r in range(values.shape[0]):
        best = along = across = 0.0
        for i in range(KRONROD.size):
            row = coarse = 0.0
            for j in range(KRONROD.size):
                term = values[r, i, j] * weights[r, i, j]
                row += KRONROD[j] * term
                coarse += GAUSS[j] * term
            best += KRONROD[i] * row
            along += GAUSS[i] * row
            across += KRONROD[i] * coarse
        out[0, r], out[1, r], out[2, r] = best, along, across


build = jit.kernel(_build, fastmath=False)
place = jit.kernel(_place, fastmath=False)
fill = jit.kernel(_fill, fastmath=False)
sums = jit.kernel(_sums, fastmath=False)
