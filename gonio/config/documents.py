"""plan.toml and fit.toml: what to measure, what to fit.

It knows the shape of these files. Whether a pose can be reached or a model exists is checked by those who know:
`gonio.scan`, `fitting`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from gonio.config.reader import Document, Table, read_document

_DIRECTIONS = ("theta_i_deg", "theta_r_deg", "phi_deg")
_HALF = ("theta_h_deg", "theta_d_deg", "phi_d_deg")
MAX_POSES = 2_000_000


# numbers that a prior takes
_NUMBERS = {"uniform": 2, "log_uniform": 2, "normal": 2, "log_normal": 2, "half_normal": 1}


@dataclass(frozen=True)
class GridConfig:
    """A grid of geometries, the product of three lists of angles [rad].

    Attributes
    ----------
    kind : str
        ``"directions"``: theta_i, theta_r, phi_r - phi_i. ``"half"``: theta_h, theta_d, phi_d of Rusinkiewicz.
    first, second, third : tuple of float
    """

    kind: Literal["directions", "half"]
    first: tuple[float, ...]
    second: tuple[float, ...]
    third: tuple[float, ...]


@dataclass(frozen=True)
class PlanConfig:
    """What to measure.

    Attributes
    ----------
    sample : mapping of str to str
        Name and whatever else the operator writes about it.
    grids : tuple of GridConfig
    poses : tuple of (theta_i, theta_r, phi)
        Further geometries, one by one [rad].
    theta_max : float
        Steepest angle from the normal that is measured [rad]; poses beyond it are left out with that reason.
    order : str
        ``"short"``: the next pose is the one nearest in time; ``"file"``: as written.
    bracket_s : tuple of float or None
        Exposures [s] instead of the rig's.
    darks : int
        Dark frames for each exposure.
    white_every : int
        Poses between two white blocks; 0 for one at the start and one at the end.
    white_repeats : int or None
        Brackets of a white block, instead of the rig's.
    """

    sample: Mapping[str, str]
    grids: tuple[GridConfig, ...]
    poses: tuple[tuple[float, float, float], ...]
    theta_max: float
    order: Literal["short", "file"]
    bracket_s: tuple[float, ...] | None
    darks: int
    white_every: int
    white_repeats: int | None

    @property
    def name(self) -> str:
        """Of the sample."""
        return self.sample["name"]


@dataclass(frozen=True)
class FitConfig:
    """A fit: model, parameters freed, fixed and with other priors, seed, largest number of steps, freedom of Student's t."""

    model: str
    free: tuple[str, ...]
    fix: Mapping[str, float]
    priors: Mapping[str, tuple[Any, ...]]
    seed: int
    max_steps: int | None
    student: float | None


def load_plan(path: str | Path) -> PlanConfig:
    """Read a plan file; see `parse_plan`."""
    return parse_plan(read_document(path), str(path))


def load_fit(path: str | Path) -> FitConfig:
    """Read a fit file; see `parse_fit`."""
    return parse_fit(read_document(path), str(path))


def parse_plan(text: str, name: str = "plan.toml") -> PlanConfig:
    """The plan that a text describes.

    Raises
    ------
    ConfigurationError
        With every problem of the document at once.
    """
    document = Document(text, name)
    root = document.root
    sample = root.table("sample")
    texts = {"name": sample.text("name")} | {key: sample.text(key) for key in sample.names() if key != "name"}
    grids = tuple(_grid(table) for table in root.tables("grid"))
    poses = _poses(root.table("poses", required=False)) if "poses" in root else ()
    scan = root.table("scan", required=False)
    exposure = root.table("exposure", required=False)
    white = root.table("white", required=False)
    config = PlanConfig(
        sample=texts,
        grids=grids,
        poses=poses,
        theta_max=scan.angle("theta_max_deg", 80.0, lower=1.0, upper=89.9),
        order=scan.text("order", "short", choices=("short", "file")),  # type: ignore[arg-type]
        bracket_s=exposure.numbers("bracket_s", above=0.0, upper=3600.0, unit="s") if "bracket_s" in exposure else None,
        darks=exposure.integer("darks", 16, lower=2, upper=10_000, unit="frames"),
        white_every=white.integer("every", 0, lower=0, upper=MAX_POSES, unit="poses"),
        white_repeats=white.integer("repeats", lower=1, upper=1000) if "repeats" in white else None,
    )
    for table in (sample, scan, exposure, white, root):
        table.finish()
    bracket = config.bracket_s or ()
    if any(b <= a for a, b in itertools.pairwise(bracket)):
        exposure.report("bracket_s", f"is {list(bracket)}; write each exposure once, the shortest first")
    total = sum(len(g.first) * len(g.second) * len(g.third) for g in grids) + len(poses)
    if total == 0 and not document.problems:
        document.report("", "grid", "is missing and [poses] too; write at least one [[grid]] or [poses] angles_deg")
    if total > MAX_POSES:
        document.report("", "grid", f"gives {total} poses; gonio plans at most {MAX_POSES}")
    document.finish()
    return config


def parse_fit(text: str, name: str = "fit.toml") -> FitConfig:
    """The fit that a text describes.

    Raises
    ------
    ConfigurationError
        With every problem of the document at once.
    """
    document = Document(text, name)
    root = document.root
    fix = root.table("fix", required=False)
    priors = root.table("priors", required=False)
    config = FitConfig(
        model=root.text("model"),
        free=root.texts("free", ()),
        fix=fix.free_numbers(),
        priors=_priors(priors),
        seed=root.integer("seed", 1, lower=0),
        max_steps=root.integer("max_steps", lower=100, upper=10**8, unit="steps") if "max_steps" in root else None,
        student=root.number("student", lower=1.0, upper=1e6) if "student" in root else None,
    )
    root.finish()
    document.finish()
    return config


def _grid(table: Table) -> GridConfig:
    half = any(key in table for key in _HALF)
    keys = _HALF if half else _DIRECTIONS
    upper = (90.0, 90.0, 360.0)
    values = [table.angles(key, lower=-360.0 if k == 2 else 0.0, upper=upper[k]) for k, key in enumerate(keys)]
    table.finish()
    return GridConfig("half" if half else "directions", *values)


def _poses(table: Table) -> tuple[tuple[float, float, float], ...]:
    rows = table.free().get("angles_deg")
    poses = []
    if not isinstance(rows, list) or not rows:
        table.report("angles_deg", "must be a list of [theta_i, theta_r, phi] in degrees")
        return ()
    for key in table.names():
        if key != "angles_deg":
            table.report(key, "is not known here; known is: angles_deg")
    for number, row in enumerate(rows, 1):
        numbers = row if isinstance(row, list) else []
        good = len(numbers) == 3 and all(isinstance(v, int | float) and not isinstance(v, bool) for v in numbers)
        if not good or not (0 <= numbers[0] <= 90 and 0 <= numbers[1] <= 90 and -360 <= numbers[2] <= 360):
            table.report(
                "angles_deg", f"row {number} is {row!r}; write [theta_i, theta_r, phi], polar angles 0 to 90 degrees"
            )
            continue
        poses.append((math.radians(numbers[0]), math.radians(numbers[1]), math.radians(numbers[2])))
    return tuple(poses)


def _priors(table: Table, prefix: str = "") -> dict[str, tuple[Any, ...]]:
    found: dict[str, tuple[Any, ...]] = {}
    for key, value in table.free().items():
        if isinstance(value, dict):
            found.update(_priors(table.table(key), f"{prefix}{key}."))
        elif (
            isinstance(value, list) and value and _NUMBERS.get(str(value[0])) == len(value) - 1
            and all(isinstance(v, int | float) and not isinstance(v, bool) for v in value[1:])
        ):  # fmt: skip
            found[prefix + key] = (value[0], *map(float, value[1:]))
        else:
            table.report(
                key,
                f'is {value!r}; write ["uniform", lower, upper], ["log_uniform", lower, upper], ["normal", mean, sd], '
                '["log_normal", mean of ln, sd of ln] or ["half_normal", sd]',
            )
    return found
