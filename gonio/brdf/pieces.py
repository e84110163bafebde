"""Tables of smooth functions within the parameter array: even pieces, each a polynomial.

A table is made when the parameters are set, from the function at Chebyshev nodes, and read in the compiled model without a
branch. Where the function has a logarithmic scale, the caller takes a logarithm of its argument.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from gonio import jit

Array = NDArray[np.float64]
DEGREE = 18
ROW = DEGREE + 1


def nodes(count: int) -> Array:
    """Where the function must be known, shape (count, 19): in units of pieces, from 0 to `count`."""
    return np.arange(count)[:, None] + 0.5 + 0.5 * chebyshev.chebpts1(ROW)


def table(values: Array) -> Array:
    """The table, shape (count * 19,), of the function's values at `nodes`."""
    k = np.arange(ROW)
    waves = np.cos(np.outer(k, np.pi * (2 * k[::-1] + 1) / (2 * ROW))) * (2.0 / ROW)
    waves[0] *= 0.5
    to_powers = np.stack([np.pad(chebyshev.cheb2poly(row), (0, ROW - 1 - n)) for n, row in enumerate(_rows())])
    return np.ravel(values @ waves.T @ to_powers)


def _rows() -> list[Array]:
    return [np.eye(ROW)[n, : n + 1] for n in range(ROW)]


@jit.model
def read(x, p, at, count):  # type: ignore[no-untyped-def]
    """The function at x, from 0 to `count` in units of pieces, of the table that begins at p[at]."""
    piece = int(x)
    piece = piece if piece < count else count - 1
    t = 2.0 * (x - piece) - 1.0
    first = at + piece * ROW
    value = p[first + DEGREE]
    for k in range(DEGREE - 1, -1, -1):
        value = value * t + p[first + k]
    return value
