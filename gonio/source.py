r"""Light sources: distant, in viewer-oriented coordinates (z towards the viewer).

A source is a sum of parts. A part is a collimated beam (a delta function in direction), a radiance over a cap of directions
around an axis (a disk, a hemisphere, the whole sphere), or any other radiance field (`gonio.fields`). That is all the
integrator has to know. A point source at a finite distance is no part of a source: it becomes a beam where it falls.

References
----------
.. [1] B. K. P. Horn, R. W. Sjoberg, MIT AI Memo 498, 1978, sections 7 and 14.
.. [2] P. Moon, D. E. Spencer, "Illumination from a non-uniform sky", Illum. Eng. 37, 1942; CIE S 003/E-1996 (overcast sky).
"""

from __future__ import annotations

import difflib
import inspect
import math
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gonio.errors import GeometryError, ParameterError
from gonio.fields import EnvironmentMap, Field, FunctionField, Harmonics, Lobes
from gonio.geometry import unit_vector

Array = NDArray[np.float64]
ViewAxis = (0.0, 0.0, 1.0)
SMALLEST_DISK = 1e-8  # half angle [rad]


@dataclass(frozen=True)
class Collimated:
    """A beam from one direction.

    Attributes
    ----------
    direction : tuple of float, length 3
        Unit vector towards the source.
    irradiance : float
        On a plane normal to the beam, E_0 [W m^-2].
    """

    direction: tuple[float, float, float]
    irradiance: float


@dataclass(frozen=True)
class Cap:
    """Radiance over all directions within a half angle of an axis.

    Attributes
    ----------
    kind : str
    axis : tuple of float, length 3
        Unit vector.
    half_angle : float
        [rad]; pi is the whole sphere.
    radiance : float
        Scale of the radiance [W m^-2 sr^-1].
    profile : callable, optional
        Relative radiance of w . axis, shape (n,) -> (n,); None for a uniform cap.
    """

    kind: str
    axis: tuple[float, float, float]
    half_angle: float
    radiance: float
    profile: Callable[[Array], Array] | None = None

    def at(self, directions: Array) -> Array:
        """Radiance from directions (n, 3), 0 outside the cap."""
        along = directions @ np.array(self.axis)
        relative = np.ones_like(along) if self.profile is None else self.profile(along)
        if self.half_angle >= math.pi:
            return self.radiance * relative
        return np.where(along > math.cos(self.half_angle), self.radiance * relative, 0.0)


Part = Collimated | Cap | Field


class Source:
    """A sum of collimated beams, caps and fields. Functions of unit vectors, (n, 3) -> (n,), may be added as they are.

    Examples
    --------
    >>> sky = make("hemispherical", radiance=1.0)
    >>> float((sky + sky).radiance([0.0, 0.0, 1.0]))
    2.0
    """

    def __init__(self, parts: Iterable[Part]) -> None:
        self.parts = tuple(parts)
        if not self.parts:
            raise ParameterError("a source needs at least one part")

    @classmethod
    def of(cls, source: Source | Callable[[Array], ArrayLike]) -> Source:
        """The source itself, or a source made of a function.

        Raises
        ------
        ParameterError
            If it is neither.
        """
        return source if isinstance(source, Source) else function(source)

    @classmethod
    def from_callable(cls, radiance: Callable[[Array], ArrayLike], detail: float = 0.1) -> Source:
        """A source from a function of unit vectors; see `function`."""
        return function(radiance, detail)

    def __add__(self, other: Source | Callable[[Array], ArrayLike]) -> Source:
        if not (isinstance(other, Source) or callable(other)):
            return NotImplemented
        return Source(self.parts + Source.of(other).parts)

    def __radd__(self, other: Callable[[Array], ArrayLike]) -> Source:
        if not callable(other):
            return NotImplemented
        return Source(Source.of(other).parts + self.parts)

    def __repr__(self) -> str:
        return " + ".join("collimated" if isinstance(part, Collimated) else part.kind for part in self.parts)

    def radiance(self, direction: ArrayLike) -> Array:
        """Radiance arriving from directions; beams are delta functions and do not count.

        Parameters
        ----------
        direction : array_like, shape (..., 3)
            Unit vectors towards the source, viewer-oriented.

        Returns
        -------
        ndarray, shape (...)
            L_i [W m^-2 sr^-1].
        """
        w = np.asarray(direction, dtype=float)
        total = np.zeros(w.reshape(-1, 3).shape[0])
        for part in self.parts:
            if not isinstance(part, Collimated):
                total += part.at(w.reshape(-1, 3))
        return total.reshape(w.shape[:-1])


def collimated(theta: float, phi: float, irradiance: float = 1.0) -> Source:
    """A distant point source (memo, sections 7 and 14a).

    Parameters
    ----------
    theta, phi : float
        Direction towards the source [rad], viewer-oriented, 0 <= theta <= pi.
    irradiance : float
        E_0 on a plane normal to the beam [W m^-2].
    """
    return Source([Collimated(_direction(theta, phi), _amount("irradiance", irradiance))])


def uniform(radiance: float = 1.0) -> Source:
    """The same radiance from all directions of the sphere (memo, section 14b)."""
    return Source([Cap("uniform", ViewAxis, math.pi, _amount("radiance", radiance))])


def hemispherical(radiance: float = 1.0, axis: Sequence[float] = ViewAxis) -> Source:
    """The same radiance from all directions of a hemisphere (memo, section 14c, with the axis towards the viewer)."""
    return Source([Cap("hemispherical", _axis(axis), math.pi / 2, _amount("radiance", radiance))])


def disk(
    theta: float, phi: float, half_angle: float, radiance: float | None = None, irradiance: float | None = None
) -> Source:
    """A uniform disk such as the sun.

    Parameters
    ----------
    theta, phi : float
        Direction of the centre [rad].
    half_angle : float
        [rad], 1e-8 <= half_angle <= pi/2.
    radiance, irradiance : float
        One of the two: L_i, or the irradiance on the plane normal to the axis, pi L_i sin^2(half_angle).
    """
    if not (math.isfinite(half_angle) and SMALLEST_DISK <= half_angle <= math.pi / 2):
        raise ParameterError(
            f"disk: half_angle = {math.degrees(half_angle):g} degrees; choose {math.degrees(SMALLEST_DISK):.1g} to 90 "
            "degrees, or a collimated beam instead of a smaller disk"
        )
    if (radiance is None) == (irradiance is None):
        raise ParameterError("disk: give either radiance or irradiance")
    if radiance is None:
        radiance = _amount("irradiance", irradiance or 0.0) / (math.pi * math.sin(half_angle) ** 2)
    return Source([Cap("disk", _direction(theta, phi), half_angle, _amount("radiance", radiance))])


def overcast(zenith_radiance: float = 1.0, axis: Sequence[float] = ViewAxis) -> Source:
    """CIE standard overcast sky [2]_: L = L_z (1 + 2 u.w) / 3 above its horizon."""
    return Source([Cap("overcast", _axis(axis), math.pi / 2, _amount("zenith_radiance", zenith_radiance), _overcast)])


def _overcast(along: Array) -> Array:
    return (1.0 + 2.0 * along) / 3.0


def lobes(amplitude: ArrayLike, kappa: ArrayLike, theta: ArrayLike, phi: ArrayLike) -> Source:
    """Von Mises-Fisher lobes: sum of amplitude exp(kappa (mu.w - 1)).

    Parameters
    ----------
    amplitude, kappa, theta, phi : array_like, scalars or shape (k,)
        Peak radiance [W m^-2 sr^-1], concentration [1] in [0, 1e5], direction mu of the peak [rad].
    """
    return Source([Lobes.checked(amplitude, kappa, theta, phi)])


def environment_map(
    radiance: ArrayLike | str | os.PathLike[str], interpolation: str = "bilinear", channel: str = "luminance"
) -> Source:
    """Radiance sampled on a grid of directions; see `gonio.fields.EnvironmentMap`.

    Parameters
    ----------
    radiance : array_like, shape (n_theta, n_phi), or path
        At theta = (i + 1/2) pi / n_theta, phi = (j + 1/2) 2 pi / n_phi [W m^-2 sr^-1]; or an HDR, floating-point TIFF or NPY
        file of it.
    interpolation : {"bilinear", "smooth"}
        Smooth is a cubic spline, and faster to integrate to high accuracy.
    channel : {"luminance", "red", "green", "blue"}
        Of a colour image.
    """
    if isinstance(radiance, str | os.PathLike):
        from gonio.environment import read

        radiance = read(radiance, channel)
    return Source([EnvironmentMap.checked(radiance, interpolation)])


def spherical_harmonics(coefficients: ArrayLike) -> Source:
    """Real spherical harmonics, (l + 1)^2 coefficients in the order l^2 + l + m; see `gonio.fields.Harmonics`."""
    return Source([Harmonics.checked(coefficients)])


def function(radiance: Callable[[Array], ArrayLike], detail: float = 0.1) -> Source:
    """Any function of unit vectors, (n, 3) -> (n,) [W m^-2 sr^-1].

    Parameters
    ----------
    radiance : callable
        Must give finite values >= 0 for all directions of the sphere.
    detail : float
        Smallest angle over which it changes [rad]; a narrower lobe could be missed, and nothing could tell.
    """
    return Source([FunctionField.checked(radiance, detail)])


@dataclass(frozen=True)
class PointSource:
    """A small lamp at a finite distance (memo, section 3: the irradiance falls with the square of the distance).

    Attributes
    ----------
    position : tuple of float, length 3
        [m], viewer-oriented.
    intensity : float
        Radiant intensity, the same in all directions [W/sr].
    """

    position: tuple[float, float, float]
    intensity: float

    def beam_at(self, surface: Sequence[float]) -> Source:
        """The beam that a surface element at `surface` [m] receives: a collimated source of irradiance I / r^2."""
        ray = np.asarray(self.position) - np.asarray(surface, dtype=float)
        squared = float(ray @ ray) if ray.shape == (3,) else math.nan
        if not (math.isfinite(squared) and squared > 0):
            raise GeometryError(f"point: no distance between lamp {self.position} and surface {list(surface)} m")
        x, y, z = ray / math.sqrt(squared)
        return Source([Collimated((float(x), float(y), float(z)), self.intensity / squared)])

    def irradiance(self, surface: Sequence[float], normal: Sequence[float]) -> float:
        """E_i = I max(0, cos theta_i) / r^2 on a surface element with that normal [W m^-2]."""
        beam = self.beam_at(surface).parts[0]
        assert isinstance(beam, Collimated)
        return beam.irradiance * max(0.0, float(np.dot(beam.direction, _axis(normal))))


def point(position: Sequence[float], intensity: float) -> PointSource:
    """A lamp at a finite distance: position [m] in viewer-oriented coordinates, radiant intensity [W/sr]."""
    where = np.asarray(position, dtype=float)
    if where.shape != (3,) or not np.all(np.isfinite(where)):
        raise GeometryError(f"point: position = {list(position)} is no place; give three finite numbers in metres")
    return PointSource((float(where[0]), float(where[1]), float(where[2])), _amount("intensity", intensity))


_KINDS: dict[str, Callable[..., Source]] = {
    f.__name__: f
    for f in (
        collimated, uniform, hemispherical, disk, overcast, lobes, environment_map, spherical_harmonics, function,
    )
}  # fmt: skip


def make(kind: str, **parameters: object) -> Source:
    """A source by name; see the function of that name for its parameters.

    Raises
    ------
    ParameterError
        If the kind or a parameter is unknown, missing or outside its range.
    """
    if kind not in _KINDS:
        near = difflib.get_close_matches(kind, list(_KINDS), 1)
        hint = f" (did you mean {near[0]!r}?)" if near else ""
        raise ParameterError(f"there is no source kind {kind!r}{hint}; known are: {', '.join(sorted(_KINDS))}")
    signature = inspect.signature(_KINDS[kind])
    unknown = [name for name in parameters if name not in signature.parameters]
    if unknown:
        raise ParameterError(f"{kind} has no parameter {unknown[0]!r}; it has: {', '.join(signature.parameters)}")
    missing = [n for n, p in signature.parameters.items() if p.default is inspect.Parameter.empty and n not in parameters]
    if missing:
        raise ParameterError(f"{kind} needs {', '.join(missing)} as well")
    for name, value in parameters.items():
        _check_type(f"{kind}: {name}", value, str(signature.parameters[name].annotation))
    return _KINDS[kind](**parameters)


def _check_type(what: str, value: object, annotation: str) -> None:
    """What is no number is told by name; environment maps and functions look at theirs themselves."""
    try:
        if annotation == "float" or (annotation == "float | None" and value is not None):
            float(value)  # type: ignore[arg-type]
        elif annotation in ("ArrayLike", "Sequence[float]"):
            np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        noun = "number" if annotation.startswith("float") else "number or list of numbers"
        raise ParameterError(f"{what} = {value!r} is no {noun}") from None


def _direction(theta: float, phi: float) -> tuple[float, float, float]:
    if not (math.isfinite(theta) and math.isfinite(phi) and 0 <= theta <= math.pi):
        raise GeometryError(
            f"source at theta = {math.degrees(theta):g}, phi = {math.degrees(phi):g} degrees; "
            "choose 0 <= theta <= 180 degrees and a finite phi"
        )
    x, y, z = unit_vector(theta, phi)
    return float(x), float(y), float(z)


def _axis(axis: Sequence[float]) -> tuple[float, float, float]:
    vector = np.asarray(axis, dtype=float)
    if vector.shape != (3,) or not np.all(np.isfinite(vector)) or not np.any(vector):
        raise GeometryError(f"axis = {list(axis)} is no direction; give three finite numbers, not all zero")
    vector = vector / np.max(np.abs(vector))  # so that the squares neither vanish nor overflow
    x, y, z = vector / np.linalg.norm(vector)
    return float(x), float(y), float(z)


def _amount(name: str, value: float) -> float:
    if not (math.isfinite(value) and value >= 0):
        raise ParameterError(f"{name} = {value:g} is not possible; give a finite number >= 0")
    return float(value)
