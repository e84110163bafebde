"""gonio map: the reflectance map of a scene, and the image of a surface under it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from gonio.cli import steps
from gonio.cli.output import Output, json_option, speaking
from gonio.errors import ConfigurationError, DatasetError, ParameterError

if TYPE_CHECKING:
    from gonio.maps import ReflectanceMap


@click.command("map")
@click.argument("scene", type=click.Path(path_type=Path, dir_okay=False))
@click.option(
    "--out", type=click.Path(path_type=Path, dir_okay=False), help="NetCDF file to write; else the scene's [output] map."
)
@click.option(
    "--plot", type=click.Path(path_type=Path, dir_okay=False),
    help="Picture to write, .png: contours in gradient space; else the scene's [output] plot.",
)  # fmt: skip
@click.option("--explain", is_flag=True, help="Print what was computed how, what was skipped, and what it took.")
@click.option(
    "--render", type=click.Path(path_type=Path, dir_okay=False), metavar="HEIGHTS",
    help="Also write the image of a surface z(x, y), .npy or .tiff: OUT_image.npy (.tiff). No shadows, no occlusion.",
)  # fmt: skip
@click.option("--spacing", metavar="DX[,DY]", help="Distance of HEIGHTS' columns and rows; DY < 0 if rows run downwards.")
@json_option
def map_(
    scene: Path, out: Path | None, plot: Path | None, explain: bool, render: Path | None, spacing: str | None, as_json: bool
) -> None:
    """Compute R(p, q) of SCENE (scene.toml): the radiance that a viewer sees against the surface's gradient."""
    import numpy as np

    from gonio import jit
    from gonio.config import load_scene
    from gonio.fields import EnvironmentMap

    with speaking(as_json) as output:
        step = _spacing(spacing, render)
        config = load_scene(scene)
        out, plot = out or config.map, plot or config.plot
        if out is None:
            raise ConfigurationError(f'{scene}: no file to write; give --out MAP.nc, or map = "..." under [output]')
        if plot is not None and plot.suffix.lower() != ".png":
            raise ParameterError(f"--plot {plot}: the picture is a PNG; give a name that ends in .png")
        for target in (out, plot):
            if target is not None:
                _make_folder(target)
        brdf, posterior, origin = steps.scene_brdf(config, scene.parent)
        grained = next((term.model.name for term in brdf.terms if not term.model.isotropic), None)
        if grained is not None and config.tangent is None:
            raise ConfigurationError(
                f"{scene}: {grained} is anisotropic; say how its grain runs: rotation_deg = 0 under [surface] is along x"
            )
        source = steps.scene_source(config)
        if config.viewer is not None and any(isinstance(part, EnvironmentMap) for part in source.parts):
            output.warn(
                f"{scene}: with the viewer off axis, an environment map can cost seconds for each of the "
                f"{config.n[0] * config.n[1]} gradients; a smaller [grid] n or a larger rtol shortens it"
            )
        made, values = steps.compute_map(
            output, "reflectance map", brdf, source,
            np.linspace(*config.p, config.n[0]), np.linspace(*config.q, config.n[1]),
            rtol=config.rtol, atol=config.atol, viewer=config.viewer, tangent=config.tangent,
            posterior=posterior, attributes=origin,
        )  # fmt: skip
        made.save(out)
        if jit.compiled_count():
            output.say(f"compiled {jit.compiled_count()} kernels; the next run finds them in the cache")
        low, high, error = float(made.value.min()), float(made.value.max()), float(made.error.max())
        kind = "at most" if values.error_is_bound else "an estimated"
        output.say(f"wrote {out}: R from {low:.6g} to {high:.6g}, integration error {kind} {error:.1e} (W m^-2 sr^-1)")
        if plot is not None:
            _plot(made, plot)
            output.say(f"wrote {plot}")
            output.result(plot=plot)
        for p, q, weight in made.impulses:
            at = f"p = {round(p, 12) + 0.0:.6g}, q = {round(q, 12) + 0.0:.6g}"
            output.say(f"impulse at {at} of weight {weight:.6g} (W m^-2 sr^-1 times the area element dp dq)")
        if explain:
            from gonio.cli.explain import explained

            explained(output, made, values, config.rtol)
        output.result(map=out, smallest=low, largest=high, error=error, impulses=made.impulses)
        output.result(plan=[step.describe() for step in values.plan])
        if render is not None:
            _render(output, made, render, step, out, config.rtol)


def _make_folder(target: Path) -> None:
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as exc:
        raise DatasetError(f"{target} cannot be written ({exc.strerror or exc}); give another place") from exc


def _plot(made: ReflectanceMap, target: Path) -> None:
    from gonio.files import replace_atomically
    from gonio.report import map_contours, style

    picture = style.png(map_contours(made))
    replace_atomically(target, lambda temporary: temporary.write_bytes(picture))


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
