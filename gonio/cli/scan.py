"""gonio scan, resume, verify: measuring, and looking after what was measured."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from gonio.cli import steps
from gonio.cli.output import Output, json_option, log_to, speaking
from gonio.errors import ConfigurationError, DatasetError

if TYPE_CHECKING:
    from gonio.scan import Run
    from gonio.scan.preflight import Preflight

FILE = click.Path(path_type=Path, dir_okay=False)


@click.command("scan")
@click.argument("plan", type=FILE)
@click.option("--rig", "rig_file", required=True, type=FILE, help="rig.toml")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Folder of the new run.")
@click.option(
    "--dry-run", is_flag=True, help="Check every pose, list what cannot be reached, tell time and space; move nothing."
)
@json_option
def scan_(plan: Path, rig_file: Path, out: Path, dry_run: bool, as_json: bool) -> None:
    """Measure the poses of PLAN. Each is journaled when complete; Ctrl-C stops the axes and keeps the data."""
    from gonio.config import parse_plan, parse_rig, read_document
    from gonio.scan import check, create_run, make_plan

    with speaking(as_json) as output:
        rig_text, plan_text = read_document(rig_file), read_document(plan)
        rig, config = parse_rig(rig_text, str(rig_file)), parse_plan(plan_text, str(plan))
        checked = check(make_plan(config, rig), config, rig)
        show_preflight(output, checked)
        if dry_run:
            output.result(**checked.as_dict())
            return
        run, _ = create_run(out, rig_text, plan_text, rig_folder=rig_file.absolute().parent)
        with run:
            measure(run, output)


@click.command()
@click.argument("run", type=click.Path(path_type=Path))
@json_option
def resume(run: Path, as_json: bool) -> None:
    """Go on with the interrupted scan of RUN: the poses that are not in its journal. A demo goes on to its end."""
    from gonio.scan import is_complete

    with speaking(as_json) as output, steps.open_run(run) as opened:
        if opened.kind == "scan" and is_complete(opened):
            output.say(f"{run}: the scan is complete")
        else:
            measure(opened, output)
        if "demo_seed" in opened.attributes:
            from gonio.cli.demo import derive

            derive(opened, output)


@click.command()
@click.argument("run", type=click.Path(path_type=Path))
@json_option
def verify(run: Path, as_json: bool) -> None:
    """Check journal, checksums and frames of RUN; exit code 6 if anything is wrong."""
    with speaking(as_json) as output, steps.open_run(run) as opened:
        problems = opened.verify()
        done = len(opened.complete_poses())
        output.result(problems=problems, poses=done)
        for problem in problems:
            output.say(problem)
        if problems:
            output.finish()
            output.as_json = False  # printed already
            raise DatasetError(f"{run}: {len(problems)} problems, the first: {problems[0]}")
        output.say(f"{run}: journal and frames of {done} poses are whole")


def measure(run: Run, output: Output) -> None:
    """Scan what a run still lacks, with a bar for each stage."""
    from gonio.rig import open_rig
    from gonio.scan import rig_of, scan

    log_to(run.log_path)
    begun = bool(run.complete_poses())
    with contextlib.ExitStack() as stack:
        with output.stage("start the rig"):
            rig = stack.enter_context(open_rig(rig_of(run), ask=ask(output), faults=not begun))
        with _stages(output) as progress:
            result = scan(run, rig, progress=progress)
    output.say(f"{result.done} of {result.poses} poses taken in {result.seconds:.0f} s by the rig's clock")
    if result.repeated:
        output.say(f"{result.repeated} exposures were taken again because an axis moved or a frame was old")
    if result.saturated:
        output.warn(f"{len(result.saturated)} poses are saturated in every exposure; shorten exposures_s")
    output.result(run=run.path, poses=result.poses, taken=result.done, saturated=list(result.saturated))


@contextlib.contextmanager
def _stages(output: Output) -> Iterator[Callable[[str, int, int], None]]:
    """One bar at a time: a new stage closes the one before."""
    names = {"home": "home axes", "dark": "dark frames", "white": "white reference", "poses": "scan"}
    with contextlib.ExitStack() as stack:
        opened: dict[str, Callable[[int, int], None]] = {}

        def progress(stage: str, done: int, total: int) -> None:
            if stage not in opened:
                stack.close()
                opened.clear()
                opened[stage] = stack.enter_context(output.stage(names.get(stage, stage)))
            opened[stage](done, total)

        yield progress


def ask(output: Output) -> Callable[[str], None] | None:
    """How a person at the terminal is asked; None if there is no person."""
    import sys

    if output.as_json or not sys.stdin.isatty():
        return None

    def wait(text: str) -> None:
        click.echo(f"\n{text} Press Enter when it is done.", err=True)
        if not sys.stdin.readline():
            raise ConfigurationError("nobody answers; run it in a terminal")

    return wait


def show_preflight(output: Output, checked: Preflight) -> None:
    """What a scan would do."""
    plan = checked.plan
    hurried = f" ({checked.speed:g} times as fast on this simulated rig)" if checked.speed != 1.0 else ""
    output.say(
        f"{len(plan.poses)} poses, {checked.frames} frames, {checked.bytes / 1e6:.0f} MB; about {checked.wall_s:.0f} s: "
        f"{checked.seconds:.0f} s of motion, exposure and rest{hurried}, and {checked.host_s:.0f} s of bus, camera and "
        f"disk, if they take {1e3 * checked.host_s / max(1, len(plan.poses)):.0f} ms a pose"
    )
    for kind, count, first in checked.reasons():
        output.say(f"{count} geometries are left out: {kind} (the first: {first.reasons[0]})")
