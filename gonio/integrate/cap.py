r"""Quadrature over the directions that light a surface element: a cap of the sphere above the surface's horizon.

.. math:: \int_{\text{cap}\,\cap\,\{n\cdot\omega>0\}} f_r\,L_i\,\cos\theta_i\,\mathrm{d}\omega_i

This is the general integral of the memo's section 13 in both of its forms: polar coordinates about the surface normal,
clipped by the source (local form), or about the source's axis, clipped by the surface's horizon (viewer form, when the
axis is the viewer's). On the ring of polar angle t about the pole, the other boundary, a cap of half angle delta whose
centre is gamma away, cuts out

.. math:: \tan^2\frac{\chi}{2} \le \frac{\sin\frac{\delta+t-\gamma}{2}\,\sin\frac{\delta-t+\gamma}{2}}
                                        {\sin\frac{t+\gamma+\delta}{2}\,\sin\frac{t+\gamma-\delta}{2}} ,

which cancels nowhere.

Gauss-Legendre nodes follow the structure. Across the rings, panels end where a ring begins or ceases to be cut (there
the integrand behaves like a square root, which a quadratic substitution takes out) and where the BRDF declares kinks. In
between, t = c + s sinh u gathers nodes around features of width s at c: the mirror direction; the horizon, a layer of the
width of the shadowing's or of the view's grazing angle; a cut or a rim that runs through the lobe. Along a ring, with d
the azimuth from the mirror direction, tan(d/4) = e sinh u does the same: the lobes' denominators vanish at
tan(d/2) = +-i eps [2]_. In u all singularities are about pi/2 away, for any width, so convergence is geometric and no
lobe is too narrow to be seen. The panels are made in `gonio.integrate.panels`, the nodes of a ring here.

References
----------
.. [1] B. K. P. Horn, R. W. Sjoberg, MIT AI Memo 498, 1978, section 13.
.. [2] T. W. Tee, L. N. Trefethen, "A rational spectral collocation method with adaptively transformed Chebyshev grid
   points", SIAM J. Sci. Comput. 28, 2006, on maps that push complex singularities away.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.brdf.arctangent import arctan
from gonio.brdf.elementary import exp, log1p, sine_and_cosine
from gonio.integrate.panels import (
    HALF_PI,
    MAX_FEATURES,
    MAX_PANELS,
    NO_LAYER,
    TWO_PI,
    ring_eps,
    ring_features,
    ring_positions,
    split,
)

Array = NDArray[np.float64]
MAX_ARCS = 24
NODE_ROWS = 5  # x, y, z of the direction, weight with cos theta_i, cosine from the cap's axis


@functools.cache
def unit_rule(order: int) -> tuple[Array, Array]:
    """Gauss-Legendre nodes and weights on [0, 1]."""
    x, w = np.polynomial.legendre.leggauss(order)
    return (x + 1.0) / 2.0, w / 2.0


@jit.model
def arsinh(x):  # type: ignore[no-untyped-def]
    """arsinh of x >= 0 without a branch or a call."""
    return log1p(x + x * x / (1.0 + math.sqrt(1.0 + x * x)))


@jit.model
def from_edge(a, turn, width, u1, sign, x, w, cosines, sines, weights):  # type: ignore[no-untyped-def]
    """Nodes that gather in a layer of some width at the end a of an interval, which lies to the side `turn`."""
    for j in range(x.size):
        e = exp(u1 * x[j])
        r = 1.0 / e
        s, c = sine_and_cosine(a + turn * 0.5 * width * (e - r))
        cosines[j], sines[j], weights[j] = c, sign * s, w[j] * 0.5 * width * (e + r) * u1


@jit.model
def about_lobe(e4, u0, u1, sign, x, w, cosines, sines, weights):  # type: ignore[no-untyped-def]
    """Nodes d on an interval of a half ring with tan(d / 4) = e4 sinh u, for u in [u0, u1]."""
    for j in range(x.size):
        e = exp(u0 + (u1 - u0) * x[j])
        r = 1.0 / e
        tau = 0.5 * e4 * (e - r)
        q = 1.0 / (1.0 + tau * tau)
        ch, sh = (1.0 - tau * tau) * q, 2.0 * tau * q
        cosines[j], sines[j] = (ch - sh) * (ch + sh), sign * 2.0 * sh * ch
        weights[j] = w[j] * (u1 - u0) * 2.0 * e4 * (e + r) * q


@jit.model
def half_ring(a, b, eps, near, edge):  # type: ignore[no-untyped-def]
    """Nodes on [a, b] within [0, pi], d from the mirror direction: u0, u1, e4 of `about_lobe` and u1 of `from_edge`.

    Layers: the lobe, eps wide, at 0; edges of width `near` at a and `edge` at b. `from_edge` begins at b, or at a if the
    last number is true; nothing is to be laid where a map has no length.
    """
    e4 = eps / (1.0 + math.sqrt(max(0.0, 1.0 - eps * eps)))
    at_a = near < b - a
    c = min(max(0.5 * (b * b + edge * edge - 4.0 * eps * eps) / b, a), b) if edge < b else b
    sine, cosine = sine_and_cosine(0.25 * a)
    u0 = arsinh(sine / (cosine * e4))
    sine, cosine = sine_and_cosine(0.25 * c)
    u1 = u0 if at_a else arsinh(sine / (cosine * e4))
    return u0, u1, e4, arsinh((b - a) / near if at_a else (b - c) / edge), at_a


@jit.model
def frame(cos_n, sin_n, ax, ay, az, half_angle, about_normal, g):  # type: ignore[no-untyped-def]
    """Geometry of the rings into g: 0-2 u, 3-5 v, 6-8 pole, 9 gamma, 10 delta, 11 t_end, 12 t_m, 13 chi_m.

    Then 14-17: sin and cos of (delta - gamma) / 2 and of (delta + gamma) / 2.
    """
    if about_normal:
        px, py, pz, cx, cy, cz = 0.0, 0.0, 1.0, ax, ay, az
        delta, t_end = half_angle, HALF_PI
    else:
        px, py, pz, cx, cy, cz = ax, ay, az, 0.0, 0.0, 1.0
        delta, t_end = HALF_PI, half_angle
    kx, ky, kz = py * cz - pz * cy, pz * cx - px * cz, px * cy - py * cx
    cross = math.sqrt(kx * kx + ky * ky + kz * kz)
    gamma = math.atan2(cross, px * cx + py * cy + pz * cz)
    if delta >= math.pi or cross < 1e-150:  # no clip, or one around the pole: count azimuth from the mirror direction
        cx, cy, cz = sin_n, 0.0, cos_n
    along = cx * px + cy * py + cz * pz
    ux, uy, uz = cx - along * px, cy - along * py, cz - along * pz
    length = math.sqrt(ux * ux + uy * uy + uz * uz)
    if length < 1e-12:  # no azimuth is special; stay in the plane of the viewer if the pole is in it
        if abs(py) < 0.9:
            ux, uy, uz = pz, 0.0, -px
        else:
            ux, uy, uz = 1.0 - px * px, -px * py, -px * pz
        length = math.sqrt(ux * ux + uy * uy + uz * uz)
    ux, uy, uz = ux / length, uy / length, uz / length
    vx, vy, vz = py * uz - pz * uy, pz * ux - px * uz, px * uy - py * ux
    m1, m2, m3 = sin_n * ux + cos_n * uz, sin_n * vx + cos_n * vz, sin_n * px + cos_n * pz
    g[0], g[1], g[2], g[3], g[4], g[5], g[6], g[7], g[8] = ux, uy, uz, vx, vy, vz, px, py, pz
    g[9], g[10], g[11] = gamma, delta, t_end
    g[12], g[13] = math.atan2(math.hypot(m1, m2), m3), math.atan2(m2, m1)
    g[14], g[15] = math.sin(0.5 * (delta - gamma)), math.cos(0.5 * (delta - gamma))
    g[16], g[17] = math.sin(0.5 * (delta + gamma)), math.cos(0.5 * (delta + gamma))


@jit.model
def insert(points, n, chi):  # type: ignore[no-untyped-def]
    """Insert into the ascending points; their new number."""
    j = n
    while points[j - 1] > chi:
        points[j] = points[j - 1]
        j -= 1
    points[j] = chi
    return n + 1


@jit.model
def reaches(rings, g):  # type: ignore[no-untyped-def]
    """Azimuth up to which the clip leaves something of each ring, into row 6: 0 if nothing, pi if all."""
    sh, ch, reach = rings[2], rings[3], rings[6]
    for i in range(reach.size):
        # products of sines of half of delta -+ (gamma - t) and of t + gamma +- delta
        inside = (g[14] * ch[i] + g[15] * sh[i]) * (g[16] * ch[i] - g[17] * sh[i])
        beyond = (sh[i] * g[17] + ch[i] * g[16]) * (sh[i] * g[15] - ch[i] * g[14])
        cut = beyond > 0.0
        left = 2.0 * arctan(math.sqrt(max(inside, 0.0)), math.sqrt(beyond if cut else 1.0))
        reach[i] = (left if cut else math.pi) if inside > 0.0 else 0.0


@jit.model
def arcs(reach, st, ct, symmetric, planes, g, points):  # type: ignore[no-untyped-def]
    """Azimuths that bound the pieces of a ring of which the clip leaves `reach`, ascending, into points."""
    chi_m = g[13]
    lower, upper, whole = chi_m - math.pi, chi_m + math.pi, True
    if reach < math.pi:
        lower, upper, whole = -reach, reach, False
    if symmetric:
        if whole:
            lower, upper = 0.0, math.pi
        else:
            lower = 0.0
    points[0] = lower
    n = 1
    if not (whole or symmetric) and min(abs(chi_m), math.pi - abs(chi_m)) > 1e-12:
        points[n] = 0.0  # so that a piece has one edge only
        n += 1
    first = math.ceil((lower - chi_m) / math.pi + 1e-12)
    while chi_m + first * math.pi < upper - 1e-12 and n < points.size - 1:
        n = insert(points, n, chi_m + first * math.pi)
        first += 1
    for k in range(planes.shape[0]):
        cz = planes[k, 0] * g[6] + planes[k, 1] * g[7] + planes[k, 2] * g[8]
        cu = planes[k, 0] * g[0] + planes[k, 1] * g[1] + planes[k, 2] * g[2]
        cv = planes[k, 0] * g[3] + planes[k, 1] * g[4] + planes[k, 2] * g[5]
        across, rest = st * math.hypot(cu, cv), planes[k, 3] - cz * ct
        if across > abs(rest):
            centre, half = math.atan2(cv, cu), math.acos(rest / across)
            for sign in (-1.0, 1.0):
                for turn in (-TWO_PI, 0.0, TWO_PI):
                    chi = centre + sign * half + turn
                    if chi > lower + 1e-12 and chi < upper - 1e-12 and n < points.size - 1:
                        n = insert(points, n, chi)
    points[n] = upper
    return n + 1, whole


@jit.model
def one_piece(rings, flipped, layer, sin_gamma):  # type: ignore[no-untyped-def]
    """`half_ring` of rings of which the clip leaves one piece from the plane of symmetry on, into rows 8 to 12.

    u0, u1, e4 and v, and the width of the layer at the end that the clip has made, if there is one.
    """
    st, reach, eps = rings[4], rings[6], rings[7]
    for i in range(reach.size):
        left = reach[i] if reach[i] > 0.0 else math.pi
        sine, _ = sine_and_cosine(left)
        edge = layer / max(sin_gamma * st[i] * abs(sine), 1e-300) if left < math.pi and layer > 0.0 else 10.0
        a, b = (math.pi - left, math.pi) if flipped else (0.0, left)
        u0, u1, e4, v, _ = half_ring(a, b, eps[i], edge if flipped else 10.0, 10.0 if flipped else edge)
        rings[8, i], rings[9, i], rings[10, i], rings[11, i], rings[12, i] = u0, u1, e4, v, edge


@jit.part
def lay(u0, u1, e4, v, at_a, a, b, near, edge, sign, x, w, arc, m):  # type: ignore[no-untyped-def]
    """The nodes of one `half_ring` into rows of `arc` (cosine, sine, weight) from m on; their new number."""
    n = x.size
    if u1 > u0:
        about_lobe(e4, u0, u1, sign, x, w, arc[0, m : m + n], arc[1, m : m + n], arc[2, m : m + n])
        m += n
    if v > 0.0:
        some = arc[0, m : m + n], arc[1, m : m + n], arc[2, m : m + n]
        from_edge(a if at_a else b, 1.0 if at_a else -1.0, near if at_a else edge, v, sign, x, w, *some)
        m += n
    return m


@jit.model
def element_nodes(  # type: ignore[no-untyped-def]
    cos_n, sin_n, axis, half_angle, about_normal, width, depth, planes, symmetric, x, w, scratch, nodes, count
):
    """Append the nodes of one element to `nodes` (NODE_ROWS, ...); the new count, or -1 if they don't fit.

    `width` is the lobe's, `depth` that of the structure at the horizon [rad].
    """
    g, features, panels, points, rings, arc = scratch
    frame(cos_n, sin_n, axis[0], axis[1], axis[2], half_angle, about_normal, g)
    ux, uy, uz, vx, vy, vz, px, py, pz = g[0], g[1], g[2], g[3], g[4], g[5], g[6], g[7], g[8]
    ax, ay, az, t_m, chi_m = axis[0], axis[1], axis[2], g[12], g[13]
    lobe = width < 10.0
    layer = max(min(depth, cos_n), 1e-15) if depth < NO_LAYER else NO_LAYER
    layered = lobe and layer < NO_LAYER and not about_normal
    n_features = ring_features(cos_n, sin_n, about_normal, width, depth, planes, g, features)
    n_panels = split(features, n_features, g[11], panels)
    cm, sm = math.cos(chi_m), math.sin(chi_m)
    half = 2.0 if symmetric else 1.0
    sin_gamma = math.sin(g[9])
    n = x.size
    y, dt, st, ct, reach, eps = rings[0], rings[1], rings[4], rings[5], rings[6], rings[7]
    single = symmetric and planes.shape[0] == 0  # one piece per ring, with the lobe's azimuth at one end
    flipped = abs(chi_m) > HALF_PI
    for k in range(n_panels):
        panel = panels[k]
        start, end, centre, scale = panel[0], panel[1], panel[2], panel[3]
        u0 = u1 = 0.0
        if scale > 0.0 and scale <= 3.0 * (end - start):
            u0, u1 = math.asinh((start - centre) / scale), math.asinh((end - centre) / scale)
        ring_positions(x, w, panel, u0, u1, rings)
        if g[10] < math.pi:
            reaches(rings, g)
        else:
            reach[:] = math.pi
        eps[:] = 1.0
        if lobe:
            for i in range(n):
                eps[i] = ring_eps(centre + y[i], st[i], ct[i], cos_n, sin_n, t_m, about_normal, width)
        if single:
            one_piece(rings, flipped, layer if layered else 0.0, sin_gamma)
        for i in range(n):
            t = centre + y[i]
            if t <= 0.0 or t >= g[11] or (about_normal and ct[i] <= 0.0) or not reach[i] > 0.0:
                continue
            m = 0
            n_points, whole = (2, False) if single else arcs(reach[i], st[i], ct[i], symmetric, planes, g, points)
            for piece in range(n_points - 1):
                if m + 2 * n > arc.shape[1]:
                    return -1
                near = edge = 10.0
                if single:
                    even = not flipped
                    a, b = (0.0, reach[i]) if even else (math.pi - reach[i], math.pi)
                    p0, p1, e4, v, near = rings[8, i], rings[9, i], rings[10, i], rings[11, i], rings[12, i]
                    edge, at_a = near, flipped and near < b - a
                else:
                    c0, c1 = points[piece] - chi_m, points[piece + 1] - chi_m
                    turn = math.floor(0.5 * (c0 + c1) / math.pi)
                    even = turn % 2 == 0  # the lobe is at even multiples of pi
                    a = c0 - turn * math.pi if even else (turn + 1) * math.pi - c1
                    b = c1 - turn * math.pi if even else (turn + 1) * math.pi - c0
                    a, b = max(a, 0.0), min(b, math.pi)
                    first, last = piece == 0 and not symmetric, piece == n_points - 2
                    if layered and not whole and (first or last):
                        slope = sin_gamma * st[i] * abs(math.sin((c1 if last else c0) + chi_m))
                        if last == even:
                            edge = layer / max(slope, 1e-300)
                        else:
                            near = layer / max(slope, 1e-300)
                    if not b > a:
                        continue
                    p0, p1, e4, v, at_a = half_ring(a, b, eps[i], near, edge)
                m = lay(p0, p1, e4, v, at_a, a, b, near, edge, 1.0 if even else -1.0, x, w, arc, m)
            if count + m > nodes.shape[1]:
                return -1
            out_x, out_y, out_z = nodes[0, count : count + m], nodes[1, count : count + m], nodes[2, count : count + m]
            out_w, out_a = nodes[3, count : count + m], nodes[4, count : count + m]
            cosines, sines, weights = arc[0], arc[1], arc[2]
            s_t, c_t, weight = st[i], ct[i], half * st[i] * dt[i]
            for j in range(m):
                c, s = cm * cosines[j] - sm * sines[j], sm * cosines[j] + cm * sines[j]
                p, q = s_t * c, s_t * s
                xi, yi, zi = p * ux + q * vx + c_t * px, p * uy + q * vy + c_t * py, p * uz + q * vz + c_t * pz
                lit = zi > 0.0  # rounding at the horizon may say otherwise
                out_x[j], out_y[j], out_z[j] = xi, yi, zi if lit else 1.0
                out_w[j] = weight * weights[j] * zi if lit else 0.0
                out_a[j] = xi * ax + yi * ay + zi * az
            count += m
    return count


def _ring_nodes(  # type: ignore[no-untyped-def]
    some, cos_n, sin_n, axis, half_angle, about_normal, width, depth, planes, symmetric, x, w, nodes, starts
):
    scratch = (
        np.empty(18), np.empty((MAX_FEATURES, 3)), np.empty((MAX_PANELS, 6)), np.empty(MAX_ARCS),
        np.empty((13, x.size)), np.empty((3, 2 * MAX_ARCS * x.size)),
    )  # fmt: skip
    count = 0
    starts[0] = 0
    for k in range(some.size):
        i = some[k]
        more = element_nodes(
            cos_n[i], sin_n[i], axis[i], half_angle, about_normal[i], width, depth, planes[i], symmetric[i],
            x, w, scratch, nodes, count,
        )  # fmt: skip
        if more < 0:
            return k
        count = more
        starts[k + 1] = count
    return some.size


ring_nodes = jit.kernel(_ring_nodes, fastmath=False)
