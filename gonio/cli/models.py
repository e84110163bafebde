"""gonio models: which BRDF models there are, and what one of them is."""

from __future__ import annotations

import inspect
import math
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from gonio.cli.formulas import plain
from gonio.cli.output import Output, json_option, speaking
from gonio.config.scene import written_name
from gonio.errors import ParameterError

if TYPE_CHECKING:
    from gonio.brdf import Family, Model, Parameter


@click.command()
@click.argument("name", required=False)
@click.option("--plot", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE.png", help="Draw the lobe of NAME.")
@json_option
def models(name: str | None, plot: Path | None, as_json: bool) -> None:
    """List the BRDF models, or explain the one called NAME, such as ggx or "oren_nayar[variant=full]"."""
    from gonio import brdf

    if plot is not None and name is None:
        raise ParameterError("--plot draws one model; name it: gonio models NAME --plot FILE.png")
    with speaking(as_json) as output:
        if name is None:
            _list(output, _loaded(output))
            return
        model, *others = brdf.parse(name)
        if others:
            raise ParameterError(f"{name} is a sum; explain one model at a time: gonio models {model.expression}")
        _explain(output, brdf.families.find(model.name), model)
        shown = _typical(model)
        if shown is None:
            if plot is not None:
                raise ParameterError(f"{model.name} is a delta function and has no lobe to draw; leave --plot out")
        else:
            from gonio.report import lobe

            output.say(f"\n{shown!r} in the plane of incidence:\n")
            output.say(lobe.text(shown))
            if plot is not None:
                _draw(shown, plot)
                output.say(f"wrote {plot}")
        output.result(models={model.name: _plain(model)})


def _loaded(output: Output) -> dict[str, Family]:
    """All families; those of other packages that do not load are told of."""
    from gonio.brdf import families, plugins

    found = dict(families.FAMILIES)
    for name in plugins.names():
        try:
            found.setdefault(name, plugins.load(name))
        except ParameterError as exc:
            output.warn(str(exc))
    return found


def _list(output: Output, found: dict[str, Family]) -> None:
    default = {name: family.model() for name, family in found.items()}
    width = max(map(len, found))
    for name, model in default.items():
        flags = f"{'R' if model.reciprocal else '-'} {'E' if model.energy_bounded else '-'}"
        choices = "; ".join(f"{key}={'|'.join(allowed)}" for key, allowed in found[name].choices.items())
        numbers = ", ".join(map(written_name, model.parameters))
        output.say(f"{name:<{width}}  {flags}  {numbers}{f'  [{choices}]' if choices else ''}")
    output.say("\nR: reciprocal; E: directional albedo at most 1. `gonio models NAME` explains one and draws its lobe.")
    output.result(models={name: _plain(model) for name, model in default.items()})


def _explain(output: Output, family: Family, model: Model) -> None:
    from gonio.brdf import derivatives

    output.say(f"{model.expression}: {model.doc}\n")
    about = _page(model)
    if about:
        output.say(about + "\n")
    for p in model.parameters:
        output.say(f"{written_name(p):<12} {_range(p)}: {p.doc}")
        output.say(f"{'':<12} prior of a fit: {_prior(p)}{_held(p)}")
    for key, allowed in family.choices.items():
        made = dict(model.choices).get(key, allowed[0])
        output.say(f"{key}: " + ", ".join(f"{a} (this one)" if a == made else a for a in allowed))
    flags = [
        "Reciprocal" if model.reciprocal else "Not reciprocal",
        "directional albedo at most 1" if model.energy_bounded else "directional albedo can exceed 1",
        "isotropic" if model.isotropic else "anisotropic",
    ]
    output.say(f"\n{'; '.join(flags)}.")
    output.say(f"Derivatives by its parameters: {derivatives.how(model)}.")
    output.say(f"Source: {model.reference}.")


def _page(model: Model) -> str:
    """Docstring of the file that defines the model, without its references, its formulas in plain characters."""
    function: Callable[..., Any] | None = getattr(model.function, "py_func", model.array_function)
    module = sys.modules.get(getattr(function, "__module__", "") or "")
    text = inspect.cleandoc(module.__doc__ or "") if module is not None else ""
    text = text.partition("\nReferences\n")[0]
    text = re.sub(r"\n{3,}", "\n\n", plain(re.sub(r" ?\[\d+\]_", "", text)))
    return "\n".join(f"    {line}".rstrip() for line in text.strip().splitlines())


def _number(value: float, parameter: Parameter) -> str:
    """A value of the parameter; an angle in degrees."""
    return f"{math.degrees(value):.4g}" if parameter.unit == "rad" else f"{value:.6g}"


def _unit(parameter: Parameter) -> str:
    return {"1": "", "rad": " deg"}.get(parameter.unit, f" {parameter.unit}")


def _range(parameter: Parameter) -> str:
    low, high = (_number(x, parameter) for x in (parameter.lower, parameter.upper))
    return f"{low} to {high}{_unit(parameter)}"


def _prior(parameter: Parameter) -> str:
    kind, a, b = parameter.prior
    if kind == "uniform":
        return f"uniform {_number(a, parameter)} to {_number(b, parameter)}{_unit(parameter)}"
    return f"log-normal, median {_number(math.exp(a), parameter)}{_unit(parameter)}, 68 % within a factor {math.exp(b):.3g}"


def _held(parameter: Parameter) -> str:
    held = "" if parameter.fixed is None else f"; held at {_number(parameter.fixed, parameter)} unless freed"
    return held if parameter.default is None else f"{held}; default {_number(parameter.default, parameter)}"


def _typical(model: Model) -> Any:
    """The BRDF at its priors' medians, lower quartiles of uniform ones, and fixed values; None for a delta function."""
    from gonio.brdf import make

    if model.delta:
        return None
    return make(model, **{p.name: _centre(p) for p in model.parameters})


def _centre(parameter: Parameter) -> float:
    if parameter.fixed is not None:
        return parameter.fixed
    if parameter.default is not None:
        return parameter.default
    kind, a, b = parameter.prior
    return min(max(math.exp(a) if kind == "log_normal" else a + 0.25 * (b - a), parameter.lower), parameter.upper)


def _draw(brdf: Any, plot: Path) -> None:
    from gonio.report import lobe, style
    from gonio.report.html import write_bytes

    if plot.suffix.lower() != ".png":
        raise ParameterError(f"--plot {plot} is no .png file; name one")
    write_bytes(plot, style.png(lobe.figure(brdf, repr(brdf))))


def _plain(model: Model) -> dict[str, Any]:
    return {
        "doc": model.doc,
        "reference": model.reference,
        "reciprocal": model.reciprocal,
        "energy_bounded": model.energy_bounded,
        "isotropic": model.isotropic,
        "choices": dict(model.choices),
        "parameters": {
            p.name: {
                "lower": p.lower, "upper": p.upper, "unit": p.unit, "prior": list(p.prior), "fixed": p.fixed,
                "default": p.default, "doc": p.doc,
            }
            for p in model.parameters
        },
    }  # fmt: skip
