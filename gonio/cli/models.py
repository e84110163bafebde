"""gonio models: which BRDF models there are, with what a user writes: their choices, and parameters, angles in degrees."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import click

from gonio.cli.output import json_option, speaking

if TYPE_CHECKING:
    from gonio.brdf import Parameter


@click.command()
@click.argument("name", required=False)
@json_option
def models(name: str | None, as_json: bool) -> None:
    """List the BRDF models, or explain the one called NAME; NAME[choice=value,...] is one of its forms."""
    from gonio import brdf
    from gonio.brdf.families import find

    with speaking(as_json) as output:
        chosen = [brdf.parse(name)[0]] if name else list(brdf.models().values())
        told = {}
        for model in chosen:
            output.say(f"{model.expression}: {model.doc}")
            for choice, values in find(model.name).choices.items():
                if len(values) > 1:
                    output.say(f"    {choice:<14} " + " or ".join(f'"{value}"' for value in values))
            rows = {_written(parameter): _range(parameter) for parameter in model.parameters}
            for parameter, (key, (lower, upper, unit)) in zip(model.parameters, rows.items(), strict=True):
                default = "" if parameter.default is None else f"; {_number(parameter, parameter.default):g} by default"
                held = (
                    "" if parameter.fixed is None
                    else f"; a fit holds it at {_number(parameter, parameter.fixed):g} unless freed"
                )  # fmt: skip
                output.say(f"    {key:<14} {parameter.doc}, {lower:g} to {upper:g}{unit}{default}{held}")
            output.say(f"    source: {model.reference}")
            told[model.expression] = {
                "doc": model.doc,
                "reference": model.reference,
                "choices": {key: list(values) for key, values in find(model.name).choices.items()},
                "parameters": {
                    key: {"lower": lower, "upper": upper, "doc": parameter.doc}
                    for parameter, (key, (lower, upper, _)) in zip(model.parameters, rows.items(), strict=True)
                },
            }
        output.result(models=told)


def _written(parameter: Parameter) -> str:
    from gonio.config.scene import written_name

    return written_name(parameter)


def _number(parameter: Parameter, value: float) -> float:
    return math.degrees(value) if parameter.unit == "rad" else value


def _range(parameter: Parameter) -> tuple[float, float, str]:
    unit = {"1": "", "rad": " degrees"}.get(parameter.unit, f" {parameter.unit}")
    return _number(parameter, parameter.lower), _number(parameter, parameter.upper), unit
