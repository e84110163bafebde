r"""EON, the energy-preserving form of Oren and Nayar's model: a rough diffuse surface that loses no light.

Fujii's variant of Oren and Nayar's single scattering, plus what its directional albedo E leaves over, scattered again:

.. math::
    f_r = \frac{\rho}{\pi} A\,(1 + r\,s') + \frac{\rho_{ms}}{\pi}
          \frac{(1-E(\mu_i))(1-E(\mu_r))}{1-\bar E}, \quad
    s = \omega_i\cdot\omega_r - \mu_i\mu_r, \quad s' = \begin{cases} s/\max(\mu_i,\mu_r) & s > 0 \\ s & s \le 0 \end{cases}

with :math:`A = 1/(1+K_1 r)`, :math:`K_1 = \tfrac12-\tfrac{2}{3\pi}`, :math:`K_2 = \tfrac23-\tfrac{28}{15\pi}`,
:math:`\bar E = A(1+K_2 r)`, :math:`\rho_{ms} = \rho^2\bar E/(1-\rho(1-\bar E))` and, with
:math:`\sigma = \sin\theta`,

.. math:: E(\mu) = A\Bigl(1 + \frac{r}{\pi} G\Bigr), \quad
          G = \sigma(\theta - \sigma\mu) + \tfrac23\Bigl(\frac{\sigma}{\mu}(1-\sigma^3) - \sigma\Bigr) .

Here :math:`1-E = A r D` with :math:`D = K_1 - G/\pi`, so that r = 0 is Lambert's surface without a special case, and
D is written in :math:`\mu` and the elevation :math:`\arcsin\mu`, in which it vanishes at the horizon digit by digit; so does
1 + s where it comes near 0. At albedo 1 the directional albedo is exactly 1.

References
----------
.. [1] J. Portsmouth, P. Kutz, S. Hill, "EON: A Practical Energy-Preserving Rough Diffuse BRDF", JCGT 14(1), 2025;
   arXiv:2410.18026.
"""

from __future__ import annotations

import math

from gonio import jit
from gonio.brdf.arctangent import arctan
from gonio.brdf.base import Model
from gonio.brdf.oren_nayar import kinks
from gonio.brdf.parameter import Parameter

INV_PI = 1.0 / math.pi
K_1 = 0.5 - 2.0 / (3.0 * math.pi)
K_2 = 2.0 / 3.0 - 28.0 / (15.0 * math.pi)
_CAP = 0.5 * math.pi - 2.0 / 3.0


@jit.model
def _left(mu: float, sine2: float) -> float:
    """D = (1 - E) / (A r), from mu and sin^2 theta."""
    s = math.sqrt(sine2)
    grazing = _CAP * mu / (1.0 + s) + s * s - (2.0 / 3.0) * s * (1.0 + s + s * s) / (1.0 + s)
    d: float = INV_PI * (mu * grazing + s * arctan(mu, s))
    return d


@jit.model
def eon_f_r(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float, p: list[float]) -> float:
    albedo, r = p[0], p[1]
    lit = (zi > 0.0) & (zr > 0.0)
    mu_i = zi if lit else 1.0
    mu_r = zr if lit else 1.0
    a = 1.0 / (1.0 + K_1 * r)
    s = xi * xr + yi * yr
    largest = mu_i if mu_i > mu_r else mu_r
    # 1 + s = (|(wi + wr)_xy|^2 + mu_i^2 + mu_r^2) / 2
    x, y = xi + xr, yi + yr
    behind = 1.0 - r + r * 0.5 * (x * x + y * y + mu_i * mu_i + mu_r * mu_r)
    ahead = 1.0 + r * s / largest
    single = ahead if s > 0.0 else behind
    mean = a * (1.0 + K_2 * r)
    multiple = albedo * mean / (1.0 - albedo * (a * r * (K_1 - K_2)))  # 1 - mean = a r (K_1 - K_2)
    # (1 - E_i) (1 - E_r) / (1 - mean), over a
    again = r / (K_1 - K_2) * _left(mu_i, xi * xi + yi * yi) * _left(mu_r, xr * xr + yr * yr)
    value = albedo * INV_PI * a * (single + multiple * again)
    return value if lit else 0.0


EON = Model(
    name="eon",
    parameters=(
        Parameter("albedo", 0.0, 1.0, "albedo of the facets; at 1 no light is lost", ("uniform", 0.0, 1.0)),
        Parameter("roughness", 0.0, 1.0, "0 is Lambert's surface", ("uniform", 0.0, 1.0)),
    ),
    function=eon_f_r,
    doc="Energy-preserving Oren-Nayar surface: single scattering of Fujii's form, and the light it leaves over.",
    reference="Portsmouth, Kutz & Hill, JCGT 14(1), 2025",
    kinks=kinks,
)
