"""Panels across the rings of a cap: where they end, which map gathers nodes in each, and the rings of one.

What calls for panels, and why its singularities do no harm, is said in `gonio.integrate.cap`, whose `frame` has laid the
geometry `g`.
"""

from __future__ import annotations

import math

from gonio import jit
from gonio.brdf.elementary import exp, sine_and_cosine

HALF_PI = 0.5 * math.pi
TWO_PI = 2.0 * math.pi
NO_LAYER = 10.0  # depth that stands for no structure at the horizon
MAX_FEATURES = 24
MAX_PANELS = 32
_ROOT_HALF = math.sqrt(0.5)
_FAR = 3.6  # widths on both sides of a feature beyond which its panel is two: sinh 2


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
def ring_positions(x, w, panel, u0, u1, rings):  # type: ignore[no-untyped-def]
    """Rings of a panel, for nodes and weights on [0, 1], into the rows: offset from the panel's centre, weight.

    u0 < u1 bound the sinh map, if there is one. Then rows 2 to 5: sine and cosine of t / 2 and of t.
    """
    a, b, centre, scale = panel[0], panel[1], panel[2], panel[3]
    root_a, root_b = panel[4] > 0.0, panel[5] > 0.0
    y, dt, sh, ch, st, ct = rings[0], rings[1], rings[2], rings[3], rings[4], rings[5]
    for i in range(x.size):
        s, ds = x[i], w[i]
        if root_a:
            if root_b:
                s, ds = x[i] * x[i] * (3.0 - 2.0 * x[i]), 6.0 * x[i] * (1.0 - x[i]) * w[i]
            else:
                s, ds = x[i] * x[i], 2.0 * x[i] * w[i]
        elif root_b:
            s, ds = 1.0 - (1.0 - x[i]) * (1.0 - x[i]), 2.0 * (1.0 - x[i]) * w[i]
        y[i], dt[i] = s, ds
    if u0 == u1:
        for i in range(x.size):
            y[i], dt[i] = (a - centre) + (b - a) * y[i], (b - a) * dt[i]
    else:
        for i in range(x.size):
            e = exp(u0 + (u1 - u0) * y[i])
            y[i], dt[i] = 0.5 * scale * (e - 1.0 / e), 0.5 * scale * (e + 1.0 / e) * (u1 - u0) * dt[i]
    if centre == HALF_PI:
        for i in range(x.size):
            p, q = sine_and_cosine(0.5 * y[i])
            sh[i], ch[i] = _ROOT_HALF * (q + p), _ROOT_HALF * (q - p)
            st[i], ct[i] = (q - p) * (q + p), -2.0 * p * q
    else:
        for i in range(x.size):
            p, q = sine_and_cosine(0.5 * (centre + y[i]))
            sh[i], ch[i], st[i], ct[i] = p, q, 2.0 * p * q, (q - p) * (q + p)
