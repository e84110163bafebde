r"""How the facets of a rough mirror are tilted, and how much of them other facets hide: four distributions.

D(h) is normalised, :math:`\int D\cos\theta_h\,\mathrm{d}\omega_h = 1`. With :math:`t = \tan\theta_h`,

- beckmann: :math:`D = e^{-t^2/\alpha^2} / (\pi\alpha^2\cos^4\theta_h)`;
- ggx: :math:`D = \alpha^2 / (\pi\,(\alpha^2\cos^2\theta_h + \sin^2\theta_h)^2)`;
- gtr: :math:`D = C / (\alpha^2\cos^2\theta_h + \sin^2\theta_h)^\gamma`, gamma = 2 is ggx;
- std: :math:`D = (1 + t^2/((\gamma-1)\alpha^2))^{-\gamma} / (\pi\alpha^2\cos^4\theta_h)`: Student's t distribution of
  slopes; gamma = 2 is ggx, infinity beckmann.

Smith's Lambda comes as :math:`M = \mu\Lambda`, the projected area of the facets seen from behind, which is finite at the
horizon and a sum of nothing but positive terms. With y = mu / (alpha sin theta):

- beckmann: :math:`M = \tfrac12\alpha s\,e^{-y^2} W(y)/\sqrt\pi` with :math:`W = 1 - \sqrt\pi\,y\,\mathrm{erfcx}(y)`, here a
  polynomial in y / (y + 4), to 1e-16;
- ggx: :math:`M = \tfrac12\alpha^2 s^2/(\sqrt{\mu^2+\alpha^2 s^2}+\mu)`;
- std: exact by the incomplete beta function, tabulated when gamma is set, to 1e-13;
- gtr: an integral over the slopes, tabulated when alpha and gamma are set, to 1e-13.

References
----------
.. [1] B. Walter, S. R. Marschner, H. Li, K. E. Torrance, "Microfacet Models for Refraction through Rough Surfaces", EGSR
   2007, eqs. 25, 33 (Beckmann's and the GGX distribution).
.. [2] E. Heitz, "Understanding the Masking-Shadowing Function in Microfacet-Based BRDFs", JCGT 3(2), 2014 (Lambda as an
   integral over slopes; those of Beckmann's and the GGX distribution).
.. [3] B. Burley, "Physically-Based Shading at Disney", SIGGRAPH course notes, 2012, appendix B (GTR).
.. [4] M. Ribardiere, B. Bringier, D. Meneveaux, L. Simonot, "STD: Student's t-Distribution of Slopes for Microfacet Based
   BSDFs", CGF 36(2), 2017. doi:10.1111/cgf.13137
.. [5] T. S. Trowbridge, K. P. Reitz, "Average irregularity representation of a rough surface for ray reflection", JOSA
   65(5), 1975. P. Beckmann, A. Spizzichino, The Scattering of Electromagnetic Waves from Rough Surfaces, 1963.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from gonio import jit
from gonio.brdf import pieces
from gonio.brdf.derivatives import differentiate
from gonio.brdf.elementary import exp, log, log_near, power
from gonio.brdf.parameter import Parameter
from gonio.brdf.pieces import read as read_pieces

Array = NDArray[np.float64]
INV_PI = 1.0 / math.pi
_REACH = 40.0  # e^-40 is nothing beside 1


@dataclass(frozen=True)
class Facets:
    """A distribution of facets; its parameters stand behind k_s: alpha at p[1], gamma at p[2].

    Attributes
    ----------
    parameters : tuple of Parameter
        Behind alpha.
    density : callable
        Of the index of the derived numbers: compiled ``(s2, z, l2, p) -> (numerator, denominator)`` of D(h), for a vector
        along h of square length l2, square tangential length s2 and height z.
    hidden : callable
        Of the same index: compiled ``(mu, s2, p) -> M``, s2 the square sine.
    derived : callable
        Of the values of alpha (and gamma): numbers that density and hidden find from that index on.
    count : int
        How many.
    slopes : callable, optional
        Of the same values: derivatives of these numbers by alpha and gamma, shape (2, count).
    width : callable
        Of the same values: half width of the lobe [rad], in units in which ggx has alpha.
    pointed : bool
        Whether M, as a function of the direction, has a broken power of s at the normal.
    steep : callable
        Of the parameter array: D grows towards the horizon no faster than the cosine to the power 1 / steep - 1.
    tip, pieces : float, int
        Sine below which the albedo is smooth at the normal, and in how many pieces it is tabulated.
    """

    parameters: tuple[Parameter, ...]
    density: Callable[[int], Any]
    hidden: Callable[[int], Any]
    derived: Callable[[Array], Array]
    count: int
    width: Callable[[Array], float]
    doc: str
    reference: str
    pointed: bool = False
    slopes: Callable[[Array], Array] | None = None
    steep: Callable[[Array], float] = lambda p: 1.0
    tip: float = 1.0
    pieces: int = 18


# --- ggx ------------------------------------------------------------------------------------------------------------------


@jit.model
def ggx_density(s2, z, l2, p):  # type: ignore[no-untyped-def]
    a2 = p[1] * p[1]
    t = a2 * z * z + s2
    return a2 * INV_PI * (l2 * l2), t * t


@jit.model
def ggx_hidden(mu, s2, p):  # type: ignore[no-untyped-def]
    a2 = p[1] * p[1] * s2
    return 0.5 * a2 / (math.sqrt(mu * mu + a2) + mu)


# --- beckmann -------------------------------------------------------------------------------------------------------------


@jit.model
def beckmann_density(s2, z, l2, p):  # type: ignore[no-untyped-def]
    a2, z2 = p[1] * p[1], z * z
    return exp(-s2 / (a2 * z2)) * INV_PI * (l2 * l2), a2 * z2 * z2


_W_FAR = 6.2  # in y; beyond, e^(-y^2) is nothing beside 1
_W_KNEE = 4.0
_W_SCALE = 2.0 * (_W_FAR + _W_KNEE) / _W_FAR


@jit.model
def beckmann_hidden(mu, s2, p):  # type: ignore[no-untyped-def]
    a = p[1] * math.sqrt(s2)
    y = mu / (a if a > 0.0 else 1.0)
    t = mu / (mu + _W_KNEE * a) * _W_SCALE - 1.0
    t = t if t < 1.0 else 1.0
    # W / (2 sqrt(pi))
    w = 5.564107984954418967e-12 + t * 1.761337688290242673e-12
    w = -4.809084077199969985e-11 + t * w
    w = -1.501593059302436984e-10 + t * w
    w = 1.234186817538993477e-9 + t * w
    w = 2.617367204831465717e-9 + t * w
    w = -3.517616479451326312e-8 + t * w
    w = 3.966737237822861671e-9 + t * w
    w = 9.586956512315067702e-7 + t * w
    w = -3.692557350002286258e-6 + t * w
    w = -0.00001143717991081517724 + t * w
    w = 0.0001913321044533722707 + t * w
    w = -0.001131883130967695373 + t * w
    w = 0.004457914038747794614 + t * w
    w = -0.01317077341768245336 + t * w
    w = 0.03034090978379962882 + t * w
    w = -0.05471492720994432718 + t * w
    w = 0.07498578492779029054 + t * w
    w = -0.07025197166444464413 + t * w
    w = 0.03284246914132163134 + t * w
    return a * exp(-y * y) * w


# --- std ------------------------------------------------------------------------------------------------------------------


def _density_std(at: int) -> Any:
    def std_density(s2, z, l2, p):  # type: ignore[no-untyped-def]
        a2, gamma, z2 = p[1] * p[1], p[2], z * z
        t2 = s2 / ((gamma - 1.0) * a2 * z2)
        return exp(-gamma * log_near(1.0 + t2, t2)) * INV_PI * (l2 * l2), a2 * z2 * z2

    return jit.model(std_density)


_STD_TERMS = 21


def _hidden_std(at: int) -> Any:
    def std_hidden(mu, s2, p):  # type: ignore[no-untyped-def]
        gamma = p[2]
        a = p[1] * math.sqrt(s2)
        b2 = (gamma - 1.0) * a * a
        q2 = mu * mu + b2
        q = math.sqrt(q2)
        t = mu / (mu + p[at] * q) * p[at + 1] - 1.0
        t = t if t < 1.0 else 1.0
        w = p[at + 1 + _STD_TERMS]
        for k in range(_STD_TERMS - 1, 0, -1):
            w = w * t + p[at + 1 + k]
        c2 = mu * mu / q2
        return a * w * exp((gamma - 1.5) * log_near(b2 / q2, -c2))

    return jit.model(std_hidden)


def _gamma(lower: float, upper: float, doc: str) -> Parameter:
    return Parameter("gamma", lower, upper, doc, ("log_normal", math.log(2.0), 0.5))


_STD_GAMMA = _gamma(1.51, 1e6, "exponent of the tail: 2 is ggx, infinity Beckmann's")


def _derived_std(values: Array) -> Array:
    r"""Of :math:`M = \tfrac12\alpha s\,\sigma^{2\gamma-3}\,T`: knee and scale of T's argument, and T / 2 as a polynomial.

    With x = y / sqrt(gamma - 1), c = x / sqrt(1 + x^2), sigma^2 = 1 - c^2, N = Gamma(gamma - 1/2) / (sqrt(pi)
    Gamma(gamma - 1)) and the tail Q = I_sigma^2(gamma - 1, 1/2) / 2 of Student's distribution,
    T / 2 = N sqrt(gamma - 1) / (2 gamma - 3) - y Q / sigma^(2 gamma - 3); T has no singularity but at c = -1.
    """
    return _std_numbers(_std_nodal(float(values[1])))


def _slopes_std(values: Array) -> Array:
    """Derivatives by alpha, none, and by gamma: of the values at the nodes, which keep digits that coefficients lose."""
    by_gamma = _std_numbers(differentiate(_std_nodal, float(values[1]), _STD_GAMMA))
    return np.stack((np.zeros_like(by_gamma), by_gamma))


def _std_nodal(gamma: float) -> Array:
    """Knee and scale of T's argument, and T / 2 at Chebyshev nodes."""
    from scipy.special import betaincc

    knee = _W_KNEE / math.hypot(_W_KNEE, math.sqrt(gamma - 1.0))
    farthest = math.sqrt(-math.expm1(-_REACH / (gamma - 1.5)))  # c at which sigma^(2 gamma - 3) = e^-40
    end = farthest / (farthest + knee)
    t = 0.5 * end * (1.0 + chebyshev.chebpts1(_STD_TERMS))
    c = knee * t / (1.0 - t)
    y = c / np.sqrt((1.0 - c) * (1.0 + c)) * math.sqrt(gamma - 1.0)
    tail = 0.5 * betaincc(0.5, gamma - 1.0, c * c) * np.exp(-(gamma - 1.5) * np.log1p(-c * c))
    half = _gamma_ratio(gamma - 1.0) * math.sqrt((gamma - 1.0) / math.pi) / (2.0 * gamma - 3.0) - y * tail
    return np.concatenate(([knee, 2.0 / end], half))


def _std_numbers(nodal: Array) -> Array:
    """The same with T / 2 as a polynomial."""
    waves = chebyshev.chebvander(chebyshev.chebpts1(_STD_TERMS), _STD_TERMS - 1)
    series = (2.0 / _STD_TERMS) * waves.T @ nodal[2:]
    series[0] *= 0.5
    polynomial = np.zeros(_STD_TERMS)
    short = chebyshev.cheb2poly(series)  # without zeros at its end
    polynomial[: len(short)] = short
    return np.concatenate((nodal[:2], polynomial))


def _gamma_ratio(z: float) -> float:
    """Gamma(z + 1/2) / Gamma(z) for z > 0 to 1e-15: the recurrence up to 40, then the asymptotic series."""
    factor = 1.0
    while z < 40.0:
        factor *= z / (z + 0.5)
        z += 1.0
    series = (-1 / 8, 1 / 128, 5 / 1024, -21 / 32768, -399 / 262144, 869 / 4194304, 39325 / 33554432)
    return factor * math.sqrt(z) * (1.0 + math.fsum(c / z ** (k + 1) for k, c in enumerate(series)))


# --- gtr ------------------------------------------------------------------------------------------------------------------

_GTR_PIECES = 12


def _density_gtr(at: int) -> Any:
    def gtr_density(s2, z, l2, p):  # type: ignore[no-untyped-def]
        t = p[1] * p[1] * z * z + s2
        return p[at] * power(l2 / t, p[2]), 1.0

    return jit.model(gtr_density)


def _hidden_gtr(at: int) -> Any:
    def gtr_hidden(mu, s2, p):  # type: ignore[no-untyped-def]
        # M / s^2 in pieces of ln((mu + r) / b), r^2 = mu^2 + b^2 s^2
        b = p[at + 1]
        r = math.sqrt(mu * mu + b * b * s2)
        return s2 * read_pieces(log((mu + r) / b) * p[at + 2], p, at + 3, _GTR_PIECES)

    return jit.model(gtr_hidden)


def gtr_normalisation(alpha: float, gamma: float) -> float:
    """C = (gamma - 1) (alpha^2 - 1) / (pi (1 - alpha^(2 - 2 gamma))), continued to gamma = 1 and to alpha = 1."""

    length = -2.0 * math.log(alpha)
    return INV_PI * _mean_exp(-length) / _mean_exp((gamma - 1.0) * length)


def _mean_exp(x: float) -> float:
    """(e^x - 1) / x, the mean of e^t from 0 to x."""
    return math.expm1(x) / x if x != 0.0 else 1.0


def _mean_exp_slope(x: float) -> float:
    """Derivative of the logarithm of `_mean_exp`."""
    if abs(x) < 1.0:
        return math.fsum(x**k / (math.factorial(k) * (k + 2)) for k in range(20)) / _mean_exp(x)
    return 1.0 / -math.expm1(-x) - 1.0 / x if x > -700.0 else -1.0 / x


def _derived_gtr(values: Array) -> Array:
    """The numbers of `_gtr`."""
    return _gtr(values)[0]


def _slopes_gtr(values: Array) -> Array:
    """Their derivatives by alpha and by gamma."""
    return _gtr(values)[1]


def _gtr(values: Array) -> tuple[Array, Array]:
    r"""C, scale b and pieces per unit of the logarithm, and the table of M / s^2.

    With the density of slopes :math:`P(t) = C\,(1+t^2)^{\gamma-2} (\alpha^2+t^2)^{-\gamma}` [2]_ and y = cot theta,
    :math:`M = 2 s y^3 \int_0^\infty x\,(x - \arctan x)\,P(y\sqrt{1+x^2})\,\mathrm{d}x`, here by equal steps of ln x. The
    derivatives are those under the integral; with alpha the nodes of the table move, too.
    """
    alpha, gamma = (float(v) for v in values)
    c = gtr_normalisation(alpha, gamma)
    b = min(alpha, 0.5)
    b_slope = 1.0 if alpha < 0.5 else 0.0
    span = math.log(2.0 / b)
    share = pieces.nodes(_GTR_PIECES).ravel()[:, None] / _GTR_PIECES
    reached = b * np.exp(share * span)  # mu + r
    # (mu + r)^2 = E^2 solved for mu; at the far end y -> infinity, s from y
    mu = (reached - b) * (reached + b) / (reached + np.sqrt(reached**2 * (1.0 - b * b) + b**4))
    y = mu / np.sqrt((1.0 - mu) * (1.0 + mu))
    step = 0.25 / math.sqrt(max(1.0, 0.4 * gamma))
    u = np.arange(-8.0, 37.0 + math.log(1.0 / float(y.min())), step)
    x = np.exp(u)
    t2 = y * y * (1.0 + x * x)
    density = c * np.exp((gamma - 2.0) * np.log1p(t2) - gamma * np.log(alpha * alpha + t2))
    # x (x - arctan x) dx = x^2 (x - arctan x) du
    bracket = np.where(x < 0.02, x**3 * (1 / 3 - x * x / 5 + x**4 / 7 - x**6 / 9), x - np.arctan(x))
    weights = x * x * bracket

    def per_square(logarithmic: Array | float) -> Array:  # M / s^2, or its derivative from that of ln P
        found: Array = 2.0 * step * y[:, 0] ** 3 * np.sqrt(1.0 + y[:, 0] ** 2) * ((density * logarithmic) @ weights)
        return found

    length, both = -2.0 * math.log(alpha), alpha * alpha + t2
    c_slope = -length * _mean_exp_slope((gamma - 1.0) * length)  # of ln C by gamma, and by alpha:
    c_rise = 2.0 / alpha * (_mean_exp_slope(-length) + (gamma - 1.0) * _mean_exp_slope((gamma - 1.0) * length))
    values_there = per_square(1.0)
    by_gamma = per_square(c_slope + np.log1p(t2) - np.log(both))
    by_alpha = per_square(c_rise - 2.0 * alpha * gamma / both)
    # b^2 mu^2 - 2 E mu + E^2 = b^2 moves with b, E = 2^share b^(1 - share)
    rise = ((reached - mu) * (1.0 - share) * reached / b - b * (1.0 - mu * mu)) / (reached - b * b * mu)
    y_rise = (rise * (1.0 + y * y) ** 1.5)[:, 0]
    along = per_square(2.0 * t2 / y * ((gamma - 2.0) / (1.0 + t2) - gamma / both))
    along += values_there * (3.0 / y[:, 0] + y[:, 0] / (1.0 + y[:, 0] ** 2))
    by_alpha += b_slope * y_rise * along

    def row(first: float, second: float, third: float, nodal: Array) -> Array:
        return np.concatenate(([first, second, third], pieces.table(nodal.reshape(_GTR_PIECES, -1))))

    numbers = row(c, b, _GTR_PIECES / span, values_there)
    alphas = row(c * c_rise, b_slope, b_slope * _GTR_PIECES / (span * span * b), by_alpha)
    return numbers, np.stack((alphas, row(c * c_slope, 0.0, 0.0, by_gamma)))


# --- all ------------------------------------------------------------------------------------------------------------------


_WALTER = "Walter et al., EGSR 2007; Heitz, JCGT 3(2), 2014"

FACETS = {
    "beckmann": Facets(
        (), lambda at: beckmann_density, lambda at: beckmann_hidden, lambda v: np.empty(0), 0, lambda v: float(v[0]),
        "Beckmann", f"Beckmann & Spizzichino, 1963; {_WALTER}", pointed=True, tip=0.05, pieces=30,
    ),
    "ggx": Facets(
        (), lambda at: ggx_density, lambda at: ggx_hidden, lambda v: np.empty(0), 0, lambda v: float(v[0]),
        "GGX (Trowbridge-Reitz)", f"Trowbridge & Reitz, JOSA 65(5), 1975; {_WALTER}",
    ),
    "gtr": Facets(
        (_gamma(0.0, 10.0, "exponent of the tail: 2 is ggx, 1 Berry's"),),
        _density_gtr, _hidden_gtr, _derived_gtr, 3 + _GTR_PIECES * pieces.ROW,
        lambda v: float(v[0]) * min(1.0, math.sqrt(2.0 ** (1.0 / max(v[1], 0.5)) - 1.0) / 0.6436),
        "GTR (generalised Trowbridge-Reitz)", "Burley, SIGGRAPH course, 2012; Heitz, JCGT 3(2), 2014", slopes=_slopes_gtr,
    ),
    "std": Facets(
        (_STD_GAMMA,),
        _density_std, _hidden_std, _derived_std, 2 + _STD_TERMS, lambda v: float(v[0]) * min(1.0, math.sqrt(v[1] - 1.0)),
        "Student's t", "Ribardiere et al., CGF 36(2), 2017", pointed=True, slopes=_slopes_std,
        steep=lambda p: max(1.0, 1.0 / (2.0 * float(p[2]) - 3.0)), tip=1e-10, pieces=44,
    ),
}  # fmt: skip
