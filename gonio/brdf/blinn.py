r"""Lobes of a power of the half vector's cosine: Blinn's highlight, normalised, and Ashikhmin and Shirley's coated diffuser.

Blinn and Phong's lobe, with k_s the directional albedo at normal incidence:

.. math:: f_r = k_s\,\frac{(n+2)(n+4)}{8\pi\,(2^{-n/2}+n)}\,\mu_h^n .

Ashikhmin and Shirley's, of equal exponents along x and y, with Schlick's Fresnel term F and c = :math:`\omega_i\cdot h`:

.. math:: f_r = \frac{28\,R_d}{23\pi}\,(1-R_s)\Bigl(1-\bigl(1-\tfrac{\mu_i}{2}\bigr)^5\Bigr)
                                            \Bigl(1-\bigl(1-\tfrac{\mu_r}{2}\bigr)^5\Bigr)
                + \frac{n+1}{8\pi}\,\frac{\mu_h^n\,F(c)}{c\,\max(\mu_i,\mu_r)},\quad F = R_s + (1-R_s)(1-c)^5 .

:math:`\mu_h^n = (1+\tan^2\theta_h)^{-n/2}` with the tangent from the two directions' sum, and
:math:`1-c = \sin^2\theta_d/(1+c)` from their difference, so nothing cancels.

References
----------
.. [1] J. F. Blinn, "Models of light reflection for computer synthesized pictures", SIGGRAPH 1977.
.. [2] T. Akenine-Moller, E. Haines, N. Hoffman, "Real-Time Rendering", 3rd ed., 2008, section 7.6, on the normalisation;
   the integral is checked in the tests.
.. [3] M. Ashikhmin, P. Shirley, "An Anisotropic Phong BRDF Model", J. Graphics Tools 5(2), 2000.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.brdf.base import Model
from gonio.brdf.elementary import exp, log1p
from gonio.brdf.parameter import Parameter
from gonio.brdf.phong import power_width

Array = NDArray[np.float64]
INV_8_PI = 0.125 / math.pi
_HALF_LN2 = 0.5 * math.log(2.0)
_DIFFUSE = 28.0 / (23.0 * math.pi)


@jit.model
def cosine_power(s2: float, z: float, n: float) -> float:
    """mu_h^n, from the squared tangential and the normal component of omega_i + omega_r."""
    value: float = exp(-0.5 * n * log1p(s2 / (z * z)))
    return value


@jit.model
def blinn_phong_f_r(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float, p: list[float]) -> float:
    k_s, n = p[0], p[1]
    lit = (zi > 0.0) & (zr > 0.0)
    x, y, z = xi + xr, yi + yr, zi + zr if lit else 1.0
    norm = INV_8_PI * (n + 2.0) * (n + 4.0) / (exp(-_HALF_LN2 * n) + n)
    value = k_s * norm * cosine_power(x * x + y * y, z, n)
    return value if lit else 0.0


@jit.model
def ashikhmin_shirley_f_r(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float, p: list[float]) -> float:
    r_d, r_s, n = p[0], p[1], p[2]
    lit = (zi > 0.0) & (zr > 0.0)
    mu_i = zi if lit else 1.0
    mu_r = zr if lit else 1.0
    x, y, z = xi + xr, yi + yr, mu_i + mu_r
    s2 = x * x + y * y
    c = 0.5 * math.sqrt(s2 + z * z)
    u, v, w = xi - xr, yi - yr, mu_i - mu_r
    less = 0.25 * (u * u + v * v + w * w) / (1.0 + c)  # 1 - c
    fresnel = r_s + (1.0 - r_s) * less * less * less * less * less
    larger = mu_i if mu_i > mu_r else mu_r
    gloss = INV_8_PI * (n + 1.0) * cosine_power(s2, z, n) * fresnel / (c * larger)
    # 1 - q^5 = (1 - q) (1 + q + q^2 + q^3 + q^4) with q = 1 - mu / 2
    q_i, q_r = 1.0 - 0.5 * mu_i, 1.0 - 0.5 * mu_r
    t_i = 0.5 * mu_i * (1.0 + q_i * (1.0 + q_i * (1.0 + q_i * (1.0 + q_i))))
    t_r = 0.5 * mu_r * (1.0 + q_r * (1.0 + q_r * (1.0 + q_r * (1.0 + q_r))))
    value = _DIFFUSE * r_d * (1.0 - r_s) * (t_i * t_r) + gloss
    return value if lit else 0.0


def _width(p: Array) -> float:
    return power_width(float(p[1]))


def _ashikhmin_width(p: Array) -> float:
    return power_width(float(p[2]))


def _kinks(p: Array, omega_r: Array) -> Array:
    """The larger of the two cosines changes at theta_i = theta_r."""
    planes = np.zeros((*omega_r.shape[:-1], 1, 4))
    planes[..., 0, 2], planes[..., 0, 3] = 1.0, omega_r[..., 2]
    return planes


_N = Parameter("n", 0.0, 1e8, "exponent of the half vector's cosine", ("log_normal", math.log(100.0), 2.0))

BLINN_PHONG = Model(
    name="blinn_phong",
    parameters=(Parameter("k_s", 0.0, 1.0, "directional albedo at normal incidence", ("uniform", 0.0, 1.0)), _N),
    function=blinn_phong_f_r,
    factors=("k_s",),
    doc="Blinn and Phong's lobe: a power of the half vector's cosine, normalised exactly at normal incidence.",
    reference="Blinn, SIGGRAPH 1977; Akenine-Moller, Haines & Hoffman, Real-Time Rendering, 2008",
    lobe_width=_width,
)
ASHIKHMIN_SHIRLEY = Model(
    name="ashikhmin_shirley",
    parameters=(
        Parameter("R_d", 0.0, 1.0, "reflectance of the diffuse base", ("uniform", 0.0, 1.0)),
        Parameter("R_s", 0.0, 1.0, "specular reflectance at normal incidence", ("uniform", 0.0, 1.0)),
        _N,
    ),
    function=ashikhmin_shirley_f_r,
    affine=("R_d", "R_s"),
    doc="Ashikhmin and Shirley's glossy coat over a diffuse base, isotropic.",
    reference="Ashikhmin & Shirley, J. Graphics Tools 5(2), 2000",
    lobe_width=_ashikhmin_width,
    kinks=_kinks,
)
