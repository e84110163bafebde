"""BRDF samples against a model: slices with error bars, pulls, and where in angle the samples lie.

The measurement is drawn as it is: an error bar is the random standard uncertainty of one reading (k = 1), and no point is
moved by a fitted shared error. The model is drawn in the plane of incidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gonio.brdf.base import BRDF
from gonio.halfdiff import half_difference
from gonio.maps.simultaneous import band_of_curves
from gonio.report import style
from gonio.report.residuals import Residuals
from gonio.samples import BRDFSamples

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

IN_PLANE = np.radians(1.0)  # a reflected direction nearer than this to the plane of incidence counts as in it
NEAR_PLANE = np.radians(2.5)
MOST_POINTS = 20_000  # of a scatter plot: beyond, every k-th sample is drawn, and the heading says so
_SIGNED = np.radians(np.linspace(-89.0, 89.0, 357))


def brdf_slices(
    samples: BRDFSamples,
    brdf: BRDF | None = None,
    *,
    band: Sequence[BRDF] = (),
    scatter: Array | None = None,
    truth: BRDF | None = None,
    table: BRDF | None = None,
    count: int = 6,
) -> Figure:
    """f_r against theta_r in and near the plane of incidence, one panel for each of several theta_i.

    Parameters
    ----------
    samples : BRDFSamples
    brdf : BRDF, optional
        The fitted model.
    band : sequence of BRDF, optional
        Draws of the posterior; the central 68 % at each angle are shaded, and lighter the band that holds 95 % of the curves
        as a whole.
    scatter : ndarray, shape (len(band), 2), optional
        Inferred noise of a reading under each draw, relative [1] and absolute [1/sr]: the band of 95 % of readings is drawn.
    truth, table : BRDF, optional
        The BRDF that the samples came from, where it is known, and the tabulated one.
    count : int, optional
        Most panels.

    Returns
    -------
    Figure
        theta_r is positive on the mirror side. Samples nearer than 1 degree to the plane of incidence are filled, up to 2.5
        degrees open.
    """
    signed, offset = in_plane_angle(samples)
    near = offset <= NEAR_PLANE
    centres = incidence_angles(samples.theta_i[near], count)
    nothing_near = centres.size == 0
    if nothing_near:
        centres = np.radians([15.0, 45.0, 75.0][:count])
    with style.look():
        rows, columns = style.grid_shape(len(centres), 3)
        figure = style.new_figure(170.0, 20.0 + 56.0 * rows)
        panels = figure.subplots(rows, columns, sharex=True, squeeze=False)
        for axes, centre in zip(panels.flat, centres, strict=False):
            chosen = np.flatnonzero(near & (np.abs(samples.theta_i - centre) <= np.radians(1.5)))
            chosen = chosen[:: 1 + len(chosen) // 500]
            _slice(axes, samples.select(chosen), signed[chosen], offset[chosen], centre, brdf, band, scatter, truth, table)
        for axes in panels.flat[len(centres) :]:
            axes.set_axis_off()
        for axes in panels[:, 0]:
            axes.set_ylabel("$f_r$ [1/sr]")
        for column in range(columns):
            bottom = max(row for row in range(rows) if row * columns + column < len(centres))
            panels[bottom, column].set_xlabel(r"$\theta_r$ [deg], mirror side positive")
            panels[bottom, column].tick_params(labelbottom=True)
        named = {text: line for axes in panels.flat for line, text in zip(*axes.get_legend_handles_labels(), strict=True)}
        if named:
            figure.legend(
                named.values(), named.keys(), loc="outside lower center", ncols=len(named) if len(named) < 6 else 3
            )
        if nothing_near:
            panels[0, 0].text(
                0.5, 0.95, "no samples near\nthe plane of incidence", transform=panels[0, 0].transAxes,
                ha="center", va="top", color=style.GREY,
            )  # fmt: skip
    return figure


def in_plane_angle(samples: BRDFSamples) -> tuple[Array, Array]:
    """Reflected directions seen from the plane of incidence.

    Returns
    -------
    signed : ndarray, shape (n,)
        Polar angle of the direction's projection on that plane [rad], positive on the mirror side.
    offset : ndarray, shape (n,)
        Angle between the direction and the plane [rad]; 0 at normal incidence, where every plane is one of incidence,
        if the sample has no side of its own.
    """
    delta = samples.phi_r - samples.phi_i
    s, c = np.sin(samples.theta_r), np.cos(samples.theta_r)
    across = np.arcsin(np.clip(np.abs(s * np.sin(delta)), 0.0, 1.0))
    signed = np.arctan2(-s * np.cos(delta), c)
    normal = samples.theta_i < np.radians(0.01)
    side = np.where(np.cos(delta) > 0.0, -1.0, 1.0)
    return np.where(normal, side * samples.theta_r, signed), np.where(normal, 0.0, across)


def incidence_angles(theta_i: Array, count: int) -> Array:
    """The angles of incidence worth a panel: those with most samples, spread over the range.

    Parameters
    ----------
    theta_i : ndarray, shape (n,)
        [rad].
    count : int
        Most angles returned.

    Returns
    -------
    ndarray, shape (k,), k <= count
        Increasing [rad], at least 3 degrees apart, each with 3 samples or more within 1.5 degrees.
    """
    half = np.radians(1.5)
    ordered = np.sort(theta_i)
    weight = np.searchsorted(ordered, ordered + half, "right") - np.searchsorted(ordered, ordered - half, "left")
    free = np.ones(len(ordered), dtype=bool)
    found: list[tuple[float, int]] = []
    while free.any() and len(found) < 60:
        best = int(np.argmax(np.where(free, weight, -1)))
        if weight[best] < 3:
            break
        # the densest place has room on both sides: take the mean of what lies there
        inside = np.abs(ordered - ordered[best]) <= half
        found.append((float(np.mean(ordered[inside])), int(weight[best])))
        free &= np.abs(ordered - found[-1][0]) > 2.0 * half
    if not found:
        return np.zeros(0)
    most = max(w for _, w in found)
    angles = np.array(sorted(a for a, w in found if w >= 0.3 * most))
    pick = np.unique(np.round(np.linspace(0, len(angles) - 1, min(count, len(angles)))).astype(int))
    return np.asarray(angles[pick])


def residual_plot(samples: BRDFSamples, left: Residuals) -> Figure:
    """Pulls against theta_h and in the order of the samples, and their histogram beside a unit normal.

    Parameters
    ----------
    samples : BRDFSamples
    left : Residuals
        Of these samples. Where no uncertainty is known, relative residuals [%] stand in for the pulls.

    Returns
    -------
    Figure
        The first panel shows a model that fails in the lobe or away from it, the second a drift.
    """
    known = np.isfinite(left.pull)
    pulls = bool(known.any())
    value = left.pull if pulls else 100.0 * left.relative
    known = np.isfinite(value)
    value = value[known]
    name = "pull $(f_r - \\hat f)/u$" if pulls else "$f_r/\\hat f - 1$ [%]"
    theta_h = half_difference(samples.omega_i(), samples.omega_r())[0][known]
    order = np.flatnonzero(known) + 1
    reach = max(4.0, 1.05 * float(np.max(np.abs(value)))) if value.size else 4.0
    if value.size and reach > 12.0 * np.quantile(np.abs(value), 0.9):  # one wild point must not flatten the rest
        reach = 4.0 * float(np.quantile(np.abs(value), 0.98))
    out = np.abs(value) > reach
    drawn = np.clip(value, -reach, reach)
    step = 1 + len(value) // MOST_POINTS
    shown = np.arange(len(value)) % step == 0
    size = 3.0 if len(value) <= 1000 else 1.2
    with style.look():
        figure = style.new_figure(170.0, 62.0)
        panels = figure.subplots(1, 3, sharey=True, width_ratios=(1.0, 1.0, 0.55))
        for axes, x, label in (
            (panels[0], np.degrees(theta_h), r"$\theta_h$ [deg]"),
            (panels[1], order.astype(float), "sample"),
        ):
            if pulls:
                axes.axhspan(-2.0, 2.0, color=style.PALE, lw=0, zorder=0)
            axes.axhline(0.0, color=style.GREY, lw=0.6)
            axes.plot(x[~out & shown], drawn[~out & shown], ".", ms=size, color=style.BLUE, rasterized=True)
            if np.any(out & shown):  # an empty line that is not clipped has no extent, which the layout cannot bear
                axes.plot(x[out & shown], drawn[out & shown], "x", ms=4, color=style.VERMILION, clip_on=False)
            axes.set_xlabel(label)
        panels[0].set_ylabel(name)
        panels[0].set_ylim(-reach, reach)
        bins = np.linspace(-reach, reach, 41 if len(value) > 200 else 25)
        panels[2].hist(drawn, bins=bins, orientation="horizontal", color=style.SKY, lw=0)
        if pulls and value.size:
            x = np.linspace(-reach, reach, 401)
            normal = np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi) * len(value) * (bins[1] - bins[0])
            panels[2].plot(normal, x, color=style.BLACK, lw=1.0)
            style.panel_title(panels[2], "line: unit normal")
        panels[2].set_xlabel("samples")
        if pulls:
            style.panel_title(panels[0], rf"$\chi^2/N$ = {left.chi2_per_n:.3g}, $N$ = {len(value)}")
        notes = [f"crosses: {out.sum()} beyond"] if out.any() else []
        notes += [f"one in {step} drawn"] if step > 1 else []
        style.panel_title(panels[1], ", ".join(notes))
    return figure


def coverage(samples: BRDFSamples) -> Figure:
    """Where the samples lie in half and difference angles.

    Parameters
    ----------
    samples : BRDFSamples

    Returns
    -------
    Figure
        theta_d against theta_h, coloured by phi_d folded into [0, 90] degrees, as reciprocity and mirror symmetry allow
        for an isotropic material. Left of the dashed line every phi_d is above the horizon.
    """
    total, step = len(samples), 1 + len(samples) // MOST_POINTS
    samples = samples.select(np.arange(0, total, step))
    theta_h, _, theta_d, phi_d = half_difference(samples.omega_i(), samples.omega_r())
    folded = np.degrees(np.arcsin(np.clip(np.abs(np.sin(phi_d)), 0.0, 1.0)))
    with style.look():
        figure = style.new_figure(110.0, 88.0)
        axes = figure.subplots()
        size = 9.0 if len(samples) <= 1000 else 2.0
        drawn = axes.scatter(
            np.degrees(theta_h), np.degrees(theta_d), c=folded, s=size, cmap="viridis", vmin=0.0, vmax=90.0, lw=0,
            rasterized=True,
        )  # fmt: skip
        axes.plot([0.0, 90.0], [90.0, 0.0], ls="--", lw=0.8, color=style.GREY)
        axes.set(xlim=(0, 90), ylim=(0, 90), xlabel=r"$\theta_h$ [deg]", ylabel=r"$\theta_d$ [deg]", aspect="equal")
        ticks = [0, 15, 30, 45, 60, 75, 90]
        axes.set(xticks=ticks, yticks=ticks)
        bar = figure.colorbar(drawn, ax=axes, ticks=ticks, shrink=0.85)
        bar.set_label(r"$\phi_d$, folded [deg]")
        bar.outline.set(linewidth=0.4)
        style.panel_title(axes, f"{total} samples" + (f", one in {step} drawn" if step > 1 else ""))
    return figure


def readings_band(curves: Array, scatter: Array) -> Array:
    """Interval that holds 95 % of readings at each point, of the curve's uncertainty and the noise together.

    Parameters
    ----------
    curves : ndarray, shape (draws, n)
    scatter : ndarray, shape (draws, 2)
        Standard deviation of the noise, relative to the curve and absolute.

    Returns
    -------
    ndarray, shape (2, n)
    """
    from scipy.special import ndtri

    z = ndtri((np.arange(61) + 0.5) / 61)  # (61,), at the places that Hazen's quantiles take for them
    sd = np.hypot(scatter[:, :1] * curves, scatter[:, 1:])  # (draws, n)
    readings = curves[:, None] + z[:, None] * sd[:, None]
    return np.asarray(np.quantile(readings.reshape(-1, curves.shape[1]), [0.025, 0.975], axis=0, method="hazen"))


def _slice(
    axes: Axes, samples: BRDFSamples, signed: Array, offset: Array, theta_i: float, brdf: BRDF | None,
    band: Sequence[BRDF], scatter: Array | None, truth: BRDF | None, table: BRDF | None,
) -> None:  # fmt: skip
    x = np.degrees(_SIGNED)
    curves: list[Array] = []
    reach = float(np.max(np.abs(signed), initial=0.0)) + np.radians(6.0) if len(signed) else np.pi
    fitting = np.abs(_SIGNED) <= reach  # the axis is scaled to where there are samples; models soar at grazing angles

    def along(one: BRDF) -> Array:
        return one.f_r(theta_i, 0.0, np.abs(_SIGNED), np.where(_SIGNED >= 0.0, np.pi, 0.0))

    if band:
        drawn = np.array([along(one) for one in band])
        if scatter is not None:
            low, high = readings_band(drawn, scatter)
            label = "95 % of readings, by inferred noise"
            axes.fill_between(x, low, high, color=style.GREY, alpha=0.18, lw=0, label=label, zorder=0.5)
        low, high = band_of_curves(drawn)
        axes.fill_between(x, low, high, color=style.SKY, alpha=0.25, lw=0, label="95 % band of the whole curve", zorder=1)
        low, high = np.quantile(drawn, [0.16, 0.84], axis=0)
        axes.fill_between(x, low, high, color=style.SKY, alpha=0.55, lw=0, label="68 % band", zorder=1)
    for one, colour, dashes, label in (
        (table, style.GREEN, (0, (1, 1.2)), "table"),
        (brdf, style.BLUE, "-", "fit, median"),
        (truth, style.VERMILION, (0, (4, 2)), "truth"),
    ):
        if one is not None:
            curves.append(along(one))
            axes.plot(x, curves[-1], color=colour, ls=dashes, lw=1.2, label=label, zorder=2)
    inside = np.abs(signed) <= np.radians(89.0)
    for chosen, face, label in (
        (inside & (offset <= IN_PLANE), style.BLACK, "measured, $u$ ($k = 1$)"),
        (inside & (offset > IN_PLANE), "white", r"measured, 1$\degree$ to 2.5$\degree$ off the plane"),
    ):
        if chosen.any():
            u = np.where(np.isnan(samples.u_f_r[chosen]), 0.0, samples.u_f_r[chosen])
            if np.all(np.isnan(samples.u_f_r[chosen])):
                label = label.replace(", $u$ ($k = 1$)", "")
            axes.errorbar(
                np.degrees(signed[chosen]), samples.f_r[chosen], yerr=u, fmt="o", ms=2.6, mfc=face, mec=style.BLACK,
                mew=0.6, ecolor=style.BLACK, elinewidth=0.7, label=label, zorder=3,
            )  # fmt: skip
    everything = np.concatenate([*(curve[fitting] for curve in curves), samples.f_r])
    positive = everything[everything > 0.0]
    text = rf"$\theta_i$ = {round(float(np.degrees(theta_i)), 1):g}$\degree$"
    if positive.size and positive.max() > min(15.0 * np.median(positive), 20.0 * np.quantile(positive, 0.02)):
        axes.set_yscale("log", nonpositive="clip")
        floor = max(float(np.quantile(positive, 0.01)), 1e-5 * float(positive.max()))
        axes.set_ylim(floor / 1.8, 1.8 * float(positive.max()))
        hidden = int(np.sum(samples.f_r < floor / 1.8))
        if hidden:
            text += f", {hidden} below the axis"
    elif everything.size:
        top = float(everything.max())
        axes.set_ylim(min(0.0, 1.1 * float(everything.min())), 1.12 * top if top > 0.0 else 1.0)
    axes.axvline(np.degrees(theta_i), color=style.GREY, lw=0.5, ls=":", zorder=0)
    axes.set_xlim(-90, 90)
    axes.set_xticks([-90, -45, 0, 45, 90])
    style.panel_title(axes, text)
