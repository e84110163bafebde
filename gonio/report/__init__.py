"""Pictures and a report of a run, from objects that are already in memory.

`build` writes ``report.html``, its twin ``report.json`` and ``figures/*.png`` into a folder. It reads no run, fits nothing
and integrates nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gonio.report import content, style
from gonio.report.chains import corner, trace
from gonio.report.contours import map_contours
from gonio.report.html import Table, write_bytes, write_report
from gonio.report.residuals import expected_reading, residuals, verdict
from gonio.report.slices import brdf_slices, coverage, residual_plot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from gonio.brdf.base import BRDF
    from gonio.brdf.tables import Tables
    from gonio.maps import ReflectanceMap
    from gonio.posterior import Posterior
    from gonio.samples import BRDFSamples

__all__ = [
    "Table",
    "brdf_slices",
    "build",
    "corner",
    "coverage",
    "expected_reading",
    "map_contours",
    "residual_plot",
    "residuals",
    "trace",
    "verdict",
    "write_report",
]

_BAND_DRAWS = 200
_PRINT_DPI = 200


def build(
    folder: str | Path,
    *,
    title: str = "BRDF report",
    samples: BRDFSamples | None = None,
    table: Tables | None = None,
    posterior: Posterior | None = None,
    maps: Mapping[str, ReflectanceMap] | None = None,
    truth: Mapping[str, float] | None = None,
    attributes: Mapping[str, object] | None = None,
    warnings: Sequence[str] = (),
    documents: Mapping[str, str] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write the report of a run.

    Parameters
    ----------
    folder : path-like
        Gets ``report.html``, ``report.json`` and ``figures/``; made if it does not exist.
    title : str, optional
    samples : BRDFSamples, optional
    table : Tables, optional
        Its line in the slices, and how much of it was measured.
    posterior : Posterior, optional
    maps : mapping of str to ReflectanceMap, optional
        By name; a name becomes part of a file name and of a title.
    truth : mapping of str to float, optional
        True values by qualified name, where they are known.
    attributes : mapping of str to object, optional
        Provenance: sample, operator, seeds, hashes, times; shown as given. Versions are added.
    warnings : sequence of str, optional
        Shown first, with those that the report finds itself.
    documents : mapping of str to str, optional
        Configuration texts to keep with it.
    progress : callable, optional
        Called with (done, total) after each picture.

    Returns
    -------
    Path
        Of ``report.html``.
    """
    target = Path(folder)
    maps = dict(maps or {})
    model = None if posterior is None else posterior.brdf()
    jobs = _figures(samples, None if table is None else table.brdf(), posterior, model, maps, dict(truth or {}))
    pictures: list[tuple[str, Figure]] = []
    for done, (name, caption, make) in enumerate(jobs, 1):
        figure = make()
        write_bytes(target / "figures" / f"{name}.png", style.png(figure, _PRINT_DPI))
        pictures.append((caption, figure))
        if progress is not None:
            progress(done, len(jobs))

    summary: content.Rows = []
    tables: list[Table] = []
    data: dict[str, object] = {"versions": content.versions(), "attributes": dict(attributes or {})}
    if samples is not None:
        summary += content.of_samples(samples)
    if posterior is not None:
        summary += content.of_fit(posterior)
        tables.append(content.parameters(posterior, truth, samples))
        data |= {
            "model": posterior.model, "parameters": posterior.summary(), "fixed": dict(posterior.fixed),
            "diagnostics": dict(posterior.diagnostics), "truth": dict(truth or {}),
        }  # fmt: skip
    if samples is not None and len(samples):
        tables += [t for t in (content.budget(samples, model, posterior),) if t is not None]
    if table is not None:
        tables.append(content.of_table(table))
        data["coverage"] = table.counts()
    if maps:
        tables.append(content.of_maps(maps))
    given = {**(dict(samples.attributes) if samples is not None else {}), **(attributes or {})}
    if given:
        rows = [[str(key), value if isinstance(value, str | int | float) else str(value)] for key, value in given.items()]
        tables.append(Table("Provenance", ["item", "value"], rows))
    tables.append(Table("Versions", ["software", "version"], [[k, v] for k, v in content.versions().items()]))
    return write_report(
        target / "report.html",
        title=title,
        summary=summary,
        tables=tables,
        figures=pictures,
        warnings=[*warnings, *(w for w in content.warnings_of(samples, posterior) if w not in warnings)],
        documents=documents,
        data=data,
    )


def _figures(
    samples: BRDFSamples | None,
    table: BRDF | None,
    posterior: Posterior | None,
    model: BRDF | None,
    maps: Mapping[str, ReflectanceMap],
    truth: Mapping[str, float],
) -> list[tuple[str, str, Callable[[], Figure]]]:
    """(file name, caption, how to draw it) of every picture for which there is something to draw."""
    jobs: list[tuple[str, str, Callable[[], Figure]]] = []
    for number, (name, one) in enumerate(maps.items(), 1):
        caption = (
            f"Reflectance map, {name}: contours of constant R(p, q), labelled in W m^-2 sr^-1. A red ring marks the "
            "gradient that faces a source; where its light grazes the surface, the line is dashed; grey is unlit."
        )
        if one.band is not None:
            caption += " Right: half-width of the 68 % band of the posterior, relative to R."
        slug = "".join(c if c.isascii() and c.isalnum() else "_" for c in name)[:40].strip("_")
        jobs.append((f"map_{number}_{slug}".rstrip("_"), caption, _map_job(one, name)))
    if samples is not None and len(samples):
        terms = {name.rpartition(".")[0] for name in truth}
        held = {} if posterior is None else posterior.fixed  # a truth need not repeat what the fit holds
        known = content.brdf_from({n: v for n, v in held.items() if n.rpartition(".")[0] in terms} | dict(truth))
        band: list[BRDF] = []
        scatter: Any = None
        if posterior is not None:
            draws = posterior.thin(_BAND_DRAWS, np.random.default_rng(0))
            band = [posterior.brdf(row) for row in draws]
            scatter = _scatter(posterior, draws)
        fit: Any = model
        measured = samples
        jobs.append((
            "slices",
            "BRDF in the plane of incidence, one panel for each angle of incidence; theta_r is positive on the mirror side, "
            "and the dotted line is the mirror direction. Bars are random standard uncertainties (k = 1).",
            lambda: brdf_slices(measured, fit, band=band, scatter=scatter, truth=known, table=table),
        ))  # fmt: skip
        if posterior is not None and fit is not None:
            # without the discrepancy of the model: the picture is to show where the model fails
            centre = dict(posterior.fixed) | {name: row["median"] for name, row in posterior.summary().items()}
            centre["noise.discrepancy"] = 0.0
            left = residuals(measured, fit, centre)
            jobs.append((
                "residuals",
                "Residuals of the fit, shared errors at their fitted values, in units of the stated uncertainty of one "
                "sample, or of the inferred one (in % of the model where there is neither): against the half angle, in the "
                "order of the samples, and as a histogram beside a unit normal. Between -2 and 2 is grey.",
                lambda: residual_plot(measured, left),
            ))  # fmt: skip
        jobs.append((
            "coverage",
            "Where the samples lie in half and difference angles (Rusinkiewicz). Beyond the dashed line part of the "
            "azimuths phi_d is below the horizon and cannot be measured.",
            lambda: coverage(measured),
        ))  # fmt: skip
    if posterior is not None:
        units = {name: content.natural_unit(name, samples) for name in posterior.names}
        jobs += [(
            "corner",
            "Posterior of the material's parameters, nuisance parameters integrated out: central 68 % shaded, contours "
            "around 39 % and 86 % of the draws (1 and 2 sd). Dashed: the truth, where it is known.",
            lambda: corner(posterior, truth),
        ), (
            "trace",
            "All fitted parameters and the log probability along the chains, burn-in removed.",
            lambda: trace(posterior, units=units),
        )]  # fmt: skip
    return jobs


def _map_job(one: ReflectanceMap, name: str) -> Callable[[], Figure]:
    return lambda: map_contours(one, title=name)


def _scatter(posterior: Posterior, draws: Any) -> Any:
    """Relative and absolute noise of a reading that each draw has inferred, shape (draws, 2); None if none was."""
    column = {name: draws[:, i] for i, name in enumerate(posterior.names) if name.startswith("noise.")}
    if not column.keys() & {"noise.relative", "noise.absolute", "noise.discrepancy"}:
        return None
    none = np.zeros(len(draws))
    relative = np.hypot(column.get("noise.relative", none), column.get("noise.discrepancy", none))
    return np.column_stack((relative, column.get("noise.absolute", none)))
