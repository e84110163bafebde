"""gonio fit-batch: many pixels, wavelengths or materials at once."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from gonio.cli.fit_choices import chosen_fit, fit_choices
from gonio.cli.output import Output, json_option, speaking
from gonio.errors import ConfigurationError, DeviceError

if TYPE_CHECKING:
    from fitting.batch import Job
    from gonio.cli.cubes import ChannelSource, CubeSource, ZarrSink


@click.command("fit-batch")
@click.argument("data", type=click.Path(path_type=Path, exists=True))
@fit_choices
@click.option(
    "--out", required=True, type=click.Path(path_type=Path), help="Zarr folder of the estimates; goes on if it is begun."
)
@click.option("--quantity", type=click.Choice(["brdf", "brf", "brdf_cos"]), help="As for `gonio import`.")
@click.option("--processes", type=click.IntRange(1), help="On this machine; its cores by default.")
@click.option("--scheduler", metavar="tcp://HOST:PORT", help="Of a Dask cluster to compute on instead.")
@click.option("--tile", type=click.IntRange(1), default=1024, show_default=True, help="Pixels that are fitted together.")
@click.option("--validate", type=click.IntRange(0), default=0, metavar="N", help="Fit N of the pixels with emcee, too.")
@json_option
def fit_batch(
    data: Path,
    model: str | None,
    config: Path | None,
    free: tuple[str, ...],
    fix: tuple[str, ...],
    out: Path,
    quantity: str | None,
    processes: int | None,
    scheduler: str | None,
    tile: int,
    validate: int,
    as_json: bool,
) -> None:
    """Fit a model to every pixel of DATA: a Zarr cube, or each channel of any file that gonio reads.

    Each pixel gets means, standard deviations and quantiles, chi2/N and a status. Interrupt it when you like; the same
    command goes on with the tiles that are missing.
    """
    import math
    import os

    from fitting import tiles
    from fitting.batch import Job
    from gonio.cli import cubes
    from gonio.cli.units import angles_of_fit, fit_options

    model, _, options = chosen_fit(model, config, free, fix)
    options.pop("max_steps", None)
    cubes.zarr()  # before anything is computed
    with speaking(as_json) as output:
        source: CubeSource | ChannelSource
        if cubes.is_cube(data):
            if quantity is not None:
                raise ConfigurationError(f"a cube holds f_r; leave --quantity {quantity} away")
            source = cubes.CubeSource(str(data.resolve()))
            samples = source.samples()
        else:
            from gonio import formats

            source, samples = cubes.ChannelSource.of(formats.read_channels(data, quantity))
        job = Job(samples, model, **fit_options(options, angles_of_fit(model, samples)))
        shape = source.shape
        cut = tiles.cut(shape[0], math.prod(shape[1:]), tile)
        sink = cubes.ZarrSink(out, job, source, shape, cut, {"data": data.name})
        with _cluster(scheduler) as client, output.stage("fit batch") as progress:
            computed = tiles.run(
                job, source, sink, cut, processes=processes or os.cpu_count() or 1, client=client, progress=progress
            )
        if computed < len(cut):
            output.say(f"{len(cut) - computed} of {len(cut)} tiles were there already")
        _tell(output, job, sink)
        if validate:
            _validate(output, job, source, sink, validate)
        output.result(out=out, tiles=len(cut), computed=computed)
        output.say(f"wrote {out}")


@contextlib.contextmanager
def _cluster(address: str | None) -> Iterator[Any]:
    """A client of a Dask scheduler, or None without an address."""
    if address is None:
        yield None
        return
    try:
        from distributed import Client
    except ImportError as error:
        raise ConfigurationError("Dask is not installed; pip install 'gonio[cluster]'") from error
    try:
        client = Client(address, timeout=5, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise DeviceError(f"no Dask scheduler answers at {address} ({error}); start one with: dask scheduler") from error
    with client:
        yield client


def _tell(output: Output, job: Job, sink: ZarrSink) -> None:
    import numpy as np

    from fitting.batch import STATUS
    from fitting.diagnostics import CONTRACTION_LIMIT, misfit_limit

    found = sink.arrays()
    good = found["status"] == 0
    count = {name: int(np.sum(found["status"] == k)) for k, name in enumerate(STATUS)}
    rows = []
    names = job.engine().names
    for i, name in enumerate(names):
        if np.any(good):
            cells = [np.median(found["mean"][good, i]), np.median(found["sd"][good, i])]
            blind = float(np.mean(found["contraction"][good, i] < CONTRACTION_LIMIT))
            rows.append([name, *(f"{cell:.4g}" for cell in cells), f"{100 * blind:.1f} %"])
    output.table(f"Fits of {job.model}", ["parameter", "median estimate", "median sd", "not informed by the data"], rows)
    output.say(f"{len(good)} pixels: " + ", ".join(f"{n} {name}" for name, n in count.items() if n or name == "good"))
    missed = int(np.sum(found["chi2_per_n"][good] > misfit_limit(len(job.samples))))
    if missed:
        output.warn(
            f"the model does not describe {missed} of {int(np.sum(good))} pixels within the stated uncertainty: "
            "their intervals are too narrow; try another model"
        )
    output.result(status=count, misfits=missed, parameters=list(names))


def _validate(output: Output, job: Job, source: CubeSource | ChannelSource, sink: ZarrSink, count: int) -> None:
    """Fit some good pixels, chosen at random, and some others with emcee, and tell how far off the fast fits are."""
    import math

    import numpy as np

    from fitting.batch import Estimates
    from fitting.validation import validate

    found = sink.arrays()
    rng = np.random.default_rng(0)
    good, poor = np.flatnonzero(found["status"] == 0), np.flatnonzero(found["status"] > 1)
    chosen = [*rng.permutation(good)[:count].tolist(), *rng.permutation(poor)[:count].tolist()]
    width = math.prod(source.shape[1:])
    rows, worst, lost = [], 0.0, 0
    with output.stage("emcee on some pixels") as progress:
        for done, pixel in enumerate(chosen, 1):
            readings, u = source.read(pixel // width, pixel // width + 1)
            inside = pixel % width
            one = Estimates(job.engine().names, **{name: array[pixel : pixel + 1] for name, array in found.items()})
            u_one = None if u is None else u[inside : inside + 1]
            (c,) = validate(job, readings[inside : inside + 1], u_one, one, [0])
            told = "good" if found["status"][pixel] == 0 else "not good"
            ratio = f"{np.min(c.ratio):.3f} to {np.max(c.ratio):.3f}"
            rows.append([str(pixel), told, f"{np.max(np.abs(c.shift)):.3f}", ratio])
            lost += not c.converged
            if told == "good" and c.converged:
                worst = max(worst, float(np.max(np.abs(c.shift))))
            progress(done, len(chosen))
    header = ["pixel", "status", "largest shift of a mean / sd", "sd / sd of emcee"]
    output.table("Against emcee", header, rows)
    if lost:
        output.warn(f"emcee did not converge for {lost} of {len(chosen)} pixels; they say nothing")
    output.result(validated=len(chosen), largest_shift=worst)
