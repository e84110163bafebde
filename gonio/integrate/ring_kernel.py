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
:math:`\rho^{-2q}` with rho of the ellipse through the nearest pole [1]_; q follows from it for every panel.

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
_CAPACITY = 4096
_RING = 8192  # nodes of one ring


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
def _theta_panels(points, sn, cn, theta_n, width, layer, planes, breaks, rows):  # type: ignore[no-untyped-def]
    """Edges of the panels in theta; returns how many."""
    upper = min(math.pi, 0.5 * math.pi + theta_n)
    n = _insert(points, 0, 0.5 * math.pi - theta_n, 0.0, upper)
    if width < 10.0:
        n = _grow(points, n, 2.0 * theta_n, 2.0 * width, 0.0, upper)
    if layer < 10.0:
        n = _grow(points, n, upper, layer, 0.0, upper)
        n = _grow(points, n, 0.5 * math.pi - theta_n, layer, 0.0, upper)
    for k in range(planes.shape[0]):
        gamma = abs(math.atan2(planes[k, 0] * cn + planes[k, 2] * sn, planes[k, 2] * cn - planes[k, 0] * sn))
        opening = math.acos(min(1.0, max(-1.0, planes[k, 3])))
        n = _insert(points, n, abs(gamma - opening), 0.0, upper)
        n = _insert(points, n, gamma + opening, 0.0, upper)
        n = _insert(points, n, 2.0 * math.pi - gamma - opening, 0.0, upper)
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
        return n + 2
    # else panels no longer than those of the field, which need not meet its edges
    coarse = np.empty(n + 2)
    coarse[0], coarse[n + 1] = 0.0, upper
    coarse[1 : n + 1] = points[:n]
    count = 0
    for k in range(n + 1):
        a, b = coarse[k], coarse[k + 1]
        pieces = max(1, math.ceil(_field_panels(breaks, b) - _field_panels(breaks, a) - 1e-9))
        for j in range(pieces):
            if count < points.size - 1:
                points[count] = a + (b - a) * j / pieces
                count += 1
    points[count] = upper
    return count + 1


@jit.part
def _touches(planes, a, b, sn, cn):  # type: ignore[no-untyped-def]
    """Whether a plane of kinks touches one of the two rings."""
    for k in range(planes.shape[0]):
        gamma = abs(math.atan2(planes[k, 0] * cn + planes[k, 2] * sn, planes[k, 2] * cn - planes[k, 0] * sn))
        opening = math.acos(min(1.0, max(-1.0, planes[k, 3])))
        for t in (abs(gamma - opening), gamma + opening, 2.0 * math.pi - gamma - opening):
            if abs(a - t) < 1e-12 or abs(b - t) < 1e-12:
                return True
    return False


@jit.part
def _field_panels(breaks, t):  # type: ignore[no-untyped-def]
    """How many panels of the field there are up to t, a real number."""
    k = min(max(np.searchsorted(breaks, t, side="right") - 1, 0), breaks.size - 2)
    return k + (t - breaks[k]) / (breaks[k + 1] - breaks[k])


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
def _ring_nodes(points, t, st, ct, sn, cn, theta_n, width, layer, planes, per_radian, digits, scale, x_table, w_table, nodes, weights):  # type: ignore[no-untyped-def]  # noqa: E501
    """Nodes in D on the half ring from 0 to the horizon, weights times `scale`; returns how many."""
    reach, clipped = math.pi, False
    # zi = cos t cn + sin t sn cos D; it vanishes where tan^2(D/2) = cos(t - theta_n) / -cos(t + theta_n)
    far = ct * cn - st * sn
    if far < 0.0:
        near = ct * cn + st * sn
        if near <= 0.0:
            return 0
        reach, clipped = 2.0 * math.atan2(math.sqrt(near), math.sqrt(-far)), True
    pole, edge = 1e9, 1e9
    n = 0
    product = st * sn
    if width < 10.0:
        squared = (width * width + 4.0 * math.sin(0.25 * t - 0.5 * theta_n) ** 2) / max(4.0 * math.sin(0.5 * t) * sn, 1e-300)
        pole = max(2.0 * math.asinh(math.sqrt(squared)), 1e-10)
        n = _grow(points, n, 0.0, pole, 0.0, reach)
    if layer < 10.0 and clipped:
        slope = product * math.sin(reach)
        edge = math.sqrt(2.0 * layer / max(product, 1e-300))
        if slope * edge > layer:
            edge = layer / slope
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
        order = max(order, 0.15 * digits * (b - a)) + per_radian * (b - a) + 1.0
        count = _arc(x_table, w_table, a, b, order, scale, nodes, weights, count)
        a = b
    return count


@functools.cache
def ring_kernel(function: Callable[..., float]) -> Any:
    """Compiled ``kernel(slopes, p, weight, width, layers, planes, breaks, series, used, rows, digits, x, w, out, n)``.

    ``slopes`` (k, 2): cos and sin of theta_n; ``layers`` (k,), ``planes`` (k, j, 4); ``out`` (k, 3, waves) receives A_m, B_m
    and the integral of abs(K_m) sin theta, whose first is the directional albedo; ``n`` (1,) evaluations.
    """

    def ring_sums(slopes, p, weight, width, layers, planes, breaks, series, used, rows, digits, x_table, w_table, out, effort):  # type: ignore[no-untyped-def]  # noqa: E501
        points, arcs = np.empty(_CAPACITY), np.empty(_CAPACITY)
        nodes, weights = np.empty(_RING), np.empty(_RING)
        cosine, kernel = np.empty(_RING), np.empty(_RING)
        c0, c1 = np.empty(_RING), np.empty(_RING)
        most = out.shape[2]
        wave, cheb = np.empty(most + 4), np.empty(series.shape[1])
        degree = series.shape[1] - 1
        for slope in range(slopes.shape[0]):
            cn, sn = slopes[slope, 0], slopes[slope, 1]
            theta_n = math.atan2(sn, cn)
            layer = layers[slope]
            tangent = 0.5 * math.pi - theta_n
            total = out[slope]
            total[:] = 0.0
            edges = _theta_panels(points, sn, cn, theta_n, width, layer, planes[slope], breaks, rows)
            upper = points[edges - 1]
            for panel in range(edges - 1):
                a, b = points[panel], points[panel + 1]
                touching = abs(a - tangent) < 1e-12 or abs(b - tangent) < 1e-12 or abs(b - upper) < 1e-12
                touching = touching or _touches(planes[slope], a, b, sn, cn)
                order = 0.15 * digits * (b - a)
                if width < 10.0:
                    order = max(order, _order(a, b, 2.0 * theta_n, 2.0 * width, digits))
                if layer < 10.0:
                    order = max(order, _order(a, b, upper, layer, digits), _order(a, b, tangent, layer, digits))
                if rows:
                    order += 0.5 + 0.5 * degree + 0.1 * digits
                else:
                    order += 1.3 + 0.2 * digits * (_field_panels(breaks, b) - _field_panels(breaks, a))
                if not touching:  # near, but not at, where a ring begins to be cut
                    order = max(order, _order(a, b, tangent, 0.0, digits - 3.0))
                    order = max(order, _order(a, b, upper, 0.0, digits - 3.0))
                if touching:
                    order = 2.0 * order + 3.0
                q = min(LARGEST_ORDER, max(2, math.ceil(order)))
                start = q * (q - 1) // 2
                for i in range(q):
                    x, w = x_table[start + i], w_table[start + i]
                    if touching:  # (t - tangent)^(3/2) there, which this makes smooth
                        t, dt = a + (b - a) * x * x * (3.0 - 2.0 * x), (b - a) * 6.0 * x * (1.0 - x) * w
                    else:
                        t, dt = a + (b - a) * x, (b - a) * w
                    st, ct = math.sin(t), math.cos(t)
                    k = min(max(np.searchsorted(breaks, t, side="right") - 1, 0), breaks.size - 2)
                    waves = min(used[k], most)
                    # cos(m D) on [a, b] takes m (b - a) / 4 nodes; fields without kinks have little in their last waves
                    per_radian = (0.27 if rows else 0.15) * (waves - 1)
                    n = _ring_nodes(
                        arcs, t, st, ct, sn, cn, theta_n, width, layer, planes[slope], per_radian, digits,
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
                    for m in range(waves):
                        total[2, m] += abs(wave[m])
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
