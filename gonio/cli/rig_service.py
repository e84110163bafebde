"""gonio rig setup, dump, watch: settings, registers and the state of a rig."""

from __future__ import annotations

import contextlib
import itertools
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from gonio.cli.output import json_option, speaking
from gonio.cli.rig_motion import AXES, RIG_FILE

if TYPE_CHECKING:
    from gonio.rig import Rig


@click.command()
@RIG_FILE
@click.option("--axis", type=click.Choice(AXES), help="The only servo on the line becomes this axis, whatever its id.")
@click.option("--yes", is_flag=True, help="Write without asking.")
@click.option("--dry-run", is_flag=True, help="Show the changes, write nothing.")
@json_option
def setup(rig_file: Path, axis: str | None, yes: bool, dry_run: bool, as_json: bool) -> None:
    """Find the servos of RIG.TOML at any line rate and put id, rate, return delay, mode and limits into them.

    New servos all have id 1: connect them one at a time, each with --axis. Every change is shown before it is written;
    torque goes off for it, so hold what could fall.
    """
    from gonio.config import load_rig
    from gonio.errors import ConfigurationError
    from gonio.rig import service

    with speaking(as_json) as output:
        config = load_rig(rig_file)
        make = service.bus_at(config)
        with output.stage("look for servos") as progress:
            found = service.survey(make, progress=progress)
        rows = [[str(f.id), f.model, str(f.firmware), str(f.baud)] for f in found]
        output.table("servos on the line", ["id", "model", "firmware", "rate [bit/s]"], rows)
        changes = service.plan_changes(config, make, found, axis=axis)
        output.result(
            found=[vars(f) for f in found],
            changes=[{"axis": c.axis, "register": c.register, "now": c.now, "new": c.new} for c in changes],
        )
        if not changes:
            output.say("every servo is as rig.toml says; nothing is written")
            return
        rows = [[c.axis, str(c.found.id), c.register, str(c.now), str(c.new)] for c in changes]
        output.table("to be written", ["axis", "id", "register", "now", "new"], rows)
        if dry_run:
            output.say("nothing was written")
            return
        if not yes:
            if as_json:
                raise ConfigurationError("--json cannot ask; give --yes to write the changes, or --dry-run to see them")
            click.confirm("Torque goes off. Write these?", abort=True)
        service.apply(config, make, changes)
        output.say(f"{len(changes)} registers written, and every servo answers")


@click.command()
@RIG_FILE
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), help="File to write; else the screen.")
def dump(rig_file: Path, out: Path | None) -> None:
    """Every register of every servo, as TOML."""
    from gonio.config import load_rig
    from gonio.files import replace_atomically
    from gonio.rig import service

    tables = service.registers(load_rig(rig_file))
    text = "\n".join(
        f"[{axis}]\n" + "".join(f'"{name}" = {_toml(value)}\n' for name, value in values.items())
        for axis, values in tables.items()
    )
    if out is None:
        click.echo(text, nl=False)
    else:
        replace_atomically(out, lambda path: path.write_text(text, encoding="utf-8"))
        click.echo(f"wrote {out}")


def _toml(value: int | str) -> str:
    return str(value) if isinstance(value, int) else f'"{value}"'


@click.command()
@RIG_FILE
@click.option("--count", type=click.IntRange(min=1), help="Readings; without end by default.")
@click.option("--interval", "interval_s", type=click.FloatRange(min=0.05), default=1.0, show_default=True, help="[s]")
def watch(rig_file: Path, count: int | None, interval_s: float) -> None:
    """Angles, current, temperature, voltage, lamp and the level of a frame, until Ctrl-C; nothing moves."""
    import sys

    from gonio.cli.output import Output
    from gonio.cli.scan import ask
    from gonio.config import load_rig
    from gonio.rig import open_rig
    from gonio.scan.interrupt import interrupts

    config = load_rig(rig_file)
    with interrupts() as stop, contextlib.ExitStack() as stack:
        rig = stack.enter_context(open_rig(config, ask=ask(Output())))
        live = sys.stdout.isatty()
        for number in itertools.count() if count is None else range(count):
            text = _line(rig, number)
            click.echo(f"\r{text}\x1b[K" if live else text, nl=not live)
            if number + 1 == count or stop.event.wait(interval_s):
                break
        if live:
            click.echo("")


def _line(rig: Rig, number: int) -> str:
    parts = []
    for name, now in rig.group.read().items():
        current = "" if math.isnan(now.current_a) else f" {now.current_a:.2f} A"
        parts.append(f"{name} {math.degrees(now.angle):.2f} deg{current} {now.temperature_c:.0f} C {now.voltage_v:.1f} V")
    about: Any = rig.lamp.describe()
    parts.append(f"lamp {'unknown' if about.get('output') is None else 'on' if about['output'] else 'off'}")
    if rig.camera is not None:
        frame = rig.camera.capture(rig.config.camera.exposures_s[0], label=f"watch {number}")
        x0, y0, width, height = rig.config.camera.roi
        level = frame.data[y0 : y0 + height, x0 : x0 + width].mean()
        parts.append(f"frame {level:.0f} of {frame.saturation_dn} DN")
    return "  ".join(parts)
