"""How gonio's pictures look, and how a figure becomes PNG bytes.

One look for all pictures: sizes of a printed column, colours that colour-blind readers can tell apart, no global state.
Figures are plain `matplotlib.figure.Figure` objects on the Agg canvas; pyplot, windows and the reader's own matplotlibrc
stay out of it. What comes from a file (names, materials) passes `plain` before it becomes text in a picture.

References
----------
.. [1] M. Okabe, K. Ito, "Color Universal Design", 2008, https://jfly.uni-koeln.de/color/ (the palette).
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

BLACK, GREY, PALE = "#000000", "#767676", "#e4e4e4"
BLUE, VERMILION, GREEN, ORANGE, SKY, PURPLE = "#0072B2", "#D55E00", "#009E73", "#E69F00", "#56B4E9", "#CC79A7"
CYCLE = (BLUE, ORANGE, GREEN, VERMILION, SKY, PURPLE)

DPI = 160  # of pictures in the report; 170 mm are then 1070 pixels

_LOOK: dict[str, Any] = {
    "font.family": "DejaVu Sans",  # ships with matplotlib: the same picture on every machine
    "font.size": 8.0,
    "axes.titlesize": 8.5,
    "axes.titlelocation": "left",
    "axes.labelsize": 8.5,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "xtick.direction": "out",
    "ytick.direction": "out",
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.minor.width": 0.4,
    "ytick.minor.width": 0.4,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "lines.linewidth": 1.2,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
}


@contextmanager
def look() -> Iterator[None]:
    """Build or render a figure in gonio's style; matplotlib's settings are as before afterwards."""
    import matplotlib.style

    with matplotlib.style.context(["default", _LOOK]):
        yield


def new_figure(width_mm: float, height_mm: float) -> Figure:
    """An empty figure of that printed size, its layout kept free of overlaps.

    Call it, and draw on it, inside `look`.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_mm / 25.4, height_mm / 25.4), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def png(figure: Figure, dpi: int = DPI) -> bytes:
    """The figure as PNG; the same figure gives the same bytes."""
    stream = io.BytesIO()
    with look():
        figure.savefig(stream, format="png", dpi=dpi, metadata={"Software": None})
    return stream.getvalue()


def plain(text: object) -> str:
    """Text from outside, safe as a label: no mathematics, one line of bounded length, printable."""
    line = "".join(c if c.isprintable() else " " for c in str(text))
    return (line if len(line) <= 80 else line[:79] + "…").replace("$", r"\$")


def panel_title(axes: Axes, text: str) -> None:
    """A panel's heading, left over the axes."""
    axes.set_title(text, loc="left", pad=5.0)


_SYMBOLS = {
    "alpha": r"$\alpha$", "f_0": r"$F_0$", "k_s": r"$k_s$", "albedo": "albedo", "rho": r"$\rho$",
}  # fmt: skip


def symbol(name: str) -> str:
    """Short label of a qualified parameter name: ``ggx.alpha`` gives a Greek letter with its model in front."""
    term, _, parameter = name.rpartition(".")
    shown = _SYMBOLS.get(parameter, plain(parameter))
    return f"{plain(term)} {shown}" if term else shown


def grid_shape(n: int, columns: int) -> tuple[int, int]:
    """Rows and columns of `n` small multiples, at most `columns` wide and as even as possible."""
    rows = -(-n // columns)
    return rows, -(-n // rows)
