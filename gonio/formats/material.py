"""What the grid formats are written from: a BRDF that can be asked anywhere, in one or more channels.

And the directions at which formats that list rows are filled when there are no samples of their own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gonio.brdf.base import BRDF
from gonio.channels import RGB_TO_XYZ, SINGLE, XYZ, Channels, ChannelSamples
from gonio.errors import DatasetError
from gonio.geometry import angles

Array = NDArray[np.float64]
INCIDENCES_DEG = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0)
LOWEST = 1e-9  # cosine below which a direction counts as at the horizon


@dataclass(frozen=True)
class Material:
    """A BRDF for each channel.

    Attributes
    ----------
    brdfs : tuple of BRDF
    channels : Channels
    u : tuple of BRDF, optional
        Standard uncertainty of each, to be evaluated as a BRDF is [1/sr].
    attributes : mapping of str to str
        Origin, material, coverage; written into the header where a format has one.
    mix : ndarray, shape (c, len(brdfs)), optional
        Channels are these sums of the BRDFs; by default each is one.
    """

    brdfs: tuple[BRDF, ...]
    channels: Channels = SINGLE
    u: tuple[BRDF, ...] | None = None
    attributes: Mapping[str, str] = field(default_factory=dict)
    mix: Array | None = None

    def __post_init__(self) -> None:
        if len(self.brdfs) != (len(self.channels) if self.mix is None else self.mix.shape[1]):
            raise DatasetError(f"a material of {len(self.channels)} channels needs as many BRDFs, got {len(self.brdfs)}")

    @property
    def isotropic(self) -> bool:
        """Whether no term knows an azimuth."""
        return all(term.model.isotropic for brdf in self.brdfs for term in brdf.terms)

    @property
    def reciprocal(self) -> bool:
        """Whether every term declares it."""
        return all(term.model.reciprocal for brdf in self.brdfs for term in brdf.terms)

    def lobe_width(self) -> float:
        """Half width of the narrowest lobe in half-vector angle [rad]; 1 without one."""
        widths = [term.lobe_width() for brdf in self.brdfs for term in brdf.terms]
        return min([w for w in widths if w is not None], default=1.0)

    def evaluate(self, omega_i: Array, omega_r: Array) -> Array:
        """f_r [1/sr], shape (c, ...); `DatasetError` where a value is not finite or negative."""
        out = np.stack([np.asarray(brdf.evaluate(omega_i, omega_r)) for brdf in self.brdfs])
        if not np.all(np.isfinite(out)):
            raise DatasetError("the BRDF is not finite everywhere, so no file can be made from it; check its parameters")
        return out if self.mix is None else np.tensordot(self.mix, out, axes=1)

    def tristimulus(self) -> Material:
        """As X, Y, Z from linear RGB; itself if it is XYZ already."""
        if self.channels.kind == "xyz":
            return self
        if self.channels.kind != "rgb":
            raise DatasetError("only linear RGB becomes X, Y, Z; choose one channel instead")
        return Material(self.brdfs, XYZ, None, self.attributes, RGB_TO_XYZ)

    def one(self, which: int | None = None) -> Material:
        """One channel of it, the main one by default."""
        k = self.channels.main if which is None else which
        if self.mix is not None:
            return Material(self.brdfs, Channels((self.channels.names[k],)), None, self.attributes, self.mix[k : k + 1])
        names = (self.channels.names[k],)
        waves = None if self.channels.wavelengths_nm is None else (self.channels.wavelengths_nm[k],)
        u = None if self.u is None else (self.u[k],)
        return Material((self.brdfs[k],), Channels(names, waves), u, self.attributes)

    def samples(self, omega_i: Array, omega_r: Array) -> ChannelSamples:
        """Rows (n,) at pairs of directions (n, 3) above the horizon."""
        theta_i, phi_i = angles(omega_i)
        theta_r, phi_r = angles(omega_r)
        u = None
        if self.u is not None:
            u = np.stack([np.asarray(b.evaluate(omega_i, omega_r)) for b in self.u], axis=-1)
        value = self.evaluate(omega_i, omega_r).T
        return ChannelSamples.make(theta_i, phi_i, theta_r, phi_r, value, self.channels, u, self.attributes)

    def rows(self) -> ChannelSamples:
        """Rows on a grid around the mirror direction of nine incidences, dense where the lobe is narrow."""
        wi, wr = row_directions(self.lobe_width(), self.isotropic)
        return self.samples(wi, wr)


def radial_deg(lobe_width: float, most: float, largest: float = 5.0) -> Array:
    """Angles from the mirror direction [deg] from 0: even steps within the lobe, then growing ones, at most `largest`."""
    step = float(np.clip(np.degrees(2.0 * lobe_width) / 4.0, 0.02, 2.5))  # the reflected lobe is twice as wide
    out = [0.0]
    while out[-1] < most - 1e-9:
        grown = step * max(1.0, out[-1] / (8.0 * step))
        out.append(min(round(out[-1] + min(grown, largest), 6), most))
    return np.array(out)


def around_mirror(theta: Array, azimuth: Array, radial: Array) -> Array:
    """Unit vectors at a radial angle from the mirror direction, shape of the broadcast angles plus (3,).

    Light comes from azimuth 0 at polar angle `theta`; azimuth 0 about the mirror direction points towards the normal,
    counter-clockwise seen against the specular ray. All in radians.
    """
    along = np.cos(azimuth) * np.sin(radial)
    x = -np.sin(theta) * np.cos(radial) + np.cos(theta) * along
    y = np.broadcast_to(np.sin(azimuth) * np.sin(radial), x.shape)
    z = np.cos(theta) * np.cos(radial) + np.sin(theta) * along
    return np.stack((x, y, z), axis=-1)


def row_directions(
    lobe_width: float, isotropic: bool, incidences_deg: Sequence[float] = INCIDENCES_DEG
) -> tuple[Array, Array]:
    """Pairs of directions (n, 3) for formats that list rows; three tangents if the BRDF is anisotropic."""
    radial = np.radians(radial_deg(lobe_width, 175.0))
    pairs_i, pairs_r = [], []
    turns = [0.0] if isotropic else list(np.radians(np.arange(0.0, 360.0, 30.0)))
    for turn in turns:
        c, s = np.cos(turn), np.sin(turn)
        spin = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        for theta in np.radians(np.array(incidences_deg)):
            if theta == 0.0 and turn > 0.0:
                continue  # the same directions again
            azimuth = np.radians(np.arange(0.0, 360.0 if not isotropic else 181.0, 15.0))
            wr = around_mirror(theta, azimuth[:, None], radial)
            once = np.ones(wr.shape[:2], dtype=bool)
            once[1:, 0] = False  # the mirror direction, once
            wr = wr[once & (wr[..., 2] > 0.02)]
            wi = np.broadcast_to([np.sin(theta), 0.0, np.cos(theta)], wr.shape)
            pairs_i.append(wi @ spin.T)
            pairs_r.append(wr @ spin.T)
    return np.concatenate(pairs_i), np.concatenate(pairs_r)
