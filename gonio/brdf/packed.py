"""The packed table, as kernels read it: where a cell begins, its weights, and the cubic sum over 64 nodes.

Along theta_h nodes are uneven: each cell carries its lower end, its reciprocal width and the coefficients of the weights of
the four nodes around it, and a list of even steps of sqrt(t) says which cell to look at first. The other axes are even.
"""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from gonio import jit

Array = NDArray[np.float64]
BUCKETS = 256  # of sqrt(t), each with the first cell that reaches into it
CELL = 18  # numbers of a cell: lower end, 1/width, 4 weights of 4 coefficients
# Masks of indices. They change none, and tell the compiler that none is negative: it then leaves out Python's counting
# from the end, an eighth of the time. NaN, as an index, becomes 0.
SMALL, LARGE = 0xFFFFFFF, 0xFFFFFFFF


@jit.model
def weights(t: float) -> tuple[float, float, float, float]:
    """Catmull-Rom weights of four even nodes at fraction t between the middle two."""
    return (
        t * (-0.5 + t * (1.0 - 0.5 * t)),
        1.0 + t * t * (1.5 * t - 2.5),
        t * (0.5 + t * (2.0 - 1.5 * t)),
        t * t * (0.5 * t - 0.5),
    )


@functools.partial(jit.part, forceinline=True, fastmath={"contract"})
def cubic(
    p: list[float],
    at: int,
    first: int,
    plane: int,
    row: int,
    u: float,
    v: tuple[float, float, float, float],
    w: tuple[float, float, float, float],
) -> float:
    """Sum over four planes from `first` on of their weights, polynomials in u from `at` on, by rows (v) and columns (w)."""
    q = 0.0
    for m in range(4):
        g = at + 4 * m
        weight = p[g] + u * (p[g + 1] + u * (p[g + 2] + u * p[g + 3]))
        x = first + m * plane
        r0 = w[0] * p[x] + w[1] * p[x + 1] + w[2] * p[x + 2] + w[3] * p[x + 3]
        x += row
        r1 = w[0] * p[x] + w[1] * p[x + 1] + w[2] * p[x + 2] + w[3] * p[x + 3]
        x += row
        r2 = w[0] * p[x] + w[1] * p[x + 1] + w[2] * p[x + 2] + w[3] * p[x + 3]
        x += row
        r3 = w[0] * p[x] + w[1] * p[x + 1] + w[2] * p[x + 2] + w[3] * p[x + 3]
        q += weight * (v[0] * r0 + v[1] * r1 + v[2] * r2 + v[3] * r3)
    return q


def cells(t: Array) -> Array:
    """Lower end, 1/width and the 4 x 4 coefficients of the weights of the nodes around each cell, shape (n - 1, CELL).

    The function is even about t = 0 and level beyond the last node.
    """
    before, after = np.concatenate(([-t[1]], t[:-2])), np.concatenate((t[2:], [2 * t[-1] - t[-2]]))
    low, high = t[:-1], t[1:]
    d0, d1, d2 = low - before, high - low, after - high
    zero, one = np.zeros_like(d1), np.ones_like(d1)
    # slopes times the width at both ends, of parabolas through three nodes, as weights of the four
    left = np.stack((-d1 * d1 / (d0 * (d0 + d1)), (d1 - d0) / d0, d0 / (d0 + d1), zero))
    right = np.stack((zero, -d2 / (d1 + d2), (d2 - d1) / d2, d1 * d1 / (d2 * (d1 + d2))))
    values = np.stack((zero, one, zero, zero)), np.stack((zero, zero, one, zero))
    # Hermite: f_1 + left u + (3 (f_2 - f_1) - 2 left - right) u^2 + (2 (f_1 - f_2) + left + right) u^3
    rise = values[1] - values[0]
    coefficients = np.stack((values[0], left, 3 * rise - 2 * left - right, left + right - 2 * rise), axis=1)  # (4, 4, n - 1)
    return np.concatenate((low[:, None], 1.0 / d1[:, None], coefficients.reshape(16, -1).T), axis=1)


def buckets(t: Array) -> Array:
    """For each even step of sqrt(t) the cell that holds its beginning."""
    start = (np.arange(BUCKETS) / BUCKETS) ** 2
    return np.clip(np.searchsorted(t, start * (1 - 1e-12), side="right") - 1, 0, len(t) - 2).astype(float)
