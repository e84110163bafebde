r"""Derivatives of a BRDF with respect to its parameters.

Compiled models are differentiated automatically (`gonio.brdf.tangent`): the derivative is that of the formula as it is
computed, to the last digits, at the ends of the parameters' ranges too. Numbers that a model derives from its parameters
enter by the chain rule. What cannot be rewritten, and the derived numbers themselves, are differentiated by interpolation
between values inside the parameter's range.

At an end of a range the derivative is one-sided; where it is infinite, so is the number given, but for differences, which
are then merely large. It is never NaN.

References
----------
.. [1] J.-P. Berrut, L. N. Trefethen, "Barycentric Lagrange Interpolation", SIAM Review 46(3), 2004, section 9.3
   (differentiation matrices).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.brdf.tangent import tangent
from gonio.errors import ParameterError

if TYPE_CHECKING:
    from gonio.brdf.base import Model, Term
    from gonio.brdf.parameter import Parameter

Array = NDArray[np.float64]
NODES, LEVELS = 13, 9  # of an interpolating polynomial; of interval lengths tried, each a quarter of the one before
_FIRST = 0.1  # half of the first interval, as a share of how far the parameter has to move to matter
_ENOUGH, _GOOD = 1e-12, 1e-9  # relative error at which no shorter interval is tried: at once; once rounding has taken over
_STEEPER = 3.0  # growth towards the end of a range of a derivative that is infinite there; a root's is 10


def jacobian(terms: tuple[Term, ...], omega_i: Array, omega_r: Array) -> Array:
    """Derivatives of the sum of terms [1/sr per unit of the parameter], shape (k, n), for unit vectors (n, 3)."""
    rows = [_of_term(term, omega_i, omega_r) for term in terms]
    return np.concatenate(rows) if rows else np.zeros((0, len(omega_i)))


def how(model: Model) -> str:
    """How a model is differentiated: ``"automatic"``, or ``"differences: "`` and why."""
    if model.function is None:
        return "differences: it is not compiled" if model.array_function is not None else "none: a delta function"
    try:
        tangent(model.function)
    except ParameterError as exc:
        return f"differences: {exc}"
    return "automatic"


def _of_term(term: Term, omega_i: Array, omega_r: Array) -> Array:
    model, p = term.model, term.values
    k = len(model.parameters)
    if k == 0:
        return np.zeros((0, len(omega_i)))
    out = np.zeros((k, len(omega_i)))
    if how(model) == "automatic":
        _filling(model.function)(omega_i, omega_r, p, seeds(model, p), term.weight, out)
        for j in np.flatnonzero(np.isnan(out).any(axis=1)):  # an infinity met a zero or another one on the way
            lost = np.isnan(out[j])
            out[j, lost] = _beside(term, int(j), omega_i[lost], omega_r[lost])
        return out
    return _differences(term, omega_i, omega_r)


def _beside(term: Term, j: int, omega_i: Array, omega_r: Array) -> Array:
    """Derivative (n,) by parameter j at the end of its range, as the limit from inside."""
    model, k = term.model, len(term.model.parameters)
    parameter = model.parameters[j]
    inward = 1.0 if term.values[j] < 0.5 * (parameter.lower + parameter.upper) else -1.0
    near = []
    for share in (1e-12, 1e-14):
        p = term.values[:k].copy()
        p[j] += inward * share * _scale(parameter, float(p[j]))
        p, out = model.complete(p), np.zeros((1, len(omega_i)))
        _filling(model.function)(omega_i, omega_r, p, seeds(model, p)[j : j + 1], term.weight, out)
        near.append(out[0])
    far, close = near
    limit = np.where(np.abs(close) > _STEEPER * np.abs(far), np.copysign(np.inf, close), close)
    again = _differences(term, omega_i, omega_r)[j] if np.isnan(limit).any() else limit
    return np.asarray(np.where(np.isnan(limit), again, limit))


def _scale(parameter: Parameter, x: float) -> float:
    """How far a parameter has to move to matter."""
    kind, a, b = parameter.prior
    wide = b - a if kind == "uniform" else max(abs(x), float(np.exp(a - 3.0 * b)))
    return min(wide, parameter.upper - parameter.lower)


@functools.cache
def _filling(function: Callable[..., float]) -> Any:
    """``kernel(omega_i (n, 3), omega_r (n, 3), p, seeds (k, p.size), weight, out (k, n))``."""
    slope = tangent(function).function

    def fill_slopes(omega_i, omega_r, p, seeds, weight, out):  # type: ignore[no-untyped-def]
        i, r = omega_i.ravel(), omega_r.ravel()
        for j in range(seeds.shape[0]):
            to, d = out[j], seeds[j]
            for k in range(to.size):
                a, b = 3 * k, 3 * k + 1
                to[k] = weight * slope(i[a], i[b], i[a + 2], r[a], r[b], r[a + 2], p, d)[1]

    return jit.kernel(fill_slopes, apart=True)


def seeds(model: Model, p: Array) -> Array:
    """Derivatives of the parameter array, derived numbers included, with respect to the k parameters: (k, p.size)."""
    k = len(model.parameters)
    if model.derived is None:
        return np.eye(k, len(p))
    if model.derived_slopes is not None:
        return np.concatenate((np.eye(k), model.derived_slopes(p[:k])), axis=1)
    return _seeds(model.derived, model.parameters, tuple(map(float, p[:k])))


@functools.lru_cache(maxsize=256)
def _seeds(derived: Callable[[Array], Array], parameters: tuple[Parameter, ...], values: tuple[float, ...]) -> Array:
    p = np.array(values)
    rows = [differentiate(_along(derived, p, j), values[j], parameter) for j, parameter in enumerate(parameters)]
    out = np.concatenate((np.eye(len(p)), np.array(rows)), axis=1)
    out.flags.writeable = False
    return out


def _along(function: Callable[[Array], Array], p: Array, j: int) -> Callable[[float], Array]:
    def moved(value: float) -> Array:
        q = p.copy()
        q[j] = value
        return np.asarray(function(q), dtype=float)

    return moved


def _differences(term: Term, omega_i: Array, omega_r: Array) -> Array:
    from gonio.brdf.kernels import accumulate

    model, kernel = term.model, accumulate(term.model)
    k = len(model.parameters)

    def f_r(q: Array) -> Array:
        out = np.zeros(len(omega_i))
        kernel(omega_i, omega_r, model.complete(q), term.weight, out)
        return out

    columns = [
        differentiate(_along(f_r, term.values[:k], j), float(term.values[j]), parameter)
        for j, parameter in enumerate(model.parameters)
    ]
    return np.array(columns)


def differentiate(function: Callable[[float], Array], x: float, parameter: Parameter) -> Array:
    """Derivative (m,) of a function of one parameter at x, from values inside the parameter's range only.

    Polynomials through Chebyshev nodes on shorter and shorter intervals around x, one-sided where the range ends; of each
    number the derivative counts that changes least if the farthest node is left out.
    """
    half = _FIRST * _scale(parameter, x)
    best = error = np.zeros(0)
    worst = np.inf
    for level in range(LEVELS):
        nodes, weights = _rule(x, max(parameter.lower, x - half), min(parameter.upper, x + half))
        if level == 0:
            middle, *ends = (function(float(t)) for t in (x, nodes[0], nodes[-1]))
            if all(np.array_equal(middle, end) for end in ends):
                return np.zeros(len(middle))
        differences = np.array([function(float(t)) - middle if t != x else np.zeros(len(middle)) for t in nodes])
        now, check = weights @ differences
        change = np.abs(now - check)
        if level == 0:
            best, error = now, change
        else:
            better = change < error
            best, error = np.where(better, now, best), np.where(better, change, error)
        before, worst = worst, float(np.max(error) / (np.max(np.abs(best)) or 1.0))
        if worst <= _ENOUGH or _GOOD >= worst > 0.5 * before:
            break
        half *= 0.25
    return best


def _rule(x: float, lower: float, upper: float) -> tuple[Array, Array]:
    """Nodes with x among them, and the weights of f - f(x) in the polynomial's derivative at x: by all nodes, and by all but
    the farthest; shapes (n,) and (2, n)."""
    nodes = 0.5 * (lower + upper) - 0.5 * (upper - lower) * np.cos(np.pi * np.arange(NODES) / (NODES - 1))
    nodes = np.clip(nodes, lower, upper)
    at, farthest = int(np.argmin(np.abs(nodes - x))), int(np.argmax(np.abs(nodes - x)))
    nodes[at] = x
    apart = (nodes[:, None] - nodes[None, :]) / (upper - lower) * 4.0
    np.fill_diagonal(apart, 1.0)
    barycentric = 1.0 / np.prod(apart, axis=1)
    fewer = barycentric * apart[:, farthest]
    fewer[farthest] = 0.0
    to = x - nodes
    to[at] = np.inf  # values are taken relative to the one at x
    return nodes, np.stack([w / w[at] / to for w in (barycentric, fewer)])
