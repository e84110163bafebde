r"""Oren and Nayar's rough diffuse surface: V-grooves of Lambertian facets, by both formulas of the paper.

With alpha the larger and beta the smaller of the two polar angles and :math:`\Delta\phi = \phi_r - \phi_i`, so that light
comes back towards the lamp, the ``qualitative`` one is

.. math::
    f_r = \frac{\rho}{\pi}\bigl(A + B\,\max(0, \cos\Delta\phi)\,\sin\alpha\,\tan\beta\bigr),\quad
    A = 1 - \frac{\sigma^2}{2(\sigma^2 + 0.33)},\quad B = \frac{0.45\,\sigma^2}{\sigma^2 + 0.09},

and the ``full`` one, with light that meets two facets,

.. math::
    f_r = \frac{\rho}{\pi}\Bigl(A + \cos\Delta\phi\,C_2\tan\beta
          + (1-|\cos\Delta\phi|)\,C_3\tan\frac{\alpha+\beta}{2}\Bigr)
          + 0.17\,\frac{\rho^2}{\pi}\,\frac{\sigma^2}{\sigma^2+0.13}
          \Bigl(1 - \cos\Delta\phi\,\frac{4\beta^2}{\pi^2}\Bigr), \\
    C_2 = B\,\bigl(\sin\alpha - [\cos\Delta\phi < 0]\,(2\beta/\pi)^3\bigr), \quad
    C_3 = \frac{0.125\,\sigma^2}{\sigma^2+0.09}\Bigl(\frac{4\alpha\beta}{\pi^2}\Bigr)^2 .

With :math:`s = \omega_i\cdot\omega_r - \mu_i\mu_r` the term in sin alpha tan beta is s / max(mu_i, mu_r), without angles,
and without a special case where an azimuth is undefined; the angles that are left are counted from the horizon.

Both are reciprocal, but not bounded by energy: near grazing the qualitative one's albedo exceeds rho by up to 1.5 %. Above
sigma = 0.66 the full formula, a fit, is negative near grazing mirror directions where rho is small; it counts as 0 there.

References
----------
.. [1] M. Oren, S. K. Nayar, "Generalization of Lambert's Reflectance Model", SIGGRAPH 1994. doi:10.1145/192161.192213
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.brdf.arctangent import arctan
from gonio.brdf.base import Model
from gonio.brdf.parameter import Parameter

Array = NDArray[np.float64]
INV_PI = 1.0 / math.pi
TWO_OVER_PI = 2.0 / math.pi


@jit.model
def qualitative_f_r(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float, p: list[float]) -> float:
    albedo, s2 = p[0], p[1] * p[1]
    lit = (zi > 0.0) & (zr > 0.0)
    mu_i = zi if lit else 1.0
    mu_r = zr if lit else 1.0
    a = 1.0 - 0.5 * s2 / (s2 + 0.33)
    b = 0.45 * s2 / (s2 + 0.09)
    s = xi * xr + yi * yr  # sin theta_i sin theta_r cos dphi
    s = s if s > 0.0 else 0.0
    largest = mu_i if mu_i > mu_r else mu_r
    value = albedo * INV_PI * (a + b * s / largest)
    return value if lit else 0.0


@jit.model
def full_f_r(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float, p: list[float]) -> float:
    albedo, s2 = p[0], p[1] * p[1]
    lit = (zi > 0.0) & (zr > 0.0)
    mu_i = zi if lit else 1.0
    mu_r = zr if lit else 1.0
    s_i, s_r = math.sqrt(xi * xi + yi * yi), math.sqrt(xr * xr + yr * yr)
    steep = (mu_i > mu_r) | ((mu_i == mu_r) & (s_i < s_r))  # omega_i is the one at beta
    mu_a, s_a = (mu_r if steep else mu_i), (s_r if steep else s_i)
    mu_b, s_b = (mu_i if steep else mu_r), (s_i if steep else s_r)
    up_b = TWO_OVER_PI * arctan(mu_b, s_b)  # 1 - 2 beta / pi
    a, b = 1.0 - TWO_OVER_PI * arctan(mu_a, s_a), 1.0 - up_b  # 2 alpha / pi, 2 beta / pi

    s = xi * xr + yi * yr
    across = xi * yr - yi * xr
    sines = s_i * s_r
    sines = sines if sines > 0.0 else 1.0  # then s = across = 0: where an azimuth is undefined, nothing depends on it
    cosine = s / sines
    off = across * across / (sines * (sines + abs(s)))  # 1 - |cos dphi|
    # sin alpha - (2 beta / pi)^3, whose parts both come near 1
    less = up_b * (1.0 + b + b * b) - mu_a * mu_a / (1.0 + s_a)
    shaded = less / (s_a if s_a > 0.0 else 1.0)
    c_1 = 1.0 - 0.5 * s2 / (s2 + 0.33)
    c_2 = 0.45 * s2 / (s2 + 0.09) * (1.0 if s >= 0.0 else shaded)
    c_3 = 0.125 * s2 / (s2 + 0.09) * (a * b) * (a * b)
    once = c_1 + c_2 * s / mu_b + c_3 * off * (s_i + s_r) / (mu_i + mu_r)  # the last factor: tan((alpha + beta) / 2)
    twice = 0.17 * albedo * s2 / (s2 + 0.13) * (1.0 - cosine * b * b)
    total = once + twice
    return albedo * INV_PI * (total if total > 0.0 else 0.0) if lit else 0.0


def kinks(p: Array, omega_r: Array) -> Array:
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


def _model(variant: str, function: Callable[..., float], doc: str) -> Model:
    return Model(
        name="oren_nayar",
        parameters=(
            Parameter("albedo", 0.0, 1.0, "albedo of the facets", ("uniform", 0.0, 1.0)),
            Parameter(
                "sigma", 0.0, math.pi / 2, "standard deviation of the facets' slope angle", ("uniform", 0.0, 0.9), "rad"
            ),
        ),
        function=function,
        doc=f"Rough diffuse surface of V-grooves, {doc}.",
        reference="Oren & Nayar, SIGGRAPH 1994",
        kinks=kinks,
        energy_bounded=False,
        factors=("albedo",) if variant == "qualitative" else (),
        choices={} if variant == "qualitative" else {"variant": variant},
    )


OREN_NAYAR = _model("qualitative", qualitative_f_r, 'the paper\'s "qualitative" formula')
OREN_NAYAR_FULL = _model("full", full_f_r, "the paper's full formula, with light that meets two facets")
