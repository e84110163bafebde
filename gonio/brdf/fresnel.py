r"""Fresnel reflectances of unpolarised light at a facet, and their means over the hemisphere.

Each is a fraction of two numbers of the geometry, so that a model divides once for all its factors:
``f(l2, e2, p) -> (numerator, denominator)`` with :math:`l^2 = |\omega_i+\omega_r|^2`, :math:`e^2 = |\omega_i-\omega_r|^2`.
The facet's cosine is :math:`c = l/2`, its sine :math:`e/2`. With m the complex refractive index and
:math:`q = \sqrt{m^2-1+c^2}`, nothing cancels in

.. math:: r_s = -\frac{m^2-1}{(q+c)^2}, \qquad r_p = \frac{(m^2-1)\,((m^2+1)\,c^2-1)}{(m^2 c+q)^2} ,

which are Fresnel's amplitudes multiplied out; m = 1 reflects nothing, to the last digit. Polarisation and thin films are
refused by having no parameter.

References
----------
.. [1] M. Born, E. Wolf, Principles of Optics, 7th ed., Cambridge, 1999, sections 1.5.2 and 14.2 (Fresnel's formulas).
.. [2] C. Schlick, "An Inexpensive BRDF Model for Physically-based Rendering", CGF 13(3), 1994. doi:10.1111/1467-8659.1330233
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.brdf.parameter import Parameter
from gonio.brdf.plastic import diffuse_reflectance

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Fresnel:
    """A reflectance of facets.

    Attributes
    ----------
    parameters : tuple of Parameter
    factor : callable
        Of the index of the first of them in the parameter array: the compiled function.
    average : callable
        Of their values: 2 times the integral of F(c) c dc from 0 to 1.
    """

    parameters: tuple[Parameter, ...]
    factor: Callable[[int], Any]
    average: Callable[[Array], float]
    doc: str
    reference: str


def _none(at: int) -> Any:
    def one(l2, e2, p):  # type: ignore[no-untyped-def]
        return 1.0, 1.0

    return jit.model(one)


def _schlick(at: int) -> Any:
    def schlick(l2, e2, p):  # type: ignore[no-untyped-def]
        # F = f_0 + (1 - f_0) (1 - c)^5, 1 - c = sin^2 / (1 + c)
        f_0 = p[at]
        s, d = 0.25 * e2, 1.0 + 0.5 * math.sqrt(l2)
        s2, d2 = s * s, d * d
        d5 = d2 * d2 * d
        return f_0 * d5 + (1.0 - f_0) * (s2 * s2 * s), d5

    return jit.model(schlick)


def _dielectric(at: int) -> Any:
    def dielectric(l2, e2, p):  # type: ignore[no-untyped-def]
        n, c2 = p[at], 0.25 * l2
        n2, m = n * n, (n - 1.0) * (n + 1.0)
        c, q = math.sqrt(c2), math.sqrt(m + c2)
        s, u = q + c, n2 * c + q
        s2, u2 = s * s, u * u
        v = m * c2 + (c2 - 0.25 * e2)  # (n^2 + 1) c^2 - 1
        s4, u4 = s2 * s2, u2 * u2
        return 0.5 * m * m * (u4 + v * v * s4), s4 * u4

    return jit.model(dielectric)


def _conductor(at: int) -> Any:
    def conductor(l2, e2, p):  # type: ignore[no-untyped-def]
        n, k, c2 = p[at], p[at + 1], 0.25 * l2
        c = math.sqrt(c2)
        m_re, m_im = (n - 1.0) * (n + 1.0) - k * k, 2.0 * n * k  # m^2 - 1
        square = (n - k) * (n + k)  # Re m^2
        # q = a + i b: a^2 - b^2 = w, a b = n k; the larger of a^2, b^2 is a sum
        w = square - 0.25 * e2 if e2 < l2 else m_re + c2
        larger = 0.5 * (math.sqrt(w * w + m_im * m_im) + abs(w))
        smaller = 0.25 * m_im * m_im / (larger if larger > 0.0 else 1.0)
        a, b = math.sqrt(larger if w > 0.0 else smaller), math.sqrt(smaller if w > 0.0 else larger)
        s2 = (a + c) * (a + c) + b * b  # |q + c|^2
        u_re, u_im = square * c + a, m_im * c + b
        u2 = u_re * u_re + u_im * u_im  # |m^2 c + q|^2
        v_re, v_im = square * c2 - 0.25 * e2, m_im * c2
        s4, u4 = s2 * s2, u2 * u2
        return 0.5 * (m_re * m_re + m_im * m_im) * (u4 + (v_re * v_re + v_im * v_im) * s4), s4 * u4

    return jit.model(conductor)


def _average_conductor(values: Array) -> float:
    """Gauss-Legendre in t, c = t^2: F(c) bends at c of the order of 1 / |m| and of |m^2 - 1|^(1/2)."""
    m2 = complex(*values) ** 2
    x, w = np.polynomial.legendre.leggauss(64)
    edges = np.array([0.0, 1e-3, 1e-2, 0.05, 0.2, 0.5, 1.0])
    half = 0.5 * np.diff(edges)[:, None]
    t = edges[:-1, None] + half * (1.0 + x)
    c = t * t
    q = np.sqrt(m2 - 1.0 + c * c)
    f = 0.5 * abs(m2 - 1.0) ** 2 * (1.0 / abs(q + c) ** 4 + abs((m2 + 1.0) * c * c - 1.0) ** 2 / abs(m2 * c + q) ** 4)
    return float(np.sum(half * w * 4.0 * t**3 * f))


_BORN = "Born & Wolf, Principles of Optics, sections 1.5.2 and 14.2"

FRESNEL = {
    "schlick": Fresnel(
        (Parameter("f_0", 0.0, 1.0, "Schlick's reflectance at normal incidence", ("uniform", 0.0, 1.0)),),
        _schlick,
        lambda values: float(values[0] + (1.0 - values[0]) / 21.0),
        "Schlick's Fresnel term in h.v",
        "Schlick, CGF 13(3), 1994",
    ),
    "dielectric": Fresnel(
        (Parameter("n", 1.0, 5.0, "refractive index of the facets", ("log_normal", math.log(1.5), 0.15)),),
        _dielectric,
        lambda values: diffuse_reflectance(float(values[0])),
        "Fresnel's term of a dielectric",
        _BORN,
    ),
    "conductor": Fresnel(
        (
            Parameter("n", 0.01, 100.0, "real part of the facets' refractive index", ("log_normal", 0.0, 1.0)),
            Parameter("k", 0.0, 200.0, "imaginary part of it (absorption)", ("log_normal", math.log(3.0), 0.7)),
        ),
        _conductor,
        _average_conductor,
        "Fresnel's term of a metal",
        _BORN,
    ),
    "none": Fresnel((), _none, lambda values: 1.0, "facets that reflect all", ""),
}
