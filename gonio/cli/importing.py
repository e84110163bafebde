"""gonio import: a run from a file that someone else measured."""

from __future__ import annotations

import hashlib
from pathlib import Path

import click

from gonio.cli.output import json_option, log_to, speaking


@click.command("import")
@click.argument("file", type=click.Path(path_type=Path, dir_okay=False))
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Folder of the new run.")
@click.option(
    "--quantity", type=click.Choice(["brdf", "brf", "brdf_cos"]), help="What the values are, where the file does not say."
)
@click.option(
    "--channel", help="One channel only, such as red or 550nm; by default all are kept, and fits see luminance or 555 nm."
)
@json_option
def import_(file: Path, out: Path, quantity: str | None, channel: str | None, as_json: bool) -> None:
    """Make a run from FILE in any format that gonio reads, such as OpticStudio, MERL, RGL, Klems, BiRD, NetCDF, CSV.

    The format is recognised by content. Values without uncertainty stay so; a fit then infers their noise.
    """
    from gonio import __version__, formats
    from gonio.channels import ChannelSamples
    from gonio.scan import Run

    with speaking(as_json) as output:
        found = formats.read(file, quantity)
        samples = formats.one_channel(file, found, channel)
        several = found if channel is None and isinstance(found, ChannelSamples) and len(found.channels) > 1 else None
        attributes = {"source_file": file.name, "source_sha256": hashlib.sha256(file.read_bytes()).hexdigest()}
        attributes |= {"gonio_version": __version__, "source_format": formats.sniff(file)}
        with Run.create(out, kind="import", documents={}, attributes=attributes) as run:
            log_to(run.log_path)
            run.write_samples(samples)
            if several is not None:
                formats.export("netcdf", run.channels_path, samples=several)
        told = {k: v for k, v in samples.attributes.items() if k != "source_file"}
        output.say(f"{len(samples)} samples of f_r in 1/sr from {file.name} ({attributes['source_format']})")
        for key, value in told.items():
            output.say(f"    {key}: {value}")
        if several is not None:
            names = several.channels.names
            shown = ", ".join(names[:3]) + (f" ... {names[-1]}" if len(names) > 3 else "")
            output.say(
                f"    tables and exports keep all {len(names)} channels ({shown}); fits see {samples.attributes['channel']}"
            )
        output.say(f"next: gonio table {out}; gonio fit {out} --model lambertian+ggx")
        output.result(run=out, samples=len(samples), attributes={**attributes, **told})
