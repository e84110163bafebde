"""gonio models: which BRDF models there are."""

from __future__ import annotations

import click

from gonio.cli.output import json_option, speaking


@click.command()
@click.argument("name", required=False)
@json_option
def models(name: str | None, as_json: bool) -> None:
    """List the BRDF models, or explain the one called NAME."""
    from gonio import brdf

    with speaking(as_json) as output:
        chosen = [brdf.parse(name)[0]] if name else list(brdf.models().values())
        for model in chosen:
            output.say(f"{model.name}: {model.doc}")
            for parameter in model.parameters:
                held = "" if parameter.fixed is None else f"; a fit holds it at {parameter.fixed:g} unless freed"
                unit = "" if parameter.unit == "1" else f" {parameter.unit}"
                output.say(
                    f"    {parameter.name:<8} {parameter.doc}, {parameter.lower:g} to {parameter.upper:g}{unit}{held}"
                )
            output.say(f"    source: {model.reference}")
        output.result(
            models={
                m.name: {
                    "doc": m.doc,
                    "reference": m.reference,
                    "parameters": {p.name: {"lower": p.lower, "upper": p.upper, "doc": p.doc} for p in m.parameters},
                }
                for m in chosen
            }
        )
