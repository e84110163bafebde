r"""Scatter of polished surfaces as a function of the distance from the mirror direction in direction cosines.

With :math:`d = |(\omega_i+\omega_r)_{xy}|`, that is :math:`|\beta-\beta_0|`, exact as written:

.. math::
    \text{abg}\quad & f_r = \frac{A}{B + d^g} \\
    \text{harvey\_shack}\quad & f_r = b_0\,\bigl[1 + (d/l)^2\bigr]^{s/2} \\
    \text{k\_correlation}\quad & f_r = \frac{16\pi^2}{\lambda^4}\,\mu_i\mu_r\,Q\,S_2(d/\lambda),\quad
        S_2(\nu) = \frac{\Gamma\bigl(\frac{C+1}{2}\bigr)}{2\sqrt\pi\,\Gamma\bigl(\frac C2\bigr)}\,
        \frac{A\,B}{\bigl[1+(B\nu)^2\bigr]^{(C+1)/2}}

The last is first-order vector perturbation (Rayleigh and Rice) of an isotropic surface whose profile has the
one-dimensional power spectrum :math:`A/[1+(Bf)^2]^{C/2}` ("ABC", K-correlation). It holds for a height far below the
wavelength. Q, in general the reflectance for the polarisations at hand, is 1 here: a perfect mirror; multiply by a
reflectance for another.

None of the three is bounded by energy: they describe little light.

References
----------
.. [1] J. E. Harvey, "Light-scattering characteristics of optical surfaces", Ph.D. thesis, University of Arizona, 1976.
.. [2] R. N. Pfisterer, "Approximated Scatter Models for Stray Light Analysis", Optics & Photonics News 22(10), 2011 (ABg,
   Harvey-Shack).
.. [3] E. L. Church, P. Z. Takacs, T. A. Leonard, "The prediction of BRDFs from surface profile measurements", Proc. SPIE
   1165, 1989 (ABC model, its two-dimensional spectrum).
.. [4] J. C. Stover, "Optical Scattering: Measurement and Analysis", 3rd ed., SPIE, 2012 (Rayleigh-Rice).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import digamma

from gonio import jit
from gonio.brdf.base import Model
from gonio.brdf.elementary import exp, log1p, power
from gonio.brdf.parameter import Parameter

Array = NDArray[np.float64]
_CUSP = 0.03
SIXTEEN_PI2 = 16.0 * math.pi**2


@jit.model
def abg_f_r(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float, p: list[float]) -> float:
    x, y = xi + xr, yi + yr
    value = p[0] / (p[1] + power(x * x + y * y, 0.5 * p[2]))
    return value if (zi > 0.0) & (zr > 0.0) else 0.0


@jit.model
def harvey_shack_f_r(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float, p: list[float]) -> float:
    scale = 1.0 / p[1]
    x, y = scale * (xi + xr), scale * (yi + yr)
    value = p[0] * exp(0.5 * p[2] * log1p(x * x + y * y))
    return value if (zi > 0.0) & (zr > 0.0) else 0.0


@jit.model
def k_correlation_f_r(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float, p: list[float]) -> float:
    scale = p[1] / p[3]
    x, y = scale * (xi + xr), scale * (yi + yr)
    value = p[4] * (zi * zr) * exp(-0.5 * (p[2] + 1.0) * log1p(x * x + y * y))
    return value if (zi > 0.0) & (zr > 0.0) else 0.0


def _abg_width(p: Array) -> float:
    """Where d^g = B: the peak's roll-off; far below it where d^g is a cusp, so that nodes crowd towards it."""
    if p[2] == 0.0:
        return 1.0
    width: float = 0.5 * float(p[1]) ** (1.0 / float(p[2]))
    return width if float(p[2]) in (2.0, 4.0) else float(_CUSP * width)


def _harvey_width(p: Array) -> float:
    return 0.5 * float(p[1])


def _k_correlation_width(p: Array) -> float:
    return 0.5 * float(p[3] / p[1])


def _peak(p: Array) -> Array:
    """f_r / (mu_i mu_r) at the mirror direction [1/sr]."""
    return np.array([p[0] * _peak_of_one(p)])


def _peak_of_one(p: Array) -> float:
    """The same for A = 1."""
    _, b, c, wavelength = map(float, p)
    gammas = math.exp(math.lgamma(0.5 * (c + 1.0)) - math.lgamma(0.5 * c))
    return SIXTEEN_PI2 / wavelength**4 * gammas / (2.0 * math.sqrt(math.pi)) * b


def _peak_slopes(p: Array) -> Array:
    """Its derivatives by A, B, C and the wavelength."""
    a, b, c, wavelength = map(float, p)
    one = _peak_of_one(p)
    by_c = 0.5 * float(digamma(0.5 * (c + 1.0)) - digamma(0.5 * c))
    return one * np.array([[1.0], [a / b], [a * by_c], [-4.0 * a / wavelength]])


ABG = Model(
    name="abg",
    parameters=(
        Parameter("A", 0.0, 1e3, "A / B is the peak", ("log_normal", math.log(1e-3), 3.0), "1/sr"),
        Parameter("B", 1e-12, 1e3, "B^(1/g) is where the peak rolls off", ("log_normal", math.log(1e-3), 3.0)),
        Parameter("g", 0.0, 4.0, "slope: f_r falls as d^-g", ("uniform", 0.0, 4.0)),
    ),
    function=abg_f_r,
    factors=("A",),
    doc="ABg scatter, A / (B + d^g), d the distance from the mirror direction in direction cosines.",
    reference="Pfisterer, Optics & Photonics News 22(10), 2011",
    lobe_width=_abg_width,
    energy_bounded=False,
)
HARVEY_SHACK = Model(
    name="harvey_shack",
    parameters=(
        Parameter("b_0", 0.0, 1e12, "the peak", ("log_normal", 0.0, 4.0), "1/sr"),
        Parameter("l", 1e-6, 1e3, "distance at which the peak rolls off", ("log_normal", math.log(0.01), 2.0)),
        Parameter("s", -4.0, 0.0, "slope: f_r falls as d^s", ("uniform", -4.0, 0.0)),
    ),
    function=harvey_shack_f_r,
    factors=("b_0",),
    doc="Harvey and Shack's scatter of a polished surface, b_0 (1 + (d / l)^2)^(s / 2).",
    reference="Harvey, thesis, University of Arizona, 1976; Pfisterer, Optics & Photonics News 22(10), 2011",
    lobe_width=_harvey_width,
    energy_bounded=False,
)
K_CORRELATION = Model(
    name="k_correlation",
    parameters=(
        Parameter("A", 0.0, 1e6, "profile's power spectrum at low frequency", ("log_normal", math.log(1e-4), 4.0), "um^3"),
        Parameter("B", 1e-3, 1e6, "correlation length, times 2 pi", ("log_normal", math.log(100.0), 3.0), "um"),
        Parameter("C", 1.0, 20.0, "slope of the profile's power spectrum, f^-C", ("uniform", 1.0, 4.0)),
        Parameter("wavelength_um", 0.01, 1000.0, "wavelength", ("uniform", 0.3, 2.0), "um", fixed=0.6328),
    ),
    function=k_correlation_f_r,
    factors=("A",),
    doc="Rayleigh-Rice scatter of a perfect mirror with K-correlated (ABC) roughness, given as a profile's power spectrum.",
    reference="Church, Takacs & Leonard, Proc. SPIE 1165, 1989; Stover, Optical Scattering, SPIE, 2012",
    lobe_width=_k_correlation_width,
    derived=_peak,
    derived_slopes=_peak_slopes,
    energy_bounded=False,
)
