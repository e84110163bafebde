"""gonio reduce, table, fit, report: what is derived from a run."""

from __future__ import annotations

from pathlib import Path

import click

from gonio.cli import steps
from gonio.cli.fit_choices import chosen_fit, fit_choices
from gonio.cli.output import json_option, speaking
from gonio.errors import ConvergenceError

RUN = click.argument("run", type=click.Path(path_type=Path))


@click.command()
@RUN
@json_option
def reduce(run: Path, as_json: bool) -> None:
    """Turn the frames of RUN into BRDF samples, each with its random and its shared uncertainties."""
    with speaking(as_json) as output, steps.open_run(run) as opened:
        samples = steps.reduce_run(opened, output)
        output.say(f"{len(samples)} samples of f_r in 1/sr; shared errors: {', '.join(e.name for e in samples.shared)}")


@click.command()
@RUN
@click.option("--fill", is_flag=True, help="Fill what was not measured from the fit; those nodes are flagged.")
@click.option("--channel", help="One channel only, such as red, 550nm or luminance.")
@json_option
def table(run: Path, fill: bool, channel: str | None, as_json: bool) -> None:
    """Tabulate the samples of RUN over half and difference angles (table.nc).

    In all channels, and over four angles if the samples depend on the incident azimuth.
    """
    with speaking(as_json) as output, steps.open_run(run) as opened:
        made = steps.tabulate(opened, output, fill=steps.load_posterior(opened).brdf() if fill else None, channel=channel)
        if made.grained:
            output.say(
                "the samples depend on the incident azimuth: the table keeps the grain, a map of it needs rotation_deg"
            )
        of = f" in each of {len(made.channels)} channels" if len(made.channels) > 1 else ""
        shown = ", ".join(f"{n} nodes {k}" for k, n in made.counts().items())
        output.say(f"wrote {opened.table_path}: {shown}{of}")


@click.command()
@RUN
@fit_choices
@click.option("--seed", type=int, help="Of the sampler; 1 by default.")
@click.option("--student", type=float, metavar="NU", help="Student's t with NU degrees of freedom in place of Gauss.")
@click.option("--chain", is_flag=True, help="Walk with emcee even where importance sampling would do.")
@click.option("--max-steps", type=int, help="Longest chain.")
@click.option("--resume", is_flag=True, help="Go on with the chains of posterior.nc; the other options as then.")
@click.option(
    "--with",
    "others",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="RUN",
    help="Another run of the same sample on the same rig, fitted together with this one; may be repeated.",
)
@click.option(
    "--mount",
    type=float,
    default=0.005,
    show_default=True,
    help="Relative uncertainty of putting a sample back, for --with.",
)
@click.option("--channels", is_flag=True, help="All channels of RUN at once: one roughness, and an albedo of each.")
@click.option("--threads", type=int, default=1, help="For the likelihood; the numbers do not depend on it.")
@json_option
def fit(
    run: Path,
    model: str | None,
    config: Path | None,
    free: tuple[str, ...],
    fix: tuple[str, ...],
    seed: int | None,
    student: float | None,
    chain: bool,
    max_steps: int | None,
    resume: bool,
    others: tuple[Path, ...],
    mount: float,
    channels: bool,
    threads: int,
    as_json: bool,
) -> None:
    """Fit a model to the samples of RUN (posterior.nc); exit code 5 if the chains did not converge."""
    model, given_seed, options = chosen_fit(model, config, free, fix)
    seed = given_seed if seed is None else seed
    given = {"student": student, "max_steps": max_steps}
    options |= {key: value for key, value in given.items() if value is not None} | {"chain": chain, "threads": threads}
    with speaking(as_json) as output, steps.open_run(run) as opened:
        if resume:
            options["resume"] = steps.load_posterior(opened, whole=True)
        posterior = steps.fit(
            opened, output, model, seed, others=others, u_mount=mount, channels=channels, **options
        )
        steps.show_fit(output, posterior)
        if not posterior.diagnostics.get("converged"):
            output.finish()
            output.as_json = False  # printed already
            raise ConvergenceError(steps.describe_convergence(posterior))


@click.command()
@RUN
@json_option
def report(run: Path, as_json: bool) -> None:
    """Write report.html, report.json and figures/ of RUN from what it has: samples, table, fit, maps."""
    with speaking(as_json) as output, steps.open_run(run) as opened:
        steps.report(opened, output)
