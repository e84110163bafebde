r"""A radiance field on rings about the view axis: Fourier series in azimuth, piecewise polynomials in polar angle.

.. math:: L(\theta, \phi) = a_0(\theta) + \sum_{m\ge 1} a_m(\theta)\cos m\phi + b_m(\theta)\sin m\phi

Maps give their coefficients exactly: on a ring the bilinear map is a sum of hat functions, the smooth one of cubic
B-splines, so the transform of the samples times sinc^2 or sinc^4 of m / n_phi, and between two rows both are polynomials of
theta. Other fields are sampled: panels in theta are halved, and azimuths doubled, until values between the nodes agree.

References
----------
.. [1] L. N. Trefethen, Approximation Theory and Approximation Practice, SIAM, 2013, chapter 3.
.. [2] M. Unser, A. Aldroubi, M. Eden, "B-Spline Signal Processing", IEEE Trans. Signal Process. 41(2), 1993, eq. 2.9.
"""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gonio.errors import IntegrationError
from gonio.fields import EnvironmentMap, Field, FunctionField, Lobes
from gonio.geometry import unit_vector
from gonio.texels import b_spline

Array = NDArray[np.float64]
EPS = float(np.finfo(float).eps)
_DEGREE = 11
_LARGEST = 1 << 14  # azimuths of a ring
_DEEPEST = 20  # halvings of a panel
_MAP_WAVES = 1024  # waves kept of a map, or four times its columns


class Needed(NamedTuple):
    """What sums over rings to a number of digits take of a `Spectrum`, for each panel.

    Attributes
    ----------
    used, bent : ndarray of int, shape (p,)
        Waves that matter; waves that matter where a ring is cut.
    rest : ndarray, shape (2, p)
        Nodes beyond m l / 4 that the series of each take on an interval of length l, over l^(1/3).
    cut : ndarray, shape (p,)
        Bound of the waves beyond [W m^-2 sr^-1].
    """

    used: NDArray[np.int64]
    bent: NDArray[np.int64]
    rest: Array
    cut: Array


@dataclass(frozen=True, eq=False)
class Spectrum:
    """The series on panels.

    Attributes
    ----------
    breaks : ndarray, shape (p + 1,)
        Edges of the panels, 0 to pi [rad].
    series : ndarray, shape (p, degree + 1, 2, waves)
        Chebyshev coefficients of a_m and b_m on each panel.
    size : ndarray, shape (p, waves)
        Bound of each wave on each panel [W m^-2 sr^-1].
    error : ndarray, shape (p,)
        Largest error of the radiance on a panel, truncation apart for maps [W m^-2 sr^-1].
    beyond : ndarray, shape (waves + 1,)
        Bound of the sum of all waves from m on, at any theta, also those that are not kept [W m^-2 sr^-1].
    falling : ndarray, shape (waves + 1,)
        The same of each wave divided by its m.
    """

    breaks: Array
    series: Array
    size: Array
    error: Array
    beyond: Array
    falling: Array

    @property
    def waves(self) -> int:
        """Number of terms of the Fourier series, m = 0 to waves - 1."""
        return int(self.series.shape[3])

    @functools.cached_property
    def groups(self) -> tuple[Array, Array]:
        """Edges (n + 1,) of runs of panels of like length, and the inverse of the shortest length in each (n,) [1/rad]."""
        lengths = np.diff(self.breaks)
        first = [0]
        for k in range(1, len(lengths)):
            run = lengths[first[-1] : k + 1]
            if run.max() > 2.5 * run.min():
                first.append(k)
        return np.append(self.breaks[first], self.breaks[-1]), 1.0 / np.minimum.reduceat(lengths, first)

    @functools.lru_cache(maxsize=8)  # noqa: B019 - spectra are few, and kept by `spectrum` anyway
    def needed(self, digits: float, power: int, waves: int) -> Needed:
        """What sums of so many waves to so many digits take; integrals over rings that are cut fall as m^-power."""
        nats = digits * math.log(10.0)
        total = self.size.sum(axis=1)
        negligible = 0.03 * 10.0**-digits * total
        weak = self.size / np.maximum(1.0, np.arange(self.waves)) ** power
        remaining, remaining_weak = (np.cumsum(x[:, ::-1], axis=1)[:, ::-1] for x in (self.size, weak))
        used = np.maximum(1, (remaining > negligible[:, None]).sum(axis=1))
        bent = (remaining_weak > 100.0 * negligible[:, None]).sum(axis=1)
        cut = np.where(used < self.waves, remaining[np.arange(len(used)), np.minimum(used, self.waves - 1)], 0.0)
        relative = 1.0 / np.maximum(total, 1e-300)[:, None]
        rest = [_rest(relative * r, np.minimum(n, waves), nats) for r, n in ((remaining, used), (remaining_weak, bent))]
        return Needed(used.astype(np.int64), bent.astype(np.int64), np.array(rest), cut)


def _rest(remaining: Array, count: NDArray[np.intp], nats: float) -> Array:
    """Nodes beyond m l / 4 for the last of `count` waves, over l^(1/3), that are enough for the others too, shape (panels,).

    The series of wave m on an interval of length l has died to d natural digits at the degree 2 q = z + (d^2 z)^(1/3),
    z = m l / 2, where Bessel's J has; a wave that is weak needs fewer digits.
    """
    last = np.maximum(count - 1, 0)[:, None]
    share = np.geomspace(1.0 / remaining.shape[1], 1.0, 24)
    m = (np.concatenate((share, 1.0 - share)) * last).astype(np.intp)  # some, denser towards either end (panels, waves)
    digits = np.clip(nats + np.log(np.maximum(np.take_along_axis(remaining, m, axis=1), 1e-300)), 0.0, nats)
    length = np.array([0.03, 0.1, 0.3, 1.0, 3.0])
    z = 0.5 * m[..., None] * length  # (panels, waves, lengths)
    beyond = z + np.cbrt(digits[..., None] ** 2 * z) - 0.5 * last[..., None] * length
    rest: Array = 0.5 * np.max(beyond / np.cbrt(length), axis=(1, 2), initial=0.0)
    return rest


@functools.lru_cache(maxsize=16)
def spectrum(field: Field, tolerance: float) -> Spectrum:
    """The series of a field.

    Parameters
    ----------
    field : Field
    tolerance : float
        Largest error of the radiance, relative to its largest value.

    Raises
    ------
    IntegrationError
        If a field's rings need more than 16384 azimuths.
    """
    if isinstance(field, EnvironmentMap):
        return _of_map(field, tolerance)
    return _of_samples(field, tolerance)


def _to_series(degree: int) -> tuple[Array, Array]:
    """Chebyshev nodes in [-1, 1] and the matrix from values there to coefficients."""
    nodes: Array = np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    matrix = np.asarray(np.linalg.inv(np.polynomial.chebyshev.chebvander(nodes, degree)), dtype=np.float64)
    return nodes, matrix


def _of_map(field: EnvironmentMap, tolerance: float) -> Spectrum:
    n_theta, n_phi = field.samples.shape
    waves = max(_MAP_WAVES, 4 * n_phi) + 1
    m = np.arange(waves)
    # c_m of a row: (1 / n) sum_j x_j exp(-i m phi_j), phi_j = (j + 1/2) 2 pi / n, times that of the hat or B-spline
    rows = field.samples if field.interpolation == "bilinear" else field.control_points
    transform = np.fft.fft(rows, axis=1)[:, m % n_phi] / n_phi
    transform *= np.exp(-1j * np.pi * m / n_phi) * np.sinc(m / n_phi) ** (2 if field.interpolation == "bilinear" else 4)
    values = np.stack((transform.real, -transform.imag), axis=1) * np.where(m == 0, 1.0, 2.0)  # (rows, 2, waves)
    centres = np.pi * (np.arange(n_theta) + 0.5) / n_theta
    breaks = np.concatenate(([0.0], centres, [np.pi]))
    if field.interpolation == "bilinear":
        padded = np.concatenate((values[:1], values, values[-1:]))
        above, below = padded[:-1], padded[1:]
        series = np.stack((0.5 * (above + below), 0.5 * (below - above)), axis=1)
    else:
        nodes, matrix = _to_series(3)
        pieces = []
        for k in range(n_theta + 1):  # between rows k - 1 and k; the first and the last piece end at a pole, half way
            lower, upper = (0.5, 1.0) if k == 0 else (0.0, 0.5) if k == n_theta else (0.0, 1.0)
            weights = np.array(b_spline(lower + (upper - lower) * (nodes + 1.0) / 2.0))  # (4, 4): row, node
            pieces.append(np.einsum("cn,rn,rpm->cpm", matrix, weights, values[k : k + 4]))
        series = np.array(pieces)
    size = np.hypot(*np.moveaxis(np.abs(series).sum(axis=1), 1, 0))  # (panels, waves)
    scale = field.radiance
    error = 8 * EPS * np.maximum(size.sum(axis=1), scale)
    # what is not kept falls as 1/m^2 (smooth: 1/m^4), period by period of the columns
    rest = 1.1 * waves * float(np.mean(size.max(axis=0)[-n_phi:]))
    return Spectrum(breaks, np.ascontiguousarray(series), size, error, *_beyond(size, rest))


def _beyond(size: Array, rest: float) -> tuple[Array, Array]:
    """Sums of the largest waves from m on, and `rest`; and the same of waves over m."""
    waves = size.shape[1]
    largest, falling = size.max(axis=0), size.max(axis=0) / np.maximum(1.0, np.arange(waves))
    return (
        np.concatenate((np.cumsum(largest[::-1])[::-1], [0.0])) + rest,
        np.concatenate((np.cumsum(falling[::-1])[::-1], [0.0])) + rest / waves,
    )


def _first_breaks(field: Field) -> list[float]:
    points = {0.0, math.pi}
    if isinstance(field, Lobes):
        for a, kappa, theta in zip(field.amplitude, field.kappa, field.theta, strict=True):
            width = 2.0 / math.sqrt(max(kappa, 1.0))
            step = width
            while a > 0 and step < math.pi:
                points |= {t for t in (theta - step, theta + step) if 0.0 < t < math.pi}
                step *= 2.0
    longest = 0.8 if isinstance(field, Lobes) else max(3.0 * field.detail, 0.01)
    ordered = sorted(points)
    breaks = [0.0]
    for b in ordered[1:]:
        a = breaks[-1]
        if b - a < 0.02 * field.detail and b < math.pi:
            continue  # two lobes' panels nearly coincide
        pieces = math.ceil((b - a) / longest)
        breaks += [a + (b - a) * (k + 1) / pieces for k in range(pieces)]
    return breaks


def _of_samples(field: Field, tolerance: float) -> Spectrum:
    tolerance = max(tolerance, 8.0 * EPS / field.detail)  # a rounded direction tells no more
    nodes, matrix = _to_series(_DEGREE)
    probes = np.array([-0.97, -0.3, 0.45, 0.99])
    at_probes = np.polynomial.chebyshev.chebvander(probes, _DEGREE) @ matrix
    x = np.concatenate((nodes, probes))
    breaks = _first_breaks(field)
    azimuths = 1 << max(5, math.ceil(math.log2(4.0 / field.detail)))
    pending = [(a, b, 0) for a, b in itertools.pairwise(breaks)]
    scale = _peak(field)
    done: list[tuple[float, NDArray[np.complex128], float]] = []
    while pending:
        a, b, depth = pending.pop(0)
        theta = a + (b - a) * (x + 1.0) / 2.0
        while True:
            values = field.at(_grid(theta, azimuths)).reshape(len(theta), azimuths)
            transform = np.fft.rfft(values, axis=1) / azimuths
            here = float(np.max(np.abs(values)))
            scale = max(scale, here)
            tail = float(np.max(np.sum(np.abs(transform[:, -max(2, azimuths // 8) :]), axis=1)))
            if tail <= tolerance * scale or azimuths >= _LARGEST:
                break
            azimuths *= 2
        if tail > max(tolerance, 1e-3) * scale and not isinstance(field, FunctionField):
            raise IntegrationError(f"{field.kind}: a ring of {azimuths} azimuths does not resolve it")
        missed = float(np.max(np.abs(at_probes @ values[: _DEGREE + 1] - values[_DEGREE + 1 :])))
        if missed > tolerance * scale and depth < _DEEPEST and len(done) + len(pending) < 2000:
            middle = 0.5 * (a + b)
            pending[:0] = [(a, middle, depth + 1), (middle, b, depth + 1)]
            continue
        done.append((b, matrix @ transform[: _DEGREE + 1], 2.0 * missed + 2.0 * tail + 8.0 * EPS * here))
    waves = max(waved.shape[1] for _, waved, _ in done)
    table = np.zeros((len(done), _DEGREE + 1, 2, waves))
    for k, (_, waved, _) in enumerate(done):
        width = waved.shape[1]
        table[k, :, 0, :width], table[k, :, 1, :width] = waved.real, -waved.imag
    table[..., 1:] *= 2.0
    negligible = 0.1 * tolerance * scale
    size = np.hypot(*np.moveaxis(np.abs(table).sum(axis=1), 1, 0))
    waves = max(3, int((np.cumsum(size[:, ::-1], axis=1)[:, ::-1] > negligible).sum(axis=1).max()))
    error = np.array([e for *_, e in done]) + size[:, waves:].sum(axis=1)
    table, size = np.ascontiguousarray(table[..., :waves]), np.ascontiguousarray(size[:, :waves])
    return Spectrum(np.array([0.0] + [b for b, *_ in done]), table, size, error, *_beyond(size, 0.0))


def _grid(theta: Array, azimuths: int) -> Array:
    """Directions on rings, shape (len(theta) * azimuths, 3)."""
    phi = 2.0 * np.pi * np.arange(azimuths) / azimuths
    directions = np.empty((len(theta), azimuths, 3))
    np.multiply.outer(np.sin(theta), np.cos(phi), out=directions[..., 0])
    np.multiply.outer(np.sin(theta), np.sin(phi), out=directions[..., 1])
    directions[..., 2] = np.cos(theta)[:, None]
    return directions.reshape(-1, 3)


def _peak(field: Field) -> float:
    if isinstance(field, Lobes):
        return float(np.max(field.at(field.axes())))
    phi = 2.399963 * np.arange(400)  # the golden angle spreads points evenly
    return float(np.max(np.abs(field.at(unit_vector(np.arccos(1.0 - (np.arange(400) + 0.5) / 200.0), phi)))))
