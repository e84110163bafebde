r"""Bands that hold a whole curve or map, not a value at a time.

A pointwise band of 95 % is left somewhere by far more than 5 % of the draws. The simultaneous one is mean +- c sd at each
point, with the least c for which 95 % of the draws stay inside everywhere (the sup-t band [1]_): c is a quantile of

.. math:: \max_x |f_i(x) - \bar f(x)| / s(x).

Values that cannot be negative are not let below 0. Like any quantile of some hundred draws, c has a sampling error.

References
----------
.. [1] J. L. Montiel Olea, M. Plagborg-Moller, "Simultaneous confidence bands: Theory, implementation, and an application to
   SVARs", Journal of Applied Econometrics 34(1), 2019. doi:10.1002/jae.2656
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
LEVEL = 0.95
_TILE = 4096  # points
_NOISE = 1e-12  # sd below which, relative to the mean, a point does not vary


def band_of_curves(curves: Array, level: float = LEVEL) -> Array:
    """Simultaneous band of draws of a curve of values that are never negative.

    Parameters
    ----------
    curves : ndarray, shape (draws, n)
    level : float
        Share of the draws that lie inside everywhere.

    Returns
    -------
    ndarray, shape (2, n)
        Lower and upper end.
    """
    return band_of_products(np.eye(len(curves)), list(curves), level)


def band_of_products(weights: Array, parts: Sequence[Array], level: float = LEVEL) -> Array:
    """The same of draws that are ``weights`` (draws, k) times ``parts`` (k arrays of one shape), shape (2, ...)."""
    flat = [part.ravel() for part in parts]
    size = flat[0].size
    mean, sd, farthest = np.empty(size), np.empty(size), np.zeros(len(weights))
    for a in range(0, size, _TILE):
        tile = slice(a, a + _TILE)
        values = weights @ np.array([part[tile] for part in flat])
        mean[tile], sd[tile] = values.mean(axis=0), values.std(axis=0)
        varies = sd[tile] > _NOISE * np.abs(mean[tile])
        if varies.any():
            apart = np.abs(values[:, varies] - mean[tile][varies]) / sd[tile][varies]
            farthest = np.maximum(farthest, apart.max(axis=1))
    reach = float(np.quantile(farthest, level)) * sd
    return np.stack((np.maximum(mean - reach, 0.0), mean + reach)).reshape(2, *parts[0].shape)
