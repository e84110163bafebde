"""Sources for the second opinion of tests/independent.py: radiance, and where it jumps, bends or is narrow.

Nothing of gonio is used. Harmonics end at degree 2 and are written out; a smooth map is Hermite's bicubic form with the
derivatives of periodic splines, down a meridian and up the opposite one.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from tests.independent_pairs import Circle, Feature

Array = NDArray[np.float64]
Part = dict[str, Any]
HALF_PI = 0.5 * math.pi


def towards(theta: float, phi: float) -> Array:
    return np.array([math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)])


def axis(part: Part) -> Array:
    if "theta" in part:
        return towards(part["theta"], part["phi"])
    direction = np.array(part.get("axis", (0.0, 0.0, 1.0)), dtype=float)
    return direction / np.linalg.norm(direction)


def radiance(part: Part, w: Array) -> Array:
    """Radiance from unit vectors w (n, 3), taken as inside the source's clip."""
    kind = part["kind"]
    if kind in ("uniform", "hemispherical", "disk"):
        return np.full(len(w), float(part["radiance"]))
    if kind == "overcast":
        return part["zenith_radiance"] * (1 + 2 * (w @ axis(part))) / 3
    if kind == "lobes":
        off = w - axis(part)  # mu.w - 1 = -|w - mu|^2 / 2
        return part["amplitude"] * np.exp(-0.5 * part["kappa"] * np.sum(off**2, axis=1))
    if kind == "spherical_harmonics":
        return _harmonics(w) @ np.array(part["coefficients"], dtype=float)
    assert kind == "environment_map"
    table = np.array(part["radiance"], dtype=float)
    rows, columns = table.shape
    x = np.arctan2(np.hypot(w[:, 0], w[:, 1]), w[:, 2]) * rows / math.pi - 0.5
    y = np.mod(np.arctan2(w[:, 1], w[:, 0]), 2 * math.pi) * columns / (2 * math.pi) - 0.5
    if part.get("interpolation") == "smooth":
        return _smooth(table, x, y)
    x = np.clip(x, 0, rows - 1)
    i, j = np.minimum(x.astype(int), rows - 2), np.floor(y).astype(int)
    x, y = x - i, y - j
    left, right = j % columns, (j + 1) % columns
    above = (1 - y) * table[i, left] + y * table[i, right]
    return (1 - x) * above + x * ((1 - y) * table[i + 1, left] + y * table[i + 1, right])


def _harmonics(w: Array) -> Array:
    """The nine of degrees 0 to 2 in the order l^2 + l + m, shape (n, 9)."""
    x, y, z = w.T
    first, second = math.sqrt(3 / (4 * math.pi)), math.sqrt(15 / (4 * math.pi))
    last = math.sqrt(5 / (16 * math.pi))
    return np.stack(
        (
            np.full(len(w), math.sqrt(1 / (4 * math.pi))), first * y, first * z, first * x,
            second * x * y, second * y * z, last * (3 * z * z - 1), second * x * z, second / 2 * (x * x - y * y),
        ),
        axis=1,
    )  # fmt: skip


def _smooth(table: Array, x: Array, y: Array) -> Array:
    """Periodic cubic spline in rows x and columns y."""
    rows, columns = table.shape
    circle = np.concatenate((table, np.roll(table, columns // 2, axis=1)[::-1]))  # of 2 rows samples around

    def slopes(values: Array, along: int) -> Array:
        closed = np.concatenate((values, np.take(values, [0], axis=along)), axis=along)
        spline = CubicSpline(np.arange(closed.shape[along]), closed, axis=along, bc_type="periodic")
        return np.asarray(spline(np.arange(values.shape[along]), 1))

    down, right = slopes(circle, 0), slopes(circle, 1)
    both = slopes(down, 1)
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    u, v = x - i, y - j
    total = np.zeros(len(x))
    for di in (0, 1):
        for dj in (0, 1):
            at = ((i + di) % (2 * rows), (j + dj) % columns)
            (h_u, k_u), (h_v, k_v) = _hermite(u, di), _hermite(v, dj)
            total += h_u * h_v * circle[at] + k_u * h_v * down[at] + h_u * k_v * right[at] + k_u * k_v * both[at]
    return total


def _hermite(t: Array, end: int) -> tuple[Array, Array]:
    """Weights of the value and of the slope at the end 0 or 1 of a unit step."""
    return (t * t * (3 - 2 * t), t * t * (t - 1)) if end else ((1 - t) ** 2 * (1 + 2 * t), t * (1 - t) ** 2)


def circles(part: Part) -> list[Circle]:
    """Horizons and rims, beyond which there is nothing, and the edges between texels, where derivatives jump."""
    if part["kind"] in ("hemispherical", "overcast"):
        return [(axis(part), HALF_PI, True)]
    if part["kind"] == "disk":
        return [(axis(part), part["half_angle"], True)]
    if part["kind"] != "environment_map":
        return []
    rows, columns = np.shape(part["radiance"])
    found: list[Circle] = [(towards(0.0, 0.0), (i + 0.5) * math.pi / rows, False) for i in range(rows)]
    middles = {round(((j + 0.5) * 2 / columns) % 1.0, 12) for j in range(columns)}  # opposite ones share a plane
    return found + [(towards(HALF_PI, m * math.pi + HALF_PI), HALF_PI, False) for m in sorted(middles)]


def features(part: Part) -> list[Feature]:
    return [(axis(part), 1 / math.sqrt(max(1.0, part["kappa"])))] if part["kind"] == "lobes" else []
