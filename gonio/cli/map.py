"""gonio map: the reflectance map of a scene, and the image of a surface under it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from gonio.cli import steps
from gonio.cli.output import Output, json_option, speaking
from gonio.errors import ParameterError
from gonio.integrate.plan import Step

if TYPE_CHECKING:
    from gonio.maps import ReflectanceMap


@click.command("map")
@click.argument("scene", type=click.Path(path_type=Path, dir_okay=False))
@click.option("--out", required=True, type=click.Path(path_type=Path, dir_okay=False), help="NetCDF file to write.")
@click.option("--explain", is_flag=True, help="Print what was computed how, what was skipped, and what it took.")
@click.option(
    "--render", type=click.Path(path_type=Path, dir_okay=False), metavar="HEIGHTS",
    help="Also write the image of a surface z(x, y), .npy or .tiff: OUT_image.npy (.tiff). No shadows, no occlusion.",
)  # fmt: skip
@click.option("--spacing", metavar="DX[,DY]", help="Distance of HEIGHTS' columns and rows; DY < 0 if rows run downwards.")
@json_option
def map_(scene: Path, out: Path, explain: bool, render: Path | None, spacing: str | None, as_json: bool) -> None:
    """Compute R(p, q) of SCENE (scene.toml): the radiance seen by a viewer at +z against the surface's gradient."""
    import numpy as np

    from gonio import jit
    from gonio.config import load_scene

    with speaking(as_json) as output:
        step = _spacing(spacing, render)
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
        if render is not None:
            _render(output, made, render, step, out, config.rtol)


def _spacing(text: str | None, render: Path | None) -> tuple[float, ...]:
    """(dx, dy); checked before anything is computed."""
    if (text is None) != (render is None):
        raise ParameterError("--render and --spacing go together: heights, and the distance of their columns and rows")
    try:
        numbers = tuple(float(word) for word in (text or "1").split(","))
    except ValueError:
        numbers = ()
    if len(numbers) not in (1, 2):
        raise ParameterError(f"--spacing {text} is not DX or DX,DY; give one or two numbers in the unit of the heights")
    return numbers * (2 // len(numbers))


def _render(output: Output, made: ReflectanceMap, heights: Path, spacing: tuple[float, ...], out: Path, rtol: float) -> None:
    import numpy as np

    from gonio.maps.images import read_heights, write_image

    image = made.render_heights(read_heights(heights), spacing, rtol=rtol)
    target = write_image(out.with_name(f"{out.stem}_image{heights.suffix.lower()}"), image.value)
    seen = np.isfinite(image.value)
    rows, columns, holes = *seen.shape, int(np.sum(~seen))
    error = float(np.max(image.error[seen], initial=0.0))
    output.say(
        f"wrote {target}: {rows} x {columns} pixels, {holes} without a surface, integration error at most {error:.1e}"
    )
    output.result(image=target, pixels_without_surface=holes)


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
