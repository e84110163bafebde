"""The ``[[source]]`` tables of a scene: the kinds of light, and which keys each has.

A wrong key or value is named with its line. Files of environment maps are opened when the source is built. It loads no
numerical package.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gonio.config.reader import Table
from gonio.errors import ConfigurationError, DatasetError, GeometryError, ParameterError

if TYPE_CHECKING:
    from gonio.source import Source

DEG = "_deg"


@dataclass(frozen=True)
class SourceConfig:
    """One source: its kind, and its parameters as `gonio.source.make` takes them (angles in radians).

    Attributes
    ----------
    kind : str
    parameters : mapping
        That of ``environment_map`` has ``file`` (a path) and ``scale`` instead of the samples.
    where : str
        What messages call it.
    """

    kind: str
    parameters: Mapping[str, Any]
    where: str = field(default="[source]", compare=False)

    def build(self) -> Source:
        """The source.

        Raises
        ------
        ConfigurationError, DatasetError
            If a parameter is outside its range, or a file cannot be read; with the place of the source in its document.
        """
        from gonio import source

        try:
            if self.kind == "point":  # where the surface is: the origin
                return source.point(**self.parameters).beam_at((0.0, 0.0, 0.0))
            if self.kind == "environment_map":
                return self._environment_map()
            return source.make(self.kind, **self.parameters)
        except (ParameterError, GeometryError) as exc:
            raise ConfigurationError(f"{self.where}: {exc}") from exc
        except DatasetError as exc:
            raise DatasetError(f"{self.where}: {exc}") from exc

    def _environment_map(self) -> Source:
        from gonio import environment, source

        given = dict(self.parameters)
        file = given.pop("file")
        radiance = environment.read(file, given.pop("channel", "luminance"))
        try:
            return source.make("environment_map", radiance=radiance * given.pop("scale", 1.0), **given)
        except ParameterError as exc:
            raise DatasetError(f"{file}: {exc}") from exc


# kind -> key -> how its value is read; a question mark: may be left out
_Reader = Callable[[Table, str], Any]


def _amount(table: Table, key: str) -> float:
    return table.number(key, lower=0.0)


def _polar(table: Table, key: str) -> float:
    return table.angle(key, lower=0.0, upper=180.0)


def _angle(table: Table, key: str) -> float:
    return table.angle(key)


def _half_angle(table: Table, key: str) -> float:
    return math.radians(table.number(key, above=0.0, upper=90.0, unit="degrees"))


def _vector(table: Table, key: str) -> tuple[float, ...]:
    found = table.numbers(key, count=3)
    if not any(found):
        table.report(key, "= [0, 0, 0] is no direction; give three numbers, not all zero")
    return found


def _list(table: Table, key: str) -> tuple[float, ...]:
    return table.numbers(key)


def _each(one: _Reader) -> _Reader:
    """A number or a list of them."""

    def read(table: Table, key: str) -> Any:
        if not table.holds_list(key):
            return one(table, key)
        table.numbers(key)  # complains of what is no number
        return tuple(one(item, key) for item in table.items(key))

    return read


def _choice(*choices: str) -> _Reader:
    return lambda table, key: table.text(key, choices=choices)


def _text(table: Table, key: str) -> str:
    return table.text(key)


def _kappa(table: Table, key: str) -> float:
    return table.number(key, lower=0.0, upper=1e5)


_DIRECTION: dict[str, _Reader] = {"theta_deg": _polar, "phi_deg": _angle}
SOURCES: dict[str, dict[str, _Reader]] = {
    "collimated": {**_DIRECTION, "irradiance?": _amount},
    "point": {"position": _vector, "intensity": _amount},
    "uniform": {"radiance?": _amount},
    "hemispherical": {"radiance?": _amount, "axis?": _vector},
    "overcast": {"zenith_radiance?": _amount, "axis?": _vector},
    "disk": {**_DIRECTION, "half_angle_deg": _half_angle, "radiance?": _amount, "irradiance?": _amount},
    "lobes": {
        "amplitude": _each(_amount), "kappa": _each(_kappa), "theta_deg": _each(_polar), "phi_deg": _each(_angle),
    },
    "environment_map": {
        "file": _text, "interpolation?": _choice("bilinear", "smooth"),
        "channel?": _choice("luminance", "red", "green", "blue"), "scale?": _amount,
    },
    "spherical_harmonics": {"coefficients": _list},
}  # fmt: skip


def read_source(table: Table, folder: Path) -> SourceConfig:
    """The source that a table describes; paths in it are relative to `folder`."""
    number = table.place.rpartition(".")[2]
    where = f"{table.document.name}: [[source]]" + (f" {number}" if number.isdigit() else "")
    if table.names() and table.get("kind") == "function":
        table.report("kind", '= "function" exists in Python only; sample it into an environment_map, or see gonio.source')
        return SourceConfig("uniform", {}, where)
    kind = table.text("kind", choices=SOURCES)
    if kind not in SOURCES or table.get("kind") != kind:
        return SourceConfig("uniform", {}, where)  # its keys cannot be judged
    parameters: dict[str, Any] = {}
    known = {key.rstrip("?"): (read, key.endswith("?")) for key, read in SOURCES[kind].items()}
    for key, (read, optional) in known.items():
        if key in table or not optional:
            bare = key.removesuffix(DEG)
            if key not in table and key != bare and table.get(bare) is not None:
                table.forget(bare)
                table.report(bare, f"has no unit; write {key} in degrees")
            else:
                parameters[bare] = read(table, key)
    table.finish()
    if kind == "disk" and ("radiance" in parameters) == ("irradiance" in parameters):
        table.report("radiance", "or irradiance: a disk needs exactly one of the two")
    if kind == "environment_map":
        parameters["file"] = str(folder / parameters["file"])
    return SourceConfig(kind, parameters, where)
