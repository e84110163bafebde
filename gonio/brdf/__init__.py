"""BRDF models: make one by name, add them up."""

from __future__ import annotations

from typing import Any

from gonio.brdf.base import BRDF, Model, Parameter, Term, _suggest, term_names
from gonio.brdf.function import from_function
from gonio.brdf.lambertian import LAMBERTIAN
from gonio.brdf.microfacet import GGX
from gonio.brdf.oren_nayar import OREN_NAYAR
from gonio.brdf.phong import PHONG
from gonio.brdf.specular import SPECULAR
from gonio.errors import ParameterError

__all__ = ["BRDF", "Model", "Parameter", "Term", "from_function", "make", "models", "parse", "term_names"]

_MODELS = {model.name: model for model in (LAMBERTIAN, OREN_NAYAR, PHONG, GGX, SPECULAR)}
_VARIANTS = {("oren_nayar", "qualitative"): OREN_NAYAR}


def models() -> dict[str, Model]:
    """All registered models by name."""
    return dict(_MODELS)


def make(name: str, **parameters: Any) -> BRDF:
    """A BRDF of one model.

    Parameters
    ----------
    name : str
        A key of `models`.
    **parameters : float
        All parameters of the model; angles in radians. Also ``variant=`` of models that come in several: oren_nayar
        ("qualitative").

    Raises
    ------
    ParameterError
        If the name or a parameter is unknown, missing or outside its range.

    Examples
    --------
    >>> make("lambertian", albedo=0.8) + make("ggx", k_s=1.0, alpha=0.3, f_0=0.04)
    lambertian(albedo=0.8) + ggx(k_s=1, alpha=0.3, f_0=0.04)
    """
    model, variant = find(name), parameters.pop("variant", None)
    if variant is not None:
        if (name, variant) not in _VARIANTS:
            known = sorted(v for n, v in _VARIANTS if n == name)
            raise ParameterError(
                f"{name} has no variant {variant!r}{_suggest(str(variant), known)}; "
                + (f"it has: {', '.join(known)}" if known else "leave it out")
            )
        model = _VARIANTS[name, variant]
    return BRDF([Term(model, model.values(parameters))])


def find(name: str) -> Model:
    """The registered model of that name, or a `ParameterError` with the nearest one."""
    if name not in _MODELS:
        raise ParameterError(
            f"there is no BRDF model {name!r}{_suggest(name, _MODELS)}; known are: {', '.join(sorted(_MODELS))}"
        )
    return _MODELS[name]


def parse(expression: str) -> tuple[Model, ...]:
    """The models of a sum such as ``"lambertian+ggx"``."""
    return tuple(find(part.strip()) for part in expression.split("+"))
