r"""The truth behind the simulated bench: what the joints, the specimen and the lamp really are.

A measurement has to find this out again, so nothing here is shared with the code that will: poses are composed from
rotation matrices of its own. The arm carries the lamp in the x-z plane, the camera looks down from +z, the specimen is
a flat disk through the origin, or another shape about it, turned by tilt about x and then by pan about y:

.. math:: \ell = R_y(\gamma)\,\hat z, \qquad (t, b, n) = R_y(\beta)\,R_x(\tau).

The true angle of a joint is that of the link behind the play, plus the error of the zero. The zero of an axis was set
with the approach that the axis always takes, so half of the play is part of its error and not added to it.

What light does between lamp, specimen and lens is in `sim.render`. Not modelled: the arm's shadow and the arm in front of
the camera (a plan has to stay clear of them), light between specimen and bench, polarisation.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from gonio import brdf
from gonio.errors import ConfigurationError
from sim import board
from sim.render import Scene, radiance
from sim.settings import AXES, Settings
from sim.truth import COUNTS_PER_TURN, Truth, generator, rotation_x, rotation_y

__all__ = ["COUNTS_PER_TURN", "SPECIMENS", "Link", "Truth", "World", "generator", "rotation_x", "rotation_y"]

Array = NDArray[np.float64]

SPECIMENS = ("sample", "white", "trap", "board")


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

    def colour(self, t: float) -> tuple[float, float, float]:
        """How red, green and blue it is; white is 1, 1, 1."""
        ...


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
    """

    def __init__(self, settings: Settings, truth: Truth, links: Mapping[str, Link], lamp: Light) -> None:
        self.settings = settings
        self.truth = truth
        self._specimens: deque[tuple[float, str]] = deque([(-math.inf, "sample")], 64)
        self._links = dict(links)
        self._lamp = lamp
        white = truth.white_brdf(settings.white_deg)
        paper = truth.white_beta * brdf.make("lambertian", albedo=1.0)
        self._brdfs = {"sample": truth.sample_brdf(), "white": white, "trap": white, "board": paper}
        self._board: Array | None = None
        half = {"up": 0.5, "down": -0.5, "any": 0.0}
        self._offsets = {
            name: truth.zero_errors[name] + half[settings.axes[name].approach] * truth.backlash for name in AXES
        }

    @property
    def specimen(self) -> str:
        """What lies on the stage: ``"sample"``, ``"white"``, ``"board"``, or ``"trap"``, which returns no light."""
        return self._specimens[-1][1]

    def mount(self, specimen: str, t: float = -math.inf) -> None:
        """Put ``"sample"``, ``"white"``, ``"board"`` or ``"trap"`` on the stage, at `t` [s].

        Raises
        ------
        ConfigurationError
            If there is no such specimen.
        """
        if specimen not in SPECIMENS:
            raise ConfigurationError(f"There is no specimen {specimen!r} to mount; there are {', '.join(SPECIMENS)}.")
        self._specimens.append((t, specimen))

    def specimen_at(self, t: float) -> str:
        """What lay on the stage at `t` [s]."""
        return next((specimen for since, specimen in reversed(self._specimens) if since <= t), self._specimens[0][1])

    def angles(self, t: float) -> dict[str, float]:
        """True joint angles at `t` [s], by axis [rad]."""
        true = {}
        for name in AXES:
            joint = self.settings.axes[name]
            counts = self._links[name].output_counts(t) - joint.zero_counts
            true[name] = joint.direction * counts * (2.0 * math.pi / COUNTS_PER_TURN) + self._offsets[name]
        return true

    def scene(self, t: float) -> Scene:
        """Specimen and lamp at `t` [s]."""
        truth, settings = self.truth, self.settings
        angles = self.angles(t)
        frame = rotation_y(angles["pan"]) @ rotation_x(angles["tilt"])  # columns t, b, n
        lamp = rotation_y(angles["arm"])[:, 2] * settings.lamp_distance_mm
        intensity = settings.lamp_intensity * self._lamp.relative_output(t)
        specimen = self.specimen_at(t)
        shape, radius, half_length, texture = "flat", truth.specimen_radius_mm, truth.half_length_mm, None
        if specimen == "sample":
            shape = truth.shape
        elif specimen == "trap":
            intensity = 0.0
        elif specimen == "board":
            columns, rows = truth.board_squares
            shape = "board"
            radius, half_length = 0.5 * columns * truth.board_square_mm, 0.5 * rows * truth.board_square_mm
            if self._board is None:
                self._board = board.texture(
                    columns, rows, truth.board_dark, truth.board_square_mm, settings.sensor.pixel_mm
                )
            texture = self._board
        return Scene(
            self._brdfs[specimen], frame, lamp, intensity, truth.lamp_radius_mm, shape, radius, half_length, texture
        )

    def radiance(self, t: float, eye: Array, rays: Array) -> Array:
        """Radiance that reaches a camera.

        Parameters
        ----------
        t : float
            Rig time [s].
        eye : ndarray, shape (3,)
            Where the middle of the camera's lens is [mm].
        rays : ndarray, shape (n, 3)
            Unit vectors into which it looks.

        Returns
        -------
        ndarray, shape (n,)
            L_r [W m^-2 sr^-1], its mean over the lens; 0 beside the specimen, behind it and where no light falls on it.
        """
        return radiance(self.scene(t), eye, rays, self.settings.sensor.lens_radius_mm)

    def colour(self, t: float) -> tuple[float, float, float]:
        """How red, green and blue the lamp is at `t`."""
        return self._lamp.colour(t)

    def state(self, t: float) -> dict[str, Any]:
        """What is true at `t` [s], ready for JSON; angles in degrees."""
        return {
            "t_s": t,
            "specimen": self.specimen_at(t),
            "angles_deg": {name: math.degrees(angle) for name, angle in self.angles(t).items()},
            "lamp": self._lamp.relative_output(t),
        }
