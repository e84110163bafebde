r"""The band of a posterior: quantiles, gradient by gradient, of the maps of many parameter sets, from few maps.

R is a sum over the terms of the BRDF, and smooth in the parameters of each. So a term's maps are interpolated: polynomials
of the parameters that vary, linear in those in which f_r is linear, of total degree 0, 1, 2 ...; where a parameter's prior
is log-normal, of its logarithm. Nodes are draws. Gaussian elimination with row pivoting on the values of the polynomials at
the draws picks them one by one (discrete Leja points [1]_) and gives Newton's form of the interpolant,

.. math:: R_i = \sum_k L_{ik} D_k, \qquad D_k = R_{n_k} - \sum_{j<k} L_{n_k j} D_j, \qquad |L_{ik}| \le 1 ,

so D_k is by what the interpolant before missed the map of draw n_k, where it was to be trusted least. The degree rises until
what the last degree has added is negligible everywhere, and all of that, though it has been added, is the error of the
interpolation. If it doesn't get there, every draw has its own map.

A quantile moves by no more than the largest move of a draw, so the error of a band is the largest error of the draws. How
far the quantiles of some hundred draws are from those of the posterior is not part of it.

References
----------
.. [1] L. Bos, S. De Marchi, A. Sommariva, M. Vianello, "Computing multivariate Fekete and Leja points by numerical linear
   algebra", SIAM J. Numer. Anal. 48(5), 2010.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.brdf.base import BRDF, Model
from gonio.brdf.kernels import accumulate
from gonio.geometry import unit_vector
from gonio.integrate import threads
from gonio.integrate.results import MapValues
from gonio.maps.simultaneous import band_of_products

Array = NDArray[np.float64]
Evaluate = Callable[[BRDF], MapValues]
_DEGREE = 6
_SHARE = 3  # at most a third of the draws become nodes
_OF_SPREAD = 0.01  # error allowed, as a share of half the range of the draws: their quantiles are not known any better
_FAINT = 1e-6  # of the brightest gradient: below it errors are measured by this
_PIVOT = 1e-7  # least of the polynomials' values that tells draws apart
_LINEAR = 1e-11
_TILE = 1024  # gradients


@dataclass(frozen=True)
class Band:
    """Quantiles of the maps of many draws.

    Attributes
    ----------
    value : ndarray, shape (quantiles, m, n)
        [W m^-2 sr^-1].
    error : ndarray, shape (m, n)
        Of each of them, as quantiles of these draws.
    maps : int
        How many maps were made, each of one term.
    whole : ndarray, shape (2, m, n)
        Simultaneous band (`gonio.maps.simultaneous`).
    """

    value: Array
    error: Array
    maps: int
    whole: Array


def band_of(
    draws: Sequence[BRDF],
    quantiles: Sequence[float],
    evaluate: Evaluate,
    *,
    rtol: float,
    progress: Callable[[int], None] | None = None,
) -> Band:
    """Pointwise quantiles of the maps of the draws.

    Parameters
    ----------
    draws : sequence of BRDF
        At least one.
    quantiles : sequence of float
        In [0, 1], with linear interpolation between order statistics.
    evaluate : callable
        The map of a BRDF, all of one shape (m, n), to a tolerance of about `rtol`.
    rtol : float
        Error of the interpolation that is allowed, relative to the map, where it is not small against the band anyway.
    progress : callable, optional
        Called with rising numbers; the last is that of the draws.

    Returns
    -------
    Band
    """
    made = 0

    def counted(brdf: BRDF) -> MapValues:
        nonlocal made
        made += 1
        if progress is not None and made < len(draws):
            progress(made)
        return evaluate(brdf)

    shares = _shares(draws, counted)
    while True:
        size = np.sum([np.abs(one.parts[0]) for one in shares], axis=0)
        spread = np.sum([one.spread for one in shares], axis=0)
        allowed = np.maximum(np.maximum(rtol * size, _OF_SPREAD * spread), rtol * _FAINT * float(size.max())) / len(shares)
        late = [one for one in shares if np.any(one.missed > allowed)]
        if not late:
            break
        for one in late:
            one.extend()
    weights = np.concatenate([one.weights for one in shares], axis=1)
    parts = [part for one in shares for part in one.parts]
    value, whole = _quantiles(weights, parts, quantiles), band_of_products(weights, parts)
    if progress is not None:
        progress(len(draws))
    return Band(value, np.sum([one.missed + one.carried() for one in shares], axis=0), made, whole)


class _Interpolant:
    """Maps of the draws as `weights` (draws, k) times `parts` (k arrays of shape (m, n)).

    Parameters
    ----------
    brdfs : sequence of BRDF
        One per draw.
    basis : ndarray, shape (draws, b)
        Values of the polynomials, the constant first.
    degrees : ndarray of int, shape (b,)
        Of the polynomials, rising.
    complete : bool
        Whether the maps are such polynomials.
    evaluate : callable

    Attributes
    ----------
    missed, spread : ndarray, shape (m, n)
        Error of the interpolation, infinite where it is not known; about half the range of the draws.
    """

    def __init__(
        self, brdfs: Sequence[BRDF], basis: Array, degrees: NDArray[np.intp], complete: bool, evaluate: Evaluate
    ) -> None:
        self._brdfs, self._complete, self._evaluate = brdfs, complete, evaluate
        self._rest, self._degrees, self._column = basis.copy(), degrees, 0
        self._nodes: list[int] = []
        self._made: dict[int, MapValues] = {}
        self.weights = np.zeros((len(brdfs), 0))
        self.parts: list[Array] = []
        self._add(0)
        self.spread: Array = np.zeros_like(self.parts[0])
        self.missed: Array = np.full_like(self.spread, np.inf)
        if complete and self._column == len(degrees):
            self.missed = np.zeros_like(self.spread)

    def extend(self) -> None:
        """One degree more; every draw by itself if there is none."""
        before = len(self.parts)
        while self._column < len(self._degrees) and len(self.parts) == before:
            self._add(int(self._degrees[self._column]))
        if len(self.parts) == before:
            if not self._complete:
                self._every()
            self.missed = np.zeros_like(self.missed)
            return
        size = np.abs(self.weights).max(axis=0)
        self.missed = np.sum([w * np.abs(d) for w, d in zip(size[before:], self.parts[before:], strict=True)], axis=0)
        self.spread = self.spread + self.missed
        if self._complete and self._column == len(self._degrees):
            self.missed = np.zeros_like(self.missed)

    def carried(self) -> Array:
        """Error of the maps of the nodes, as it comes through the interpolation (m, n)."""
        errors = [self._made[node].error for node in self._nodes]
        if len(self._nodes) == len(self._brdfs):
            return np.asarray(np.max(errors, axis=0))
        of_maps = np.abs(np.linalg.solve(self.weights[self._nodes].T, self.weights.T)).max(axis=1)
        return np.asarray(np.sum([w * e for w, e in zip(of_maps, errors, strict=True)], axis=0))

    def _add(self, degree: int) -> None:
        """All polynomials of one degree, each with the draw where it is largest after elimination of those before."""
        while self._column < len(self._degrees) and self._degrees[self._column] == degree:
            column = self._rest[:, self._column]
            node = int(np.argmax(np.abs(column)))
            if abs(column[node]) > _PIVOT:
                lower = column / column[node]
                lower[self._nodes] = 0.0
                self._rest[:, self._column + 1 :] -= np.outer(lower, self._rest[node, self._column + 1 :])
                self._made[node] = self._evaluate(self._brdfs[node])
                known = np.zeros_like(self._made[node].value)
                for w, d in zip(self.weights[node], self.parts, strict=True):
                    known += w * d
                self.parts.append(self._made[node].value - known)
                self.weights = np.column_stack((self.weights, lower))
                self._nodes.append(node)
            self._column += 1

    def _every(self) -> None:
        for k, brdf in enumerate(self._brdfs):
            if k not in self._made:
                self._made[k] = self._evaluate(brdf)
        self._nodes = list(range(len(self._brdfs)))
        self.weights, self.parts = np.eye(len(self._brdfs)), [self._made[k].value for k in self._nodes]
        self.spread = np.asarray(0.5 * (np.max(self.parts, axis=0) - np.min(self.parts, axis=0)))


def _shares(draws: Sequence[BRDF], evaluate: Evaluate) -> list[_Interpolant]:
    """One interpolant for each term; one of all draws' own maps if these are not of one form."""
    forms = {tuple((id(term.model), term.weight) for term in brdf.terms) for brdf in draws}
    if len(forms) > 1:
        return [_Interpolant(draws, np.ones((len(draws), 1)), np.zeros(1, dtype=np.intp), False, evaluate)]
    shares = []
    for terms in zip(*(brdf.terms for brdf in draws), strict=True):
        basis, degrees, complete = _polynomials(terms[0].model, np.array([term.values for term in terms]))
        shares.append(_Interpolant([BRDF([term]) for term in terms], basis, degrees, complete, evaluate))
    return shares


def _polynomials(model: Model, values: Array) -> tuple[Array, NDArray[np.intp], bool]:
    """Products of Chebyshev polynomials at parameter arrays (draws, p), their total degrees, whether f_r is one of them."""
    varying = [k for k in range(values.shape[1]) if np.ptp(values[:, k]) > 0.0]
    linear = [_is_linear(model, values, k) for k in varying]
    most = max(1, len(values) // _SHARE)
    tables, limits = [], []
    for k, straight in zip(varying, linear, strict=True):
        x = values[:, k]
        if not straight and model.parameters[k].prior[0] == "log_normal" and x.min() > 0.0:
            x = np.log(x)
        limits.append(1 if straight else _DEGREE)
        tables.append(np.polynomial.chebyshev.chebvander((2.0 * x - x.min() - x.max()) / np.ptp(x), limits[-1]))
    powers: list[tuple[int, ...]] = []
    for degree in range(_DEGREE + 1):
        level = _of_degree(degree, limits)
        if len(powers) + len(level) > most:
            break
        powers += level
    basis = np.array(
        [math.prod((t[:, j] for t, j in zip(tables, p, strict=True)), start=np.ones(len(values))) for p in powers]
    ).T
    return basis, np.array([sum(p) for p in powers], dtype=np.intp), all(linear) and len(powers) == 2 ** len(varying)


def _of_degree(degree: int, limits: Sequence[int]) -> list[tuple[int, ...]]:
    """Exponents below the limits that sum to `degree`."""
    if not limits:
        return [()] if degree == 0 else []
    return [(first, *rest) for first in range(min(degree, limits[0]) + 1) for rest in _of_degree(degree - first, limits[1:])]


def _is_linear(model: Model, values: Array, k: int) -> bool:
    """Whether f_r is linear in the parameter k, by its values at many directions."""
    if model.delta or model.own:
        return False
    lower, upper = float(values[:, k].min()), float(values[:, k].max())
    rng = np.random.default_rng(0)
    theta, phi = np.arcsin(np.sqrt(rng.random((2, 256)))), rng.uniform(0.0, 2.0 * np.pi, (2, 256))
    theta[1, ::2], phi[1, ::2] = (
        theta[0, ::2],
        phi[0, ::2] + np.pi + 0.1 * rng.normal(size=128),
    )  # half of them near a mirror's
    omega_i, omega_r = unit_vector(theta[0], phi[0]), unit_vector(theta[1], phi[1])
    at = []
    for share in (0.0, 0.3, 0.55, 1.0):
        p, out = values[0].copy(), np.zeros(256)
        p[k] = lower + share * (upper - lower)
        accumulate(model)(omega_i, omega_r, p, 1.0, out)
        at.append(out)
    size = np.abs(at[0]) + np.abs(at[3])
    return all(
        bool(np.all(np.abs(f - (at[0] + share * (at[3] - at[0]))) <= _LINEAR * size))
        for share, f in ((0.3, at[1]), (0.55, at[2]))
    )


def _quantiles(weights: Array, parts: Sequence[Array], quantiles: Sequence[float]) -> Array:
    """Pointwise quantiles of weights (draws, k) times parts (k, m, n), shape (quantiles, m, n)."""
    flat, columns = [part.ravel() for part in parts], np.ascontiguousarray(weights.T)
    size = flat[0].size
    out = np.empty((len(quantiles), size))
    at = np.array([q * (len(weights) - 1) for q in quantiles])

    def work(tile: slice) -> None:
        _order(columns, np.array([part[tile] for part in flat]), at, out[:, tile])

    threads.run(work, [slice(k, k + _TILE) for k in range(0, size, _TILE)], threads.available())
    return out.reshape(len(quantiles), *parts[0].shape)


def _order_tile(weights, parts, at, out):  # type: ignore[no-untyped-def]
    """Interpolated order statistics; the draw that had one at a gradient is asked first at the next."""
    draws = weights.shape[1]
    sample = np.empty(draws)
    guess = np.zeros(at.size, dtype=np.int64)
    for g in range(parts.shape[1]):
        sample[:] = 0.0
        for k in range(parts.shape[0]):
            d = parts[k, g]
            for i in range(draws):
                sample[i] += weights[k, i] * d
        for j in range(at.size):
            wanted = int(at[j])
            value = sample[guess[j]]
            below = equal = 0
            for i in range(draws):
                below += 1 if sample[i] < value else 0
                equal += 1 if sample[i] == value else 0
            while below > wanted:  # the next smaller value
                next_value = -1e308
                for i in range(draws):
                    x = sample[i] if sample[i] < value else -1e308
                    next_value = x if x > next_value else next_value
                value, equal = next_value, 0
                for i in range(draws):
                    equal += 1 if sample[i] == value else 0
                below -= equal
            above = value
            while below + equal <= wanted + 1 and below + equal < draws:  # the next larger one
                above = 1e308
                for i in range(draws):
                    x = sample[i] if sample[i] > value else 1e308
                    above = x if x < above else above
                if below + equal == wanted + 1:
                    break
                value, below, equal = above, below + equal, 0
                for i in range(draws):
                    equal += 1 if sample[i] == value else 0
            share = at[j] - wanted
            out[j, g] = value + share * (above - value) if share > 0.0 else value
            found = 0
            for i in range(draws):
                found = max(found, i if sample[i] == value else 0)
            guess[j] = found


_order = jit.kernel(_order_tile, fastmath=True)
