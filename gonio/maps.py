"""Reflectance maps on a grid of gradients: value, error, band of a posterior, file.

References
----------
.. [1] B. K. P. Horn, R. W. Sjoberg, "Calculating the Reflectance Map", MIT AI Memo 498, 1978, section 1 and Fig. 1.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gonio.brdf.base import BRDF
from gonio.errors import DatasetError, IntegrationError, ParameterError
from gonio.files import replace_atomically
from gonio.integrate import MapValues, reflectance_map
from gonio.source import Source

Array = NDArray[np.float64]
CONFIDENCE = 0.68
_QUANTILES = ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2)
_BAND_RTOL = 1e-4  # far below the width of any measured band


@dataclass(frozen=True)
class ReflectanceMap:
    """R(p, q) on a grid.

    Attributes
    ----------
    p, q : ndarray, shapes (n,) and (m,)
        Axes of the gradient dz/dx, dz/dy [1].
    value, error : ndarray, shape (m, n)
        Scene radiance [W m^-2 sr^-1] (per unit of the source's radiometric scale) and the integrator's error.
    band : ndarray, shape (2, m, n), or None
        Lower and upper end of the pointwise 68 % interval of the posterior.
    impulses : tuple of (p, q, weight)
        Delta functions, memo 15a.
    sources : tuple of (p, q)
        Gradients that face the beams of the source, for plots.
    attributes : mapping
    """

    p: Array
    q: Array
    value: Array
    error: Array
    band: Array | None = None
    impulses: tuple[tuple[float, float, float], ...] = ()
    sources: tuple[tuple[float, float], ...] = ()
    attributes: Mapping[str, str] = field(default_factory=dict)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write NetCDF-4; the file appears whole or not at all."""
        import xarray as xr

        unit = {"units": "W m-2 sr-1"}
        data: dict[str, Any] = {
            "R": (("q", "p"), self.value, {"long_name": "scene radiance as a function of surface gradient", **unit}),
            "R_error": (("q", "p"), self.error, {"long_name": "error of the integration", **unit}),
        }
        if self.band is not None:
            text = "ends of the pointwise 68 % interval of the posterior"
            data["R_band"] = (("quantile", "q", "p"), self.band, {"long_name": text, **unit})
        coordinates: dict[str, Any] = {
            "p": ("p", self.p, {"long_name": "surface gradient dz/dx", "units": "1"}),
            "q": ("q", self.q, {"long_name": "surface gradient dz/dy", "units": "1"}),
        }
        if self.band is not None:
            coordinates["quantile"] = ("quantile", np.array(_QUANTILES))
        attributes = {
            "Conventions": "CF-1.11 gonio-1",
            "title": "reflectance map",
            "impulses": json.dumps(self.impulses),
            "sources": json.dumps(self.sources),
            "attributes": json.dumps(dict(self.attributes)),
        }
        target = Path(path)
        data_set = xr.Dataset(data, coordinates, attributes)
        replace_atomically(target, lambda temporary: data_set.to_netcdf(temporary, engine="h5netcdf"))
        return target

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> ReflectanceMap:
        """Read what `save` wrote.

        Raises
        ------
        DatasetError
            If the file is no reflectance map.
        """
        import xarray as xr

        try:
            with xr.open_dataset(path, engine="h5netcdf") as data:
                band = data["R_band"].to_numpy() if "R_band" in data else None
                return cls(
                    data["p"].to_numpy(),
                    data["q"].to_numpy(),
                    data["R"].to_numpy(),
                    data["R_error"].to_numpy(),
                    band,
                    tuple((float(a), float(b), float(c)) for a, b, c in json.loads(data.attrs["impulses"])),
                    tuple((float(a), float(b)) for a, b in json.loads(data.attrs["sources"])),
                    {str(k): str(v) for k, v in json.loads(data.attrs["attributes"]).items()},
                )
        except FileNotFoundError:
            raise DatasetError(f"{path}: there is no such file; make it with: gonio map SCENE.toml --out {path}") from None
        except (OSError, KeyError, ValueError, TypeError) as exc:
            raise DatasetError(f"{path} is no reflectance map of gonio ({exc}); make it again with: gonio map") from exc


def compute(
    brdf: BRDF,
    source: Source,
    p: Array,
    q: Array,
    *,
    rtol: float = 1e-6,
    draws: Iterable[BRDF] = (),
    attributes: Mapping[str, str] | None = None,
    progress: Callable[[int], None] | None = None,
    tolerant: bool = False,
) -> tuple[ReflectanceMap, MapValues]:
    """Map of a BRDF on a grid, with the band of its posterior.

    Parameters
    ----------
    brdf : BRDF
    source : Source
    p, q : ndarray, shapes (n,) and (m,)
        Axes of the grid.
    rtol : float, optional
        Relative error requested of the integrator.
    draws : iterable of BRDF, optional
        Posterior draws; the band is their pointwise 16 and 84 % quantile.
    attributes : mapping, optional
    progress : callable, optional
        Called with the number of draws done.
    tolerant : bool, optional
        Keep a map whose tolerance was not met, with its honest ``error``, instead of raising.

    Returns
    -------
    ReflectanceMap, MapValues
        The map, and the integrator's own result with its plan.

    Raises
    ------
    IntegrationError
        If the tolerance is not met and `tolerant` is False.
    """
    if p.ndim != 1 or q.ndim != 1 or p.size < 2 or q.size < 2:
        raise ParameterError("a map needs two axes of at least two gradients each")
    values = _evaluate(brdf, source, p, q, rtol, tolerant)
    stack = []
    for count, draw in enumerate(draws, 1):
        stack.append(_evaluate(draw, source, p, q, max(rtol, _BAND_RTOL), True).value)
        if progress is not None:
            progress(count)
    band = np.quantile(np.array(stack), _QUANTILES, axis=0) if stack else None
    facing = tuple(
        (-part.direction[0] / part.direction[2], -part.direction[1] / part.direction[2])
        for part in source.parts
        if hasattr(part, "direction") and part.direction[2] > 0
    )
    made = ReflectanceMap(p, q, values.value, values.error, band, tuple(values.impulses), facing, dict(attributes or {}))
    return made, values


def _evaluate(brdf: BRDF, source: Source, p: Array, q: Array, rtol: float, tolerant: bool) -> MapValues:
    try:
        return reflectance_map(brdf, source, p[None, :], q[:, None], rtol=rtol)
    except IntegrationError as exc:
        if not tolerant or not isinstance(exc.best, MapValues):
            raise
        return exc.best
