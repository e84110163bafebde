"""Maps that are symmetric about the view axis: one function of theta_n, tabulated and interpolated.

If BRDF and cap are both symmetric, R depends on theta_n alone. Over tau = tan(theta_n / 2), which costs two square roots
from a gradient, it is represented by Chebyshev polynomials on intervals that grow away from its features (where the mirror
direction crosses the rim, the limb) and are halved until the series, and values computed between its nodes, agree with the
tolerance. A map of any size then costs an interpolation.

References
----------
.. [1] L. N. Trefethen, Approximation Theory and Approximation Practice, SIAM, 2013, chapters 3 and 8.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.integrate.frames import Elements
from gonio.integrate.grid import BLOCK, Gradients

Array = NDArray[np.float64]
Profile = Callable[[Array, NDArray[np.intp]], tuple[Array, Array]]

_NOTHING = 1e-30  # of the largest value: the tail of a lobe underflows, and no digits are left to agree
_FAINT = 1e-24  # of it: what is fainter and not a tail, but falls to 0, has no digits of its own
_STEEP = 30.0  # ratio of the values of a piece from which on it is their logarithm that is a polynomial
_SHORT = 0.4  # of the tolerance, for the samples, whose share is an eighth: more than they should take
_DEEPEST = 40  # halvings
_MOST_PIECES = 500
_NOISE = 0.35  # ratio of the last coefficients to those before from which on they are noise of the samples
_FIRST, _GROWTH = 1.9, 4.4  # widths of a feature: the interval next to it, and how the others grow
_RATE = 2.8  # the series of intervals graded so fall at least like this
_BETWEEN = np.array([-1.0, -0.45, 0.2, 1.0])
PROBES = len(_BETWEEN)
_LOOKUP = 256
_END = 1.0 - 2.0**-53


@dataclass(frozen=True)
class Table:
    """Piecewise Chebyshev series over tau.

    Attributes
    ----------
    bounds : ndarray, shape (k + 1,)
        Of tau, rising from 0.
    series : ndarray, shape (k, degree + 1)
    error : ndarray, shape (k,)
        Of a value in that piece, from samples and interpolation; of a logarithm where `logarithmic`.
    logarithmic : ndarray of bool, shape (k,)
        Where the series is that of ln R: the tail of a lobe.
    first : ndarray of int, shape (256,)
        Piece at the lower end of each 256th of [0, 1].
    relative : float
        Largest relative error.
    """

    bounds: Array
    series: Array
    error: Array
    logarithmic: NDArray[np.bool_]
    first: NDArray[np.int64]
    relative: float

    def add(self, gradients: Gradients, tile: tuple[int, int], value: Array, error: Array) -> float:
        """Add value and error on one tile of gradients; returns the table's largest relative error."""
        _add(
            gradients.p, gradients.q, *tile, self.bounds, self.series, self.error, self.logarithmic, self.first, value, error
        )
        return self.relative


def elements(tau: Array) -> Elements:
    """Surface elements of given tan(theta_n / 2), at phi_n = 0."""
    squared = tau * tau
    return Elements(
        (1.0 - tau) * (1.0 + tau) / (1.0 + squared), 2.0 * tau / (1.0 + squared), np.ones_like(tau), np.zeros_like(tau)
    )


def tau_of_slope(slope: float) -> float:
    """tan(theta_n / 2) of a slope tan(theta_n)."""
    return min(slope / (1.0 + math.hypot(1.0, slope)), _END) if slope < 1e15 else _END


@functools.cache
def _to_series(degree: int) -> tuple[Array, Array]:
    """Chebyshev nodes, and the matrix that turns values there into coefficients."""
    nodes: Array = np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    return nodes, np.asarray(np.linalg.inv(np.polynomial.chebyshev.chebvander(nodes, degree)), dtype=np.float64)


def _breaks(upper: float, features: Iterable[tuple[float, float]]) -> Array:
    """Bounds of tau in [0, upper], graded towards features (theta_n, width) [rad]; pi/2 is one of them."""
    last = 2.0 * math.atan(upper)
    points = {0.0}
    for at, width in features:
        reach = _FIRST * width
        if 0.0 < at < last:
            points.add(at)
        while reach < math.pi:
            points.update(x for x in (at - reach, at + reach) if 0.0 < x < last)
            reach *= _GROWTH
        if at >= math.pi / 2:  # a logarithm at the limb: on to where the map ends
            reach = _FIRST * width / _GROWTH
            while reach > 2.0 * (math.pi / 2 - last) and reach > 1e-15:
                points.add(math.pi / 2 - reach)
                reach /= _GROWTH
    ordered = np.tan(0.5 * np.array(sorted(points)))
    gaps = np.diff(np.append(ordered, upper))
    keep = np.append(True, gaps[:-1] > 0.2 * gaps[1:]) & (gaps > 1e-3 * (upper - ordered))  # drop slivers
    keep[0] = True
    return np.append(ordered[keep], upper)


def tabulate(
    profile: Profile, upper: float, *, rtol: float, atol: float, features: Iterable[tuple[float, float]] = ()
) -> Table:
    """Represent a function of theta_n on tau in [0, upper].

    Parameters
    ----------
    profile : callable
        tau (k, n), finer (k,) -> value (k, n), error (k, n), for the places of k pieces, of which the last `PROBES` tell of
        all; where `finer` is 1, values should be more exact than they seem to have to be.
    upper : float
        Largest tan(theta_n / 2), below 1.
    rtol, atol : float
        Tolerance of the interpolation.
    features : iterable of (theta_n, width)
        [rad]; where the function changes within less than a radian.

    Returns
    -------
    Table
        Its error includes that of the samples and of the interpolation.
    """
    degree = int(np.clip(math.ceil(math.log(10.0 / max(rtol, 1e-14)) / math.log(_RATE)), 7, 27))
    nodes, to_series = _to_series(degree)
    lebesgue = 1.0 + (2.0 / math.pi) * math.log(degree + 1.0)
    places = np.concatenate((nodes, _BETWEEN))
    at_probes = np.polynomial.chebyshev.chebvander(_BETWEEN, degree)
    bounds = _breaks(max(upper, 1e-3), features)
    pending = [(a, b, 0, 0) for a, b in itertools.pairwise(bounds)]
    ready: list[tuple[float, float, Array, float, bool]] = []
    relative_error = top = 0.0
    while pending:
        a, b = (np.array([piece[k] for piece in pending])[:, None] for k in (0, 1))
        finer = np.array([piece[3] for piece in pending])
        value, sampled = profile(a + 0.5 * (b - a) * (places + 1.0), finer)
        top = max(top, float(np.max(np.abs(value))))
        absolute = max(atol, _FAINT * top)
        least, most = np.min(value, axis=1), np.max(value, axis=1)
        steep = (least > 10.0 * max(atol, _NOTHING * top) / rtol) & (most > _STEEP * least)  # samples are good to `absolute`
        value[steep], sampled[steep] = np.log(value[steep]), sampled[steep] / value[steep]
        series = value[:, : degree + 1] @ to_series.T
        missed = np.max(np.abs(series @ at_probes.T - value[:, degree + 1 :]), axis=1)
        worst, size = np.max(sampled, axis=1), np.where(steep, 1.0, np.min(np.abs(value), axis=1))
        tail, before = np.sum(np.abs(series[:, -2:]), axis=1), np.sum(np.abs(series[:, -4:-2]), axis=1)
        interpolation = np.maximum(2.0 * missed, 0.5 * tail)
        allowed = np.maximum(rtol * size, np.where(steep, 0.0, absolute)) - lebesgue * worst
        # where the samples themselves fall short, halving can't help
        scale = np.where(steep[:, None], 1.0, np.maximum(np.abs(value), absolute / rtol + 1e-300))
        relative = np.max(sampled / scale, axis=1)
        allowed = np.where(lebesgue * relative > _SHORT * rtol, np.maximum(allowed, 2.0 * worst), allowed)
        again = []
        for k, (left, right, depth, orders) in enumerate(pending):
            if interpolation[k] > allowed[k] and orders == 0 and tail[k] > _NOISE * before[k]:
                again.append((left, right, depth, 1))
            elif interpolation[k] > allowed[k] and depth < _DEEPEST and len(ready) + len(again) < _MOST_PIECES:
                middle = 0.5 * (left + right)
                again += [(left, middle, depth + 1, orders), (middle, right, depth + 1, orders)]
            else:
                rounding = 4.0 * (degree + 1) * np.finfo(float).eps * float(np.max(np.abs(value[k])))
                error = max(interpolation[k] + lebesgue * worst[k], 0.3 * rtol * size[k]) + rounding
                ready.append((left, right, series[k], error, bool(steep[k])))
                relative_error = max(relative_error, error / size[k] if size[k] > 0.0 else 0.0)
        pending = again
    ready.sort(key=lambda piece: piece[0])
    ends = np.array([0.0] + [piece[1] for piece in ready])
    first = np.clip(np.searchsorted(ends, np.arange(_LOOKUP) / _LOOKUP, side="right") - 1, 0, len(ready) - 1)
    series, error = np.array([piece[2] for piece in ready]), np.array([piece[3] for piece in ready])
    logarithmic = np.array([piece[4] for piece in ready])
    return Table(ends, series, error, logarithmic, first.astype(np.int64), relative_error)


def _evaluate(p, q, start, stop, bounds, series, piece_error, logarithmic, first, value, error):  # type: ignore[no-untyped-def]
    columns, last, degree = p.shape[1], series.shape[0] - 1, series.shape[1] - 1
    coefficients, at = series.ravel(), np.empty(BLOCK, dtype=np.int64)
    rows = np.empty((4, BLOCK))
    tau, t, total, before = rows[0], rows[1], rows[2], rows[3]
    done = start
    while done < stop:
        i = done // columns
        j = done - i * columns
        n = min(min(columns - j, stop - done), BLOCK)
        for k in range(n):
            x, y = p[i, j + k], q[i, j + k]
            tau[k] = x * x + y * y
        for k in range(n):
            squared = tau[k]
            near = squared < 1e30
            squared = squared if near else 1.0
            some = math.sqrt(squared) / (1.0 + math.sqrt(1.0 + squared))
            tau[k] = some if near and some < _END else _END
        for k in range(n):
            piece = first[min(int(tau[k] * _LOOKUP), _LOOKUP - 1)]
            while piece < last and tau[k] > bounds[piece + 1]:
                piece += 1
            a, b = bounds[piece], bounds[piece + 1]
            t[k] = min(max((2.0 * tau[k] - a - b) / (b - a), -1.0), 1.0)
            at[k] = piece
            total[k] = before[k] = 0.0
        for r in range(degree, 0, -1):  # Clenshaw's recurrence
            for k in range(n):
                now = 2.0 * t[k] * total[k] - before[k] + coefficients[at[k] * (degree + 1) + r]
                before[k] = total[k]
                total[k] = now
        for k in range(n):
            piece = at[k]
            read, slack = t[k] * total[k] - before[k] + series[piece, 0], piece_error[piece]
            if logarithmic[piece]:
                read = math.exp(read)
                slack *= read
            value[done + k] += read
            error[done + k] += slack
        done += n


_add = jit.kernel(_evaluate)
