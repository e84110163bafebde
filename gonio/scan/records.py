"""What the journal of a run holds, as frozen dataclasses that are JSON-compatible.

Times are rig seconds since the run's start; a resumed run's clock goes on where the last committed record ended. The
calendar's time is kept beside them for people, and nothing is computed from it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal, TypeVar

from gonio.errors import DatasetError

T = TypeVar("T")


@dataclass(frozen=True)
class PoseRecord:
    """One completed pose.

    Attributes
    ----------
    index : int
        Its number in the plan.
    theta_i, theta_r, phi : float
        Geometry asked for [rad]; phi = phi_r - phi_i.
    commanded, measured : mapping of axis name to float
        Joint angles [rad]; `measured` is the mean of the readings before and after the exposures, from the encoders.
    counts : mapping of axis name to int
        Present Position after the exposures.
    time_s : float
        Middle of the exposures [s].
    session : int
        Which start of the scan took it.
    lamp_on : bool
    attempts : int
        1, or more if an axis moved during the exposures and they were taken again.
    flags : tuple of str
        ``"saturated"``: no exposure of the bracket is free of saturated pixels in the region of interest.
    health : mapping
        For each axis temperature [degrees Celsius], voltage [V], current [A], goal [counts], as far as it tells.
    wall_time : str
        ISO 8601, UTC.
    """

    index: int
    theta_i: float
    theta_r: float
    phi: float
    commanded: Mapping[str, float]
    measured: Mapping[str, float]
    counts: Mapping[str, int]
    time_s: float
    session: int
    lamp_on: bool = True
    attempts: int = 1
    flags: tuple[str, ...] = ()
    health: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    wall_time: str = ""


@dataclass(frozen=True)
class BlockRecord:
    """One completed block of dark frames (one exposure each) or of white reference brackets.

    Attributes
    ----------
    kind : str
        ``"dark"`` or ``"white"``.
    number : int
        Dark: index of the exposure. White: 0, 1, ... in the order taken.
    measured : mapping of axis name to float
        Joint angles [rad]; empty for a dark block.
    time_s : float
        Middle of the block [s].
    times_s : tuple of float
        Middle of each repeat [s].
    session : int
    exposures_s : tuple of float
        Exposures asked for [s].
    repeats : int
        Frames of each exposure.
    lamp_on : bool
    flags : tuple of str
    counts : mapping of axis name to int
    wall_time : str
    """

    kind: Literal["dark", "white"]
    number: int
    measured: Mapping[str, float]
    time_s: float
    session: int
    exposures_s: tuple[float, ...]
    repeats: int
    lamp_on: bool
    flags: tuple[str, ...] = ()
    counts: Mapping[str, int] = field(default_factory=dict)
    times_s: tuple[float, ...] = ()
    wall_time: str = ""


def to_json(record: object) -> str:
    """A record, or anything JSON-compatible, as canonical text; NaN as null."""
    values = asdict(record) if hasattr(record, "__dataclass_fields__") else record  # type: ignore[call-overload]
    return json.dumps(_plain(values), sort_keys=True, separators=(",", ":"), allow_nan=False)


def from_json(kind: type[T], text: str) -> T:
    """The record of a text written by `to_json`.

    Raises
    ------
    DatasetError
        If the text holds no such record.
    """
    try:
        values = json.loads(text)
        names = {f.name for f in fields(kind)}  # type: ignore[arg-type]
        if not isinstance(values, dict) or not set(values) <= names:
            raise ValueError("wrong fields")
        for name in ("flags", "exposures_s", "times_s"):
            if name in values:
                values[name] = tuple(values[name])
        if "health" in values:
            values["health"] = {
                a: {k: math.nan if v is None else v for k, v in h.items()} for a, h in values["health"].items()
            }
        return kind(**values)
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise DatasetError(f"a {kind.__name__} in the journal cannot be read: {error}; run `gonio verify`") from error


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if hasattr(value, "item") and not isinstance(value, str | bytes):  # a NumPy scalar
        return _plain(value.item())
    if value is None or isinstance(value, str | bool | int | float):
        return value
    return str(value)
