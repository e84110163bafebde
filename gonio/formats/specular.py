"""Tables around the mirror direction: the grid that an OpticStudio ``.bsdf`` holds, and its samples.

Angles are relative to the specular direction: radial 0 is specular, azimuth 0 runs from specular towards the normal,
counter-clockwise seen against the specular ray. Sample rotation turns the sample under a fixed light, so azimuths on the
sample fall as it grows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from gonio.channels import SINGLE, XYZ, Channels, ChannelSamples
from gonio.errors import DatasetError, IntegrationError
from gonio.formats.material import Material, around_mirror, radial_deg
from gonio.geometry import angles
from gonio.integrate import directional_albedo

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SpecularTable:
    """Values on a grid around the mirror direction.

    Attributes
    ----------
    rotation_deg, incidence_deg, azimuth_deg, radial_deg : ndarray
        [deg], ascending.
    value : ndarray, shape (c, rotations, incidences, azimuths, radials)
        f_r [1/sr]; an exact 0 above the horizon was never measured.
    tis : ndarray, shape (c, rotations, incidences)
        Total integrated scatter [1].
    symmetric : bool
        Azimuths cover 0 to 180 degrees, and the other half mirrors them.
    channels : Channels
        One, or X, Y, Z.
    comments : tuple of str
        Lines above the header.
    attributes : mapping of str to str
    """

    rotation_deg: Array
    incidence_deg: Array
    azimuth_deg: Array
    radial_deg: Array
    value: Array
    tis: Array
    symmetric: bool
    channels: Channels = SINGLE
    comments: tuple[str, ...] = ()
    attributes: Mapping[str, str] = field(default_factory=dict)

    def directions(self) -> Array:
        """Reflected unit vectors for light at azimuth 0, shape (incidences, azimuths, radials, 3)."""
        theta = np.radians(self.incidence_deg)[:, None, None]
        return around_mirror(theta, np.radians(self.azimuth_deg)[:, None], np.radians(self.radial_deg))

    def samples(self) -> ChannelSamples:
        """The measured directions above the horizon, each once; what is left out is counted in the attributes."""
        wr = self.directions()
        theta_r, phi_r = angles(wr)
        shape = self.value.shape[1:]
        one = np.ones(shape[1:], dtype=bool)
        one[:, 1:, self.radial_deg == 0.0] = False  # the specular direction, once
        above = np.broadcast_to((wr[..., 2] > 1e-9) & one, shape)
        measured = above & np.any(self.value != 0.0, axis=0)
        if not np.any(measured):
            raise DatasetError("all values above the horizon are 0, which means never measured; the file is empty")
        turn = -np.radians(self.rotation_deg)[:, None, None, None]

        def picked(array: Array) -> Array:
            return np.asarray(np.broadcast_to(array, shape)[measured])

        value = np.moveaxis(self.value, 0, -1)[measured]
        attributes = {
            **self.attributes,
            "directions": "specular-relative in the file, converted to polar angle and azimuth from the normal",
            "n_above_horizon": str(int(np.count_nonzero(above))),
            "n_missing": str(int(np.count_nonzero(above & ~measured))),
            "missing": "an exact 0 marks a direction that was never measured",
            "total_integrated_scatter": ", ".join(f"{t:g}" for t in self.tis[self.channels.main].ravel()[:100]),
        }
        return ChannelSamples.make(
            picked(np.radians(self.incidence_deg)[:, None, None]), picked(turn), picked(theta_r), picked(phi_r + turn),
            np.where(value == 0.0, np.nan, value), self.channels, attributes=attributes,
        )  # fmt: skip


def tabulate(material: Material, incidence_deg: Array) -> SpecularTable:
    """The table of a material: one channel, or X, Y, Z if it has linear RGB."""
    if material.channels.kind == "rgb":
        material = material.tristimulus()
    channels = XYZ if material.channels.kind == "xyz" else SINGLE
    if len(material.channels) != len(channels):
        material = material.one()
    symmetric = material.isotropic
    azimuth = np.arange(0.0, 181.0, 3.0) if symmetric else np.arange(0.0, 361.0, 10.0)
    rotation = np.array([0.0]) if symmetric else np.arange(0.0, 360.0, 15.0)
    radial = radial_deg(material.lobe_width(), 175.0, 2.0 if symmetric else 5.0)
    empty = np.zeros((1, 1, 1, 1, 1))
    table = SpecularTable(rotation, incidence_deg, azimuth, radial, empty, empty[..., 0, 0], symmetric, channels)
    wr = table.directions()
    theta = np.radians(incidence_deg)
    wi = np.stack((np.sin(theta), np.zeros_like(theta), np.cos(theta)), axis=-1)
    value = np.empty((len(channels), len(rotation), *wr.shape[:-1]))
    for k, turn in enumerate(-np.radians(rotation)):
        c, s = np.cos(turn), np.sin(turn)
        spin = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        value[:, k] = material.evaluate(np.broadcast_to((wi @ spin.T)[:, None, None, :], wr.shape), wr @ spin.T)
    value = np.where(wr[..., 2] > 1e-9, np.maximum(value, 0.0), 0.0)
    tis = _scatter(material, theta) if symmetric else integrated(value, wr, azimuth, radial, symmetric)
    return replace(table, value=value, tis=tis, attributes=material.attributes)


def _scatter(material: Material, theta: Array) -> Array:
    """Total integrated scatter of an isotropic material at the incidences, shape (c, 1, incidences)."""
    each = []
    for brdf in material.brdfs:
        try:
            each.append(np.array([float(directional_albedo(brdf, t, rtol=1e-3).value) for t in theta]))
        except IntegrationError as error:
            raise DatasetError(f"the scatter of the material cannot be integrated: {error}") from error
    found = np.stack(each)
    return np.asarray((found if material.mix is None else material.mix @ found)[:, None, :])


def integrated(value: Array, wr: Array, azimuth_deg: Array, radial_deg: Array, symmetric: bool) -> Array:
    """Total integrated scatter of each block by the trapezoidal rule on the grid itself, shape of `value` less two axes."""
    r, az = np.radians(radial_deg), np.radians(azimuth_deg)
    inner = np.trapezoid(value * np.maximum(wr[..., 2], 0.0) * np.sin(r), r, axis=-1)
    return np.asarray(np.trapezoid(inner, az, axis=-1) * (2.0 if symmetric else 1.0))
