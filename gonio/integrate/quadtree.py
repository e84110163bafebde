r"""A map of very many gradients under a disk off the axis: R as polynomials on squares of normals, a quadtree of them.

Normals are points of the stereographic plane, at tau = tan(theta_n / 2) and phi_n from the disk's azimuth, about which R is
even. A square holds products of Chebyshev polynomials [1]_ of degree 7, from 64 gradients by the rules for disks. It is
quartered until values between the nodes and the series' last terms agree with the tolerance, and not trusted before

- it is no larger than twice its distance from the mirror of the disk's centre, or the width of the lobe there;
- where the horizon cuts the disk, what is left of it does not vanish or rise too steeply for a polynomial. (Where the
  horizon begins to cut it R is smooth enough, to the power 5/2 of what is below.)

Squares with too few gradients to be worth their nodes, as along the terminator, are left to the rule itself, and all that
are still open when the nodes would cost more than what they save.

References
----------
.. [1] L. N. Trefethen, Approximation Theory and Approximation Practice, SIAM, 2013, chapters 3 and 8.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.integrate.grid import Gradients
from gonio.source import Cap

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Sample = Callable[[Array, Array], tuple[Array, Array]]
_NODES = 8  # along either side
_ROOT, _DEEPEST, _BINS = 3, 13, 9  # levels: squares of 2^-level
_EVERY = 16  # gradients of which one is counted
_BUDGET = 8  # gradients for each of which there may be one that is sampled
_WORTH = 80  # gradients for which a square pays
_SAFETY = 3.0
_STEEPEST = 3.2  # ratio of the heights above the horizon of what is left of a setting disk, within a square
_EDGE = 9.0  # where the horizon begins to cut the disk: probes may be far from that line
_LEBESGUE = 2.4**2  # of the nodes, both ways
_BLOCK = 256
_PROBES = np.array([-0.9808, -0.7, -0.19, 0.19, 0.56, 0.9808])
_DIRECT = -1


@dataclass(frozen=True)
class Quadtree:
    """The squares.

    Attributes
    ----------
    turn : (cos, sin)
        Of the disk's azimuth.
    nodes : ndarray of int, shape (k, 4)
        Of the inner nodes: their quarters. A number from 0 on is another inner node, -1 a square left to the rule, -2 - j
        the leaf j. The first are the squares of the lowest level, row by row, as quarters of nothing.
    coefficients : ndarray, shape (leaves * 64,)
        Of powers.
    errors : ndarray, shape (leaves,)
    """

    turn: tuple[float, float]
    nodes: Index
    coefficients: Array
    errors: Array

    def add(
        self, gradients: Gradients, tile: tuple[int, int], rtol: float, value: Array, error: Array
    ) -> tuple[float, NDArray[np.intp]]:
        """Add value and error on one tile, to `rtol`; the largest relative error, and the gradients left to do."""
        left = np.empty(tile[1] - tile[0], dtype=np.int64)
        worst, count = _read(
            gradients.p, gradients.q, *tile, *self.turn, self.nodes, self.coefficients, self.errors, rtol, value, error, left
        )
        return float(worst), left[:count].astype(np.intp)


def build(cap: Cap, width: float, gradients: Gradients, sample: Sample, rtol: float) -> Quadtree:
    """The quadtree of one term and one disk.

    Parameters
    ----------
    cap : Cap
        A small disk off the axis.
    width : float
        Of the term's lobe [rad]; 10 without one.
    gradients : Gradients
        Where it will be asked.
    sample : callable
        p, q (n,) -> value and error (n,), to a small part of `rtol`.
    rtol : float
    """
    sine = math.hypot(cap.axis[0], cap.axis[1])
    turn = (cap.axis[0] / sine, cap.axis[1] / sine)
    sums = _census(gradients, turn)
    mirror = math.tan(0.25 * math.atan2(sine, cap.axis[2]))
    height = math.sin(cap.half_angle)
    lobe = 0.5 * width + 0.25 * cap.half_angle
    nodes, at_probes, to_series, to_powers = _rules()
    side = 1 << _ROOT
    y, x = np.divmod(np.arange(2 * side * side), 2 * side)
    # of each square: the place in `codes` that says what it is
    codes: list[int] = [_DIRECT] * len(x)
    place = np.arange(len(x))
    room = gradients.size // _BUDGET
    leaves: list[Array] = []
    errors: list[float] = []
    for level in range(_ROOT, _DEEPEST + 1):
        h = 2.0**-level
        worth = _count(sums, x, y, level) * _EVERY > _WORTH
        x, y, place = x[worth], y[worth], place[worth]
        if not len(x):
            break
        left, low = -1.0 + h * x, h * y
        distance = np.hypot(np.maximum(np.abs(left + 0.5 * h - mirror) - 0.5 * h, 0.0), low)
        split = (h > 2.0 * np.maximum(distance, lobe)) & (width < 10.0)
        least, most = _heights(left, low, h, cap, -height)
        split |= (most >= 0.0) & (least < 2.0 * height) & (most > _STEEPEST * np.maximum(least, 0.0))
        split |= np.hypot(np.maximum(np.abs(left), np.abs(left + h)), low + h) >= 1.0
        tried = np.flatnonzero(~split)
        room -= len(tried) * nodes.shape[1]
        if room < 0:  # R is too rough for this to pay: what is open stays so
            break
        if len(tried):
            value, sampled = _sampled(left[tried], low[tried], h, nodes, turn, sample)
            grid = value[:, : _NODES**2].reshape(-1, _NODES, _NODES)
            series = to_series @ grid @ to_series.T
            missed = np.max(np.abs(np.einsum("pij,kij->kp", at_probes, series) - value[:, _NODES**2 :]), axis=1)
            tail = np.abs(series[:, -1]).sum(axis=1) + np.abs(series[:, :-1, -1]).sum(axis=1)
            rounding = 64.0 * np.finfo(float).eps * np.abs(grid).max(axis=(1, 2))
            least, most = _heights(left[tried], low[tried], h, cap, height)
            safety = np.where((least <= 0.0) & (most >= 0.0), _EDGE, _SAFETY)
            error = np.maximum(safety * missed, tail) + _LEBESGUE * sampled.max(axis=1) + rounding
            good = error <= 0.9 * rtol * np.abs(value).min(axis=1)
            split[tried] = ~good
            powers = to_powers @ series @ to_powers.T
            for k, where in zip(np.flatnonzero(good), place[tried[good]], strict=True):
                codes[where] = -2 - len(errors)
                leaves.append(powers[k])
                errors.append(float(error[k]))
        # quarters, in the order of the bits of y and x
        x, y, parents = x[split], y[split], place[split]
        place = np.arange(len(codes), len(codes) + 4 * len(parents))
        for child, parent in enumerate(parents, len(codes) // 4):
            codes[parent] = child
        codes += [_DIRECT] * len(place)
        x, y = (2 * x[:, None] + np.array([0, 1, 0, 1])).ravel(), (2 * y[:, None] + np.array([0, 0, 1, 1])).ravel()
    tree = np.array(codes, dtype=np.int64).reshape(-1, 4)
    return Quadtree(turn, tree, np.array(leaves).ravel(), np.array(errors))


@functools.cache
def _rules() -> tuple[Array, Array, Array, Array]:
    """Nodes on [0, 1]; polynomials at the probes (p, 8, 8); values to coefficients; coefficients to powers."""
    x = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
    to_series = np.asarray(np.linalg.inv(np.polynomial.chebyshev.chebvander(x, _NODES - 1)))
    t, u = (a.ravel() for a in np.meshgrid(_PROBES[::2], _PROBES[1::2]))
    corner = np.array([-1.0, -1.0, 1.0, 1.0])  # where a line may cut off least and deepest
    t, u = np.concatenate((t, u, corner)), np.concatenate((u, t, corner[[0, 2, 1, 3]]))
    at_probes = np.einsum("pi,pj->pij", *(np.polynomial.chebyshev.chebvander(a, _NODES - 1) for a in (t, u)))
    powers = np.zeros((_NODES, _NODES))
    for k in range(_NODES):
        one = np.polynomial.chebyshev.cheb2poly(np.eye(_NODES)[k])
        powers[: len(one), k] = one
    first, second = (a.ravel() for a in np.meshgrid(x, x, indexing="ij"))
    nodes = 0.5 * (1.0 + np.stack((np.concatenate((first, t)), np.concatenate((second, u)))))
    return nodes, at_probes, to_series, powers


def _sampled(
    left: Array, low: Array, h: float, nodes: Array, turn: tuple[float, float], sample: Sample
) -> tuple[Array, Array]:
    """Values and errors at the nodes and probes of squares, shape (k, 64 + p)."""
    x, y = left[:, None] + h * nodes[0], low[:, None] + h * nodes[1]
    scale = -2.0 / ((1.0 - np.hypot(x, y)) * (1.0 + np.hypot(x, y)))
    p, q = scale * (x * turn[0] - y * turn[1]), scale * (x * turn[1] + y * turn[0])
    value, error = sample(p.ravel(), q.ravel())
    return value.reshape(x.shape), error.reshape(x.shape)


def _heights(left: Array, low: Array, h: float, cap: Cap, height: float) -> tuple[Array, Array]:
    """Least and largest (1 + tau^2) (cos theta_i - height) of the disk's centre for the normals of each square."""
    sine, cosine = math.hypot(cap.axis[0], cap.axis[1]), cap.axis[2]
    # it is (c - height) + 2 s X - (c + height) (X^2 + Y^2)
    bend = cosine + height
    ends = [2.0 * sine * x - bend * x * x for x in (left, left + h)]
    if bend != 0.0:
        summit = np.clip(sine / bend, left, left + h)
        ends.append(2.0 * sine * summit - bend * summit * summit)
    across = [-bend * y * y for y in (low, low + h)]
    least = np.minimum.reduce(ends) + np.minimum.reduce(across) + cosine - height
    most = np.maximum.reduce(ends) + np.maximum.reduce(across) + cosine - height
    return least, most


def _census(gradients: Gradients, turn: tuple[float, float]) -> Array:
    """Running sums of how many of the counted gradients lie in squares of 2^-9, shape (513, 1025)."""
    bins = np.zeros((1 << _BINS, 2 << _BINS))
    _sort(gradients.p, gradients.q, gradients.size, *turn, bins)
    sums = np.zeros((bins.shape[0] + 1, bins.shape[1] + 1))
    np.cumsum(np.cumsum(bins, axis=0), axis=1, out=sums[1:, 1:])
    return sums


def _count(sums: Array, x: NDArray[np.intp], y: NDArray[np.intp], level: int) -> Array:
    """How many of the counted gradients lie in squares of 2^-level, about."""
    finer = max(level - _BINS, 0)
    wide = 1 << max(_BINS - level, 0)
    x, y = (x >> finer) * wide, (y >> finer) * wide
    return np.asarray((sums[y + wide, x + wide] - sums[y, x + wide] - sums[y + wide, x] + sums[y, x]) / 4.0**finer)


@jit.model
def _place(x, y, cos, sin):  # type: ignore[no-untyped-def]
    """Point of the stereographic plane; no branch, so that loops vectorise. Steeper than 1e15: out of the plane."""
    squared = x * x + y * y
    scale = 1.0 / (1.0 + math.sqrt(1.0 + squared))
    near = squared < 1e30
    return (-(x * cos + y * sin) * scale if near else 2.0), (abs(y * cos - x * sin) * scale if near else 2.0)


def _sort_all(p, q, size, cos, sin, bins):  # type: ignore[no-untyped-def]
    columns, rows, wide = p.shape[1], bins.shape[0], bins.shape[1]
    for k in range(0, size, _EVERY):
        i = k // columns
        x, y = _place(p[i, k - i * columns], q[i, k - i * columns], cos, sin)
        if x < 1.0 and y < 1.0:
            bins[min(int(y * rows), rows - 1), min(max(int((x + 1.0) * rows), 0), wide - 1)] += 1.0


def _read_tile(p, q, start, stop, cos, sin, tree, coefficients, errors, rtol, value, error, left):  # type: ignore[no-untyped-def]
    columns, side = p.shape[1], 1 << _ROOT
    along, across = np.empty(_BLOCK), np.empty(_BLOCK)
    right, up, sums = np.empty(_BLOCK), np.empty(_BLOCK), np.empty(8)
    first = tree.ravel()
    x, y, h, code = 9.0, 9.0, 0.0, _DIRECT  # square of the last gradient
    worst, count = 0.0, 0
    k = start
    while k < stop:
        i = k // columns
        j = k - i * columns
        n = min(min(columns - j, stop - k), _BLOCK)
        for m in range(n):
            along[m], across[m] = p[i, j + m], q[i, j + m]
        for m in range(n):
            right[m], up[m] = _place(along[m], across[m], cos, sin)
        for m in range(n):
            a, b = right[m], up[m]
            if not (a >= x and a < x + h and b >= y and b < y + h):
                code = _DIRECT
                if a < 1.0 and b < 1.0:
                    column, row = min(max(int((a + 1.0) * side), 0), 2 * side - 1), int(b * side)
                    x, y, h = -1.0 + column / side, row / side, 1.0 / side
                    code = first[row * 2 * side + column]
                    while code >= 0:
                        h *= 0.5
                        quarter = 0
                        if a >= x + h:
                            x, quarter = x + h, 1
                        if b >= y + h:
                            y, quarter = y + h, quarter + 2
                        code = tree[code, quarter]
            if code == _DIRECT:
                left[count] = k + m
                count += 1
                continue
            leaf = -2 - code
            t, u = 2.0 * (a - x) / h - 1.0, 2.0 * (b - y) / h - 1.0
            t2 = t * t
            t3, t4 = t2 * t, t2 * t2
            t5, t6, t7 = t4 * t, t3 * t3, t4 * t3
            square = coefficients[64 * leaf : 64 * leaf + 64]
            for c in range(8):
                sums[c] = (
                    square[c] + t * square[c + 8] + t2 * square[c + 16] + t3 * square[c + 24]
                    + t4 * square[c + 32] + t5 * square[c + 40] + t6 * square[c + 48] + t7 * square[c + 56]
                )  # fmt: skip
            u2 = u * u
            total = (sums[0] + u * sums[1] + u2 * (sums[2] + u * sums[3])) + u2 * u2 * (
                sums[4] + u * sums[5] + u2 * (sums[6] + u * sums[7])
            )
            e = errors[leaf]
            if e > rtol * abs(total):
                left[count] = k + m
                count += 1
                continue
            value[k + m] += total
            error[k + m] += e
            if e > worst * abs(total) and total != 0.0:
                worst = e / abs(total)
        k += n
    return worst, count


_sort = jit.kernel(_sort_all)
_read = jit.kernel(_read_tile)
