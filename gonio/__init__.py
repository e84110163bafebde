"""gonio: angles and light go in, images come out, and every step from image to reflectance map carries its error.

Public names are imported when first used, so that ``gonio --help`` loads no numerical package.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gonio import brdf as brdf
    from gonio import geometry as geometry
    from gonio import halfdiff as halfdiff
    from gonio import source as source
    from gonio.brdf.base import BRDF as BRDF
    from gonio.integrate import directional_albedo as directional_albedo
    from gonio.integrate import reflectance_map as reflectance_map
    from gonio.integrate.imaging import image_irradiance as image_irradiance
    from gonio.integrate.imaging import irradiance as irradiance
    from gonio.integrate.reflectances import HEMISPHERE as HEMISPHERE
    from gonio.integrate.reflectances import Cone as Cone
    from gonio.integrate.reflectances import Direction as Direction
    from gonio.integrate.reflectances import reflectance as reflectance
    from gonio.integrate.reflectances import reflectance_factor as reflectance_factor
    from gonio.maps import ReflectanceMap as ReflectanceMap
    from gonio.posterior import Posterior as Posterior
    from gonio.samples import BRDFSamples as BRDFSamples

__version__ = "0.1.0"

_MODULES = {"brdf", "geometry", "halfdiff", "source"}
_NAMES = {
    "BRDF": "gonio.brdf.base",
    "BRDFSamples": "gonio.samples",
    "Cone": "gonio.integrate.reflectances",
    "Direction": "gonio.integrate.reflectances",
    "HEMISPHERE": "gonio.integrate.reflectances",
    "Posterior": "gonio.posterior",
    "ReflectanceMap": "gonio.maps",
    "directional_albedo": "gonio.integrate",
    "image_irradiance": "gonio.integrate.imaging",
    "irradiance": "gonio.integrate.imaging",
    "reflectance": "gonio.integrate.reflectances",
    "reflectance_factor": "gonio.integrate.reflectances",
    "reflectance_map": "gonio.integrate",
}
__all__ = [
    "BRDF",
    "HEMISPHERE",
    "BRDFSamples",
    "Cone",
    "Direction",
    "Posterior",
    "ReflectanceMap",
    "brdf",
    "directional_albedo",
    "geometry",
    "halfdiff",
    "image_irradiance",
    "irradiance",
    "reflectance",
    "reflectance_factor",
    "reflectance_map",
    "source",
]


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return importlib.import_module(f"gonio.{name}")
    if name in _NAMES:
        return getattr(importlib.import_module(_NAMES[name]), name)
    raise AttributeError(f"module 'gonio' has no attribute {name!r}")
