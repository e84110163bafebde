r"""Circles on the sphere, and adaptive quadrature over rings split by them, for the second opinion of tests/independent.py.

Everything that makes the integrand jump or bend (horizon of the surface, horizon of a sky, rim of a disk, edges of texels,
kinks of a model) is a circle on the sphere. In polar coordinates (t, chi) about any pole, a circle of angular radius delta
whose centre is gamma from the pole cuts the ring t at

.. math:: \tan^2\frac{\chi}{2} = \frac{\sin\frac{\delta+t-\gamma}{2}\,\sin\frac{\delta-t+\gamma}{2}}
                                      {\sin\frac{t+\gamma+\delta}{2}\,\sin\frac{t+\gamma-\delta}{2}} ,

so each ring is split where circles cut it, and the rings where two circles meet or one touches. Between, the integrand is
smooth, and panels are halved until the rule is content. Nothing of gonio is used.

References
----------
.. [1] R. Piessens et al., QUADPACK, Springer, 1983 (nodes and error of the 21-point Gauss-Kronrod rule).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
EPS = float(np.finfo(float).eps)
_POINTS = 400_000  # integrand values held at once


# --- rules: nodes on [0, 1], weights of the result and of its rival ---------------------------------------------------

_KRONROD = (
    (0.995657163025808080735527280689003, 0.011694638867371874278064396062192, 0.0),
    (0.973906528517171720077964012084452, 0.032558162307964727478818972459390, 0.066671344308688137593568809893332),
    (0.930157491355708226001207180059508, 0.054755896574351996031381300244580, 0.0),
    (0.865063366688984510732096688423493, 0.075039674810919952767043140916190, 0.149451349150580593145863396957658),
    (0.780817726586416897063717578345042, 0.093125454583697605535065465083366, 0.0),
    (0.679409568299024406234327365114874, 0.109387158802297641899210590325805, 0.219086362515982043995534934228163),
    (0.562757134668604683339000099272694, 0.123491976262065851077958109585166, 0.0),
    (0.433395394129247190799265943165784, 0.134709217311473325928054001771707, 0.269266719309996355091226921569469),
    (0.294392862701460198131126603103866, 0.142775938577060080797094273138717, 0.0),
    (0.148874338981631210884826001129720, 0.147739104901338491374841515972068, 0.295524224714752870173815619188769),
    (0.0, 0.149445554002916905664936468389821, 0.0),
)  # fmt: skip


def _kronrod() -> tuple[Array, Array, Array]:
    x, k, g = np.array(_KRONROD).T
    return (
        np.concatenate((-x, x[-2::-1])) / 2 + 0.5,
        np.concatenate((k, k[-2::-1])) / 2,
        np.concatenate((g, g[-2::-1])) / 2,
    )


def _halves() -> tuple[Array, Array, Array]:
    x, w = np.polynomial.legendre.leggauss(12)
    x, w = (x + 1) / 2, w / 2
    nothing = np.zeros(12)
    return (
        np.concatenate((x, x / 2, (x + 1) / 2)),
        np.concatenate((nothing, w / 2, w / 2)),
        np.concatenate((w, nothing, nothing)),
    )


RULES = {"normal": _kronrod(), "other": _halves()}


def _judge(values: Array, width: Array, rule: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    """Integral over each panel and its error as QUADPACK judges it; values (panels, nodes), width (panels,)."""
    _, weights, rival = rule
    result = values @ weights
    spread = np.abs(values - result[:, None]) @ weights * width
    off = np.abs(result - values @ rival) * width
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.where(spread > 0, spread * np.minimum(1.0, (200.0 * off / spread) ** 1.5), off)
    return result * width, error


# --- circles, rings and the nested integral ---------------------------------------------------------------------------


@dataclass
class Arrangement:
    """Circles (centre, angular radius, whether only its inside counts) and narrow features (direction, width).

    `curve`, a polynomial of degree 2 in the components of w, vanishes where a derivative jumps elsewhere.
    """

    circles: list[tuple[Array, float, bool]] = field(default_factory=list)
    features: list[tuple[Array, float]] = field(default_factory=list)
    curve: Callable[[Array], Array] | None = None

    def inside(self, w: Array) -> NDArray[np.bool_]:
        kept = np.ones(len(w), dtype=bool)
        for centre, radius, clips in self.circles:
            if clips:  # chord against chord: exact for tiny circles too
                kept &= np.sum((w - centre) ** 2, axis=1) < 4 * math.sin(radius / 2) ** 2
        return kept

    def meetings(self) -> list[Array]:
        """Points where two circles meet."""
        points = []
        for k, (c1, r1, _) in enumerate(self.circles):
            for c2, r2, _ in self.circles[:k]:
                cross = np.cross(c1, c2)
                s2, dot = float(cross @ cross), float(c1 @ c2)
                if s2 < 1e-20:
                    continue
                a, b = (math.cos(r1) - dot * math.cos(r2)) / s2, (math.cos(r2) - dot * math.cos(r1)) / s2
                g2 = (1 - a * a - b * b - 2 * a * b * dot) / s2
                if g2 >= 0:
                    points += [a * c1 + b * c2 + s * math.sqrt(g2) * cross for s in (-1, 1)]
        return points


def angle(a: Array, b: Array) -> float:
    return math.atan2(float(np.linalg.norm(np.cross(a, b))), float(a @ b))


def _steps(width: float) -> list[float]:
    steps, step = [0.0], width
    while step < 3.0:
        steps += [step, -step]
        step *= 5.0
    return steps


class Rings:
    """Polar coordinates about a pole e3 with azimuth 0 at e1, and the integral of a function over the arrangement."""

    def __init__(self, e1: Array, e3: Array, arrangement: Arrangement, rule: tuple[Array, Array, Array]) -> None:
        e1 = e1 - (e1 @ e3) * e3
        self.e1, self.e3 = e1 / np.linalg.norm(e1), e3
        self.e2 = np.cross(self.e3, self.e1)
        self.arrangement, self.rule = arrangement, rule

    def _polar(self, w: Array) -> tuple[float, float]:
        return angle(self.e3, w), math.atan2(float(w @ self.e2), float(w @ self.e1))

    def directions(self, t: Array, chi: Array) -> Array:
        s = np.sin(t)
        return (s * np.cos(chi))[:, None] * self.e1 + (s * np.sin(chi))[:, None] * self.e2 + np.cos(t)[:, None] * self.e3

    def breaks(self) -> Array:
        """Rings where the integrand of t is not smooth, from 0 to pi."""
        at = [0.0, math.pi]
        for centre, radius, _ in self.arrangement.circles:
            gamma = angle(self.e3, centre)
            at += [abs(gamma - radius), gamma + radius, 2 * math.pi - gamma - radius]
        at += [angle(self.e3, w) for w in self.arrangement.meetings()]
        for direction, width in self.arrangement.features:
            t = self._polar(direction)[0]
            at += [t + step for step in _steps(width)]
        if self.arrangement.curve is not None:
            at += self._touched(self.arrangement.curve) + self._met(self.arrangement.curve)
        at = sorted(t for t in at if 0.0 <= t <= math.pi)
        return np.array([t for k, t in enumerate(at) if k == 0 or t - at[k - 1] > 1e-14])

    def _crossings(self, curve: Callable[[Array], Array], t: Array) -> tuple[Array, NDArray[np.intp]]:
        """Where the rings t (n,) meet the curve (n, 4), 0 where they do not; and a number that tells rings apart.

        On a ring the curve is a trigonometric polynomial of degree 2: five samples give it, and it is one of degree 4 in
        exp(i chi).
        """
        chi = 2 * math.pi * np.arange(5) / 5
        samples = curve(self.directions(np.repeat(t, 5), np.tile(chi, len(t)))).reshape(-1, 5)
        waves = np.fft.fft(samples, axis=1) / 5  # of exp(i m chi), m = 0, 1, 2, -2, -1
        polynomial = waves[:, [2, 1, 0, 4, 3]]  # from the highest power down
        cuts, kind = np.zeros((len(t), 4)), np.sign(samples[:, 0]).astype(int) * 5
        size = np.abs(polynomial).max(axis=1)
        for k in np.flatnonzero(np.abs(polynomial).sum(axis=1) > 1.0000001 * np.abs(polynomial[:, 2])):
            roots = np.roots(np.where(np.abs(polynomial[k]) > 1e-15 * size[k], polynomial[k], 0.0))
            found = np.mod(np.angle(roots[np.abs(np.abs(roots) - 1) < 1e-6]), 2 * math.pi)
            cuts[k, : len(found)] = found
            kind[k] += len(found)
        return cuts, kind

    def _touched(self, curve: Callable[[Array], Array]) -> list[float]:
        """Rings where the number of crossings changes, by bisection."""
        t = np.linspace(0.0, math.pi, 1001)
        kind = self._crossings(curve, t)[1]
        change = np.flatnonzero(np.diff(kind))
        low, high, left = t[change], t[change + 1], kind[change]
        for _ in range(50):
            middle = 0.5 * (low + high)
            same = self._crossings(curve, middle)[1] == left
            low, high = np.where(same, middle, low), np.where(same, high, middle)
        return list(0.5 * (low + high))

    def _met(self, curve: Callable[[Array], Array]) -> list[float]:
        """Rings on which the curve meets a circle."""
        found = []
        for centre, radius, _ in self.arrangement.circles:
            around = Rings(np.roll(centre, 1) + np.array([0.3, 0.0, 0.1]), centre, self.arrangement, self.rule)
            cuts = around._crossings(curve, np.array([radius]))[0][0]
            found += [angle(self.e3, w) for w in around.directions(np.full(4, radius), cuts)]
        return found

    def panels(self, t: Array) -> tuple[Array, Array, NDArray[np.intp]]:
        """Smooth and lit pieces of the rings t (n,): lower and upper azimuth and the ring's number."""
        cuts = [np.zeros_like(t), np.full_like(t, math.pi), np.full_like(t, 2 * math.pi)]
        for centre, radius, _ in self.arrangement.circles:
            gamma, chi = self._polar(centre)
            within = np.sin((radius + t - gamma) / 2) * np.sin((radius - t + gamma) / 2)
            beyond = np.sin((t + gamma + radius) / 2) * np.sin((t + gamma - radius) / 2)
            crossed = (within > 0) & (beyond > 0)
            reach = 2 * np.arctan2(np.sqrt(np.where(crossed, within, 0)), np.sqrt(np.where(crossed, beyond, 1)))
            cuts += [np.where(crossed, np.mod(chi + s * reach, 2 * math.pi), 0.0) for s in (-1, 1)]
        for direction, width in self.arrangement.features:
            t_f, chi = self._polar(direction)
            if min(t_f, math.pi - t_f) < 1e-9:
                continue
            scale = np.hypot(t - t_f, width) / np.maximum(np.sin(t), 1e-12)
            step = np.ones_like(t)
            cuts.append(np.full_like(t, chi % (2 * math.pi)))
            while np.any(scale * step < 3.0):
                cuts += [np.where(scale * step < 3.0, np.mod(chi + s * scale * step, 2 * math.pi), 0.0) for s in (-1, 1)]
                step = step * 5.0
        if self.arrangement.curve is not None:
            cuts += list(self._crossings(self.arrangement.curve, t)[0].T)
        edges = np.sort(np.stack(cuts, axis=1), axis=1)
        lower, upper = edges[:, :-1], edges[:, 1:]
        ring = np.broadcast_to(np.arange(len(t))[:, None], lower.shape)
        wide = upper - lower > 1e-15
        lower, upper, ring = lower[wide], upper[wide], ring[wide]
        lit = self.arrangement.inside(self.directions(t[ring], 0.5 * (lower + upper)))
        return lower[lit], upper[lit], ring[lit]

    def ring_integrals(self, f: Callable[[Array, Array, Array], Array], t: Array, rtol: float, floor: float) -> Array:
        """Integral of f(t, chi, w) over the lit azimuths of each ring t (n,)."""
        done = np.zeros_like(t)
        lower, upper, ring = self.panels(t)
        x = self.rule[0]
        for _ in range(60):
            if not len(ring):
                break
            value, error = np.empty(len(ring)), np.empty(len(ring))
            chunk = max(1, _POINTS // len(x))
            for k in range(0, len(ring), chunk):
                part = slice(k, k + chunk)
                width = upper[part] - lower[part]
                chi = (lower[part, None] + width[:, None] * x).ravel()
                at = np.repeat(t[ring[part]], len(x))
                values = f(at, chi, self.directions(at, chi)).reshape(-1, len(x))
                value[part], error[part] = _judge(values, width, self.rule)
            total = np.abs(done + np.bincount(ring, value, len(t)))
            fine = (error <= np.maximum(rtol * total[ring], floor)) | (error <= 4 * EPS * np.abs(value))
            done += np.bincount(ring[fine], value[fine], len(t))
            lower, upper, ring = lower[~fine], upper[~fine], ring[~fine]
            middle = 0.5 * (lower + upper)
            lower, upper, ring = np.append(lower, middle), np.append(middle, upper), np.append(ring, ring)
            if len(ring) > 4_000_000:
                raise ArithmeticError("a ring does not converge")
        return done

    def integral(self, f: Callable[[Array, Array, Array], Array], rtol: float) -> float:
        """Integral of f over the lit part of the sphere, d omega."""
        edges = self.breaks()
        a, b = edges[:-1], edges[1:]  # of the smooth interval that a panel belongs to
        lower, upper = np.zeros_like(a), np.ones_like(a)  # in s, t = a + (b - a) s^2 (3 - 2 s): no square root at the ends
        done, x = 0.0, self.rule[0]

        def pieces(rtol: float, floor: float) -> tuple[Array, Array]:
            width = upper - lower
            s = lower[:, None] + width[:, None] * x
            t = (a[:, None] + (b - a)[:, None] * s**2 * (3 - 2 * s)).ravel()
            slope = ((b - a)[:, None] * 6 * s * (1 - s)).ravel() * np.sin(t)
            rows = self.ring_integrals(f, t, rtol, floor)
            return _judge((slope * rows).reshape(-1, len(x)), width, self.rule)

        floor = 1e-5 * rtol * abs(float(pieces(1e-2, 1e-300)[0].sum()))  # rings far below the sum may be coarse
        for _ in range(60):
            if not len(a):
                break
            value, error = pieces(0.1 * rtol, floor)
            total = abs(done + float(value.sum()))
            floor = 0.01 * rtol * total
            fine = (error <= rtol * total) | (error <= 4 * EPS * np.abs(value))
            done += float(value[fine].sum())
            a, b, lower, upper = a[~fine], b[~fine], lower[~fine], upper[~fine]
            middle = 0.5 * (lower + upper)
            a, b = np.append(a, a), np.append(b, b)
            lower, upper = np.append(lower, middle), np.append(middle, upper)
        return done
