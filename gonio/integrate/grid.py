"""Gradients of any shape as one long list that is worked on tile by tile, without copies of a grid's axes.

Also beams (14a), which are so cheap that they are computed gradient by gradient in one compiled loop.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gonio import jit
from gonio.brdf.base import Term
from gonio.errors import GeometryError
from gonio.integrate.frames import Elements
from gonio.source import Collimated

Array = NDArray[np.float64]
EPS = float(np.finfo(float).eps)
TILE = 1 << 14  # gradients
BLOCK = 256  # gradients whose cosines are taken together
_LIMB = 1e-150  # least cosine of the view: an infinite slope gives the limit


class Gradients:
    """Gradients p, q that broadcast to `shape`; `p` and `q` are 2-D views whose rows make one list of `size`.

    Raises
    ------
    GeometryError
        If one is NaN, or both components of one are infinite.
    """

    def __init__(self, p: ArrayLike, q: ArrayLike) -> None:
        first, second = np.asarray(p, dtype=float), np.asarray(q, dtype=float)
        if np.any(np.isnan(first)) or np.any(np.isnan(second)):
            raise GeometryError("a gradient is NaN: give finite p and q")
        self.shape = np.broadcast_shapes(first.shape, second.shape)
        wide, high = np.broadcast_to(first, self.shape), np.broadcast_to(second, self.shape)
        if np.any(np.isinf(first)) and np.any(np.isinf(second)) and np.any(np.isinf(wide) & np.isinf(high)):
            raise GeometryError(
                "p and q are both infinite, so the direction of the slope is undefined: give one of them finite"
            )
        rows = (1, -1) if len(self.shape) < 2 else (-1, self.shape[-1]) if wide.size else (1, 0)
        self.p, self.q = (a if len(self.shape) == 2 else a.reshape(rows) for a in (wide, high))
        for view in (self.p, self.q):
            view.flags.writeable = False  # told apart from the arrays of np.broadcast_arrays, which warn when asked
        self.size = wide.size
        largest = [float(np.max(np.abs(a), initial=0.0)) for a in (first, second)]
        self.steepest = math.hypot(*largest)  # not below the largest slope, and equal to it on a grid

    def tiles(self) -> list[tuple[int, int]]:
        """Ranges of the list; they depend on its size only."""
        return [(a, min(a + TILE, self.size)) for a in range(0, self.size, TILE)]

    def select(self, index: NDArray[np.intp]) -> Gradients:
        """Some of them, as a list."""
        row, column = np.divmod(index, self.p.shape[1])
        return Gradients(self.p[row, column], self.q[row, column])

    def elements(self, start: int = 0, stop: int | None = None) -> Elements:
        """Surface elements of a range."""
        count = (self.size if stop is None else stop) - start
        out = np.empty((4, count))
        _cosines(self.p, self.q, start, out)
        return Elements(out[0], out[1], out[2], out[3])


@jit.model
def cosines(x, y):  # type: ignore[no-untyped-def]
    """cos and sin of theta_n and of phi_n of a gradient."""
    m = max(abs(x), abs(y))
    if m < 1e-100 or m > 1e100:  # squares would leave the range
        if m == 0.0:
            return 1.0, 0.0, 1.0, 0.0
        if m == math.inf:
            u, v = (math.copysign(1.0, x), 0.0) if abs(x) == m else (0.0, math.copysign(1.0, y))
        else:
            u, v = x / m, y / m
        r = math.sqrt(u * u + v * v)
        return (1.0, m * r, -u / r, -v / r) if m < 1.0 else (max(1.0 / m / r, _LIMB), 1.0, -u / r, -v / r)
    squared = x * x + y * y
    slope = math.sqrt(squared)
    c = 1.0 / math.sqrt(1.0 + squared)
    return c, slope * c, -x / slope, -y / slope


@jit.part
def block(p, q, start, stop, rows):  # type: ignore[no-untyped-def]
    """`cosines` of the gradients from `start` on, up to 256 of one row of the grid, into rows 0-3 of (6, 256); how many.

    The loop over those of a normal size has no branch and vectorises; the others, such as 0, are few.
    """
    columns = p.shape[1]
    i = start // columns
    first = start - i * columns
    n = min(min(columns - first, stop - start), BLOCK)
    x, y, c, s, cf, sf = rows[4], rows[5], rows[0], rows[1], rows[2], rows[3]
    odd = False
    for k in range(n):
        x[k], y[k] = p[i, first + k], q[i, first + k]
    for k in range(n):
        squared = x[k] * x[k] + y[k] * y[k]
        usual = (squared > 1e-200) & (squared < 1e200)
        odd |= not usual
        squared = squared if usual else 1.0
        across = 1.0 / math.sqrt(squared)
        cosine = 1.0 / math.sqrt(1.0 + squared)
        c[k], s[k], cf[k], sf[k] = cosine, squared * across * cosine, -x[k] * across, -y[k] * across
    if odd:
        for k in range(n):
            c[k], s[k], cf[k], sf[k] = cosines(x[k], y[k])
    return n


def _all_cosines(p, q, start, out):  # type: ignore[no-untyped-def]
    rows = np.empty((6, BLOCK))
    done = 0
    while done < out.shape[1]:
        n = block(p, q, start + done, start + out.shape[1], rows)
        for r in range(4):
            for k in range(n):
                out[r, done + k] = rows[r, k]
        done += n


_cosines = jit.kernel(_all_cosines, fastmath=False)


def add_beam(term: Term, beam: Collimated, gradients: Gradients, tile: tuple[int, int], value: Array, error: Array) -> float:
    """14a on one tile, for a compiled isotropic model; adds value and error; returns the largest relative error."""
    # cos theta_i is a sum of terms of order 1, good to a few eps; a lobe of width w turns 1 eps of direction into eps/w
    slack = EPS * (16.0 + 16.0 / (term.lobe_width() or 1.0))
    direction, scale = np.array(beam.direction), term.weight * beam.irradiance
    worst = _beam(term.model.function)(gradients.p, gradients.q, *tile, direction, term.values, scale, slack, value, error)
    return float(worst)


@functools.cache
def _beam(function: Any) -> Any:
    def all_beams(p, q, start, stop, direction, parameters, weight, slack, value, error):  # type: ignore[no-untyped-def]
        x, y, z = direction[0], direction[1], direction[2]
        rows, lit = np.empty((6, BLOCK)), np.empty((2, BLOCK))
        total, relative = lit[0], lit[1]
        c, s, cf, sf = rows[0], rows[1], rows[2], rows[3]
        worst, done = 0.0, start
        while done < stop:
            n = block(p, q, done, stop, rows)
            for k in range(n):
                along = x * cf[k] + y * sf[k]
                zi = along * s[k] + z * c[k]
                f = function(along * c[k] - z * s[k], y * cf[k] - x * sf[k], zi, -s[k], 0.0, c[k], parameters)
                total[k] = weight * f * zi if zi > 0.0 else 0.0
                relative[k] = slack + 4.0 * EPS / (zi if zi > EPS else EPS) if zi > 0.0 else 0.0
            for k in range(n):
                value[done + k] += total[k]
                error[done + k] += total[k] * relative[k]
                worst = max(worst, relative[k])
            done += n
        return worst

    return jit.kernel(all_beams, fastmath=False)
