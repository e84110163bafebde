r"""Where the sums of `ring_kernel` are taken: panels of theta, and nodes in azimuth on half a ring.

Panels grow from the features: the lobe and other peaks in the plane of incidence, the horizon and its layer of shadowing,
kinks, the rows of a map. A lobe of half width w in half-vector angle has its poles, on the ring theta, at
:math:`D = \pm 2i\,\mathrm{asinh}\,e`,
:math:`4e^2\sin\frac\theta2\sin\theta_n = w^2 + 4\sin^2\frac{\theta/2-\theta_n}{2}` (exact for GGX up to the definition of w,
from :math:`\cos\theta_h = \cos\frac\theta2\cos\theta_n+\sin\frac\theta2\sin\theta_n\cos D`). A Gauss rule of q nodes errs by
:math:`\rho^{-2q}` with rho of the ellipse through the nearest pole [1]_; q follows from it for every panel. On top come
nodes for the waves, half the degree n at which :math:`J_n(mh)` has died, to the digits that each wave, many being weak,
must have: along a ring for cos mD, across rings for what K_m turns as the ring's cut at the horizon or a kink moves. Towards
a ring that is only touched, where there is a square root, panels are graded on the side on which rings are crossed. So d
digits asked for are d digits, of the largest value at the slope, or two more where nothing is narrow.

References
----------
.. [1] L. N. Trefethen, Approximation Theory and Approximation Practice, SIAM, 2013, theorem 19.3.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray

from gonio import jit

Array = NDArray[np.float64]
LARGEST_ORDER = 96
CAPACITY = 4096  # breakpoints, besides the rows of a map
RING = 8192  # nodes of one ring, besides those for the waves
LANES = 16  # the nodes of a ring are filled up to a multiple of it with nodes of no weight, so that loops have no rest
_GROWTH = 6.0
_FIRST = 2.0  # length of the panel next to a feature, in units of the distance of its pole
_GRADE = 4.0  # growth of panels away from where a ring begins to be cut
_SMOOTH = 0.15  # nodes per radian and digit that a function without features takes


@functools.cache
def gauss_table() -> tuple[Array, Array]:
    """Nodes and weights on [0, 1] of all orders q = 1 to 96, that of order q starting at q (q - 1) / 2."""
    rules = [np.polynomial.legendre.leggauss(q) for q in range(1, LARGEST_ORDER + 1)]
    return np.concatenate([(x + 1.0) / 2.0 for x, _ in rules]), np.concatenate([w / 2.0 for _, w in rules])


@jit.part
def _insert(points, count, value, lower, upper):  # type: ignore[no-untyped-def]
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


@jit.part
def _insert_apart(points, count, value, apart, upper):  # type: ignore[no-untyped-def]
    """Insert a breakpoint if it is so far from its neighbours; returns the new count."""
    if value < apart or value > upper - apart:
        return count
    k = np.searchsorted(points[:count], value)
    if (k > 0 and value - points[k - 1] < apart) or (k < count and points[k] - value < apart):
        return count
    return _insert(points, count, value, 0.0, upper)


@jit.part
def _grow(points, count, centre, scale, lower, upper):  # type: ignore[no-untyped-def]
    """Insert the centre and panels that grow from it in both directions."""
    count = _insert(points, count, centre, lower, upper)
    step = _FIRST * scale
    while step < upper - lower:
        count = _insert(points, count, centre - step, lower, upper)
        count = _insert(points, count, centre + step, lower, upper)
        step *= _GROWTH
    return count


@jit.part
def _stretch(a, b, centre, scale):  # type: ignore[no-untyped-def]
    """Half the axes' sum of the ellipse about a panel [a, b] of half length 1 through poles at centre +- i scale."""
    half = 0.5 * (b - a)
    x, y = (centre - 0.5 * (a + b)) / half, scale / half
    return 0.5 * (math.sqrt((x - 1.0) ** 2 + y * y) + math.sqrt((x + 1.0) ** 2 + y * y))


@jit.part
def _order(stretch, digits):  # type: ignore[no-untyped-def]
    """Order q with rho^(-2 q) = exp(-digits)."""
    rho = max(stretch + math.sqrt(max(0.0, stretch * stretch - 1.0)), 1.2)
    return digits / (2.0 * math.log(rho))


@jit.part
def tangents(touch, sn, cn, theta_n, planes, corner):  # type: ignore[no-untyped-def]
    """Rings that the horizon or a plane of kinks touches, rows of theta and the side (-1, 1) on which they are crossed.

    There integrals over rings have square roots. Broken powers have structure on both sides, side 0, and where planes meet.
    Returns how many; the first two are those of the horizon.
    """
    touch[0, 0], touch[0, 1] = 0.5 * math.pi - theta_n, 1.0
    touch[1, 0], touch[1, 1] = min(math.pi, 0.5 * math.pi + theta_n), -1.0
    n = 2
    for k in range(planes.shape[0]):
        if abs(planes[k, 3]) < 1.0:
            gamma = abs(math.atan2(planes[k, 0] * cn + planes[k, 2] * sn, planes[k, 2] * cn - planes[k, 0] * sn))
            opening = math.acos(planes[k, 3])
            side = 1.0 if corner == 0.0 else 0.0
            touch[n, 0], touch[n, 1] = abs(gamma - opening), side
            touch[n + 1, 0], touch[n + 1, 1] = min(gamma + opening, 2.0 * math.pi - gamma - opening), -side
            n += 2
    for k in range(planes.shape[0] if corner > 0.0 else 0):
        for j in range(-1, k):
            t = _meeting(planes, k, j, sn, cn)
            if t > 0.0:
                touch[n, 0], touch[n, 1] = t, 0.0
                n += 1
    return n


@jit.part
def _meeting(planes, k, j, sn, cn):  # type: ignore[no-untyped-def]
    """The ring on which two planes of kinks meet, or (j = -1) one and the horizon [rad]; -1 if they do not."""
    c_x, c_z, d = (0.0, 1.0, 0.0) if j < 0 else (planes[j, 0], planes[j, 2], planes[j, 3])
    determinant = planes[k, 0] * c_z - planes[k, 2] * c_x
    if abs(determinant) <= 1e-12:
        return -1.0
    x = (planes[k, 3] * c_z - planes[k, 2] * d) / determinant
    z = (planes[k, 0] * d - planes[k, 3] * c_x) / determinant
    return math.acos(min(1.0, max(-1.0, z * cn - x * sn))) if x * x + z * z < 1.0 else -1.0


@jit.part
def theta_panels(points, touch, touching, sn, cn, theta_n, width, layer, peaks, planes, corner, edges, rows):  # type: ignore[no-untyped-def]
    """Edges of the panels in theta; returns how many. ``edges``: rows of a map, or where another field changes detail."""
    upper = touch[1, 0]
    n = 0
    for k in range(touching):
        n = _insert(points, n, touch[k, 0], 0.0, upper)
    for k in range(planes.shape[0]):  # rings where two kinks, or a kink and the horizon, meet
        for j in range(-1, k):
            n = _insert(points, n, _meeting(planes, k, j, sn, cn), 0.0, upper)
    for k in range(1, edges.size - 1):  # kinks of a map; else only for economy
        apart = 0.0 if rows else 0.3 * min(edges[k + 1] - edges[k], edges[k] - edges[k - 1])
        n = _insert_apart(points, n, edges[k], apart, upper)
    if width < 10.0:
        n = _grow(points, n, 2.0 * theta_n, 2.0 * width, 0.0, upper)
    for k in range(peaks.shape[0]):
        n = _grow(points, n, peaks[k, 0], peaks[k, 2], 0.0, upper)
    if layer < 10.0:
        n = _grow(points, n, upper, layer, 0.0, upper)
        n = _grow(points, n, touch[0, 0], layer, 0.0, upper)
    for k in range(2, touching if corner > 0.0 else 2):
        n = _grow(points, n, touch[k, 0], corner, 0.0, upper)
    for k in range(n, 0, -1):
        points[k] = points[k - 1]
    points[0], points[n + 1] = 0.0, upper
    n += 2
    for k in range(touching):  # a square root just outside a long panel: grade that panel towards it
        side = touch[k, 1]
        if side == 0.0:
            continue
        i = np.searchsorted(points[:n], touch[k, 0] + side * 1e-12)
        i = i - 1 if side < 0.0 else i
        if i < 0 or i >= n:
            continue
        step = _GRADE * abs(points[i] - touch[k, 0])
        while step > 0.0 and step < math.pi:
            t = touch[k, 0] + side * step
            if t > 0.0 and t < upper:
                j = np.searchsorted(points[:n], t)
                near = points[j - 1] if side > 0.0 else points[j]
                if points[j] - points[j - 1] > (_GRADE - 1.0) * 1.5 * abs(near - touch[k, 0]):
                    n = _insert(points, n, t, 0.0, upper)
            step *= _GRADE
    return n


@jit.part
def root(length):  # type: ignore[no-untyped-def]
    """Cube root of a length below pi [rad], or up to an eighth more: three of its tangents."""
    narrow, middle, wide = 0.20715 + 3.4525 * length, 0.44629 + 0.74381 * length, 0.9615 + 0.16025 * length
    return min(narrow, middle, wide)


@jit.part
def _reach(st, ct, sn, cn):  # type: ignore[no-untyped-def]
    """Half of the part of a ring above the horizon [rad], and whether the horizon cuts it."""
    # zi = cos t cn + sin t sn cos D; it vanishes where tan^2(D/2) = cos(t - theta_n) / -cos(t + theta_n)
    far = ct * cn - st * sn
    if far >= 0.0:
        return math.pi, False
    near = ct * cn + st * sn
    if near <= 0.0:
        return 0.0, True
    return 2.0 * math.atan2(math.sqrt(near), math.sqrt(-far)), True


@jit.part
def _crossing(plane, st, ct, sn, cn):  # type: ignore[no-untyped-def]
    """Where on a half ring it meets a plane of kinks [rad]; 0 or pi if it does not."""
    c_z = plane[2] * cn - plane[0] * sn
    c_x = plane[0] * cn + plane[2] * sn
    across = c_x * st if abs(c_x * st) > 1e-300 else 1e-300
    return math.acos(min(1.0, max(-1.0, (plane[3] - c_z * ct) / across)))


@jit.part
def turn_of(a, b, sn, cn, planes):  # type: ignore[no-untyped-def]
    """By how much the horizon and the kinks move along the rings between a and b, at most [rad]."""
    sa, ca, sb, cb = math.sin(a), math.cos(a), math.sin(b), math.cos(b)
    turn = abs(_reach(sb, cb, sn, cn)[0] - _reach(sa, ca, sn, cn)[0])
    for k in range(planes.shape[0]):
        if abs(planes[k, 3]) < 1.0:
            turn = max(turn, abs(_crossing(planes[k], sb, cb, sn, cn) - _crossing(planes[k], sa, ca, sn, cn)))
    return turn


@jit.part
def parts(bend, beyond):  # type: ignore[no-untyped-def]
    """Into how many equal parts an interval is cut, each with an order q of at most 96, and q.

    The interval as a whole would take ``bend + beyond`` nodes. Of the former each part takes its share; what series have
    beyond their degrees goes with the cube root of a length (`_rest` of `spectrum`), and no other order falls less.
    """
    count, order = 1, bend + beyond
    while order > LARGEST_ORDER:
        count = max(count + 1, math.ceil(bend / LARGEST_ORDER))
        order = bend / count + beyond * count ** (-1.0 / 3.0)
    return count, max(2, math.ceil(order))


@jit.part
def _arc(x_table, w_table, a, b, bend, beyond, scale, nodes, weights, n):  # type: ignore[no-untyped-def]
    """Append the nodes of an arc [a, b], in as many pieces as the largest order asks for; returns how many nodes."""
    pieces, q = parts(bend, beyond)
    start = q * (q - 1) // 2
    h = (b - a) / pieces
    for piece in range(pieces):
        if n + q > nodes.size:
            return n
        for j in range(q):
            nodes[n] = a + h * (piece + x_table[start + j])
            weights[n] = scale * h * w_table[start + j]
            n += 1
    return n


@jit.part
def theta_order(a, b, touch, touching, theta_n, width, layer, peaks, rest, digits):  # type: ignore[no-untyped-def]
    """Order for a panel of theta besides what oscillates, and whether it starts and whether it ends with a square root.

    ``rest`` nodes are for what the series of that have beyond their degrees.
    """
    starts, ends, square_roots = False, False, 1e9
    for k in range(touching):
        if touch[k, 1] >= 0.0 and abs(a - touch[k, 0]) < 1e-12:
            starts = True
        elif touch[k, 1] <= 0.0 and abs(b - touch[k, 0]) < 1e-12:
            ends = True
        elif touch[k, 1] == 0.0 or (touch[k, 1] > 0.0) == (touch[k, 0] < a):
            square_roots = min(square_roots, _stretch(a, b, touch[k, 0], 0.0))
    stretch = 1e9
    if width < 10.0:
        stretch = _stretch(a, b, 2.0 * theta_n, 2.0 * width)
    if layer < 10.0:
        stretch = min(stretch, _stretch(a, b, touch[1, 0], layer), _stretch(a, b, touch[0, 0], layer))
    for k in range(peaks.shape[0]):
        stretch = min(stretch, _stretch(a, b, peaks[k, 0], peaks[k, 2]))
    order = max(_order(stretch, digits), _SMOOTH * digits * (b - a), rest)
    if starts or ends:
        return 2.0 * order + 2.0, starts, ends
    return max(order, _order(square_roots, digits - 3.0)) + 0.5, False, False


@jit.part
def ring_nodes(cuts, t, st, ct, sn, cn, theta_n, width, layer, peaks, planes, corner, bend, rest, digits, scale, x_table, w_table, nodes, weights):  # type: ignore[no-untyped-def]  # noqa: E501
    """Nodes in D on the half ring from 0 to the horizon, weights times `scale`; how many, a multiple of `LANES`."""
    reach, clipped = _reach(st, ct, sn, cn)
    if reach == 0.0:
        return 0
    pole, edge = 1e9, 1e9
    product = st * sn
    if width < 10.0:
        squared = (width * width + 4.0 * math.sin(0.25 * t - 0.5 * theta_n) ** 2) / max(4.0 * math.sin(0.5 * t) * sn, 1e-300)
        pole = max(2.0 * math.asinh(math.sqrt(squared)), 1e-10)
    opposite = 1e9  # distance of the poles of peaks at D = pi
    for k in range(peaks.shape[0]):
        squared = peaks[k, 2] ** 2 + 4.0 * math.sin(0.5 * (t - peaks[k, 0])) ** 2
        squared /= max(4.0 * st * math.sin(peaks[k, 0]), 1e-300)
        distance = max(2.0 * math.asinh(math.sqrt(squared)), 1e-10)
        if peaks[k, 1] > 0.0:
            pole = min(pole, distance)
        else:
            opposite = min(opposite, distance)
    if layer < 10.0:  # at the horizon, or where the ring comes nearest to it
        edge = math.sqrt(2.0 * (layer + max(0.0, ct * cn - product)) / max(product, 1e-300))
        slope = product * math.sin(reach)
        if clipped and slope * edge > layer:
            edge = layer / slope
    for k in range(planes.shape[0]):
        cuts[k] = _crossing(planes[k], st, ct, sn, cn)
        if corner > 0.0 and clipped and cuts[k] > reach:
            edge = min(edge, max(cuts[k] - reach, corner))
        elif corner > 0.0 and (cuts[k] == 0.0 or cuts[k] == math.pi):  # where the ring comes nearest to it
            c_z, c_x = planes[k, 2] * cn - planes[k, 0] * sn, planes[k, 0] * cn + planes[k, 2] * sn
            apart = math.sqrt(2.0 * abs(abs(planes[k, 3] - c_z * ct) / max(abs(c_x * st), 1e-300) - 1.0))
            if cuts[k] == 0.0:
                pole = min(pole, max(apart, corner))
            else:
                edge = min(edge, max(apart, corner))
    ahead, behind = _FIRST * pole, _FIRST * edge  # next breakpoints: from the lobe on, and left to the horizon
    while behind * _GROWTH < reach:
        behind *= _GROWTH
    count, a, passed = 0, 0.0, -1e9  # where the last kink was
    from_lobe, from_edge = pole, math.sqrt(reach * reach + edge * edge)
    while a < reach:
        stop = reach  # up to which nothing is bent
        for k in range(planes.shape[0]):
            if cuts[k] > a + 1e-13 and cuts[k] < stop - 1e-13:
                stop = cuts[k]
        while ahead <= 1.5 * a:
            ahead *= _GROWTH
        while behind >= _FIRST * edge and reach - behind < a + 0.3 * behind:
            behind /= _GROWTH
        b = min(stop, ahead)
        if behind >= _FIRST * edge:
            b = min(b, reach - behind)
        if stop - b < 0.4 * (b - a) and behind < _FIRST * edge:
            b = stop
        stretch = 1e9
        if corner > 0.0:  # panels grow from the kinks too
            b = min(b, passed + max(_FIRST * corner, _GROWTH * (a - passed)))
            if stop < reach and stop - a > _FIRST * corner:
                b = min(b, stop - (stop - a) / _GROWTH)
            if a > passed:
                stretch = (a + b - 2.0 * passed) / (b - a)
            if b < stop and stop < reach:
                stretch = min(stretch, (2.0 * stop - a - b) / (b - a))
        to_lobe, to_edge = math.sqrt(b * b + pole * pole), math.sqrt((reach - b) ** 2 + edge * edge)
        stretch = min(stretch, (from_lobe + to_lobe) / (b - a), (from_edge + to_edge) / (b - a))
        stretch = min(stretch, math.sqrt((b - a) ** 2 + 4.0 * opposite**2) / (b - a))
        beyond = max(_order(stretch, digits), _SMOOTH * digits * (b - a), rest * root(b - a)) + 0.5
        count = _arc(x_table, w_table, a, b, bend * (b - a), beyond, scale, nodes, weights, count)
        if b == stop:
            passed = b
        a, from_lobe, from_edge = b, to_lobe, to_edge
    last = nodes[count - 1]
    while count % LANES:
        nodes[count], weights[count] = last, 0.0
        count += 1
    return count


@jit.part
def finest_detail(edges, detail, a, b):  # type: ignore[no-untyped-def]
    """Largest ``detail`` (n - 1,) of the intervals between ``edges`` (n,) that [a, b] meets."""
    largest = 0.0
    for k in range(detail.size):
        if edges[k] < b and edges[k + 1] > a:
            largest = max(largest, detail[k])
    return largest
