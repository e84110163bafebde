r"""Adaptive quadrature for what has no faster rule: BRDFs with kinks, anisotropic ones, functions of the user's.

The cells of `gonio.integrate.cells` are free of every edge that is known. Each takes the product of two 15-point Kronrod
rules; what the 7-point Gauss rules inside them miss is its error, so the error of a total is that of a far coarser rule.
Cells are halved, in the direction that errs, until the errors of an element add up to its tolerance. Before that, cells
near a declared lobe are halved down to its width, so that no lobe is too narrow to be seen. All elements advance together,
array by array. Regions and light of the parts of a source come from `gonio.integrate.lights`.

What is not declared, an edge or a lobe in a user's function, is found as far as the nodes hit it.

References
----------
.. [1] R. Piessens, E. de Doncker-Kapenga, C. W. Ueberhuber, D. K. Kahaner, QUADPACK, Springer, 1983.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from gonio.brdf.base import Term
from gonio.brdf.kernels import accumulate
from gonio.errors import IntegrationError, ParameterError
from gonio.integrate import threads
from gonio.integrate.cells import COLUMNS, MOST_PLANES, NODES, build, fill, place, sums
from gonio.integrate.tails import UNDERFLOW

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Radiance = Callable[[Array, Index], Array]
EPS = float(np.finfo(float).eps)
_BLOCK = 64  # elements that advance together
_CHUNK = 128  # cells evaluated at once: 2 MiB
_LARGEST = 1 << 24  # nodes for one element
_SAFETY = 4.0  # a feature that no node has met yet can exceed the difference of the rules
_GROWTH = 64.0  # of panels away from the horizon; halving sees to the rest
GRAZING = 0.05  # cosine below which a view is grazing: its lobe is a streak
_DEEPEST = 2.0**-40  # of a base cell's side
_ENDS = np.array([1e-9, 0.5, 1.0 - 1e-9])  # of a cell's sides, and their middles
_GLIMPSE = 1e-290  # f_r times the radiance that is not 0 by underflow


class Counter(Protocol):
    """Where the cost is written down."""

    def add(self, nodes: int, order: int) -> None: ...


class Region(NamedTuple):
    """Directions to integrate over, one cap for each element, above the element's horizon.

    Attributes
    ----------
    axis : ndarray, shape (n, 3)
        In the local frames.
    half_angle : float
        [rad]; pi is the whole sphere.
    about_normal : bool
        Pole of the coordinates: the normal or the cap's axis.
    """

    axis: Array
    half_angle: float
    about_normal: bool


class Light(NamedTuple):
    """Radiance as a function of direction, and what is known of its structure.

    Attributes
    ----------
    radiance : callable
        ``(directions (m, k, 3) in the local frames, element (m,)) -> (m, k)``.
    peaks : ndarray, shape (n, f, 3)
        Directions in the local frames around which it is concentrated.
    widths : ndarray, shape (f,)
        Their half widths [rad].
    planes : ndarray, shape (n, j, 4)
        Circles across which a derivative jumps: centre in the local frames, half angle.
    detail : float
        Size of its finest structure elsewhere [rad].
    """

    radiance: Radiance
    peaks: Array | None = None
    widths: Array | None = None
    planes: Array | None = None
    detail: float = math.inf

    def select(self, index: Index) -> Light:
        """For some of the elements; the numbers that `radiance` is given stay those of all."""
        peaks, planes = (None if a is None else a[index] for a in (self.peaks, self.planes))
        return self._replace(peaks=peaks, planes=planes)


def integrate(
    term: Term,
    fixed: Array,
    region: Region,
    light: Light | None,
    *,
    rtol: float,
    atol: float | Array,
    effort: Counter,
    reverse: bool = False,
    cores: int = 1,
) -> tuple[Array, Array]:
    r"""Integral of f_r L cos theta over the directions of a region, for each of n elements.

    Parameters
    ----------
    term : Term
        With values (no delta function).
    fixed : ndarray, shape (n, 3)
        Unit vectors in the local frames above the horizon: omega_r, while omega_i is integrated over.
    region : Region
    light : Light, optional
        None for a radiance of 1.
    rtol : float
    atol : float or ndarray, shape (n,)
        Tolerance per element. An element that does not reach it keeps its honest error.
    effort : Counter
    reverse : bool, optional
        `fixed` is omega_i, and omega_r is integrated over.
    cores : int, optional
        More than one only where `light` is compiled code or NumPy's.

    Returns
    -------
    value, error : ndarray, shape (n,)

    Raises
    ------
    ParameterError
        If a user's function returns NaN or infinity, or declares too many planes.
    IntegrationError
        If an element would need more than 16 million nodes before its declared lobe is resolved.
    """
    n = len(fixed)
    value, error = np.zeros(n), np.zeros(n)
    absolute = np.broadcast_to(np.asarray(atol, dtype=float), n)
    size = _BLOCK if light is None or light.planes is None else max(1, _BLOCK // (1 + light.planes.shape[1]))

    def work(start: int) -> int:
        lit = np.arange(start, min(n, start + size))
        if region.half_angle < math.pi / 2:
            lit = lit[region.axis[lit, 2] > -math.sin(region.half_angle)]  # others lie below the horizon as a whole
        if not len(lit):
            return 0
        here = None if light is None else light.select(lit)
        block = _Block(term, fixed[lit], region._replace(axis=region.axis[lit]), here, lit, reverse)
        value[lit], error[lit] = block.run(rtol, absolute[lit])
        return block.nodes

    effort.add(sum(threads.run(work, range(0, n, size), cores)), NODES.size)
    return value, error


class _Block:
    """A few elements, with the cells that cover their regions."""

    def __init__(
        self,
        term: Term,
        fixed: Array,
        region: Region,
        light: Light | None,
        names: Index,
        reverse: bool,
    ) -> None:
        self.term, self.fixed, self.light, self.names = term, np.ascontiguousarray(fixed), light, names
        self.reverse, self.nodes = reverse, 0
        self.width = term.lobe_width()
        self.rounding = 4.0 * EPS * (1.0 + 1.0 / (self.width or 1.0)) + edge_rounding(region.axis, region.half_angle)
        n, axis = len(fixed), np.ascontiguousarray(region.axis)
        planes, counts = _planes(term, fixed, region, light)
        self.frames, self.circles = np.empty((n, 3, 3)), np.empty((n, planes.shape[1], 3))
        capacity = 32 * n
        while True:
            cells, owner = np.empty((capacity, COLUMNS)), np.empty(capacity, dtype=np.intp)
            count = build(
                axis, region.half_angle, region.about_normal, planes, counts, self.frames, self.circles, cells, owner
            )
            if count >= 0:
                break
            capacity *= 2
        self.cells, self.owner = cells[:count], owner[:count]
        self.base = np.arange(count)
        self.box = np.tile(np.array([0.0, 1.0, 0.0, 1.0]), (count, 1))  # u0, u1, v0, v1
        self._approach_features()

    def _approach_features(self) -> None:
        """Halve cells near the mirror direction, the model's features and the light's peaks until they are as small."""
        feature, widths = [], []
        if self.width is not None:
            mirror = self.fixed * np.array([-1.0, -1.0, 1.0])
            feature.append(mirror[:, None, :])
            # across the plane of incidence the lobe is narrower by cos theta_r
            widths.append(self.width * np.maximum(self.fixed[:, 2:3], 0.02))
        own = [self.term.features(direction) for direction in self.fixed]
        most = max((len(rows) for rows in own), default=0)
        if most:
            padded: Array = np.full((len(own), most, 4), (0.0, 0.0, 1.0, math.inf))
            for k, rows in enumerate(own):
                padded[k, : len(rows)] = rows
            feature.append(padded[..., :3])
            widths.append(padded[..., 3])
        if self.light is not None and self.light.peaks is not None and self.light.widths is not None:
            feature.append(self.light.peaks)
            widths.append(np.broadcast_to(self.light.widths, self.light.peaks.shape[:2]))
        at = (
            np.einsum("nij,nfj->nfi", self.frames, np.concatenate(feature, axis=1))
            if feature
            else np.empty((len(self.fixed), 0, 3))
        )
        where = np.stack(
            (np.arctan2(np.hypot(at[..., 0], at[..., 1]), at[..., 2]), np.arctan2(at[..., 1], at[..., 0])), axis=-1
        )
        if self.light is not None and self.light.detail < math.pi:
            where = np.concatenate((where, np.full((len(where), 1, 2), -1.0)), axis=1)
            widths.append(np.full((len(where), 1), 1.5 * self.light.detail))
        if not widths:
            return
        half = np.ascontiguousarray(np.concatenate(widths, axis=1))
        done = [(self.base[:0], self.box[:0])]
        base, box, finished = self.base, self.box, 0
        while len(base):
            ways = np.empty(len(base), dtype=np.int64)
            place(self.cells, self.owner, self.circles, base, box, where, half, ways)
            ways[_smallest(box) <= _DEEPEST] = 0  # an edge that runs along a ring leaves nothing there
            small = ways == 0
            done.append((base[small], box[small]))
            finished += int(np.count_nonzero(small))
            base, box = _halve(base[~small], box[~small], ways[~small])
            if (finished + len(base) - len(self.base)) * NODES.size**2 > _LARGEST * len(self.fixed):  # by halving
                raise IntegrationError(
                    f"{self.term.model.name}: more than {_LARGEST} nodes around its lobes for one gradient"
                )
        self.base, self.box = (np.concatenate(of) for of in zip(*done, strict=True))

    def run(self, rtol: float, atol: Array) -> tuple[Array, Array]:
        """Refine to the tolerance, `atol` of shape (n,); value and error (n,)."""
        n = len(self.fixed)
        value, along, across = self._evaluate(self.base, self.box)
        spent = np.bincount(self.owner[self.base], minlength=n)
        while True:
            element, err = self.owner[self.base], along + across
            total = np.bincount(element, value, minlength=n).astype(float)
            missing = np.bincount(element, err, minlength=n).astype(float)
            # rounding comes on top, and what it takes away cannot be mended
            tolerance = np.maximum(np.maximum(0.95 * rtol, 0.5 * self.rounding) * np.abs(total), atol)
            count = np.bincount(element, minlength=n)
            open_ = (missing > tolerance) & (spent * NODES.size**2 < _LARGEST)
            split = open_[element] & (err > 0.5 * tolerance[element] / count[element]) & (err > 100 * EPS * np.abs(value))
            split |= self._glimpsed((total == 0.0)[element])
            split &= _smallest(self.box) > _DEEPEST
            if not np.any(split):
                if self.term.model.pieces:
                    total, missing = self._confirm(total)
                return total, missing + self.rounding * np.abs(total) + (total == 0.0) * UNDERFLOW
            ways = np.where(along > 4 * across, 1, np.where(across > 4 * along, 2, 3)) * split
            keep = ~split
            base, box = _halve(self.base[split], self.box[split], ways[split])
            fresh = self._evaluate(base, box)
            spent += np.bincount(self.owner[base], minlength=n)
            self.base, self.box = np.concatenate((self.base[keep], base)), np.concatenate((self.box[keep], box))
            value, along, across = (np.concatenate((o[keep], f)) for o, f in zip((value, along, across), fresh, strict=True))

    def _glimpsed(self, dark: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Cells without a value at any node that have one at a corner or a side: a tail that falls too steeply."""
        index, out = np.flatnonzero(dark), np.zeros(len(dark), dtype=np.bool_)
        for start in range(0, len(index), _CHUNK):
            some = index[start : start + _CHUNK]
            values, weights = self._integrand(self.base[some], self.box[some], _ENDS)
            out[some] = np.any((values > _GLIMPSE) & (weights > 0.0), axis=(1, 2))
        return out

    def _confirm(self, before: Array) -> tuple[Array, Array]:
        """All cells halved once more, for models with small pieces that both rules of a cell may have missed."""
        self.base, self.box = _halve(self.base, self.box, np.full(len(self.base), 3))
        value, along, across = self._evaluate(self.base, self.box)
        total, missing = (
            np.bincount(self.owner[self.base], of, minlength=len(before)).astype(float) for of in (value, along + across)
        )
        return total, np.maximum(missing, 0.5 * np.abs(total - before))

    def _evaluate(self, base: Index, box: Array) -> tuple[Array, Array, Array]:
        """Value of each cell, and its errors along t and along chi."""
        out = np.empty((3, len(base)))
        for start in range(0, len(base), _CHUNK):
            part = slice(start, min(len(base), start + _CHUNK))
            sums(*self._integrand(base[part], box[part], NODES), out[:, part])
        if not np.all(np.isfinite(out)):
            raise ParameterError(
                f"{self.term.model.name}: f_r or the radiance is NaN or infinite above the horizon; both must be finite"
            )
        return out[0], _SAFETY * np.abs(out[0] - out[1]), _SAFETY * np.abs(out[0] - out[2])

    def _integrand(self, base: Index, box: Array, x: Array) -> tuple[Array, Array]:
        """f_r times the radiance, and the weights, at nodes x by x of each cell, shape (c, k, k)."""
        size, side = len(base), x.size
        directions, weights = np.empty((size, side, side, 3)), np.empty((size, side, side))
        fill(self.cells, self.owner, self.circles, self.frames, base, box, x, directions, weights)
        flat, element = directions.reshape(-1, 3), self.owner[base]
        f_r, fixed = np.zeros(len(flat)), np.repeat(self.fixed[element], side * side, axis=0)
        pair = (fixed, flat) if self.reverse else (flat, fixed)
        accumulate(self.term.model)(*pair, self.term.values, self.term.weight, f_r)
        f_r = f_r.reshape(weights.shape)
        if self.light is not None:
            f_r *= self.light.radiance(directions.reshape(size, -1, 3), self.names[element]).reshape(weights.shape)
        self.nodes += f_r.size
        return f_r, weights


def _smallest(box: Array) -> Array:
    """The shorter side of each."""
    return np.minimum(box[:, 1] - box[:, 0], box[:, 3] - box[:, 2])


def edge_rounding(axis: Array, half_angle: float) -> Array:
    """Relative rounding error of a cap's edges: 1 eps of an angle is eps / sine of a small cap, or of what a horizon leaves.

    `axis` holds the direction of each cap from the normal, shape (n, 3).
    """
    if half_angle >= math.pi:
        return np.zeros(len(axis))
    left = np.abs(half_angle + 0.5 * math.pi - np.arctan2(np.hypot(axis[:, 0], axis[:, 1]), axis[:, 2]))
    sine = math.sin(half_angle)
    return np.asarray(4.0 * EPS * (1.0 / np.clip(left, EPS, sine) + 1.0 / sine))


def _planes(term: Term, fixed: Array, region: Region, light: Light | None) -> tuple[Array, Index]:
    """Centres and half angles (n, m, 4) of the circles that cut each element's region; the clip comes first."""
    n = len(fixed)
    rows: list[Array] = []
    for k in range(n):
        own = []
        if not region.about_normal:
            own.append([[0.0, 0.0, 1.0, math.pi / 2]])
        elif region.half_angle < math.pi:
            own.append([[*region.axis[k], region.half_angle]])
        kinks = term.edges(fixed[k])
        kinks = kinks[np.abs(kinks[:, 3]) < 1.0]  # others miss the sphere
        if len(kinks) > MOST_PLANES:
            raise ParameterError(f"{term.model.name}: {len(kinks)} planes of kinks; at most {MOST_PLANES} can be broken at")
        own.append(np.column_stack((kinks[:, :3], np.arccos(kinks[:, 3]))).tolist())
        # a grazing view and the shadowing of a narrow lobe each make a layer along the horizon
        layer = max(1e-9, min(float(fixed[k, 2]), term.layer_width()))
        own.append([[0.0, 0.0, 1.0, math.pi / 2 - w] for w in layer * _GROWTH ** np.arange(20) if w < 0.3])
        if term.model.lobe_width is not None and fixed[k, 2] < GRAZING:
            own.append(_streak(fixed[k], (term.lobe_width() or 1.0) * max(1e-9, float(fixed[k, 2]))))
        if light is not None and light.planes is not None:
            own.append(light.planes[k].tolist())
        rows.append(np.array([row for group in own for row in group]).reshape(-1, 4))
    counts = np.array([len(r) for r in rows], dtype=np.intp)
    planes = np.zeros((n, max(1, int(counts.max())), 4))
    for k, r in enumerate(rows):
        planes[k, : len(r)] = r
    return planes, counts


def _streak(fixed: Array, width: float) -> list[list[float]]:
    """Circles along the plane of incidence: seen at a grazing angle, a lobe is a streak in it, `width` wide."""
    sine = math.hypot(fixed[0], fixed[1])
    steps = [w for w in width * _GROWTH ** np.arange(20) if w < 0.3]
    offsets = [0.0, *steps, *(-w for w in steps)]
    return [[-float(fixed[1]) / sine, float(fixed[0]) / sine, 0.0, math.pi / 2 + off] for off in offsets]


def _halve(base: Index, box: Array, ways: NDArray[np.int64]) -> tuple[Index, Array]:
    """Cells cut in two along t (1), along chi (2) or in four (3)."""
    for bit, low in ((1, 0), (2, 2)):
        cut = (ways & bit) > 0
        first, second = box.copy(), box[cut].copy()
        middle = 0.5 * (box[cut, low] + box[cut, low + 1])
        first[cut, low + 1] = middle
        second[:, low] = middle
        base, box, ways = (
            np.concatenate((base, base[cut])),
            np.concatenate((first, second)),
            np.concatenate((ways, ways[cut])),
        )
    return base, box
