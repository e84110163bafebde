"""Values of terms at many pairs of directions: one kernel for each model, and one for each sum of models."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.errors import ParameterError

if TYPE_CHECKING:
    from gonio.brdf.base import Model, Term

Array = NDArray[np.float64]


def accumulate(model: Model) -> Any:
    """``kernel(omega_i (n, 3), omega_r (n, 3), p, weight, out (n,))`` that adds weight * f_r; compiled if it can be."""
    if model.array_function is not None:
        return functools.partial(_accumulate_array, model.array_function)
    if model.function is None:
        raise ParameterError(
            f"{model.name} is a delta function and has no value at a pair of directions; use it in a reflectance map"
        )
    return _accumulate(model.function)


@jit.model
def _known(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float, value: float) -> float:
    """The value, NaN if a direction is; models that need few of the six numbers are faster where all are loaded in a row."""
    return value if (xi == xi) & (yi == yi) & (zi == zi) & (xr == xr) & (yr == yr) & (zr == zr) else math.nan


@functools.cache
def _accumulate(function: Callable[..., float]) -> Any:
    def accumulate_terms(omega_i, omega_r, p, weight, out):  # type: ignore[no-untyped-def]
        i, r = omega_i.ravel(), omega_r.ravel()  # with one index the loop vectorises
        for k in range(out.size):
            xi, yi, zi, xr, yr, zr = i[3 * k], i[3 * k + 1], i[3 * k + 2], r[3 * k], r[3 * k + 1], r[3 * k + 2]
            out[k] += weight * _known(xi, yi, zi, xr, yr, zr, function(xi, yi, zi, xr, yr, zr, p))

    return jit.kernel(accumulate_terms, apart=True)


def sum_kernel(terms: Sequence[Term]) -> tuple[Any, Array] | None:
    """``kernel(omega_i (n, 3), omega_r (n, 3), p, out (n,))`` that fills `out` with a sum of compiled terms, and its p.

    None for a single term or if one isn't compiled.
    """
    functions = tuple(term.model.function for term in terms)
    if len(functions) < 2 or None in functions:
        return None
    packed = np.array([x for term in terms for x in (term.weight, *term.values)])
    return _sum_kernel(functions, tuple(len(term.values) for term in terms)), packed


@functools.cache
def _sum_kernel(functions: tuple[Any, ...], sizes: tuple[int, ...]) -> Any:
    """Kernel of a sum of terms; its parameter array holds, term after term, weight and parameters."""
    total: Any = None
    start = 0
    for function, size in zip(functions, sizes, strict=True):
        total = _joined(total, function, start, size)
        start += 1 + size

    def fill_with_sum(omega_i, omega_r, p, out):  # type: ignore[no-untyped-def]
        i, r = omega_i.ravel(), omega_r.ravel()
        for k in range(out.size):
            xi, yi, zi, xr, yr, zr = i[3 * k], i[3 * k + 1], i[3 * k + 2], r[3 * k], r[3 * k + 1], r[3 * k + 2]
            out[k] = _known(xi, yi, zi, xr, yr, zr, total(xi, yi, zi, xr, yr, zr, p))

    return jit.kernel(fill_with_sum, apart=True)


def _joined(before: Any, function: Callable[..., float], start: int, size: int) -> Any:
    """The sum with one more term, whose weight is p[start]."""
    first, stop = start + 1, start + 1 + size

    def only(xi, yi, zi, xr, yr, zr, p):  # type: ignore[no-untyped-def]
        return p[start] * function(xi, yi, zi, xr, yr, zr, p[first:stop])

    def both(xi, yi, zi, xr, yr, zr, p):  # type: ignore[no-untyped-def]
        return before(xi, yi, zi, xr, yr, zr, p) + p[start] * function(xi, yi, zi, xr, yr, zr, p[first:stop])

    return jit.model(only if before is None else both)


def _accumulate_array(
    function: Callable[[Array, Array, Array], Array], omega_i: Array, omega_r: Array, p: Array, weight: float, out: Array
) -> None:
    unknown = np.isnan(omega_i).any(axis=1) | np.isnan(omega_r).any(axis=1)
    out += weight * np.where(unknown, np.nan, function(omega_i, omega_r, p))
