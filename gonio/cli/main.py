"""The door: verbs imported when called, every error one sentence and an exit code."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence

import click

from gonio import __version__
from gonio.cli.output import Output, fail
from gonio.errors import EXIT_INTERRUPTED, GonioError

# verb -> (module, attribute, line of help); nothing of it is imported for --help
VERBS: dict[str, tuple[str, str, str]] = {
    "demo": ("gonio.cli.demo", "demo", "The main job end to end on the simulated rig."),
    "init": ("gonio.cli.init", "init", "Write commented rig, plan, scene and fit files into a folder."),
    "doctor": ("gonio.cli.doctor", "doctor", "What is wrong with ports, servos, camera and lamp, and what mends it."),
    "rig": ("gonio.cli.rig", "rig", "Look after a rig: setup, check, home, move, jog, park, stop, watch, dump."),
    "sim": ("gonio.cli.sim", "sim", "The simulated rig as a server for other programs."),
    "scan": ("gonio.cli.scan", "scan_", "Measure the poses of a plan."),
    "resume": ("gonio.cli.scan", "resume", "Go on with an interrupted scan."),
    "verify": ("gonio.cli.scan", "verify", "Check journal and frames of a run."),
    "import": ("gonio.cli.importing", "import_", "Make a run from a measured file."),
    "reduce": ("gonio.cli.derive", "reduce", "Frames to BRDF samples with uncertainties."),
    "table": ("gonio.cli.derive", "table", "Samples to a tabulated BRDF."),
    "fit": ("gonio.cli.derive", "fit", "Samples to a posterior over model parameters."),
    "fit-batch": ("gonio.cli.batch", "fit_batch", "The same fit for many pixels or channels, on all cores or a cluster."),
    "compare": ("gonio.cli.compare", "compare", "Which model predicts best, by how much, and is any adequate."),
    "map": ("gonio.cli.map", "map_", "Reflectance map R(p, q) of a scene."),
    "export": ("gonio.cli.export", "export", "Write the data set in another format."),
    "convert": ("gonio.cli.fileverbs", "convert", "A file of one format to another."),
    "info": ("gonio.cli.info", "info", "Say what a file holds."),
    "check-file": ("gonio.cli.fileverbs", "check_file", "Read a file again through other people's programs."),
    "bundle": ("gonio.cli.bundle", "bundle", "Make a folder for publication from a run."),
    "report": ("gonio.cli.derive", "report", "Plots and a single-file HTML report."),
    "models": ("gonio.cli.models", "models", "List the BRDF models with their parameters."),
}


class _Lazy(click.Group):
    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(VERBS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in VERBS:
            return None
        module, attribute, _ = VERBS[cmd_name]
        command: click.Command = getattr(importlib.import_module(module), attribute)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Verbs"):
            formatter.write_dl([(name, line) for name, (_, _, line) in VERBS.items()])

    def resolve_command(self, ctx: click.Context, args: list[str]) -> tuple[str | None, click.Command | None, list[str]]:
        if args and args[0] not in VERBS and not args[0].startswith("-"):
            import difflib

            near = difflib.get_close_matches(args[0], list(VERBS), 1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise click.UsageError(f"there is no verb {args[0]!r}{hint} `gonio --help` lists them.", ctx)
        return super().resolve_command(ctx, args)


@click.group(cls=_Lazy, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="gonio")
@click.option("--debug", is_flag=True, help="Show the traceback of an error.")
@click.pass_context
def cli(ctx: click.Context, debug: bool) -> None:
    """Angles and light go in, images come out, and every step from image to reflectance map carries its error.

    Start with `gonio demo --out runs/demo`, or with `gonio init DIR` for files to edit.

    Exit codes: 2 usage or configuration, 3 device, 4 measurement, 5 not converged, 6 data, 130 interrupted.
    """


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug, as_json = "--debug" in arguments, "--json" in arguments
    arguments = [a for a in arguments if a != "--debug"]  # wherever it stands
    try:
        code = cli.main(args=arguments, prog_name="gonio", standalone_mode=False)
        return code if isinstance(code, int) else 0
    except click.exceptions.Exit as exc:
        return int(exc.exit_code)
    except click.ClickException as exc:
        if as_json:
            return fail(exc.format_message(), 2, as_json)
        exc.show()
        return 2
    except (KeyboardInterrupt, click.Abort) as exc:
        told = exc.__cause__ if isinstance(exc, click.Abort) else exc  # click wraps Ctrl-C; a scan says what it kept
        return fail(str(told or "") or "interrupted", EXIT_INTERRUPTED, as_json)
    except GonioError as exc:
        if debug:
            raise
        return fail(str(exc), exc.exit_code, as_json)
    except BrokenPipeError:  # the reader of our output is gone
        Output.close_stdout()
        return 0
    except Exception as exc:
        if debug:
            raise
        sentence = f"{type(exc).__name__}: {exc}. This is a defect of gonio; `gonio --debug ...` shows where it happened"
        return fail(sentence, 1, as_json)


if __name__ == "__main__":
    sys.exit(main())
