"""Integrals with known values: one table of scenes, tagged by what makes them hard.

The values in tests/data/problems.json come from tests/independent.py by two methods (`tests.make_problems` wrote them).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import gonio

FILE = Path(__file__).parent / "data" / "problems.json"
Parts = list[dict[str, Any]]


@dataclass(frozen=True)
class Problem:
    """One (BRDF, source, gradient) with its scene radiance.

    Attributes
    ----------
    brdf_name, source_name : str
    brdf, source : list of dict
        Terms and parts as data, angles in radians.
    p, q : float
    value : float
        [W m^-2 sr^-1], without delta functions.
    uncertainty : float
        By how much the two methods differ, plus their rounding, 1e-12 of the value.
    tags : tuple of str
    """

    brdf_name: str
    source_name: str
    brdf: Parts
    source: Parts
    p: float
    q: float
    value: float
    uncertainty: float
    tags: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.brdf_name} / {self.source_name} / {', '.join(self.tags)}"


def load() -> list[Problem]:
    """The whole table."""
    table = json.loads(FILE.read_text(encoding="utf-8"))
    return [
        Problem(
            x["brdf"], x["source"], table["brdfs"][x["brdf"]], table["sources"][x["source"]], x["p"], x["q"], x["value"],
            (x["difference"] + 1e-12) * abs(x["value"]), tuple(x["tags"]),
        )
        for x in table["problems"]
    ]  # fmt: skip


def make_brdf(terms: Parts) -> gonio.BRDF:
    """The BRDF of the data."""
    found = [gonio.brdf.make(t["model"], **{k: v for k, v in t.items() if k != "model"}) for t in terms]
    return sum(found[1:], found[0])


def make_source(parts: Parts) -> gonio.Source:
    """The source of the data."""
    found = []
    for part in parts:
        given = {k: np.array(v) if isinstance(v, list) and k != "axis" else v for k, v in part.items() if k != "kind"}
        found.append(gonio.source.make(part["kind"], **given))
    return sum(found[1:], found[0])


def brightness(parts: Parts) -> float:
    """Scale of a source, to tell nothing from little: its largest radiances and irradiances, added up."""
    names = ("irradiance", "radiance", "zenith_radiance", "amplitude")
    return sum(float(np.max(part[name])) for part in parts for name in names if name in part)
