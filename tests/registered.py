"""Every registered BRDF model: what tests and benchmarks of all of them go through."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from gonio.brdf import Family, Model, Parameter, families


def variants(family: Family) -> Iterator[Model]:
    """The family with its default choices, then with each other choice by itself."""
    yield family.model()
    for key, allowed in family.choices.items():
        for choice in allowed[1:]:
            yield family.model(**{key: choice})


def registered() -> Iterator[Model]:
    """Every model of every family, each choice once."""
    for family in families.FAMILIES.values():
        yield from variants(family)


def compiled() -> list[Model]:
    """Those that have a value at a pair of directions, and parameters."""
    return [model for model in registered() if model.function is not None and model.parameters]


def middle(parameter: Parameter) -> float:
    """A value well inside the range: the median of a log-normal prior, 0.37 of a uniform one."""
    kind, a, b = parameter.prior
    value = a + 0.37 * (b - a) if kind == "uniform" else math.exp(a)
    return min(max(value, parameter.lower), parameter.upper)


def typical(model: Model) -> NDArray[np.float64]:
    """The model's parameter array, derived numbers included, with every parameter at its middle."""
    return model.complete(np.array([middle(parameter) for parameter in model.parameters]))
