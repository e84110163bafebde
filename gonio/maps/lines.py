"""Contours of constant R as polylines: marching squares on the grid, then every vertex moved onto the contour itself.

It draws nothing; `gonio.report.contours` does.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gonio.errors import ParameterError

if TYPE_CHECKING:
    from gonio.maps.grid import Method, ReflectanceMap

Array = NDArray[np.float64]

_STEPS = 6  # Newton's, with the slope of the grid: each shortens the distance to the contour by its relative error
_FINE = 1e-12  # of half a cell: a step shorter than this changes nothing
_MOST_LEVELS = 1000


def contour_lines(
    reflectance_map: ReflectanceMap, levels: ArrayLike | int = 10, *, rtol: float = 1e-6, method: Method = "auto"
) -> dict[float, list[Array]]:
    """Lines on which R(p, q) has a given value.

    Parameters
    ----------
    reflectance_map : ReflectanceMap
        Where it is NaN there are no lines.
    levels : array_like or int, optional
        Radiances [W m^-2 sr^-1]; a number of levels means that many equal steps between the smallest and the largest
        value of the map, both left out.
    rtol, method
        As in `ReflectanceMap.evaluate`: where R comes from when the vertices are moved onto their contour.

    Returns
    -------
    dict of float to list of ndarray, shape (k, 2)
        Of each level, in the order given, its lines as vertices (p, q); a closed line ends where it began. A level that
        the map does not reach has an empty list.

    Raises
    ------
    ParameterError
        If a level is not finite, or there are more than 1000.

    Notes
    -----
    Topology is that of the grid: two lines closer than its spacing may come out as one. A vertex moves at most by half
    a cell, and stays where the grid put it if that brings it no nearer to the level, as on a jump.
    """
    import contourpy

    reflectance_map.interpolant  # noqa: B018  checks axes and shapes
    value = reflectance_map.value
    finite = value[np.isfinite(value)]
    if isinstance(levels, int | np.integer):
        if not 1 <= levels <= _MOST_LEVELS:
            raise ParameterError(f"{levels} contour levels; choose 1 to {_MOST_LEVELS}, or give the levels themselves")
        ends = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
        wanted = np.linspace(*ends, int(levels) + 2)[1:-1] if ends[0] < ends[1] else np.zeros(0)
    else:
        wanted = np.atleast_1d(np.asarray(levels, dtype=float)).ravel()
    if wanted.size > _MOST_LEVELS or not np.all(np.isfinite(wanted)):
        raise ParameterError(f"{wanted.size} contour levels; give at most {_MOST_LEVELS}, all of them finite")
    generator = contourpy.contour_generator(
        reflectance_map.p, reflectance_map.q, np.ma.masked_invalid(value), line_type=contourpy.LineType.Separate
    )
    drawn = {float(level): [np.array(line, dtype=float) for line in generator.lines(float(level))] for level in wanted}
    pieces = [line for lines in drawn.values() for line in lines]
    if not pieces:
        return drawn
    target = np.concatenate([np.full(len(line), level) for level, lines in drawn.items() for line in lines])
    moved = _onto(reflectance_map, np.concatenate(pieces), target, rtol, method)
    rest = iter(np.split(moved, np.cumsum([len(line) for line in pieces])[:-1]))
    return {level: [next(rest) for _ in lines] for level, lines in drawn.items()}


def _onto(reflectance_map: ReflectanceMap, at: Array, level: Array, rtol: float, method: Method) -> Array:
    """Vertices (k, 2) moved along the gradient of R until R has its level, each by half a cell at most."""
    p, q = reflectance_map.p, reflectance_map.q
    cell = [np.clip(np.searchsorted(a, at[:, k], side="right") - 1, 0, a.size - 2) for k, a in enumerate((p, q))]
    reach = 0.5 * np.stack((np.diff(p)[cell[0]], np.diff(q)[cell[1]]), axis=-1)
    lower, upper = np.maximum(at - reach, (p[0], q[0])), np.minimum(at + reach, (p[-1], q[-1]))
    free = (at > (p[0], q[0])) & (at < (p[-1], q[-1]))  # the end of a line slides along the border of the map
    best, missing = at.copy(), np.full(len(at), np.inf)
    trial, pending = at.copy(), np.arange(len(at))
    for _ in range(_STEPS + 1):
        here = trial[pending]
        value = reflectance_map._at(here[:, 0], here[:, 1], method, rtol).value
        off = level[pending] - value
        nearer = np.abs(off) < missing[pending]
        best[pending[nearer]], missing[pending[nearer]] = here[nearer], np.abs(off[nearer])
        slope = reflectance_map.interpolant(here[:, 0], here[:, 1])[1][:, 0] * free[pending]
        steepness = np.sum(slope**2, axis=-1)
        move = np.divide(off, steepness, out=np.zeros_like(off), where=steepness > 0)[:, None] * slope
        trial[pending] = np.clip(here + np.nan_to_num(move), lower[pending], upper[pending])
        pending = pending[np.any(np.abs(trial[pending] - here) > _FINE * reach[pending], axis=-1)]
    return best
