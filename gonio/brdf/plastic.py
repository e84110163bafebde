r"""A diffuse base below a smooth dielectric surface, as in plastics and varnished paint: what comes out of it again.

.. math:: f_r = \frac{\rho}{\pi}\,\frac{(1-F(\mu_i))\,(1-F(\mu_r))}{n^2\,(1-\rho\,\bar F_{int})}

F is Fresnel's reflectance for unpolarised light. The base, of albedo rho, scatters as Lambert's; of what comes from below,
the surface throws back the share :math:`\bar F_{int}`, which meets the base again, and so on. The gloss is not in it: add
``specular`` or a microfacet model. With rho = 1 gloss and base together lose nothing: the directional albedo is
:math:`1 - F(\mu_r)`.

1 - F comes from Fresnel's amplitudes multiplied out, and where F nears 1 from the transmittances; and
:math:`n^2(1-\bar F_{int}) = 1-\bar F_{ext}` from the integral of F outside, exactly: with :math:`m^2 = n^2 - 1`,
:math:`\mu = m\sinh t` and :math:`\sqrt{m^2 + \mu^2} = m\cosh t` it has no root, and n = 1 no special case.

References
----------
.. [1] L. B. Wolff, "Diffuse-reflectance model for smooth dielectric surfaces", JOSA A 11(11), 1994.
   doi:10.1364/JOSAA.11.002956
.. [2] S. Q. Duntley, "The Optical Properties of Diffusing Materials", JOSA 32(2), 1942, on the reflectances of a surface
   for diffuse light. doi:10.1364/JOSA.32.000061
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.brdf.base import Model
from gonio.brdf.parameter import Parameter

Array = NDArray[np.float64]
INV_PI = 1.0 / math.pi
_NODES = 40  # to a panel
_DEEPEST = 20.0  # of t, where e^-2t is nothing


def diffuse_reflectance(n: float) -> float:
    """Fresnel reflectance of a surface of refractive index n >= 1 for diffuse light from outside, to 1e-15."""
    return _diffuse(n)[0]


def _diffuse(n: float) -> tuple[float, float]:
    """Fresnel reflectance for diffuse light from outside, and its derivative by n."""
    m2 = (n - 1.0) * (n + 1.0)
    end = min(math.asinh(1.0 / math.sqrt(m2)), _DEEPEST) if m2 > 0.0 else _DEEPEST
    x, w = np.polynomial.legendre.leggauss(_NODES)
    edges = np.linspace(0.0, end, math.ceil(end) + 1)
    half = 0.5 * np.diff(edges)[:, None]
    t = edges[:-1, None] + half * (1.0 + x)
    below = n * n * np.sinh(t) + np.cosh(t)
    parallel = (m2 * np.sinh(t) - np.exp(-t)) / below
    # 2 mu F dmu = m^2 sinh 2t F dt; r_s = -e^-2t
    f, w = 0.5 * (np.exp(-4.0 * t) + parallel**2), half * w * np.sinh(2.0 * t)
    # the end of t moves with n, and dr_p / dn = 2 n sinh 2t / (n^2 sinh t + cosh t)^2
    change = 2.0 * n * (f + m2 * parallel * np.sinh(2.0 * t) / below**2)
    return float(np.sum(w * f)) * m2, float(np.sum(w * change)) - 2.0 * n * (n - 1.0) / (n + 1.0) ** 3


@jit.model
def transmitted(mu: float, n2: float, m2: float) -> float:
    """1 - F for a cosine mu from outside; n2 = n^2, m2 = n^2 - 1."""
    mu2 = mu * mu
    q = math.sqrt(m2 + mu2)  # n cos theta_t
    s, p = mu + q, n2 * mu + q
    both = 1.0 / (s * p)
    s, p = p * both, s * both  # 1 / s, 1 / p
    r_s, r_p = m2 * s * s, m2 * ((n2 + 1.0) * mu2 - 1.0) * p * p
    # 1 - r^2; where that would cancel, multiplied out
    t_s = 1.0 - r_s * r_s if r_s < 0.5 else 4.0 * mu * q * s * s
    t_p = 1.0 - r_p * r_p if abs(r_p) < 0.5 else 4.0 * n2 * mu * q * p * p
    return 0.5 * (t_s + t_p)


@jit.model
def plastic_f_r(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float, p: list[float]) -> float:
    n, scale = p[1], p[2]
    lit = (zi > 0.0) & (zr > 0.0)
    mu_i = zi if lit else 1.0
    mu_r = zr if lit else 1.0
    n2, m2 = n * n, (n - 1.0) * (n + 1.0)
    value = scale * transmitted(mu_i, n2, m2) * transmitted(mu_r, n2, m2)
    return value if lit else 0.0


def _width(p: Array) -> float:
    """No lobe, but a layer at the horizon."""
    return 1.0


def _layer(p: Array) -> float:
    """Fresnel's reflectance rises within m = (n^2 - 1)^(1/2) of the horizon."""
    return max(math.sqrt((p[1] - 1.0) * (p[1] + 1.0)), 1e-5)


def _scale(p: Array) -> Array:
    """rho / (pi n^2 (1 - rho F_int))."""
    albedo, n = float(p[0]), float(p[1])
    return np.array([albedo * INV_PI / (n * n * (1.0 - albedo) + albedo * (1.0 - diffuse_reflectance(n)))])


def _scale_slopes(p: Array) -> Array:
    """Its derivatives; next to n = 1, where it is not smooth, differences would lose them."""
    albedo, n = float(p[0]), float(p[1])
    f, slope = _diffuse(n)
    below = n * n * (1.0 - albedo) + albedo * (1.0 - f)
    by_albedo = n * n / below**2
    by_n = -albedo * (2.0 * n * (1.0 - albedo) - albedo * slope) / below**2
    return INV_PI * np.array([[by_albedo], [by_n]])


PLASTIC = Model(
    name="plastic",
    parameters=(
        Parameter("albedo", 0.0, 1.0, "albedo of the base", ("uniform", 0.0, 1.0)),
        Parameter("n", 1.0, 3.0, "refractive index of the surface", ("log_normal", math.log(1.5), 0.15), fixed=1.5),
    ),
    function=plastic_f_r,
    doc="Diffuse base below a smooth dielectric surface, without the gloss.",
    reference="Wolff, JOSA A 11, 1994; Duntley, JOSA 32, 1942",
    lobe_width=_width,
    layer_width=_layer,
    derived=_scale,
    derived_slopes=_scale_slopes,
)
