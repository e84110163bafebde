"""Reflectance maps R(p, q) as things to use: evaluate, draw contours, render a surface, read gradients off radiances.

>>> import math
>>> import numpy as np
>>> import gonio
>>> paper = gonio.brdf.make("lambertian", albedo=1.0)
>>> lamp = gonio.source.make("collimated", theta=0.0, phi=0.0, irradiance=math.pi)
>>> axis = np.linspace(-2.0, 2.0, 65)
>>> made, _ = compute(paper, lamp, axis, axis)
>>> round(float(made.evaluate(0.75, 1.0).value), 12) == round(1.0 / math.sqrt(2.5625), 12)
True
"""

from __future__ import annotations

from gonio.maps.grid import CONFIDENCE, ReflectanceMap, compute
from gonio.maps.lines import contour_lines
from gonio.maps.stereo import Gradients, Status, gradients_of
from gonio.maps.surface import gradients_of_heights, gradients_of_normals

__all__ = [
    "CONFIDENCE",
    "Gradients",
    "ReflectanceMap",
    "Status",
    "compute",
    "contour_lines",
    "gradients_of",
    "gradients_of_heights",
    "gradients_of_normals",
]
