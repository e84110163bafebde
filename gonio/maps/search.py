"""Where on a grid of gradients can given radiances come from?

A pyramid over the cells of the maps holds the smallest and the largest radiance of every block of cells, widened by
the error of the interpolation. A block whose ranges leave out one of the radiances of a pixel can hold no solution, and
is dropped with all of its cells; what is left are the places to start from. No solution that the grid resolves is lost,
however many there are.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gonio.maps.interpolation import Interpolant

Array = NDArray[np.float64]
Index = NDArray[np.intp]

MOST_BLOCKS = 2048  # for one pixel; more is a continuum of solutions


class Pyramid:
    """Ranges of several maps over blocks of 2^k x 2^k cells.

    Parameters
    ----------
    interpolant : Interpolant
        Of the maps; of its functions the first `maps` count.
    maps : int
    slack : ndarray, shape (m - 1, n - 1, maps)
        What the ranges of the cells are widened by, beyond the errors of the interpolation.
    """

    def __init__(self, interpolant: Interpolant, maps: int, slack: Array) -> None:
        low, high = (ends[..., :maps] for ends in interpolant.ranges())
        low, high = low - slack, high + slack
        holes = ~(np.isfinite(low) & np.isfinite(high))  # the map is not known there
        low[holes], high[holes] = np.inf, -np.inf
        side = 1 << int(max(low.shape[:2]) - 1).bit_length()
        padding = ((0, side - low.shape[0]), (0, side - low.shape[1]), (0, 0))
        low = np.pad(low, padding, constant_values=np.inf)
        high = np.pad(high, padding, constant_values=-np.inf)
        self._p, self._q = interpolant.p, interpolant.q
        self._levels = [(low, high)]  # the finest first
        while low.shape[0] > 1:
            low = np.minimum(np.minimum(low[::2, ::2], low[1::2, ::2]), np.minimum(low[::2, 1::2], low[1::2, 1::2]))
            high = np.maximum(np.maximum(high[::2, ::2], high[1::2, ::2]), np.maximum(high[::2, 1::2], high[1::2, 1::2]))
            self._levels.append((low, high))

    def starts(self, radiance: Array, reach: Array) -> tuple[Index, Array, Array, NDArray[np.bool_]]:
        """Centres of all blocks that may hold a solution.

        Parameters
        ----------
        radiance, reach : ndarray, shape (pixels, maps)
            Radiances looked for, and how far off a solution may be. Blocks are split until their range is below twice the
            reach, or down to single cells.

        Returns
        -------
        pixel : ndarray, shape (k,)
        centre, half : ndarray, shape (k, 2)
            (p, q) and half the extent.
        too_many : ndarray of bool, shape (pixels,)
            More than `MOST_BLOCKS` blocks; these pixels have no starts.
        """
        count = len(radiance)
        pixel, row, column = np.arange(count), np.zeros(count, dtype=np.intp), np.zeros(count, dtype=np.intp)
        too_many = np.zeros(count, dtype=bool)
        found_pixel: list[Index] = []
        found: list[tuple[Array, Array]] = []
        for level in range(len(self._levels) - 1, -1, -1):
            low, high = (table[row, column] for table in self._levels[level])
            wanted, margin = radiance[pixel], reach[pixel]
            may = np.all((low - margin <= wanted) & (wanted <= high + margin), axis=-1)
            done = may & (np.all(high - low <= 2.0 * margin, axis=-1) | (level == 0))
            found_pixel.append(pixel[done])
            found.append(self._extent(row[done], column[done], level))
            split = may & ~done
            pixel, row, column = pixel[split], row[split], column[split]
            crowded = np.bincount(pixel, minlength=count) > MOST_BLOCKS
            too_many |= crowded
            keep = ~crowded[pixel]
            pixel, row, column = np.repeat(pixel[keep], 4), 2 * np.repeat(row[keep], 4), 2 * np.repeat(column[keep], 4)
            row += np.tile((0, 0, 1, 1), len(row) // 4)
            column += np.tile((0, 1, 0, 1), len(column) // 4)
        pixel = np.concatenate(found_pixel)
        centre, half = (np.concatenate(parts) for parts in zip(*found, strict=True))
        keep = ~too_many[pixel]
        return pixel[keep], centre[keep], half[keep], too_many

    def _extent(self, row: Index, column: Index, level: int) -> tuple[Array, Array]:
        """Centre and half extent of blocks, shape (k, 2) each."""
        size = 1 << level
        ends = [
            (axis[np.minimum(k * size, axis.size - 1)], axis[np.minimum((k + 1) * size, axis.size - 1)])
            for axis, k in ((self._p, column), (self._q, row))
        ]
        lower, upper = (np.stack(side, axis=-1) for side in zip(*ends, strict=True))
        return 0.5 * (lower + upper), 0.5 * (upper - lower)
