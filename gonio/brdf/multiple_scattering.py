r"""Light that facets scatter several times, after Kulla and Conty: what is lost at the first time, given back diffusely.

.. math:: f_{ms} = \frac{\bar F^2 \bar E}{1-\bar F(1-\bar E)}\,\frac{(1-E(\mu_i))\,(1-E(\mu_r))}{\pi\,(1-\bar E)}

E is the directional albedo of facets that reflect all, :math:`\bar E = 2\int E\mu\,\mathrm{d}\mu`, and :math:`\bar F` the
mean of their reflectance. With F = 1 nothing is lost; the model is reciprocal.

E is tabulated when alpha and gamma are set. What is integrated is the loss itself, over the facets h that are seen: as
Smith's masking sees an area of just 1,

.. math:: 1 - E = \frac1{\mu_r}\int D(h)\,(\omega_r\cdot h)\,(G_1(\omega_r) - G_2)\,\mathrm{d}\omega_h ,

whose integrand is positive, so that the small losses of smooth surfaces keep their digits; so does a table of ln(1 - E).
Rings of equal theta_h are split where they reach the horizon, touch it or leave it; between, and along the rings, nodes
crowd double-exponentially towards these places [2]_, where the integrand has layers as thin as alpha and mu_r.

References
----------
.. [1] C. Kulla, A. Conty, "Revisiting Physically Based Shading at Imageworks", SIGGRAPH course notes, 2017.
.. [2] H. Takahasi, M. Mori, "Double Exponential Formulas for Numerical Integration", Publ. RIMS 9(3), 1974.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.brdf import pieces
from gonio.brdf.elementary import exp, log
from gonio.brdf.facets import Facets
from gonio.brdf.pieces import read as read_pieces

Array = NDArray[np.float64]
_NEAR = 1e-8  # in alphas: cosines below are near the horizon
_LOW = 1e-8  # in alphas: slopes below are none
_PANEL = 1.5  # longest panel in ln tan(theta_h / 2)


def lost(facets: Facets, at: int) -> Any:
    """Compiled ``(mu, s2, p) -> 1 - E(mu)``, s2 the square sine, from the numbers of `derived` that begin at p[at]."""
    tip, count = facets.tip, facets.pieces

    def loss(mu, s2, p):  # type: ignore[no-untyped-def]
        # pieces of ln((mu + near) / (s + tip))
        x = log((mu * p[at + 1] + 1.0) * (1.0 + tip) / (math.sqrt(s2) + tip)) * p[at + 2]
        return exp(read_pieces(x, p, at + 3, count))

    return jit.model(loss)


def derived(facets: Facets, shadowing: str, average: float, p: Array, at: int) -> Array:
    """Weight of the product of losses, two scales of the table's argument, and the table of ln(1 - E).

    Parameters
    ----------
    facets : Facets
    shadowing : str
    average : float
        Mean of Fresnel's reflectance.
    p : ndarray
        Parameters and the numbers derived from them, for the distribution's functions.
    at : int
        Index of the latter.
    """
    loss, numbers = _tabulated(facets, shadowing, tuple(map(float, p[1 : 2 + len(facets.parameters)])), at)
    weight = average * average * (1.0 - loss) / (1.0 - average * loss) / (math.pi * loss)
    return np.concatenate(([weight], numbers))


@functools.lru_cache(maxsize=256)  # a fit changes what is not the facets' own, too
def _tabulated(facets: Facets, shadowing: str, shape: tuple[float, ...], at: int) -> tuple[float, Array]:
    """The mean of 1 - E, and `derived` but for the weight, of facets of a shape (alpha and gamma)."""
    p = np.zeros(at + facets.count)
    p[1 : 1 + len(shape)], p[at:] = shape, facets.derived(np.array(shape))
    near, tip, count = _NEAR * shape[0], facets.tip, facets.pieces
    span = math.log((1.0 / near + 1.0) * (1.0 + tip) / tip)
    mu, s = _angles(pieces.nodes(count).ravel() * (span / count), span, near, tip)
    found = np.empty(len(mu))
    _losses(facets.density(at), facets.hidden(at), shadowing == "smith", facets.pointed)(
        mu, s, p, facets.steep(p), *rules(facets.pointed), found
    )
    table = pieces.table(_logarithm(found.reshape(count, -1)))
    # the mean of 1 - E: 2 mu dmu of the table, with dx = dmu / (mu + near) - ds / (s + tip)
    g, w = np.polynomial.legendre.leggauss(24)
    x = (np.arange(count)[:, None] + 0.5 * (1.0 + g)) * (span / count)
    mu, s = _angles(x, span, near, tip)
    rows = np.exp(np.polynomial.polynomial.polyval(g, table.reshape(count, -1).T))
    slope = mu * s / (s / (mu + near) + mu / (s + tip))
    loss = float(np.sum(rows * w * slope) * (span / count))
    numbers = np.concatenate(([1.0 / near, count / span], table))
    numbers.flags.writeable = False
    return loss, numbers


def _logarithm(losses: Array) -> Array:
    """ln(1 - E) at the nodes of pieces; -800, of which the exponential is 0, for pieces in which any loss is too small."""
    seen = np.all(losses > 1e-290, axis=1, keepdims=True)
    return np.where(seen, np.log(np.where(seen, losses, 1.0)), -800.0)


def _angles(x: Array, span: float, near: float, tip: float) -> tuple[Array, Array]:
    """Cosine and sine of the direction at which the table's argument is x: the smaller of the two to all its digits."""

    def smaller(w: Array, a: Array, b: Array) -> Array:
        # c + a = a e^w (sqrt(1 - c^2) + b) / (1 + b) by Newton's method
        c = np.minimum(a * np.expm1(w), 0.8)
        for _ in range(30):
            rest = np.sqrt((1.0 - c) * (1.0 + c))
            value = c - a * (np.expm1(w) - np.exp(w) * c * c / ((1.0 + rest) * (1.0 + b)))
            c = np.clip(c - value / (1.0 + a * np.exp(w) * c / (rest * (1.0 + b))), 0.0, 0.8)
        return c

    low = x < span + math.log(tip * (1.0 + near) / (1.0 + tip))  # theta > 45 degrees, or about so
    few = smaller(np.where(low, x, span - x), np.where(low, near, tip), np.where(low, tip, near))
    many = np.sqrt((1.0 - few) * (1.0 + few))
    return np.where(low, few, many), np.where(low, many, few)


def tanh_sinh(step: float = 0.08, reach: float = 3.9) -> Array:
    """Nodes on [0, 1] by their distance from the nearer end, negative from the upper one, and weights; shape (2, n)."""
    t = step * np.arange(-round(reach / step), round(reach / step) + 1)
    e = np.exp(-math.pi * np.sinh(np.abs(t)))
    distance = np.where(t > 0, -e / (1.0 + e), e / (1.0 + e))
    return np.stack((distance, step * math.pi * np.cosh(t) * e / (1.0 + e) ** 2))


def gauss(count: int = 16) -> Array:
    """The same for Gauss and Legendre's rule."""
    x, w = np.polynomial.legendre.leggauss(count)
    return np.stack((np.where(x < 0, 0.5 * (1.0 + x), -0.5 * (1.0 - x)), 0.5 * w))


def even(step: float = 0.075, reach: float = 3.9) -> Array:
    """tanh-sinh for functions that are even about 0: distances from 1 and weights."""
    t = step * (np.arange(round(reach / step)) + 0.5)
    e = np.exp(-math.pi * np.sinh(t))
    return np.stack((2.0 * e / (1.0 + e), step * math.pi * np.cosh(t) * 2.0 * e / (1.0 + e) ** 2))


@functools.cache
def rules(pointed: bool) -> tuple[Array, Array, Array]:
    """Along rings; for panels of theta_h with an edge, and without."""
    both = tanh_sinh(0.07)
    whole = np.stack((np.where(both[0] < 0, -both[0], 1.0 - both[0]), both[1]))
    return whole if pointed else even(), tanh_sinh(0.05), gauss()


@functools.cache
def _losses(density: Any, hidden: Any, correlated: bool, pointed: bool) -> Any:
    @jit.model
    def share(mu, mu_i, m_r, p):  # type: ignore[no-untyped-def]
        """(G_1 - G_2) (mu + m_r) / mu"""
        m_i = hidden(mu_i, max(1.0 - mu_i * mu_i, 0.0), p)
        if correlated:
            return mu * m_i / (mu * mu_i + (mu * m_i + mu_i * m_r))
        return m_i / (mu_i + m_i)

    @jit.part
    def bounds(theta, theta_r, a, b, along, across):  # type: ignore[no-untyped-def]
        """Of phi: where omega_i sets and where the facets do; the smallest mu_i if it never sets."""
        end = math.acos(min(max(-a / b, -1.0), 1.0))
        last = math.acos(min(max(-along / across, -1.0), 1.0))
        least = max(math.cos(2.0 * theta + theta_r), 0.0)
        end = math.pi if least > 0.0 else end
        end = 0.0 if math.cos(2.0 * theta - theta_r) <= 0.0 else end
        return end, last, least

    def losses(mu, sine_r, p, steep, along_ring, edged, smooth, out):  # type: ignore[no-untyped-def]
        low, quarter = math.log(0.5 * _LOW * p[1]), 0.5 * math.pi
        floor = 1e-60 ** (1.0 / steep)
        edges = np.empty(5)
        for j in range(mu.size):
            m, s = mu[j], sine_r[j]
            m_r, theta_r, up = hidden(m, s * s, p), math.atan2(s, m), math.atan2(m, s)
            # rings begin to reach the horizon, begin to have facets unseen, are all below the horizon
            edges[0], edges[1], edges[2], edges[3] = 0.5 * up, up, 0.5 * (quarter + theta_r), quarter
            edges[4] = 0.5 * theta_r if pointed else quarter  # the ring has the facet that mirrors to the normal
            edges.sort()
            total, begin, sharp = 0.0, low, False
            for i in range(5):
                far_end = math.log(math.tan(0.5 * edges[i])) if edges[i] < quarter else 0.0
                if far_end - begin < 1e-13:
                    continue
                count = int((far_end - begin) / _PANEL) + 1
                width = (far_end - begin) / count
                for n in range(count):
                    last_panel = far_end == 0.0 and n == count - 1
                    closes = pointed if last_panel else n == count - 1
                    rule = edged if closes or (n == 0 and sharp) else smooth
                    for k in range(rule.shape[1]):
                        step, weight = rule[0, k], width * rule[1, k]
                        u = begin + n * width + width * (step if step > 0.0 else 1.0 + step)
                        if last_panel:  # D grows like cos(theta)^(1 / steep - 1)
                            z = max(-step if step < 0.0 else 1.0 - step, floor)
                            u = -width * z**steep
                            weight *= steep * z ** (steep - 1.0)
                        theta = 2.0 * math.atan(math.exp(u))
                        st, ct = 1.0 / math.cosh(u), -math.tanh(u)
                        a, b = m * (ct - st) * (ct + st), 2.0 * s * st * ct  # mu_i = a + b cos(phi)
                        along, across = m * ct, s * st  # omega_r . h = along + across cos(phi)
                        end, last, least = bounds(theta, theta_r, a, b, along, across)
                        # sin(phi / 2) = sin(end / 2) v, along_ring[0] = 1 - v; the integrand is even in v
                        sine, cosine = math.sin(0.5 * end), math.cos(0.5 * end)
                        sine2, cosine2 = sine * sine, cosine * cosine if least == 0.0 else 0.0
                        seen = 0.0
                        for l in range(along_ring.shape[1] if end > 0.0 else 0):
                            far = sine2 * along_ring[0, l] * (2.0 - along_ring[0, l])  # (cos(phi) - cos(end)) / 2
                            towards = along + across * (2.0 * (far + cosine2) - 1.0)
                            value = towards * share(m, least + 2.0 * b * far, m_r, p)
                            seen += along_ring[1, l] * value / math.sqrt(cosine2 + far)
                        seen *= 2.0 * sine
                        if last > end:
                            seen += along * (last - end) + across * (math.sin(last) - math.sin(end))
                        d_n, d_d = density(st * st, ct, 1.0, p)
                        total += 2.0 * weight * st * st * seen * d_n / (d_d * (m + m_r))
                begin, sharp = far_end, True
            out[j] = total

    return jit.kernel(losses)
