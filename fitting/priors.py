r"""Priors of one parameter each, and where they are cut.

A prior is a tuple in the registry of models, in fit.toml and in ``fit(priors=...)``:

==============================  ==================================================================
``("uniform", lower, upper)``   constant between two values
``("log_uniform", lower, upper)``  constant in the logarithm
``("normal", mean, sd)``        Gauss
``("log_normal", mean, sd)``    Gauss in the natural logarithm; mean and sd are those of ln x
``("half_normal", sd)``         Gauss around 0, positive half
==============================  ==================================================================

Every prior is proper and is cut to the range of its parameter. Densities are given without their normalisation: a fit
needs ratios only, and no evidence is computed here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gonio.errors import ParameterError

Array = NDArray[np.float64]
UNIFORM, LOG_UNIFORM, NORMAL, LOG_NORMAL, HALF_NORMAL = range(5)
_CODES = {
    "uniform": UNIFORM,
    "log_uniform": LOG_UNIFORM,
    "normal": NORMAL,
    "log_normal": LOG_NORMAL,
    "half_normal": HALF_NORMAL,
}
_GRID = 4001  # nodes of the tabulated distribution function


@dataclass(frozen=True)
class Prior:
    """One prior on the range left to it.

    Attributes
    ----------
    kind : str
        A name of the table above.
    a, b : float
        Its two numbers (``half_normal``: `b` is its sd, `a` is 0).
    lower, upper : float
        Range; infinite on both sides for a normal prior of an unbounded parameter.
    """

    kind: str
    a: float
    b: float
    lower: float
    upper: float

    @property
    def code(self) -> int:
        """Number of the kind, for kernels."""
        return _CODES[self.kind]

    @property
    def bounded(self) -> bool:
        return math.isfinite(self.lower) and math.isfinite(self.upper)

    @property
    def logarithmic(self) -> bool:
        """The natural coordinate of the parameter is its logarithm."""
        return self.kind in ("log_uniform", "log_normal")

    def log_density(self, x: Array) -> Array:
        """Logarithm of the density, up to a constant; -inf outside the range.

        Parameters
        ----------
        x : ndarray, shape (...)
            In the parameter's own unit.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.kind == "uniform":
                value = np.zeros_like(x)
            elif self.kind == "log_uniform":
                value = -np.log(x)
            elif self.kind == "log_normal":
                value = -np.log(x) - 0.5 * ((np.log(x) - self.a) / self.b) ** 2
            else:
                value = -0.5 * ((x - self.a) / self.b) ** 2
        return np.where((x >= self.lower) & (x <= self.upper), value, -np.inf)

    def _table(self) -> tuple[Array, Array]:
        """Natural coordinate (x or ln x) and distribution function on a grid."""
        lower, upper = (self.lower, self.upper) if self.bounded else (self.a - 8 * self.b, self.a + 8 * self.b)
        if self.logarithmic:
            grid = np.linspace(math.log(lower), math.log(upper), _GRID)
            x = np.clip(np.exp(grid), lower, upper)
            log_p = self.log_density(x) + grid
        else:
            grid = np.linspace(lower, upper, _GRID)
            log_p = self.log_density(grid)
        density = np.exp(log_p - log_p.max())
        cumulative = np.concatenate(([0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))))
        return grid, cumulative / cumulative[-1]

    def draw(self, rng: np.random.Generator, n: int) -> Array:
        """Draws, shape (n,), in the parameter's own unit."""
        grid, cumulative = self._table()
        value = np.interp(rng.uniform(size=n), cumulative, grid)
        return np.clip(np.exp(value) if self.logarithmic else value, self.lower, self.upper)

    def sd(self) -> float:
        """Standard deviation of the natural coordinate: of x, or of ln x if `logarithmic`."""
        grid, cumulative = self._table()
        mass, middle = np.diff(cumulative), 0.5 * (grid[1:] + grid[:-1])
        mean = float(mass @ middle)
        return math.sqrt(float(mass @ (middle - mean) ** 2))


def prior(given: Sequence[object], lower: float, upper: float, owner: str) -> Prior:
    """A checked prior, cut to a parameter's range.

    Parameters
    ----------
    given : sequence
        A tuple of the table above.
    lower, upper : float
        The parameter's range.
    owner : str
        Qualified name of the parameter, for messages.

    Raises
    ------
    ParameterError
        If the tuple is malformed or leaves no room inside the range.
    """
    kind = given[0] if len(given) else None
    if not isinstance(kind, str) or kind not in _CODES:
        raise ParameterError(f"prior of {owner}: {kind!r} is unknown; choose one of {', '.join(_CODES)}")
    wanted = 1 if kind == "half_normal" else 2
    numbers = given[1:]
    if len(numbers) != wanted or not all(isinstance(v, int | float) and math.isfinite(v) for v in numbers):
        raise ParameterError(f"prior of {owner}: {kind} takes {wanted} finite number(s), got {tuple(numbers)!r}")
    a, b = (0.0, float(numbers[0])) if wanted == 1 else (float(numbers[0]), float(numbers[1]))  # type: ignore[arg-type]
    if kind in ("uniform", "log_uniform"):
        if not a < b or (kind == "log_uniform" and a <= 0):
            raise ParameterError(f"prior of {owner}: {kind}({a:g}, {b:g}) is empty; the lower bound must be less")
        low, high = max(lower, a), min(upper, b)
    else:
        if b <= 0:
            raise ParameterError(f"prior of {owner}: the standard deviation {b:g} must be positive")
        low, high = lower, upper
        if kind == "half_normal":
            low, high = max(low, 0.0), min(high, 20.0 * b)
        elif kind == "log_normal":  # 8 sd hold all of it; ln 0 is not needed
            low, high = max(low, math.exp(max(a - 8 * b, -700.0))), min(high, math.exp(min(a + 8 * b, 700.0)))
        elif math.isfinite(lower) or math.isfinite(upper):
            low, high = max(low, a - 20 * b), min(high, a + 20 * b)
    if not low < high:
        raise ParameterError(
            f"prior of {owner}: {kind}({', '.join(f'{v:g}' for v in (a, b))}) leaves nothing of the parameter's range "
            f"[{lower:g}, {upper:g}]; move it inside"
        )
    return Prior(kind, a, b, low, high)
