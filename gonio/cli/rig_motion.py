"""gonio rig home, move, park, jog, stop: moving the axes by hand.

The same limits, zones and one-sided approach as in a scan; Ctrl-C stops the axes, which then hold.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from gonio.cli.output import Output, json_option, speaking

if TYPE_CHECKING:
    from gonio.rig import OpenAxes
    from gonio.scan.interrupt import Interrupts
    from gonio.scan.motion import Motion

AXES = ("arm", "pan", "tilt")
RIG_FILE = click.argument("rig_file", metavar="RIG.TOML", type=click.Path(path_type=Path, dir_okay=False))
_STEPS_DEG = (0.1, 0.5, 1.0, 5.0, 15.0)


@contextlib.contextmanager
def moving(rig_file: Path) -> Iterator[tuple[OpenAxes, Motion, Interrupts]]:
    """Open axes to be moved; on any error or Ctrl-C they stop and hold."""
    from gonio.config import load_rig
    from gonio.errors import DeviceError
    from gonio.rig import open_axes
    from gonio.scan.interrupt import interrupts
    from gonio.scan.motion import Motion

    config = load_rig(rig_file)
    with interrupts() as stop, open_axes(config) as opened:
        again = "give the command again to go on"
        motion = Motion(opened.group, opened.clock, config, lambda: stop.check(again), again)
        try:
            yield opened, motion, stop
        except BaseException:
            with contextlib.suppress(DeviceError):
                opened.bus.stop_all()
            raise


def _show(output: Output, motion: Motion) -> None:
    readings = motion.read()
    rows = [
        [axis, f"{math.degrees(r.angle):.2f}", str(r.position_counts), str(r.goal_counts), f"{r.current_a:.2f}"]
        for axis, r in readings.items()
    ]
    output.table("", ["axis", "angle [deg]", "counts", "goal [counts]", "current [A]"], rows)
    output.result(**{f"{axis}_deg": math.degrees(r.angle) for axis, r in readings.items()})


def _go(rig_file: Path, as_json: bool, goal: Callable[[Any], Mapping[str, float]], what: str) -> None:
    with speaking(as_json) as output, moving(rig_file) as (opened, motion, _):
        with output.stage(what):
            motion.move(goal(opened.config))
        _show(output, motion)


@click.command()
@RIG_FILE
@json_option
def home(rig_file: Path, as_json: bool) -> None:
    """Move all axes to the white reference's geometry and see that they arrive."""
    _go(rig_file, as_json, lambda config: {axis: float(getattr(config.white, axis)) for axis in AXES}, "home axes")


@click.command()
@RIG_FILE
@json_option
def park(rig_file: Path, as_json: bool) -> None:
    """Move all axes to the angles of [park]."""
    _go(rig_file, as_json, lambda config: config.park, "park axes")


@click.command(context_settings={"ignore_unknown_options": True})  # negative angles
@RIG_FILE
@click.argument("axis", type=click.Choice(AXES))
@click.argument("angle", metavar="ANGLE", type=float)
@json_option
def move(rig_file: Path, axis: str, angle: float, as_json: bool) -> None:
    """Move AXIS of RIG.TOML to ANGLE [degrees]; the others stay."""
    from gonio.errors import ConfigurationError

    if not math.isfinite(angle):
        raise ConfigurationError(f"an angle of {angle} degrees cannot be reached; give a number")
    _go(rig_file, as_json, lambda config: {axis: math.radians(angle)}, f"{axis} to {angle:g} degrees")


@click.command()
@RIG_FILE
@json_option
def stop(rig_file: Path, as_json: bool) -> None:
    """Stop all axes now; they hold. A gonio that moves them is told to stop, as by Ctrl-C. This is no safety function."""
    from gonio.config import load_rig
    from gonio.rig import service

    with speaking(as_json) as output:
        pid = service.stop(load_rig(rig_file))
        output.say("the axes hold" if pid is None else f"process {pid} has stopped; the axes hold")
        output.result(stopped_process=pid)


@click.command()
@RIG_FILE
def jog(rig_file: Path) -> None:
    """Move the axes by keys, with their angles on the screen."""
    import sys

    from gonio.errors import ConfigurationError

    if not sys.stdin.isatty():
        raise ConfigurationError("jog needs a terminal for its keys; use `gonio rig move` in a script")
    with moving(rig_file) as (opened, motion, interrupt), _keys() as key:
        click.echo("1 2 3 or a p t: axis   left right: move   up down: step   space: stop   q: quit")
        _jog(opened, motion, key, interrupt)


def _jog(opened: OpenAxes, motion: Motion, key: Callable[[float], str], interrupt: Interrupts) -> None:
    from gonio.errors import LimitError
    from gonio.scan import zones

    names = list(opened.axes)
    axis, step = names[0], 2
    chosen = {**{str(k + 1): name for k, name in enumerate(names)}, **{name[0]: name for name in names}}
    told = ""
    while True:
        interrupt.check("start jog again to go on")
        here = {name: reading.angle for name, reading in motion.read().items()}
        opened.group.settled(names)  # drives the last leg of an approach
        angles = "  ".join(f"{'>' if n == axis else ' '}{n} {math.degrees(a):8.2f}" for n, a in here.items())
        click.echo(f"\r{angles}   step {_STEPS_DEG[step]:g} deg  {told}\x1b[K", nl=False)
        pressed = key(0.1)
        if pressed == "q":
            click.echo("")
            return
        if pressed == " ":
            opened.bus.stop_all()
            told = "stopped"
        elif pressed in chosen:
            axis, told = chosen[pressed], ""
        elif pressed in ("up", "down"):
            step = min(max(step + (1 if pressed == "up" else -1), 0), len(_STEPS_DEG) - 1)
        elif pressed in ("left", "right"):
            sign = 1.0 if pressed == "right" else -1.0
            goal = here[axis] + sign * math.radians(_STEPS_DEG[step])
            try:
                zones.stages(here, {**here, axis: goal}, opened.config)
                opened.axes[axis].move_to(goal)
                told = f"to {math.degrees(goal):.2f}"
            except LimitError as error:
                told = str(error)


@contextlib.contextmanager
def _keys() -> Iterator[Callable[[float], str]]:
    """Keys of the terminal as they are pressed; what it yields waits up to some seconds, and gives "" if there was none."""
    import os
    import select
    import sys
    import termios
    import tty

    arrows = {"\x1b[A": "up", "\x1b[B": "down", "\x1b[C": "right", "\x1b[D": "left"}
    terminal = sys.stdin.fileno()
    earlier = termios.tcgetattr(terminal)

    def key(seconds: float) -> str:
        if not select.select([terminal], [], [], seconds)[0]:
            return ""
        text = os.read(terminal, 3).decode(errors="replace")
        return arrows.get(text, text[:1] or "q")  # the end of the input ends it too

    tty.setcbreak(terminal)
    try:
        yield key
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, earlier)
