r"""Microfacet models: rough mirrors made of small facets.

.. math:: f_r = k_s \frac{F(\omega_r\cdot h)\,D(h)\,G}{4\cos\theta_i\cos\theta_r}

Written without the half vector's normalisation: with :math:`|\omega_i+\omega_r|^2 = 2+2\cos g`,
:math:`\cos^2\theta_h = (\mu_i+\mu_r)^2/(2+2\cos g)` and :math:`\sin^2\theta_h` from the tangential components, so nothing
cancels near h = n.

References
----------
.. [1] B. Walter, S. R. Marschner, H. Li, K. E. Torrance, "Microfacet Models for Refraction through Rough Surfaces", EGSR
   2007, eqs. 33, 34 (GGX: D and its Smith Lambda).
.. [2] E. Heitz, "Understanding the Masking-Shadowing Function in Microfacet-Based BRDFs", JCGT 3(2), 2014, eqs. 72, 99
   (GGX Lambda, height-correlated G).
.. [3] T. S. Trowbridge, K. P. Reitz, "Average irregularity representation of a rough surface for ray reflection", JOSA
   65(5), 1975.
.. [4] C. Schlick, "An Inexpensive BRDF Model for Physically-based Rendering", CGF 13(3), 1994.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.brdf.base import Model, Parameter

INV_PI = 1.0 / math.pi


@jit.model
def ggx_f_r(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float, p: list[float]) -> float:
    k_s, alpha, f_0 = p[0], p[1], p[2]
    lit = (zi > 0.0) & (zr > 0.0)  # no branch: the loop vectorises
    mu_i = zi if lit else 1.0
    mu_r = zr if lit else 1.0
    a2 = alpha * alpha
    x, y, z = xi + xr, yi + yr, mu_i + mu_r
    s2 = x * x + y * y  # |wi + wr|^2 sin^2 theta_h
    l2 = s2 + z * z  # |wi + wr|^2 = 2 + 2 cos g
    t = a2 * z * z + s2
    d = a2 * INV_PI * l2 * l2 / (t * t)  # D(h) = a^2 / (pi (a^2 cos^2 theta_h + sin^2 theta_h)^2)
    # G / (4 mu_i mu_r), height-correlated Smith
    si2, sr2 = xi * xi + yi * yi, xr * xr + yr * yr
    g = 0.5 / (mu_r * math.sqrt(mu_i * mu_i + a2 * si2) + mu_i * math.sqrt(mu_r * mu_r + a2 * sr2))
    c = 1.0 - 0.5 * math.sqrt(l2)  # 1 - h.v, as h.v = |wi + wr| / 2
    c = c if c > 0.0 else 0.0
    c2 = c * c
    f = f_0 + (1.0 - f_0) * c2 * c2 * c
    return k_s * f * d * g if lit else 0.0


def _width(p: NDArray[np.float64]) -> float:
    return float(p[1])


GGX = Model(
    name="ggx",
    parameters=(
        Parameter("k_s", 0.0, 1.0, "specular weight", ("uniform", 0.0, 1.0), fixed=1.0),
        Parameter("alpha", 1e-4, 1.0, "roughness, used as it is (not squared)", ("log_normal", math.log(0.2), 0.9)),
        Parameter("f_0", 0.0, 1.0, "Schlick's reflectance at normal incidence", ("uniform", 0.0, 1.0)),
    ),
    function=ggx_f_r,
    doc="GGX (Trowbridge-Reitz) facets, height-correlated Smith shadowing, Schlick's Fresnel term in h.v.",
    reference="Walter et al., EGSR 2007; Heitz, JCGT 3(2), 2014; Schlick, CGF 13(3), 1994",
    lobe_width=_width,
)
