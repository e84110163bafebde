"""A posterior in pictures: corner plot and traces of the chains.

It shows draws; whether they may be trusted is what the diagnostics beside them say.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gonio.errors import DatasetError
from gonio.report import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from gonio.posterior import Posterior

Array = NDArray[np.float64]

NUISANCE = ("shared.", "noise.")
# share of a two-dimensional normal distribution inside 1 and 2 standard deviations: 1 - exp(-k^2 / 2)
INSIDE = (1.0 - np.exp(-0.5), 1.0 - np.exp(-2.0))


def material_names(posterior: Posterior) -> list[str]:
    """The free parameters of the material, without the nuisance parameters of the measurement."""
    return [name for name in posterior.names if not name.startswith(NUISANCE)]


def corner(posterior: Posterior, truth: Mapping[str, float] | None = None, names: Sequence[str] | None = None) -> Figure:
    """Histograms of parameters, and contours of their densities in pairs.

    Parameters
    ----------
    posterior : Posterior
    truth : mapping of str to float, optional
        True values by qualified name; drawn as lines where known.
    names : sequence of str, optional
        Which parameters; those of the material by default.

    Returns
    -------
    Figure
        Contours hold 39 % and 86 % of the draws, which is one and two standard deviations of a two-dimensional normal
        distribution. The shaded part of a histogram is the central 68 %.

    Raises
    ------
    DatasetError
        If a name is not in the posterior, or there is none to draw.
    """
    chosen = list(names) if names is not None else material_names(posterior) or list(posterior.names)
    columns = _columns(posterior, chosen)
    known = truth or {}
    n = len(chosen)
    with style.look():
        side = float(np.clip(40.0 * n + 25.0, 75.0, 180.0))
        figure = style.new_figure(side, side)
        figure.set_layout_engine("constrained", w_pad=0.015, h_pad=0.015, wspace=0.0, hspace=0.0)
        panels = figure.subplots(n, n, squeeze=False)
        for row in range(n):
            for column in range(n):
                axes: Axes = panels[row, column]
                if column > row:
                    axes.set_axis_off()
                    continue
                if column == row:
                    _histogram(axes, columns[row], known.get(chosen[row]))
                    style.panel_title(axes, _estimate(chosen[row], columns[row]))
                else:
                    _density(axes, columns[column], columns[row])
                    _lines(axes, known.get(chosen[column]), known.get(chosen[row]))
                    axes.set_ylim(_range(columns[row]))
                axes.set_xlim(_range(columns[column]))
                _ticks(axes, row, column, n, chosen)
        figure.align_labels()
    return figure


def trace(
    posterior: Posterior,
    names: Sequence[str] | None = None,
    chains: int = 24,
    units: Mapping[str, str] | None = None,
) -> Figure:
    """Parameters along the chains, burn-in removed.

    Parameters
    ----------
    posterior : Posterior
    names : sequence of str, optional
        Which parameters; all by default.
    chains : int, optional
        Most chains drawn, spread evenly over those there are.
    units : mapping of str to str, optional
        Natural unit of a parameter by name, where it has one.

    Returns
    -------
    Figure
    """
    chosen = list(names) if names is not None else list(posterior.names)
    index = [posterior.names.index(name) for name in chosen if name in posterior.names]
    n_chain, n_draw = posterior.draws.shape[:2]
    drawn = np.unique(np.linspace(0, n_chain - 1, min(chains, n_chain)).astype(int))
    stride = max(1, n_draw // 800)
    step = np.arange(0, n_draw, stride)
    given = units or {}
    series = [(_with_unit(posterior.names[i], given), posterior.draws[..., i]) for i in index]
    series.append((r"$\ln P$", posterior.log_probability))
    with style.look():
        rows, columns = style.grid_shape(len(series), 2 if len(series) > 3 else 1)
        figure = style.new_figure(170.0, 14.0 + 27.0 * rows)
        panels = figure.subplots(rows, columns, sharex=True, squeeze=False)
        for axes, (label, values) in zip(panels.flat, series, strict=False):
            for j, chain in enumerate(drawn):
                colour = style.CYCLE[j % len(style.CYCLE)]
                axes.plot(step, values[chain, ::stride], color=colour, lw=0.35, alpha=0.7, rasterized=True)
            axes.set_ylabel(label)
            axes.set_xlim(0, max(n_draw - 1, 1))
            axes.locator_params(axis="y", nbins=4)
        for axes in panels.flat[len(series) :]:
            axes.set_axis_off()
        for column in range(columns):
            bottom = max(row for row in range(rows) if row * columns + column < len(series))
            panels[bottom, column].set_xlabel("draw")
            panels[bottom, column].tick_params(labelbottom=True)
        style.panel_title(panels[0, 0], f"{len(drawn)} of {n_chain} chains" if len(drawn) < n_chain else "all chains")
        figure.align_ylabels()
    return figure


def _with_unit(name: str, units: Mapping[str, str]) -> str:
    unit = units.get(name, "1")
    return style.symbol(name) if unit == "1" else f"{style.symbol(name)} [{style.plain(unit)}]"


def _columns(posterior: Posterior, names: Sequence[str]) -> list[Array]:
    unknown = [name for name in names if name not in posterior.names]
    if unknown or not names:
        missing = ", ".join(map(repr, unknown)) or "to draw"
        raise DatasetError(f"the posterior has no parameter {missing}; it has: {', '.join(posterior.names)}")
    flat = posterior.draws.reshape(-1, posterior.draws.shape[-1])
    return [flat[:, posterior.names.index(name)] for name in names]


def _range(x: Array) -> tuple[float, float]:
    low, high = np.quantile(x, [0.002, 0.998])
    pad = 0.08 * (high - low) or max(1e-6 * abs(low), 1e-12)
    return float(low - pad), float(high + pad)


def _estimate(name: str, x: Array) -> str:
    low, middle, high = np.quantile(x, [0.16, 0.5, 0.84])
    narrow = min(high - middle, middle - low)
    digits = int(np.clip(1 - np.floor(np.log10(narrow)), 0, 12)) if narrow > 0.0 else 6
    return f"{style.symbol(name)}\n= ${middle:.{digits}f}^{{+{high - middle:.{digits}f}}}_{{-{middle - low:.{digits}f}}}$"


def _histogram(axes: Axes, x: Array, truth: float | None) -> None:
    edges = np.linspace(*_range(x), 41)
    density, _ = np.histogram(x, edges)
    low, high = np.quantile(x, [0.16, 0.84])
    axes.stairs(density, edges, fill=True, color=style.PALE, lw=0)
    inside = np.clip(edges, low, high)
    axes.bar(
        inside[:-1], density, width=np.diff(inside), align="edge", color=style.SKY, lw=0,
    )  # fmt: skip
    axes.stairs(density, edges, color=style.BLUE, lw=0.9)
    axes.set_ylim(0, 1.08 * max(int(density.max()), 1))
    _lines(axes, truth, None)


def _density(axes: Axes, x: Array, y: Array) -> None:
    from scipy.ndimage import gaussian_filter

    bins = 32 if len(x) < 20_000 else 50
    grid, x_edges, y_edges = np.histogram2d(x, y, bins=bins, range=(_range(x), _range(y)))
    smooth = gaussian_filter(grid, 1.3)
    ordered = np.sort(smooth.ravel())[::-1]
    share = np.cumsum(ordered) / max(float(ordered.sum()), 1e-300)
    # the density above which a given share of all draws lies
    found = sorted({float(ordered[min(int(np.searchsorted(share, inside)), ordered.size - 1)]) for inside in INSIDE})
    x_mid, y_mid = 0.5 * (x_edges[1:] + x_edges[:-1]), 0.5 * (y_edges[1:] + y_edges[:-1])
    if len(found) == 2 and found[0] > 0.0:
        top = float(smooth.max())
        axes.contourf(x_mid, y_mid, smooth.T, levels=[*found, 1.001 * top], colors=["#d5ebf8", style.SKY])
        axes.contour(x_mid, y_mid, smooth.T, levels=found, colors=style.BLUE, linewidths=0.8)
    else:
        axes.plot(x[:: max(1, len(x) // 1000)], y[:: max(1, len(y) // 1000)], ",", color=style.BLUE)


def _lines(axes: Axes, x: float | None, y: float | None) -> None:
    for value, draw in ((x, axes.axvline), (y, axes.axhline)):
        if value is not None and np.isfinite(value):
            draw(value, color=style.VERMILION, lw=1.0, ls=(0, (4, 2)))


def _ticks(axes: Axes, row: int, column: int, n: int, names: Sequence[str]) -> None:
    from matplotlib.ticker import MaxNLocator

    axes.xaxis.set_major_locator(MaxNLocator(3, prune="both"))
    for side in ("top", "right"):
        axes.spines[side].set_visible(row != column)
    if row == n - 1:
        axes.set_xlabel(style.symbol(names[column]))
        axes.tick_params(axis="x", labelrotation=45)
    else:
        axes.tick_params(labelbottom=False)
    if row == column:
        axes.set_yticks([])
        axes.spines["left"].set_visible(False)
        return
    axes.yaxis.set_major_locator(MaxNLocator(3, prune="both"))
    if column == 0:
        axes.set_ylabel(style.symbol(names[row]))
    else:
        axes.tick_params(labelleft=False)
