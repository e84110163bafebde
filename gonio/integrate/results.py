"""What the integrator returns: a value with its error, a map with what was done."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gonio.errors import IntegrationError, ParameterError
from gonio.integrate.plan import Step

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
    value, error = result.value, result.error
    if not np.all(np.isfinite(value)):
        raise ParameterError("f_r or the radiance is NaN or infinite for a direction above the horizon; both must be finite")
    missed = error > np.maximum(rtol * np.abs(value), atol) * (1 + 1e-9) + 1e-300
    if np.any(missed & (error > 1e-13 * np.max(np.abs(value), initial=0.0))):
        worst = float(np.max(np.divide(error, np.abs(value), out=np.zeros_like(error), where=value != 0)))
        raise IntegrationError(
            f"reflectance map: reached a relative error of {worst:.1e} where {rtol:.1e} was asked for, at "
            f"{int(missed.sum())} of {value.size} gradients; ask for a larger rtol or use the result in exc.best",
            result,
        )
    return result
