"""Maps that are symmetric about the view axis: one function of theta_n, tabulated and interpolated.

If BRDF and cap are both symmetric, R depends on theta_n alone. It is represented by Chebyshev polynomials on intervals
that are halved until the series, and values computed between its nodes, agree with the tolerance; a map of any size then
costs an interpolation.

References
----------
.. [1] L. N. Trefethen, Approximation Theory and Approximation Practice, SIAM, 2013, chapters 3 and 8.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Profile = Callable[[Array], tuple[Array, Array]]

_DEGREE = 15
_DEEPEST = 24  # halvings


def tabulate(profile: Profile, upper: float, *, rtol: float, atol: float) -> Callable[[Array], tuple[Array, Array]]:
    """Represent a function of theta_n on [0, upper].

    Parameters
    ----------
    profile : callable
        theta_n (k,) [rad] -> value (k,), error (k,).
    upper : float
        [rad].
    rtol, atol : float
        Tolerance of the interpolation.

    Returns
    -------
    callable
        theta_n (n,) -> value (n,), error (n,); the error includes that of the samples and of the interpolation.
    """
    nodes = np.cos(np.pi * (np.arange(_DEGREE + 1) + 0.5) / (_DEGREE + 1))
    to_series = np.linalg.inv(np.polynomial.chebyshev.chebvander(nodes, _DEGREE))
    probes = np.array([-0.99, -0.6, 0.05, 0.65, 0.985])
    edges, series, errors = [0.0], [], []
    pending = [(0.0, upper, 0)]
    while pending:
        a, b, depth = pending.pop()
        at = a + (b - a) * (np.concatenate((nodes, probes)) + 1.0) / 2.0
        value, sampled = profile(at)
        coefficients = to_series @ value[: _DEGREE + 1]
        missed = np.abs(np.polynomial.chebyshev.chebval(probes, coefficients) - value[_DEGREE + 1 :])
        tail = float(np.sum(np.abs(coefficients[-3:])))
        interpolation = max(2.0 * float(missed.max()), tail)
        allowed = max(0.5 * rtol * float(np.min(np.abs(value))), 0.5 * atol, 2.0 * float(sampled.max()))
        if interpolation > allowed and depth < _DEEPEST:
            middle = 0.5 * (a + b)
            pending += [(middle, b, depth + 1), (a, middle, depth + 1)]  # the left one comes next
            continue
        edges.append(b)
        series.append(coefficients)
        errors.append(interpolation + 2.0 * float(sampled.max()))  # Lebesgue constant of 16 nodes is below 3
    bounds, table, error = np.array(edges), np.array(series).T, np.array(errors)

    def evaluate(theta_n: Array) -> tuple[Array, Array]:
        piece = np.clip(np.searchsorted(bounds, theta_n, side="right") - 1, 0, len(error) - 1)
        x = (2.0 * theta_n - bounds[piece] - bounds[piece + 1]) / (bounds[piece + 1] - bounds[piece])
        # Clenshaw's recurrence with per-point coefficients
        b1, b2 = np.zeros_like(x), np.zeros_like(x)
        for row in table[:0:-1]:
            b1, b2 = 2.0 * x * b1 - b2 + row[piece], b1
        return x * b1 - b2 + table[0][piece], error[piece]

    return evaluate
