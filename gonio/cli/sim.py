"""gonio sim: the simulated rig for other programs."""

from __future__ import annotations

from pathlib import Path

import click


@click.group()
def sim() -> None:
    """The simulated rig as a server."""


@sim.command()
@click.option("--pty", type=click.Path(path_type=Path), metavar="LINK", help="Name for the servo bus's pseudo-terminal.")
@click.option("--lamp-pty", type=click.Path(path_type=Path), metavar="LINK", help="Name for the lamp's pseudo-terminal.")
@click.option("--tcp", type=int, metavar="PORT", help="Serve the bus on 127.0.0.1:PORT as well; 0 for any.")
@click.option("--mjpeg", type=int, metavar="PORT", help="Serve the camera as motion JPEG over HTTP as well; 0 for any port.")
@click.option("--pace", is_flag=True, help="Let bytes take the time that they need on the wire.")
@click.option("--log", type=click.Path(path_type=Path), metavar="FILE", help="Write what was true at each frame, as JSON.")
@click.option("--scenario", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE", help="TOML list of faults.")
@click.option(
    "--rig", "rig_file", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE", help="rig.toml to simulate."
)
@click.option("--speed", type=float, help="Rig seconds per wall second.")
@click.option("--seed", type=int, help="Of the bench's errors and the noise.")
@click.pass_context
def serve(ctx: click.Context, /, **options: object) -> None:
    """Serve servos, lamp and camera until Ctrl-C; prints one line "ready {...}" with their addresses."""
    from gonio.rig import serve_simulator

    flags = {"rig_file": "--config", "lamp_pty": "--lamp-pty"}
    arguments: list[str] = []
    for name, value in options.items():
        if value is True:
            arguments.append(f"--{name}")
        elif value is not None and value is not False:
            arguments += [flags.get(name, f"--{name}"), str(value)]
    ctx.exit(serve_simulator(arguments, announce=click.echo))
