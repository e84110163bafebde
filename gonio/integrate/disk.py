r"""Small uniform disks that neither the lobe nor, unless it cuts the disk, the surface's horizon comes close to.

A disk that is seen whole takes nodes about its centre, the same for all gradients, from rules that integrate polynomials
up to some degree d exactly: products of Gauss or Radau nodes in :math:`1-\cos t` and equal steps in azimuth, and one of 12
nodes for degree 7 [1]_. The nearest singularities are complex: a lobe's, and that of the layer at the horizon. With rho of
the ellipse about the disk's diameter that goes through them [2]_, and g half of the spread of f_r over its mean at the
nodes, the relative error of such a rule is at most

.. math:: 50\,\max\bigl((1.25/\rho)^{d+1},\ g^d \max(g, \sin\delta/\cos\theta_i)\bigr)

for all models without kinks, found by trial (tests/property/test_disks.py); for Phong's lobe, which is not bent near the
horizon and falls like an exponential, g^d is :math:`(\kappa/2)^d/(d+1)!` with kappa half of the spread of ln f_r. So the
first rule is the least one that cannot miss anything, and its own nodes tell whether it is enough; where they tell nothing,
or where the BRDF has kinks somewhere, one compiled loop climbs from rule to rule until two agree. A sum next to nothing is
the far tail of a lobe, or looks so: f_r where the disk is nearest to the lobe decides (`gonio.integrate.tails`).

A disk that the horizon cuts is, seen from its centre in gnomonic projection, a segment of a circle: points
:math:`\rho(\cos\psi, s\sin\psi)` with psi from 0 to the horizon and s in [-1, 1], without a singularity.

Disks that a kink of the BRDF cuts go to `gonio.integrate.cut_disk`. Gradients for which no rule is fine enough are left to
`gonio.integrate.quadrature`: a rule that could miss a lobe is never asked.

References
----------
.. [1] A. H. Stroud, Approximate Calculation of Multiple Integrals, Prentice-Hall, 1971, section 3.12 (products for disks)
   and the rule S2: 7-1.
.. [2] L. N. Trefethen, Approximation Theory and Approximation Practice, SIAM, 2013, chapter 8 (Bernstein's ellipses).
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from gonio import jit
from gonio.brdf.base import Term
from gonio.brdf.elementary import exp, sine_and_cosine
from gonio.integrate import cut_disk
from gonio.integrate.cap import unit_rule
from gonio.integrate.closed_forms import collimated
from gonio.integrate.cut_disk import crosses
from gonio.integrate.grid import BLOCK, Gradients, block
from gonio.integrate.model_sums import over_nodes, over_rule, sum_over_nodes, sums_over_rule
from gonio.integrate.tails import UNDERFLOW, most_in_disk
from gonio.source import Cap, Collimated

Array = NDArray[np.float64]
EPS = float(np.finfo(float).eps)
LARGEST = 0.35  # half angle [rad]
_GAUSS = {3: (1, 4), 23: (6, 24), 35: (9, 36), 51: (13, 52)}  # degree: nodes along the radius, around the centre
_RADAU = {5: (1, 6), 9: (2, 10), 13: (3, 14), 17: (4, 18)}  # the centre too
_DEGREES = (3, 5, 7, 9, 13, 17, 23, 35, 51)
_CUT = (4, 8, 12, 16, 24)  # nodes along either coordinate of a segment, the first along one only
_FINER = 0.5  # least distance, of a lobe from a segment, in half angles
_FLAT = 0.5  # spread below which the agreement of two rules is none by chance
_SAFETY = 64.0  # of the bound
_MARGIN = 1.25  # of 1 / rho, in the bound
_NOTHING = 1e-60  # of the solid angle: the far tail of a lobe, of which no digits are asked
_FAINT = 1e-16  # of the largest value of a map: the same
_OF_ATOL = 0.25  # of an absolute tolerance, where one is given: the same
_PROBES = 512  # gradients by which that value is known


def _flat(degree: int) -> tuple[Array, Array, Array]:
    """Nodes x, y of a rule on the unit disk, and weights whose sum is 1."""
    if degree == 7:
        root = math.sqrt(29.0)
        near, far = math.sqrt((27.0 - 3.0 * root) / 104.0), math.sqrt((27.0 + 3.0 * root) / 104.0)
        on, sign = math.sqrt(0.75), np.array([1.0, 1.0, -1.0, -1.0])
        x = np.concatenate((near * sign, far * sign, [on, -on, 0.0, 0.0]))
        y = np.concatenate((near * np.roll(sign, 1), far * np.roll(sign, 1), [0.0, 0.0, on, -on]))
        return x, y, np.repeat((551.0 + 41.0 * root, 551.0 - 41.0 * root, 464.0), 4) / 6264.0
    if degree in _GAUSS:
        radial, around = _GAUSS[degree]
        r2, w = unit_rule(radial)
    else:
        radial, around = _RADAU[degree]
        nodes = np.sort(legendre.legroots(np.append(np.zeros(radial), (1.0, 1.0))))
        nodes[0] = -1.0
        first = np.append(1.0, np.zeros(radial))  # integrals of Legendre's polynomials over [-1, 1], halved
        w = np.linalg.solve(legendre.legvander(nodes, radial).T, first)
        r2 = 0.5 * (nodes + 1.0)
    rings = range(len(r2) - radial, len(r2))
    chi = 2.0 * np.pi * (np.arange(around) + 0.5 * (np.arange(radial)[:, None] % 2)) / around
    r = np.sqrt(r2[rings])[:, None]
    x, y = (r * np.cos(chi)).ravel(), (r * np.sin(chi)).ravel()
    weights = np.repeat(w[rings] / around, around)
    if len(r2) > radial:
        x, y, weights = np.append(x, 0.0), np.append(y, 0.0), np.append(weights, w[0])
    return x, y, weights


@functools.cache
def _nodes(half_angle: float) -> tuple[Array, NDArray[np.int64]]:
    """All rules one after another: rows cos t, sin t cos chi, sin t sin chi, weight [sr]; and where each starts."""
    versed = 2.0 * math.sin(0.5 * half_angle) ** 2  # 1 - cos
    rows, starts = [], [0]
    for degree in _DEGREES:
        x, y, weight = _flat(degree)
        v = versed * (x * x + y * y)
        stretch = np.sqrt(versed * (2.0 - v))  # sin t / r
        rows.append(np.stack((1.0 - v, stretch * x, stretch * y, 2.0 * np.pi * versed * weight)))
        starts.append(starts[-1] + len(x))
    return np.ascontiguousarray(np.concatenate(rows, axis=1)), np.array(starts)


def suits(term: Term, cap: Cap) -> bool:
    """Whether `add` can do most gradients."""
    return cap.half_angle <= LARGEST and cap.profile is None and term.mirror_only and not term.model.own


def add(
    term: Term, cap: Cap, gradients: Gradients, tile: tuple[int, int], rtol: float, floor: float, value: Array, error: Array
) -> tuple[float, int, NDArray[np.intp]]:
    """Add value and error on one tile; returns the largest relative error, the evaluations and what is left to do.

    Parameters
    ----------
    term : Term
    cap : Cap
        A disk for which `suits` holds.
    gradients : Gradients
    tile : (start, stop)
    rtol, floor : float
        Tolerance: relative, and of the integral of f_r cos theta_i [1], as by `negligible`.
    value, error : ndarray, shape (n,)
        Of all gradients.
    """
    nodes, starts = _nodes(cap.half_angle)
    x, w, cuts = _segment_nodes()
    left, crossed = np.empty((2, tile[1] - tile[0]), dtype=np.int64)
    counts = np.zeros(3, dtype=np.int64)
    planes = term.kinks(gradients.elements(*tile).viewer()) if term.kinked else np.empty((0, 0, 4))
    function, rough = term.model.function, term.model.kinks is not None or term.model.pieces
    worst = _disks(
        gradients.p, gradients.q, *tile, np.array(cap.axis), cap.half_angle, cap.radiance * term.weight,
        term.lobe_width() or 10.0, term.layer_width(), over_nodes(function), over_rule(function), term.values, nodes, starts,
        np.array(_DEGREES), _reaches(rtol), x, w, cuts, planes, rough, term.model.shadowed, rtol, floor, value,
        error, left, crossed, counts,
    )  # fmt: skip
    rest, nodes_used = left[: counts[0]].astype(np.intp), int(counts[1])
    if counts[2]:
        some = crossed[: counts[2]]
        nothing = _NOTHING * math.pi * math.sin(cap.half_angle) ** 2
        at_cuts, more, missed = cut_disk.add(term, cap, gradients, some, planes[some - tile[0]], rtol, nothing, value, error)
        rest = np.sort(np.concatenate((rest, missed)))
        worst, nodes_used = max(worst, at_cuts), nodes_used + more
    return float(worst), nodes_used, rest


def negligible(term: Term, cap: Cap, gradients: Gradients, atol: float) -> tuple[float, bool]:
    """What of the integral of f_r cos theta_i [1] is nothing, and whether next to `atol` or the largest of many gradients.

    Otherwise it is nothing by itself, and counts where no gradient is brighter. `atol` is one of radiance.
    """
    solid = math.pi * math.sin(cap.half_angle) ** 2
    scale = abs(cap.radiance * term.weight)
    if scale > 0.0 and _OF_ATOL * atol > _NOTHING * solid * scale:
        return _OF_ATOL * atol / scale, True
    if gradients.size < _PROBES:
        return _NOTHING * solid, False
    some = gradients.select(np.arange(0, gradients.size, gradients.size // _PROBES)).elements()
    brightest, _ = collimated(term, Collimated(cap.axis, 1.0), some)
    # a disk wider than the lobe gets less than that, and no surface reflects more than all
    faint = _FAINT * min(solid * float(np.max(brightest)), abs(term.weight))
    return max(_NOTHING * solid, faint), faint > _NOTHING * solid


@functools.cache
def _reaches(rtol: float) -> Array:
    """Largest 1.25 / rho up to which each rule does."""
    return np.array([(0.25 * rtol / _SAFETY) ** (1.0 / (degree + 1.0)) for degree in _DEGREES])


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


@jit.model
def inverse(real, imaginary, sine):  # type: ignore[no-untyped-def]
    """1 / rho of the ellipse (Bernstein's) about [-sine, sine] through a complex point."""
    x, y = real / sine, imaginary / sine
    a = 0.5 * (math.sqrt((x - 1.0) ** 2 + y * y) + math.sqrt((x + 1.0) ** 2 + y * y))
    return 1.0 / (a + math.sqrt(max(0.0, a * a - 1.0)))


@jit.model
def small(g, sun, degree, bound, exponential):  # type: ignore[no-untyped-def]
    """Whether g^degree max(g, sun), with a factorial for exponentials, is not above the bound."""
    if exponential:
        power = max(g, 2.0 * (degree + 1) * sun) / (2.0 * (degree + 1))
        for k in range(degree):
            power *= 0.5 * g / (k + 1.0)
        return 2.0 * power <= bound
    if not g < 1.0:
        return False
    power = max(g, sun)
    for _ in range(degree):
        power *= g
    return power <= bound


def _segment_rule(  # type: ignore[no-untyped-def]
    ax, ay, az, s, c, half_angle, layer, near, weigh, parameters, x, w, cuts, rtol, floor, some, counts
):
    """Integral over a disk that the horizon cuts, and its error beyond rtol; negative if the rules don't agree."""
    # e points up the disk, away from the horizon; f along it
    up = math.sqrt(1.0 - az * az)
    ex, ey, ez = -ax * az / up, -ay * az / up, up
    fx, fy = ay * ez - az * ey, az * ex - ax * ez
    rho = math.tan(half_angle)
    end = math.acos(min(max(-az / (up * rho), -1.0), 1.0))
    width = min(layer / (rho * up * max(math.sin(end), 1e-3)), 10.0)  # of the horizon's layer, in psi
    reach = math.asinh(end / width)
    first = 0  # along the lines that are parallel to the horizon only the lobe counts
    while first < cuts.size - 2 and 64.0 * near ** (2.0 * (cuts[first + 1] - cuts[first])) > 0.25 * rtol:
        first += 1
    before = earlier = -1.0
    for level in range(1, cuts.size - 1):
        n, begin = cuts[level + 1] - cuts[level], cuts[min(first + level - 1, cuts.size - 2)]
        m = cuts[min(first + level, cuts.size - 1)] - begin
        at = 0
        for i in range(n):
            e = exp(reach * x[cuts[level] + i])
            sin_psi, cos_psi = sine_and_cosine(end - 0.5 * width * (e - 1.0 / e))
            across = rho * sin_psi
            some[4, i], some[5, i] = rho * cos_psi, across
            some[6, i] = width * (e + 1.0 / e) * reach * w[cuts[level] + i] * across * across
        for i in range(n):
            u, across, weight = some[4, i], some[5, i], some[6, i]
            bx, by, bz = ax + u * ex, ay + u * ey, az + u * ez
            some_u = 1.0 + u * u
            for j in range(m):
                v = across * (2.0 * x[begin + j] - 1.0)
                r = 1.0 / math.sqrt(some_u + v * v)
                some[0, at + j], some[1, at + j] = (bx + v * fx) * r, (by + v * fy) * r
                zi = bz * r
                zi = zi if zi > 1e-300 else 1e-300
                some[2, at + j], some[3, at + j] = zi, weight * w[begin + j] * (r * r * r) * zi
            at += m
        total = sum_over_nodes(weigh, some, at, s, c, parameters)
        counts[1] += at
        dim = total <= 0.01 * floor
        if dim:
            sine, cosine = math.sin(half_angle), math.cos(half_angle)
            most = most_in_disk(weigh, ax, ay, az, s, c, sine, cosine, True, some, parameters)
            if most <= floor:
                return total, max(most, UNDERFLOW)
        if before >= 0.0:
            step = abs(total - before)
            estimate = 2.0 * step
            if earlier >= 0.0:
                estimate = max(step, 0.01 * abs(before - earlier))
            if total > 0.0 and estimate <= 0.25 * rtol * total:
                return total, 0.0
            if not dim and estimate <= 0.1 * floor:
                return total, floor
        earlier, before = before, total
    return -1.0, 0.0


_segment = jit.part(_segment_rule, fastmath=jit.FAST)


def _all_disks(  # type: ignore[no-untyped-def]
    p, q, start, stop, axis, half_angle, scale, width, depth, weigh, apply, parameters, nodes, starts, degrees, reaches, x,
    w, cuts, planes, rough, shadowed, rtol, floor, value, error, left, crossed, counts,
):  # fmt: skip
    worst, rules, kinks = 0.0, degrees.size, planes.shape[1]
    dx, dy, dz = axis[0], axis[1], axis[2]
    sine, cosine = math.sin(half_angle), math.cos(half_angle)
    bound = 0.25 * rtol / _SAFETY
    flat = np.empty((7, _CUT[-1] ** 2))
    solid = 4.0 * math.pi * math.sin(0.5 * half_angle) ** 2
    g, now = np.empty((11, BLOCK)), np.empty((11, BLOCK))  # axis and tangents in the local frame, sin, cos theta_n
    out = np.empty((3, BLOCK))
    sums, most, least = out[0], out[1], out[2]
    nearness, chosen = np.empty(BLOCK), np.empty(BLOCK, dtype=np.int64)
    level, history = np.empty(BLOCK, dtype=np.int64), np.empty((2, BLOCK))
    row = np.empty((6, BLOCK))
    begin, size = start, 0
    while begin + size < stop:
        begin += size
        size = block(p, q, begin, stop, row)
        lowest = rules
        for k in range(size):
            c, s, cf, sf = row[0, k], row[1, k], row[2, k], row[3, k]
            along = dx * cf + dy * sf
            ax, ay, az = along * c - dz * s, dy * cf - dx * sf, along * s + dz * c
            level[k] = rules
            if az <= -sine:
                continue
            # distance of the lobe from the disk's axis, real and imaginary; a grazing view's is a streak
            off, across = math.hypot(ax - s, ay), width * (az + c)
            layer = min(depth, c) if shadowed and (width < 10.0 or kinks > 0) else 1.0
            lobe = 0.6 * half_angle
            if width < 10.0:
                lobe = max(lobe, _MARGIN * inverse(off, across, sine))
            near = max(lobe, _MARGIN * inverse(az, layer, sine))
            cut = False
            for j in range(kinks):
                plane = planes[begin + k - start, j]
                cut = cut or crosses(plane[0], plane[1], plane[2], plane[3], ax, ay, az, sine, cosine)
            if cut or az <= sine:
                far = math.hypot(off, across) * _FINER / half_angle
                if cut and far > 1.0:
                    crossed[counts[2]] = begin + k
                    counts[2] += 1
                    continue
                total, faint = -1.0, 0.0
                if not cut and far > 1.0 and layer > 0.02 * half_angle and az > -0.99999 * sine:
                    total, faint = _segment(
                        ax, ay, az, s, c, half_angle, layer, lobe, weigh, parameters, x, w, cuts, rtol, floor, flat, counts
                    )
                if total < 0.0:
                    left[counts[0]] = begin + k
                    counts[0] += 1
                else:
                    height = min(az + sine, sine)
                    relative = 0.5 * rtol + EPS * (16.0 + 16.0 / width + 16.0 / height)
                    value[begin + k] += scale * total
                    error[begin + k] += scale * (relative * total + faint)
                    worst = max(worst, relative)
                continue
            first = 0
            while first < rules and near > reaches[first]:
                first += 1
            if first == rules:
                left[counts[0]] = begin + k
                counts[0] += 1
                continue
            level[k], nearness[k] = first, near
            lowest = min(lowest, first)
            history[0, k] = history[1, k] = -1.0
            g[0, k], g[1, k], g[2, k] = ax, ay, az
            g[3, k], g[4, k], g[5, k], g[6, k], g[7, k], g[8, k] = tangents(ax, ay, az)
            g[9, k], g[10, k] = s, c
        for rule in range(lowest, rules):
            m = 0
            for k in range(size):
                if level[k] == rule:
                    chosen[m] = k
                    m += 1
            if m == 0:
                continue
            for r in range(11):
                for i in range(m):
                    now[r, i] = g[r, chosen[i]]
            sums_over_rule(apply, now, m, nodes, starts[rule], starts[rule + 1], parameters, out)
            counts[1] += m * (starts[rule + 1] - starts[rule])
            for i in range(m):
                k, total = chosen[i], sums[i]
                before, earlier = history[0, k], history[1, k]
                spread, low_sun = math.inf, sine / g[2, k]
                if shadowed and total > 0.0:
                    spread = 0.5 * solid * g[2, k] * (most[i] - least[i]) / total
                elif total > 0.0 and least[i] > 0.0:
                    spread = 0.5 * math.log(most[i] / least[i])
                good = not rough and nearness[k] <= reaches[rule]
                good = good and small(spread, low_sun, degrees[rule], bound, not shadowed)
                faint, dim = 0.0, total <= 0.01 * floor
                if dim and not good:
                    ax, ay, az, s, c = g[0, k], g[1, k], g[2, k], g[9, k], g[10, k]
                    faint = most_in_disk(weigh, ax, ay, az, s, c, sine, cosine, shadowed, flat, parameters)
                    good, faint = faint <= floor, max(faint, UNDERFLOW)
                if not good and before >= 0.0 and (earlier >= 0.0 or spread < _FLAT):  # two rough rules agree by chance
                    step = abs(total - before)
                    estimate = 2.0 * step if earlier < 0.0 else max(step, 0.01 * abs(before - earlier))
                    good, faint = total > 0.0 and estimate <= 0.25 * rtol * total, 0.0
                    if not good and not dim and estimate <= 0.1 * floor:
                        good, faint = True, floor
                history[0, k], history[1, k] = total, before
                if good:
                    relative = 0.5 * rtol + EPS * (16.0 + 16.0 / width + 4.0 / g[2, k])
                    value[begin + k] += scale * total
                    error[begin + k] += scale * (relative * total + faint)
                    worst = max(worst, relative)
                elif rule == rules - 1:
                    left[counts[0]] = begin + k
                    counts[0] += 1
                else:
                    following = rule + 1
                    while (
                        not rough
                        and (spread < _FLAT or (not shadowed and spread < 30.0))
                        and following < rules - 1
                        and not small(spread, low_sun, degrees[following], bound, not shadowed)
                    ):
                        following += 1
                    level[k] = following
    return worst


_disks = jit.kernel(_all_disks)
