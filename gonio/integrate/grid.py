"""Gradients of any shape as one long list that is worked on tile by tile, without copies of a grid's axes.

Also what is so cheap that it is computed gradient by gradient in one compiled loop: beams (14a) and diffuse surfaces under
hemispheres (14b, 14c).
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
from gonio.integrate.closed_forms import diffuse_albedo
from gonio.integrate.frames import Elements
from gonio.source import Cap, Collimated

Array = NDArray[np.float64]
EPS = float(np.finfo(float).eps)
TILE = 1 << 14  # gradients
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


def _all_cosines(p, q, start, out):  # type: ignore[no-untyped-def]
    columns = p.shape[1]
    for k in range(out.shape[1]):
        i = (start + k) // columns
        j = start + k - i * columns
        out[0, k], out[1, k], out[2, k], out[3, k] = cosines(p[i, j], q[i, j])


def _all_facing(p, q, start, stop, axis, a, b, slack, value, error):  # type: ignore[no-untyped-def]
    columns = p.shape[1]
    for k in range(start, stop):
        i = k // columns
        c, s, cf, sf = cosines(p[i, k - i * columns], q[i, k - i * columns])
        value[k] += a + b * ((axis[0] * cf + axis[1] * sf) * s + axis[2] * c)
        error[k] += slack


_cosines = jit.kernel(_all_cosines, fastmath=False)
_facing = jit.kernel(_all_facing, fastmath=False)


def add_diffuse(term: Term, cap: Cap, gradients: Gradients, tile: tuple[int, int], value: Array, error: Array) -> float:
    """14b and 14c on one tile: adds value and error; returns the largest relative error."""
    full = diffuse_albedo(term) * cap.radiance
    half = cap.half_angle < math.pi
    a, b = (0.5 * full, 0.5 * full) if half else (full, 0.0)
    _facing(gradients.p, gradients.q, *tile, np.array(cap.axis), a, b, 8.0 * EPS * full, value, error)
    return 8.0 * EPS


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
        columns, worst = p.shape[1], 0.0
        x, y, z = direction[0], direction[1], direction[2]
        for k in range(start, stop):
            i = k // columns
            c, s, cf, sf = cosines(p[i, k - i * columns], q[i, k - i * columns])
            along = x * cf + y * sf
            zi = along * s + z * c
            if zi > 0.0:
                f = function(along * c - z * s, y * cf - x * sf, zi, -s, 0.0, c, parameters)
                lit = weight * f * zi
                relative = slack + 4.0 * EPS / max(zi, EPS)
                value[k] += lit
                error[k] += lit * relative
                worst = max(worst, relative)
        return worst

    return jit.kernel(all_beams, fastmath=False)
