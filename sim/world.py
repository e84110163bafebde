r"""The truth behind the simulated bench: what the joints, the specimen and the lamp really are.

A measurement has to find this out again, so nothing here is shared with the code that will: poses are composed from
rotation matrices of its own. The arm carries the lamp in the x-z plane, the camera looks down from +z, the specimen is
a flat disk through the origin, turned by tilt about x and then by pan about y:

.. math:: \ell = R_y(\gamma)\,\hat z, \qquad (t, b, n) = R_y(\beta)\,R_x(\tau).

The true angle of a joint is that of the link behind the play, plus the error of the zero. The zero of an axis was set
with the approach that the axis always takes, so half of the play is part of its error and not added to it.

Not modelled: the arm's shadow and the arm in front of the camera (a plan has to stay clear of them), light between
specimen and bench, polarisation, colour, the lamp's size.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from gonio import brdf
from gonio.brdf import BRDF, Term, term_names
from gonio.errors import ConfigurationError
from sim.settings import AXES, Settings, Table

Array = NDArray[np.float64]

COUNTS_PER_TURN = 4096
SPECIMENS = ("sample", "white", "trap")

DEFAULT_MODEL = "lambertian+ggx"
DEFAULT_PARAMETERS = {"lambertian.albedo": 0.5, "ggx.k_s": 1.0, "ggx.alpha": 0.2, "ggx.f_0": 0.06}
_KEYS = (
    "model", "parameters", "errors", "zero_deg", "white_beta", "lamp_drift_per_hour", "lamp_warm_up", "veiling_glare",
    "backlash_deg", "friction_counts", "specimen_radius_mm", "width", "height", "pixel_mm", "dark_current_e_s",
    "responsivity", "lamp_intensity",
)  # fmt: skip


class Link(Protocol):
    """What the world sees of a servo: the link that it drives."""

    def output_counts(self, t: float) -> float:
        """Position at rig time `t` [s], in counts of the encoder but not rounded."""
        ...


class Light(Protocol):
    """What the world sees of the lamp."""

    def relative_output(self, t: float) -> float:
        """Radiant output at rig time `t` [s], 1 when new, warm and at full level."""
        ...


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
        friction = given.values.get("friction_counts", (0.2, 3.0))
        if not (
            isinstance(friction, list | tuple)
            and len(friction) == 2
            and all(isinstance(x, int | float) and 0 <= x <= 100 for x in friction)
        ):
            raise ConfigurationError(f"[sim.truth] friction_counts must be two numbers from 0 to 100, and is {friction!r}.")
        return cls(
            seed=settings.seed,
            model=model,
            parameters=_parameters(given, model, names),
            zero_errors=zero_errors,
            backlash=math.radians(given.number("backlash_deg", 0.25, 0.0, 10.0)),
            friction_counts=(float(friction[0]), float(friction[1])),
            white_beta=given.number("white_beta", drawn if errors else settings.beta, 0.0, 10.0),
            lamp_drift_per_hour=given.number("lamp_drift_per_hour", 0.01, -1.0, 1.0),
            lamp_warm_up=given.number("lamp_warm_up", 0.0, 0.0, 1.0),
            veiling_glare=given.number("veiling_glare", 0.0, 0.0, 0.9),
            specimen_radius_mm=given.number("specimen_radius_mm", 25.0, 1e-3, 1e5),
        )

    def sample_brdf(self) -> BRDF:
        """The sample's BRDF."""
        models = brdf.parse(self.model)
        terms = []
        for name, model in zip(term_names(models), models, strict=True):
            values = {k.split(".", 1)[1]: v for k, v in self.parameters.items() if k.split(".", 1)[0] == name}
            terms.append(Term(model, model.values(values)))
        return BRDF(terms)

    def white_brdf(self) -> BRDF:
        """The white's BRDF, f_r = beta / pi."""
        return self.white_beta * brdf.make("lambertian", albedo=1.0)

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
        }


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


class World:
    """The bench as it truly is, asked at a time.

    Parameters
    ----------
    settings : Settings
        The bench as drawn.
    truth : Truth
        How it differs.
    links : mapping of str to Link
        By axis.
    lamp : Light

    Attributes
    ----------
    specimen : str
        What lies on the stage: ``"sample"``, ``"white"`` or ``"trap"``, which returns no light.
    """

    def __init__(self, settings: Settings, truth: Truth, links: Mapping[str, Link], lamp: Light) -> None:
        self.settings = settings
        self.truth = truth
        self.specimen = "sample"
        self._links = dict(links)
        self._lamp = lamp
        self._brdfs = {"sample": truth.sample_brdf(), "white": truth.white_brdf()}
        half = {"up": 0.5, "down": -0.5, "any": 0.0}
        self._offsets = {
            name: truth.zero_errors[name] + half[settings.axes[name].approach] * truth.backlash for name in AXES
        }

    def mount(self, specimen: str) -> None:
        """Put ``"sample"``, ``"white"`` or ``"trap"`` on the stage.

        Raises
        ------
        ConfigurationError
            If there is no such specimen.
        """
        if specimen not in SPECIMENS:
            raise ConfigurationError(f"There is no specimen {specimen!r} to mount; there are {', '.join(SPECIMENS)}.")
        self.specimen = specimen

    def angles(self, t: float) -> dict[str, float]:
        """True joint angles at `t` [s], by axis [rad]."""
        true = {}
        for name in AXES:
            joint = self.settings.axes[name]
            counts = self._links[name].output_counts(t) - joint.zero_counts
            true[name] = joint.direction * counts * (2.0 * math.pi / COUNTS_PER_TURN) + self._offsets[name]
        return true

    def radiance(self, t: float, eye: Array, rays: Array) -> Array:
        """Radiance that reaches a camera.

        Parameters
        ----------
        t : float
            Rig time [s].
        eye : ndarray, shape (3,)
            Where the camera is [mm].
        rays : ndarray, shape (n, 3)
            Unit vectors into which it looks.

        Returns
        -------
        ndarray, shape (n,)
            L_r [W m^-2 sr^-1]; 0 beside the specimen, behind it and where no light falls on it.

        Notes
        -----
        For a lamp that is a point, the integral of f_r over the incident light is one evaluation per ray,
        L_r = f_r (I / d^2) cos theta_i, with the directions and the distance d of the place where the ray meets the disk.
        """
        out = np.zeros(len(rays))
        intensity = self.settings.lamp_intensity * self._lamp.relative_output(t)
        if self.specimen == "trap" or intensity == 0.0:
            return out
        angles = self.angles(t)
        frame = rotation_y(angles["pan"]) @ rotation_x(angles["tilt"])  # columns t, b, n
        lamp = rotation_y(angles["arm"])[:, 2] * self.settings.lamp_distance_mm
        # Everything in the specimen's frame, where its plane is z = 0.
        eye_local, lamp_local = eye @ frame, lamp @ frame
        if eye_local[2] <= 0.0 or lamp_local[2] <= 0.0:
            return out
        rays_local = rays @ frame  # (n, 3)
        down = rays_local[:, 2] < 0.0
        reach = np.divide(-eye_local[2], rays_local[:, 2], out=np.zeros(len(rays)), where=down)
        x = eye_local[0] + reach * rays_local[:, 0]
        y = eye_local[1] + reach * rays_local[:, 1]
        hit = np.flatnonzero(down & (x * x + y * y <= self.truth.specimen_radius_mm**2))
        to_lamp = np.empty((len(hit), 3))
        to_lamp[:, 0] = lamp_local[0] - x[hit]
        to_lamp[:, 1] = lamp_local[1] - y[hit]
        to_lamp[:, 2] = lamp_local[2]
        d2 = np.einsum("ij,ij->i", to_lamp, to_lamp)  # [mm^2]
        omega_i = to_lamp / np.sqrt(d2)[:, None]
        f_r = self._brdfs[self.specimen].evaluate(omega_i, -rays_local[hit])
        # E = I cos theta_i / d^2, d in metres
        out[hit] = f_r * (intensity * 1e6) * omega_i[:, 2] / d2
        return out
