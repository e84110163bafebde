"""gonio map: the reflectance map of a scene."""

from __future__ import annotations

from pathlib import Path

import click

from gonio.cli import steps
from gonio.cli.output import Output, json_option, speaking
from gonio.integrate.plan import Step


@click.command("map")
@click.argument("scene", type=click.Path(path_type=Path, dir_okay=False))
@click.option("--out", required=True, type=click.Path(path_type=Path, dir_okay=False), help="NetCDF file to write.")
@click.option("--explain", is_flag=True, help="Print what was computed how, what was skipped, and what it took.")
@json_option
def map_(scene: Path, out: Path, explain: bool, as_json: bool) -> None:
    """Compute R(p, q) of SCENE (scene.toml): the radiance seen by a viewer at +z against the surface's gradient."""
    import numpy as np

    from gonio import jit
    from gonio.config import load_scene

    with speaking(as_json) as output:
        config = load_scene(scene)
        brdf, posterior, origin = steps.scene_brdf(config, scene.parent)
        source = steps.scene_source(config)
        made, values = steps.compute_map(
            output, "reflectance map", brdf, source,
            np.linspace(*config.p, config.n), np.linspace(*config.q, config.n),
            rtol=config.rtol, posterior=posterior, attributes=origin,
        )  # fmt: skip
        out.parent.mkdir(parents=True, exist_ok=True)
        made.save(out)
        if jit.compiled_count():
            output.say(f"compiled {jit.compiled_count()} kernels; the next run finds them in the cache")
        low, high, error = float(made.value.min()), float(made.value.max()), float(made.error.max())
        output.say(f"wrote {out}: R from {low:.6g} to {high:.6g}, integration error at most {error:.1e} (W m^-2 sr^-1)")
        for p, q, weight in made.impulses:
            output.say(f"impulse at p = {p:.6g}, q = {q:.6g} of weight {weight:.6g}")
        if explain:
            _explain(output, values.plan)
        output.result(map=out, smallest=low, largest=high, error=error, impulses=made.impulses)
        output.result(plan=[step.describe() for step in values.plan])


def _explain(output: Output, plan: list[Step]) -> None:
    rows = []
    for step in plan:
        d = step.describe()
        rows.append([
            f"{d['term']} x {d['source']}", str(d["method"]), str(d["evaluations"]), f"{d['largest_relative_error']:.1e}",
            f"{1e3 * step.seconds:.1f} ms",
        ])  # fmt: skip
    output.table("What was done", ["term x source", "method", "evaluations", "largest rel. error", "time"], rows)
    for step in plan:
        output.say(f"  {step.describe()['term']} x {step.describe()['source']}: {step.reason}")
