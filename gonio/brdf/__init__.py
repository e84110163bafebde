"""BRDF models: make one by name, add them up."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from gonio.brdf import plugins
from gonio.brdf.base import BRDF, Model, Term, term_names
from gonio.brdf.families import FAMILIES, Family, find, parse
from gonio.brdf.function import from_function, probe
from gonio.brdf.parameter import Parameter
from gonio.errors import ParameterError

__all__ = ["BRDF", "Family", "Model", "Parameter", "Term", "from_function", "make", "models", "parse", "term_names"]


def models() -> dict[str, Model]:
    """All registered models by name, each with its default choices; those of other packages that load included."""
    found = dict(FAMILIES)
    for name in plugins.names():
        with contextlib.suppress(ParameterError):  # `find` tells why
            found[name] = plugins.load(name)
    return {name: family.model() for name, family in found.items()}


def make(name: str | Model, **parameters: Any) -> BRDF:
    """A BRDF of one model.

    Parameters
    ----------
    name : str or Model
        A key of `models`; or a model of your own, whose values are tried for a few hundred directions; errors of integrals
        over it are estimates.
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
    if isinstance(name, Model):
        return _made(name if _built_in(name) else replace(name, own=True), parameters)
    if not isinstance(name, str):
        raise ParameterError(f"a BRDF model is named by its name or given as a gonio.brdf.Model, not as {name!r}")
    family = find(name)
    model = family.model(**{key: parameters.pop(key) for key in family.choices if key in parameters})
    unknown = set(parameters) - {parameter.name for parameter in model.parameters}
    for key in sorted(unknown):
        if isinstance(parameters[key], str | bool):
            family.model(**{key: parameters[key]})  # tells which choices there are
    return _made(model, parameters)


def _built_in(model: Model) -> bool:
    family = FAMILIES.get(model.name)
    return family is not None and family.model(**dict(model.choices)) is model


def _made(model: Model, parameters: Mapping[str, Any]) -> BRDF:
    brdf = BRDF([Term(model, model.values(parameters))])
    return probe(brdf) if model.own and not model.delta else brdf
