"""Is twice the exposure twice the signal? The camera's linearity from the brackets of the scan itself.

Everything after this assumes counts in proportion to light. The check compares neighbouring exposures of the same
scene; it does not correct a curve, and it cannot see an error that all exposures share.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gonio.errors import MeasurementError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Linearity:
    """Ratio of the rates [DN/s] seen with neighbouring exposures, 1 for a linear camera.

    Attributes
    ----------
    exposure_s : ndarray, shape (k,)
        [s], ascending.
    ratio, u_ratio : ndarray, shape (k - 1,)
        Rate at exposure j + 1 over rate at exposure j, and its standard uncertainty; NaN where no scene has both.
    scenes : ndarray of int, shape (k - 1,)
        How many scenes have both.
    """

    exposure_s: Array
    ratio: Array
    u_ratio: Array
    scenes: NDArray[np.int64]

    @property
    def deviation(self) -> float:
        """Largest deviation of a ratio from 1, 0 if none was measured."""
        deviations = np.abs(self.ratio[np.isfinite(self.ratio)] - 1.0)
        return float(deviations.max()) if deviations.size else 0.0

    def check(self, limit: float = 0.01, *, coverage: float = 3.0) -> None:
        """Refuse a camera that is not linear.

        Parameters
        ----------
        limit : float
            Largest deviation of a ratio from 1.
        coverage : float
            The excess over `limit` has to exceed this many standard uncertainties, so that noise alone never refuses.

        Raises
        ------
        MeasurementError
            With the two exposures and the ratio.
        """
        for k, (ratio, u) in enumerate(zip(self.ratio, self.u_ratio, strict=True)):
            if np.isfinite(ratio) and abs(ratio - 1.0) > limit + coverage * u:
                raise MeasurementError(
                    f"the camera is not linear: {self.exposure_s[k + 1]:g} s sees {100 * (ratio - 1):+.2f} % "
                    f"(u = {100 * u:.2f} %) more light per second than {self.exposure_s[k]:g} s, the limit is "
                    f"{100 * limit:g} %; switch gamma, automatic exposure and image processing off"
                )


def linearity(exposure_s: ArrayLike, signal: ArrayLike, variance: ArrayLike, usable: ArrayLike) -> Linearity:
    """Ratios of the rates of neighbouring exposures over many scenes.

    Parameters
    ----------
    exposure_s : array_like, shape (k,)
        [s], ascending.
    signal, variance : array_like, shape (n, k)
        Signal above dark of n scenes [DN], and its variance [DN^2].
    usable : array_like of bool, shape (n, k)
        False where saturated or missing.

    Notes
    -----
    The ratio of sums over all scenes, not the mean of ratios: dark scenes then add little noise and no bias.
    """
    t, s, v = np.asarray(exposure_s, dtype=float), np.asarray(signal, dtype=float), np.asarray(variance, dtype=float)
    ok = np.asarray(usable, dtype=bool)
    ratio, u_ratio = np.full(len(t) - 1, np.nan), np.full(len(t) - 1, np.nan)
    scenes = np.zeros(len(t) - 1, dtype=np.int64)
    for k in range(len(t) - 1):
        both = ok[:, k] & ok[:, k + 1]
        scenes[k] = both.sum()
        low, high = s[both, k].sum() / t[k], s[both, k + 1].sum() / t[k + 1]
        u_low = np.sqrt(v[both, k].sum()) / t[k]
        u_high = np.sqrt(v[both, k + 1].sum()) / t[k + 1]
        if scenes[k] and low > 5.0 * u_low:
            ratio[k] = high / low
            u_ratio[k] = ratio[k] * np.hypot(u_low / low, u_high / high)
    return Linearity(t, ratio, u_ratio, scenes)
