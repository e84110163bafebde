"""BRDF values of other people's programs beside gonio's: what a comparison is, and all of them.

A program is asked at the directions at which gonio is, in its own parameters. What it computes otherwise than gonio does,
and says so, is either part of the limit or is taken out with the program's own formula; each comparison tells which.
"""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version

import numpy as np
from numpy.typing import NDArray

from gonio.brdf import BRDF

Array = NDArray[np.float64]
FAINT = 1e-6  # of the largest value: fainter ones count by their absolute difference


@dataclass(frozen=True)
class Comparison:
    """A model of gonio's and the same of another program's.

    Attributes
    ----------
    program : str
        Its package.
    theirs : str
        What the program calls it.
    brdf : BRDF
    values : callable
        Nothing -> gonio's values, the program's values, shape (n,) each.
    limit : float
        Largest relative difference expected.
    limited_by : str
        What sets the limit.
    """

    program: str
    theirs: str
    brdf: BRDF
    values: Callable[[], tuple[Array, Array]]
    limit: float
    limited_by: str

    def __str__(self) -> str:
        return f"{self.brdf!r} by {self.program}, {self.theirs}"

    @property
    def missing(self) -> bool:
        return importlib.util.find_spec(self.program) is None

    @functools.cached_property
    def difference(self) -> float:
        """Largest relative difference; infinite if the program has no value somewhere."""
        ours, theirs = self.values()
        apart = np.abs(ours - theirs) / np.maximum(ours, FAINT * np.max(ours))
        return float(np.max(np.where(np.isfinite(apart), apart, np.inf)))

    @property
    def release(self) -> str:
        return f"{self.program} {version(self.program)}"


def directions(count: int = 300) -> tuple[Array, Array, Array]:
    """theta_i, theta_r, dphi [rad]: drawn to 88.9 degrees, and the normal, mirror and retro directions."""
    rng = np.random.default_rng(20)
    theta = np.arccos(rng.uniform(0.02, 1.0, (2, count)))
    dphi = rng.uniform(0.0, 2.0 * np.pi, count)
    at_normal, mirror, retro = [(0.0, 0.0, 0.0), (0.0, 0.8, 0.5), (0.8, 0.0, 1.0)], (0.7, 0.7, np.pi), (0.7, 0.7, 0.0)
    special = np.array([*at_normal, mirror, retro, (1.5, 1.5, np.pi), (1.5, 0.1, 2.0)])
    theta_i, theta_r, phi = np.concatenate((np.stack((*theta, dphi), axis=1), special)).T
    return theta_i, theta_r, phi


def everything() -> list[Comparison]:
    """All comparisons with all programs; nothing is computed, and no program need be there."""
    from tests.conformance import mitsuba_bsdf, scatmech

    return [*scatmech.comparisons(), *mitsuba_bsdf.comparisons()]
