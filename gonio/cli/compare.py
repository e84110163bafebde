"""gonio compare: which model, by how much, and whether any is adequate."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from gonio.cli.output import Output, json_option, speaking
from gonio.errors import ConfigurationError

if TYPE_CHECKING:
    from fitting.compare import Comparison
    from gonio.samples import BRDFSamples


@click.command()
@click.argument("data", type=click.Path(path_type=Path, exists=True))
@click.option("--models", required=True, metavar="A,B,C", help="Sums of models, such as lambertian+ggx,oren_nayar.")
@click.option("--free", multiple=True, metavar="NAME", help="Free a parameter that its model holds, e.g. ggx.k_s.")
@click.option("--fix", multiple=True, metavar="NAME=VALUE", help="Hold a parameter.")
@click.option("--quantity", type=click.Choice(["brdf", "brf", "brdf_cos"]), help="As for `gonio import`; of a file.")
@click.option("--channel", help="As for `gonio import`; of a file.")
@click.option("--seed", type=click.IntRange(0), default=1, show_default=True)
@json_option
def compare(
    data: Path,
    models: str,
    free: tuple[str, ...],
    fix: tuple[str, ...],
    quantity: str | None,
    channel: str | None,
    seed: int,
    as_json: bool,
) -> None:
    """Compare models on the samples of DATA, a run or a file, by what they predict of readings that were left out."""
    from fitting.compare import compare as score
    from gonio.cli.fit_choices import held_values
    from gonio.cli.units import angles_of_fit, fit_options

    names = split(models)
    with speaking(as_json) as output:
        samples = _samples(data, quantity, channel)
        angles = set().union(*(angles_of_fit(name, samples) for name in names))
        options = fit_options({"free": free, "fix": held_values(fix)}, angles)
        with output.stage("compare") as progress:
            found = score(samples, names, **options, seed=seed, progress=progress)
        show(output, found, angles)


def split(models: str) -> list[str]:
    """Names between commas, those inside brackets left alone: ``"a,b[c=d,e=f]"`` are two."""
    out, depth = [""], 0
    for letter in models:
        depth += (letter == "[") - (letter == "]")
        if letter == "," and depth == 0:
            out.append("")
        else:
            out[-1] += letter
    return [name.strip() for name in out if name.strip()]


def _samples(data: Path, quantity: str | None, channel: str | None) -> BRDFSamples:
    if data.is_dir() and (data / "run.sqlite").exists():
        from gonio.cli.steps import open_run

        if quantity is not None or channel is not None:
            raise ConfigurationError(f"{data} is a run; --quantity and --channel belong to files")
        with open_run(data) as run:
            return run.read_samples()
    from gonio import formats

    return formats.read_samples(data, quantity, channel)


def show(output: Output, found: Comparison, angles: set[str]) -> None:
    """The table, the estimates and the verdict; `angles` are the names of parameters in rad."""
    several = len(found.theta_i) > 1
    header = ["model", "parameters", "left-out incidences", "left-out readings", "chi2/N", "noise needed", "systematic"]
    rows = []
    for score in found.scores:
        parts = ["0" if score is found.scores[0] else _gap(found.difference(score, kind)) for kind in ("incidence", "loo")]
        rows.append([
            score.model, f"{score.effective_parameters:.1f}", parts[0] if several else "-", parts[1],
            "-" if math.isnan(score.chi2_per_n) else f"{score.chi2_per_n:.3g}", f"{100 * score.noise:.3g} %",
            f"{100 * max(score.alike, 0.0):.0f} %",
        ])  # fmt: skip
    output.table(f"{len(found.group)} samples at {len(found.theta_i)} incidences; log score behind the best", header, rows)
    for score in found.scores:
        told = []
        for name, (mean, sd) in score.parameters.items():
            scale, unit = (math.degrees(1.0), " deg") if name in angles else (1.0, "")
            told.append(f"{name} {scale * mean:.4g} +- {scale * sd:.2g}{unit}")
        output.say(f"{score.model}: {', '.join(told)}")
    for sentence in found.verdict():
        output.say(sentence)
    output.result(
        samples=len(found.group),
        models=[
            {
                "model": s.model, "parameters": {k: {"mean": m, "sd": sd} for k, (m, sd) in s.parameters.items()},
                "loo": found.difference(s, "loo"), "incidence": found.difference(s, "incidence") if several else None,
                "effective_parameters": s.effective_parameters, "chi2_per_n": s.chi2_per_n, "noise": s.noise,
                "systematic": s.alike, "adequate": not found.faults(s), "not_informed": s.blind,
            }
            for s in found.scores
        ],
        verdict=found.verdict(),
    )  # fmt: skip


def _gap(gap: tuple[float, float]) -> str:
    return f"{gap[0]:.1f} +- {gap[1]:.1f}"
