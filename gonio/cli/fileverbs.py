"""gonio convert, check-file: files of anyone, without a run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from gonio.cli.output import Output, json_option, speaking
from gonio.errors import ConfigurationError, DatasetError

if TYPE_CHECKING:
    from gonio.formats import Material
    from gonio.samples import BRDFSamples

FILE = click.argument("file", type=click.Path(path_type=Path, dir_okay=False))
DENSE = 12  # incidences from which a table is believed to interpolate between them


@click.command()
@FILE
@click.argument("out", type=click.Path(path_type=Path))
@click.option(
    "--format", "name", required=True, help="Format of OUT, such as rgl, klems, merl, bird, netcdf; see the guide."
)
@click.option(
    "--quantity", type=click.Choice(["brdf", "brf", "brdf_cos"]), help="What the values are, where the file does not say."
)
@click.option("--channel", help="One channel only, such as red or 550nm.")
@click.option("--model", help="Fit this model, such as lambertian+ggx, and write it where the format needs every direction.")
@json_option
def convert(
    file: Path, out: Path, name: str, quantity: str | None, channel: str | None, model: str | None, as_json: bool
) -> None:
    """Convert FILE to OUT in another format.

    Formats of rows get the samples as they are. Formats that need every direction get a table of the samples, or a model
    fitted to them (--model) where they are sparse.
    """
    from gonio import formats
    from gonio.brdf.tables import Tables
    from gonio.channels import ChannelSamples
    from gonio.formats import opticstudio

    with speaking(as_json) as output:
        form = formats.FORMATS.get(name)
        if form is None or not form.writes:
            known = ", ".join(n for n, f in formats.FORMATS.items() if f.writes)
            raise ConfigurationError(f"gonio cannot write the format {name!r}; choose one of: {known}")
        source = formats.sniff(file)
        attributes = {"source_file": file.name, "source_format": source}
        if source == name == "opticstudio" and not (quantity or channel or model):
            opticstudio.write_table(out, opticstudio.read_table(file))
            what = "the same grid, number for number"
        else:
            found = formats.read(file, quantity)
            if isinstance(found, Tables) and channel is not None:
                found = found.one(channel)
            elif channel is not None:
                found = ChannelSamples.of(formats.one_channel(file, found, channel))
            samples = None if isinstance(found, Tables) else found
            if form.writes == "grid" or (form.writes == "samples" and samples is None):
                material = _material(output, found, model, attributes)
                formats.export(name, out, material=material, attributes=attributes)
                what = f"from a {material.attributes['origin']}"
            else:
                table = found if isinstance(found, Tables) else None
                formats.export(name, out, samples=samples, table=table, attributes=attributes)
                what = "the samples as they are" if samples is not None else "the table as it is"
        output.say(f"wrote {out}: {form.doc}, {_quantity(form)}; {what}")
        output.result(file=out, format=name, quantity=form.quantity or "brdf", source_format=source, content=what)


@click.command("check-file")
@FILE
@json_option
def check_file(file: Path, as_json: bool) -> None:
    """Read FILE again through the other people's programs that are installed, and print the largest difference.

    Programs: mitsuba (RGL), pywincalc and Radiance (Klems), jsonschema (BiRD), xarray (NetCDF): pip install 'gonio[check]'.
    """
    from gonio.formats import check

    with speaking(as_json) as output:
        results = check.check(file)
        for result in results:
            output.say(f"    {result.reader}: {result.text}")
        output.result(file=file, results=[{"reader": r.reader, "text": r.text, "ok": r.ok} for r in results])
        wrong = [r for r in results if r.ok is False]
        if wrong:
            raise DatasetError(f"{file}: {wrong[0].reader} reads it differently: {wrong[0].text}")
        if not any(r.ok for r in results):
            output.warn(f"{file}: no independent program has read it")


def _material(output: Output, found: Any, model: str | None, attributes: dict[str, str]) -> Material:
    """What the grid formats are written from: the table of the file, a table of its samples, or a fitted model."""
    from gonio import formats
    from gonio.brdf import tables
    from gonio.channels import SINGLE, ChannelSamples
    from gonio.formats import Material

    if not isinstance(found, tables.Tables):
        several = isinstance(found, ChannelSamples)
        sets = found.all_channels() if several else (found,)
        _warn_of_holes(output, sets[0], model)
        if model is not None:
            from fitting import fit

            told = {**found.attributes, **attributes, "origin": "model", "model": model}
            posteriors = [fit(one, model, seed=1) for one in sets]
            return Material(tuple(p.brdf() for p in posteriors), found.channels if several else SINGLE, attributes=told)
        found = tables.tabulate(found)
        if found.grained:
            output.warn("the samples depend on the incident azimuth: the table keeps the grain")
    made = formats.material_of(found, attributes=attributes)
    assert made is not None
    return made


def _warn_of_holes(output: Output, samples: BRDFSamples, model: str | None) -> None:
    import numpy as np

    n = len(np.unique(np.round(np.degrees(samples.theta_i), 1)))
    if n < DENSE:
        source = f"the model {model}" if model else "a table that extrapolates; --model fits a model instead"
        output.warn(f"the data have {n} incidence{'s' if n > 1 else ''}: all other directions come from {source}")


def _quantity(form: Any) -> str:
    from gonio.formats.quantity import QUANTITIES

    return QUANTITIES[form.quantity or "brdf"]
