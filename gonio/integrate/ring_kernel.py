r"""For one slope theta_n, the reflected radiance as a Fourier series in phi_n: sums over rings about the view axis.

With the viewer on the axis and an isotropic BRDF, :math:`K = f_r\cos\theta_i` depends on the source's azimuth through
:math:`D = \phi_s-\phi_n` alone, and evenly. With the source's series :math:`a_m(\theta), b_m(\theta)` (`spectrum`)

.. math:: R(\theta_n,\phi_n) = \sum_m A_m\cos m\phi_n + B_m\sin m\phi_n, \qquad
          A_m = \int a_m K_m \sin\theta\,\mathrm{d}\theta, \quad K_m = \int_{-\pi}^{\pi} K\cos(mD)\,\mathrm{d}D ,

so the source is never looked at where the BRDF is: a node costs one evaluation and one multiply-add for each wave. On a
panel of the source, where a_m and b_m are polynomials of theta, K_m is summed times each power first.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from gonio import jit
from gonio.integrate.ring_nodes import (
    CAPACITY,
    LANES,
    RING,
    finest_detail,
    parts,
    ring_nodes,
    root,
    tangents,
    theta_order,
    theta_panels,
    turn_of,
)

# a panel of a sampled field has degree 11 to 1e-12 (`spectrum`)
SERIES = 1.15  # as has a wave of z = m h = 1.15
GAUSSIAN = 0.36  # as has a Gaussian lobe that is as wide; over many panels it has waves up to sqrt(2 digits) over its width


@jit.part
def _gather(series, moments, total):  # type: ignore[no-untyped-def]
    """Add what a panel of the source (degree + 1, 2, waves) gives with moments of K_m (degree + 1, waves); clear them."""
    for j in range(moments.shape[0]):
        row = moments[j]
        for side in range(2):
            line, out = series[j, side], total[side]
            for m in range(out.size):
                out[m] += line[m] * row[m]
        for m in range(row.size):
            row[m] = 0.0


@jit.part
def _panel_of(breaks, t):  # type: ignore[no-untyped-def]
    """The panel of the source on which t is."""
    return min(max(np.searchsorted(breaks, t, side="right") - 1, 0), breaks.size - 2)


@functools.cache
def ring_kernel(function: Callable[..., float]) -> Any:
    """Compiled kernel of one model's function.

    Its arguments: ``slopes`` (k, 2), cos and sin of theta_n; the term's parameters, weight and lobe ``width``; ``layers``
    (k,); ``peaks`` (k, i, 3) in the plane of incidence: theta, cos D and half width; ``planes`` (k, j, 4) of kinks, and the
    ``corner`` of broken powers at them [rad] or 0; ``edges`` and ``detail``, `Spectrum.groups` or the rows of a map;
    ``breaks`` and ``series`` of the `Spectrum`; what it needs (`Needed`) and the ``error`` (panels,) of the series; whether
    ``rows`` are kinks; natural ``digits``; `gauss_table`; ``out`` (k, 3, waves >= 3), which receives A_m, B_m and, in its
    last row, the directional albedo, the error of R due to that of the series, and that due to waves that are cut off;
    ``effort`` (1,), evaluations.
    """

    def ring_sums(slopes, p, weight, width, layers, peaks, planes, corner, edges, detail, breaks, series, used, bent, rest, cut, error, rows, digits, x_table, w_table, out, effort):  # type: ignore[no-untyped-def]  # noqa: E501
        most = out.shape[2]
        points, cuts = np.empty(CAPACITY + 2 * breaks.size), np.empty(planes.shape[1])
        touch = np.empty((2 + 2 * planes.shape[1] + planes.shape[1] * (planes.shape[1] + 1) // 2, 2))
        room = (RING + 2 * most) // LANES * LANES
        nodes, weights = np.empty(room), np.empty(room)
        cosine, kernel = np.empty(room), np.empty(room)
        c0, c1 = np.empty(room), np.empty(room)
        degree = series.shape[1] - 1
        wave, moments = np.empty(most + 4), np.zeros((degree + 1, most))
        for slope in range(slopes.shape[0]):
            cn, sn = slopes[slope, 0], slopes[slope, 1]
            theta_n = math.atan2(sn, cn)
            layer = layers[slope]
            total = out[slope]
            total[:] = 0.0
            touching = tangents(touch, sn, cn, theta_n, planes[slope], corner)
            panels = theta_panels(
                points, touch, touching, sn, cn, theta_n, width, layer, peaks[slope], planes[slope], corner, edges, rows
            )
            held = 0  # the panel of the source whose moments are being summed
            for panel in range(panels - 1):
                a, b = points[panel], points[panel + 1]
                turn = turn_of(a, b, sn, cn, planes[slope])
                bend, beyond = 0.0, 0.0
                for k in range(_panel_of(breaks, a), _panel_of(breaks, b) + 1):
                    bend = max(bend, 0.25 * min(bent[k], most) * turn)
                    beyond = max(beyond, rest[1, k] * root(turn))
                if rows:
                    bend += 0.5 * degree
                else:
                    panels_across = (b - a) * finest_detail(edges, detail, a, b)
                    bend += GAUSSIAN * math.sqrt(digits) * panels_across
                    beyond = max(beyond, 0.5 * (SERIES * digits * digits * min(1.0, panels_across)) ** (1.0 / 3.0))
                order, starts, ends = theta_order(
                    a, b, touch, touching, theta_n, width, layer, peaks[slope], beyond, digits
                )
                pieces, q = parts(bend, order)
                start = q * (q - 1) // 2
                for i in range(q * pieces):
                    x, w = (i // q + x_table[start + i % q]) / pieces, w_table[start + i % q] / pieces
                    # (t - tangent)^(3/2) at one end or both, which this makes smooth
                    if starts and not ends:
                        t, dt = a + (b - a) * x * x, (b - a) * 2.0 * x * w
                    elif ends and not starts:
                        t, dt = b - (b - a) * x * x, (b - a) * 2.0 * x * w
                    elif starts:
                        t, dt = a + (b - a) * x * x * (3.0 - 2.0 * x), (b - a) * 6.0 * x * (1.0 - x) * w
                    else:
                        t, dt = a + (b - a) * x, (b - a) * w
                    st, ct = math.sin(t), math.cos(t)
                    k = _panel_of(breaks, t)
                    waves = min(used[k], most)
                    n = ring_nodes(
                        cuts, t, st, ct, sn, cn, theta_n, width, layer, peaks[slope], planes[slope], corner,
                        0.25 * (waves - 1), rest[0, k], digits, 2.0 * st * dt * weight, x_table, w_table, nodes, weights,
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
                    s0, s1 = 0.0, 0.0
                    for j in range(n):
                        s0 += kernel[j]
                        c0[j] = 1.0
                        c1[j] = 0.5 * cosine[j]
                        s1 += kernel[j] * c1[j]
                    wave[0], wave[1] = s0, s1
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
                    total[2, 2] += cut[k] * abs(wave[0])
                    if k != held:
                        _gather(series[held], moments, total)
                        held = k
                    u = (2.0 * t - breaks[k] - breaks[k + 1]) / (breaks[k + 1] - breaks[k])
                    before, now = 1.0, u
                    for j in range(degree + 1):
                        row = moments[j]
                        for m in range(waves):
                            row[m] += before * wave[m]
                        before, now = now, 2.0 * u * now - before
            _gather(series[held], moments, total)

    return jit.kernel(ring_sums)
