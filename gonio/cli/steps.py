"""The steps from a run to its products, each used by its own verb and by the demo."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gonio.cli.output import Output, log_to
from gonio.errors import ConfigurationError, DatasetError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from gonio.brdf.base import BRDF
    from gonio.brdf.tables import Tables
    from gonio.channels import ChannelSamples
    from gonio.config import SceneConfig
    from gonio.integrate import MapValues
    from gonio.maps import ReflectanceMap
    from gonio.posterior import Posterior
    from gonio.samples import BRDFSamples
    from gonio.scan import Run
    from gonio.source import Source

log = logging.getLogger("gonio")
BAND_DRAWS = 200


def open_run(path: Path) -> Run:
    """Open a run and send the log to it."""
    from gonio.scan import Run

    run = Run.open(path)
    log_to(run.log_path)
    return run


def reduce_run(run: Run, output: Output) -> BRDFSamples:
    """Frames of a scan to samples, stored in the run."""
    from gonio.config import parse_rig
    from gonio.radiometry import reduce_run as reduction

    if run.kind != "scan":
        raise DatasetError(f"{run.path} was imported: it has samples already and no frames to reduce")
    rig = parse_rig(run.document("rig.toml"), f"{run.path}: rig.toml")
    with output.stage("reduce frames") as progress:
        samples = reduction(run, rig, lambda _, done, total: progress(done, total))
        run.write_samples(samples)
    log.info("reduced to %d samples", len(samples))
    output.result(samples=len(samples), shared_errors={error.name: error.u for error in samples.shared})
    return samples


def all_samples(run: Run) -> BRDFSamples | ChannelSamples:
    """The samples of a run, in all channels if it was imported from a file with several."""
    from gonio import formats

    return formats.read_channels(run.channels_path) if run.channels_path.exists() else run.read_samples()


def tabulate(run: Run, output: Output, *, fill: BRDF | None = None, channel: str | None = None) -> Tables:
    """Samples to tables of all channels or of one, written as table.nc."""
    from gonio.brdf.tables import tabulate as make_tables
    from gonio.channels import ChannelSamples

    samples = all_samples(run)
    if channel is not None:
        if not isinstance(samples, ChannelSamples):
            raise ConfigurationError(f"{run.path} has one channel; leave --channel {channel} away")
        samples = samples.channel(channel)
    with output.stage("tabulate") as progress:
        tables = make_tables(samples, fill=fill, progress=progress)
        tables.save(run.table_path)
    output.result(table=run.table_path, coverage=tables.counts(), channels=tables.channels.names, grain=tables.grained)
    return tables


def load_table(run: Run) -> Tables:
    """The tables of a run."""
    from gonio.brdf.tables import Tables

    if not run.table_path.exists():
        raise DatasetError(f"{run.path} has no table yet; make it with: gonio table {run.path}")
    return Tables.load(run.table_path)


def load_posterior(run: Run, *, whole: bool = False) -> Posterior:
    """The fit of a run; of one to several channels, that of the main one unless the `whole` is wanted."""
    from gonio.channels import from_names
    from gonio.posterior import Posterior

    if not run.posterior_path.exists():
        raise DatasetError(f"{run.path} has no fit yet; make it with: gonio fit {run.path} --model lambertian+ggx")
    posterior = Posterior.load(run.posterior_path)
    if whole or not posterior.channels:
        return posterior
    return posterior.channel(posterior.channels[from_names(posterior.channels, str(run.posterior_path)).main])


def remounts(run: Run, others: Sequence[Path | str], u_mount: float) -> BRDFSamples:
    """Samples of a run, together with those of others of the same sample, if any."""
    from gonio.samples import together

    if not others:
        return run.read_samples()
    parts = [run.read_samples()]
    for path in others:
        with open_run(Path(path)) as other:
            parts.append(other.read_samples())
    return together(parts, u_mount)


def fit(
    run: Run, output: Output, model: str, seed: int, *, others: Sequence[Path] = (), u_mount: float = 0.0,
    channels: bool = False, **options: Any,
) -> Posterior:  # fmt: skip
    """Samples to a posterior, written as posterior.nc; angles among the options as a user writes them, in degrees.

    `others` are runs of the same sample after remounting, each with a relative error of its own of sd `u_mount`.
    With `channels`, all channels at once: one roughness, and an albedo of each.
    """
    from fitting import fit as run_fit
    from gonio.cli.units import angles_of_fit, fit_options

    if channels and others:
        raise ConfigurationError("--channels and --with exclude each other; fit remounted runs one channel at a time")
    samples = all_samples(run) if channels else remounts(run, others, u_mount)
    options = fit_options(options, angles_of_fit(model, samples))
    with output.stage("fit") as progress:
        posterior = run_fit(samples, model, seed=seed, progress=progress, **options)
        if others:
            runs = {"other_runs": [str(path.resolve()) for path in others], "u_mount": u_mount}
            posterior = replace(posterior, diagnostics={**posterior.diagnostics, **runs})
        posterior.save(run.posterior_path)
    status = posterior.diagnostics
    log.info("fit %s: %s", model, {k: v for k, v in status.items() if isinstance(v, str | bool | int | float)})
    output.result(
        converged=bool(status.get("converged")),
        parameters=posterior.summary(),
        fixed=dict(posterior.fixed),
        diagnostics=dict(status),
        posterior=run.posterior_path,
    )
    return posterior


def show_fit(output: Output, posterior: Posterior, truth: Mapping[str, float] | None = None) -> None:
    """Table of the parameters, with the truth where it is known, and whether the chains converged."""
    header = ["parameter", *(["truth"] if truth is not None else []), "estimate", "68 % interval", "95 % interval"]
    units = posterior.diagnostics.get("units") or {}
    rows = []
    for name, s in posterior.summary().items():
        # an angle is shown in degrees, as everything at the user's edge
        degrees = units.get(name) == "rad"
        scale = math.degrees(1.0) if degrees else 1.0
        known = [f"{scale * truth[name]:.4g}" if name in truth else ""] if truth is not None else []
        intervals = [f"{scale * s[low]:.4g} to {scale * s[high]:.4g}" for low, high in (("q16", "q84"), ("q025", "q975"))]
        rows.append([name + (" [deg]" if degrees else ""), *known, f"{scale * s['median']:.4g}", *intervals])
    output.table(f"Fit of {posterior.model}", header, rows)
    output.say(describe_convergence(posterior))


def describe_convergence(posterior: Posterior) -> str:
    """One sentence on tau, ESS, R-hat and chi2/N."""
    import numpy as np

    d = posterior.diagnostics
    state = "converged" if d.get("converged") else "NOT CONVERGED"

    def worst(key: str, pick: Any) -> str:
        value = d.get(key)
        if value is None:
            return "?"
        items = list(value.values()) if isinstance(value, Mapping) else np.atleast_1d(np.asarray(value, dtype=float))
        return f"{float(pick(items)):.4g}"

    how = (
        f"importance sampling with Pareto k = {max(float(d['k_hat'] or 0.0), 0.0):.2f}"
        if "k_hat" in d
        else f"autocorrelation time up to {worst('tau', max)}"
    )
    text = (
        f"{state}: {how}, effective sample size at least {worst('ess', min)}, "
        f"R-hat up to {worst('rhat', max)}; chi2/N = {worst('chi2_per_n', max)}"
    )
    advice = d.get("advice")
    if advice:
        text += ". " + (advice if isinstance(advice, str) else ". ".join(advice))
    return text


def scene_brdf(scene: SceneConfig, folder: Path) -> tuple[BRDF, Posterior | None, dict[str, str]]:
    """The BRDF of a scene, the posterior it comes from if any, and where it is from."""
    config = scene.brdf
    if config.run is None:
        brdf = config.build()
        return brdf, None, {"brdf": repr(brdf)}
    path = Path(config.run)
    if not path.is_absolute() and not path.exists():
        path = folder / path
    with open_run(path) as run:
        if config.use == "table":
            tables = load_table(run)
            n = len(tables.channels)
            which = f", channel {tables.channels.names[tables.channels.main]} of {n}" if n > 1 else ""
            return tables.brdf(), None, {"brdf": f"table of {path}{which}"}
        posterior = load_posterior(run)
    return posterior.brdf(), posterior, {"brdf": f"fit of {path}: {posterior.brdf()!r}"}


def scene_source(scene: SceneConfig) -> Source:
    """The sum of the scene's sources."""
    made = [config.build() for config in scene.sources]
    total = made[0]
    for source in made[1:]:
        total = total + source
    return total


def compute_map(
    output: Output,
    title: str,
    brdf: BRDF,
    source: Source,
    p: NDArray[np.float64],
    q: NDArray[np.float64] | None = None,
    *,
    rtol: float,
    atol: float = 0.0,
    viewer: tuple[float, float] | None = None,
    tangent: float | None = None,
    posterior: Posterior | None = None,
    attributes: Mapping[str, str] | None = None,
) -> tuple[ReflectanceMap, MapValues]:
    """A map on the axes p and q (p again by default), with its band if there is a posterior.

    A tolerance that is not met is told, not hidden.
    """
    import numpy as np

    from gonio import maps

    draws = []
    if posterior is not None:
        chosen = posterior.thin(BAND_DRAWS, np.random.default_rng(0))
        draws = [posterior.brdf(values) for values in chosen]
    with output.stage(title) as progress:
        made, values = maps.compute(
            brdf,
            source,
            p,
            p if q is None else q,
            rtol=rtol,
            atol=atol,
            viewer=viewer,
            tangent=tangent,
            draws=draws,
            attributes={"source": repr(source), "rtol": f"{rtol:g}", **(attributes or {})},
            progress=lambda done: progress(done, len(draws)),
            tolerant=True,
        )
    allowed = np.maximum(rtol * np.abs(made.value), max(atol, 1e-13 * float(np.max(np.abs(made.value)))))
    missed = made.error > allowed * (1.0 + 1e-9)
    if np.any(missed):
        with np.errstate(divide="ignore"):
            reached = float(np.max(made.error[missed] / np.abs(made.value[missed])))
        output.warn(
            f"{title}: the integration reached a relative error of {reached:.1e} at {np.sum(missed)} of {missed.size} "
            f"gradients where {rtol:.0e} was asked for"
        )
    return made, values


def export(run: Run, name: str, path: Path, output: Output) -> None:
    """Write the data set of a run in one format."""
    from gonio import formats
    from gonio.formats.quantity import SHORT

    samples = all_samples(run) if run.has_samples() else None
    table = load_table(run) if run.table_path.exists() else None
    posterior = load_posterior(run) if run.posterior_path.exists() else None
    path.parent.mkdir(parents=True, exist_ok=True)
    form = formats.FORMATS.get(name)
    if form is not None and form.writes == "grid":
        _warn_of_coverage(output, samples, table, posterior)
    formats.export(
        name,
        path,
        samples=samples,
        table=table,
        brdf=None if posterior is None else posterior.brdf(),
        attributes={"run": run.path.name},
    )
    form = formats.FORMATS[name]
    stated = form.quantity or "brdf"
    output.say(f"wrote {path}: {SHORT[stated]}, {form.doc}")
    output.result(file=path, format=name, quantity=stated)


def _warn_of_coverage(
    output: Output, samples: BRDFSamples | ChannelSamples | None, table: Tables | None, posterior: Posterior | None
) -> None:
    """Say what of a file that holds every direction was not measured."""
    if table is not None:
        counts = table.counts()
        above = sum(n for name, n in counts.items() if name != "below_horizon")
        guessed = counts["extrapolated"] + counts["model"]
        if guessed > 0.1 * above:
            source = "a fitted model" if counts["model"] else "extrapolation"
            output.warn(f"{100 * guessed / above:.0f} % of the table's nodes were not measured and come from {source}")
    elif posterior is not None and samples is not None:
        output.warn(f"there is no table: all directions come from the fit of {posterior.model} to {len(samples)} samples")


def report(
    run: Run,
    output: Output,
    *,
    maps: Mapping[str, ReflectanceMap] | None = None,
    truth: Mapping[str, float] | None = None,
    warnings: Sequence[str] = (),
) -> Path:
    """Plots and report.html of whatever the run has."""
    from gonio import report as reporting
    from gonio.maps import ReflectanceMap

    if maps is None:
        maps = {file.stem: ReflectanceMap.load(file) for file in sorted(run.path.glob("map*.nc"))}
    posterior = load_posterior(run) if run.posterior_path.exists() else None
    with output.stage("report") as progress:
        attributes = {k: v for k, v in run.attributes.items() if k not in ("kind",)}
        path = reporting.build(
            run.path,
            title=f"gonio report: {run.path.name}",
            samples=_fitted_samples(run, posterior) if run.has_samples() else None,
            table=load_table(run) if run.table_path.exists() else None,
            posterior=posterior,
            maps=maps,
            truth=truth,
            attributes=attributes,
            warnings=warnings,
            documents=run.documents,
            progress=progress,
        )
    output.say(f"wrote {path}")
    output.result(report=path)
    return path


def _fitted_samples(run: Run, posterior: Posterior | None) -> BRDFSamples:
    """What the posterior was fitted to: the run's samples, with those of other runs if they were fitted together."""
    given = {} if posterior is None else posterior.diagnostics
    return remounts(run, given.get("other_runs", ()), given.get("u_mount", 0.0))
