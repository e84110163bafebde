r"""The linear part of a model: coefficients such as an albedo, in which f_r is linear while the other parameters are held.

Of each term of the sum at most one free parameter counts as linear, so that all of them are linear together:

.. math:: \hat f_j = a_j(q) + \sum_k c_k\,b_{jk}(q) .

Given the others, q, they follow from linear algebra: the start of a fit solves for them (variable projection [1]_), and
where the variances do not depend on them, `fitting.marginal` integrates them out. This module evaluates a and b for the
compiled models and accumulates their weighted products; it knows no priors.

References
----------
.. [1] G. H. Golub, V. Pereyra, "The differentiation of pseudo-inverses and nonlinear least squares problems whose variables
   separate", SIAM J. Numer. Anal. 10(2), 1973.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fitting.likelihood import Problem, shared_factor
from gonio import jit

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Coefficient:
    """One linear parameter.

    Attributes
    ----------
    name : str
        Qualified.
    term : int
        Number of its term.
    place : int
        Among the free parameters of the problem.
    column : int
        Among all declared parameters.
    factor : bool
        The whole term is proportional to it.
    channels : frozenset of int
        Numbers of the channels that it belongs to.
    """

    name: str
    term: int
    place: int
    column: int
    factor: bool
    channels: frozenset[int]


def coefficients(problem: Problem, accept: Callable[[int], bool] = lambda place: True) -> tuple[Coefficient, ...]:
    """The linear parameters of a problem, at most one of each term, factors first.

    Parameters
    ----------
    problem : Problem
    accept : callable, optional
        Of the place of a free parameter: whether it may be one.
    """
    found: dict[int, Coefficient] = {}
    for number, (_, model, _) in enumerate(problem.terms):
        names = [p.name for p in model.parameters]
        for channel in range(len(problem.channels.names)):
            columns = problem.columns(number, channel)
            for short in (*model.factors, *model.affine):
                column = int(columns[names.index(short)])
                name = problem.space.declared[column].name
                if name in problem.space.names and accept(place := problem.space.names.index(name)):
                    one = Coefficient(name, number, place, column, short in model.factors, frozenset((channel,)))
                    before = found.get(column, one)
                    found[column] = replace(one, channels=before.channels | one.channels)
                    break
    return tuple(found.values())


def of_block(problem: Problem, linear: tuple[Coefficient, ...], index: int) -> tuple[Coefficient, ...]:
    """The coefficients of the channel to which a block of samples belongs."""
    return tuple(c for c in linear if problem.block_channels[index] in c.channels)


def bases(problem: Problem, linear: tuple[Coefficient, ...], full: Array, index: int) -> tuple[Array, Array]:
    """a and b of one block of samples, before the factor of the shared errors.

    Parameters
    ----------
    full : ndarray, shape (w, number declared)
        Parameters; what it holds for the linear ones does not matter and is overwritten.

    Returns
    -------
    a : ndarray, shape (w, 1, n)
    b : ndarray, shape (p, w, 1, n)
        Of those coefficients that the block's channel has, `of_block`.
    """
    channel = problem.block_channels[index]
    linear = of_block(problem, linear, index)
    directions = problem.directions(full, index)[:, :1]
    if not directions.flags.c_contiguous:
        directions = np.ascontiguousarray(directions)
    shape = (len(full), 1, directions.shape[3])
    a, b = np.zeros(shape), np.zeros((len(linear), *shape))
    owner = {c.term: k for k, c in enumerate(linear)}
    for term in range(len(problem.terms)):
        if term not in owner:
            problem.add_term(term, full, directions, a, channel)
            continue
        c, out = linear[owner[term]], b[owner[term]]
        full[:, c.column] = 1.0
        problem.add_term(term, full, directions, out, channel)
        if not c.factor:
            constant = np.zeros(shape)
            full[:, c.column] = 0.0
            problem.add_term(term, full, directions, constant, channel)
            out -= constant
            a += constant
    return a, b


def _products(a, b, full, offset, log_slope, has_log, about, place, reading, root, out):  # type: ignore[no-untyped-def]
    """Add the weighted products of (f - a - b about, b_1, ..., b_p), factor included, to the lower half of out."""
    p, n = b.shape[0], reading.size
    rows, factor, scaled = np.empty((p + 1, n)), root.copy(), reading * root
    for w in range(out.shape[0]):
        if has_log:
            shared_factor(full[w], offset, log_slope, factor)
            for j in range(n):
                factor[j] *= root[j]
        left, known = rows[0], a[w, 0]
        for j in range(n):
            left[j] = scaled[j] - factor[j] * known[j]
        for k in range(p):
            to, by, c = rows[k + 1], b[k, w, 0], about[k]
            for j in range(n):
                value = factor[j] * by[j]
                to[j] = value
                left[j] -= c * value
        for k in range(p + 1):
            one = rows[k]
            for l in range(k + 1):
                other, total = rows[l], 0.0
                for j in range(n):
                    total += one[j] * other[j]
                out[w, place[k], place[l]] += total


_products_kernel = jit.kernel(_products)


def products(
    problem: Problem, linear: tuple[Coefficient, ...], full: Array, about: Array, reading: Array, root: Array
) -> Array:
    r"""Weighted sums over all samples of the products of :math:`f - a - \sum_k b_k c^0_k, b_1, \dots, b_p`.

    Parameters
    ----------
    full : ndarray, shape (w, number declared)
        Overwritten in the columns of the linear parameters.
    about : ndarray, shape (p,)
        Values c^0, for the sake of rounding: near the optimum.
    reading, root : ndarray, shape (n,)
        f [1/sr] and one over its standard deviation [sr].

    Returns
    -------
    ndarray, shape (w, 1 + p, 1 + p)
        The lower half; the upper one is 0.
    """
    out = np.zeros((len(full), 1 + len(linear), 1 + len(linear)))
    at = 0
    for index in problem.blocks:
        a, b = bases(problem, linear, full, index)
        log_slope, offset, has_log = problem.log_slopes(index)
        cut = slice(at, at + log_slope.shape[1])
        here = [k for k, c in enumerate(linear) if problem.block_channels[index] in c.channels]
        place = np.array([0, *(k + 1 for k in here)], dtype=np.int64)
        _products_kernel(
            a, b, full, offset, log_slope, has_log, about[here], place, reading[cut], root[cut], out
        )
        at = cut.stop
    return out


def columns(problem: Problem, linear: tuple[Coefficient, ...], full: Array) -> tuple[Array, Array]:
    """a, shape (w, n), and b, shape (w, n, p), of all samples, with the factor of the shared errors."""
    known, by = [], []
    for index in problem.blocks:
        a, b = bases(problem, linear, full, index)
        log_slope, offset, _ = problem.log_slopes(index)
        factor = np.exp(full[:, offset : offset + len(log_slope)] @ log_slope)  # (w, n)
        known.append(factor * a[:, 0])
        here = [k for k, c in enumerate(linear) if problem.block_channels[index] in c.channels]
        by.append(np.zeros((*factor.shape, len(linear))))
        by[-1][..., here] = factor[..., None] * b[:, :, 0].transpose(1, 2, 0)
    return np.concatenate(known, axis=1), np.concatenate(by, axis=1)


def _boxed(normal, right, lower, upper, out):  # type: ignore[no-untyped-def]
    """Least squares in a box by coordinate descent: normal (w, p, p) out = right (w, p); the lower half counts."""
    p = right.shape[1]
    for w in range(right.shape[0]):
        for _ in range(400):
            moved = 0.0
            for k in range(p):
                if not normal[w, k, k] > 0.0:
                    continue
                slope = right[w, k]
                for l in range(p):
                    slope -= (normal[w, k, l] if l <= k else normal[w, l, k]) * out[w, l]
                to = min(max(out[w, k] + slope / normal[w, k, k], lower[k]), upper[k])
                moved = max(moved, abs(to - out[w, k]) / (upper[k] - lower[k]))
                out[w, k] = to
            if moved < 1e-10:
                break


_boxed_kernel = jit.kernel(_boxed)


def solve_in_box(products: Array, about: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
    """Coefficients within their ranges that leave the least sum of squares, from `products`.

    Returns
    -------
    c : ndarray, shape (w, p)
    left : ndarray, shape (w,)
        The sum of squares.
    """
    normal, right = np.ascontiguousarray(products[:, 1:, 1:]), np.ascontiguousarray(products[:, 1:, 0])
    start = np.tile(np.clip(about, lower, upper), (len(products), 1))
    step = start - about
    _boxed_kernel(normal, right, lower - about, upper - about, step)
    whole = np.tril(normal) + np.tril(normal, -1).transpose(0, 2, 1)
    left = products[:, 0, 0] - 2.0 * np.einsum("wk,wk->w", right, step) + np.einsum("wk,wkl,wl->w", step, whole, step)
    return about + step, left
