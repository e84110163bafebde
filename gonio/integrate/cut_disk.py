r"""Small disks that a BRDF's kinks cut, and perhaps the surface's horizon too.

A kink is a plane c . w = d. In polar coordinates (t, chi) about the c of one that cuts the disk it is a ring, so that rings
on either side of it see no edge; they are :math:`t = \gamma + \delta\cos\psi`, with gamma the distance of the disk's
centre, which takes the square roots at the disk's ends out. Along a ring, in :math:`\tau = \tan(\chi/2)`, the rim is at

.. math:: \tau^2 = \frac{\sin\frac{\delta+t-\gamma}{2}\,\sin\frac{\delta-t+\gamma}{2}}
                        {\sin\frac{t+\gamma+\delta}{2}\,\sin\frac{t+\gamma-\delta}{2}}

and every other plane at the roots of a quadratic: further edges, between which the integrand is smooth. Panels in psi also
end where such a plane meets the rim or another plane. Gauss-Legendre products climb until two orders agree. A disk on the
pole, a plane that touches a ring within the disk, or orders that do not agree are left to the general rule.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.brdf.base import Term
from gonio.integrate.cap import unit_rule
from gonio.integrate.grid import Gradients, cosines
from gonio.integrate.model_sums import over_nodes, sum_over_nodes
from gonio.source import Cap

Array = NDArray[np.float64]
EPS = float(np.finfo(float).eps)
_ORDERS = (4, 6, 9, 13, 19)
_MOST = 6  # planes that cut one disk, the horizon among them
_ROOM = 1024  # nodes held at once
_CLEAR = 1.5  # half angles that the pole, and the touch of a plane and a ring, must be away from the centre


@functools.cache
def _rules() -> tuple[Array, Array, NDArray[np.int64]]:
    """Gauss-Legendre nodes and weights on [0, 1] of all orders, one after another; and where each starts."""
    rules = [unit_rule(order) for order in _ORDERS]
    starts = np.concatenate(([0], np.cumsum(_ORDERS)))
    return np.concatenate([x for x, _ in rules]), np.concatenate([w for _, w in rules]), starts.astype(np.int64)


def add(
    term: Term, cap: Cap, gradients: Gradients, crossed: NDArray[np.int64], planes: Array, rtol: float, floor: float,
    value: Array, error: Array,
) -> tuple[float, int, NDArray[np.intp]]:  # fmt: skip
    """Add value and error of the gradients `crossed`; the largest relative error, the evaluations, and what is left.

    Parameters
    ----------
    term : Term
    cap : Cap
        A uniform disk.
    gradients : Gradients
    crossed : ndarray of int, shape (m,)
        Indices of gradients for which a plane cuts the disk.
    planes : ndarray, shape (m, k, 4)
        Kinks of the term for each.
    rtol, floor : float
        Tolerance: relative, and of the integral of f_r cos theta_i [1].
    value, error : ndarray, shape (n,)
        Of all gradients.
    """
    x, w, starts = _rules()
    left, counts = np.empty(len(crossed), dtype=np.int64), np.zeros(2, dtype=np.int64)
    worst = _cut_disks(
        gradients.p, gradients.q, crossed, planes, np.array(cap.axis), cap.half_angle, cap.radiance * term.weight,
        term.lobe_width() or 10.0, over_nodes(term.model.function), term.values, x, w, starts, rtol, floor, value, error,
        left, counts,
    )  # fmt: skip
    return float(worst), int(counts[1]), left[: counts[0]].astype(np.intp)


@jit.model
def crosses(px, py, pz, d, ax, ay, az, sine, cosine):  # type: ignore[no-untyped-def]
    """Whether the plane p . w = d cuts the disk around a."""
    along = px * ax + py * ay + pz * az
    across = math.sqrt(max(0.0, 1.0 - along * along))
    high = 1.0 if along >= cosine else along * cosine + across * sine
    low = -1.0 if along <= -cosine else along * cosine - across * sine
    return d > low and d < high


@jit.model
def meet(b, c, a, cosine, pole, gamma, delta, cuts, n):  # type: ignore[no-untyped-def]
    """Append the psi of the points common to two planes (rows of 4) that are on the disk; their new number."""
    dot = b[0] * c[0] + b[1] * c[1] + b[2] * c[2]
    det = 1.0 - dot * dot
    if det < 1e-14:
        return n
    f, g = (b[3] - dot * c[3]) / det, (c[3] - dot * b[3]) / det
    off = (1.0 - f * b[3] - g * c[3]) / det
    if off < 0.0:
        return n
    off = math.sqrt(off)
    kx, ky, kz = b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]
    for side in (-1.0, 1.0):
        x, y, z = (
            f * b[0] + g * c[0] + side * off * kx,
            f * b[1] + g * c[1] + side * off * ky,
            f * b[2] + g * c[2] + side * off * kz,
        )
        if a[0] * x + a[1] * y + a[2] * z < cosine - 1e-9 * (1.0 - cosine):
            continue
        sx, sy, sz = y * pole[2] - z * pole[1], z * pole[0] - x * pole[2], x * pole[1] - y * pole[0]
        t = math.atan2(math.sqrt(sx * sx + sy * sy + sz * sz), x * pole[0] + y * pole[1] + z * pole[2])
        n = insert(cuts, n, (t - gamma) / delta)
    return n


@jit.model
def insert(cuts, n, y):  # type: ignore[no-untyped-def]
    """Insert acos(y) into the ascending cuts if it is new and inside; their new number."""
    if not abs(y) < 1.0 or n >= cuts.size:
        return n
    psi = math.acos(y)
    j = n
    while j > 0 and cuts[j - 1] > psi:
        cuts[j] = cuts[j - 1]
        j -= 1
    cuts[j] = psi
    return n + 1


def _all_pieces(  # type: ignore[no-untyped-def]
    ax, ay, az, s, c, half_angle, planes, weigh, parameters, x, w, starts, rtol, floor, some, cuts, edges, nodes, counts
):
    """Integral of f_r cos theta_i over the disk around a; negative if it is not a case for this rule."""
    sine, cosine = math.sin(half_angle), math.cos(half_angle)
    # the pole: of the planes that cut, the one farthest from the disk's centre
    pole, best, cutting = -1, 0.0, 0
    for k in range(planes.shape[0]):
        if crosses(planes[k, 0], planes[k, 1], planes[k, 2], planes[k, 3], ax, ay, az, sine, cosine):
            if cutting >= _MOST - 1:
                return -1.0
            some[cutting] = planes[k]
            along = planes[k, 0] * ax + planes[k, 1] * ay + planes[k, 2] * az
            if 1.0 - along * along > best:
                pole, best = cutting, 1.0 - along * along
            cutting += 1
    if pole < 0 or math.sqrt(best) < math.sin(min(_CLEAR * half_angle, 1.5)):
        return -1.0
    cut = az < sine
    if cut:  # by the horizon
        some[cutting, 0], some[cutting, 1], some[cutting, 2], some[cutting, 3] = 0.0, 0.0, 1.0, 0.0
        cutting += 1
    px, py, pz, d = some[pole, 0], some[pole, 1], some[pole, 2], some[pole, 3]
    cos_g, sin_g = px * ax + py * ay + pz * az, math.sqrt(best)
    gamma = math.atan2(sin_g, cos_g)
    ux, uy, uz = (ax - cos_g * px) / sin_g, (ay - cos_g * py) / sin_g, (az - cos_g * pz) / sin_g
    vx, vy, vz = py * uz - pz * uy, pz * ux - px * uz, px * uy - py * ux
    a, p = (ax, ay, az), (px, py, pz)
    rim = (ax, ay, az, cosine)
    n_cuts = insert(cuts, 0, (math.acos(d) - gamma) / half_angle)
    for k in range(cutting):
        if k == pole:
            continue
        b = some[k]
        n_cuts = meet(b, rim, a, cosine, p, gamma, half_angle, cuts, n_cuts)
        for j in range(k):
            if j != pole:
                n_cuts = meet(b, some[j], a, cosine, p, gamma, half_angle, cuts, n_cuts)
        u, v, along = (
            b[0] * ux + b[1] * uy + b[2] * uz,
            b[0] * vx + b[1] * vy + b[2] * vz,
            b[0] * px + b[1] * py + b[2] * pz,
        )
        across, down = math.sqrt(u * u + v * v), math.sqrt(max(0.0, 1.0 - b[3] * b[3]))
        if across > 1e-12:
            for side in (-1.0, 1.0):  # where it touches a ring
                ct, st = along * b[3] - side * across * down, across * b[3] + side * along * down
                if ct * cos_g + st * sin_g * u / across > math.cos(min(_CLEAR * half_angle, math.pi)):
                    return -1.0
    before = earlier = -1.0
    for level in range(starts.size - 1):
        first, n = starts[level], starts[level + 1] - starts[level]
        total, held = 0.0, 0
        for panel in range(n_cuts + 1):
            low = 0.0 if panel == 0 else cuts[panel - 1]
            high = math.pi if panel == n_cuts else cuts[panel]
            if high - low < 1e-14:
                continue
            for i in range(n):
                psi = low + (high - low) * x[first + i]
                y = half_angle * math.cos(psi)
                t = gamma + y
                ct, st = math.cos(t), math.sin(t)
                inside = math.sin(0.5 * (half_angle + y)) * math.sin(0.5 * (half_angle - y))
                beyond = math.sin(0.5 * (t + gamma + half_angle)) * math.sin(0.5 * (t + gamma - half_angle))
                reach = math.sqrt(max(inside, 0.0) / beyond)
                edges[0] = -reach
                m = 1
                for k in range(cutting):
                    if k == pole:
                        continue
                    b = some[k]
                    u = st * (b[0] * ux + b[1] * uy + b[2] * uz)
                    v = st * (b[0] * vx + b[1] * vy + b[2] * vz)
                    rest = ct * (b[0] * px + b[1] * py + b[2] * pz) - b[3]
                    root = u * u + v * v - rest * rest
                    if root <= 0.0:
                        continue
                    root = -(v + math.copysign(math.sqrt(root), v))
                    for side in range(2):
                        over = rest - u if side == 0 else root
                        tau = (root if side == 0 else rest + u) / over if over != 0.0 else 2.0 * reach
                        if abs(tau) < reach:
                            j = m
                            while edges[j - 1] > tau:
                                edges[j] = edges[j - 1]
                                j -= 1
                            edges[j] = tau
                            m += 1
                edges[m] = reach
                weight = 2.0 * st * half_angle * math.sin(psi) * (high - low) * w[first + i]
                for piece in range(m):
                    start, length = edges[piece], edges[piece + 1] - edges[piece]
                    if cut:
                        tau = start + 0.5 * length
                        q = 1.0 / (1.0 + tau * tau)
                        if (uz * (1.0 - tau * tau) + vz * 2.0 * tau) * q * st + pz * ct <= 0.0:
                            continue
                    if held + n > _ROOM:
                        total += sum_over_nodes(weigh, nodes, held, s, c, parameters)
                        held = 0
                    for j in range(n):
                        tau = start + length * x[first + j]
                        q = 1.0 / (1.0 + tau * tau)
                        f, g = st * (1.0 - tau * tau) * q, st * 2.0 * tau * q
                        zi = max(f * uz + g * vz + ct * pz, 1e-300)
                        nodes[0, held + j], nodes[1, held + j] = f * ux + g * vx + ct * px, f * uy + g * vy + ct * py
                        nodes[2, held + j], nodes[3, held + j] = zi, weight * length * w[first + j] * q * zi
                    held += n
                    counts[1] += n
        total += sum_over_nodes(weigh, nodes, held, s, c, parameters)
        if before >= 0.0:
            step = abs(total - before)
            estimate = 2.0 * step if earlier < 0.0 else max(step, 0.01 * abs(before - earlier))
            if estimate <= max(0.25 * rtol * total, 0.1 * floor):
                return total
        earlier, before = before, total
    return -1.0


_pieces = jit.part(_all_pieces, fastmath=jit.FAST)


def _all_cut_disks(  # type: ignore[no-untyped-def]
    p, q, crossed, planes, axis, half_angle, scale, width, weigh, parameters, x, w, starts, rtol, floor,
    value, error, left, counts,
):  # fmt: skip
    columns, worst, sine = p.shape[1], 0.0, math.sin(half_angle)
    dx, dy, dz = axis[0], axis[1], axis[2]
    some, cuts, edges = np.empty((_MOST, 4)), np.empty(4 * _MOST * _MOST), np.empty(2 * _MOST + 2)
    nodes = np.empty((4, _ROOM))
    for index in range(crossed.size):
        k = crossed[index]
        i = k // columns
        c, s, cf, sf = cosines(p[i, k - i * columns], q[i, k - i * columns])
        along = dx * cf + dy * sf
        ax, ay, az = along * c - dz * s, dy * cf - dx * sf, along * s + dz * c
        total = _pieces(
            ax, ay, az, s, c, half_angle, planes[index], weigh, parameters, x, w, starts, rtol, floor, some, cuts, edges,
            nodes, counts,
        )  # fmt: skip
        if total < 0.0:
            left[counts[0]] = k
            counts[0] += 1
        else:
            height = min(az + sine, sine)
            relative = 0.5 * rtol + EPS * (16.0 + 16.0 / width + 16.0 / height)
            value[k] += scale * total
            error[k] += scale * max(relative * total, floor)
            worst = max(worst, relative)
    return worst


_cut_disks = jit.kernel(_all_cut_disks)
