r"""Minnaert's law of the lunar surface: Lambert's with one exponent for limb darkening.

.. math:: f_r = \frac{\rho}{\pi}\,(\mu_i\,\mu_r)^{k-1}

k = 1 is Lambert's surface; dark soils near opposition show k of 0.5 to 0.7. The albedo is a coefficient: the
directional albedo, :math:`2\rho\,\mu_r^{k-1}/(k+1)`, has no bound for k < 1, where f_r itself is infinite at the horizon.

References
----------
.. [1] M. Minnaert, "The Reciprocity Principle in Lunar Photometry", Astrophysical Journal 93, 1941. doi:10.1086/144279
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.brdf.base import Model
from gonio.brdf.elementary import power
from gonio.brdf.parameter import Parameter

Array = NDArray[np.float64]
INV_PI = 1.0 / math.pi
_LEAST = 1e-300  # of the product of the cosines: f_r stays finite


@jit.model
def minnaert_f_r(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float, p: list[float]) -> float:
    albedo, k = p[0], p[1]
    lit = (zi > 0.0) & (zr > 0.0)
    product = zi * zr if lit else 1.0
    product = product if product > _LEAST else _LEAST
    return albedo * INV_PI * power(product, k - 1.0) if lit else 0.0


def _width(p: Array) -> float:
    """No lobe; but mu_i^k has no derivatives at the horizon, which lobes have layers at too."""
    return 1.0


def _layer(p: Array) -> float:
    """Below it, mu_i^k is nothing; with k = 0, 1 or 2 it is a polynomial."""
    return 1.0 if p[1] in (0.0, 1.0, 2.0) else 1e-8


MINNAERT = Model(
    name="minnaert",
    parameters=(
        Parameter("albedo", 0.0, 1.0, "pi f_r at normal incidence, seen from the normal", ("uniform", 0.0, 1.0)),
        Parameter("k", 0.0, 2.0, "limb darkening; 1 is Lambert's surface", ("uniform", 0.0, 2.0)),
    ),
    function=minnaert_f_r,
    factors=("albedo",),
    doc="albedo / pi (cos theta_i cos theta_r)^(k - 1); infinite at the horizon for k < 1.",
    reference="Minnaert, Astrophysical Journal 93, 1941",
    lobe_width=_width,
    layer_width=_layer,
    energy_bounded=False,
)
