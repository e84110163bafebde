"""gonio rig: look after a rig without measuring; here its check, the other verbs in `rig_motion` and `rig_service`."""

from __future__ import annotations

import contextlib
from pathlib import Path

import click

from gonio.cli import rig_motion, rig_service
from gonio.cli.output import json_option, speaking


@click.group()
def rig() -> None:
    """Look after a rig."""


for verb in (
    rig_service.setup, rig_motion.home, rig_motion.move, rig_motion.jog, rig_motion.park, rig_motion.stop,
    rig_service.watch, rig_service.dump,
):  # fmt: skip
    rig.add_command(verb)


@rig.command()
@rig_motion.RIG_FILE
@json_option
def check(rig_file: Path, as_json: bool) -> None:
    """Open every device of RIG.TOML, read its identity and settings, expose one dark frame; nothing moves."""
    import math

    from gonio.cli.scan import ask
    from gonio.config import load_rig
    from gonio.rig import open_rig

    with speaking(as_json) as output:
        config = load_rig(rig_file)
        with contextlib.ExitStack() as stack:
            with output.stage("start the rig"):
                opened = stack.enter_context(open_rig(config, ask=ask(output)))
            rows = []
            for name, axis in opened.axes.items():
                reading, about = axis.read(), axis.describe()
                rows.append([
                    name, str(about.get("model", "")), str(about.get("firmware", "")), f"{math.degrees(reading.angle):.2f}",
                    f"{math.degrees(axis.limits.lower):.0f} to {math.degrees(axis.limits.upper):.0f}",
                    f"{reading.temperature_c:.0f}", f"{reading.voltage_v:.1f}",
                ])  # fmt: skip
            header = ["axis", "model", "firmware", "angle [deg]", "limits [deg]", "temp. [C]", "voltage [V]"]
            output.table(config.name, header, rows)
            camera = opened.camera
            if camera is None:
                output.say("camera: none")
            else:
                frame = camera.capture(config.camera.exposures_s[0], label="check")
                height, width = frame.data.shape
                output.say(
                    f"camera: {camera.name}, {width} x {height} pixels, {frame.bit_depth} bit, "
                    f"{'linear' if frame.linear else 'NOT LINEAR'}, {frame.data.mean():.1f} DN at {frame.exposure_s:g} s"
                )
            output.say(f"lamp: {opened.lamp.describe().get('identity') or opened.lamp.name}")
            output.say("all devices answer")
            output.result(**opened.describe())
