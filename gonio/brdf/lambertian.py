"""Lambert's diffuse surface: the same radiance in all directions."""

from __future__ import annotations

import math

from gonio import jit
from gonio.brdf.base import Model
from gonio.brdf.parameter import Parameter

INV_PI = 1.0 / math.pi


@jit.model
def f_r(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float, p: list[float]) -> float:
    value = p[0] * INV_PI
    return value if (zi > 0.0) & (zr > 0.0) else 0.0


LAMBERTIAN = Model(
    name="lambertian",
    parameters=(Parameter("albedo", 0.0, 1.0, "directional-hemispherical reflectance", ("uniform", 0.0, 1.0)),),
    function=f_r,
    doc="f_r = albedo / pi.",
    reference="J. H. Lambert, Photometria, 1760",
    diffuse=True,
    factors=("albedo",),
)
