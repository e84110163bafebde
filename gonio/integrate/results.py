"""What the integrator returns: a value with its error, a map with what was done."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.errors import IntegrationError, ParameterError
from gonio.integrate.plan import Step
from gonio.integrate.tails import NOTHING, ROUNDING

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Estimate:
    """A value with its error.

    Attributes
    ----------
    value, error : ndarray
        `error` aims never to understate ``abs(value - truth)``.
    error_is_bound : bool
        False where a function of the user's takes part: what it does between the nodes is not known.
    """

    value: Array
    error: Array
    error_is_bound: bool = field(default=True, kw_only=True)


@dataclass(frozen=True)
class MapValues(Estimate):
    """A reflectance map on given gradients.

    Attributes
    ----------
    value, error : ndarray, shape of broadcast(p, q)
        Scene radiance [W m^-2 sr^-1] without the impulses.
    impulses : list of (p, q, weight)
        Delta functions: weight is the coefficient of delta(p - p1) delta(q - q1).
    plan : list of Step
        What was done.
    """

    impulses: list[tuple[float, float, float]]
    plan: list[Step]


def insist(result: MapValues, rtol: float, atol: float) -> MapValues:
    """The result, or an `IntegrationError` that carries it where its error exceeds the tolerance.

    Raises
    ------
    ParameterError
        If a value is NaN or infinite, which only a function of the user's can make it.
    """
    value, error = result.value.ravel(), result.error.ravel()
    largest = max(float(np.max(value, initial=0.0)), -float(np.min(value, initial=0.0)))  # NaN if one is
    if not math.isfinite(largest):
        raise ParameterError("f_r or the radiance is NaN or infinite for a direction above the horizon; both must be finite")
    missed = _missed(value, error, rtol, atol, ROUNDING * largest)
    if missed:
        worst = float(np.max(error[value != 0.0] / np.abs(value[value != 0.0]), initial=0.0))
        raise IntegrationError(
            f"reflectance map: reached a relative error of {worst:.1e} where {rtol:.1e} was asked for, at "
            f"{missed} of {value.size} gradients; ask for a larger rtol or use the result in exc.best",
            result,
        )
    return result


def _count(value, error, rtol, atol, negligible):  # type: ignore[no-untyped-def]
    """How many miss the tolerance by more than rounding."""
    missed = 0
    for k in range(value.size):
        wanted = rtol * abs(value[k])
        wanted = (wanted if wanted > atol else atol) * (1.0 + 1e-9) + NOTHING
        missed += (error[k] > wanted) & (error[k] > negligible)
    return missed


_missed = jit.kernel(_count, fastmath=False)
