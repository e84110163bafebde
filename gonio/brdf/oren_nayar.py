r"""Oren and Nayar's rough diffuse surface: V-grooves of Lambertian facets. The "qualitative" variant of the paper.

.. math::
    f_r = \frac{\rho}{\pi}\bigl(A + B\,\max(0, \cos\Delta\phi)\,\sin\alpha\,\tan\beta\bigr),\quad
    A = 1 - \frac{\sigma^2}{2(\sigma^2 + 0.33)},\quad B = \frac{0.45\,\sigma^2}{\sigma^2 + 0.09},

with alpha the larger and beta the smaller of the two polar angles and :math:`\Delta\phi = \phi_r - \phi_i`: light comes
back towards the lamp. With :math:`s = \omega_i\cdot\omega_r - \mu_i\mu_r` the second term is B max(0, s) / max(mu_i, mu_r),
without angles, and without a special case where an azimuth is undefined.

Reciprocal, but not bounded by energy: near grazing the albedo exceeds rho by up to 1.5 %.

References
----------
.. [1] M. Oren, S. K. Nayar, "Generalization of Lambert's Reflectance Model", SIGGRAPH 1994, the
   simplified ("qualitative") model.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.brdf.base import Model, Parameter

Array = NDArray[np.float64]
INV_PI = 1.0 / math.pi


@jit.model
def qualitative_f_r(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float, p: list[float]) -> float:
    albedo, s2 = p[0], p[1] * p[1]
    lit = zi > 0.0 and zr > 0.0
    a = 1.0 - 0.5 * s2 / (s2 + 0.33)
    b = 0.45 * s2 / (s2 + 0.09)
    s = max(0.0, xi * xr + yi * yr)  # sin theta_i sin theta_r cos dphi
    largest = max(zi, zr) if lit else 1.0
    return albedo * INV_PI * (a + b * s / largest) if lit else 0.0


def _kinks(p: Array, omega_r: Array) -> Array:
    """Where alpha and beta change places, theta_i = theta_r, and where cos dphi changes sign."""
    if p[1] == 0.0:  # Lambert
        return np.empty((*omega_r.shape[:-1], 0, 4))
    across = np.hypot(omega_r[..., 0], omega_r[..., 1])
    slanted = across > 0.0  # seen from straight above, s = 0
    planes = np.zeros((*across.shape, 2, 4))
    planes[..., 0, 2], planes[..., 0, 3] = 1.0, np.where(slanted, omega_r[..., 2], 2.0)
    planes[..., 1, 0] = np.divide(omega_r[..., 0], across, out=np.ones_like(across), where=slanted)
    planes[..., 1, 1] = np.divide(omega_r[..., 1], across, out=np.zeros_like(across), where=slanted)
    planes[..., 1, 3] = np.where(slanted, 0.0, 2.0)
    return planes


OREN_NAYAR = Model(
    name="oren_nayar",
    parameters=(
        Parameter("albedo", 0.0, 1.0, "albedo of the facets", ("uniform", 0.0, 1.0)),
        Parameter("sigma", 0.0, math.pi / 2, "standard deviation of the facets' slope angle", ("uniform", 0.0, 0.9), "rad"),
    ),
    function=qualitative_f_r,
    doc='Rough diffuse surface of V-grooves, the paper\'s "qualitative" formula.',
    reference="Oren & Nayar, SIGGRAPH 1994",
    kinks=_kinks,
    energy_bounded=False,
)
