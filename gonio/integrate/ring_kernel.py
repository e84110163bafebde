r"""For one slope theta_n, the reflected radiance as a Fourier series in phi_n: sums over rings about the view axis.

With the viewer on the axis and an isotropic BRDF, :math:`K = f_r\cos\theta_i` depends on the source's azimuth through
:math:`D = \phi_s-\phi_n` alone, and evenly. With the source's series :math:`a_m(\theta), b_m(\theta)` (`spectrum`)

.. math:: R(\theta_n,\phi_n) = \sum_m A_m\cos m\phi_n + B_m\sin m\phi_n, \qquad
          A_m = \int a_m K_m \sin\theta\,\mathrm{d}\theta, \quad K_m = \int_{-\pi}^{\pi} K\cos(mD)\,\mathrm{d}D ,

so the source is never looked at where the BRDF is: a node costs one evaluation and one multiply-add for each wave.

Panels grow from the features: the lobe, the horizon and its layer of shadowing, kinks, the rows of a map. A lobe of half
width w in half-vector angle has its poles, on the ring theta, at :math:`D = \pm 2i\,\mathrm{asinh}\,e`,
:math:`4e^2\sin\frac\theta2\sin\theta_n = w^2 + 4\sin^2\frac{\theta/2-\theta_n}{2}` (exact for GGX up to the definition of w,
from :math:`\cos\theta_h = \cos\frac\theta2\cos\theta_n+\sin\frac\theta2\sin\theta_n\cos D`). A Gauss rule of q nodes errs by
:math:`\rho^{-2q}` with rho of the ellipse through the nearest pole [1]_; q follows from it for every panel. On top come
nodes for the waves, half the degree n at which :math:`J_n(mh)` has died: along a ring those of cos mD, across rings those
with which K_m turns as the ring's cut at the horizon or a kink moves. Towards rings that are only touched, where there is a
square root, panels are graded. So d digits asked for are d digits, of the largest value at the slope.

References
----------
.. [1] L. N. Trefethen, Approximation Theory and Approximation Practice, SIAM, 2013, theorem 19.3.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gonio import jit

Array = NDArray[np.float64]
LARGEST_ORDER = 96
_GROWTH = 4.0
_FIRST = 1.5  # length of the panel next to a feature, in units of the distance of its pole
_CAPACITY = 4096  # breakpoints, besides the rows of a map
_RING = 8192  # nodes of one ring, besides those for the waves
_GRADE = 4.0  # growth of panels away from where a ring begins to be cut


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
def _order(a, b, centre, scale, digits):  # type: ignore[no-untyped-def]
    """Order q with rho^(-2 q) = exp(-digits) for a panel [a, b] and poles at centre +- i scale."""
    half = 0.5 * (b - a)
    x, y = (centre - 0.5 * (a + b)) / half, scale / half
    s = 0.5 * (math.sqrt((x - 1.0) ** 2 + y * y) + math.sqrt((x + 1.0) ** 2 + y * y))
    rho = max(s + math.sqrt(max(0.0, s * s - 1.0)), 1.2)
    return digits / (2.0 * math.log(rho))


@jit.part
def _tangents(touch, sn, cn, theta_n, planes):  # type: ignore[no-untyped-def]
    """Rings that the horizon or a plane of kinks touches, where integrals over rings have square roots; how many."""
    upper = min(math.pi, 0.5 * math.pi + theta_n)
    touch[0], touch[1], n = 0.5 * math.pi - theta_n, upper, 2
    for k in range(planes.shape[0]):
        if abs(planes[k, 3]) < 1.0:
            gamma = abs(math.atan2(planes[k, 0] * cn + planes[k, 2] * sn, planes[k, 2] * cn - planes[k, 0] * sn))
            opening = math.acos(planes[k, 3])
            for t in (abs(gamma - opening), gamma + opening, 2.0 * math.pi - gamma - opening):
                if t > 0.0 and t < upper:
                    touch[n] = t
                    n += 1
    return n


@jit.part
def _theta_panels(points, touch, touching, sn, cn, theta_n, width, layer, planes, breaks, rows):  # type: ignore[no-untyped-def]
    """Edges of the panels in theta; returns how many."""
    upper = touch[1]
    n = 0
    for k in range(touching):
        n = _insert(points, n, touch[k], 0.0, upper)
    if width < 10.0:
        n = _grow(points, n, 2.0 * theta_n, 2.0 * width, 0.0, upper)
    if layer < 10.0:
        n = _grow(points, n, upper, layer, 0.0, upper)
        n = _grow(points, n, 0.5 * math.pi - theta_n, layer, 0.0, upper)
    for k in range(planes.shape[0]):  # rings where two kinks, or a kink and the horizon, meet
        for j in range(-1, k):
            c_x, c_z, d = (0.0, 1.0, 0.0) if j < 0 else (planes[j, 0], planes[j, 2], planes[j, 3])
            determinant = planes[k, 0] * c_z - planes[k, 2] * c_x
            if abs(determinant) > 1e-12:
                x = (planes[k, 3] * c_z - planes[k, 2] * d) / determinant
                z = (planes[k, 0] * d - planes[k, 3] * c_x) / determinant
                if x * x + z * z < 1.0:
                    n = _insert(points, n, math.acos(min(1.0, max(-1.0, z * cn - x * sn))), 0.0, upper)
    if rows:  # the field has kinks at its rows
        for k in range(1, breaks.size - 1):
            n = _insert(points, n, breaks[k], 0.0, upper)
        for k in range(n, 0, -1):
            points[k] = points[k - 1]
        points[0], points[n + 1] = 0.0, upper
        n += 2
    else:  # panels no longer than those of the field, which need not meet its edges
        coarse = np.empty(n + 2)
        coarse[0], coarse[n + 1] = 0.0, upper
        coarse[1 : n + 1] = points[:n]
        last, n = n + 1, 0
        for k in range(last):
            a, b = coarse[k], coarse[k + 1]
            pieces = max(1, math.ceil(_field_panels(breaks, b) - _field_panels(breaks, a) - 1e-9))
            for j in range(pieces):
                if n < points.size - 1:
                    points[n] = a + (b - a) * j / pieces
                    n += 1
        points[n] = upper
        n += 1
    for k in range(touching):  # a square root just outside a long panel: grade that panel towards it
        for side in (-1.0, 1.0):
            i = np.searchsorted(points[:n], touch[k] + side * 1e-12)
            i = i - 1 if side < 0.0 else i
            if i < 0 or i >= n:
                continue
            step = _GRADE * abs(points[i] - touch[k])
            while step > 0.0 and step < math.pi:
                t = touch[k] + side * step
                if t > 0.0 and t < upper:
                    j = np.searchsorted(points[:n], t)
                    near = points[j - 1] if side > 0.0 else points[j]
                    if points[j] - points[j - 1] > (_GRADE - 1.0) * 1.5 * abs(near - touch[k]):
                        n = _insert(points, n, t, 0.0, upper)
                step *= _GRADE
    return n


@jit.part
def _field_panels(breaks, t):  # type: ignore[no-untyped-def]
    """How many panels of the field there are up to t, a real number."""
    k = min(max(np.searchsorted(breaks, t, side="right") - 1, 0), breaks.size - 2)
    return k + (t - breaks[k]) / (breaks[k + 1] - breaks[k])


@jit.part
def _wave_order(waves, length, digits):  # type: ignore[no-untyped-def]
    """Nodes that waves up to cos(m D) take on an interval: half the degree at which their series, Bessel's J_n, has died."""
    z = 0.5 * waves * length
    return 0.5 * z + 0.5 * (digits * digits * z) ** (1.0 / 3.0)


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
    return math.acos(min(1.0, max(-1.0, (plane[3] - c_z * ct) / max(1e-300, abs(c_x * st)))))


@jit.part
def _turn(a, b, sn, cn, planes):  # type: ignore[no-untyped-def]
    """By how much the horizon and the kinks move along the rings between a and b, at most [rad]."""
    sa, ca, sb, cb = math.sin(a), math.cos(a), math.sin(b), math.cos(b)
    turn = abs(_reach(sb, cb, sn, cn)[0] - _reach(sa, ca, sn, cn)[0])
    for k in range(planes.shape[0]):
        if abs(planes[k, 3]) < 1.0:
            turn = max(turn, abs(_crossing(planes[k], sb, cb, sn, cn) - _crossing(planes[k], sa, ca, sn, cn)))
    return turn


@jit.part
def _arc(x_table, w_table, a, b, order, scale, nodes, weights, n):  # type: ignore[no-untyped-def]
    """Append the nodes of an arc [a, b], in as many pieces as the largest order asks for; returns how many nodes."""
    pieces = max(1, math.ceil(order / LARGEST_ORDER))
    q = min(LARGEST_ORDER, max(2, math.ceil(order / pieces)))
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
def _ring_nodes(points, t, st, ct, sn, cn, theta_n, width, layer, planes, waves, digits, scale, x_table, w_table, nodes, weights):  # type: ignore[no-untyped-def]  # noqa: E501
    """Nodes in D on the half ring from 0 to the horizon, weights times `scale`; returns how many."""
    reach, clipped = _reach(st, ct, sn, cn)
    if reach == 0.0:
        return 0
    pole, edge = 1e9, 1e9
    n = 0
    product = st * sn
    if width < 10.0:
        squared = (width * width + 4.0 * math.sin(0.25 * t - 0.5 * theta_n) ** 2) / max(4.0 * math.sin(0.5 * t) * sn, 1e-300)
        pole = max(2.0 * math.asinh(math.sqrt(squared)), 1e-10)
        n = _grow(points, n, 0.0, pole, 0.0, reach)
    if layer < 10.0:  # at the horizon, or where the ring comes nearest to it
        edge = math.sqrt(2.0 * (layer + max(0.0, ct * cn - product)) / max(product, 1e-300))
        slope = product * math.sin(reach)
        if clipped and slope * edge > layer:
            edge = layer / slope
        if edge < math.pi:
            n = _grow(points, n, reach, edge, 0.0, reach)
    for k in range(planes.shape[0]):
        c_z = planes[k, 2] * cn - planes[k, 0] * sn
        c_x = planes[k, 0] * cn + planes[k, 2] * sn
        if abs(planes[k, 3] - c_z * ct) < abs(c_x * st):
            n = _insert(points, n, math.acos((planes[k, 3] - c_z * ct) / (c_x * st)), 0.0, reach)
    count = 0
    a = 0.0
    for k in range(n + 1):
        b = points[k] if k < n else reach
        order = max(_order(a, b, 0.0, pole, digits), _order(a, b, reach, edge, digits))
        order = max(order, 0.15 * digits * (b - a)) + _wave_order(waves, b - a, digits) + 1.0
        count = _arc(x_table, w_table, a, b, order, scale, nodes, weights, count)
        a = b
    return count


@functools.cache
def ring_kernel(function: Callable[..., float]) -> Any:
    """Compiled kernel of ``(slopes, p, weight, width, layers, planes, breaks, series, used, bent, error, rows, digits, x, w,
    out, n)``.

    ``slopes`` (k, 2): cos and sin of theta_n; ``layers`` (k,), ``planes`` (k, j, 4); ``used`` and ``bent`` (panels,): waves
    to sum, and waves whose integrals over rings turn with the horizon by more than is negligible; ``error`` (panels,) of the
    series. ``out`` (k, 3, waves) receives A_m, B_m and, first in its last row, the directional albedo and the error of R due
    to that of the series; ``n`` (1,) evaluations.
    """

    def ring_sums(slopes, p, weight, width, layers, planes, breaks, series, used, bent, error, rows, digits, x_table, w_table, out, effort):  # type: ignore[no-untyped-def]  # noqa: E501
        most = out.shape[2]
        points, arcs = np.empty(_CAPACITY + 2 * breaks.size), np.empty(_CAPACITY)
        touch = np.empty(2 + 3 * planes.shape[1])
        room = _RING + 2 * most
        nodes, weights = np.empty(room), np.empty(room)
        cosine, kernel = np.empty(room), np.empty(room)
        c0, c1 = np.empty(room), np.empty(room)
        wave, cheb = np.empty(most + 4), np.empty(series.shape[1])
        degree = series.shape[1] - 1
        for slope in range(slopes.shape[0]):
            cn, sn = slopes[slope, 0], slopes[slope, 1]
            theta_n = math.atan2(sn, cn)
            layer = layers[slope]
            total = out[slope]
            total[:] = 0.0
            touching = _tangents(touch, sn, cn, theta_n, planes[slope])
            edges = _theta_panels(points, touch, touching, sn, cn, theta_n, width, layer, planes[slope], breaks, rows)
            for panel in range(edges - 1):
                a, b = points[panel], points[panel + 1]
                order = 0.15 * digits * (b - a)
                if width < 10.0:
                    order = max(order, _order(a, b, 2.0 * theta_n, 2.0 * width, digits))
                if layer < 10.0:
                    order = max(order, _order(a, b, touch[1], layer, digits), _order(a, b, touch[0], layer, digits))
                if rows:
                    order += 0.5 + 0.5 * degree + 0.1 * digits
                else:
                    order += 1.3 + 0.2 * digits * (_field_panels(breaks, b) - _field_panels(breaks, a))
                at = False
                for k in range(touching):
                    at = at or abs(a - touch[k]) < 1e-12 or abs(b - touch[k]) < 1e-12
                for k in range(touching):
                    if not at:
                        order = max(order, _order(a, b, touch[k], 0.0, digits - 3.0))
                k = min(max(np.searchsorted(breaks, 0.5 * (a + b), side="right") - 1, 0), breaks.size - 2)
                turn = _turn(a, b, sn, cn, planes[slope])
                order += _wave_order(min(bent[k], most), turn, 0.3 * digits)  # the last of these waves are weak
                if at:
                    order = 2.0 * order + 3.0
                pieces = max(1, math.ceil(order / LARGEST_ORDER))
                q = min(LARGEST_ORDER, max(2, math.ceil(order / pieces)))
                start = q * (q - 1) // 2
                for i in range(q * pieces):
                    x, w = (i // q + x_table[start + i % q]) / pieces, w_table[start + i % q] / pieces
                    if at:  # (t - tangent)^(3/2) there, which this makes smooth
                        t, dt = a + (b - a) * x * x * (3.0 - 2.0 * x), (b - a) * 6.0 * x * (1.0 - x) * w
                    else:
                        t, dt = a + (b - a) * x, (b - a) * w
                    st, ct = math.sin(t), math.cos(t)
                    k = min(max(np.searchsorted(breaks, t, side="right") - 1, 0), breaks.size - 2)
                    waves = min(used[k], most)
                    n = _ring_nodes(
                        arcs, t, st, ct, sn, cn, theta_n, width, layer, planes[slope], waves - 1, digits,
                        2.0 * st * dt * weight, x_table, w_table, nodes, weights,
                    )  # fmt: skip
                    effort[0] += n
                    for j in range(n):
                        # sin and cos of y = D - pi/2, |y| <= pi/2, by their series
                        y = nodes[j] - 0.5 * math.pi
                        y2 = y * y
                        odd = y * (1.0 + y2 * (-1 / 6 + y2 * (1 / 120 + y2 * (-1 / 5040 + y2 * (1 / 362880 + y2 * (
                            -1 / 39916800 + y2 * (1 / 6227020800 + y2 * (-1 / 1307674368000 + y2 * (
                            1 / 355687428096000 - y2 / 121645100408832000)))))))))  # fmt: skip
                        even = 1.0 + y2 * (-1 / 2 + y2 * (1 / 24 + y2 * (-1 / 720 + y2 * (1 / 40320 + y2 * (
                            -1 / 3628800 + y2 * (1 / 479001600 + y2 * (-1 / 87178291200 + y2 * (1 / 20922789888000 + y2 * (
                            -1 / 6402373705728000 + y2 / 2432902008176640000)))))))))  # fmt: skip
                        cosine[j] = -2.0 * odd
                        zi = ct * cn - st * sn * odd
                        f = function(-st * odd * cn - ct * sn, st * even, zi, -sn, 0.0, cn, p)
                        kernel[j] = f * max(zi, 0.0) * weights[j]
                    s = 0.0
                    for j in range(n):
                        s += kernel[j]
                        c0[j] = 1.0
                        c1[j] = 0.5 * cosine[j]
                    wave[0] = s
                    s = 0.0
                    for j in range(n):
                        s += kernel[j] * c1[j]
                    wave[1] = s
                    for m in range(2, waves, 4):
                        s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
                        for j in range(n):  # cos(m D) by Chebyshev's recurrence
                            z, g = cosine[j], kernel[j]
                            u0 = z * c1[j] - c0[j]
                            u1 = z * u0 - c1[j]
                            u2 = z * u1 - u0
                            u3 = z * u2 - u1
                            s0 += g * u0
                            s1 += g * u1
                            s2 += g * u2
                            s3 += g * u3
                            c0[j] = u2
                            c1[j] = u3
                        wave[m], wave[m + 1], wave[m + 2], wave[m + 3] = s0, s1, s2, s3
                    total[2, 0] += abs(wave[0])
                    total[2, 1] += error[k] * abs(wave[0])
                    u = (2.0 * t - breaks[k] - breaks[k + 1]) / (breaks[k + 1] - breaks[k])
                    cheb[0] = 1.0
                    if degree > 0:
                        cheb[1] = u
                    for j in range(2, degree + 1):
                        cheb[j] = 2.0 * u * cheb[j - 1] - cheb[j - 2]
                    for j in range(degree + 1):
                        for side in range(2):
                            line = series[k, j, side]
                            for m in range(waves):
                                total[side, m] += cheb[j] * line[m] * wave[m]

    return jit.kernel(ring_sums)
