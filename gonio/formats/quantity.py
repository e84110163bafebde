"""What a number in a file means, and how it becomes a BRDF.

===========  ==========================================  ==================
``brdf``     f_r, as Nicodemus defines it                1/sr
``brf``      bidirectional reflectance factor, pi f_r    1
``brdf_cos`` cosine-corrected BRDF, f_r cos(theta_r)     1/sr
===========  ==========================================  ==================

References
----------
.. [1] F. E. Nicodemus et al., NBS Monograph 160, 1977. doi:10.6028/NBS.MONO.160
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gonio.errors import ConfigurationError

Array = NDArray[np.float64]
QUANTITIES = {
    "brdf": "bidirectional reflectance distribution function f_r = dL_r / dE_i [1/sr]",
    "brf": "bidirectional reflectance factor pi f_r [1]",
    "brdf_cos": "cosine-corrected BRDF f_r cos(theta_r) [1/sr]",
}
SHORT = {"brdf": "f_r in 1/sr", "brf": "pi f_r, without a unit", "brdf_cos": "f_r cos(theta_r) in 1/sr"}


def check(quantity: str) -> str:
    """The quantity, or a `ConfigurationError` with those that are known."""
    if quantity not in QUANTITIES:
        raise ConfigurationError(f"there is no quantity {quantity!r}; known are: {', '.join(QUANTITIES)}")
    return quantity


def factor_to_brdf(quantity: str, theta_r: Array) -> Array:
    """Factor [1 or 1/sr] that turns values of a quantity into f_r [1/sr]; theta_r in radians, below pi/2."""
    check(quantity)
    if quantity == "brf":
        return np.full(theta_r.shape, 1.0 / np.pi)
    if quantity == "brdf_cos":
        return np.asarray(1.0 / np.cos(theta_r))
    return np.ones(theta_r.shape)
