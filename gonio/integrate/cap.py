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
lobe is too narrow to be seen.

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

Array = NDArray[np.float64]
HALF_PI = 0.5 * math.pi
TWO_PI = 2.0 * math.pi
NO_LAYER = 10.0  # depth that stands for no structure at the horizon
_ROOT_HALF = math.sqrt(0.5)
MAX_FEATURES = 24
MAX_PANELS = 32
MAX_ARCS = 24
NODE_ROWS = 5  # x, y, z of the direction, weight with cos theta_i, cosine from the cap's axis
_FAR = 3.6  # widths on both sides of a feature beyond which its panel is two: sinh 2


@functools.cache
def unit_rule(order: int) -> tuple[Array, Array]:
    """Gauss-Legendre nodes and weights on [0, 1]."""
    x, w = np.polynomial.legendre.leggauss(order)
    return (x + 1.0) / 2.0, w / 2.0


@jit.model
def add(features, n, at, scale, cut, end):  # type: ignore[no-untyped-def]
    """Append a feature (position, scale, whether a panel must end there); cuts outside (0, end) are dropped."""
    if n >= features.shape[0] or (cut and not (at > 0.0 and at < end)):
        return n
    features[n, 0], features[n, 1], features[n, 2] = at, scale, 1.0 if cut else 0.0
    return n + 1


@jit.model
def split(features, n, end, panels):  # type: ignore[no-untyped-def]
    """Panels (start, end, centre, scale, root at start, root at end) on [0, end]; returns how many.

    Panels end at cuts; between cuts, t belongs to the feature with the least (t - at)^2 + scale^2, which asks for the
    finest nodes there. That lower envelope of parabolas is one of straight lines, walked from left to right.
    """
    count = 0
    a, a_cut = 0.0, False
    while True:
        b, b_cut = end, False
        for k in range(n):
            if features[k, 2] > 0.0 and features[k, 0] > a and features[k, 0] < b:
                b, b_cut = features[k, 0], True
        t = a
        at_start = a_cut
        if n == 0:
            panels[count, 0], panels[count, 1], panels[count, 2], panels[count, 3] = a, b, 0.0, 0.0
            panels[count, 4], panels[count, 5] = 0.0, 0.0
            count += 1
        else:
            best = 0
            for k in range(1, n):
                now = (t - features[k, 0]) ** 2 + features[k, 1] ** 2
                old = (t - features[best, 0]) ** 2 + features[best, 1] ** 2
                if now < old or (now == old and features[k, 0] > features[best, 0]):
                    best = k
            while count < panels.shape[0]:
                nearest, following = b, -1
                c, s = features[best, 0], features[best, 1]
                for k in range(n):
                    if features[k, 0] > c:
                        away = (features[k, 1] - s) * (features[k, 1] + s) / (features[k, 0] - c)
                        cross = 0.5 * (features[k, 0] + c + away)
                        if cross < nearest and cross >= t:
                            nearest, following = cross, k
                if nearest > t:
                    if s > 0.0 and c - t > _FAR * s and nearest - c > _FAR * s and count < panels.shape[0] - 1:
                        panels[count, 0], panels[count, 1], panels[count, 2], panels[count, 3] = t, c, c, s
                        panels[count, 4], panels[count, 5] = 1.0 if at_start else 0.0, 0.0
                        at_start = False
                        count += 1
                        t = c
                    panels[count, 0], panels[count, 1], panels[count, 2], panels[count, 3] = t, nearest, c, s
                    panels[count, 4] = 1.0 if at_start else 0.0
                    panels[count, 5] = 1.0 if following < 0 and b_cut else 0.0
                    at_start = False
                    count += 1
                    t = nearest
                if following < 0:
                    break
                best = following
        if not b_cut or count >= panels.shape[0]:
            return count
        a, a_cut = b, True


@jit.model
def exponential(x):  # type: ignore[no-untyped-def]
    """exp(x) for abs(x) < 40 without a branch or a call, so that loops vectorise; relative error 3e-14."""
    y = x * (1.0 / 256.0)
    e = 1.0 + y * (1.0 + y * (1.0 / 2.0) * (1.0 + y * (1.0 / 3.0) * (1.0 + y * (1.0 / 4.0) * (1.0 + y * (1.0 / 5.0) * (
        1.0 + y * (1.0 / 6.0) * (1.0 + y * (1.0 / 7.0) * (1.0 + y * (1.0 / 8.0) * (1.0 + y * (1.0 / 9.0)))))))))  # fmt: skip
    for _ in range(8):
        e = e * e
    return e


@jit.model
def ring_position(x, w, panel, u0, u1):  # type: ignore[no-untyped-def]
    """Offset from the panel's centre, and weight, of a node and weight on [0, 1]; u0 < u1 bound the sinh map, if any."""
    a, b, centre, scale, root_a, root_b = panel[0], panel[1], panel[2], panel[3], panel[4], panel[5]
    if root_a > 0.0:
        if root_b > 0.0:
            s, ds = x * x * (3.0 - 2.0 * x), 6.0 * x * (1.0 - x) * w
        else:
            s, ds = x * x, 2.0 * x * w
    elif root_b > 0.0:
        s, ds = 1.0 - (1.0 - x) * (1.0 - x), 2.0 * (1.0 - x) * w
    else:
        s, ds = x, w
    if u0 == u1:
        return (a - centre) + (b - a) * s, (b - a) * ds
    e = math.exp(u0 + (u1 - u0) * s)
    return 0.5 * scale * (e - 1.0 / e), 0.5 * scale * (e + 1.0 / e) * (u1 - u0) * ds


@jit.model
def half_ring(a, b, eps, near, edge, sign, x, w, cosines, sines, weights, count):  # type: ignore[no-untyped-def]
    """Nodes on [a, b] within [0, pi], d from the mirror direction: cos d, sign sin d, weights.

    Layers: the lobe, eps wide, at 0; edges of width `near` at a and `edge` at b.
    """
    if not b > a:
        return count
    if near < b - a:
        u1 = math.asinh((b - a) / near)
        for j in range(x.size):
            e = math.exp(u1 * x[j])
            d = a + 0.5 * near * (e - 1.0 / e)
            cosines[count + j], sines[count + j] = math.cos(d), sign * math.sin(d)
            weights[count + j] = w[j] * 0.5 * near * (e + 1.0 / e) * u1
        return count + x.size
    e4 = eps / (1.0 + math.sqrt(max(0.0, 1.0 - eps * eps)))
    c = b
    if edge < b:
        c = min(max(0.5 * (b * b + edge * edge - 4.0 * eps * eps) / b, a), b)
    n = x.size
    if c > a:
        u0 = 0.0 if a == 0.0 else math.asinh(math.tan(0.25 * a) / e4)
        u1 = math.asinh((1.0 if c == math.pi else math.tan(0.25 * c)) / e4)
        some_c, some_s, some_w = cosines[count : count + n], sines[count : count + n], weights[count : count + n]
        for j in range(n):
            e = exponential(u0 + (u1 - u0) * x[j])
            r = 1.0 / e
            tau = 0.5 * e4 * (e - r)
            q = 1.0 / (1.0 + tau * tau)
            ch, sh = (1.0 - tau * tau) * q, 2.0 * tau * q
            some_c[j] = (ch - sh) * (ch + sh)
            some_s[j] = sign * 2.0 * sh * ch
            some_w[j] = w[j] * (u1 - u0) * 2.0 * e4 * (e + r) * q
        count += n
    if c < b:
        u1 = math.asinh((b - c) / edge)
        for j in range(n):
            e = math.exp(u1 * x[j])
            d = b - 0.5 * edge * (e - 1.0 / e)
            cosines[count + j], sines[count + j] = math.cos(d), sign * math.sin(d)
            weights[count + j] = w[j] * 0.5 * edge * (e + 1.0 / e) * u1
        count += n
    return count


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
def ring_eps(t, st, ct, cos_n, sin_n, t_m, about_normal, width):  # type: ignore[no-untyped-def]
    """eps of the lobe along a ring: its denominator vanishes at tan(d/2) = +- i eps. Exact for GGX about the normal."""
    if about_normal:
        a = (st - sin_n) ** 2 + (width * (ct + cos_n)) ** 2
        b = 4.0 * st * sin_n
    else:
        a = (t - t_m) ** 2 + (2.0 * width * cos_n) ** 2
        b = 4.0 * st * math.sin(t_m)
    a = max(a, 1e-30)
    return math.sqrt(a / (a + b))


@jit.model
def ring_features(cos_n, sin_n, about_normal, width, depth, planes, g, features):  # type: ignore[no-untyped-def]
    """Where the integrand across the rings needs nodes: cuts, the lobe, layers at the horizon, kinks."""
    gamma, delta, t_end, t_m, chi_m = g[9], g[10], g[11], g[12], g[13]
    lobe = width < 10.0
    layer = max(min(depth, cos_n), 1e-15) if depth < NO_LAYER else NO_LAYER
    n = 0
    if delta < math.pi:
        for k in range(3):
            t = abs(gamma - delta) if k == 0 else (gamma + delta if k == 1 else TWO_PI - gamma - delta)
            scale = 10.0
            if lobe:
                far = chi_m if (k == 1 or (k == 0 and gamma > delta)) else math.pi - abs(chi_m)
                st, ct = math.sin(t), math.cos(t)
                eps = ring_eps(t, st, ct, cos_n, sin_n, t_m, about_normal, width)
                scale = 0.5 * (far * far + 4.0 * eps * eps) * abs(st) * math.sin(gamma) / max(math.sin(delta), 1e-300)
                if about_normal:  # so that the horizon's layer, however thin, leaves the square root a panel
                    scale = min(scale, 0.5 * abs(HALF_PI - t))
                else:
                    scale = min(scale, layer)
                scale = max(scale, 1e-15)
            n = add(features, n, t, scale, True, t_end)
        if lobe and about_normal and g[1] != 0.0:  # where the rim crosses the plane of incidence
            cx, cy, cz = math.sin(gamma) * g[0], math.sin(gamma) * g[1], math.cos(gamma)
            r = math.hypot(cx, cz)
            if r > abs(math.cos(delta)):
                half = math.acos(math.cos(delta) / r)
                for k in range(2):
                    t = math.atan2(cx, cz) + (half if k == 0 else -half)
                    if t > 0.0 and t < t_end:
                        st, ct = math.sin(t), math.cos(t)
                        eps = ring_eps(t, st, ct, cos_n, sin_n, t_m, True, width)
                        slope = max(abs(cx * ct - cz * st), 1e-15)
                        scale = 2.0 * eps * st * (abs(cy) + eps * abs(cx)) / slope
                        n = add(features, n, t, max(scale, 1e-15), False, t_end)
    if lobe:
        n = add(features, n, t_m, 2.0 * width * (1.0 if about_normal else max(cos_n, width)), False, t_end)
        if about_normal and layer < NO_LAYER:
            n = add(features, n, HALF_PI, layer, False, t_end)
    for k in range(planes.shape[0]):
        cz = planes[k, 0] * g[6] + planes[k, 1] * g[7] + planes[k, 2] * g[8]
        cu = planes[k, 0] * g[0] + planes[k, 1] * g[1] + planes[k, 2] * g[2]
        cv = planes[k, 0] * g[3] + planes[k, 1] * g[4] + planes[k, 2] * g[5]
        if abs(planes[k, 3]) < 1.0:
            away, half = math.atan2(math.hypot(cu, cv), cz), math.acos(planes[k, 3])
            n = add(features, n, abs(away - half), 10.0, True, t_end)
            n = add(features, n, away + half, 10.0, True, t_end)
            n = add(features, n, TWO_PI - away - half, 10.0, True, t_end)
    return n


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
def arcs(sh, ch, st, ct, symmetric, planes, g, points):  # type: ignore[no-untyped-def]
    """Azimuths that bound the pieces of a ring, ascending, into points; 0 if all of it is cut away."""
    delta, chi_m = g[10], g[13]
    lower, upper, whole = chi_m - math.pi, chi_m + math.pi, True
    if delta < math.pi:
        # products of sines of half of delta -+ (gamma - t) and of t + gamma +- delta
        inside = (g[14] * ch + g[15] * sh) * (g[16] * ch - g[17] * sh)
        beyond = (sh * g[17] + ch * g[16]) * (sh * g[15] - ch * g[14])
        if inside <= 0.0:
            return 0, whole
        if beyond > 0.0:
            reach = 2.0 * math.atan2(math.sqrt(inside), math.sqrt(beyond))
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
def element_nodes(  # type: ignore[no-untyped-def]
    cos_n, sin_n, axis, half_angle, about_normal, width, depth, planes, symmetric, x, w, scratch, nodes, count
):
    """Append the nodes of one element to `nodes` (NODE_ROWS, ...); the new count, or -1 if they don't fit.

    `width` is the lobe's, `depth` that of the structure at the horizon [rad].
    """
    g, features, panels, points, cosines, sines, arc = scratch
    frame(cos_n, sin_n, axis[0], axis[1], axis[2], half_angle, about_normal, g)
    ux, uy, uz, vx, vy, vz, px, py, pz = g[0], g[1], g[2], g[3], g[4], g[5], g[6], g[7], g[8]
    ax, ay, az, t_m, chi_m = axis[0], axis[1], axis[2], g[12], g[13]
    lobe = width < 10.0
    layer = max(min(depth, cos_n), 1e-15) if depth < NO_LAYER else NO_LAYER
    n_features = ring_features(cos_n, sin_n, about_normal, width, depth, planes, g, features)
    n_panels = split(features, n_features, g[11], panels)
    cm, sm = math.cos(chi_m), math.sin(chi_m)
    half = 2.0 if symmetric else 1.0
    sin_gamma = math.sin(g[9])
    for k in range(n_panels):
        panel = panels[k]
        start, end, centre, scale = panel[0], panel[1], panel[2], panel[3]
        u0 = u1 = 0.0
        if scale > 0.0 and scale <= 3.0 * (end - start):
            u0, u1 = math.asinh((start - centre) / scale), math.asinh((end - centre) / scale)
        for i in range(x.size):
            y, dt = ring_position(x[i], w[i], panel, u0, u1)
            t = centre + y
            if centre == HALF_PI:
                a, b = math.sin(0.5 * y), math.cos(0.5 * y)
                sh, ch, st, ct = _ROOT_HALF * (b + a), _ROOT_HALF * (b - a), (b - a) * (b + a), -2.0 * a * b
            else:
                sh, ch = math.sin(0.5 * t), math.cos(0.5 * t)
                st, ct = 2.0 * sh * ch, (ch - sh) * (ch + sh)
            if t <= 0.0 or t >= g[11] or (about_normal and ct <= 0.0):
                continue
            n_points, whole = arcs(sh, ch, st, ct, symmetric, planes, g, points)
            eps = ring_eps(t, st, ct, cos_n, sin_n, t_m, about_normal, width) if lobe else 1.0
            m = 0
            for piece in range(n_points - 1):
                c0, c1 = points[piece] - chi_m, points[piece + 1] - chi_m
                turn = math.floor(0.5 * (c0 + c1) / math.pi)
                even = turn % 2 == 0  # the lobe is at even multiples of pi
                a = c0 - turn * math.pi if even else (turn + 1) * math.pi - c1
                b = c1 - turn * math.pi if even else (turn + 1) * math.pi - c0
                a, b = max(a, 0.0), min(b, math.pi)
                near = edge = 10.0
                if lobe and layer < NO_LAYER and not about_normal and not whole:
                    first, last = piece == 0 and not symmetric, piece == n_points - 2
                    if first or last:
                        slope = sin_gamma * st * abs(math.sin((c1 if last else c0) + chi_m))
                        if last == even:
                            edge = layer / max(slope, 1e-300)
                        else:
                            near = layer / max(slope, 1e-300)
                if m + 2 * x.size > arc.size:
                    return -1
                m = half_ring(a, b, eps, near, edge, 1.0 if even else -1.0, x, w, cosines, sines, arc, m)
            if count + m > nodes.shape[1]:
                return -1
            out_x, out_y, out_z = nodes[0, count : count + m], nodes[1, count : count + m], nodes[2, count : count + m]
            out_w, out_a = nodes[3, count : count + m], nodes[4, count : count + m]
            for j in range(m):
                c, s = cm * cosines[j] - sm * sines[j], sm * cosines[j] + cm * sines[j]
                p, q = st * c, st * s
                xi, yi, zi = p * ux + q * vx + ct * px, p * uy + q * vy + ct * py, p * uz + q * vz + ct * pz
                lit = zi > 0.0  # rounding at the horizon may say otherwise
                out_x[j], out_y[j], out_z[j] = xi, yi, zi if lit else 1.0
                out_w[j] = half * st * dt * arc[j] * zi if lit else 0.0
                out_a[j] = xi * ax + yi * ay + zi * az
            count += m
    return count


def _ring_nodes(  # type: ignore[no-untyped-def]
    cos_n, sin_n, axis, half_angle, about_normal, width, depth, planes, symmetric, x, w, nodes, starts
):
    size = 2 * MAX_ARCS * x.size
    scratch = (
        np.empty(18), np.empty((MAX_FEATURES, 3)), np.empty((MAX_PANELS, 6)), np.empty(MAX_ARCS),
        np.empty(size), np.empty(size), np.empty(size),
    )  # fmt: skip
    count = 0
    starts[0] = 0
    for k in range(cos_n.size):
        more = element_nodes(
            cos_n[k], sin_n[k], axis[k], half_angle, about_normal[k], width, depth, planes[k], symmetric[k],
            x, w, scratch, nodes, count,
        )  # fmt: skip
        if more < 0:
            return k
        count = more
        starts[k + 1] = count
    return cos_n.size


ring_nodes = jit.kernel(_ring_nodes, fastmath=False)
