"""The white reference: what the rig would read on it at any time of the scan, and how well that is known.

The white is measured in blocks of a few brackets. A reading is divided by cos theta_i, so that blocks and samples may
be lit at different angles. Between two blocks the lamp is taken to drift linearly in rig time; how far it may have
strayed from that line is a shared error, u = |change| / sqrt(12): rectangular, of half-width |change| / 2 (JCGM
100:2008, 4.3.7).

It knows no certificate: the white's radiance factor enters in `gonio.radiometry`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gonio.errors import MeasurementError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class WhiteBlock:
    """Repeated readings of the white at one time.

    Attributes
    ----------
    time_s : float
        Rig time of the middle [s].
    value : float
        Rate over cos theta_i, mean of the repeats [DN/s].
    u : float
        Its standard uncertainty [DN/s].
    repeats : int
    chi2_per_dof : float
        Scatter of the repeats against their noise; NaN for one repeat.
    """

    time_s: float
    value: float
    u: float
    repeats: int
    chi2_per_dof: float


def white_block(time_s: ArrayLike, value: ArrayLike, u: ArrayLike) -> WhiteBlock:
    """Combine the repeats of a block.

    Parameters
    ----------
    time_s, value, u : array_like, shape (n,)
        Rig time [s], rate over cos theta_i [DN/s] and its standard uncertainty [DN/s] of each repeat.

    Raises
    ------
    MeasurementError
        If there is no repeat, or the white reads no light.

    Notes
    -----
    If the repeats scatter more than their noise, the uncertainty grows by the square root of chi^2 per degree of
    freedom (Birge ratio); it never shrinks.
    """
    t, x, s = (np.atleast_1d(np.asarray(a, dtype=float)) for a in (time_s, value, u))
    if len(x) == 0:
        raise MeasurementError("a white block holds no usable reading: all exposures are saturated; shorten them")
    mean, sigma = float(x.mean()), float(np.sqrt(np.sum(s**2)) / len(s))
    if not mean > 5.0 * sigma:
        raise MeasurementError(
            f"the white reads {mean:.4g} DN/s (u = {sigma:.4g} DN/s), which is no light: check the lamp and the white"
        )
    chi2 = float(np.sum(((x - mean) / s) ** 2) / (len(x) - 1)) if len(x) > 1 else float("nan")
    birge = np.sqrt(max(1.0, chi2)) if len(x) > 1 else 1.0
    return WhiteBlock(float(t.mean()), mean, float(sigma * birge), len(x), chi2)


@dataclass(frozen=True)
class Reference:
    """White blocks of a scan.

    Attributes
    ----------
    blocks : tuple of WhiteBlock
        In order of time.
    """

    blocks: tuple[WhiteBlock, ...]

    @classmethod
    def of(cls, blocks: Sequence[WhiteBlock]) -> Reference:
        """Sort the blocks.

        Raises
        ------
        MeasurementError
            If there is none.
        """
        if not blocks:
            raise MeasurementError("the run holds no white reference: measure at least one white block")
        return cls(tuple(sorted(blocks, key=lambda b: b.time_s)))

    def at(self, time_s: ArrayLike) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
        """The white's reading over cos theta_i at given times.

        Parameters
        ----------
        time_s : array_like, shape (n,)
            Rig time [s].

        Returns
        -------
        value, u : ndarray, shape (n,)
            [DN/s]; u is from the blocks' noise alone.
        bow : ndarray, shape (n,)
            Relative departure from the line, if the lamp strays by the whole change between the blocks:
            4 a (1 - a) (change / value) with a the fraction of the interval that has passed. 0 at every block, and
            where the change is within the noise (twice its uncertainty).
        bracketed : ndarray of bool, shape (n,)
            False before the first and after the last block: that block is then held.
        """
        times = np.asarray(time_s, dtype=float)
        t = np.array([b.time_s for b in self.blocks])
        y = np.array([b.value for b in self.blocks])
        s = np.array([b.u for b in self.blocks])
        bracketed = (times >= t[0]) & (times <= t[-1])
        if len(t) == 1:
            return np.full(times.shape, y[0]), np.full(times.shape, s[0]), np.zeros(times.shape), bracketed
        left = np.clip(np.searchsorted(t, times, side="right") - 1, 0, len(t) - 2)
        length = t[left + 1] - t[left]
        a = np.clip((times - t[left]) / np.where(length > 0.0, length, 1.0), 0.0, 1.0)
        value = (1.0 - a) * y[left] + a * y[left + 1]
        change = y[left + 1] - y[left]
        significant = np.abs(change) > 2.0 * np.hypot(s[left], s[left + 1])
        bow = np.where(significant, 4.0 * a * (1.0 - a) * change / value, 0.0)
        return value, np.hypot((1.0 - a) * s[left], a * s[left + 1]), bow, bracketed

    @property
    def drift(self) -> float:
        """Largest relative change between neighbouring blocks, signed; 0 if there is one block only."""
        pairs = zip(self.blocks, self.blocks[1:], strict=False)
        return max((2.0 * (b.value - a.value) / (a.value + b.value) for a, b in pairs), key=abs, default=0.0)
