"""A BRDF in the plane of incidence: as characters in a terminal, and as a picture.

It draws a model as it is, at given parameters; measured samples are drawn by `gonio.report.slices`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gonio.brdf.base import BRDF
from gonio.geometry import unit_vector
from gonio.report import style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

THETA_I = tuple(math.radians(t) for t in (10.0, 45.0, 75.0))
MARKS = "abc"  # the lights are their capitals
MOST_DECADES = 6
_ROWS = 19  # of the half disk; a character is twice as high as wide


def in_plane(brdf: BRDF, theta_i: float, signed: Array) -> Array:
    """f_r [1/sr] towards polar angles in the plane of incidence [rad], positive on the mirror side, shape of `signed`."""
    return brdf.evaluate(unit_vector(theta_i, 0.0), unit_vector(np.abs(signed), np.where(signed > 0, np.pi, 0.0)))


def decades(values: Array) -> tuple[int, int]:
    """Powers of ten that hold the positive values, at most `MOST_DECADES` below the largest."""
    positive = values[np.isfinite(values) & (values > 0)]
    if not positive.size:
        return -1, 0
    top = math.ceil(math.log10(float(positive.max())) - 1e-9)
    low = math.floor(math.log10(float(positive.min())) + 1e-9)
    return max(min(low, top - 1), top - MOST_DECADES), top


def text(brdf: BRDF, thetas: Sequence[float] = THETA_I) -> str:
    """The lobe as a polar plot in characters, its radius the logarithm of f_r.

    Parameters
    ----------
    brdf : BRDF
    thetas : sequence of float
        Up to three angles of incidence [rad].

    Returns
    -------
    str
        Lines of at most 79 characters: the surface is below, the light comes from the left.
    """
    signed = np.radians(np.linspace(-89.75, 89.75, 719))
    values = np.array([in_plane(brdf, t, signed) for t in thetas])
    low, top = decades(values)
    width = 4 * _ROWS + 1
    canvas = [[" "] * width for _ in range(_ROWS + 1)]

    def put(theta: Array, radius: Array, mark: str) -> None:
        column = np.rint(2 * _ROWS * (1.0 + radius * np.sin(theta))).astype(int)
        row = np.rint(_ROWS * (1.0 - radius * np.cos(theta))).astype(int)
        for i, j in zip(row, column, strict=True):
            canvas[i][j] = mark

    for decade in range(low + 1, top + 1):
        ring = (decade - low) / (top - low)
        angles = np.radians(np.linspace(-90.0, 90.0, 2 * math.ceil(15 * ring) + 1))
        put(angles, np.full(len(angles), ring), ".")
    for row, mark in zip(values, MARKS, strict=False):
        kept = row > 10.0**low
        put(signed[kept], (np.log10(row[kept]) - low) / (top - low), mark)
    for theta_i, mark in zip(thetas, MARKS, strict=False):
        put(np.array([-theta_i]), np.array([1.0]), mark.upper())
    axis = ["-"] * width
    for decade in range(low, top + 1):
        for side in (-1, 1):
            axis[round(2 * _ROWS * (1 + side * (decade - low) / (top - low)))] = "+"
    middle = 2 * _ROWS
    labels = [" "] * width
    for decade in range(low, top + 1):
        at = round(middle + 2 * _ROWS * (decade - low) / (top - low))
        label = f"1e{decade}"
        if at + len(label) <= width and all(c == " " for c in labels[max(at - 1, 0) : at + len(label)]):
            labels[at : at + len(label)] = label
    drawn = ["".join(line).rstrip() for line in [*canvas[:-1], axis, labels]]
    lights = ", ".join(f"{m} {math.degrees(t):g}" for t, m in zip(thetas, MARKS, strict=False))
    return "\n".join([*drawn, f"theta_i [deg]: {lights}; the light at the capital. Radius: log f_r [1/sr]"])


def figure(brdf: BRDF, title: str, thetas: Sequence[float] = THETA_I) -> Figure:
    """f_r in the plane of incidence on a logarithmic scale: over the angle, and in polar coordinates.

    Parameters
    ----------
    brdf : BRDF
    title : str
    thetas : sequence of float
        Angles of incidence [rad].
    """
    with style.look():
        made = style.new_figure(170.0, 78.0)
        flat = made.add_subplot(1, 2, 1)
        round_ = made.add_subplot(1, 2, 2, projection="polar")
        every = []
        for theta_i, colour in zip(thetas, style.CYCLE, strict=False):
            near = theta_i + np.concatenate((-np.geomspace(0.3, 1e-5, 120), [0.0], np.geomspace(1e-5, 0.3, 120)))
            every_angle = np.concatenate((np.radians(np.linspace(-89.9, 89.9, 720)), near, -near))
            signed = np.unique(np.clip(every_angle, -1.569, 1.569))
            value = in_plane(brdf, theta_i, signed)
            every.append(value)
            shown = np.where(value > 0, value, np.nan)
            flat.semilogy(np.degrees(signed), shown, color=colour, label=rf"$\theta_i$ = {math.degrees(theta_i):g}°")
            flat.axvline(math.degrees(theta_i), color=colour, lw=0.6, ls=":")
            round_.plot(signed, np.log10(shown), color=colour)
        low, top = decades(np.concatenate(every))
        flat.set(xlim=(-90, 90), ylim=(10.0**low, 10.0**top), xticks=range(-90, 91, 30), ylabel="$f_r$ [1/sr]")
        flat.set_xlabel(r"$\theta_r$ [deg], mirror side positive")
        flat.legend(loc="best")
        style.panel_title(flat, style.plain(title))
        round_.set(theta_zero_location="N", theta_direction=-1, thetamin=-90, thetamax=90, rlim=(low, top))
        round_.set_yticks(range(low, top + 1), [f"$10^{{{d}}}$" for d in range(low, top + 1)])
        round_.set_xticks(np.radians(range(-90, 91, 30)))
        round_.tick_params(labelsize=7)
        round_.grid(lw=0.4)
    return made
