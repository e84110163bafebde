"""gonio export: the data set for other programs."""

from __future__ import annotations

from pathlib import Path

import click

from gonio.cli import steps
from gonio.cli.output import json_option, speaking


@click.command()
@click.argument("run", type=click.Path(path_type=Path))
@click.option("--format", "name", required=True, type=click.Choice(["merl", "netcdf", "csv"]))
@click.option("--out", required=True, type=click.Path(path_type=Path, dir_okay=False), help="File to write.")
@json_option
def export(run: Path, name: str, out: Path, as_json: bool) -> None:
    """Write the data set of RUN: merl (the table, else the fit), netcdf (samples and table) or csv (samples)."""
    with speaking(as_json) as output, steps.open_run(run) as opened:
        steps.export(opened, name, out, output)
