r"""Photometric stereo: the gradients whose radiances under two or more sources are those measured.

Each radiance confines the gradient to one contour of its map; two contours cross in one, two or more points, a third
source tells which [1]_. All of them are found: the grid of the maps says where to look, Gauss-Newton steps on the exact
maps do the rest. Smoothness of the surface, cast shadows and interreflections are not used and not modelled.

References
----------
.. [1] R. J. Woodham, "Photometric method for determining surface orientation from multiple images", Optical Engineering
   19(1), 1980. doi:10.1117/12.7972479
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gonio.errors import DatasetError, ParameterError
from gonio.maps.grid import Method, ReflectanceMap
from gonio.maps.interpolation import Interpolant
from gonio.maps.newton import covariance, minimise, normal_equations
from gonio.maps.search import Pyramid

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Model = Callable[[Array], tuple[Array, Array, Array]]

_PIXELS = 1024  # looked up together
_UNKNOWN = 1e-3  # of the brightest of a map: how far a radiance may be off where its uncertainty is not known
_FLOOR = 1e-9  # of the brightest of a map: a radiance is never taken to be more certain than that
_APART, _APART_EXACT = 0.02, 1e-3  # of a cell: what is nearer to each other is one solution, on the grid and exactly
_GENEROUS = 100.0  # on the grid, where the exact maps have the last word: kinks mislead the interpolant
_FEW = 64  # starts of a pixel; one with more has a continuum of solutions
_AROUND = np.array([(0, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)], dtype=float)[:, None, :]
_DIVIDED = 0.05  # smallest over largest squared Jacobian over a block
_KINKED = 3e-3  # of the brightest of a map: an interpolation that may be off by more does not lead to a solution
_ALIKE = 5.0  # standard uncertainties
_REACH = 4.0  # standard uncertainties


class Status(enum.IntEnum):
    """What became of a pixel."""

    SOLVED = 0
    NO_SOLUTION = 1  # no gradient within the axes of the maps has these radiances
    UNUSABLE = 2  # a radiance is NaN, infinite or saturated, or its uncertainty is no number
    UNDETERMINED = 3  # too many gradients have them: shadow in too many images, or maps that tell too little


@dataclass(frozen=True)
class Gradients:
    """Solutions of photometric stereo for pixels of shape (...), at most s for one pixel; NaN where there is none.

    Attributes
    ----------
    p, q : ndarray, shape (s, ...)
        Gradients [1]. With two maps the flattest comes first; with more, the one that fits best.
    covariance : ndarray, shape (s, ..., 2, 2)
        Of (p, q), from the uncertainty of the radiances and of the maps through the Jacobian of the maps; NaN if
        neither is known. Infinite in no case: see `Status.UNDETERMINED`.
    chi_squared : ndarray, shape (s, ...)
        Squared deviations of the radiances in units of their variance, maps' included; k - 2 degrees of freedom.
    count : ndarray of int, shape (...)
        How many solutions.
    status : ndarray of uint8, shape (...)
        `Status`.
    """

    p: Array
    q: Array
    covariance: Array
    chi_squared: Array
    count: NDArray[np.int64]
    status: NDArray[np.uint8]

    def u(self) -> tuple[Array, Array]:
        """Standard uncertainties of p and q, shape (s, ...) each."""
        return np.sqrt(self.covariance[..., 0, 0]), np.sqrt(self.covariance[..., 1, 1])


def gradients_of(
    radiances: ArrayLike,
    maps: Sequence[ReflectanceMap],
    *,
    u: ArrayLike | None = None,
    saturation: ArrayLike | None = None,
    confidence: float = 0.999,
    most: int = 8,
    rtol: float = 1e-9,
    method: Method = "auto",
) -> Gradients:
    """All surface gradients that have the given radiances.

    Parameters
    ----------
    radiances : array_like, shape (k, ...)
        Scene radiance [W m^-2 sr^-1] of each pixel under each of the k >= 2 sources.
    maps : sequence of ReflectanceMap, length k
        Of the same material under each source, on the same axes; solutions within these axes are found.
    u : array_like, shape broadcast to (k, ...), optional
        Standard uncertainty of the radiances. Without it a solution may be off by 0.1 % of the brightest radiance of
        each map, and the covariance is that of the maps alone.
    saturation : array_like, shape broadcast to (k, ...), optional
        Radiances at and above this are not used.
    confidence : float, optional
        A solution may deviate from the radiances as much as a right one does with this probability.
    most : int, optional
        A pixel with more solutions than this is `Status.UNDETERMINED`.
    rtol : float, optional
        Relative error requested of the integrator in the last steps.
    method : {"auto", "integrate", "interpolate"}, optional
        Last steps on the maps' scenes through the integrator, on their grids, or through the integrator where all
        scenes are known.

    Returns
    -------
    Gradients

    Raises
    ------
    ParameterError
        If the numbers of maps and images differ or are below two, or an option is out of range or of another shape.
    DatasetError
        If the maps' axes differ, or a map is dark everywhere.

    Notes
    -----
    The uncertainty of a map is half its 68 % band and the error of its integration (of its interpolation, where the
    scene is not known); it is taken as independent between maps, although maps of one posterior share their BRDF.
    The grid has to resolve the maps: two solutions nearer to each other than one fiftieth of a cell come out as one.
    """
    images = np.asarray(radiances, dtype=float)
    if len(maps) < 2 or images.ndim < 1 or images.shape[0] != len(maps):
        raise ParameterError(
            f"radiances of shape {images.shape} for {len(maps)} maps; give k >= 2 maps and radiances of shape (k, ...)"
        )
    if not (0.0 < confidence < 1.0 and most >= 1):
        raise ParameterError(f"confidence = {confidence:g}, most = {most}: choose 0 < confidence < 1 and most >= 1")
    scene = _Maps(maps, method, rtol)
    flat = _pixels(images, images.shape)  # (n, k)
    noise = np.zeros_like(flat) if u is None else _pixels(u, images.shape)
    usable = np.all(np.isfinite(flat) & np.isfinite(noise) & (noise >= 0), axis=1)
    if saturation is not None:
        usable &= np.all(flat < _pixels(saturation, images.shape), axis=1)
    status = np.full(len(flat), Status.UNUSABLE, dtype=np.uint8)
    parts = []
    todo = np.flatnonzero(usable)
    for first in range(0, len(todo), _PIXELS):
        pixels = todo[first : first + _PIXELS]
        part, undetermined = _solve(scene, flat[pixels], noise[pixels], u is not None, confidence, most)
        status[pixels] = Status.NO_SOLUTION
        status[pixels[part.pixel]] = Status.SOLVED
        status[pixels[undetermined]] = Status.UNDETERMINED
        parts.append(part._replace(pixel=pixels[part.pixel]))
    return _packed(parts, status, images.shape[1:], len(maps))


def _pixels(value: ArrayLike, shape: tuple[int, ...]) -> Array:
    """(k, ...) -> (n, k)."""
    array = np.asarray(value, dtype=float)
    try:
        return np.ascontiguousarray(np.broadcast_to(array, shape).reshape(shape[0], -1).T)
    except ValueError:
        raise ParameterError(
            f"u or saturation of shape {array.shape} does not fit radiances of shape {shape}; give one number, or an array "
            "that broadcasts to the radiances"
        ) from None


class _Found(NamedTuple):
    """Solutions, one a row."""

    pixel: Index
    at: Array  # (s, 2)
    covariance: Array  # (s, 2, 2)
    chi_squared: Array

    @classmethod
    def none(cls) -> _Found:
        return cls(np.zeros(0, dtype=np.intp), np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0))

    def with_(self, other: _Found) -> _Found:
        return _Found(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))

    def take(self, index: Index | NDArray[np.bool_]) -> _Found:
        return _Found(self.pixel[index], self.at[index], self.covariance[index], self.chi_squared[index])


class _Starts(NamedTuple):
    """Points to start from on the grid, more of them for divided blocks, and those to start from on the exact maps."""

    pixel: Index
    at: Array  # (n, 2)
    more_pixel: Index
    more: Array
    exact_pixel: Index
    exact: Array


class _Maps:
    """The maps as functions of many gradients at once: values (n, k), derivatives (n, k, 2), own variances (n, k)."""

    def __init__(self, maps: Sequence[ReflectanceMap], method: Method, rtol: float) -> None:
        p, q = maps[0].p, maps[0].q
        if any(not np.array_equal(p, one.p) or not np.array_equal(q, one.q) for one in maps):
            raise DatasetError("the maps have different axes; make all of them on the same p and q")
        self.maps, self.rtol, count = maps, rtol, len(maps)
        self.exact = all(one._integrates(method) for one in maps)
        value = np.array([one.value for one in maps])
        half = [np.zeros_like(m.value) if m.band is None else 0.5 * np.abs(m.band[1] - m.band[0]) for m in maps]
        error = np.concatenate(([m.error for m in maps], np.zeros_like(half)))
        self.width = 2 * count  # functions of the interpolant: the maps, then half their bands
        self.grid = Interpolant(p, q, np.concatenate((value, half)), error)
        self.brightest = np.array([np.max(np.abs(v[np.isfinite(v)]), initial=0.0) for v in value])
        if not np.all(self.brightest > 0):
            raise DatasetError(
                "a map is dark or has no finite value, so that it tells nothing of the gradient; leave it out"
            )
        self.has_band = any(one.band is not None for one in maps)
        self.lower, self.upper = np.array([p[0], q[0]]), np.array([p[-1], q[-1]])
        self.cell = (self.upper - self.lower) / np.array([p.size - 1, q.size - 1])
        self.pyramid = Pyramid(self.grid, count, _REACH * _largest_in_cell(np.array(half)))

    def starts(self, radiance: Array, u: Array) -> tuple[_Starts, NDArray[np.bool_]]:
        """Where solutions may be, and which pixels may have them almost anywhere.

        A block is dropped if the linear map at its centre, with all that its corners deviate from that, puts the solution
        outside of it (Krawczyk's test). Blocks that a fold or a kink divides get starts at their corners too.
        """
        pixel, at, half, crowded = self.pyramid.starts(radiance, _REACH * u)
        count = len(self.maps)
        around = np.clip(at + half * _AROUND, self.lower, self.upper)  # (5, n, 2)
        value, slope, error = self.grid(*around.reshape(-1, 2).T)
        value, slope = value.reshape(5, len(at), self.width), slope[:, :count].reshape(5, len(at), count, 2)
        bands = _REACH * value[0, :, count:]
        value, error = value[..., :count], error.reshape(5, len(at), self.width)[..., :count]
        bent = np.abs(value - value[0] - np.einsum("nki,cni->cnk", slope[0], around - at))
        off = (1.5 * np.max(bent, axis=0) + np.max(error, axis=0) + bands + _REACH * u[pixel]) / self.brightest
        jacobian = slope / self.brightest[:, None]
        matrix = np.einsum("cnki,cnkj->cnij", jacobian, jacobian)
        area = matrix[..., 0, 0] * matrix[..., 1, 1] - matrix[..., 0, 1] ** 2  # (5, n)
        inverse = covariance(matrix[0])
        singular = ~np.all(np.isfinite(inverse), axis=(1, 2))
        inverse[singular] = 0.0
        pseudo = np.einsum("nij,nkj->nik", inverse, jacobian[0])
        step = np.einsum("nik,nk->ni", pseudo, (radiance[pixel] - value[0]) / self.brightest)
        outside = np.abs(step) > 1.05 * half + np.einsum("nik,nk->ni", np.abs(pseudo), off)
        keep = singular | ~np.any(outside, axis=1)
        pixel, at, area, around = pixel[keep], at[keep], area[:, keep], around[:, keep]
        few = np.bincount(pixel, minlength=len(radiance))[pixel] <= _FEW
        least, most = np.min(area, axis=0), np.max(area, axis=0)
        divided = few & (most > 0) & ~(least > _DIVIDED * most)
        more_pixel, more = np.tile(pixel[divided], 5), around[:, divided].reshape(-1, 2)
        kinked = few & ~divided & (most > 0) & np.any(error[0, keep] > _KINKED * self.brightest, axis=1)
        return _Starts(pixel, at, more_pixel, more, pixel[kinked], at[kinked]), crowded

    def on_grid(self, at: Array) -> tuple[Array, Array, Array]:
        k = len(self.maps)
        value, slope, error = self.grid(at[:, 0], at[:, 1])
        return value[:, :k], slope[:, :k], error[:, :k] ** 2 + value[:, k:] ** 2

    def through_scenes(self, at: Array) -> tuple[Array, Array, Array]:
        """By the integrator; derivatives by forward differences, whose step is far above its error."""
        step = 1e-5 * (1.0 + np.abs(at))
        points = np.stack((at, at + step * (1.0, 0.0), at + step * (0.0, 1.0)))  # (3, n, 2)
        values, errors = [], []
        for one in self.maps:
            got = one._at(points[..., 0].ravel(), points[..., 1].ravel(), "integrate", self.rtol)
            values.append(got.value.reshape(3, -1))
            errors.append(got.error.reshape(3, -1)[0])
        value = np.array(values)  # (k, 3, n)
        slope = np.stack(((value[:, 1] - value[:, 0]) / step[:, 0], (value[:, 2] - value[:, 0]) / step[:, 1]), axis=-1)
        band = self.grid(*np.clip(at, self.lower, self.upper).T)[0][:, len(self.maps) :]
        return value[:, 0].T, np.swapaxes(slope, 0, 1), np.array(errors).T ** 2 + band**2


def _solve(scene: _Maps, radiance: Array, u: Array, u_known: bool, confidence: float, most: int) -> tuple[_Found, Index]:
    """Solutions of some pixels, and the pixels that have too many."""
    from scipy.special import chdtri

    allowed = float(chdtri(max(radiance.shape[1] - 2, 1), 1.0 - confidence))
    tolerated = np.hypot(u, (_FLOOR if u_known else _UNKNOWN) * scene.brightest)
    starts, many = scene.starts(radiance, tolerated)

    def descend(model: Model, pixel: Index, at: Array) -> tuple[_Found, NDArray[np.bool_]]:
        at, inside = minimise(model, at, radiance[pixel], tolerated[pixel], scene.lower, scene.upper)
        return _judged(model, pixel, at, radiance, tolerated), inside

    first, inside = descend(scene.on_grid, starts.pixel, starts.at)
    flat = first.take(np.isinf(first.covariance[:, 0, 0]) & (first.chi_squared <= allowed))
    off = (radiance[flat.pixel] - scene.on_grid(flat.at)[0]) / tolerated[flat.pixel]
    many[flat.pixel[np.sum(off**2, axis=1) <= allowed]] = True  # a solution where maps are flat: more are all around it
    first, inside = first.take(~many[first.pixel]), inside[~many[first.pixel]]
    left = ~many[starts.more_pixel]
    more_pixel, more = starts.more_pixel[left], starts.more[left]
    second, also_inside = descend(scene.on_grid, more_pixel, more)
    found, inside = first.with_(second), np.concatenate((inside, also_inside))
    if scene.exact:  # the grid may be a little off at kinks and at its edges; the last word is not its
        near = _distinct(found.take(found.chi_squared <= _GENEROUS * allowed), _APART * scene.cell, 4 * most)
        pixel = np.concatenate((near.pixel, more_pixel, starts.exact_pixel))
        at = np.concatenate((near.at, more, starts.exact))
        pixel, at = pixel[~many[pixel]], at[~many[pixel]]
        found, inside = descend(scene.through_scenes, pixel, at)
    apart = _APART_EXACT if scene.exact else _APART
    found = _distinct(found.take(inside & (found.chi_squared <= allowed)), apart * scene.cell, most + 1)
    # a solution less certain than the axes are long is none
    spread = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    vague = ~np.all(spread <= scene.upper - scene.lower, axis=1)
    many |= np.bincount(found.pixel, minlength=len(radiance)) > most
    many[found.pixel[vague]] = True
    found = found.take(~many[found.pixel])
    if not u_known and scene.has_band:
        model = scene.through_scenes if scene.exact else scene.on_grid
        found = _judged(model, found.pixel, found.at, radiance, np.zeros_like(tolerated))
    elif not u_known:
        found.covariance[:] = np.nan
    return found, np.flatnonzero(many)


def _judged(model: Model, pixel: Index, at: Array, radiance: Array, u: Array) -> _Found:
    """Candidates with their chi squared and covariance."""
    value, slope, own = model(at)
    residual, weight = radiance[pixel] - value, 1.0 / np.maximum(u[pixel] ** 2 + own, np.finfo(float).tiny)
    matrix, _ = normal_equations(slope, weight, residual)
    return _Found(pixel, at, covariance(matrix), np.sum(weight * residual**2, axis=1))


def _distinct(found: _Found, apart: Array, most: int) -> _Found:
    """The best of each group of candidates; at most `most` a pixel.

    A group lies within `apart` (2,) of its best, or within its uncertainty and fits worse: on a kink of the maps a search
    may end beside the minimum.
    """
    found = found.take(np.lexsort((found.chi_squared, found.pixel)))
    kept: list[Index] = []
    rest = np.arange(len(found.pixel))
    for _ in range(most):
        if not rest.size:
            break
        first = np.concatenate(([True], np.diff(found.pixel[rest]) > 0))
        best = rest[first]
        kept.append(best)
        leader = best[np.cumsum(first) - 1]
        off = found.at[rest] - found.at[leader]
        worse = found.chi_squared[rest] > found.chi_squared[leader] + 1e-3
        spread = _ALIKE * np.sqrt(np.diagonal(found.covariance[leader], axis1=1, axis2=2))
        alike = np.all(np.abs(off) <= apart, axis=1) | (worse & np.all(np.abs(off) <= spread, axis=1))
        rest = rest[~alike]
    return found.take(np.sort(np.concatenate(kept)) if kept else rest)


def _packed(parts: list[_Found], status: NDArray[np.uint8], shape: tuple[int, ...], maps: int) -> Gradients:
    """Solutions by pixel and rank."""
    found = _Found(*(np.concatenate(columns) for columns in zip(_Found.none(), *parts, strict=True)))
    rank_by = np.hypot(found.at[:, 0], found.at[:, 1]) if maps == 2 else found.chi_squared
    found = found.take(np.lexsort((rank_by, found.pixel)))
    count = np.bincount(found.pixel, minlength=len(status)).astype(np.int64)
    rank = np.arange(len(found.pixel)) - np.concatenate(([0], np.cumsum(count)))[found.pixel]
    deep = max(1, int(count.max(initial=0)))

    def spread(values: Array) -> Array:
        out = np.full((deep, len(status)) + values.shape[1:], np.nan)
        out[rank, found.pixel] = values
        return out.reshape((deep,) + shape + values.shape[1:])

    return Gradients(
        spread(found.at[:, 0]), spread(found.at[:, 1]), spread(found.covariance), spread(found.chi_squared),
        count.reshape(shape), status.reshape(shape),
    )  # fmt: skip


def _largest_in_cell(value: Array) -> Array:
    """Largest of the four corners of each cell: (k, m, n) -> (m - 1, n - 1, k)."""
    corners = (value[:, :-1, :-1], value[:, :-1, 1:], value[:, 1:, :-1], value[:, 1:, 1:])
    return np.moveaxis(np.maximum.reduce(corners), 0, -1)
