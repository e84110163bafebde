"""Declaration of one parameter of a model: its range, its default and the prior of a fit."""

from __future__ import annotations

import math
from dataclasses import dataclass

from gonio.errors import ParameterError


@dataclass(frozen=True)
class Parameter:
    """Declaration of one parameter of a model.

    Attributes
    ----------
    name, unit, doc : str
    lower, upper : float
        Closed range.
    prior : tuple
        Default prior of a fit: ``("uniform", lower, upper)`` or ``("log_normal", mean of ln, sd of ln)``, cut to the range.
    fixed : float, optional
        Value at which a fit holds the parameter unless it is freed.
    default : float, optional
        Value where none is given; without it the parameter must be given.
    """

    name: str
    lower: float
    upper: float
    doc: str
    prior: tuple[str, float, float]
    unit: str = "1"
    fixed: float | None = None
    default: float | None = None

    def __post_init__(self) -> None:
        if not self.name.isidentifier():
            raise ParameterError(f"parameter {self.name!r}: its name is used as a keyword; take letters, digits and _")
        if not (math.isfinite(self.lower) and math.isfinite(self.upper) and self.lower < self.upper):
            raise ParameterError(
                f"parameter {self.name}: its range {self.lower:g} to {self.upper:g} is none; give a finite lower end below "
                "the upper one"
            )
        if not (isinstance(self.prior, tuple) and len(self.prior) == 3 and self.prior[0] in ("uniform", "log_normal")):
            raise ParameterError(
                f'parameter {self.name}: its prior {self.prior!r} is not known; write ("uniform", lower, upper) or '
                '("log_normal", mean of ln, standard deviation of ln)'
            )
        for value in (self.fixed, self.default):
            if value is not None:
                self.check(value, f"parameter {self.name}")

    def check(self, value: float, owner: str) -> float:
        """The value as float, or a `ParameterError` naming what is allowed."""
        allowed = f"[{self.lower:g}, {self.upper:g}]" + ("" if self.unit == "1" else f" {self.unit}")
        try:
            number = float("text" if isinstance(value, str | bool) else value)
        except (TypeError, ValueError):
            raise ParameterError(f"{owner}: {self.name} = {value!r} is not a number; choose one inside {allowed}") from None
        if not (math.isfinite(number) and self.lower <= number <= self.upper):
            raise ParameterError(f"{owner}: {self.name} = {number:g} is outside {allowed}; choose one inside")
        return number
