r"""Phong's lobe, normalised to be a BRDF, and its widening by Lafortune.

.. math:: f_r = k_s\,\frac{n+2}{2\pi}\,\max(0, m\cdot\omega_i)^n

with m the mirror image of :math:`\omega_r`. Phong's own law is one of radiance; here, after Lafortune and Willems [2]_,
the cosine of the incidence stays in the integral, the lobe is reciprocal, and k_s is the directional albedo at normal
incidence (elsewhere it is less: the horizon cuts the lobe). Lafortune's lobe [3]_ weighs the tangential and the normal part
of the product apart,

.. math:: f_r = k_s\,\frac{n+2}{2\pi}\,\max\Bigl(0,
          \frac{C_{xy}\,(x_i x_r + y_i y_r) + C_z\,\mu_i\mu_r}{\max(|C_{xy}|, C_z)}\Bigr)^n .

:math:`C_{xy} = -C_z` is Phong's; :math:`|C_{xy}| > C_z` leans the lobe away from the normal, :math:`C_{xy} > 0` sends it
back to the lamp. Only the ratio of the two counts; :math:`C_{xy} = C_z = 0` is no lobe, and f_r is 0. The base of the
power is the cosine from the lobe's axis times a factor of at most 1, so the lobe reflects no more than Phong's about that
axis.

Near the peak, 1 less the base of the power is summed from positive terms, such as squares of differences of the two
directions, so that sharp lobes keep their digits.

References
----------
.. [1] B. T. Phong, "Illumination for Computer Generated Pictures", CACM 18(6), 1975.
.. [2] E. P. Lafortune, Y. D. Willems, "Using the Modified Phong Reflectance Model for Physically Based Rendering", Report
   CW 197, K.U. Leuven, 1994.
.. [3] E. P. F. Lafortune, S.-C. Foo, K. E. Torrance, D. P. Greenberg, "Non-Linear Approximation of Reflectance Functions",
   SIGGRAPH 1997.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.brdf.base import Model
from gonio.brdf.elementary import exp, log_near, two_products
from gonio.brdf.parameter import Parameter

Array = NDArray[np.float64]
INV_TWO_PI = 0.5 / math.pi
_FAINT = 40.0  # from that exponent on, what lies next to the cut is nothing against the lobe
_BROKEN = 8.0  # and a broken power is as good as a polynomial


def power_width(n: float) -> float:
    """Angle [rad] at which the n-th power of a cosine is 1/2; 1 for n <= 1, a cosine being no lobe."""
    return math.acos(2.0 ** (-1.0 / n)) if n > 1.0 else 1.0


@jit.model
def phong_f_r(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float, p: list[float]) -> float:
    k_s, n = p[0], p[1]
    x, y, z = xi + xr, yi + yr, zi - zr  # omega_i - m
    less = 0.5 * (x * x + y * y + z * z)  # 1 - m.w
    along = 1.0 - less if less < 0.5 else zi * zr - two_products(xi, xr, yi, yr)
    lit = (zi > 0.0) & (zr > 0.0) & (along > 0.0)
    value = k_s * (n + 2.0) * INV_TWO_PI * exp(n * log_near(along if lit else 1.0, -less))
    return value if lit else 0.0


def _width(p: Array) -> float:
    """Half width at half maximum, by half vector: cos(2 theta_h)^n = 1/2."""
    return 0.5 * power_width(float(p[1]))


def _kinks(p: Array, omega_r: Array) -> Array:
    """The lobe is cut at m.w = 0."""
    plane = np.stack((-omega_r[..., 0], -omega_r[..., 1], omega_r[..., 2], np.zeros_like(omega_r[..., 2])), axis=-1)
    return plane[..., None, :]


def cut_power(n: float) -> float:
    """The power with which a lobe begins at its cut, unless it is whole or so high that it is smooth."""
    return n if n < _BROKEN and n != math.floor(n) else math.inf


def _kink_power(p: Array) -> float:
    return cut_power(float(p[1]))


def _faint_kinks(p: Array) -> bool:
    return bool(p[1] >= _FAINT)


_N = Parameter("n", 0.0, 1e8, "exponent", ("log_normal", math.log(50.0), 2.0))

PHONG = Model(
    name="phong",
    parameters=(Parameter("k_s", 0.0, 1.0, "directional albedo at normal incidence", ("uniform", 0.0, 1.0)), _N),
    function=phong_f_r,
    factors=("k_s",),
    doc="Phong's lobe, k_s (n + 2) / (2 pi) max(0, m.w)^n; the cosine stays in the integral.",
    reference="Phong, CACM 18(6), 1975; Lafortune & Willems, Report CW 197, K.U. Leuven, 1994",
    lobe_width=_width,
    kinks=_kinks,
    kink_power=_kink_power,
    faint_kinks=_faint_kinks,
    shadowed=False,
)


@jit.model
def lafortune_f_r(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float, p: list[float]) -> float:
    k_s, c_xy, c_z, n = p[0], p[1], p[2], p[3]
    sign = 1.0 if c_xy > 0.0 else -1.0
    r_xy = sign * c_xy
    largest = r_xy if r_xy > c_z else c_z
    largest = largest if largest > 0.0 else 1.0
    r_xy, r_z = r_xy / largest, c_z / largest
    both = r_xy if r_xy < r_z else r_z
    x, y, z = xi - sign * xr, yi - sign * yr, zi - zr
    d2, z2 = x * x + y * y, z * z
    # 1 - (sign * (x x + y y) + z z), 1 - sign * (x x + y y) and 1 - z z of the two unit vectors
    less = 0.5 * (d2 + z2)
    less_xy = 0.5 * (d2 + (zi * zi + zr * zr))
    less_z = 0.5 * (z2 + ((xi * xi + yi * yi) + (xr * xr + yr * yr)))
    less = both * less + (r_xy - both) * less_xy + (r_z - both) * less_z
    along = 1.0 - less if less < 0.5 else (c_xy * two_products(xi, xr, yi, yr) + c_z * (zi * zr)) / largest
    lit = (zi > 0.0) & (zr > 0.0) & (along > 0.0) & (r_xy + r_z > 0.0)
    value = k_s * (n + 2.0) * INV_TWO_PI * exp(n * log_near(along if lit else 1.0, -less))
    return value if lit else 0.0


def _mirrors(p: Array) -> bool:
    """Whether the lobe is around the mirror direction, where the integrator looks for one."""
    return bool(p[1] == -p[2])


def _lafortune_width(p: Array) -> float:
    return 0.5 * power_width(float(p[3])) if _mirrors(p) else 1.0


def _axis(p: Array, omega_r: Array) -> Array:
    """Direction of the lobe: the base of the power is its product with omega_i; shape as omega_r."""
    axis = omega_r * np.array([p[1], p[1], p[2]])
    length = np.linalg.norm(axis, axis=-1, keepdims=True)
    return np.asarray(np.divide(axis, length, out=np.zeros_like(axis), where=length > 0.0))


def _lafortune_kinks(p: Array, omega_r: Array) -> Array:
    axis = _axis(p, omega_r)
    out_of_reach = np.where(np.any(axis != 0.0, axis=-1), 0.0, 2.0)
    return np.concatenate((axis, out_of_reach[..., None]), axis=-1)[..., None, :]


def _lafortune_kink_power(p: Array) -> float:
    return cut_power(float(p[3]))


def _lafortune_faint_kinks(p: Array) -> bool:
    return bool(p[3] >= _FAINT)


def _lafortune_features(p: Array, omega_r: Array) -> Array:
    if _mirrors(p) or p[3] <= 1.0:
        return np.empty((0, 4))
    return np.array([[*_axis(p, omega_r), power_width(float(p[3]))]])


LAFORTUNE = Model(
    name="lafortune",
    parameters=(
        Parameter("k_s", 0.0, 1.0, "weight; the albedo at normal incidence if C_z >= |C_xy|", ("uniform", 0.0, 1.0)),
        Parameter("C_xy", -10.0, 10.0, "weight of the tangential product; > 0 reflects back", ("uniform", -1.0, 1.0)),
        Parameter("C_z", 0.0, 10.0, "weight of the normal product", ("uniform", 0.0, 1.0), fixed=1.0),
        _N,
    ),
    function=lafortune_f_r,
    factors=("k_s",),
    doc="Lafortune's lobe: Phong's, off the mirror direction or back to the lamp.",
    reference="Lafortune, Foo, Torrance & Greenberg, SIGGRAPH 1997",
    lobe_width=_lafortune_width,
    kinks=_lafortune_kinks,
    kink_power=_lafortune_kink_power,
    faint_kinks=_lafortune_faint_kinks,
    features=_lafortune_features,
)
