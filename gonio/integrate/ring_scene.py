"""A term and a field as `ring_kernel` takes them, and what its sums over rings tell about their own errors."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gonio.brdf.base import Term
from gonio.integrate import threads
from gonio.integrate.quadrature import Effort
from gonio.integrate.ring_kernel import ring_kernel
from gonio.integrate.ring_nodes import gauss_table
from gonio.integrate.spectrum import Spectrum

Array = NDArray[np.float64]
EPS = float(np.finfo(float).eps)
MOST_DIGITS = 14.0
NONE = 1e9  # [rad], a width that means: no such feature
FIRST_WAVES = 48
_AT_LAYERS = 2.0  # digits more
_ON_PIECES = 2.0  # times as many nodes


@dataclass(frozen=True, eq=False)
class Scene:
    """What the kernel needs beyond the slopes."""

    term: Term
    rings: Spectrum
    rows: bool
    width: float
    threads: int
    effort: Effort
    first_waves: int  # to begin with
    overshoots: bool = False  # the field, below 0

    @property
    def least(self) -> float:
        """What no value can be below: smooth maps overshoot."""
        return -math.inf if self.overshoots else 0.0

    def sums(self, tau: Array, digits: float, waves: int) -> Array:
        """What `ring_kernel` gives for slopes tan(theta_n / 2), shape (n, 3, waves), to a number of digits."""
        slopes = np.stack(((1.0 - tau) * (1.0 + tau), 2.0 * tau), axis=1) / (1.0 + tau * tau)[:, None]
        layers = self._layers(slopes[:, 0])
        peaks, planes = self._peaks(slopes), self._planes(slopes)
        out = np.zeros((len(tau), 3, waves))
        x, w = gauss_table()
        kernel: Any = ring_kernel(self.term.model.function)
        needed = self.rings.needed(digits, 2 if self.width >= NONE and self.term.model.diffuse else 1, waves)
        corner = self._corner(digits)
        edges, detail = (self.rings.breaks, np.zeros(1)) if self.rows else self.rings.groups

        # a layer finer than the lobe has no nearest pole for the orders to count with, borders of pieces have none at all
        more = _AT_LAYERS if self.term.model.layer_width is not None else 0.0
        dense = _ON_PIECES if self.term.model.pieces else 1.0

        def work(tile: slice) -> int:
            effort = np.zeros(1, dtype=np.int64)
            kernel(
                slopes[tile], self.term.values, self.term.weight, self.width, layers[tile], peaks[tile], planes[tile],
                corner, edges, detail, self.rings.breaks, self.rings.series, *needed, self.rings.error, self.rows,
                dense * (digits + more) * math.log(10.0), x, w, out[tile], effort,
            )  # fmt: skip
            return int(effort[0])

        tiles = [slice(k, k + 2) for k in range(0, len(tau), 2)]
        self.effort.add(sum(threads.run(work, tiles, self.threads)), math.ceil(digits))
        return out

    def _corner(self, digits: float) -> float:
        """Distance from a kink [rad] from which on a broken power must be resolved; 0 if there is none."""
        power = math.inf if self.term.model.kink_power is None else self.term.model.kink_power(self.term.values)
        return 0.0 if power == math.inf else float(max(1e-12, 10.0 ** (-(digits + 2.0) / (1.0 + power))))

    def _layers(self, cosine: Array) -> Array:
        """Width of the structure at the surface's horizon [rad]."""
        if self.width < NONE:
            return np.maximum(np.minimum(self.term.layer_width(), cosine), 1e-9)
        if self.term.model.diffuse:
            return np.full(len(cosine), NONE)
        return np.maximum(cosine, 1e-9)

    def _peaks(self, slopes: Array) -> Array:
        """Features of the term, all in the plane of incidence: theta, cos D (1, -1) and half width, shape (n, k, 3)."""
        rows = np.array([self.term.features(np.array((-s, 0.0, c))) for c, s in slopes])
        angle = np.arctan2(rows[..., 0], rows[..., 2]) + np.arctan2(slopes[:, 1], slopes[:, 0])[:, None]
        side = np.where(angle < 0.0, -1.0, 1.0)
        return np.stack((np.abs(angle), side, np.maximum(rows[..., 3], 1e-9)), axis=-1)

    def _planes(self, slopes: Array) -> Array:
        """Planes of kinks in the local frames, shape (n, k, 4), filled up with planes that meet no direction."""
        planes = [self.term.kinks(np.array((-s, 0.0, c))) for c, s in slopes]
        most = max(len(p) for p in planes)
        filled = np.zeros((len(slopes), most, 4))
        filled[..., 2:] = 1.0, 2.0
        for k, given in enumerate(planes):
            filled[k, : len(given)] = given
        return filled


def first_digits(rtol: float) -> float:
    """Digits to begin with, of the largest value at a slope: smooth fields give three more than asked for."""
    return min(MOST_DIGITS - 2.0, max(3.0, -2.0 - math.log10(rtol)))


def on_azimuths(sums: Array, columns: int, shift: float = 0.0) -> Array:
    """Values at phi = (j + shift) 2 pi / columns, shape (..., columns), of sums (..., 2 or more, waves)."""
    m = np.arange(sums.shape[-1])
    half = 0.5 * columns * (sums[..., 0, :] - 1j * sums[..., 1, :])
    half[..., 0] = columns * sums[..., 0, 0]
    half = half * np.exp(2j * np.pi * m * shift / columns)
    values: Array = np.fft.irfft(half, columns, axis=-1)
    return values


def tail_of(sums: Array, rings: Spectrum) -> Array:
    """What waves beyond the last may add at any azimuth, shape (n,).

    The field's own waves, all of them known, times how much of the last ones came through. This share, what a BRDF lets
    through of a wave, falls with m at least as 1/m: K is continuous. Of two groups of last waves the larger is taken twice.
    """
    waves = sums.shape[2]
    if rings.beyond[waves] == 0.0:
        return np.zeros(len(sums))
    share = np.zeros(len(sums))
    for first, last in ((3 * waves // 4, 7 * waves // 8), (7 * waves // 8, waves)):
        given = max(rings.beyond[first] - rings.beyond[last], 1e-3 * rings.beyond[waves], 1e-300)
        share = np.maximum(share, truncated(sums[..., :last], first) / given)
    tail: Array = np.minimum(2.0 * share * waves * rings.falling[waves], sums[:, 2, 0] * rings.beyond[waves])
    return tail


def truncated(sums: Array, waves: int) -> Array:
    """Largest sum of the waves from `waves` on at any azimuth, shape (n,)."""
    if waves >= sums.shape[2]:
        return np.zeros(len(sums))
    rest = sums[:, :2].copy()
    rest[..., :waves] = 0.0
    largest: Array = np.abs(on_azimuths(rest, 4 * sums.shape[2])).max(axis=1)
    return largest


def floor_of(scene: Scene, sums: Array) -> float:
    """Error of the field's series and rounding."""
    rounding = 4.0 * EPS * (1.0 + 1.0 / scene.width) * float(np.sum(np.abs(sums[:2])))
    return float(sums[2, 1]) + rounding
