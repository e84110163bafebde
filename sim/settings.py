"""The tables of rig.toml that the simulated rig is built from, with defaults that make it run without any file.

The simulator is told what is written on the bench: ids, zeros, distances, the camera's data sheet, and how well each is
known. What is true is drawn from that by `sim.world.Truth`. Keys that only a host needs (timeouts, limits, the region of
interest) are left to ``gonio.config``; keys under ``[sim.truth]`` are known to nobody else, so there an unknown one is an
error here.
"""

from __future__ import annotations

import difflib
import json
import math
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gonio.errors import ConfigurationError

MAX_BYTES = 1_000_000
AXES = ("arm", "pan", "tilt")


@dataclass(frozen=True)
class Joint:
    """One axis as the bench's drawing has it.

    Attributes
    ----------
    servo_id : int
    model : str
        Of the servo.
    zero_counts : int
        Encoder counts at joint angle zero.
    direction : int
        1 or -1: sign of the joint angle against the encoder.
    u_zero : float
        Standard uncertainty of the zero [rad].
    approach : str
        ``"up"``, ``"down"`` or ``"any"``: how the axis comes to its goals, and came to its zero when that was set.
    """

    servo_id: int
    model: str = "XM430-W350"
    zero_counts: int = 2048
    direction: int = 1
    u_zero: float = math.radians(0.1)
    approach: str = "up"


@dataclass(frozen=True)
class Sensor:
    """A camera that looks down on the specimen from +z; as it comes, monochrome, linear, and with a pinhole.

    Attributes
    ----------
    distance_mm : float
        Pinhole to specimen [mm].
    width, height : int
        Pixels.
    pixel_mm : float
        Side of a pixel, seen at the specimen [mm].
    gain_dn_per_e, read_noise_e, offset_dn : float
        Counts per electron; standard deviation of the read noise [electrons]; counts in the dark.
    bit_depth : int
        Of the analogue-to-digital converter; all bits set means saturated.
    dark_current_e_s : float
        Electrons per second in a covered pixel.
    responsivity : float
        Electrons per second and unit of radiance [e s^-1 / (W m^-2 sr^-1)], on the optical axis.
    lens_radius_mm : float
        Of the aperture; 0 for a pinhole. It is sharp in the plane through the axes.
    vignetting : float
        Share of the light that is missing in the corners, beyond cos^4; grows with the square of the distance.
    veiling_glare : float
        Share of the mean of an image that is spread over all of it.
    psf_sigma_px : float
        Standard deviation of the Gaussian point spread [pixels].
    prnu : float
        Relative standard deviation of the pixels' gains.
    cfa : str
        Colours of the pixels (0, 0), (0, 1), (1, 0), (1, 1), e.g. ``"RGGB"``; empty for a monochrome sensor.
    cfa_response : tuple of float
        Of red, green and blue pixels to white light, relative to a monochrome one.
    response : {"linear", "gamma"}
    gamma : float
        With ``"gamma"``, counts go with the signal to the power 1 / gamma.
    frame_interval_s : float
        Of the stream that a driver for live cameras sees.
    """

    distance_mm: float = 600.0
    width: int = 160
    height: int = 120
    pixel_mm: float = 0.25
    gain_dn_per_e: float = 0.25
    read_noise_e: float = 4.0
    offset_dn: float = 64.0
    bit_depth: int = 12
    dark_current_e_s: float = 20.0
    responsivity: float = 3.25e5
    lens_radius_mm: float = 0.0
    vignetting: float = 0.0
    veiling_glare: float = 0.0
    psf_sigma_px: float = 0.0
    prnu: float = 0.0
    cfa: str = ""
    cfa_response: tuple[float, float, float] = (0.6, 1.0, 0.5)
    response: str = "linear"
    gamma: float = 2.2
    frame_interval_s: float = 1.0 / 30.0

    def hidden(self) -> dict[str, Any]:
        """What no data sheet tells, ready for JSON."""
        names = (
            "dark_current_e_s", "responsivity", "lens_radius_mm", "vignetting", "psf_sigma_px", "prnu", "cfa",
            "cfa_response", "response", "gamma",
        )  # fmt: skip
        return {name: list(v) if isinstance(v := getattr(self, name), tuple) else v for name in names}

    @property
    def saturation_dn(self) -> int:
        """The largest number that the converter gives."""
        return int(2**self.bit_depth - 1)


@dataclass(frozen=True)
class Settings:
    """What is written on the simulated bench.

    Attributes
    ----------
    axes : mapping of str to Joint
        ``"arm"``, ``"pan"``, ``"tilt"``.
    sensor : Sensor
    lamp_distance_mm : float
        Lamp to specimen [mm].
    lamp_intensity : float
        Radiant intensity at full output [W/sr]; the same in every direction.
    beta, u_beta : float
        Radiance factor that the white's certificate states, and its standard uncertainty.
    white_deg : tuple of float
        Arm, pan and tilt of the geometry that the white's certificate is for [degrees].
    baud : int
        Of the bus [bit/s].
    speed : float
        Rig seconds per wall second, where the wall's clock is used.
    seed : int
        Of everything that is drawn: errors of the bench, noise.
    truth : mapping
        ``[sim.truth]``, as it stands.
    """

    axes: Mapping[str, Joint] = field(default_factory=lambda: {name: Joint(k) for k, name in enumerate(AXES, start=1)})
    sensor: Sensor = Sensor()
    lamp_distance_mm: float = 500.0
    lamp_intensity: float = 1.0
    beta: float = 0.99
    u_beta: float = 0.005
    white_deg: tuple[float, float, float] = (30.0, 15.0, 0.0)
    baud: int = 1_000_000
    speed: float = 1.0
    seed: int = 1
    truth: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def from_mapping(cls, config: Mapping[str, Any] | None = None) -> Settings:
        """Read the tables of a rig.toml that concern the simulator.

        Parameters
        ----------
        config : mapping, optional
            The parsed file; tables and keys that are missing have defaults.

        Raises
        ------
        ConfigurationError
            If a value has the wrong type or is outside its range.
        """
        root = Table(config or {}, "")
        axes = {}
        for k, name in enumerate(AXES, start=1):
            t = root.table("axes").table(name)
            direction = t.integer("direction", 1, -1, 1)
            if direction == 0:
                raise ConfigurationError(f"[axes.{name}] direction is 0; write 1 or -1.")
            axes[name] = Joint(
                t.integer("id", k, 0, 252),
                t.text("model", "XM430-W350"),
                t.integer("zero_counts", 2048, -1_048_575, 1_048_575),
                direction,
                math.radians(t.number("u_zero_deg", 0.1, 0.0, 45.0)),
                t.text("approach", "up"),
            )
            if axes[name].approach not in ("up", "down", "any"):
                raise ConfigurationError(f"[axes.{name}] approach is {axes[name].approach!r}; write up, down or any.")
        ids = [joint.servo_id for joint in axes.values()]
        if len(set(ids)) < len(ids):
            raise ConfigurationError(f"[axes] have the servo ids {ids}; each axis needs an id of its own.")
        camera, lamp = root.table("camera"), root.table("lamp")
        white, sim = root.table("white"), root.table("sim")
        truth = sim.table("truth")
        cfa = truth.text("cfa", "")
        if cfa and not (len(cfa) == 4 and set(cfa) <= set("RGB")):
            raise ConfigurationError(f"[sim.truth] cfa = {cfa!r} is no pattern of four colours; write for example RGGB.")
        response = truth.text("response", "linear")
        if response not in ("linear", "gamma"):
            raise ConfigurationError(f"[sim.truth] response = {response!r} is not known; write linear or gamma.")
        red, green, blue = truth.numbers("cfa_response", (0.6, 1.0, 0.5), 0.0, 10.0)
        sensor = Sensor(
            camera.number("distance_mm", 600.0, 10.0, 1e5),
            truth.integer("width", 160, 8, 4096),
            truth.integer("height", 120, 8, 4096),
            truth.number("pixel_mm", 0.25, 1e-4, 100.0),
            camera.number("gain_dn_per_e", 0.25, 1e-6, 1e3),
            camera.number("read_noise_e", 4.0, 0.0, 1e4),
            camera.number("offset_dn", 64.0, 0.0, 60_000.0),
            camera.integer("bit_depth", 12, 8, 16),
            truth.number("dark_current_e_s", 20.0, 0.0, 1e6),
            truth.number("responsivity", 3.25e5, 0.0, 1e12),
            truth.number("lens_radius_mm", 0.0, 0.0, 100.0),
            truth.number("vignetting", 0.0, 0.0, 1.0),
            truth.number("veiling_glare", 0.0, 0.0, 0.9),
            truth.number("psf_sigma_px", 0.0, 0.0, 100.0),
            truth.number("prnu", 0.0, 0.0, 0.5),
            cfa,
            (red, green, blue),
            response,
            truth.number("gamma", 2.2, 1.0, 5.0),
            truth.number("frame_interval_s", 1.0 / 30.0, 1e-4, 60.0),
        )
        return cls(
            axes,
            sensor,
            lamp.number("distance_mm", 500.0, 10.0, 1e5),
            truth.number("lamp_intensity", 1.0, 0.0, 1e6),
            white.number("beta", 0.99, 1e-6, 10.0),
            white.number("u_beta", 0.005, 0.0, 1.0),
            (
                white.number("arm_deg", 30.0, -180.0, 180.0),
                white.number("pan_deg", 15.0, -180.0, 180.0),
                white.number("tilt_deg", 0.0, -180.0, 180.0),
            ),
            root.table("bus").integer("baud", 1_000_000, 9_600, 4_500_000),
            sim.number("speed", 1.0, 1e-3, 1e4),
            sim.integer("seed", 1, 0, 2**63 - 1),
            truth.values,
        )


def read_file(path: Path) -> dict[str, Any]:
    """Parse a TOML file, or a JSON file if its name ends so.

    Raises
    ------
    ConfigurationError
        If it cannot be read or parsed, or is larger than 1 MB.
    """
    try:
        with path.open("rb") as stream:
            raw = stream.read(MAX_BYTES + 1)
    except OSError as error:
        raise ConfigurationError(f"{path} cannot be read ({error.strerror}); give the path of a readable file.") from error
    if len(raw) > MAX_BYTES:
        raise ConfigurationError(f"{path} is larger than {MAX_BYTES} bytes; that is no configuration file.")
    try:
        text = raw.decode()
        parsed = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise ConfigurationError(f"{path} cannot be parsed: {error}.") from error
    if not isinstance(parsed, dict):
        raise ConfigurationError(f"{path} holds no tables; write a rig.toml.")
    return parsed


class Table:
    """One table of a file, which knows its place when something is wrong.

    Parameters
    ----------
    values : mapping
    place : str
        Name for messages, e.g. ``"sim.truth"``; empty for the file itself.
    """

    def __init__(self, values: Mapping[str, Any], place: str) -> None:
        self.values = values
        self.place = place

    def table(self, key: str) -> Table:
        """A table inside this one; empty if it is missing."""
        value = self.values.get(key, {})
        place = f"{self.place}.{key}" if self.place else key
        if not isinstance(value, Mapping):
            raise ConfigurationError(f"[{place}] must be a table, and is {value!r}.")
        return Table(value, place)

    def number(self, key: str, default: float, lower: float, upper: float) -> float:
        """A finite number within [lower, upper]."""
        value = self.values.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ConfigurationError(f"[{self.place}] {key} must be a number, and is {value!r}.")
        if not lower <= value <= upper:
            within = f"{lower:g} to {upper:g}"
            raise ConfigurationError(f"[{self.place}] {key} = {value:g} is outside {within}; choose one inside.")
        return float(value)

    def numbers(self, key: str, default: tuple[float, ...], lower: float, upper: float) -> tuple[float, ...]:
        """As many finite numbers as `default` has, each within [lower, upper]."""
        value = self.values.get(key, default)
        if not isinstance(value, list | tuple) or len(value) != len(default):
            raise ConfigurationError(f"[{self.place}] {key} must be a list of {len(default)} numbers, and is {value!r}.")
        return tuple(Table({key: one}, self.place).number(key, 0.0, lower, upper) for one in value)

    def integer(self, key: str, default: int, lower: int, upper: int) -> int:
        """A whole number within [lower, upper]."""
        value = self.values.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int):
            raise ConfigurationError(f"[{self.place}] {key} must be a whole number, and is {value!r}.")
        if not lower <= value <= upper:
            raise ConfigurationError(f"[{self.place}] {key} = {value} is outside {lower} to {upper}; choose one inside.")
        return value

    def text(self, key: str, default: str) -> str:
        """A string."""
        value = self.values.get(key, default)
        if not isinstance(value, str):
            raise ConfigurationError(f"[{self.place}] {key} must be a string, and is {value!r}.")
        return value

    def only(self, known: Iterable[str]) -> None:
        """Refuse any other key.

        Raises
        ------
        ConfigurationError
            Naming the nearest known key.
        """
        names = list(known)
        for key in self.values:
            if key not in names:
                near = difflib.get_close_matches(key, names, 1)
                hint = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(names)}."
                raise ConfigurationError(f"[{self.place}] has no key {key!r}; {hint}")
