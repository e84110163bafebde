"""gonio demo: the main job end to end on the simulated rig, through the code that a real rig uses."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from gonio.cli import steps
from gonio.cli.output import Output, json_option, speaking

if TYPE_CHECKING:
    from gonio.maps import ReflectanceMap
    from gonio.scan import Run

RANGE, POINTS = (-3.0, 3.0), 129
RTOL = {"fit": 1e-6, "table": 1e-3}
_SMALLEST = 1e-3  # of the largest radiance: below it a relative error says little


@click.command()
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Folder of the new run.")
@click.option(
    "--seed", type=click.IntRange(0, 2**53), default=1, show_default=True, help="Of the bench's errors, noise and sampler."
)
@json_option
def demo(out: Path, seed: int, as_json: bool) -> None:
    """Scan a simulated sample, reduce, tabulate, fit, map, export, report, and compare with the truth.

    Interrupt it and `gonio resume OUT` carries on.
    """
    from gonio.config import default_documents
    from gonio.scan import create_run

    with speaking(as_json) as output:
        start = time.perf_counter()
        documents = default_documents()
        rig_text = re.sub(r"(?m)^seed = \d+", f"seed = {seed}", documents["rig.toml"])
        run, _ = create_run(out, rig_text, documents["plan.toml"], attributes={"demo_seed": str(seed)})
        with run:
            from gonio.cli.scan import measure

            measure(run, output)
            derive(run, output)
        output.say(f"done in {time.perf_counter() - start:.0f} s")


def derive(run: Run, output: Output) -> None:
    """Everything after the scan."""
    import numpy as np

    from gonio import source

    seed = int(run.attributes["demo_seed"])
    steps.reduce_run(run, output)
    posterior = steps.fit(run, output, "lambertian+ggx", seed)
    fitted = posterior.brdf()
    table = steps.tabulate(run, output, fill=fitted).brdf()

    hidden = json.loads(run.attributes["truth"])
    true_values = truth_by_name(hidden)
    true_brdf = true_brdf_of(hidden)
    lights = {
        "collimated": source.make("collimated", theta=0.5, phi=0.0, irradiance=1.0),
        "sky": source.make("hemispherical", radiance=1.0),
    }
    axis = np.linspace(*RANGE, POINTS)
    made: dict[str, ReflectanceMap] = {}
    rows = []
    for light_name, light in lights.items():
        reference, _ = steps.compute_map(output, f"map: truth, {light_name}", true_brdf, light, axis, rtol=1e-8)
        for what, brdf in (("table", table), ("fit", fitted)):
            name = f"{what}, {light_name}"
            of_draws = posterior if what == "fit" else None
            one, _ = steps.compute_map(output, f"map: {name}", brdf, light, axis, rtol=RTOL[what], posterior=of_draws)
            made[name] = one
            one.save(run.path / f"map_{what}_{light_name}.nc")
            error, relative, inside = _compare(one, reference)
            shown = "" if inside is None else f"{100 * inside:.0f} %"
            rows.append([f"R(p, q): {name}", f"{error:.3g}", f"{100 * relative:.2g} %", shown])
            output.result(**{f"map_{what}_{light_name}": {"max_error": error, "of_largest": relative, "in_band": inside}})

    for form, name in (("merl", "brdf.binary"), ("netcdf", "dataset.nc"), ("csv", "samples.csv")):
        steps.export(run, form, run.exports / name, output)
    steps.report(run, output, maps=made, truth=true_values)
    steps.show_fit(output, posterior, true_values)
    header = ["reflectance map", "largest error", "largest error / largest R", "gradients in the 68 % band"]
    output.table("Against the map of the true BRDF", header, rows)
    output.result(truth=true_values)


def truth_by_name(hidden: Mapping[str, Any]) -> dict[str, float]:
    """The simulator's truth under the names of the fit's parameters."""
    import math

    known = {str(name): float(value) for name, value in hidden["parameters"].items()}
    known |= {f"shared.{axis}": math.radians(float(value)) for axis, value in hidden["zero_deg"].items()}
    return known


def true_brdf_of(hidden: Mapping[str, Any]) -> Any:
    """The BRDF of the simulated sample."""
    from gonio.config import BRDFConfig

    return BRDFConfig(None, "fit", str(hidden["model"]), {str(k): float(v) for k, v in hidden["parameters"].items()}).build()


def _compare(one: ReflectanceMap, reference: ReflectanceMap) -> tuple[float, float, float | None]:
    """Largest error of a map, also relative to the largest radiance, and the share of gradients whose band has the truth."""
    import numpy as np

    largest = float(np.abs(one.value - reference.value).max())
    inside = None
    if one.band is not None:
        lit = reference.value > _SMALLEST * reference.value.max()
        inside = float(((reference.value >= one.band[0]) & (reference.value <= one.band[1]))[lit].mean())
    return largest, largest / float(reference.value.max()), inside
