r"""Radiance fields: light from all directions that is not a cap around an axis.

======================  ====================================================================================
`Lobes`                 sum of von Mises-Fisher lobes, :math:`\sum_k a_k\,e^{\kappa_k(\mu_k\cdot\omega-1)}`
`EnvironmentMap`        samples on a grid of polar angle and azimuth, bilinear or by cubic splines
`Harmonics`             real spherical harmonics
`FunctionField`         a user's function of unit vectors
======================  ====================================================================================

A field is a part of a `gonio.source.Source`; make it there. Directions are viewer-oriented (z towards the viewer). A field
has no delta functions, and nothing here integrates.

References
----------
.. [1] R. A. Fisher, "Dispersion on a Sphere", Proc. R. Soc. A 217, 1953.
.. [2] C. de Boor, A Practical Guide to Splines, Springer, 1978 (cubic splines through equidistant samples).
.. [3] P.-P. Sloan, "Stupid Spherical Harmonics (SH) Tricks", GDC 2008, appendix A2 (real harmonics and their signs).
"""

from __future__ import annotations

import functools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gonio import texels
from gonio.errors import GeometryError, ParameterError
from gonio.geometry import unit_vector

Array = NDArray[np.float64]
KAPPA_MAX = 1e5
MAX_PIXELS = 1 << 26
MAX_DEGREE = 200


class Field(ABC):
    """Radiance as a function of direction.

    Attributes
    ----------
    kind : str
    radiance : float
        A scale of it [W m^-2 sr^-1]; 0 only if the field is dark everywhere.
    detail : float
        Smallest angle over which it changes noticeably [rad].
    """

    kind: str
    radiance: float
    detail: float

    @abstractmethod
    def at(self, directions: Array) -> Array:
        """Radiance [W m^-2 sr^-1] from unit vectors, shape (n, 3) -> (n,)."""


@dataclass(frozen=True, eq=False)
class Lobes(Field):
    """Von Mises-Fisher lobes [1]_.

    Attributes
    ----------
    amplitude, kappa, theta, phi : ndarray, shape (k,)
        Peak radiance [W m^-2 sr^-1], concentration [1], direction of the peak [rad].
    """

    amplitude: Array
    kappa: Array
    theta: Array
    phi: Array
    kind: str = field(default="lobes", init=False)

    @classmethod
    def checked(cls, amplitude: ArrayLike, kappa: ArrayLike, theta: ArrayLike, phi: ArrayLike) -> Lobes:
        """Lobes from scalars or arrays that broadcast to (k,)."""
        given = dict(zip(("amplitude", "kappa", "theta", "phi"), (amplitude, kappa, theta, phi), strict=True))
        arrays = {name: np.atleast_1d(np.asarray(value, dtype=float)) for name, value in given.items()}
        for name, array in arrays.items():
            if array.ndim != 1 or array.size == 0:
                raise ParameterError(f"lobes: {name} has shape {array.shape}; give a number or a list of numbers")
            if not np.all(np.isfinite(array)):
                raise ParameterError(f"lobes: {name} = {array[~np.isfinite(array)][0]:g} is not finite")
        try:
            a, k, t, f = np.broadcast_arrays(*arrays.values())
        except ValueError:
            sizes = ", ".join(f"{len(array)} {name}" for name, array in arrays.items())
            raise ParameterError(f"lobes: {sizes} do not go together; give as many of each, or one") from None
        if np.any(a < 0):
            raise ParameterError(f"lobes: amplitude = {a.min():g} is negative; radiance is >= 0")
        if np.any((k < 0) | (k > KAPPA_MAX)):
            worst = k[(k < 0) | (k > KAPPA_MAX)][0]
            raise ParameterError(f"lobes: kappa = {worst:g}; choose 0 <= kappa <= {KAPPA_MAX:g}, beyond that a small disk")
        if np.any((t < 0) | (t > np.pi)):
            worst = t[(t < 0) | (t > np.pi)][0]
            raise GeometryError(f"lobes: theta = {math.degrees(worst):g} degrees; choose 0 <= theta <= 180 degrees")
        return cls(a.copy(), k.copy(), t.copy(), f.copy())

    @property
    def radiance(self) -> float:  # type: ignore[override]
        return float(self.amplitude.sum())

    @property
    def detail(self) -> float:  # type: ignore[override]
        return float(1.0 / np.sqrt(max(1.0, self.kappa.max())))

    def axes(self) -> Array:
        """Unit vectors of the peaks, shape (k, 3)."""
        return unit_vector(self.theta, self.phi)

    def at(self, directions: Array) -> Array:
        total = np.zeros(len(directions))
        for a, k, mu in zip(self.amplitude, self.kappa, self.axes(), strict=True):
            if a > 0.0:
                # mu.w - 1 = -|w - mu|^2 / 2, which does not cancel at the peak
                offset = directions - mu
                total += a * np.exp(-0.5 * k * np.einsum("ij,ij->i", offset, offset))
        return total


@dataclass(frozen=True, eq=False)
class EnvironmentMap(Field):
    """Radiance sampled at theta = (i + 1/2) pi / n_theta, phi = (j + 1/2) 2 pi / n_phi, row 0 around the viewer's axis.

    Bilinear in (theta, phi): periodic in phi, constant in theta beyond the first and the last row. Smooth: a cubic spline
    in both [2]_, periodic in phi and continued across the poles on the opposite meridian; it goes through the samples, is
    twice differentiable, and overshoots, also below 0, next to jumps.

    Attributes
    ----------
    samples : ndarray, shape (n_theta, n_phi)
        [W m^-2 sr^-1].
    interpolation : str
        ``"bilinear"`` or ``"smooth"``.
    """

    samples: Array
    interpolation: str = "bilinear"
    kind: str = field(default="environment_map", init=False)

    @classmethod
    def checked(cls, samples: ArrayLike, interpolation: str = "bilinear") -> EnvironmentMap:
        """A map from an array, copied."""
        array = np.array(samples, dtype=float, order="C")
        if interpolation not in ("bilinear", "smooth"):
            raise ParameterError(f"environment_map: interpolation = {interpolation!r}; choose 'bilinear' or 'smooth'")
        if array.ndim != 2 or array.size == 0 or array.size > MAX_PIXELS:
            raise ParameterError(
                f"environment_map: radiance has shape {array.shape}; give (n_theta, n_phi) with at most {MAX_PIXELS} samples"
            )
        if not np.all(np.isfinite(array)):
            i, j = np.argwhere(~np.isfinite(array))[0]
            raise ParameterError(f"environment_map: radiance[{i}, {j}] = {array[i, j]:g}; every sample must be finite")
        if np.any(array < 0):
            i, j = np.argwhere(array < 0)[0]
            raise ParameterError(f"environment_map: radiance[{i}, {j}] = {array[i, j]:g} is negative; radiance is >= 0")
        if interpolation == "smooth" and (array.shape[1] % 2 or array.shape[1] < 4 or array.shape[0] < 2):
            raise ParameterError(
                f"environment_map: radiance has shape {array.shape}; smooth interpolation across the poles needs an even "
                "number of columns, at least 4, and at least 2 rows"
            )
        array.setflags(write=False)
        return cls(array, interpolation)

    @property
    def radiance(self) -> float:  # type: ignore[override]
        return float(self.samples.max())

    @property
    def detail(self) -> float:  # type: ignore[override]
        n_theta, n_phi = self.samples.shape
        return float(min(np.pi / n_theta, 2.0 * np.pi / n_phi))

    def at(self, directions: Array) -> Array:
        out, given = np.empty(len(directions)), np.ascontiguousarray(directions)
        if self.interpolation == "bilinear":
            texels.bilinear(given, self.samples, out)
        else:
            texels.smooth(given, self.control_points, out)
        return out

    @functools.cached_property
    def control_points(self) -> Array:
        """B-spline coefficients of the smooth map, rows -2 to n_theta + 1, shape (n_theta + 4, n_phi)."""
        n_theta, n_phi = self.samples.shape
        # the whole great circle: down one meridian, up the opposite one, is periodic with 2 n_theta samples
        circles = np.concatenate((self.samples, np.roll(self.samples, n_phi // 2, axis=1)[::-1]))
        spectrum = np.fft.rfft2(circles)
        m, k = np.arange(n_phi // 2 + 1) / n_phi, np.arange(2 * n_theta) / (2 * n_theta)
        spectrum /= sampled_b_spline(k)[:, None] * sampled_b_spline(m)[None, :]
        whole = np.fft.irfft2(spectrum, circles.shape)
        control: Array = np.concatenate((whole[-2:], whole[: n_theta + 2]))
        return control


def sampled_b_spline(frequency: Array) -> Array:
    """Transfer function of the cubic B-spline sampled at its knots, (1, 4, 1) / 6; frequency in cycles per sample."""
    transfer: Array = (4.0 + 2.0 * np.cos(2.0 * np.pi * frequency)) / 6.0
    return transfer


@dataclass(frozen=True, eq=False)
class Harmonics(Field):
    r"""Real, orthonormal spherical harmonics up to a degree, with the signs of [3]_ (Y_11 ~ +x, Y_1-1 ~ +y, Y_10 ~ +z).

    Attributes
    ----------
    coefficients : ndarray, shape ((degree + 1)^2,)
        Of Y_lm at index l^2 + l + m [W m^-2 sr^-1].
    """

    coefficients: Array
    kind: str = field(default="spherical_harmonics", init=False)

    @classmethod
    def checked(cls, coefficients: ArrayLike) -> Harmonics:
        """Harmonics whose radiance is nowhere negative (looked at on a grid finer than their waves)."""
        array = np.array(coefficients, dtype=float)
        degree = math.isqrt(max(array.size, 1)) - 1
        if array.ndim != 1 or array.size != (degree + 1) ** 2 or degree > MAX_DEGREE:
            raise ParameterError(
                f"spherical_harmonics: {array.size} coefficients in shape {array.shape}; give (l + 1)^2 in one list, "
                f"l <= {MAX_DEGREE}"
            )
        if not np.all(np.isfinite(array)):
            raise ParameterError(f"spherical_harmonics: coefficient {int(np.argmin(np.isfinite(array)))} is not finite")
        made = cls(array)
        n = 4 * degree + 5
        theta, phi = np.meshgrid(np.pi * (np.arange(n) + 0.5) / n, 2 * np.pi * np.arange(2 * n) / (2 * n), indexing="ij")
        seen = made.at(unit_vector(theta.ravel(), phi.ravel()))
        lowest = int(np.argmin(seen))
        if seen[lowest] < -1e-12 * np.max(np.abs(seen)):
            raise ParameterError(
                f"spherical_harmonics: radiance {seen[lowest]:.6g} is negative at theta = "
                f"{math.degrees(theta.flat[lowest]):.4g}, phi = {math.degrees(phi.flat[lowest]):.4g} degrees; raise the "
                f"first coefficient by {-seen[lowest] * math.sqrt(4 * math.pi):.6g} or smooth the others"
            )
        return made

    @property
    def degree(self) -> int:
        return math.isqrt(self.coefficients.size) - 1

    @property
    def radiance(self) -> float:  # type: ignore[override]
        return float(np.linalg.norm(self.coefficients)) / math.sqrt(4.0 * math.pi)

    @property
    def detail(self) -> float:  # type: ignore[override]
        return 1.0 / (self.degree + 1.0)

    def at(self, directions: Array) -> Array:
        c, total = self.coefficients, np.zeros(len(directions))
        for l, m, cosine, sine in _harmonics(directions, self.degree):
            total += c[l * l + l + m] * cosine
            if m:
                total += c[l * l + l - m] * sine
        return total

    def turned(self, rotation: Array) -> Harmonics:
        """The same light in coordinates w' = rotation w, which is again harmonics of this degree.

        Coefficients are integrals of products of two harmonics over the sphere, which a Gauss rule in the height with
        equidistant azimuths gives exactly.
        """
        n = self.degree + 1
        height, weight = np.polynomial.legendre.leggauss(n)
        phi = 2.0 * np.pi * np.arange(2 * n) / (2 * n)
        w = unit_vector(np.arccos(height)[:, None], phi[None, :]).reshape(-1, 3)
        light = self.at(w @ rotation) * np.repeat(weight * (np.pi / n), 2 * n)
        coefficients = np.zeros(n * n)
        for l, m, cosine, sine in _harmonics(w, self.degree):
            coefficients[l * l + l + m] = light @ cosine
            if m:
                coefficients[l * l + l - m] = light @ sine
        return Harmonics(coefficients)


def _harmonics(directions: Array, degree: int) -> Iterator[tuple[int, int, Array, Array]]:
    """Degree l, order m >= 0, and the values of Y_lm and Y_l-m at unit vectors (n, 3)."""
    x, y, z = directions.T
    # sin^m(theta) cos(m phi) and sin^m(theta) sin(m phi) are the real and imaginary part of (x + iy)^m
    rim, turn = np.ones(len(directions), dtype=complex), x + 1j * y
    sectoral = math.sqrt(1.0 / (4.0 * math.pi))
    for m in range(degree + 1):
        if m:
            rim = rim * turn
            sectoral *= math.sqrt((2.0 * m + 1.0) / (2.0 * m))
        before, now = np.zeros(len(directions)), np.full(len(directions), sectoral)
        for l in range(m, degree + 1):
            if l > m:
                a = math.sqrt((4.0 * l * l - 1.0) / (l * l - m * m))
                b = math.sqrt(((l - 1.0) ** 2 - m * m) / (4.0 * (l - 1.0) ** 2 - 1.0))
                before, now = now, a * (z * now - b * before)
            yield (l, m, now, now) if m == 0 else (l, m, math.sqrt(2.0) * now * rim.real, math.sqrt(2.0) * now * rim.imag)


@dataclass(frozen=True, eq=False)
class FunctionField(Field):
    """A user's radiance.

    Attributes
    ----------
    function : callable
        Unit vectors (n, 3) -> radiance (n,) [W m^-2 sr^-1], finite and >= 0. Errors of integrals over it are estimates:
        structure finer than `detail` may be missed.
    detail : float
        [rad].
    """

    function: Callable[[Array], ArrayLike]
    detail: float = 0.1
    kind: str = field(default="function", init=False)
    radiance: float = field(default=1.0, init=False)

    @classmethod
    def checked(cls, function: Callable[[Array], ArrayLike], detail: float = 0.1) -> FunctionField:
        """A field from a function that answers with the right shape."""
        if not callable(function):
            raise ParameterError(f"function: {function!r} cannot be called; give a function of unit vectors (n, 3) -> (n,)")
        if not (math.isfinite(detail) and 1e-4 <= detail <= np.pi):
            raise ParameterError(f"function: detail = {detail:g} rad; give that of its finest structure, 1e-4 to pi")
        made = cls(function, float(detail))
        made.at(np.eye(3))
        return made

    def at(self, directions: Array) -> Array:
        got = np.asarray(self.function(directions), dtype=float)
        if got.shape != (len(directions),):
            raise ParameterError(f"function: gave shape {got.shape} for {len(directions)} directions; give (n, 3) -> (n,)")
        bad = ~(np.isfinite(got) & (got >= 0.0))
        if np.any(bad):
            k = int(np.argmax(bad))
            w = ", ".join(f"{c:.6g}" for c in directions[k])
            raise ParameterError(f"function: radiance {got[k]:g} from direction ({w}); it must be finite and >= 0")
        return got
