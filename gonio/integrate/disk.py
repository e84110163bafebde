r"""Small uniform disks that neither the lobe nor, unless it cuts the disk, the surface's horizon comes close to.

A disk that is seen whole takes products of Gauss-Legendre nodes in :math:`1-\cos t` and equal steps in azimuth about its
centre: polynomials of the tangential coordinates up to some degree are integrated exactly [1]_, so a lobe or layer at a
distance l (where necessary a complex one) leaves an error of order (half angle / l)^(degree + 1). Nodes are the same for
all gradients; one compiled loop per model climbs from rule to rule until two agree.

A disk that the horizon cuts is, seen from its centre in gnomonic projection, a segment of a circle: points
:math:`\rho(\cos\psi, s\sin\psi)` with psi from 0 to the horizon and s in [-1, 1], without a singularity.

Disks that a kink of the BRDF cuts go to `gonio.integrate.cut_disk`. Gradients for which no rule is fine enough are left to
`gonio.integrate.quadrature`: a rule that could miss a lobe is never asked.

References
----------
.. [1] A. H. Stroud, Approximate Calculation of Multiple Integrals, Prentice-Hall, 1971, section 3.12 (products for disks).
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.brdf.base import Term
from gonio.integrate import cut_disk
from gonio.integrate.cap import unit_rule
from gonio.integrate.cut_disk import crosses
from gonio.integrate.grid import Gradients, cosines
from gonio.source import Cap

Array = NDArray[np.float64]
EPS = float(np.finfo(float).eps)
LARGEST = 0.35  # half angle [rad]
_RULES = ((1, 4), (2, 6), (3, 8), (4, 16), (6, 24), (9, 36), (13, 52))  # nodes along the radius, around the centre
_DEGREES = (3, 5, 7, 15, 23, 35, 51)
_CUT = (6, 9, 13, 19, 27)  # nodes along either coordinate of a segment
_FINER = 0.5  # least distance of a lobe or a horizon's layer, in half angles
_BLOCK = 256  # gradients whose sums advance together
_NOTHING = 1e-60  # of the solid angle: the far tail of a lobe, of which no digits are asked


@functools.cache
def _nodes(half_angle: float) -> tuple[Array, NDArray[np.int64]]:
    """All rules one after another: rows cos t, sin t cos chi, sin t sin chi, weight [sr]; and where each starts."""
    versed = 2.0 * math.sin(0.5 * half_angle) ** 2  # 1 - cos
    rows, starts = [], [0]
    for radial, around in _RULES:
        x, w = np.polynomial.legendre.leggauss(radial)
        v = 0.5 * versed * (x + 1.0)
        sine = np.sqrt(v * (2.0 - v))
        chi = 2.0 * np.pi * (np.arange(around)[None, :] + 0.5 * (np.arange(radial) % 2)[:, None]) / around
        weight = np.repeat(0.5 * versed * w * 2.0 * np.pi / around, around)
        c, s = sine[:, None] * np.cos(chi), sine[:, None] * np.sin(chi)
        rows.append(np.stack((np.repeat(1.0 - v, around), c.ravel(), s.ravel(), weight)))
        starts.append(starts[-1] + radial * around)
    return np.ascontiguousarray(np.concatenate(rows, axis=1)), np.array(starts)


def suits(term: Term, cap: Cap) -> bool:
    """Whether `add` can do most gradients."""
    return cap.half_angle <= LARGEST and cap.profile is None and term.mirror_only and not term.model.own


def add(
    term: Term, cap: Cap, gradients: Gradients, tile: tuple[int, int], rtol: float, value: Array, error: Array
) -> tuple[float, int, NDArray[np.intp]]:
    """Add value and error on one tile; returns the largest relative error, the evaluations and what is left to do.

    Parameters
    ----------
    term : Term
    cap : Cap
        A disk for which `suits` holds.
    gradients : Gradients
    tile : (start, stop)
    rtol : float
    value, error : ndarray, shape (n,)
        Of all gradients.
    """
    nodes, starts = _nodes(cap.half_angle)
    x, w, cuts = _segment_nodes()
    left, crossed = np.empty((2, tile[1] - tile[0]), dtype=np.int64)
    counts = np.zeros(3, dtype=np.int64)
    kinked = term.model.kinks is not None
    planes = term.kinks(gradients.elements(*tile).viewer()) if kinked else np.empty((0, 0, 4))
    floor = _NOTHING * math.pi * math.sin(cap.half_angle) ** 2
    worst = _kernel(term.model.function)(
        gradients.p, gradients.q, *tile, np.array(cap.axis), cap.half_angle, cap.radiance * term.weight,
        term.lobe_width() or 10.0, term.layer_width(), term.values, nodes, starts, np.array(_DEGREES, dtype=float),
        x, w, cuts, planes, rtol, floor, value, error, left, crossed, counts,
    )  # fmt: skip
    rest, nodes_used = left[: counts[0]].astype(np.intp), int(counts[1])
    if counts[2]:
        some = crossed[: counts[2]]
        at_cuts, more, missed = cut_disk.add(term, cap, gradients, some, planes[some - tile[0]], rtol, floor, value, error)
        rest = np.sort(np.concatenate((rest, missed)))
        worst, nodes_used = max(worst, at_cuts), nodes_used + more
    return float(worst), nodes_used, rest


@functools.cache
def _segment_nodes() -> tuple[Array, Array, NDArray[np.int64]]:
    """Gauss-Legendre nodes and weights on [0, 1] for the orders of `_CUT`, one after another; and where each starts."""
    rules = [unit_rule(order) for order in _CUT]
    starts = np.concatenate(([0], np.cumsum(_CUT)))
    return np.concatenate([x for x, _ in rules]), np.concatenate([w for _, w in rules]), starts.astype(np.int64)


@jit.model
def tangents(ax, ay, az):  # type: ignore[no-untyped-def]
    """Two unit vectors normal to a third and to each other."""
    if abs(ax) < 0.9:
        r = 1.0 / math.sqrt(1.0 - ax * ax)
        ex, ey, ez = (1.0 - ax * ax) * r, -ax * ay * r, -ax * az * r
    else:
        r = 1.0 / math.sqrt(1.0 - ay * ay)
        ex, ey, ez = -ay * ax * r, (1.0 - ay * ay) * r, -ay * az * r
    return ex, ey, ez, ay * ez - az * ey, az * ex - ax * ez, ax * ey - ay * ex


@functools.cache
def _kernel(function: Any) -> Any:
    @jit.model
    def segment(  # type: ignore[no-untyped-def]
        ax, ay, az, s, c, half_angle, layer, parameters, x, w, cuts, rtol, floor, counts
    ):
        """Integral over a disk that the horizon cuts; negative if the rules don't agree."""
        # e points up the disk, away from the horizon; f along it
        up = math.sqrt(1.0 - az * az)
        ex, ey, ez = -ax * az / up, -ay * az / up, up
        fx, fy = ay * ez - az * ey, az * ex - ax * ez
        rho = math.tan(half_angle)
        end = math.acos(min(max(-az / (up * rho), -1.0), 1.0))
        width = min(layer / (rho * up * max(math.sin(end), 1e-3)), 10.0)  # of the horizon's layer, in psi
        reach = math.asinh(end / width)
        before = earlier = -1.0
        for level in range(cuts.size - 1):
            total = 0.0
            begin, n = cuts[level], cuts[level + 1] - cuts[level]
            some_x, some_w = x[begin : begin + n], w[begin : begin + n]
            for i in range(n):
                e = math.exp(reach * some_x[i])
                psi = end - 0.5 * width * (e - 1.0 / e)
                weight = 0.5 * width * (e + 1.0 / e) * reach * some_w[i]
                across = rho * math.sin(psi)
                u = rho * math.cos(psi)
                weight *= 2.0 * across * across
                line = 0.0
                for j in range(n):
                    v = across * (2.0 * some_x[j] - 1.0)
                    r = 1.0 / math.sqrt(1.0 + u * u + v * v)
                    zi = (az + u * ez) * r
                    lit = zi > 0.0
                    f = function(
                        (ax + u * ex + v * fx) * r, (ay + u * ey + v * fy) * r, zi if lit else 1.0, -s, 0.0, c, parameters
                    )
                    line += some_w[j] * r * r * r * f * (zi if lit else 0.0)
                total += weight * line
            counts[1] += n * n
            if before >= 0.0:
                step = abs(total - before)
                estimate = 2.0 * step
                if earlier >= 0.0:
                    estimate = max(step, 0.01 * abs(before - earlier))
                if estimate <= max(0.25 * rtol * total, floor):
                    return total
            earlier, before = before, total
        return -1.0

    def disks(  # type: ignore[no-untyped-def]
        p, q, start, stop, axis, half_angle, scale, width, depth, parameters, nodes, starts, degrees, x, w, cuts, planes,
        rtol, floor, value, error, left, crossed, counts,
    ):  # fmt: skip
        columns, worst, rules, kinks = p.shape[1], 0.0, degrees.size, planes.shape[1]
        dx, dy, dz = axis[0], axis[1], axis[2]
        sine, cosine = math.sin(half_angle), math.cos(half_angle)
        g, now = np.empty((11, _BLOCK)), np.empty((11, _BLOCK))  # axis and tangents in the local frame, sin, cos theta_n
        sums, chosen = np.empty(_BLOCK), np.empty(_BLOCK, dtype=np.int64)
        level, history = np.empty(_BLOCK, dtype=np.int64), np.empty((2, _BLOCK))
        for block in range(start, stop, _BLOCK):
            size = min(_BLOCK, stop - block)
            for k in range(size):
                i = (block + k) // columns
                c, s, cf, sf = cosines(p[i, block + k - i * columns], q[i, block + k - i * columns])
                along = dx * cf + dy * sf
                ax, ay, az = along * c - dz * s, dy * cf - dx * sf, along * s + dz * c
                level[k] = rules
                history[0, k] = history[1, k] = -1.0
                if az <= -sine:
                    continue
                # squared distances from the axis: of the lobe, |m - axis|, and of the horizon's layer
                lobe = (ax - s) ** 2 + ay * ay + (az - c) ** 2 + (2.0 * width * c) ** 2
                layer = min(depth, c)
                if width >= 10.0:
                    lobe, layer = 1.0, c if kinks else 1.0
                far = math.sqrt(min(lobe, 1.0)) * _FINER / half_angle
                cut = False
                for j in range(kinks):
                    row = planes[block + k - start, j]
                    cut = cut or crosses(row[0], row[1], row[2], row[3], ax, ay, az, sine, cosine)
                if cut and far > 1.0:
                    crossed[counts[2]] = block + k
                    counts[2] += 1
                    continue
                if cut:
                    left[counts[0]] = block + k
                    counts[0] += 1
                    continue
                if az <= sine:
                    total = -1.0
                    if far > 1.0 and layer > 0.02 * half_angle and az > -0.99999 * sine:
                        total = segment(ax, ay, az, s, c, half_angle, layer, parameters, x, w, cuts, rtol, floor, counts)
                    if total < 0.0:
                        left[counts[0]] = block + k
                        counts[0] += 1
                    else:
                        height = min(az + sine, sine)
                        relative = 0.5 * rtol + EPS * (16.0 + 16.0 / width + 16.0 / height)
                        value[block + k] += scale * total
                        error[block + k] += scale * max(relative * total, floor)
                        worst = max(worst, relative)
                    continue
                far = math.sqrt(min(lobe, az * az + layer * layer)) * _FINER / half_angle
                if far < 1.0:
                    left[counts[0]] = block + k
                    counts[0] += 1
                    continue
                # the first rule that can't miss anything: (half angle / distance)^(degree + 1) well below 1
                first = 0
                while first < rules - 2 and far ** (degrees[first] + 1.0) < 100.0:
                    first += 1
                level[k] = first
                g[0, k], g[1, k], g[2, k] = ax, ay, az
                g[3, k], g[4, k], g[5, k], g[6, k], g[7, k], g[8, k] = tangents(ax, ay, az)
                g[9, k], g[10, k] = s, c
            for rule in range(rules):
                m = 0
                for k in range(size):
                    if level[k] == rule:
                        chosen[m] = k
                        for r in range(11):
                            now[r, m] = g[r, k]
                        m += 1
                some = sums[:m]
                some[:] = 0.0
                ax_, ay_, az_, s_, c_ = now[0, :m], now[1, :m], now[2, :m], now[9, :m], now[10, :m]
                ex_, ey_, ez_, fx_, fy_, fz_ = now[3, :m], now[4, :m], now[5, :m], now[6, :m], now[7, :m], now[8, :m]
                if m > 0:
                    for j in range(starts[rule], starts[rule + 1]):
                        t, u, v, weight = nodes[0, j], nodes[1, j], nodes[2, j], nodes[3, j]
                        for k in range(m):
                            zi = t * az_[k] + u * ez_[k] + v * fz_[k]
                            xi, yi = t * ax_[k] + u * ex_[k] + v * fx_[k], t * ay_[k] + u * ey_[k] + v * fy_[k]
                            some[k] += weight * zi * function(xi, yi, zi, -s_[k], 0.0, c_[k], parameters)
                counts[1] += m * (starts[rule + 1] - starts[rule])
                for i in range(m):
                    k, total = chosen[i], sums[i]
                    before, earlier = history[0, k], history[1, k]
                    estimate = math.inf
                    if before >= 0.0:
                        step = abs(total - before)
                        estimate = 2.0 * step if earlier < 0.0 else max(step, 0.01 * abs(before - earlier))
                    history[0, k], history[1, k] = total, before
                    if estimate <= max(0.25 * rtol * total, floor):
                        relative = 0.5 * rtol + EPS * (16.0 + 16.0 / width + 4.0 / g[2, k])
                        value[block + k] += scale * total
                        error[block + k] += scale * max(relative * total, floor)
                        worst = max(worst, relative)
                        level[k] = rules
                    elif rule == rules - 1:
                        left[counts[0]] = block + k
                        counts[0] += 1
                    else:
                        level[k] = rule + 1
        return worst

    return jit.kernel(disks)
