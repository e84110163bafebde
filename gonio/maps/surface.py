"""Gradients of surfaces given as heights or as normals.

z(x, y) lies on a grid: row j, column i is the point x = i dx, y = j dy, as the rows and columns of a reflectance map are
q and p. An image whose first row is its upper edge has a negative dy. No surface shades another here: cast shadows and
light that surfaces throw on each other are outside the reflectance map (memo, section 1), and so is occlusion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gonio.errors import GeometryError

Array = NDArray[np.float64]


def gradients_of_heights(z: ArrayLike, spacing: float | Sequence[float]) -> tuple[Array, Array]:
    """p = dz/dx and q = dz/dy by second-order differences.

    Parameters
    ----------
    z : array_like, shape (m, n)
        Heights, in the unit of the spacing; at least 3 x 3. NaN where there is no surface.
    spacing : float or (dx, dy)
        Distance of two columns and of two rows, not zero; dy < 0 where rows run downwards.

    Returns
    -------
    p, q : ndarray, shape (m, n)
        [1]; NaN at and beside a missing height.

    Raises
    ------
    GeometryError
        If the array is too small or of another shape, a height is infinite, or a spacing is zero or not finite.

    Notes
    -----
    Central differences inside, one-sided ones of the same order at the edges: the error is about
    spacing^2 |d^3 z / dx^3| / 6, twice that at an edge, and is not part of the error that a map reports.

    Examples
    --------
    >>> p, q = gradients_of_heights([[0.0, 0.5, 1.0], [0.2, 0.7, 1.2], [0.4, 0.9, 1.4]], (1.0, -1.0))
    >>> float(p[1, 1]), round(float(q[1, 1]), 12)
    (0.5, -0.2)
    """
    heights = np.asarray(z, dtype=float)
    if heights.ndim != 2 or min(heights.shape) < 3:
        raise GeometryError(f"heights of shape {heights.shape} have no gradients; give at least 3 rows of 3 columns")
    if np.any(np.isinf(heights)):
        raise GeometryError("a height is infinite; mark points without a surface with NaN")
    steps = (spacing, spacing) if isinstance(spacing, int | float | np.floating) else tuple(spacing)
    if len(steps) != 2 or not all(math.isfinite(step) and step != 0.0 for step in steps):
        raise GeometryError(f"spacing = {spacing}; give one number or (dx, dy), finite and not zero, in the unit of z")
    dx, dy = (float(step) for step in steps)
    q, p = np.gradient(heights, dy, dx, edge_order=2)
    holes = np.isnan(heights)  # central differences step over the point itself
    return np.where(holes, np.nan, p), np.where(holes, np.nan, q)


def gradients_of_normals(normals: ArrayLike) -> tuple[Array, Array]:
    """p and q of normals of any length.

    Parameters
    ----------
    normals : array_like, shape (..., 3)
        Viewer-oriented: z towards the viewer.

    Returns
    -------
    p, q : ndarray, shape (...)
        -n_x / n_z, -n_y / n_z [1]; NaN where the normal is not finite or does not point to the viewer's side (n_z <= 0):
        such a surface is not seen.

    Raises
    ------
    GeometryError
        If the last axis has not three components.
    """
    n = np.asarray(normals, dtype=float)
    if n.ndim < 1 or n.shape[-1] != 3:
        raise GeometryError(f"normals of shape {n.shape}: the last axis must have the three components x, y, z")
    seen = np.all(np.isfinite(n), axis=-1) & (n[..., 2] > 0)
    with np.errstate(over="ignore"):
        p, q = (np.divide(-n[..., k], n[..., 2], out=np.full(seen.shape, np.nan), where=seen) for k in (0, 1))
    steep = np.isinf(p) & np.isinf(q)  # so near the edge that the direction of the slope is lost
    return np.where(steep, np.nan, p + 0.0), np.where(steep, np.nan, q + 0.0)
