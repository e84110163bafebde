r"""Kubelka and Munk's infinitely thick layer of paint, diffuse in all directions; Saunderson's correction for its surface.

.. math::
    R_\infty = 1 + \kappa - \sqrt{\kappa(\kappa+2)}, \quad \kappa = K/S, \qquad
    \pi f_r = k_1 + \frac{(1-k_1)(1-k_2)\,R_\infty}{1 - k_2 R_\infty} ,

k_1 being the share of the incident light that the surface throws back before it enters, k_2 the share of the light from
within that it throws back inwards. Both 0, the default, leave the layer without a surface. k_1 is spread here like the rest;
with the gloss in a term of its own, (1 - k_1) times the model with k_1 = 0 is what remains.

Written without the difference of two large numbers, :math:`R_\infty = 1/(1+\kappa+\sqrt{\kappa(\kappa+2)})`. One level of
reflectance tells K/S only, not K and S.

References
----------
.. [1] P. Kubelka, F. Munk, "Ein Beitrag zur Optik der Farbanstriche", Zeitschrift fuer technische Physik 12, 1931.
.. [2] P. Kubelka, "New Contributions to the Optics of Intensely Light-Scattering Materials. Part I", JOSA 38(5), 1948.
   doi:10.1364/JOSA.38.000448
.. [3] J. L. Saunderson, "Calculation of the Color of Pigmented Plastics", JOSA 32(12), 1942. doi:10.1364/JOSA.32.000727
"""

from __future__ import annotations

import math

from gonio import jit
from gonio.brdf.base import Model
from gonio.brdf.parameter import Parameter

INV_PI = 1.0 / math.pi


@jit.model
def kubelka_munk_f_r(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float, p: list[float]) -> float:
    k, k_1, k_2 = p[0], p[1], p[2]
    lost = k + math.sqrt(k * (k + 2.0))  # 1 / R - 1
    rho = k_1 + (1.0 - k_1) * (1.0 - k_2) / (1.0 - k_2 + lost)
    return rho * INV_PI if (zi > 0.0) & (zr > 0.0) else 0.0


KUBELKA_MUNK = Model(
    name="kubelka_munk",
    parameters=(
        Parameter("K_over_S", 0.0, 1e8, "absorption over scattering", ("log_normal", math.log(0.1), 2.0)),
        Parameter("k_1", 0.0, 1.0, "reflectance of the surface from outside", ("uniform", 0.0, 0.1), fixed=0.0, default=0.0),
        Parameter("k_2", 0.0, 0.99, "reflectance of the surface from within", ("uniform", 0.4, 0.7), fixed=0.0, default=0.0),
    ),
    function=kubelka_munk_f_r,
    doc="Infinitely thick layer of paint, diffuse; with k_1 and k_2 below a surface (Saunderson).",
    reference="Kubelka & Munk, Z. techn. Phys. 12, 1931; Saunderson, JOSA 32, 1942",
    diffuse=True,
)
