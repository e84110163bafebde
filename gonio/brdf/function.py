"""A BRDF from any Python function.

A scalar function that numba can compile runs like a built-in model. Any other, or one that takes arrays, is called with
arrays of directions: slower, integrated by the same rules. The function is asked only for pairs of directions above the
horizon; a value that is negative or not finite is an error that names the directions.

What the function does between the nodes of a quadrature nobody knows: a lobe narrower than about a degree must be declared
(`lobe_width`), a jump or kink may be (`kinks`), and the errors of its integrals are estimates.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.brdf.base import BRDF, Model, Term
from gonio.brdf.kernels import _accumulate
from gonio.errors import ParameterError
from gonio.geometry import unit_vector

Array = NDArray[np.float64]


def from_function(
    function: Callable[..., Any],
    *,
    name: str = "function",
    isotropic: bool = True,
    reciprocal: bool = False,
    lobe_width: float | None = None,
    kinks: Callable[[Array], Array] | None = None,
) -> BRDF:
    """A BRDF of one term, a function of yours.

    Parameters
    ----------
    function : callable
        Either ``f(omega_i, omega_r)`` of unit vectors (n, 3) in the local frame (normal along +z) that returns f_r (n,)
        [1/sr], or ``f(xi, yi, zi, xr, yr, zr)`` of their components that returns one number and is compiled if numba can.
    name : str, optional
        Shown in plans and messages.
    isotropic : bool, optional
        f_r does not change when both directions turn about the normal. False: its integrals need a `tangent`.
    reciprocal : bool, optional
        f_r(omega_i, omega_r) = f_r(omega_r, omega_i) holds. It is believed, and used where it saves work.
    lobe_width : float, optional
        Half width [rad] of the narrowest lobe around the mirror direction, in half-vector angle (half of the reflected
        lobe's own half width).
    kinks : callable, optional
        ``omega_r (3,) -> (k, 4)``: planes ``c . omega_i = d`` (rows c_x, c_y, c_z, d) across which f_r or a derivative
        jumps. Without it kinks cost nodes, not honesty.

    Raises
    ------
    ParameterError
        If the function takes neither 2 nor 6 arguments, fails, or gives values that are no BRDF's on a probe of
        directions.

    Examples
    --------
    >>> matte = from_function(lambda omega_i, omega_r: np.full(len(omega_i), 0.5 / math.pi))
    >>> round(float(matte.f_r(0.3, 0.0, 0.9, 3.0)) * math.pi, 15)
    0.5
    """
    if lobe_width is not None and not (math.isfinite(lobe_width) and 1e-9 <= lobe_width <= math.pi):
        raise ParameterError(f"{name}: lobe_width = {lobe_width:g} rad; give a half width between 1e-9 and pi, or None")
    inner = getattr(function, "py_func", function)  # of a function that is compiled already
    count = _arity(inner, name)
    compiled = _compile(inner) if count == 6 else None
    model = Model(
        name=name,
        parameters=(),
        function=compiled,
        doc=(inspect.getdoc(inner) or "A function of the user's.").splitlines()[0],
        reference="the user",
        lobe_width=None if lobe_width is None else lambda p: float(lobe_width),
        kinks=None if kinks is None else lambda p, omega_r: _planes(kinks(omega_r), name),
        array_function=None if compiled is not None else _guarded(inner, name, scalar=count == 6),
        isotropic=isotropic,
        reciprocal=reciprocal,
        energy_bounded=False,
        own=True,
    )
    brdf = BRDF([Term(model, np.empty(0))])
    _probe(brdf, name)
    return brdf


def probe(brdf: BRDF) -> BRDF:
    """The BRDF of one term that is not gonio's own, once its function has compiled and its values are a BRDF's.

    Raises
    ------
    ParameterError
        If not; the message says what is wrong, or where.
    """
    import numba

    name = brdf.terms[0].model.name
    try:
        _probe(brdf, name)
    except numba.errors.NumbaError as exc:
        lines = [line.strip() for line in str(exc).splitlines() if line.strip()]
        told = next((line for line in lines if not line.startswith(("Failed in", "During", "File"))), lines[0])
        told = told.rstrip(".")
        raise ParameterError(f"{name}: its function does not compile, {told}; write plain arithmetic and math") from exc
    return brdf


def _arity(function: Callable[..., Any], name: str) -> int:
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # a builtin without a signature
        return 2
    if any(p.kind is p.VAR_POSITIONAL for p in parameters):
        return 2
    plain = [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD) and p.default is p.empty]
    if len(plain) not in (2, 6):
        raise ParameterError(
            f"{name}: the function takes {len(plain)} arguments; write f(omega_i, omega_r) of arrays (n, 3), or "
            "f(xi, yi, zi, xr, yr, zr) of numbers"
        )
    return len(plain)


def _compile(function: Callable[..., Any]) -> Callable[..., float] | None:
    """The scalar function as a model function, 0 below the horizon; None if it cannot be compiled."""
    import numba

    try:
        inner = jit.model(function)
    except TypeError:
        return None  # it leans on objects that the kernel cache cannot follow

    def above_horizon(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float, p: list[float]) -> float:
        return float(inner(xi, yi, zi, xr, yr, zr)) if zi > 0.0 and zr > 0.0 else 0.0

    model = jit.model(above_horizon)
    one = np.array([[0.0, 0.6, 0.8]])
    try:
        _accumulate(model)(one, one, np.empty(0), 1.0, np.zeros(1))
    except (numba.errors.NumbaError, TypeError, NotImplementedError):
        return None  # not in numba's language
    return model  # type: ignore[no-any-return]


def _guarded(function: Callable[..., Any], name: str, *, scalar: bool) -> Callable[[Array, Array, Array], Array]:
    """The function on arrays: 0 below the horizon, checked values."""

    def evaluate(omega_i: Array, omega_r: Array, p: Array) -> Array:
        out = np.zeros(len(omega_i))
        lit = (omega_i[:, 2] > 0) & (omega_r[:, 2] > 0)
        wi, wr = omega_i[lit], omega_r[lit]
        if not len(wi):
            return out
        if scalar:
            value = np.array([float(function(*a, *b)) for a, b in zip(wi.tolist(), wr.tolist(), strict=True)])
        else:
            value = np.asarray(function(wi, wr), dtype=float)
            if value.shape != (len(wi),):
                raise ParameterError(
                    f"{name}: for directions of shape {wi.shape} the function returned shape {value.shape}; "
                    f"return ({len(wi)},)"
                )
        out[lit] = _checked(value, wi, wr, name)
        return out

    return evaluate


def _checked(value: Array, wi: Array, wr: Array, name: str) -> Array:
    bad = np.flatnonzero(~(np.isfinite(value) & (value >= 0)))
    if bad.size:
        k = int(bad[0])
        raise ParameterError(
            f"{name}: f_r = {value[k]:g} 1/sr at omega_i = {np.array2string(wi[k], precision=6)}, omega_r = "
            f"{np.array2string(wr[k], precision=6)}; a BRDF is finite and never negative"
        )
    return value


def _planes(given: Any, name: str) -> Array:
    planes = np.asarray(given, dtype=float)
    if planes.size == 0:
        return np.empty((0, 4))
    if planes.ndim != 2 or planes.shape[1] != 4 or not np.all(np.isfinite(planes)):
        raise ParameterError(f"{name}: kinks returned shape {planes.shape}; return finite rows c_x, c_y, c_z, d")
    length = np.linalg.norm(planes[:, :3], axis=1)
    if np.any(length == 0):
        raise ParameterError(f"{name}: a plane of kinks without a direction; a row starts with its normal")
    return np.asarray(planes / length[:, None])


def _probe(brdf: BRDF, name: str) -> None:
    """A few hundred directions, near the normal and near the horizon."""
    rng = np.random.default_rng(0)
    theta = np.concatenate((np.arccos(rng.uniform(0, 1, (160, 2))), [[0.0, 0.0], [0.7, 0.7], [1.5, 0.1], [0.1, 1.5]]))
    phi = np.concatenate((rng.uniform(0, 2 * np.pi, (160, 2)), [[0.0, 0.0], [0.0, np.pi], [0.0, 1.0], [2.0, 3.0]]))
    wi, wr = (unit_vector(theta[:, k], phi[:, k]) for k in (0, 1))
    _checked(brdf.evaluate(wi, wr), wi, wr, name)
