"""R(theta_n, phi_n) of a whole map: Chebyshev polynomials of tau = tan(theta_n / 2) on pieces, a grid of azimuths, Lagrange.

Pieces are halved, and their sums made with more digits or waves, until slopes and azimuths between the nodes agree.

References
----------
.. [1] J. P. Boyd, "A fast algorithm for Chebyshev, Fourier, and sinc interpolation onto an irregular grid", J. Comput. Phys.
   103, 1992 (oversampling, then local interpolation).
"""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.integrate import threads
from gonio.integrate.ring_scene import MOST_DIGITS, Scene, first_digits, floor_of, on_azimuths, tail_of, truncated

Array = NDArray[np.float64]
_DEGREE = 15
_OVERSAMPLING = 4
_SAFETY = 3.0
_MOST_PIECES = 200
_DEEPEST = 24


def _read(tau, phi, bounds, errors, table, value, error):  # type: ignore[no-untyped-def]
    """Value and error at each gradient: Chebyshev in tau, Lagrange in phi on a periodic grid."""
    pieces, degree, columns = table.shape[0], table.shape[1] - 1, table.shape[2] - 9
    per_radian = columns / (2.0 * math.pi)
    cheb, lagrange, line = np.empty(degree + 1), np.empty(10), np.empty(10)
    for k in range(tau.size):
        low, high = 0, pieces
        while high - low > 1:
            middle = (low + high) // 2
            if tau[k] >= bounds[middle]:
                low = middle
            else:
                high = middle
        x = (2.0 * tau[k] - bounds[low] - bounds[low + 1]) / (bounds[low + 1] - bounds[low])
        cheb[0], cheb[1] = 1.0, x
        for j in range(2, degree + 1):
            cheb[j] = 2.0 * x * cheb[j - 1] - cheb[j - 2]
        at = phi[k] * per_radian
        at -= columns * math.floor(at / columns)
        column = int(at)
        if column >= columns:
            column = columns - 1
        u = at - column + 4.0  # 4 to 5 of the ten points 0 to 9
        # w_j = prod_{i != j} (u - i) / (j - i), from products of the differences on either side
        left = 1.0
        for j in range(10):
            lagrange[j] = left
            left *= u - j
        right = 1.0
        for j in range(9, -1, -1):
            lagrange[j] *= right
            right *= u - j
        lagrange[0] *= -1.0 / 362880.0
        lagrange[1] *= 1.0 / 40320.0
        lagrange[2] *= -1.0 / 10080.0
        lagrange[3] *= 1.0 / 4320.0
        lagrange[4] *= -1.0 / 2880.0
        lagrange[5] *= 1.0 / 2880.0
        lagrange[6] *= -1.0 / 4320.0
        lagrange[7] *= 1.0 / 10080.0
        lagrange[8] *= -1.0 / 40320.0
        lagrange[9] *= 1.0 / 362880.0
        for i in range(10):
            line[i] = 0.0
        for j in range(degree + 1):
            c = cheb[j]
            row = table[low, j, column : column + 10]
            for i in range(10):
                line[i] += c * row[i]
        total = 0.0
        for i in range(10):
            total += lagrange[i] * line[i]
        value[k] = total
        error[k] = errors[low]


@functools.cache
def _reader() -> Any:
    return jit.kernel(_read)


@functools.cache
def _chebyshev() -> tuple[Array, Array, Array]:
    """Nodes and probes in [-1, 1], and the matrix from values at the nodes to coefficients."""
    nodes: Array = np.cos(np.pi * (np.arange(_DEGREE + 1) + 0.5) / (_DEGREE + 1))
    probes: Array = np.cos(np.pi * np.array([1, 3, 6, 9, 12, 15]) / (_DEGREE + 1))  # half way between nodes
    matrix = np.asarray(np.linalg.inv(np.polynomial.chebyshev.chebvander(nodes, _DEGREE)), dtype=np.float64)
    return nodes, probes, matrix


@dataclass(frozen=True)
class _Piece:
    """An interval of tau with what its sums are made with."""

    lower: float
    upper: float
    digits: float
    waves: int
    depth: int = 0


@dataclass(frozen=True)
class _Trial:
    """What came of a piece: the series in tau of its sums (degree + 1, 2, waves), its error, and by what it exceeds."""

    series: Array
    error: float
    good: bool
    digits_short: float
    waves_short: bool
    too_long: bool


def by_table(scene: Scene, tau: Array, phi: Array, rtol: float, atol: Array) -> tuple[Array, Array]:
    lowest, highest = float(tau.min()), float(tau.max())
    highest = max(highest, lowest * (1.0 + 1e-12) + 1e-300)
    digits = first_digits(rtol)
    room = _Room(tau, atol)
    waves, scale = _waves(scene, lowest, highest, digits, rtol, room)
    count = max(1, math.ceil((highest - lowest) * min(waves, 64) / 9.0))
    edges = np.linspace(lowest, highest, count + 1)
    pending = [_Piece(float(a), float(b), digits, waves) for a, b in itertools.pairwise(edges)]
    done: list[tuple[_Piece, _Trial]] = []
    while pending:
        first = pending[0]
        batch = [p for p in pending if p.digits == first.digits and p.waves == first.waves]
        pending = [p for p in pending if not (p.digits == first.digits and p.waves == first.waves)]
        for piece, trial in zip(batch, _try(scene, batch, rtol, room, 2e-14 * scale), strict=True):
            exhausted = piece.depth >= _DEEPEST or len(done) + len(pending) > _MOST_PIECES
            if trial.good or exhausted:
                done.append((piece, trial))
                continue
            better = replace(
                piece,
                digits=min(MOST_DIGITS - 3.0, piece.digits + math.ceil(trial.digits_short)),
                waves=min(scene.rings.waves, math.ceil(1.5 * piece.waves)) if trial.waves_short else piece.waves,
                depth=piece.depth + 1,
            )
            if trial.too_long or (better.digits == piece.digits and better.waves == piece.waves):
                middle = 0.5 * (piece.lower + piece.upper)
                pending += [replace(better, upper=middle), replace(better, lower=middle)]
            else:
                pending.append(better)
    done.sort(key=lambda item: item[0].lower)
    bounds = np.array([piece.lower for piece, _ in done] + [highest])
    errors = np.array([trial.error for _, trial in done])
    columns = _columns(max(piece.waves for piece, _ in done))
    table = np.array([_padded(on_azimuths(trial.series, columns)) for _, trial in done])
    return _evaluate(bounds, errors, table, tau, phi, scene.threads)


def _columns(waves: int) -> int:
    return 1 << max(5, math.ceil(math.log2(2 * _OVERSAMPLING * waves)))


def _padded(table: Array) -> Array:
    """The periodic grid with the points that Lagrange's formula needs beyond its ends."""
    return np.concatenate((table[:, -4:], table, table[:, :5]), axis=1)


def _try(scene: Scene, pieces: list[_Piece], rtol: float, room: _Room, resolution: float) -> list[_Trial]:
    """Sums on pieces of equal digits and waves, and their errors at slopes and azimuths between the nodes."""
    digits, waves = pieces[0].digits, pieces[0].waves
    nodes, probes, matrix = _chebyshev()
    at_nodes = np.array([_within(piece, nodes) for piece in pieces])
    at_probes = np.array([_within(piece, probes) for piece in pieces])
    # nodes with more digits than probes ask for: how many are needed varies with the slope
    all_nodal = scene.sums(at_nodes.ravel(), digits + 2.0, waves).reshape(len(pieces), len(nodes), 3, waves)
    more = min(scene.rings.waves, max(waves + max(8, waves // 3), scene.first_waves if scene.rows else 0))
    all_fine = scene.sums(at_probes.ravel(), digits + 3.0, more).reshape(len(pieces), len(probes), 3, more)
    all_rough = scene.sums(at_probes.ravel(), digits, waves).reshape(len(pieces), len(probes), 3, waves)
    columns = _columns(waves)
    between = (np.arange(columns) + 0.5) * (2.0 * np.pi / columns)
    trials = []
    for k, piece in enumerate(pieces):
        nodal, fine, rough = all_nodal[k], all_fine[k], all_rough[k]
        exact = on_azimuths(fine, columns, 0.5)
        series = np.tensordot(matrix, nodal[:, :2], axes=1)
        grid = on_azimuths(series, columns)
        got, _ = _evaluate(
            np.array([piece.lower, piece.upper]), np.zeros(1), _padded(grid)[None],
            np.repeat(at_probes[k], columns), np.tile(between, len(probes)), 1,
        )  # fmt: skip
        missed = float(np.max(np.abs(got.reshape(exact.shape) - exact)))
        if scene.rows:  # the series converges slowly where the horizon or the lobe crosses rows: doubt more than the probes
            missed = max(missed, 0.5 * float(np.max(np.sum(np.abs(grid[-3:]), axis=0))))
        lost, tail = float(np.max(truncated(fine, waves))), float(np.max(tail_of(fine, scene.rings)))
        common = fine[..., :waves] - rough
        quadrature = float(np.max(np.abs(on_azimuths(common, columns))))
        floor = max(floor_of(scene, sums) for sums in fine)
        error = _SAFETY * missed + 0.1 * quadrature + floor + tail
        smallest = min(float(np.abs(exact).min()), float(np.abs(on_azimuths(nodal, columns)).min()))
        allowed = max(0.7 * rtol * smallest, room.smallest(piece.lower, piece.upper), 2.0 * floor, resolution)
        trials.append(
            _Trial(
                series,
                error,
                error <= allowed,
                math.log10(max(quadrature / allowed, 1e-300)) if missed > quadrature else 2.0,
                lost + tail > 0.2 * allowed and waves < scene.rings.waves,
                missed > quadrature + 2.0 * lost,
            )
        )
    return trials


class _Room:
    """Absolute tolerances of the elements, by slope."""

    def __init__(self, tau: Array, atol: Array) -> None:
        self._order = np.argsort(tau, kind="stable") if np.any(atol > 0.0) else None
        if self._order is not None:
            self._tau, self._atol = tau[self._order], atol[self._order]

    def smallest(self, lower: float, upper: float) -> float:
        """Of the elements with slopes in the interval; 0 without tolerances."""
        if self._order is None:
            return 0.0
        first, last = np.searchsorted(self._tau, (lower, upper))
        return float(self._atol[max(0, first - 1) : last + 1].min())


def _within(piece: _Piece, x: Array) -> Array:
    return piece.lower + (piece.upper - piece.lower) * (x + 1.0) / 2.0


def _waves(scene: Scene, lowest: float, highest: float, digits: float, rtol: float, room: _Room) -> tuple[int, float]:
    """How many waves R has, from a few slopes, and its largest value there."""
    at = lowest + (highest - lowest) * np.array([0.02, 0.2, 0.4, 0.6, 0.8, 0.98])
    spare = np.array([room.smallest(t, t) for t in at])
    waves = min(scene.rings.waves, scene.first_waves)
    while True:
        sums = scene.sums(at, digits + 2.0, waves)
        values = np.abs(on_azimuths(sums, 4 * waves))
        wanted = 0.1 * np.maximum(np.maximum(rtol * values.min(axis=1), spare), 1e-14 * values.max())
        if waves >= scene.rings.waves or np.all(tail_of(sums, scene.rings) <= wanted):
            break
        waves = min(scene.rings.waves, 2 * waves)
    for fewer in range(8, waves, 4):
        if np.all(truncated(sums, fewer) + tail_of(sums, scene.rings) <= wanted):
            return fewer + 2, float(values.max())
    return waves, float(values.max())


def _evaluate(bounds: Array, errors: Array, table: Array, tau: Array, phi: Array, cores: int) -> tuple[Array, Array]:
    value, error = np.empty(len(tau)), np.empty(len(tau))

    def work(tile: slice) -> None:
        _reader()(tau[tile], phi[tile], bounds, errors, table, value[tile], error[tile])

    threads.run(work, [slice(k, k + 8192) for k in range(0, len(tau), 8192)], cores)
    return value, error
