"""gonio export: the data set for other programs."""

from __future__ import annotations

from pathlib import Path

import click

from gonio.cli import steps
from gonio.cli.output import json_option, speaking


@click.command()
@click.argument("run", type=click.Path(path_type=Path))
@click.option(
    "--format",
    "name",
    required=True,
    help="netcdf, rgl, merl, klems, bird, ssdd, opticstudio, alta, astm, csv, cornell or pab.",
)
@click.option("--out", required=True, type=click.Path(path_type=Path), help="File to write; of pab a new folder.")
@json_option
def export(run: Path, name: str, out: Path, as_json: bool) -> None:
    """Write the data set of RUN in a format of other programs.

    csv, bird, alta, astm, cornell and pab hold the samples, netcdf samples and table, the others the table, else the fit.
    """
    with speaking(as_json) as output, steps.open_run(run) as opened:
        steps.export(opened, name, out, output)
