"""A reflectance map on a grid of gradients: value, error, band of a posterior; anywhere between; image; file.

It knows no picture and no device. What it returns between the points of its grid it computes anew, if it knows its scene.

References
----------
.. [1] B. K. P. Horn, R. W. Sjoberg, "Calculating the Reflectance Map", MIT AI Memo 498, 1978, section 1 and Fig. 1.
"""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gonio.brdf.base import BRDF
from gonio.errors import DatasetError, GeometryError, IntegrationError, ParameterError
from gonio.files import replace_atomically
from gonio.integrate import Estimate, MapValues, reflectance_map
from gonio.maps import surface
from gonio.maps.band import band_of
from gonio.maps.interpolation import Interpolant
from gonio.source import Cap, Collimated, Source

Array = NDArray[np.float64]
Method = Literal["auto", "integrate", "interpolate"]
CONFIDENCE = 0.68
_QUANTILES = ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2)
_SMALL = 0.02  # half angle of a disk [rad] below which it is drawn as a beam is
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
        Gradients that face beams and small disks of the source, for plots.
    attributes : mapping
    brdf, source : BRDF and Source, optional
        The scene, where it is known: `compute` fills them in, a file does not keep them. With them the map is exact
        anywhere; ``dataclasses.replace(map, brdf=..., source=...)`` gives them to a loaded map.
    viewer : (theta, phi), optional
        Direction of a viewer off the z axis [rad].
    tangent : float, optional
        Rotation of a grained surface's x axis about its normal [rad], the same for all gradients.
    band_error : ndarray, shape (m, n), optional
        Of both ends of the band, as quantiles of the draws it was made of.
    band_whole : ndarray, shape (2, m, n), optional
        Simultaneous band: the whole map lies inside with a probability of 95 % (`gonio.maps.simultaneous`).
    """

    p: Array
    q: Array
    value: Array
    error: Array
    band: Array | None = None
    impulses: tuple[tuple[float, float, float], ...] = ()
    sources: tuple[tuple[float, float], ...] = ()
    attributes: Mapping[str, str] = field(default_factory=dict)
    brdf: BRDF | None = field(default=None, repr=False, compare=False)
    source: Source | None = field(default=None, repr=False, compare=False)
    viewer: tuple[float, float] | None = None
    tangent: float | None = None
    band_error: Array | None = None
    band_whole: Array | None = None

    @property
    def has_scene(self) -> bool:
        """Whether BRDF and source are known."""
        return self.brdf is not None and self.source is not None

    @functools.cached_property
    def interpolant(self) -> Interpolant:
        """R between the points of the grid."""
        return Interpolant(self.p, self.q, self.value[None], self.error[None])

    def evaluate(self, p: ArrayLike, q: ArrayLike, *, rtol: float = 1e-6, method: Method = "auto") -> Estimate:
        """R at any gradients, without the impulses.

        Parameters
        ----------
        p, q : array_like, shapes broadcast to (...)
            Surface gradient [1].
        rtol : float, optional
            Relative error requested of the integrator; interpolation is as good as the grid.
        method : {"auto", "integrate", "interpolate"}, optional
            Through the integrator, from the grid, or through the integrator where the scene is known.

        Returns
        -------
        Estimate
            ``value`` and ``error``, shape (...) [W m^-2 sr^-1]. The error of an interpolated value covers
            structures that the grid resolves; what is narrower than its spacing it cannot know.

        Raises
        ------
        GeometryError
            If a gradient is NaN, or outside the axes of a map whose scene is not known.
        ParameterError
            If ``"integrate"`` is asked for and the scene is not known.
        IntegrationError
            If `rtol` is not met; ``exc.best`` is what was reached.
        """
        p, q = np.broadcast_arrays(np.asarray(p, dtype=float), np.asarray(q, dtype=float))
        if self._integrates(method):
            assert self.brdf is not None and self.source is not None
            exact = reflectance_map(self.brdf, self.source, p, q, rtol=rtol, viewer=self.viewer, tangent=self.tangent)
            return Estimate(exact.value, exact.error, error_is_bound=exact.error_is_bound)
        if np.any(np.isnan(p)) or np.any(np.isnan(q)):
            raise GeometryError("a gradient is NaN: give finite p and q")
        self.interpolant  # noqa: B018  checks axes and shapes
        for name, x, axis in (("p", p, self.p), ("q", q, self.q)):
            outside = (x < axis[0]) | (x > axis[-1])
            if np.any(outside):
                raise GeometryError(
                    f"{name} = {x[outside].flat[0]:g} is outside the map, which goes from {axis[0]:g} to {axis[-1]:g}; "
                    "make a larger map, or give this one its brdf and source"
                )
        return self._at(p, q, method, rtol)

    def render_heights(
        self, z: ArrayLike, spacing: float | Sequence[float], *, rtol: float = 1e-6, method: Method = "auto"
    ) -> Estimate:
        """Image of a surface given by its heights: the radiance of every point, seen from +z.

        Points do not occlude, shadow or light each other; the error is that of R, not that of the differences.

        Parameters
        ----------
        z : array_like, shape (m, n)
            Heights at x = i dx, y = j dy (column i, row j), in the unit of `spacing`. NaN where there is no surface.
        spacing : float or (dx, dy)
            dy < 0 where the first row is the upper edge.
        rtol, method
            As in `evaluate`.

        Returns
        -------
        Estimate
            ``value`` and ``error``, shape (m, n) [W m^-2 sr^-1]; NaN beside missing heights, and where the slope is
            outside the axes of a map whose scene is not known.
        """
        return self._image(*surface.gradients_of_heights(z, spacing), method, rtol)

    def render_normals(self, normals: ArrayLike, *, rtol: float = 1e-6, method: Method = "auto") -> Estimate:
        """Image of a surface given by its normals.

        Parameters
        ----------
        normals : array_like, shape (..., 3)
            Viewer-oriented, of any length.
        rtol, method
            As in `evaluate`.

        Returns
        -------
        Estimate
            Shape (...) [W m^-2 sr^-1]; NaN where a normal is not finite or does not point to the viewer's side, and
            where the slope is outside the axes of a map whose scene is not known.
        """
        return self._image(*surface.gradients_of_normals(normals), method, rtol)

    def contours(
        self, levels: ArrayLike | int = 10, *, rtol: float = 1e-6, method: Method = "auto"
    ) -> dict[float, list[Array]]:
        """Lines of constant R (Fig. 1 of the memo [1]_); see `gonio.maps.lines.contour_lines`."""
        from gonio.maps import lines

        return lines.contour_lines(self, levels, rtol=rtol, method=method)

    def _integrates(self, method: str) -> bool:
        if method not in ("auto", "integrate", "interpolate"):
            raise ParameterError(f"method = {method!r}; choose 'auto', 'integrate' or 'interpolate'")
        if method == "integrate" and not self.has_scene:
            raise ParameterError(
                "this map does not know its brdf and source; interpolate, or make it with gonio.maps.compute"
            )
        return method != "interpolate" and self.has_scene

    def _image(self, p: Array, q: Array, method: Method, rtol: float) -> Estimate:
        """`_at` where the gradient is a number, NaN elsewhere."""
        seen = ~(np.isnan(p) | np.isnan(q))
        value, error = np.full(p.shape, np.nan), np.full(p.shape, np.nan)
        part = self._at(p[seen], q[seen], method, rtol)
        value[seen], error[seen] = part.value, part.error
        return Estimate(value, error, error_is_bound=part.error_is_bound)

    def _at(self, p: Array, q: Array, method: Method, rtol: float) -> Estimate:
        """Value and honest error, whether or not the tolerance is met; NaN outside a map without a scene."""
        if self._integrates(method):
            assert self.brdf is not None and self.source is not None
            best = _evaluate(self.brdf, self.source, p, q, True, rtol=rtol, viewer=self.viewer, tangent=self.tangent)
            return Estimate(best.value, best.error, error_is_bound=best.error_is_bound)
        value, _, error = self.interpolant(p.ravel(), q.ravel())
        return Estimate(value[:, 0].reshape(p.shape), error[:, 0].reshape(p.shape), error_is_bound=False)

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
        if self.band_error is not None:
            data["R_band_error"] = (("q", "p"), self.band_error, {"long_name": "error of the band", **unit})
        if self.band_whole is not None:
            text = "ends of the band that holds the whole map with a probability of 95 %"
            data["R_band_whole"] = (("end", "q", "p"), self.band_whole, {"long_name": text, **unit})
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
            "view": json.dumps({"viewer": self.viewer, "tangent": self.tangent}),
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
                view = json.loads(data.attrs.get("view", "{}"))
                viewer, tangent = view.get("viewer"), view.get("tangent")
                return cls(
                    data["p"].to_numpy(),
                    data["q"].to_numpy(),
                    data["R"].to_numpy(),
                    data["R_error"].to_numpy(),
                    band,
                    tuple((float(a), float(b), float(c)) for a, b, c in json.loads(data.attrs["impulses"])),
                    tuple((float(a), float(b)) for a, b in json.loads(data.attrs["sources"])),
                    {str(k): str(v) for k, v in json.loads(data.attrs["attributes"]).items()},
                    viewer=None if viewer is None else (float(viewer[0]), float(viewer[1])),
                    tangent=None if tangent is None else float(tangent),
                    band_error=data["R_band_error"].to_numpy() if "R_band_error" in data else None,
                    band_whole=data["R_band_whole"].to_numpy() if "R_band_whole" in data else None,
                )
        except FileNotFoundError:
            raise DatasetError(f"{path}: there is no such file; make it with: gonio map SCENE.toml --out {path}") from None
        except (OSError, KeyError, ValueError, TypeError) as exc:
            raise DatasetError(f"{path} is no reflectance map of gonio ({exc}); make it again with: gonio map") from exc


def compute(
    brdf: BRDF,
    source: Source | Callable[[Array], ArrayLike],
    p: Array,
    q: Array,
    *,
    rtol: float = 1e-6,
    atol: float = 0.0,
    viewer: tuple[float, float] | None = None,
    tangent: float | None = None,
    draws: Iterable[BRDF] = (),
    attributes: Mapping[str, str] | None = None,
    progress: Callable[[int], None] | None = None,
    tolerant: bool = False,
) -> tuple[ReflectanceMap, MapValues]:
    """Map of a BRDF on a grid, with the band of its posterior.

    Parameters
    ----------
    brdf : BRDF
    source : Source or callable
    p, q : ndarray, shapes (n,) and (m,)
        Axes of the grid.
    rtol, atol : float, optional
        Relative and absolute [W m^-2 sr^-1] error requested of the integrator.
    viewer, tangent : optional
        As for `gonio.reflectance_map`; the grain is rotated by the same angle [rad] at all gradients.
    draws : iterable of BRDF, optional
        Posterior draws; the band is their pointwise 16 and 84 % quantile (`gonio.maps.band`).
    attributes : mapping, optional
    progress : callable, optional
        Called with rising numbers; the last is that of the draws.
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
    source, p_all, q_all = Source.of(source), p[None, :], q[:, None]
    scene: dict[str, Any] = {"atol": atol, "viewer": viewer, "tangent": tangent}
    values = _evaluate(brdf, source, p_all, q_all, tolerant, rtol=rtol, **scene)
    coarse = {**scene, "rtol": max(rtol, _BAND_RTOL)}
    sample = list(draws)
    band = None
    if sample:
        band = band_of(
            sample,
            _QUANTILES,
            lambda draw: _evaluate(draw, source, p_all, q_all, True, **coarse),
            rtol=coarse["rtol"],
            progress=progress,
        )
    facing = tuple((-axis[0] / axis[2], -axis[1] / axis[2]) for axis in _small_sources(source) if axis[2] > 0)
    made = ReflectanceMap(
        p, q, values.value, values.error, None if band is None else band.value, tuple(values.impulses), facing,
        dict(attributes or {}), brdf, source, viewer, tangent, None if band is None else band.error,
        None if band is None else band.whole,
    )  # fmt: skip
    return made, values


def _small_sources(source: Source) -> list[tuple[float, float, float]]:
    """Directions of what shines from about one direction."""
    beams = [part.direction for part in source.parts if isinstance(part, Collimated) and part.irradiance > 0]
    disks = [part.axis for part in source.parts if isinstance(part, Cap) and part.half_angle < _SMALL and part.radiance > 0]
    return beams + disks


def _evaluate(brdf: BRDF, source: Source, p: Array, q: Array, tolerant: bool, **scene: Any) -> MapValues:
    try:
        return reflectance_map(brdf, source, p, q, **scene)
    except IntegrationError as exc:
        if not tolerant or not isinstance(exc.best, MapValues):
            raise
        return exc.best
