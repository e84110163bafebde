"""What a measurement on the simulated bench has to find out: read from ``[sim.truth]`` and drawn from stated uncertainties.

The errors that a bench has but nobody knows are drawn here; what follows from them is in `sim.world`.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gonio import brdf
from gonio.brdf import BRDF, Term, term_names
from gonio.errors import ConfigurationError
from sim.dynamixel.load import Load
from sim.lamp import Channel
from sim.render import SHAPES
from sim.settings import AXES, Settings, Table

Array = NDArray[np.float64]

COUNTS_PER_TURN = 4096
DEFAULT_MODEL = "lambertian+ggx"
DEFAULT_PARAMETERS = {"lambertian.albedo": 0.5, "ggx.k_s": 1.0, "ggx.alpha": 0.2, "ggx.f_0": 0.06}
_KEYS = (
    "model", "parameters", "errors", "zero_deg", "white_beta", "lamp_drift_per_hour", "lamp_warm_up", "veiling_glare",
    "backlash_deg", "friction_counts", "specimen_radius_mm", "width", "height", "pixel_mm", "dark_current_e_s",
    "responsivity", "lamp_intensity", "lamp_radius_mm", "lamp_channels", "lens_radius_mm", "vignetting", "psf_sigma_px",
    "prnu", "cfa", "cfa_response", "response", "gamma", "frame_interval_s", "shape", "half_length_mm", "board_squares",
    "board_square_mm", "board_dark", "white_model", "white_parameters", "encoder_harmonics_deg", "load_nm", "hanging_deg",
    "supply_v",
)  # fmt: skip


def generator(seed: int, *key: str) -> np.random.Generator:
    """Random numbers that depend on `seed` and `key` alone, and not on what was drawn before.

    Parameters
    ----------
    seed : int
    *key : str
        Say what for: ``"frame", "pose 17 exposure 2"``.
    """
    text = "\x1f".join((str(seed), *key))
    return np.random.Generator(np.random.SFC64(int.from_bytes(hashlib.sha256(text.encode()).digest(), "big")))


@dataclass(frozen=True)
class Truth:
    """All that a measurement on the simulated bench has to find out, or to put up with.

    Attributes
    ----------
    seed : int
    model : str
        Of the sample, e.g. ``"lambertian+ggx"``.
    parameters : mapping of str to float
        Qualified, e.g. ``"ggx.alpha"``.
    zero_errors : mapping of str to float
        By axis: true minus encoder angle [rad], with the axis's usual approach.
    backlash : float
        Play of each joint, from flank to flank [rad].
    friction_counts : tuple of float
        Range of distances from the goal at which a shaft stops [counts].
    white_beta : float
        Radiance factor of the white, which is Lambertian.
    lamp_drift_per_hour, lamp_warm_up : float
        Relative change of the lamp in an hour; relative deficit when it is cold.
    veiling_glare : float
        Share of the mean of an image that is spread over all of it.
    specimen_radius_mm : float
        Of a disk, a sphere or a cylinder.
    shape : str
        Of the sample, as in `sim.render.Scene`: flat, sphere or cylinder.
    half_length_mm : float
        Of a cylinder.
    lamp_radius_mm : float
        Of the lamp's globe; 0 for a point.
    lamp_channels : tuple of Channel
        The head's LEDs.
    white_model : str
        BRDF of the white, scaled so that its radiance factor at the certificate's geometry is `white_beta`.
    white_parameters : mapping of str to float
    board_squares : tuple of int
        Columns and rows of the ChArUco board.
    board_square_mm, board_dark : float
        Side of its squares; reflectance of its ink relative to its paper, which is a Lambertian white.
    harmonics : mapping of str to tuple
        By axis: (n, amplitude [counts], phase [rad]) of the encoder's errors.
    loads : mapping of str to Load
        By axis: the weight of what it carries.
    supply_v : float or None
        Of the servos; None for the models' nominal voltages.
    hidden : mapping
        Of the sensor.
    """

    seed: int
    model: str
    parameters: Mapping[str, float]
    zero_errors: Mapping[str, float]
    backlash: float
    friction_counts: tuple[float, float]
    white_beta: float
    lamp_drift_per_hour: float
    lamp_warm_up: float
    veiling_glare: float
    specimen_radius_mm: float
    shape: str = "flat"
    half_length_mm: float = 50.0
    lamp_radius_mm: float = 0.0
    lamp_channels: tuple[Channel, ...] = (Channel(),)
    white_model: str = "lambertian"
    white_parameters: Mapping[str, float] = field(default_factory=dict)
    board_squares: tuple[int, int] = (8, 6)
    board_square_mm: float = 4.0
    board_dark: float = 0.04
    harmonics: Mapping[str, tuple[tuple[int, float, float], ...]] = field(default_factory=dict)
    loads: Mapping[str, Load] = field(default_factory=dict)
    supply_v: float | None = None
    hidden: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def draw(cls, settings: Settings) -> Truth:
        """Draw the errors of the bench from what the rig.toml says of them, and take the rest from ``[sim.truth]``.

        Zeros are normal with ``u_zero_deg``, the white's radiance factor with the relative uncertainty ``u_beta``.
        ``errors = false`` leaves both at their nominal values; ``zero_deg.arm`` and ``white_beta`` set one.

        Raises
        ------
        ConfigurationError
            If a key is unknown or a value is not usable.
        """
        given = Table(settings.truth, "sim.truth")
        model = given.text("model", DEFAULT_MODEL)
        names = term_names(brdf.parse(model))
        given.only((*_KEYS, *names, *(key for key in given.values if key.split(".")[0] in names)))
        errors = given.values.get("errors", True)
        if not isinstance(errors, bool):
            raise ConfigurationError(f"[sim.truth] errors must be true or false, and is {errors!r}.")
        zeros = given.table("zero_deg")
        zeros.only(AXES)
        zero_errors = {}
        for name in AXES:
            drawn = settings.axes[name].u_zero * float(generator(settings.seed, "zero", name).standard_normal())
            degrees = zeros.number(name, math.degrees(drawn) if errors else 0.0, -360.0, 360.0)
            zero_errors[name] = math.radians(degrees)
        drawn = settings.beta * (1.0 + settings.u_beta * float(generator(settings.seed, "white").standard_normal()))
        friction = given.numbers("friction_counts", (0.2, 3.0), 0.0, 100.0)
        shape = given.text("shape", "flat")
        if shape not in SHAPES[:3]:
            raise ConfigurationError(f"[sim.truth] shape = {shape!r} is not known; choose one of {', '.join(SHAPES[:3])}.")
        columns, rows = given.numbers("board_squares", (8, 6), 3, 50)
        return cls(
            seed=settings.seed,
            model=model,
            parameters=_parameters(given, model, names),
            zero_errors=zero_errors,
            backlash=math.radians(given.number("backlash_deg", 0.25, 0.0, 10.0)),
            friction_counts=(friction[0], friction[1]),
            white_beta=given.number("white_beta", drawn if errors else settings.beta, 0.0, 10.0),
            lamp_drift_per_hour=given.number("lamp_drift_per_hour", 0.01, -1.0, 1.0),
            lamp_warm_up=given.number("lamp_warm_up", 0.0, 0.0, 1.0),
            veiling_glare=given.number("veiling_glare", 0.0, 0.0, 0.9),
            specimen_radius_mm=given.number("specimen_radius_mm", 25.0, 1e-3, 1e5),
            shape=shape,
            half_length_mm=given.number("half_length_mm", 50.0, 1e-3, 1e5),
            lamp_radius_mm=given.number("lamp_radius_mm", 0.0, 0.0, 0.3 * settings.lamp_distance_mm),
            lamp_channels=_channels(given),
            white_model=given.text("white_model", "lambertian"),
            white_parameters={str(k): float(v) for k, v in given.table("white_parameters").values.items()},
            board_squares=(int(columns), int(rows)),
            board_square_mm=given.number("board_square_mm", 4.0, 1e-3, 1e5),
            board_dark=given.number("board_dark", 0.04, 0.0, 1.0),
            harmonics={name: _harmonics(given, name) for name in AXES},
            loads=_loads(given, settings),
            supply_v=given.number("supply_v", 0.0, 0.0, 60.0) or None,
            hidden=settings.sensor.hidden(),
        )

    def sample_brdf(self) -> BRDF:
        """The sample's BRDF."""
        models = brdf.parse(self.model)
        terms = []
        for name, model in zip(term_names(models), models, strict=True):
            values = {k.split(".", 1)[1]: v for k, v in self.parameters.items() if k.split(".", 1)[0] == name}
            terms.append(Term(model, model.values(values)))
        return BRDF(terms)

    def white_brdf(self, white_deg: tuple[float, float, float] = (30.0, 15.0, 0.0)) -> BRDF:
        """The white's BRDF: f_r = beta / pi at the certificate's geometry (arm, pan and tilt [degrees])."""
        if self.white_model == "lambertian":
            return self.white_beta * brdf.make("lambertian", albedo=1.0)
        plain = brdf.make(self.white_model, **self.white_parameters)
        arm, pan, tilt = np.radians(white_deg)
        frame = rotation_y(float(pan)) @ rotation_x(float(tilt))
        to_lamp, to_eye = rotation_y(float(arm))[:, 2] @ frame, frame[2]
        return self.white_beta / (math.pi * float(plain.evaluate(to_lamp, to_eye))) * plain

    def as_dict(self) -> dict[str, Any]:
        """Everything, ready for JSON; angles in degrees under names that say so."""
        return {
            "seed": self.seed,
            "model": self.model,
            "parameters": dict(self.parameters),
            "zero_deg": {name: math.degrees(value) for name, value in self.zero_errors.items()},
            "backlash_deg": math.degrees(self.backlash),
            "friction_counts": list(self.friction_counts),
            "white_beta": self.white_beta,
            "lamp_drift_per_hour": self.lamp_drift_per_hour,
            "lamp_warm_up": self.lamp_warm_up,
            "veiling_glare": self.veiling_glare,
            "specimen_radius_mm": self.specimen_radius_mm,
            "shape": self.shape,
            "half_length_mm": self.half_length_mm,
            "lamp_radius_mm": self.lamp_radius_mm,
            "lamp_channels": [{"share": c.share, "colour": list(c.colour)} for c in self.lamp_channels],
            "white_model": self.white_model,
            "white_parameters": dict(self.white_parameters),
            "board_squares": list(self.board_squares),
            "board_square_mm": self.board_square_mm,
            "board_dark": self.board_dark,
            "encoder_harmonics_deg": {
                name: [[n, a * 360.0 / COUNTS_PER_TURN, math.degrees(phase)] for n, a, phase in waves]
                for name, waves in self.harmonics.items()
            },
            "load_nm": {name: load.torque_nm for name, load in self.loads.items()},
            "supply_v": self.supply_v,
            "sensor": dict(self.hidden),
        }


def _channels(given: Table) -> tuple[Channel, ...]:
    """``lamp_channels = [{share = 0.5, colour = [3, 0, 0]}, ...]``."""
    entries = given.values.get("lamp_channels", [{}])
    if not isinstance(entries, list | tuple) or not entries:
        raise ConfigurationError("[sim.truth] lamp_channels must be a list of tables with share and colour.")
    channels = []
    for k, entry in enumerate(entries, start=1):
        table = Table({"channel": entry}, "sim.truth").table("channel")
        table = Table(table.values, f"sim.truth: lamp_channels {k}")
        table.only(("share", "colour"))
        red, green, blue = table.numbers("colour", (1.0, 1.0, 1.0), 0.0, 100.0)
        channels.append(Channel(table.number("share", 1.0 / len(entries), 0.0, 1.0), (red, green, blue)))
    return tuple(channels)


def _harmonics(given: Table, axis: str) -> tuple[tuple[int, float, float], ...]:
    """``encoder_harmonics_deg.pan = [[n, amplitude, phase], ...]``, in degrees; as (n, counts, rad)."""
    table = given.table("encoder_harmonics_deg")
    table.only(AXES)
    waves = table.values.get(axis, ())
    if not isinstance(waves, list | tuple):
        raise ConfigurationError(f"[{table.place}] {axis} must be a list of waves [n, amplitude, phase].")
    found = []
    for wave in waves:
        n, amplitude, phase = Table({axis: wave}, table.place).numbers(axis, (1.0, 0.0, 0.0), -360.0, 360.0)
        found.append((int(n), amplitude * COUNTS_PER_TURN / 360.0, math.radians(phase)))
    return tuple(found)


def _loads(given: Table, settings: Settings) -> dict[str, Load]:
    """``load_nm.tilt`` and ``hanging_deg.tilt``: torque of the weight, and the joint angle at which it hangs."""
    torques, angles = given.table("load_nm"), given.table("hanging_deg")
    torques.only(AXES)
    angles.only(AXES)
    loads = {}
    for name in AXES:
        joint = settings.axes[name]
        hanging = joint.direction * angles.number(name, 180.0, -360.0, 360.0) * COUNTS_PER_TURN / 360.0
        loads[name] = Load(torques.number(name, 0.0, 0.0, 100.0), joint.zero_counts + hanging)
    return loads


def _parameters(given: Table, model: str, names: tuple[str, ...]) -> dict[str, float]:
    """Qualified parameters, from ``parameters``, ``ggx.alpha`` in quotes, and tables such as ``[sim.truth.ggx]``."""
    found: dict[str, Any] = dict(given.table("parameters").values)
    for name in names:
        found |= {f"{name}.{key}": value for key, value in given.table(name).values.items()}
    found |= {key: value for key, value in given.values.items() if key.split(".")[0] in names and "." in key}
    # The usual sample stands in for what is not said, term by term.
    usual = {key: value for key, value in DEFAULT_PARAMETERS.items() if key.split(".")[0] in names}
    for key, value in found.items():
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ConfigurationError(f"[sim.truth] {key} must be a number, and is {value!r}.")
    parameters = usual | {key: float(value) for key, value in found.items()}
    for name, declared in zip(names, brdf.parse(model), strict=True):
        declared.values({k.split(".", 1)[1]: v for k, v in parameters.items() if k.split(".", 1)[0] == name})
    for key in parameters:
        if key.split(".")[0] not in names:
            raise ConfigurationError(f"[sim.truth] {key} belongs to no term of the model {model!r}.")
    return parameters


def rotation_x(angle: float) -> Array:
    """Rotation about x by `angle` [rad], right-handed; shape (3, 3)."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def rotation_y(angle: float) -> Array:
    """Rotation about y by `angle` [rad], right-handed; shape (3, 3)."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
