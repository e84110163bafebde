"""BRDF models: make one by name, add them up."""

from __future__ import annotations

from typing import Any

from gonio.brdf.base import BRDF, Model, Parameter, Term, term_names
from gonio.brdf.families import FAMILIES, Family, find, parse
from gonio.brdf.function import from_function

__all__ = ["BRDF", "Family", "Model", "Parameter", "Term", "from_function", "make", "models", "parse", "term_names"]


def models() -> dict[str, Model]:
    """All registered models by name, each with its default choices."""
    return {name: family.model() for name, family in FAMILIES.items()}


def make(name: str, **parameters: Any) -> BRDF:
    """A BRDF of one model.

    Parameters
    ----------
    name : str
        A key of `models`.
    **parameters : float or str
        The parameters of the model; angles in radians. Also the choices of models that come in several forms, such as
        ``variant="full"`` of oren_nayar.

    Raises
    ------
    ParameterError
        If the name, a parameter or a choice is unknown, missing or outside its range.

    Examples
    --------
    >>> make("lambertian", albedo=0.8) + make("ggx", k_s=1.0, alpha=0.3, f_0=0.04)
    lambertian(albedo=0.8) + ggx(k_s=1, alpha=0.3, f_0=0.04)
    """
    family = find(name)
    chosen = {key: parameters.pop(key) for key, value in [*parameters.items()] if isinstance(value, str | bool)}
    model = family.model(**chosen)
    return BRDF([Term(model, model.values(parameters))])
