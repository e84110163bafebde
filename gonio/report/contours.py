"""Reflectance maps as contours of constant R in gradient space, as in Fig. 1 of the memo.

It draws a map that exists; it integrates nothing and fits nothing.

References
----------
.. [1] B. K. P. Horn, R. W. Sjoberg, "Calculating the Reflectance Map", MIT AI Memo 498, 1978.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gonio.errors import DatasetError
from gonio.report import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from gonio.maps import ReflectanceMap

Array = NDArray[np.float64]


def map_contours(
    reflectance_map: ReflectanceMap,
    *,
    title: str = "",
    unit: str = "W m$^{-2}$ sr$^{-1}$",
) -> Figure:
    """Contours of constant R(p, q), and the width of its 68 % band where it has one.

    Parameters
    ----------
    reflectance_map : ReflectanceMap
        On axes p, shape (n,), and q, shape (m,). Gradients that face a source get a ring, delta functions a cross. With
        exactly one source, the line where it grazes the surface, 1 + p_s p + q_s q = 0, is drawn as well.
    title : str, optional
        Put in front of the quantity over the first panel; plain text.
    unit : str, optional
        Of R, in matplotlib's mathematics.

    Returns
    -------
    Figure

    Raises
    ------
    DatasetError
        If the map has no finite value, or fewer than two points on an axis.
    """
    p, q, value = reflectance_map.p, reflectance_map.q, reflectance_map.value
    if len(p) < 2 or len(q) < 2 or not np.any(np.isfinite(value)):
        raise DatasetError(
            f"a map of {len(p)} x {len(q)} points with {np.isfinite(value).sum()} finite values has no contours; "
            "make it on a grid of at least 2 x 2"
        )
    width = None
    if reflectance_map.band is not None:
        low, high = reflectance_map.band
        floor = 1e-6 * np.nanmax(np.abs(value))
        with np.errstate(divide="ignore", invalid="ignore"):
            width = np.where(np.abs(value) > floor, 50.0 * (high - low) / np.abs(value), np.nan)
        if not np.any(np.isfinite(width)):
            width = None
    with style.look():
        figure = style.new_figure(*((170.0, 92.0) if width is not None else (105.0, 105.0)))
        panels = figure.subplots(1, 1 if width is None else 2, squeeze=False)[0]
        lead = f"{style.plain(title)}: " if title else ""
        _panel(panels[0], reflectance_map, value, f"{lead}$R(p, q)$ [{unit}]", "viridis")
        if width is not None:
            middle = _number(float(np.nanmedian(width)))
            heading = f"68 % band of $R$: half-width [%], median {middle}"
            _panel(panels[1], reflectance_map, width, heading, "YlOrBr", about=6, flat=0.05, share=2e-3)
            panels[1].set_ylabel("")
    return figure


def levels(value: Array, about: int = 10, flat: float = 1e-9, share: float = 1.2e-4) -> Array:
    """Round contour levels: linear steps, or 1-2-5 steps where the values span more than these would show.

    Parameters
    ----------
    value : ndarray
        Values on the map; those that are not finite are left out.
    about : int, optional
        How many levels to aim at.
    flat : float, optional
        A map whose values differ by less than this, relative to the largest, is constant.
    share : float, optional
        Least part of the map above the last line, below the first and between two: closer lines run into each other.

    Returns
    -------
    ndarray, shape (k,)
        Increasing, strictly inside the range of the values; empty for a constant map.
    """
    from matplotlib.ticker import MaxNLocator

    finite = value[np.isfinite(value)]
    low, high = float(finite.min()), float(finite.max())
    if not high - low > flat * max(abs(low), abs(high)):
        return np.zeros(0)
    positive = finite[finite > 0.0]
    least = share * finite.size
    if low >= 0.0 and high > 6.0 * float(np.median(positive)):
        start = max(float(np.quantile(positive, 0.08)), 1e-4 * high)
        decades = range(int(np.floor(np.log10(start))), int(np.ceil(np.log10(high))) + 1)
        steps = (1.0, 2.0, 5.0) if np.log10(high / start) > 1.5 else (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0)
        candidates = np.array([step * 10.0**decade for decade in decades for step in steps])
    else:
        candidates = np.asarray(MaxNLocator(about, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high))
    kept: list[float] = []
    for level in candidates[(candidates > low) & (candidates < high)]:
        since = kept[-1] if kept else -np.inf
        if np.sum(finite > level) >= least and np.sum((finite > since) & (finite <= level)) >= least:
            kept.append(float(level))
    return np.array(kept)


def _panel(
    axes: Axes,
    one: ReflectanceMap,
    value: Array,
    title: str,
    palette: str,
    *,
    about: int = 10,
    flat: float = 1e-9,
    share: float = 1.2e-4,
) -> None:
    import matplotlib
    from matplotlib.colors import BoundaryNorm, ListedColormap

    p, q = one.p, one.q
    shown = np.ma.masked_invalid(value)
    lines = levels(value, about, flat, share)
    dark = np.asarray((one.value <= 0.0) & np.isfinite(one.value))
    if lines.size:
        # tints light enough for black labels, one for each interval
        edges = np.concatenate(([min(float(shown.min()), lines[0]) - 1e-300], lines, [float(shown.max())]))
        ramp = matplotlib.colormaps[palette](np.linspace(0.1, 0.95, len(edges) - 1))
        tint = ListedColormap(0.5 * ramp + 0.5)
        axes.pcolormesh(p, q, shown, cmap=tint, norm=BoundaryNorm(edges, tint.N), shading="nearest", rasterized=True)
        drawn = axes.contour(p, q, shown, levels=lines, colors=style.BLACK, linewidths=0.8)
        # a label needs room: a two-hundredth of the map above its line and below
        above = np.array([np.mean(value[np.isfinite(value)] > line) for line in lines])
        roomy = lines[(above > 0.005) & (above < 0.995)]
        labels = axes.clabel(drawn, roomy, fmt=_number, fontsize=7, inline_spacing=3)
        if _number(lines[-1]) not in [label.get_text() for label in labels]:
            _summit(axes, p, q, value)
    else:
        low, high = float(np.nanmin(value)), float(np.nanmax(value))
        axes.set_facecolor(matplotlib.colormaps[palette](0.1, alpha=0.5))
        text = f"{low:.3g} to {high:.3g}" if high - low > 1e-6 * abs(high) else f"{high:.6g}"
        axes.text(0.5, 0.85, f"everywhere {text}", transform=axes.transAxes, ha="center", va="center")
    if dark.any() and not dark.all():
        axes.contourf(p, q, dark.astype(float), levels=[0.5, 1.5], colors=[style.PALE], zorder=1.5)
    if len(one.sources) == 1 and dark.any():
        _terminator(axes, p, q, *one.sources[0])
    for p_s, q_s in one.sources:
        if _inside(one, p_s, q_s):
            axes.plot(p_s, q_s, marker="o", ms=6.5, mfc="white", mec=style.VERMILION, mew=1.4, zorder=6)
            axes.plot(p_s, q_s, marker=".", ms=3, color=style.VERMILION, zorder=7)
    for p_1, q_1, weight in one.impulses:
        if _inside(one, p_1, q_1):
            axes.plot(p_1, q_1, marker="x", ms=6, mew=1.4, color=style.VERMILION, zorder=7)
            axes.annotate(
                rf"$\delta$: {_number(weight)}", (p_1, q_1), (5, -9), textcoords="offset points", fontsize=7,
                color=style.VERMILION, zorder=7,
            )  # fmt: skip
    axes.set(aspect="equal", xlim=(p[0], p[-1]), ylim=(q[0], q[-1]), xlabel="$p$", ylabel="$q$")
    for side in ("top", "right"):
        axes.spines[side].set_visible(True)
    style.panel_title(axes, title)


def _terminator(axes: Axes, p: Array, q: Array, p_s: float, q_s: float) -> None:
    # cos theta_i = 0: 1 + p_s p + q_s q = 0, a straight line at right angles to (p_s, q_s)
    square = p_s * p_s + q_s * q_s
    if square == 0.0:
        return
    reach = 2.0 * (np.hypot(p[-1] - p[0], q[-1] - q[0]) + 1.0 / np.sqrt(square))
    along = np.array([-q_s, p_s]) / np.sqrt(square) * reach
    foot = np.array([-p_s, -q_s]) / square
    ends: Any = np.stack((foot - along, foot + along))
    axes.plot(ends[:, 0], ends[:, 1], color=style.VERMILION, lw=1.1, ls=(0, (4, 2)), zorder=5)


def _summit(axes: Axes, p: Array, q: Array, value: Array) -> None:
    """Say the largest value: for a peak so narrow that its lines leave no room for labels."""
    row, column = np.unravel_index(int(np.nanargmax(value)), value.shape)
    side = 1 if column < 0.6 * len(p) else -1
    axes.annotate(
        f"max {_number(value[row, column])}",
        (p[column], q[row]),
        (side * 24, 22),
        textcoords="offset points",
        fontsize=7,
        ha="left" if side > 0 else "right",
        bbox={"fc": "white", "ec": "none", "alpha": 0.7, "pad": 1.2},
        arrowprops={"arrowstyle": "-", "lw": 0.6, "shrinkB": 0},
        zorder=8,
    )


def _inside(one: ReflectanceMap, p: float, q: float) -> bool:
    return bool(one.p[0] <= p <= one.p[-1] and one.q[0] <= q <= one.q[-1])


def _number(value: float) -> str:
    return f"{value:.3g}"
