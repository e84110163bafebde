r"""Reading a map of R(theta_n, phi_n) at many gradients: a polynomial in tau on short cells, Lagrange's formula in phi_n.

Per gradient 64 multiply-adds, whatever the map was made of. A piece comes as a Chebyshev series in tau = tan(theta_n / 2) of
Fourier series in phi_n. Its interval is cut into cells until what lies beyond degree 7 is negligible there, and its azimuths
are as many as Lagrange's formula with eight points asks for. Both remainders have bounds, which are part of a value's error:
the sum of the Chebyshev coefficients left out, and for a wave of m in steps of h in the middle of eight points

.. math:: \frac{(m h)^8}{8!} \prod_{j=0}^{7} \left|\tfrac72 - j\right| .

References
----------
.. [1] J. P. Boyd, "A fast algorithm for Chebyshev, Fourier, and sinc interpolation onto an irregular grid", J. Comput. Phys.
   103, 1992 (oversampling, then local interpolation).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.integrate import threads
from gonio.integrate.grid import Gradients
from gonio.integrate.ring_scene import on_azimuths

Array = NDArray[np.float64]
Index = NDArray[np.int64]
EPS = float(np.finfo(float).eps)
_POINTS = 8  # of Lagrange's formula, and coefficients of a cell
_BEFORE, _AFTER = 3, 4  # of them on either side of the step in which an azimuth lies
_REMAINDER = (0.5 * 1.5 * 2.5 * 3.5) ** 2 / math.factorial(_POINTS)
_LEBESGUE = 2.0  # at least the sum of the absolute weights in that step, 1.7
_MOST_CELLS, _MOST_PER_WAVE = 16, 16
_LOOKUP, _BLOCK = 256, 256
_BINS = 512
_EVERY = 8  # gradients of a row that are asked what the steps before left
_EIGHTH = math.tan(math.pi / 8.0)


@dataclass(frozen=True)
class Patches:
    """One piece of tau: values (cells, azimuths + 7, 8), coefficients of powers last; and a bound of what is left out."""

    coefficients: Array
    error: float


@dataclass(frozen=True)
class Table:
    """A map, ready to be read.

    Attributes
    ----------
    bounds : ndarray, shape (k + 1,)
        Of tau.
    errors : ndarray, shape (k,)
        Of a value in that piece.
    shapes : ndarray of int, shape (k, 3)
        Where a piece begins in `coefficients`, its cells, its azimuths.
    first : ndarray of int, shape (256,)
        Piece at the lower end of each 256th of [0, 1].
    coefficients : ndarray
    least : float
        No value is below it, and none is reported: 0 for fields that are nowhere negative.
    """

    bounds: Array
    errors: Array
    shapes: Index
    first: Index
    coefficients: Array
    least: float

    @classmethod
    def of(cls, bounds: Array, errors: Array, pieces: Sequence[Patches], least: float = -math.inf) -> Table:
        """From pieces in rising order."""
        shapes, start = [], 0
        for piece in pieces:
            cells, columns, _ = piece.coefficients.shape
            shapes.append((start, cells, columns - _BEFORE - _AFTER))
            start += piece.coefficients.size
        first = np.clip(np.searchsorted(bounds, np.arange(_LOOKUP) / _LOOKUP, side="right") - 1, 0, len(pieces) - 1)
        flat = np.concatenate([piece.coefficients.ravel() for piece in pieces])
        return cls(bounds, errors, np.array(shapes), first.astype(np.int64), flat, least)

    @property
    def largest(self) -> float:
        """Of the values, at the middle of the cells."""
        return float(np.max(np.abs(self.coefficients[::_POINTS])))

    def add(
        self,
        gradients: Gradients,
        tile: tuple[int, int],
        rtol: float,
        atol: float,
        value: Array,
        error: Array,
        negligible: float = 0.0,
    ) -> tuple[float, NDArray[np.intp]]:
        """Add value and error on one tile, at those gradients where they are within the tolerance.

        Parameters
        ----------
        gradients : Gradients
        tile : (start, stop)
        rtol, atol : float
        value, error : ndarray, shape (n,)
            Of all gradients; what `value` and `error` leave of the tolerance is this table's too.
        negligible : float, optional
            Errors that do not count as relative ones.

        Returns
        -------
        largest error relative to the sum, index of the gradients that miss the tolerance, which are left as they were
        """
        missed = np.empty(tile[1] - tile[0], dtype=np.int64)
        worst, count = _add(
            gradients.p, gradients.q, *tile, self.bounds, self.errors, self.shapes, self.first, self.coefficients,
            self.least, rtol, atol, negligible, value, error, missed,
        )  # fmt: skip
        return float(worst), missed[:count].astype(np.intp)


class Room:
    """What steps before leave of the tolerance, by slope, from some of the gradients; and the range of all slopes.

    Parameters
    ----------
    gradients : Gradients
    rtol, atol : float
    value, error : ndarray, shape (n,)
        Of the steps before.
    cores : int

    Attributes
    ----------
    lowest, highest : float
        tau of the gradients.
    largest : float
        Of the same values of the steps before.
    """

    def __init__(self, gradients: Gradients, rtol: float, atol: float, value: Array, error: Array, cores: int) -> None:
        def work(tile: tuple[int, int]) -> tuple[float, float, float, Array]:
            bins = np.full(_BINS, np.inf)
            return *_survey(gradients.p, gradients.q, *tile, rtol, atol, value, error, bins), bins

        done = threads.run(work, gradients.tiles(), cores)
        self.lowest, self.highest = float(min(d[0] for d in done)), float(max(d[1] for d in done))
        self.largest = float(max(d[2] for d in done))
        bins = np.minimum.reduce([spare for *_, spare in done])
        # where there is no gradient, the nearest on either side count
        index, known = np.arange(_BINS), np.isfinite(bins)
        below = np.maximum.accumulate(np.where(known, index, np.flatnonzero(known)[0]))
        above = np.minimum.accumulate(np.where(known, index, np.flatnonzero(known)[-1])[::-1])[::-1]
        self._bins: Array = np.minimum(bins[below], bins[above])

    def smallest(self, lower: float, upper: float) -> float:
        """Of the gradients with slopes in the interval."""
        first, last = (min(int(max(tau, 0.0) * _BINS), _BINS - 1) for tau in (lower, upper))
        return float(self._bins[first : last + 1].min())


def patches(series: Array, negligible: float) -> Patches:
    """A piece whose bounds of what is left out are below `negligible`, or as small as 16 cells and azimuths make them.

    Parameters
    ----------
    series : ndarray, shape (degree + 1, 2, waves)
        Chebyshev coefficients over the piece of those of cos m phi and sin m phi.
    negligible : float
    """
    degree, waves = len(series) - 1, series.shape[2]
    size = np.hypot(*np.abs(series).sum(axis=0))
    power = (2.0 * np.pi * np.arange(waves)) ** _POINTS * _REMAINDER
    columns = 1 << max(4, math.ceil(math.log2(2 * waves)))
    around = float(size @ power)
    while around * float(columns) ** -_POINTS > negligible and columns < _MOST_PER_WAVE * waves:
        columns *= 2
    grid = on_azimuths(series, columns)
    cells = 1
    while True:
        cut, powers = _cells(degree, cells)
        beyond = float(np.max(np.sum(np.abs(np.matmul(cut[:, _POINTS:], grid)), axis=1), initial=0.0))
        if _LEBESGUE * beyond <= negligible or cells >= _MOST_CELLS:
            break
        cells *= 2
    local = np.einsum("jk,ckn->cnj", powers, np.matmul(cut[:, :_POINTS], grid))
    local = np.concatenate((local[:, -_BEFORE:], local, local[:, :_AFTER]), axis=1)
    rounding = 4.0 * _POINTS * EPS * float(np.max(np.abs(grid).sum(axis=0)))
    return Patches(local, _LEBESGUE * beyond + around * float(columns) ** -_POINTS + rounding)


@functools.cache
def _cells(degree: int, cells: int) -> tuple[Array, Array]:
    """Chebyshev coefficients over each cell from those over the piece (cells, degree + 1, degree + 1); and to powers."""
    nodes = np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    to_series = np.linalg.inv(np.polynomial.chebyshev.chebvander(nodes, degree))
    centres = -1.0 + (2.0 * np.arange(cells) + 1.0) / cells
    cut = np.array([to_series @ np.polynomial.chebyshev.chebvander(c + nodes / cells, degree) for c in centres])
    powers = np.zeros((_POINTS, _POINTS))
    for k in range(_POINTS):
        one = np.polynomial.chebyshev.cheb2poly(np.eye(_POINTS)[k])
        powers[: len(one), k] = one
    return cut, powers


@jit.model
def _tau(x, y):  # type: ignore[no-untyped-def]
    """tan(theta_n / 2) of a gradient; no branch, so that loops vectorise."""
    squared = x * x + y * y
    slope = math.sqrt(squared)
    tau = slope / (1.0 + math.sqrt(1.0 + squared))
    return tau if squared < 1e300 else 1.0


@jit.model
def _azimuth(x, y):  # type: ignore[no-untyped-def]
    """phi_n in [-pi, pi] of a gradient, as atan2(-y, -x)."""
    a, b = 0.25 * abs(y), 0.25 * abs(x)  # a sum of two stays in range
    small, large = min(a, b), max(a, b)
    turned = small > _EIGHTH * large
    top = small - large if turned else small
    bottom = small + large if turned else large
    t = top / (bottom if bottom > 0.0 else 1.0)
    z = t * t  # at most 0.172
    series = 1/3 - z * (1/5 - z * (1/7 - z * (1/9 - z * (1/11 - z * (1/13 - z * (1/15 - z * (1/17 - z * (1/19 - z * (
        1/21 - z * (1/23 - z * (1/25 - z * (1/27 - z * (1/29 - z * (1/31 - z * (
        1/33 - z * (1/35 - z / 37))))))))))))))))  # fmt: skip
    angle = t - t * z * series
    angle = angle + (0.25 * math.pi if turned else 0.0)
    angle = 0.5 * math.pi - angle if a > b else angle
    angle = math.pi - angle if x > 0.0 else angle
    return -angle if y > 0.0 else angle


def _survey_tile(p, q, start, stop, rtol, atol, value, error, bins):  # type: ignore[no-untyped-def]
    columns, largest = p.shape[1], 0.0
    along, across = np.empty(_BLOCK), np.empty(_BLOCK)
    low, high = np.full(_BLOCK, np.inf), np.zeros(_BLOCK)
    k = start
    while k < stop:
        i = k // columns
        j = k - i * columns
        n = min(min(columns - j, stop - k), _BLOCK)
        for m in range(n):
            along[m], across[m] = p[i, j + m], q[i, j + m]
        for m in range(n):  # every one: reading knows no slopes beyond
            squared = along[m] * along[m] + across[m] * across[m]
            low[m] = squared if squared < low[m] else low[m]
            high[m] = squared if squared > high[m] else high[m]
        for m in range(0, n, _EVERY):
            b = min(int(_tau(along[m], across[m]) * _BINS), _BINS - 1)
            largest = max(largest, abs(value[k + m]))
            bins[b] = min(bins[b], max(atol, 0.5 * (rtol * abs(value[k + m]) - error[k + m])))
        k += n
    return _tau(math.sqrt(low.min()), 0.0), _tau(math.sqrt(high.max()), 0.0), largest


def _read_tile(p, q, start, stop, bounds, errors, shapes, first, table, least, rtol, atol, negligible, value, error, missed):  # type: ignore[no-untyped-def]
    columns, last = p.shape[1], errors.size - 1
    along, across, tau, phi = np.empty(_BLOCK), np.empty(_BLOCK), np.empty(_BLOCK), np.empty(_BLOCK)
    weights, sums, total = np.empty((8, _BLOCK)), np.empty(8), np.empty(_BLOCK)
    base, which = np.empty(_BLOCK, dtype=np.int64), np.empty(_BLOCK, dtype=np.int64)
    scale = np.empty(errors.size)
    for piece in range(errors.size):
        scale[piece] = shapes[piece, 1] / (bounds[piece + 1] - bounds[piece])
    worst, count = 0.0, 0
    k = start
    while k < stop:
        i = k // columns
        j = k - i * columns
        n = min(min(columns - j, stop - k), _BLOCK)
        for m in range(n):
            along[m], across[m] = p[i, j + m], q[i, j + m]
        for m in range(n):
            tau[m] = _tau(along[m], across[m])
        for m in range(n):
            phi[m] = _azimuth(along[m], across[m])
        for m in range(n):
            at = tau[m]
            piece = first[min(int(at * _LOOKUP), _LOOKUP - 1)]
            while piece < last and at >= bounds[piece + 1]:
                piece += 1
            cells, around = shapes[piece, 1], shapes[piece, 2]
            within = (at - bounds[piece]) * scale[piece]
            cell = max(min(int(within), cells - 1), 0)
            tau[m] = min(max(2.0 * (within - cell) - 1.0, -1.0), 1.0)
            step = (phi[m] * (0.5 / math.pi) + 1.0) * around
            column = int(step)
            phi[m] = step - column
            base[m] = shapes[piece, 0] + (cell * (around + 7) + (column & (around - 1))) * 8
            which[m] = piece
        for m in range(n):
            # w_j = prod_{i != j} (u + 3 - i) / (j - i)
            d3 = phi[m]
            d0, d1, d2, d4, d5, d6, d7 = d3 + 3.0, d3 + 2.0, d3 + 1.0, d3 - 1.0, d3 - 2.0, d3 - 3.0, d3 - 4.0
            l2 = d0 * d1
            l3 = l2 * d2
            l4 = l3 * d3
            r5 = d6 * d7
            r4 = r5 * d5
            r3 = r4 * d4
            weights[0, m] = d1 * d2 * d3 * r3 * (-1.0 / 5040.0)
            weights[1, m] = d0 * d2 * d3 * r3 * (1.0 / 720.0)
            weights[2, m] = l2 * d3 * r3 * (-1.0 / 240.0)
            weights[3, m] = l3 * r3 * (1.0 / 144.0)
            weights[4, m] = l4 * r4 * (-1.0 / 144.0)
            weights[5, m] = l4 * d4 * r5 * (1.0 / 240.0)
            weights[6, m] = l4 * d4 * d5 * d7 * (-1.0 / 720.0)
            weights[7, m] = l4 * d4 * d5 * d6 * (1.0 / 5040.0)
        for m in range(n):
            b = base[m]
            w0, w1, w2, w3 = weights[0, m], weights[1, m], weights[2, m], weights[3, m]
            w4, w5, w6, w7 = weights[4, m], weights[5, m], weights[6, m], weights[7, m]
            patch = table[b : b + 64]
            for j in range(8):
                sums[j] = (
                    w0 * patch[j] + w1 * patch[j + 8] + w2 * patch[j + 16] + w3 * patch[j + 24]
                    + w4 * patch[j + 32] + w5 * patch[j + 40] + w6 * patch[j + 48] + w7 * patch[j + 56]
                )  # fmt: skip
            t = tau[m]
            t2 = t * t
            total[m] = (sums[0] + t * sums[1] + t2 * (sums[2] + t * sums[3])) + t2 * t2 * (
                sums[4] + t * sums[5] + t2 * (sums[6] + t * sums[7])
            )
        for m in range(n):
            e = errors[which[m]]
            if total[m] < least:
                e = max(e, least - total[m])
                total[m] = least
            if e > max(rtol * abs(total[m]), max(atol, 0.5 * (rtol * abs(value[k + m]) - error[k + m]))):
                missed[count] = k + m
                count += 1
                continue
            value[k + m] += total[m]
            error[k + m] += e
            size = abs(value[k + m])
            if e > worst * size and e > negligible and size > 0.0:
                worst = e / size
        k += n
    return worst, count


_survey = jit.kernel(_survey_tile)
_add = jit.kernel(_read_tile)
