"""What a report says about samples, fit, table and maps: rows and sentences, no pictures and no files.

Nothing is judged without the number it is judged by. Angles that are fitted in radians are shown in degrees, as their unit
column says.
"""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from importlib import metadata
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import gonio
from gonio import brdf as brdf_models
from gonio.brdf.base import BRDF
from gonio.report.chains import NUISANCE
from gonio.report.html import Cell, Table
from gonio.report.residuals import expected_reading, is_sound, verdict
from gonio.samples import BRDFSamples

if TYPE_CHECKING:
    from gonio.brdf.tables import Tables
    from gonio.maps import ReflectanceMap
    from gonio.posterior import Posterior

_SAMPLER = ("method", "proposals", "ensembles", "walkers", "steps", "burn_in", "thin", "seed")
Array = NDArray[np.float64]
Rows = list[tuple[str, Cell]]

CONVENTIONS = (
    "f_r = dL_r/dE_i as defined by Nicodemus (NBS Monograph 160, 1977), without a cosine. theta is measured from the "
    "surface normal, the mirror direction is at phi_r = phi_i + 180 degrees, p = dz/dx and q = dz/dy with the normal along "
    "(-p, -q, 1)."
)
UNCERTAINTY = (
    "u is a standard uncertainty (k = 1), U = 2 u an expanded one (k = 2, about 95 %). u(f_r) of a sample is its random "
    "part; errors that all samples share are parameters of the fit and are listed apart."
)


def brdf_from(values: Mapping[str, float]) -> BRDF | None:
    """The BRDF of qualified parameter values such as ``{"lambertian.albedo": 0.5, ...}``.

    None if they name no model, or one that comes in several forms, which the names do not tell apart.
    """
    terms: dict[str, dict[str, float]] = {}
    known = brdf_models.models()
    for name, value in values.items():
        term, _, parameter = name.rpartition(".")
        if term.rstrip("0123456789") in known:
            terms.setdefault(term, {})[parameter] = value
    built: BRDF | None = None
    for term, parameters in terms.items():
        model = known[term.rstrip("0123456789")]
        if {p.name for p in model.parameters} != set(parameters) or brdf_models.families.find(model.name).choices:
            return None  # a truth with a parameter missing is no truth
        one = brdf_models.make(model.name, **parameters)
        built = one if built is None else built + one
    return built


def of_samples(samples: BRDFSamples) -> Rows:
    """Counts, ranges and random uncertainty of samples."""
    known = np.isfinite(samples.u_f_r)
    rows: Rows = [
        ("quantity", samples.attributes.get("quantity", "BRDF f_r [1/sr]")),
        ("conventions", CONVENTIONS),
        ("uncertainty", UNCERTAINTY),
        ("samples", len(samples)),
    ]
    if not len(samples):
        return rows
    for name in ("theta_i", "theta_r"):
        theta = np.degrees(getattr(samples, name))
        rows.append((f"{name} [deg]", f"{theta.min():.4g} to {theta.max():.4g}"))
    rows.append(("f_r [1/sr]", f"{samples.f_r.min():.4g} to {samples.f_r.max():.4g}"))
    noise = int(np.sum(samples.f_r <= 0.0))
    rows.append(("samples at or below zero", f"{noise} (noise around zero is kept)" if noise else 0))
    rows.append(("samples with unknown u(f_r)", int(np.sum(~known))))
    ratio = samples.u_f_r[known & (samples.f_r > 0.0)] / samples.f_r[known & (samples.f_r > 0.0)]
    if ratio.size:
        low, middle, high = 100.0 * np.quantile(ratio, [0.05, 0.5, 0.95])
        rows.append(("random u(f_r)/f_r, k = 1", f"median {middle:.3g} %, 5 to 95 % of samples: {low:.3g} to {high:.3g} %"))
    return rows


def of_fit(posterior: Posterior) -> Rows:
    """Model, convergence with its numbers, chi2/N with its consequence."""
    d = posterior.diagnostics
    n_chain, n_draw = posterior.draws.shape[:2]
    rows: Rows = [("model", posterior.model)]
    held = {n: v for n, v in posterior.fixed.items() if not (n.startswith(("shared.", "noise.")) and v == 0.0)}
    if held:
        rows.append(("held fixed", ", ".join(f"{name} = {value:g}" for name, value in held.items())))
    rows.append(("draws", f"{n_chain} independent chains of {n_draw}, burn-in removed"))
    sampler = [f"{key.replace('_', '-')} {d[key]}" for key in _SAMPLER if isinstance(d.get(key), int | str)]
    if sampler:
        rows.append(("sampler", ", ".join(sampler)))
    converged = d.get("converged")
    state = "not known" if converged is None else "converged" if converged else "NOT CONVERGED"
    numbers = []
    for key, label, worst in (("tau", "tau", np.max), ("ess", "ESS", np.min), ("rhat", "R-hat", np.max)):
        values = list(per_parameter(d.get(key), posterior.names).values())
        if values:
            sense = "largest" if worst is np.max else "smallest"
            numbers.append(f"{sense} {label} {float(worst(values)):.4g}")
    acceptance = d.get("acceptance")
    if acceptance is not None:
        numbers.append(f"acceptance {float(np.mean(np.asarray(acceptance, dtype=float))):.2f}")
    rows.append(("convergence", state + (f" ({', '.join(numbers)})" if numbers else "")))
    rows.append(("fit quality", _verdict(d)))
    return rows


def parameters(posterior: Posterior, truth: Mapping[str, float] | None = None, samples: BRDFSamples | None = None) -> Table:
    """Estimate and intervals of each free parameter, with the truth where it is known."""
    summary, d, known = posterior.summary(), posterior.diagnostics, dict(truth or {})
    tau, ess, rhat = (per_parameter(d.get(key), posterior.names) for key in ("tau", "ess", "rhat"))
    contraction = per_parameter(d.get("contraction"), posterior.names)
    header = ["parameter", "unit", "median", "sd (k = 1)", "68 % from", "to", "95 % from", "to", "tau", "ESS", "R-hat"]
    if contraction:
        header.append("contraction")
    if known:
        header[2:2] = ["truth"]
        header.append("(median - truth)/sd")
    rows: list[list[Cell]] = []
    for name in posterior.names:
        s, (unit, scale) = summary[name], _unit(name, samples)
        keys = ("median", "sd", "q16", "q84", "q025", "q975")
        row: list[Cell] = [name, unit, *(scale * float(s[key]) for key in keys)]
        row += [tau.get(name), ess.get(name), rhat.get(name)]
        if contraction:
            row.append(contraction.get(name))
        if known:
            true = known.get(name)
            row[2:2] = [None if true is None else scale * true]
            row.append(None if true is None or not s["sd"] > 0.0 else float((s["median"] - true) / s["sd"]))
        rows.append(row)
    note = "68 %: from the 16 % to the 84 % quantile of the draws; 95 %: from 2.5 % to 97.5 %."
    if contraction:
        note += " Contraction: 1 - variance/variance of the prior; near 0 the data say nothing about the parameter."
    return Table("Parameters of the fit", header, rows, note)


def budget(samples: BRDFSamples, brdf: BRDF | None, posterior: Posterior | None = None) -> Table | None:
    """Uncertainty budget of one reading: the random part, and each shared error carried through the fitted model."""
    rows: list[list[Cell]] = []
    positive = np.isfinite(samples.u_f_r) & (samples.f_r > 0.0)
    if positive.any():
        u = 100.0 * np.quantile(samples.u_f_r[positive] / samples.f_r[positive], [0.5, 0.95])
        rows.append(["random, each sample", None, "", u[0], u[1], 2.0 * u[0]])
    summary = {} if posterior is None else posterior.summary()
    for k, error in enumerate(samples.shared):
        name = f"shared.{error.name}"
        unit, scale = _unit(name, samples)
        shown = "" if unit == "1" else f" {unit}"
        effect = np.abs(samples.d_ln_f[:, k]) if brdf is None else _sensitivity(samples, brdf, k)
        effect = effect[np.isfinite(effect)] * error.u * 100.0
        middle, high = np.quantile(effect, [0.5, 0.95]) if effect.size else (np.nan, np.nan)
        fitted = ""
        if name in summary:
            fitted = f"{scale * summary[name]['mean']:.3g} ± {scale * summary[name]['sd']:.2g}{shown}"
        before, middle = f"{scale * error.u:.3g}{shown}", float(middle)
        rows.append([f"{error.name}, shared", before, fitted, middle, float(high), 2.0 * middle])
    if not rows:
        return None
    header = ["error", "u before the fit (k = 1)", "found by the fit", "u(f_r)/f_r median [%]", "95th percentile [%]",
              "U, k = 2, median [%]"]  # fmt: skip
    return Table(
        "Uncertainty budget of one sample", header, rows,
        "Relative to f_r, over all samples. A shared error moves all samples together and is not averaged away.",
    )  # fmt: skip


def of_maps(maps: Mapping[str, ReflectanceMap]) -> Table:
    """Range, band and quadrature error of each map."""
    rows: list[list[Cell]] = []
    for name, one in maps.items():
        value = one.value[np.isfinite(one.value)]
        width = None
        if one.band is not None:
            good = one.value > 1e-3 * np.nanmax(one.value)
            width = float(np.nanmedian(50.0 * (one.band[1] - one.band[0])[good] / one.value[good])) if good.any() else None
        error = np.asarray(one.error)
        rows.append([
            name, f"{one.value.shape[1]} x {one.value.shape[0]}", float(value.min()) if value.size else None,
            float(value.max()) if value.size else None, width,
            float(np.nanmax(error)) if error.size and np.any(np.isfinite(error)) else None,
        ])  # fmt: skip
    width_of = "half-width of the 68 % band, median [%]"
    header = ["map", "points p x q", "smallest R", "largest R", width_of, "largest integration error"]
    return Table("Reflectance maps R(p, q)", header, rows, "R and its integration error in W m^-2 sr^-1.")


def of_table(table: Tables) -> Table:
    """Number of nodes of a tabulated BRDF by what they rest on."""
    counts = table.counts()
    above = sum(number for name, number in counts.items() if name != "below_horizon")
    rows: list[list[Cell]] = [
        [name, number, 100.0 * number / above if above and name != "below_horizon" else None]
        for name, number in counts.items()
    ]
    shape = " x ".join(str(n) for n in table.main.shape)
    over = "phi_h, theta_h, theta_d, phi_d" if table.grained else "theta_h, theta_d, phi_d"
    of = f", {len(table.channels)} channels" if len(table.channels) > 1 else ""
    return Table(
        f"Tabulated BRDF, {shape} nodes over {over}{of}",
        ["coverage", "nodes", "of those above the horizon [%]"],
        rows,
        "Extrapolated nodes and those from a model are not measurements.",
    )


def warnings_of(samples: BRDFSamples | None, posterior: Posterior | None) -> list[str]:
    """What a reader must know before believing a number: the advice of the fit, and what it did not say."""
    found: list[str] = []
    if posterior is not None:
        d = posterior.diagnostics
        if d.get("converged") is False:
            found.append("The chains have not converged: intervals and bands are not to be trusted.")
        advice = d.get("advice") or []
        found += [advice] if isinstance(advice, str) else [str(sentence) for sentence in advice]
        known, sentence = " ".join(found), _verdict(d)
        if np.isfinite(_number(d.get("chi2_per_n"))) and not is_sound(sentence) and "chi2/N" not in known:
            found.append(sentence)
        weak = [
            name
            for name, value in per_parameter(d.get("contraction"), posterior.names).items()
            if value < 0.3 and not name.startswith(NUISANCE) and name not in known
        ]
        if weak:
            found.append(f"The data hardly constrain {', '.join(weak)}: the interval is mostly that of the prior.")
    if samples is not None and len(samples) and np.all(np.isnan(samples.u_f_r)) and "no uncertainty" not in " ".join(found):
        found.append("The samples state no uncertainty: nothing here tests a model against the noise of the measurement.")
    return found


def versions() -> dict[str, str]:
    """Versions of what computed the report."""
    found = {"gonio": gonio.__version__, "python": platform.python_version()}
    for package in ("numpy", "scipy", "numba", "emcee", "matplotlib"):
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def _verdict(d: Mapping[str, Any]) -> str:
    noise, discrepancy = str(d.get("noise", "stated")), bool(d.get("discrepancy"))
    return verdict(_number(d.get("chi2_per_n")), int(d.get("n_samples") or 0), noise=noise, discrepancy=discrepancy)


def per_parameter(value: Any, names: Sequence[str]) -> dict[str, float]:
    """A diagnostic by parameter, from a mapping, a sequence in the order of the names, or one number for all."""
    if value is None:
        return {}
    if isinstance(value, Mapping):
        pairs = {str(name): _number(item) for name, item in value.items() if name in names}
    else:
        array = np.asarray(value, dtype=float)
        if array.ndim and array.shape != (len(names),):
            return {}
        pairs = dict(zip(names, np.broadcast_to(array, (len(names),)).tolist(), strict=True))
    return {name: item for name, item in pairs.items() if np.isfinite(item)}


def _number(value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        return float("nan")


def natural_unit(name: str, samples: BRDFSamples | None) -> str:
    """Unit of a parameter of a posterior: of its model's declaration, of the shared error, or of the noise."""
    term, _, parameter = name.rpartition(".")
    if term == "shared" and samples is not None:
        return next((error.unit for error in samples.shared if error.name == parameter), "1")
    if name == "noise.absolute":
        return "1/sr"
    model = brdf_models.models().get(term.rstrip("0123456789"))
    return next((p.unit for p in model.parameters if p.name == parameter), "1") if model else "1"


def _unit(name: str, samples: BRDFSamples | None) -> tuple[str, float]:
    """Unit in which a parameter is shown, and the factor from its natural unit."""
    unit = natural_unit(name, samples)
    return ("deg", 180.0 / np.pi) if unit == "rad" else (unit, 1.0)


def _sensitivity(samples: BRDFSamples, brdf: BRDF, k: int) -> Array:
    """abs(d ln f / d delta_k) of each sample, through directions and scale."""
    step = np.zeros(len(samples.shared))
    step[k] = 1e-5
    up, down = expected_reading(samples, brdf, step), expected_reading(samples, brdf, -step)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.abs((up - down) / (1e-5 * (up + down)))
