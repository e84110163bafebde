"""R(theta_n, phi_n) of a whole map: Chebyshev polynomials of tau = tan(theta_n / 2) on pieces, Fourier series in phi_n.

Pieces are halved, and their sums made with more digits or waves, until slopes and azimuths between the nodes agree.
`ring_patches` reads the map then.
"""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gonio.integrate.ring_patches import Room, Table, patches
from gonio.integrate.ring_scene import MOST_DIGITS, Scene, first_digits, floor_of, on_azimuths, tail_of, truncated
from gonio.integrate.tails import ROUNDING

Array = NDArray[np.float64]
_DEGREE = 15
_SAFETY = 3.0
_MOST_PIECES = 200
_AT_ONCE = 2  # pieces between two looks at what they took
_DEEPEST = 24
_TO_LIMB = 4.0  # by which a piece may come nearer to the limb than it began
_WAVES_IN_PIECE = 8.0  # length of a piece times waves
_NOISE = 0.1  # of the tolerance, for the quadrature
_DOUBT = 0.03  # of the digits asked for, which sums may miss alike
_NOISE_IN_TAIL = 1.5  # times the tail by sums with another digit: it is noise, not waves
_SOME = [1, 2]  # probes of which the noise is measured
_FLOORS = 2.5  # of the error that no digits lower: what may be asked for
_PATCHING = 0.05  # of the tolerance, for reading between the nodes


@functools.cache
def _chebyshev() -> tuple[Array, Array, Array]:
    """Nodes and probes in [-1, 1], and the matrix from values at the nodes to coefficients."""
    nodes: Array = np.cos(np.pi * (np.arange(_DEGREE + 1) + 0.5) / (_DEGREE + 1))
    probes: Array = np.cos(np.pi * np.array([1, 6, 11, 15]) / (_DEGREE + 1))  # half way between nodes
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
    halved: int = 0
    error: float = math.inf  # of the trial before


@dataclass(frozen=True)
class _Trial:
    """What came of a piece: the series in tau of its sums (degree + 1, 2, waves), its error, and by what it exceeds."""

    series: Array
    error: float
    allowed: float
    good: bool
    digits_short: float
    waves_short: bool
    too_long: bool
    stuck: bool  # by waves that the field's series does not have, or rounding


def tabulate(scene: Scene, rtol: float, room: Room, worth: float = math.inf) -> Table | None:
    """The map for all slopes in a range.

    Parameters
    ----------
    scene : Scene
    rtol : float
    room : Room
        The range, and what absolute errors are allowed in it.
    worth : float, optional
        Evaluations that the table may take; it is given up as soon as it looks as if it took more.

    Returns
    -------
    Table or None
        With its honest errors, whether or not they are within the tolerance; None if it takes more than it is worth.
    """
    lowest = room.lowest
    highest = max(room.highest, lowest * (1.0 + 1e-12) + 1e-300)
    survey = _survey(scene, lowest, highest, rtol, room)
    scale = max(survey.scale, room.largest)
    pending = [_Piece(a, b, *survey.around(a, b)) for a, b in itertools.pairwise(survey.edges(lowest, highest))]
    done: list[tuple[_Piece, _Trial]] = []
    begun, tried = scene.effort.evaluations, 0
    while pending:
        if (scene.effort.evaluations - begun) * (1.0 + len(pending) / max(tried, 1)) > worth:
            return None
        first = pending[0]
        alike = [p for p in pending if p.digits == first.digits and p.waves == first.waves]
        batch = alike if worth == math.inf else alike[:_AT_ONCE]
        pending = [p for p in pending if p not in batch]
        tried += len(batch)
        for piece, trial in zip(batch, _try(scene, batch, rtol, room, 0.5 * ROUNDING * scale), strict=True):
            exhausted = piece.depth >= _DEEPEST or len(done) + len(pending) > _MOST_PIECES
            # what halving gained once it gains again: at that rate, how many pieces would it take?
            rate = min(1.0, trial.error / piece.error) if piece.halved else 0.0
            halvings = math.log(trial.error / trial.allowed) / -math.log(rate) if 0.0 < rate < 0.95 else math.inf * rate
            exhausted = exhausted or (trial.too_long and piece.halved > 1 and 2.0 ** min(halvings, 99.0) > _MOST_PIECES)
            if trial.good or trial.stuck or exhausted:
                done.append((piece, trial))
                continue
            better = replace(
                piece,
                digits=min(MOST_DIGITS, piece.digits + trial.digits_short),
                waves=min(scene.rings.waves, math.ceil(1.5 * piece.waves)) if trial.waves_short else piece.waves,
                depth=piece.depth + 1,
                error=trial.error,
            )
            if trial.too_long or (better.digits == piece.digits and better.waves == piece.waves):
                middle = 0.5 * (piece.lower + piece.upper)
                half = replace(better, halved=piece.halved + 1)
                pending += [replace(half, upper=middle), replace(half, lower=middle)]
            else:
                pending.append(better)
    done.sort(key=lambda item: item[0].lower)
    bounds = np.array([piece.lower for piece, _ in done] + [highest])
    read = [patches(trial.series, _PATCHING * max(trial.allowed, trial.error)) for _, trial in done]
    errors = np.array([trial.error + patch.error for (_, trial), patch in zip(done, read, strict=True)])
    return Table.of(bounds, errors, read, scene.least)


def _try(scene: Scene, pieces: list[_Piece], rtol: float, room: Room, resolution: float) -> list[_Trial]:
    """Sums on pieces of equal digits and waves, and their errors at slopes and azimuths between the nodes."""
    digits, waves = pieces[0].digits, pieces[0].waves
    nodes, probes, matrix = _chebyshev()
    at_nodes = np.array([_within(piece, nodes) for piece in pieces])
    at_probes = np.array([_within(piece, probes) for piece in pieces])
    all_nodal = scene.sums(at_nodes.ravel(), digits, waves).reshape(len(pieces), len(nodes), 3, waves)
    more = _more(scene, waves)
    all_fine = scene.sums(at_probes.ravel(), digits + 1.0, more).reshape(len(pieces), len(probes), 3, more)
    some = np.ascontiguousarray(at_probes[:, _SOME])
    all_rough = scene.sums(some.ravel(), digits, waves).reshape(len(pieces), len(_SOME), 3, waves)
    between = np.polynomial.chebyshev.chebvander(probes, _DEGREE)
    columns = 1 << max(5, math.ceil(math.log2(8 * waves)))
    trials = []
    for k, piece in enumerate(pieces):
        nodal, fine = all_nodal[k], all_fine[k]
        exact = on_azimuths(fine, columns, 0.5)
        series = np.tensordot(matrix, nodal[:, :2], axes=1)
        missed = float(np.max(np.abs(on_azimuths(np.tensordot(between, series, axes=1), columns, 0.5) - exact)))
        if scene.rows:  # the series converges slowly where the horizon or the lobe crosses rows: doubt more than the probes
            missed = max(missed, 0.5 * float(np.max(np.sum(np.abs(on_azimuths(series[-3:], columns)), axis=0))))
        noise = float(np.max(np.abs(on_azimuths(fine[_SOME, :, :waves] - all_rough[k], columns))))
        lost, tail = float(np.max(truncated(fine, waves))), float(np.max(tail_of(fine, scene.rings)))
        floor = max(floor_of(scene, sums) for sums in fine)
        cut = float(np.max(fine[:, 2, 2]))
        doubt = _DOUBT * 10.0**-digits * float(np.abs(exact).max())
        error = _SAFETY * missed + doubt + floor + cut + tail
        smallest = min(float(np.abs(exact).min()), float(np.abs(on_azimuths(nodal, columns)).min()))
        allowed = max(0.7 * rtol * smallest, room.smallest(piece.lower, piece.upper), _FLOORS * floor, resolution)
        noise = max(noise, cut, 0.3 * doubt)
        lasting = waves == scene.rings.waves and floor + tail > (1.0 - _PATCHING) * allowed
        if lasting and float(np.max(tail_of(all_rough[k], scene.rings))) > _NOISE_IN_TAIL * tail:
            noise = max(noise, tail)
        noisy = noise > _NOISE * allowed and digits < MOST_DIGITS
        trials.append(
            _Trial(
                series,
                error,
                allowed,
                error <= (1.0 - _PATCHING) * allowed,
                max(1.0, min(3.0, math.ceil(math.log10(3.0 * noise / allowed)))) if noisy else 0.0,
                lost + tail > 0.2 * allowed and waves < scene.rings.waves,
                missed > 4.0 * max(noise, lost),
                lasting and not noisy,
            )
        )
    return trials


def _within(piece: _Piece, x: Array) -> Array:
    return piece.lower + (piece.upper - piece.lower) * (x + 1.0) / 2.0


def _more(scene: Scene, waves: int) -> int:
    """Waves of the sums that others with fewer are compared with."""
    return min(scene.rings.waves, waves + max(8, waves // 3))


@dataclass(frozen=True)
class _Survey:
    """What a few slopes tell: digits (n,) and waves (n,) that sums take there, and the largest value."""

    at: Array
    digits: Array
    waves: NDArray[np.int64]
    scale: float

    def around(self, lower: float, upper: float) -> tuple[float, int]:
        """Digits and waves for an interval: the most of those inside and next to it."""
        first = max(0, int(np.searchsorted(self.at, lower, side="right")) - 1)
        last = min(len(self.at), int(np.searchsorted(self.at, upper)) + 1)
        return float(self.digits[first:last].max()), int(self.waves[first:last].max())


    def edges(self, lower: float, upper: float) -> list[float]:
        """Intervals on which so many waves should be polynomials: R turns with the mirror direction, 4 atan(tau).

        Seen along the surface R may be singular: an interval comes nearer to the limb by a factor at most.
        """
        edges = [lower]
        while edges[-1] < upper:
            a = edges[-1]
            long = _WAVES_IN_PIECE * (1.0 + a * a)
            waves = self.around(a, a + long / self.around(a, a)[1])[1]
            b = min(upper, a + long / waves)
            edges.append(min(b, 1.0 - (1.0 - a) / _TO_LIMB) if upper < 1.0 else b)
        return edges


def _survey(scene: Scene, lowest: float, highest: float, rtol: float, room: Room) -> _Survey:
    at = lowest + (highest - lowest) * np.array([0.02, 0.2, 0.4, 0.6, 0.8, 0.98])
    spare = np.array([room.smallest(t, t) for t in at])
    most = min(scene.rings.waves, scene.first_waves)
    digits = np.full(len(at), first_digits(rtol))
    sums = scene.sums(at, digits[0], most)
    pending = np.arange(len(at))
    while True:
        level = float(digits[pending[0]]) + 1.0
        finer = scene.sums(at[pending], level, most)
        values = np.abs(on_azimuths(finer, 4 * most))
        wanted = np.maximum(np.maximum(rtol * values.min(axis=1), spare[pending]), 1e-14 * values.max())
        noise = np.abs(on_azimuths(finer - sums[pending], 4 * most)).max(axis=1)
        sums[pending] = finer
        doubt = 0.3 * _DOUBT * 10.0 ** (1.0 - level) * values.max(axis=1)
        again = np.maximum(noise, np.maximum(finer[:, 2, 2], doubt)) > _NOISE * wanted
        pending = pending[again]
        if not pending.size or level >= MOST_DIGITS - 1.0:
            break
        digits[pending] += 1.0
    values = np.abs(on_azimuths(sums, 4 * most))
    wanted = 0.1 * np.maximum(np.maximum(rtol * values.min(axis=1), spare), 1e-14 * values.max())
    while most < scene.rings.waves and np.any(tail_of(sums, scene.rings) > wanted):
        most = min(scene.rings.waves, 2 * most)
        sums = scene.sums(at, float(digits.max()) + 1.0, most)
    waves = np.full(len(at), most)
    for fewer in range(most - 1, 7, -4):
        tail = tail_of(sums[..., : _more(scene, fewer)], scene.rings)
        enough = (truncated(sums, fewer) + tail <= wanted) & (waves <= fewer + 4)
        waves[enough] = fewer
    return _Survey(at, digits, np.minimum(waves + 2, scene.rings.waves), float(values.max()))
