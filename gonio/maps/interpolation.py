"""Values between the points of a grid: cubic in each direction, with a bound that holds across kinks and jumps.

A reflectance map has a kink along every terminator and a jump along the rim of a mirror image, so the interpolant is
local: four points in each direction, nothing rings beyond them. Its error is taken from the fourth differences around
the cell. That never vanishes near a kink that the grid has seen and is some thirty times too large where the map is
smooth. A structure narrower than the spacing of the grid leaves no trace in the values, and none in the error.

Nothing here extrapolates: outside its axes the interpolant is NaN.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gonio.errors import DatasetError

Array = NDArray[np.float64]
Index = NDArray[np.intp]

_POINTS = 4
# Largest ratio of the true error to the largest fourth difference near the cell, over all positions of a kink or a jump;
# 1.3 for the second direction.
_INSIDE, _BORDER = 1.3 * 0.55, 1.3


class Interpolant:
    """Several functions on one grid, interpolated together.

    Parameters
    ----------
    p, q : ndarray, shapes (n,) and (m,)
        Strictly increasing axes.
    value, error : ndarray, shape (c, m, n)
        Of c functions; the error of the values is carried along.

    Raises
    ------
    DatasetError
        If an axis has fewer than two points or does not increase, or a shape does not fit.
    """

    def __init__(self, p: Array, q: Array, value: Array, error: Array) -> None:
        for name, axis in (("p", p), ("q", q)):
            if axis.ndim != 1 or axis.size < 2 or not np.all(np.isfinite(axis)) or not np.all(np.diff(axis) > 0):
                raise DatasetError(f"axis {name} of the map must be at least two finite, strictly increasing gradients")
        if value.ndim != 3 or value.shape[1:] != (q.size, p.size) or error.shape != value.shape:
            raise DatasetError(
                f"a map on {p.size} gradients p and {q.size} gradients q needs values and errors of shape "
                f"({q.size}, {p.size}), got {value.shape[1:]} and {error.shape[1:]}"
            )
        self.p, self.q = p, q
        self._p, self._q = _Axis(p), _Axis(q)
        self._value = np.ascontiguousarray(np.moveaxis(value, 0, -1))  # (m, n, c)
        self._error = np.ascontiguousarray(np.moveaxis(self._cell_errors(value, np.abs(error)), 0, -1))

    def __call__(self, p: Array, q: Array) -> tuple[Array, Array, Array]:
        """Values, derivatives and errors.

        Parameters
        ----------
        p, q : ndarray, shape (n,)

        Returns
        -------
        value : ndarray, shape (n, c)
        derivative : ndarray, shape (n, c, 2)
            With respect to p and q.
        error : ndarray, shape (n, c)
            Bound of the interpolation's error, carried error of the values included.
        """
        cell_p, start_p, w_p, d_p, inside_p = self._p.weights(p)
        cell_q, start_q, w_q, d_q, inside_q = self._q.weights(q)
        shape = (len(p), self._value.shape[2])
        value, along_p, along_q = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        for b in range(w_q.shape[1]):
            row, slope = np.zeros(shape), np.zeros(shape)
            for a in range(w_p.shape[1]):
                v = self._value[start_q + b, start_p + a]
                row += w_p[:, a, None] * v
                slope += d_p[:, a, None] * v
            value += w_q[:, b, None] * row
            along_p += w_q[:, b, None] * slope
            along_q += d_q[:, b, None] * row
        error = self._error[cell_q, cell_p]
        outside = ~(inside_p & inside_q)
        if np.any(outside):
            value[outside], along_p[outside], along_q[outside], error[outside] = np.nan, np.nan, np.nan, np.nan
        return value, np.stack((along_p, along_q), axis=-1), error

    def ranges(self) -> tuple[Array, Array]:
        """Smallest and largest value in every cell, errors included, shape (m - 1, n - 1, c) each.

        A cell with a summit goes beyond its corners, by up to an eighth of the second difference in each direction.
        """
        value = np.moveaxis(self._value, -1, 0)
        bulge = self._q.spread(self._p.differences(value, 2), axis=1)
        bulge += self._p.spread(np.swapaxes(self._q.differences(np.swapaxes(value, 1, 2), 2), 1, 2), axis=2)
        slack = 0.25 * np.moveaxis(bulge, 0, -1) + self._error
        v = self._value
        corners = (v[:-1, :-1], v[:-1, 1:], v[1:, :-1], v[1:, 1:])
        return np.minimum.reduce(corners) - slack, np.maximum.reduce(corners) + slack

    def _cell_errors(self, value: Array, error: Array) -> Array:
        """Of every cell, shape (c, m - 1, n - 1): differences in both directions, and 2.7 times the error of the values.

        2.7 is the square of 1.63, the largest sum of the absolute cubic weights, reached in the outermost cells.
        """
        over_p = self._q.spread(self._p.truncation(value), axis=1)
        over_q = self._p.spread(np.swapaxes(self._q.truncation(np.swapaxes(value, 1, 2)), 1, 2), axis=2)
        carried = self._q.spread(self._p.spread(error, axis=2), axis=1)
        return np.asarray(over_p + over_q + 2.7 * carried)


class _Axis:
    """One direction: where a point lies, the weights of its four neighbours, the differences along it."""

    def __init__(self, at: Array) -> None:
        self.at, self.points = at, min(_POINTS, at.size)
        windows = np.lib.stride_tricks.sliding_window_view(at, self.points)
        gaps = windows[:, :, None] - windows[:, None, :]
        gaps[:, np.arange(self.points), np.arange(self.points)] = 1.0
        self.scale = 1.0 / np.prod(gaps, axis=2)  # (starts, points)

    def start(self, cell: Index) -> Index:
        """First of the points whose polynomial serves a cell."""
        return np.clip(cell - 1, 0, self.at.size - self.points)

    def weights(self, x: Array) -> tuple[Index, Index, Array, Array, NDArray[np.bool_]]:
        """Cell, first point, weights and their derivatives (n, points), and whether x is on the axis."""
        inside = (x >= self.at[0]) & (x <= self.at[-1])
        x = np.where(inside, x, self.at[0])
        cell = np.clip(np.searchsorted(self.at, x, side="right") - 1, 0, self.at.size - 2)
        start = self.start(cell)
        off = [x - self.at[start + a] for a in range(self.points)]
        weight, derivative = np.empty((len(x), self.points)), np.empty((len(x), self.points))
        for a in range(self.points):
            others = [off[b] for b in range(self.points) if b != a]
            product, slope = np.ones_like(x), np.zeros_like(x)
            for factor in others:
                slope, product = slope * factor + product, product * factor
            weight[:, a] = product * self.scale[start, a]
            derivative[:, a] = slope * self.scale[start, a]
        return cell, start, weight, derivative, inside

    def differences(self, value: Array, order: int) -> Array:
        """Largest difference of some order near each cell, along the last axis: (..., n) -> (..., n - 1)."""
        n = self.at.size
        order = min(order, max(n - 2, 1))  # two at least, as a single one may vanish by chance
        table = value
        for k in range(1, order + 1):
            table = np.diff(table, axis=-1) / (self.at[k:] - self.at[:-k])
        spacing = (self.at[order:] - self.at[:-order]) / order
        table = np.abs(table) * spacing**order * math.factorial(order)  # as on an even grid
        cells, last = np.arange(n - 1), table.shape[-1] - 1
        worst = np.zeros(value.shape[:-1] + (n - 1,))
        for shift in range(-order, 2):
            np.maximum(worst, table[..., np.clip(cells + shift, 0, last)], out=worst)
        return worst

    def truncation(self, value: Array) -> Array:
        """Error of the interpolation along the last axis, one per cell."""
        factor = np.full(self.at.size - 1, _INSIDE)
        factor[[0, -1]] = _BORDER
        return np.asarray(self.differences(value, _POINTS) * factor)

    def spread(self, value: Array, axis: int) -> Array:
        """Largest of the points that serve each cell, along `axis` (n -> n - 1)."""
        start = self.start(np.arange(self.at.size - 1))
        worst = np.take(value, start, axis=axis)
        for a in range(1, self.points):
            worst = np.maximum(worst, np.take(value, start + a, axis=axis))
        return worst
