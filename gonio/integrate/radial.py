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
from gonio.integrate.grid import Gradients

Array = NDArray[np.float64]
Profile = Callable[[Array], tuple[Array, Array]]

_NOTHING = 1e-30  # of the largest value: the tail of a lobe underflows, and no digits are left to agree
_DEEPEST = 40  # halvings
_FIRST, _GROWTH = 1.9, 4.4  # widths of a feature: the interval next to it, and how the others grow
_RATE = 2.8  # the series of intervals graded so fall at least like this
_PROBES = np.array([-1.0, -0.45, 0.2, 1.0])
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
        Of a value in that piece, from samples and interpolation.
    first : ndarray of int, shape (256,)
        Piece at the lower end of each 256th of [0, 1].
    relative : float
        Largest relative error.
    """

    bounds: Array
    series: Array
    error: Array
    first: NDArray[np.int64]
    relative: float

    def add(self, gradients: Gradients, tile: tuple[int, int], value: Array, error: Array) -> float:
        """Add value and error on one tile of gradients; returns the table's largest relative error."""
        _add(gradients.p, gradients.q, *tile, self.bounds, self.series, self.error, self.first, value, error)
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
        tau (k,) -> value (k,), error (k,).
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
    places = np.concatenate((nodes, _PROBES))
    at_probes = np.polynomial.chebyshev.chebvander(_PROBES, degree)
    bounds = _breaks(max(upper, 1e-3), features)
    pending = [(a, b, 0) for a, b in itertools.pairwise(bounds)]
    ready: list[tuple[float, float, Array, float]] = []
    relative_error = top = 0.0
    while pending:
        a, b = (np.array([piece[k] for piece in pending])[:, None] for k in (0, 1))
        value, sampled = (v.reshape(len(pending), -1) for v in profile((a + 0.5 * (b - a) * (places + 1.0)).ravel()))
        series = value[:, : degree + 1] @ to_series.T
        missed = np.max(np.abs(series @ at_probes.T - value[:, degree + 1 :]), axis=1)
        worst, least = np.max(sampled, axis=1), np.min(np.abs(value), axis=1)
        interpolation = np.maximum(2.0 * missed, 0.5 * np.sum(np.abs(series[:, -2:]), axis=1))
        top = max(top, float(np.max(np.abs(value))))
        allowed = np.maximum(np.maximum(rtol * least, atol) - lebesgue * worst, _NOTHING * top)
        # where the samples themselves fall short, halving can't help
        relative = np.max(sampled / np.maximum(np.abs(value), atol / rtol + 1e-300), axis=1)
        allowed = np.where(lebesgue * relative > 0.9 * rtol, np.maximum(allowed, 2.0 * worst), allowed)
        again = []
        for k, (left, right, depth) in enumerate(pending):
            if interpolation[k] > allowed[k] and depth < _DEEPEST:
                middle = 0.5 * (left + right)
                again += [(left, middle, depth + 1), (middle, right, depth + 1)]
            else:
                rounding = 4.0 * (degree + 1) * np.finfo(float).eps * float(np.max(np.abs(value[k])))
                error = max(interpolation[k] + lebesgue * worst[k], 0.3 * rtol * least[k])
                ready.append((left, right, series[k], error + rounding))
                relative_error = max(relative_error, (error + rounding) / least[k] if least[k] > 0.0 else 0.0)
        pending = again
    ready.sort(key=lambda piece: piece[0])
    ends = np.array([0.0] + [piece[1] for piece in ready])
    first = np.clip(np.searchsorted(ends, np.arange(_LOOKUP) / _LOOKUP, side="right") - 1, 0, len(ready) - 1)
    series, error = np.array([piece[2] for piece in ready]), np.array([piece[3] for piece in ready])
    return Table(ends, series, error, first.astype(np.int64), relative_error)


def _evaluate(p, q, start, stop, bounds, series, piece_error, first, value, error):  # type: ignore[no-untyped-def]
    columns, last, degree = p.shape[1], series.shape[0] - 1, series.shape[1] - 1
    for k in range(start, stop):
        i = k // columns
        x, y = p[i, k - i * columns], q[i, k - i * columns]
        squared = x * x + y * y
        tau = _END
        if squared < 1e30:
            tau = min(math.sqrt(squared) / (1.0 + math.sqrt(1.0 + squared)), _END)
        piece = first[min(int(tau * _LOOKUP), _LOOKUP - 1)]
        while piece < last and tau > bounds[piece + 1]:
            piece += 1
        a, b = bounds[piece], bounds[piece + 1]
        t = (2.0 * tau - a - b) / (b - a)
        t = min(max(t, -1.0), 1.0)
        b1 = b2 = 0.0  # Clenshaw's recurrence
        for j in range(degree, 0, -1):
            b1, b2 = 2.0 * t * b1 - b2 + series[piece, j], b1
        value[k] += t * b1 - b2 + series[piece, 0]
        error[k] += piece_error[piece]


_add = jit.kernel(_evaluate)
