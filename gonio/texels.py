"""Values of sampled environment maps between their samples, compiled: bilinear, and by uniform cubic B-splines.

A direction's row and column are theta n_theta / pi - 1/2 and phi n_phi / (2 pi) - 1/2. What a map means, and whether an
array can be one, is decided in `gonio.fields`.
"""

from __future__ import annotations

import math
from typing import Any

from gonio import jit


@jit.model
def _column(x, y, columns):  # type: ignore[no-untyped-def]
    return math.atan2(y, x) * (columns / (2.0 * math.pi)) - 0.5


@jit.model
def _row(x, y, z, rows):  # type: ignore[no-untyped-def]
    return math.atan2(math.sqrt(x * x + y * y), z) * (rows / math.pi) - 0.5


def _bilinear(directions, samples, out):  # type: ignore[no-untyped-def]
    rows, columns = samples.shape
    for k in range(out.size):
        x, y, z = directions[k, 0], directions[k, 1], directions[k, 2]
        row, column = min(max(_row(x, y, z, rows), 0.0), rows - 1.0), _column(x, y, columns)
        i, j = min(int(row), max(rows - 2, 0)), math.floor(column)
        u, v = row - i, column - j
        below, left, right = min(i + 1, rows - 1), j % columns, (j + 1) % columns
        above = (1.0 - v) * samples[i, left] + v * samples[i, right]
        under = (1.0 - v) * samples[below, left] + v * samples[below, right]
        out[k] = (1.0 - u) * above + u * under


def b_spline(t: Any) -> tuple[Any, Any, Any, Any]:
    """Values of the four uniform cubic B-splines that cover a point t in [0, 1) between two knots; also of an array."""
    s = 1.0 - t
    left, right = (4.0 - 6.0 * t * t + 3.0 * t * t * t) / 6.0, (4.0 - 6.0 * s * s + 3.0 * s * s * s) / 6.0
    return s * s * s / 6.0, left, right, t * t * t / 6.0


_b_spline = jit.model(b_spline)


def _smooth(directions, control, out):  # type: ignore[no-untyped-def]
    """`control` has two more rows at either end."""
    rows, columns = control.shape[0] - 4, control.shape[1]
    for k in range(out.size):
        x, y, z = directions[k, 0], directions[k, 1], directions[k, 2]
        row, column = _row(x, y, z, rows), _column(x, y, columns)
        i, j = math.floor(row), math.floor(column)
        along, across = _b_spline(row - i), _b_spline(column - j)
        total = 0.0
        for a in range(4):
            line = control[i + 1 + a]
            part = 0.0
            for b in range(4):
                part += across[b] * line[(j + b - 1) % columns]
            total += along[a] * part
        out[k] = total


bilinear = jit.kernel(_bilinear)
smooth = jit.kernel(_smooth)
