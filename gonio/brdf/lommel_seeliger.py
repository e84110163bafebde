r"""Lommel and Seeliger's dark, deep cloud: single scattering, the same in all directions.

.. math:: f_r = \frac{w}{4\pi}\,\frac{1}{\mu_i + \mu_r}

w is the share of the light that one scattering leaves over. The directional albedo,
:math:`\tfrac{w}{2}\bigl(1 - \mu_r\ln\frac{1+\mu_r}{\mu_r}\bigr)`, is below w / 2. The limit of Hapke's model for small w.

References
----------
.. [1] H. Seeliger, "Zur Photometrie zerstreut reflectirender Substanzen", Sitzungsberichte der math.-phys. Classe der k. b.
   Akademie der Wissenschaften zu Muenchen 18, 1888.
.. [2] B. Hapke, "Bidirectional reflectance spectroscopy: 1. Theory", J. Geophys. Res. 86(B4), 1981.
   doi:10.1029/JB086iB04p03039
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.brdf.base import Model
from gonio.brdf.parameter import Parameter

Array = NDArray[np.float64]
INV_FOUR_PI = 0.25 / math.pi


@jit.model
def lommel_seeliger_f_r(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float, p: list[float]) -> float:
    lit = (zi > 0.0) & (zr > 0.0)
    total = zi + zr if lit else 1.0
    return p[0] * INV_FOUR_PI / total if lit else 0.0


def _width(p: Array) -> float:
    """No lobe; seen at a grazing angle, f_r is a layer at the horizon, which lobes have too."""
    return 1.0


LOMMEL_SEELIGER = Model(
    name="lommel_seeliger",
    parameters=(Parameter("w", 0.0, 1.0, "single-scattering albedo", ("uniform", 0.0, 1.0)),),
    function=lommel_seeliger_f_r,
    factors=("w",),
    doc="w / (4 pi) / (cos theta_i + cos theta_r): single scattering in a deep layer.",
    reference="Seeliger, Sitzungsber. Akad. Wiss. Muenchen 18, 1888; Hapke, J. Geophys. Res. 86, 1981",
    lobe_width=_width,
)
