r"""Hapke's model of a particulate surface.

Single scattering with a phase function and an opposition peak, multiple scattering as of isotropic scatterers, and the
shadows of a roughness on a large scale:

.. math::
    f_r = \frac{w}{4\pi}\,\frac{1}{\mu_i}\,\frac{\mu_{ie}}{\mu_{ie}+\mu_{re}}
          \Bigl([1+B(g)]P(g) + H(\mu_{ie})H(\mu_{re}) - 1\Bigr)\,S ,

which is Hapke's bidirectional reflectance over :math:`\mu_i`; his I/F is :math:`\pi\mu_i f_r`, his reflectance factor
:math:`\pi f_r`. P is the sum of two Henyey-Greenstein functions with weights (1 + c) / 2, backwards, and (1 - c) / 2,
forwards, c in [-1, 1]; :math:`B = B_0/(1+\tan(g/2)/h)`; H, with :math:`\gamma=\sqrt{1-w}` and
:math:`r_0=(1-\gamma)/(1+\gamma)`, is

.. math::
    \text{1981:}\ \frac{1+2x}{1+2x\gamma}, \qquad
    \text{2002:}\ \Bigl\{1 - wx\Bigl[r_0 + \tfrac{1-2r_0x}{2}\ln\tfrac{1+x}{x}\Bigr]\Bigr\}^{-1},

within 4 % and 1 % of Chandrasekhar's function. The effective cosines and the shadowing S for a mean slope angle
:math:`\bar\theta` are those of 1984, with their two branches. In f_r these are one: let a be the direction nearer to the
normal, b the other, :math:`\tau=\tan\bar\theta`, and :math:`E_1, E_2` Hapke's exponentials of
:math:`\cot\bar\theta\cot\theta`. Then

.. math::
    m_a = \mu_a + \frac{s_a\tau\,(\cos\psi\,E_2(b) + \sin^2\!\frac\psi2\,E_2(a))}{d}, \quad
    m_b = \mu_b + \frac{s_b\tau\,(E_2(b) - \sin^2\!\frac\psi2\,E_2(a))}{d}, \quad
    d = 2 - E_1(b) - \tfrac\psi\pi E_1(a),

are the effective cosines over :math:`\chi = (1+\pi\tau^2)^{-1/2}`, and with :math:`x = s\tau E_2/(2-E_1)`,
:math:`f=e^{-2\tan(\psi/2)}`

.. math:: f_r = \frac{w}{4\pi}\,\frac{m_a m_b}{m_a+m_b}\,\frac{[1+B]P + H(\chi m_a)H(\chi m_b) - 1}
                {(\mu_b + x_b)(\mu_a + x_a(1-f))} .

It is reciprocal. It is not bounded by energy: the opposition peak is added to surfaces that lose nothing. One look from one
side fits w, b and theta_bar against each other, and B_0 and h need phase angles below 3 h.

References
----------
.. [1] B. Hapke, "Bidirectional reflectance spectroscopy: 1. Theory", J. Geophys. Res. 86(B4), 1981.
   doi:10.1029/JB086iB04p03039
.. [2] B. Hapke, "... 3. Correction for macroscopic roughness", Icarus 59, 1984. doi:10.1016/0019-1035(84)90054-X
.. [3] B. Hapke, "... 4. The extinction coefficient and the opposition effect", Icarus 67, 1986.
   doi:10.1016/0019-1035(86)90108-9
.. [4] B. Hapke, "... 5. The coherent backscatter opposition effect and anisotropic scattering", Icarus 157, 2002.
   doi:10.1006/icar.2002.6853
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.brdf.arctangent import arctan
from gonio.brdf.base import Model
from gonio.brdf.elementary import exp, log1p
from gonio.brdf.parameter import Parameter

Array = NDArray[np.float64]
INV_PI = 1.0 / math.pi
TWO_OVER_PI = 2.0 / math.pi
_LARGE = 700.0  # an exponent from which on nothing is left
_NARROW = 0.5  # b from which on the phase function has peaks


@jit.model
def h_1981(x: float, w: float) -> float:
    """H - 1."""
    gamma = math.sqrt(1.0 - w)
    # 1 - gamma = w / (1 + gamma)
    return 2.0 * x * w / ((1.0 + gamma) * (1.0 + 2.0 * x * gamma))


@jit.model
def h_2002(x: float, w: float) -> float:
    """H - 1."""
    gamma = math.sqrt(1.0 - w)
    r_0 = w / ((1.0 + gamma) * (1.0 + gamma))
    y = w * x * (r_0 + (0.5 - r_0 * x) * log1p(1.0 / x))
    more: float = y / (1.0 - y)
    return more


@jit.model
def one_minus_exp(x: float) -> float:
    """1 - e^-x, x >= 0, to 4 eps, relative."""
    near = 2.505210838544172e-08 - x * 2.08767569878681e-09
    near = 2.7557319223985893e-07 - x * near
    near = 2.755731922398589e-06 - x * near
    near = 2.48015873015873e-05 - x * near
    near = 1.984126984126984e-04 - x * near
    near = 1.388888888888889e-03 - x * near
    near = 8.333333333333333e-03 - x * near
    near = 4.1666666666666664e-02 - x * near
    near = 1.6666666666666666e-01 - x * near
    near = x * (1.0 - x * (0.5 - x * near))
    value: float = near if x < 0.25 else 1.0 - exp(-x)
    return value


def _function(big_h: Any) -> Any:
    def hapke_f_r(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float, p: list[float]) -> float:
        w, b, c, b_0, h, tau = p[0], p[1], p[2], p[3], p[4], p[6]
        lit = (zi > 0.0) & (zr > 0.0)
        mu_i = zi if lit else 1.0
        mu_r = zr if lit else 1.0
        sum_x, sum_y, sum_z = xi + xr, yi + yr, mu_i + mu_r
        off_x, off_y, off_z = xi - xr, yi - yr, mu_i - mu_r
        sum2 = sum_x * sum_x + sum_y * sum_y + sum_z * sum_z  # 4 cos^2(g/2)
        off2 = off_x * off_x + off_y * off_y + off_z * off_z  # 4 sin^2(g/2)

        # 1 -+ 2 b cos g + b^2
        base, spread = (1.0 - b) * (1.0 - b), (1.0 - b) * (1.0 + b)
        back, ahead = base + b * off2, base + b * sum2
        phase = 0.5 * spread * ((1.0 + c) / (back * math.sqrt(back)) + (1.0 - c) / (ahead * math.sqrt(ahead)))
        opposition = b_0 / (1.0 + math.sqrt(off2) / (h * math.sqrt(sum2)))

        # roughness
        s2_i, s2_r = xi * xi + yi * yi, xr * xr + yr * yr
        nearer = mu_i > mu_r
        mu_a, s2_a = (mu_i if nearer else mu_r), (s2_i if nearer else s2_r)
        mu_b, s2_b = (mu_r if nearer else mu_i), (s2_r if nearer else s2_i)
        s_a, s_b = math.sqrt(s2_a), math.sqrt(s2_b)
        # cot theta_bar cot theta, and how much larger it is at a
        cot_a, cot_b = mu_a / (tau * s_a + 1e-290), mu_b / (tau * s_b + 1e-290)
        apart = (mu_a * s_b - mu_b * s_a) / (tau * s_a * s_b + 1e-290)
        fall = INV_PI * apart * (cot_a + cot_b)  # ln E2(b) - ln E2(a)
        fall = fall if fall > 0.0 else 0.0
        fall = fall if fall < _LARGE else _LARGE
        low = INV_PI * cot_b * cot_b
        lost_a, lost_b = one_minus_exp(TWO_OVER_PI * cot_a), one_minus_exp(TWO_OVER_PI * cot_b)  # 1 - E1
        e2_b, less = exp(-low), one_minus_exp(fall)
        e2_a = e2_b * (1.0 - less)
        # psi, by its distance from 0 or from pi, whichever is nearer
        dot = xi * xr + yi * yr
        sines = s_a * s_b
        facing = (dot > 0.0) | (sines <= 0.0)  # no azimuth at the normal: psi = 0, which nothing depends on
        side = 1.0 if facing else -1.0
        across = abs(xi * (yr - side * yi) - yi * (xr - side * xi))
        larger = sines + abs(dot) if sines > 0.0 else 1.0
        small = across / larger  # tan(psi/2), or its inverse
        small2 = small * small
        cos2 = (1.0 if facing else small2) / (1.0 + small2)  # cos^2(psi/2)
        angle = TWO_OVER_PI * arctan(small, 1.0)
        rest = 1.0 - angle if facing else angle  # 1 - psi / pi
        tangent = small if facing else 1.0 / (small + 1e-290)
        f_less = one_minus_exp(2.0 * tangent)  # 1 - f

        d = lost_b + lost_a + rest * (1.0 - lost_a)
        m_a = mu_a + s_a * tau * (cos2 * e2_b - (1.0 - cos2) * e2_b * less) / d
        m_b = mu_b + s_b * tau * e2_b * (less + cos2 * (1.0 - less)) / d
        x_a, x_b = s_a * tau * e2_a / (1.0 + lost_a), s_b * tau * e2_b / (1.0 + lost_b)
        chi = 1.0 / math.sqrt(1.0 + math.pi * tau * tau)

        h_a, h_b = big_h(chi * m_a, w), big_h(chi * m_b, w)
        scattered = (1.0 + opposition) * phase + h_a + h_b + h_a * h_b
        f_r = 0.25 * INV_PI * w * m_a * m_b * scattered / ((m_a + m_b) * (mu_b + x_b) * (mu_a + x_a * f_less))
        return f_r if lit else 0.0

    return jit.model(hapke_f_r)


_FUNCTIONS = {"1981": _function(h_1981), "2002": _function(h_2002)}


def _kinks(p: Array, omega_r: Array) -> Array:
    """The roughness has branches at theta_i = theta_r, and corners where psi is 0 or pi."""
    if p[5] == 0.0:
        return np.empty((*omega_r.shape[:-1], 0, 4))
    across = np.hypot(omega_r[..., 0], omega_r[..., 1])
    slanted = across > 0.0
    planes = np.zeros((*across.shape, 2, 4))
    planes[..., 0, 2], planes[..., 0, 3] = 1.0, np.where(slanted, omega_r[..., 2], 2.0)
    planes[..., 1, 0] = -np.divide(omega_r[..., 1], across, out=np.zeros_like(across), where=slanted)
    planes[..., 1, 1] = np.divide(omega_r[..., 0], across, out=np.ones_like(across), where=slanted)
    planes[..., 1, 3] = np.where(slanted, 0.0, 2.0)
    return planes


def _features(p: Array, omega_r: Array) -> Array:
    """The opposition peak, pointed however wide it is, and the phase function's peaks where they are narrow."""
    b, c, b_0, h = p[1:5]
    rows = []
    if b_0 > 0.0:
        rows.append([*omega_r, min(2.0 * h, 1.0)])
    if b > _NARROW and c > -1.0:
        rows.append([*omega_r, 1.0 - b])
    if b > _NARROW and c < 1.0:  # ahead, below the horizon: what is seen of it sits around the mirror direction
        rows.append([-omega_r[0], -omega_r[1], omega_r[2], max(1.0 - b, float(omega_r[2]))])
    return np.array(rows).reshape(-1, 4)


def _width(p: Array) -> float:
    """No lobe; seen at a grazing angle, 1 / (mu_i + mu_r) is a layer at the horizon, which lobes have too."""
    return 1.0


def _layer_2002(p: Array) -> float:
    """mu_i H has a term mu_i^2 ln mu_i, nothing below this height."""
    return 1e-5 if p[0] > 0.0 else 1.0


def _tau(p: Array) -> Array:
    return np.array([math.tan(p[5])])


@functools.cache
def hapke(H: str) -> Model:
    """The model with one of the two approximations of Chandrasekhar's H."""
    return Model(
        name="hapke",
        parameters=(
            Parameter("w", 0.0, 1.0, "single-scattering albedo", ("uniform", 0.0, 1.0)),
            Parameter("b", 0.0, 0.999, "width of the phase function's lobes; 0 is isotropic", ("uniform", 0.0, 0.9)),
            Parameter("c", -1.0, 1.0, "1 scatters backwards only, -1 forwards only", ("uniform", -1.0, 1.0)),
            Parameter("B_0", 0.0, 3.0, "height of the opposition peak", ("uniform", 0.0, 1.0), fixed=0.0),
            Parameter("h", 1e-5, 10.0, "width of the opposition peak", ("log_normal", math.log(0.05), 0.8), fixed=0.05),
            Parameter("theta_bar", 0.0, math.pi / 4, "mean slope of the roughness", ("uniform", 0.0, 0.7), "rad"),
        ),
        function=_FUNCTIONS[H],
        doc=f"Particulate surface: phase function, opposition peak, multiple scattering (H of {H}), roughness.",
        reference="Hapke, J. Geophys. Res. 86, 1981; Icarus 59, 1984; Icarus 67, 1986; Icarus 157, 2002",
        lobe_width=_width,
        layer_width=_layer_2002 if H == "2002" else None,
        kinks=_kinks,
        features=_features,
        derived=_tau,
        energy_bounded=False,
        choices={} if H == "1981" else {"H": H},
    )
