r"""Phong's lobe, normalised to be a BRDF.

.. math:: f_r = k_s\,\frac{n+2}{2\pi}\,\max(0, m\cdot\omega_i)^n

with m the mirror image of :math:`\omega_r`. Phong's own law is one of radiance; here, as in [2]_, the cosine of the
incidence stays in the integral, the lobe is reciprocal, and k_s is the directional albedo at normal incidence (elsewhere it
is less: the horizon cuts the lobe).

Near the peak :math:`1 - m\cdot\omega_i` comes from the difference of the two directions, so that sharp lobes keep their
digits.

References
----------
.. [1] B. T. Phong, "Illumination for Computer Generated Pictures", CACM 18(6), 1975.
.. [2] E. P. Lafortune, Y. D. Willems, "Using the Modified Phong Reflectance Model for Physically Based Rendering", Report
   CW 197, K.U. Leuven, 1994.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.brdf.base import Model, Parameter

Array = NDArray[np.float64]
INV_TWO_PI = 0.5 / math.pi
_SMOOTH = 40.0  # from that exponent on, what lies next to m.w = 0 is nothing, even where only the tail is lit


@jit.model
def phong_f_r(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float, p: list[float]) -> float:
    k_s, n = p[0], p[1]
    if not (zi > 0.0 and zr > 0.0):
        return 0.0
    x, y, z = xi + xr, yi + yr, zi - zr  # omega_i - m
    c = 0.5 * (x * x + y * y + z * z)  # 1 - m.w
    if c < 0.5:
        logarithm = math.log1p(-c)
    else:
        along = zi * zr - xi * xr - yi * yr
        if along <= 0.0:
            return 0.0
        logarithm = math.log(along)
    return k_s * (n + 2.0) * INV_TWO_PI * math.exp(n * logarithm)


def _width(p: Array) -> float:
    """Half width at half maximum, by half vector: cos(2 theta_h)^n = 1/2."""
    n = float(p[1])
    return 0.5 * math.acos(2.0 ** (-1.0 / n)) if n > 1.0 else 0.5


def _kinks(p: Array, omega_r: Array) -> Array:
    """The lobe is cut at m.w = 0, with a derivative that jumps where n is small."""
    if p[1] >= _SMOOTH:
        return np.empty((*omega_r.shape[:-1], 0, 4))
    plane = np.stack((-omega_r[..., 0], -omega_r[..., 1], omega_r[..., 2], np.zeros_like(omega_r[..., 2])), axis=-1)
    return plane[..., None, :]


PHONG = Model(
    name="phong",
    parameters=(
        Parameter("k_s", 0.0, 1.0, "directional albedo at normal incidence", ("uniform", 0.0, 1.0)),
        Parameter("n", 0.0, 1e8, "exponent", ("log_normal", math.log(50.0), 2.0)),
    ),
    function=phong_f_r,
    doc="Phong's lobe, k_s (n + 2) / (2 pi) max(0, m.w)^n; the cosine stays in the integral.",
    reference="Phong, CACM 18(6), 1975; Lafortune & Willems, Report CW 197, K.U. Leuven, 1994",
    lobe_width=_width,
    kinks=_kinks,
)
