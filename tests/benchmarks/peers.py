"""What a user could pick instead: scipy's dblquad and cubature, and product rules in NumPy.

Every peer is written as well as its users would write it: unit vectors, symmetry of the sky used, nodes shared by all
gradients. None of them knows where a lobe is. "split" means that the user has worked out the horizons by hand: polar
coordinates about the normal, with the azimuth at which the sky ends; for a disk, coordinates of the disk.
A peer is timed on a few gradients and by processor time (one core), which is kind to it on a busy machine; the caller
scales.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.benchmarks.scenes import NUMBERS, Scene, lights

Array = NDArray[np.float64]
Region = tuple[float, float, float, float, Callable[..., Any]]  # a <= t <= b, c <= u <= d, integrand(m, t, u)


@dataclass
class Answer:
    """Values at the gradients tried, seconds and evaluations of f_r per gradient; `late` if the time ran out."""

    values: Array
    seconds: float
    evaluations: float
    late: bool = False


class _LateError(Exception):
    pass


class _Frame:
    """A surface element: n and two tangents, the viewer at (-s, 0, c) in the local frame, the mirror direction at +x."""

    def __init__(self, p: float, q: float) -> None:
        slope = math.hypot(p, q)
        self.c = 1.0 / math.hypot(1.0, slope)
        self.s = slope * self.c
        a, b = (-p / slope, -q / slope) if slope else (1.0, 0.0)
        self.x = (a * self.c, b * self.c, -self.s)
        self.y = (-b, a, 0.0)
        self.n = (a * self.s, b * self.s, self.c)

    def local(self, x: Any, y: Any, z: Any) -> tuple[Any, Any, Any]:
        (a, b, c), (d, e, _), (f, g, h) = self.x, self.y, self.n
        return a * x + b * y + c * z, d * x + e * y, f * x + g * y + h * z

    def world(self, x: Any, y: Any, z: Any) -> tuple[Any, Any, Any]:
        (a, b, c), (d, e, _), (f, g, h) = self.x, self.y, self.n
        return a * x + d * y + f * z, b * x + e * y + g * z, c * x + h * z


def _full(scene: Scene, m: Any, trig: Any, frame: _Frame) -> list[Region]:
    """The memo's integral over the whole sphere, viewer-oriented, as it is printed."""
    f_r, radiance = scene.f_r(m), scene.radiance(m)

    def integrand(t: Any, u: Any) -> Any:
        st = trig.sin(t)
        w = st * trig.cos(u), st * trig.sin(u), trig.cos(t)
        x, y, z = frame.local(*w)
        z = m.maximum(z, 0.0)
        return f_r(x, y, z, -frame.s, frame.c) * radiance(*w) * z * st

    return [(0.0, math.pi, 0.0, 2.0 * math.pi, integrand)]


def _split(scene: Scene, m: Any, trig: Any, frame: _Frame) -> list[Region]:
    """Horizons and rims on the edges of rectangles."""
    f_r, radiance, kind = scene.f_r(m), scene.radiance(m), scene.kind
    if kind == "disk":
        return [_on_disk(lights()[scene.light][0], f_r, m, trig, frame)]
    symmetric = kind in ("uniform", "hemispherical", "overcast") and len(lights()[scene.light]) == 1

    def integrand(t: Any, u: Any) -> Any:
        st, ct = trig.sin(t), trig.cos(t)
        x, y, z = -st * trig.cos(u), st * trig.sin(u), ct  # azimuth from the viewer's side
        light = radiance(*frame.world(x, y, z))
        return f_r(x, y, z, -frame.s, frame.c) * light * ct * st * (2.0 if symmetric else 1.0)

    if kind not in ("hemispherical", "overcast"):
        return [(0.0, math.pi / 2, 0.0, math.pi if symmetric else 2.0 * math.pi, integrand)]
    edge = math.pi / 2 - math.atan2(frame.s, frame.c)  # beyond, the sky's horizon cuts the ring
    cot = frame.c / frame.s

    def cut(t: Any, u: Any) -> Any:
        reach = trig.arccos(m.maximum(-1.0, -cot * trig.cos(t) / trig.sin(t)))
        return reach * integrand(t, u * reach)

    return [(0.0, edge, 0.0, math.pi, integrand), (edge, math.pi / 2, 0.0, 1.0, cut)]


def _on_disk(disk: dict[str, Any], f_r: Any, m: Any, trig: Any, frame: _Frame) -> Region:
    c, s, cf, sf = math.cos(disk["theta"]), math.sin(disk["theta"]), math.cos(disk["phi"]), math.sin(disk["phi"])

    def integrand(t: Any, u: Any) -> Any:
        st, ct = trig.sin(t), trig.cos(t)
        a, b = st * trig.cos(u), st * trig.sin(u)
        along = c * a + s * ct
        x, y, z = frame.local(cf * along - sf * b, sf * along + cf * b, c * ct - s * a)
        z = m.maximum(z, 0.0)
        return disk["radiance"] * f_r(x, y, z, -frame.s, frame.c) * z * st

    return 0.0, disk["half_angle"], 0.0, 2.0 * math.pi, integrand


def dblquad(scene: Scene, gradients: Array, rtol: float, *, split: bool, limit_s: float) -> Answer:
    """scipy.integrate.dblquad, epsrel = rtol, on a function of Python floats; gradients shape (n, 2)."""
    from scipy.integrate import dblquad as integrate

    def one(frame: _Frame, deadline: float, count: list[int]) -> float:
        total = 0.0
        for a, b, c, d, f in (_split if split else _full)(scene, NUMBERS, _TRIG, frame):

            def counted(u: float, t: float, f: Callable[..., Any] = f) -> float:
                count[0] += 1
                if not count[0] & 1023 and time.process_time() > deadline:
                    raise _LateError
                return float(f(t, u))

            total += integrate(counted, a, b, c, d, epsabs=1e-13, epsrel=rtol)[0]
        return total

    return _each(one, gradients, limit_s)


def cubature(scene: Scene, gradients: Array, rtol: float, *, split: bool, limit_s: float) -> Answer:
    """scipy.integrate.cubature, its default rule, on a function of arrays; gradients shape (n, 2)."""
    from scipy.integrate import cubature as integrate

    def one(frame: _Frame, deadline: float, count: list[int]) -> float:
        total = 0.0
        for a, b, c, d, f in (_split if split else _full)(scene, np, np, frame):

            def counted(x: Array, f: Callable[..., Any] = f) -> Array:
                count[0] += len(x)
                if time.process_time() > deadline:
                    raise _LateError
                return np.asarray(f(x[:, 0], x[:, 1]))

            total += float(integrate(counted, [a, c], [b, d], rtol=rtol, atol=1e-13).estimate)
        return total

    return _each(one, gradients, limit_s)


class _TRIG:
    sin, cos, arccos = math.sin, math.cos, math.acos


def _each(one: Callable[[_Frame, float, list[int]], float], gradients: Array, limit_s: float) -> Answer:
    """One after another, until the time is over; the last two are tried, but not typical, and so are not timed."""
    values, count, typical = [], [0], len(gradients) - 2
    start = time.process_time()
    seconds, evaluations = np.nan, np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # scipy's remarks on its own accuracy
        for k, (p, q) in enumerate(gradients):
            try:
                values.append(one(_Frame(p, q), start + limit_s, count))
            except _LateError:
                break
            if k < typical:
                seconds, evaluations = (time.process_time() - start) / (k + 1), count[0] / (k + 1)
    late = len(values) < len(gradients)
    if len(values) < typical:  # at least
        n = max(1, len(values))
        seconds, evaluations = (time.process_time() - start) / n, count[0] / n
    return Answer(np.array(values), seconds, evaluations, late)


def midpoint(n: int) -> tuple[Array, Array, Array, Array]:
    """Midpoint rule in theta and phi about the normal, n x 2n nodes: x, y, z, weight with the cosine."""
    return _product((np.arange(n) + 0.5) * (np.pi / 2 / n), np.full(n, np.pi / 2 / n), 2 * n)


def gauss(n: int) -> tuple[Array, Array, Array, Array]:
    """Gauss-Legendre in theta, trapezoid in phi, n x 2n nodes."""
    x, w = np.polynomial.legendre.leggauss(n)
    return _product(np.asarray((x + 1.0) * (np.pi / 4)), np.asarray(w * (np.pi / 4)), 2 * n)


def _product(theta: Array, w: Array, columns: int) -> tuple[Array, Array, Array, Array]:
    psi = (np.arange(columns) + 0.5) * (2.0 * np.pi / columns)
    st, ct = np.sin(theta)[:, None], np.cos(theta)[:, None]
    weight = np.broadcast_to((w * np.sin(theta) * np.cos(theta))[:, None] * (2.0 * np.pi / columns), (len(w), columns))
    return (st * np.cos(psi)).ravel(), (st * np.sin(psi)).ravel(), np.repeat(ct, columns), weight.ravel()


def product_rule(scene: Scene, gradients: Array, nodes: tuple[Array, Array, Array, Array]) -> Answer:
    """The 20-line NumPy script: all nodes for each gradient, in blocks that fit the cache; gradients shape (n, 2)."""
    x, y, z, weight = nodes
    f_r, radiance = scene.f_r(np), scene.radiance(np)
    block = max(1, 16384 // x.size)  # small rules: several gradients at once
    values, start = np.empty(len(gradients)), time.process_time()
    for k in range(0, len(gradients), block):
        p, q = gradients[k : k + block, 0, None], gradients[k : k + block, 1, None]
        slope = np.hypot(p, q)
        c = 1.0 / np.sqrt(1.0 + slope * slope)
        s, cp, sp = slope * c, -p / slope, -q / slope
        along, up = c * x + s * z, c * z - s * x  # the nodes in the viewer's frame
        light = radiance(cp * along - sp * y, sp * along + cp * y, up)
        integrand = f_r(x, y, z, -s, c) * light
        # einsum, not @, which would start threads of its own
        values[k : k + block] = np.einsum("kn,n->k", np.broadcast_to(integrand, along.shape), weight)
    return Answer(values, (time.process_time() - start) / len(gradients), float(x.size))


def disk_rule(scene: Scene, gradients: Array, n: int) -> Answer:
    """The same script for one who sees that the source is a disk: n x 2n nodes on the disk, common to all gradients."""
    disk = lights()[scene.light][0]
    x, w = np.polynomial.legendre.leggauss(n)
    t, w = (x + 1.0) * (disk["half_angle"] / 2), w * (disk["half_angle"] / 2)
    psi = (np.arange(2 * n) + 0.5) * (np.pi / n)
    u, v = np.outer(np.sin(t), np.cos(psi)).ravel(), np.outer(np.sin(t), np.sin(psi)).ravel()
    height = np.repeat(np.cos(t), 2 * n)
    weight = np.repeat(w * np.sin(t) * (np.pi / n) * disk["radiance"], 2 * n)
    ct, st, cf, sf = math.cos(disk["theta"]), math.sin(disk["theta"]), math.cos(disk["phi"]), math.sin(disk["phi"])
    along, wz = ct * u + st * height, ct * height - st * u
    wx, wy = cf * along - sf * v, sf * along + cf * v
    f_r = scene.f_r(np)
    block = max(1, 16384 // u.size)
    values, start = np.empty(len(gradients)), time.process_time()
    for k in range(0, len(gradients), block):
        p, q = gradients[k : k + block, 0, None], gradients[k : k + block, 1, None]
        slope = np.hypot(p, q)
        c = 1.0 / np.sqrt(1.0 + slope * slope)
        s, cp, sp = slope * c, -p / slope, -q / slope
        ahead = cp * wx + sp * wy
        zi = np.maximum(s * ahead + c * wz, 0.0)
        integrand = f_r(c * ahead - s * wz, cp * wy - sp * wx, zi, -s, c) * zi
        values[k : k + block] = np.einsum("kn,n->k", integrand, weight)
    return Answer(values, (time.process_time() - start) / len(gradients), float(u.size))
