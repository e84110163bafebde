r"""Several numbers at each pair of directions: colour channels or wavelengths.

`BRDFSamples` and `gonio.brdf` know one channel; a data set of many is `ChannelSamples`, and `ChannelSamples.channel` takes
one out. Conversion between colour spaces is for linear RGB with the primaries of Rec. ITU-R BT.709 and D65 only.

References
----------
.. [1] Rec. ITU-R BT.709-6, 2015 (primaries, luminance).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gonio.errors import ConfigurationError, DatasetError
from gonio.samples import BRDFSamples

Array = NDArray[np.float64]
PHOTOPIC_PEAK_NM = 555.0
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # Y of linear RGB, BT.709
# XYZ of linear RGB, from the chromaticities of BT.709 and D65
RGB_TO_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)


@dataclass(frozen=True)
class Channels:
    """What the columns of a data set are.

    Attributes
    ----------
    names : tuple of str
        ``("value",)``, ``("red", "green", "blue")``, ``("X", "Y", "Z")``, or wavelengths such as ``("450nm", "550nm")``.
    wavelengths_nm : tuple of float, optional
        Of spectral channels.
    """

    names: tuple[str, ...]
    wavelengths_nm: tuple[float, ...] | None = None

    def __len__(self) -> int:
        return len(self.names)

    @property
    def kind(self) -> str:
        """``"single"``, ``"rgb"``, ``"xyz"`` or ``"spectral"``."""
        if self.wavelengths_nm is not None:
            return "spectral"
        return {RGB.names: "rgb", XYZ.names: "xyz"}.get(self.names, "single")

    @property
    def main(self) -> int:
        """The channel for whoever wants one that is stored: Y, green, or the wavelength nearest to 555 nm."""
        if self.wavelengths_nm is not None:
            return int(np.argmin(np.abs(np.array(self.wavelengths_nm) - PHOTOPIC_PEAK_NM)))
        return 1 if self.kind in ("rgb", "xyz") else 0

    def index(self, name: str) -> int:
        """Number of a channel, or a `ConfigurationError` that lists them."""
        if name not in self.names:
            shown = ", ".join(self.names[:12]) + (", ..." if len(self) > 12 else "")
            raise ConfigurationError(f"there is no channel {name!r}; choose one of: {shown}")
        return self.names.index(name)


SINGLE = Channels(("value",))
RGB = Channels(("red", "green", "blue"))
XYZ = Channels(("X", "Y", "Z"))


def spectral(wavelengths_nm: ArrayLike, where: str = "the data") -> Channels:
    """Channels of wavelengths [nm]; `DatasetError` beginning with `where` if one is not positive or stands twice."""
    given = [float(w) for w in np.atleast_1d(np.asarray(wavelengths_nm, dtype=float))]
    bad = [w for w in given if not 0 < w <= 1e6]
    if bad:
        raise DatasetError(f"{where}: a wavelength is not between 0 and 1e6 nm: {bad[0]:g}; the file is damaged")
    if len(set(given)) != len(given):
        raise DatasetError(f"{where}: a wavelength stands twice; each may have one channel")
    return Channels(tuple(f"{w:.10g}nm" for w in given), tuple(given))


def from_names(names: tuple[str, ...], where: str) -> Channels:
    """Channels from column names of files: R G B, X Y Z, 550nm, or a single one of any name."""
    lower = tuple(name.lower() for name in names)
    if lower in (("r", "g", "b"), RGB.names):
        return RGB
    if lower == ("x", "y", "z"):
        return XYZ
    if lower and all(name.endswith("nm") for name in lower):
        try:
            return spectral([float(name[:-2]) for name in lower], where)
        except ValueError:
            pass
    if len(names) == 1:
        return SINGLE
    raise DatasetError(f"{where}: channels {', '.join(names[:6])!r} are unknown; known are R,G,B, X,Y,Z, wavelengths in nm")


@dataclass(frozen=True)
class ChannelSamples:
    """Scattered samples of a BRDF in one or more channels.

    Attributes
    ----------
    theta_i, phi_i, theta_r, phi_r : ndarray, shape (n,)
        [rad], as in `BRDFSamples`.
    f_r, u_f_r : ndarray, shape (n, c)
        BRDF and its standard uncertainty [1/sr]; f_r is NaN where a channel was not measured, u_f_r where it is unknown.
    channels : Channels, length c
    attributes : mapping of str to str
    """

    theta_i: Array
    phi_i: Array
    theta_r: Array
    phi_r: Array
    f_r: Array
    u_f_r: Array
    channels: Channels
    attributes: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n, c = len(self.theta_i), len(self.channels)
        for name in ("f_r", "u_f_r"):
            if getattr(self, name).shape != (n, c):
                raise DatasetError(f"samples: {name} has shape {getattr(self, name).shape}, needed is {(n, c)}")
        if np.any(np.isinf(self.f_r)):
            raise DatasetError("samples: a value of f_r is infinite; the file is damaged")

    def __len__(self) -> int:
        return len(self.theta_i)

    @classmethod
    def make(
        cls, theta_i: ArrayLike, phi_i: ArrayLike, theta_r: ArrayLike, phi_r: ArrayLike, f_r: ArrayLike,
        channels: Channels = SINGLE, u_f_r: ArrayLike | None = None, attributes: Mapping[str, str] | None = None,
    ) -> ChannelSamples:  # fmt: skip
        """Samples from arrays; f_r of shape (n, c), or (n,) for one channel; azimuths are folded into [0, 2 pi)."""
        value = np.array(f_r, dtype=float)
        value = value[:, None] if value.ndim == 1 else value
        given = (theta_i, phi_i, theta_r, phi_r)
        angles = [np.array(np.broadcast_to(np.asarray(a, dtype=float), value.shape[:1])) for a in given]
        u = np.full(value.shape, np.nan) if u_f_r is None else np.array(u_f_r, dtype=float).reshape(value.shape)
        for k in (1, 3):
            angles[k] = np.where((angles[k] >= 0) & (angles[k] < 2 * np.pi), angles[k], np.mod(angles[k], 2 * np.pi))
            angles[k] = np.where(angles[k] >= 2 * np.pi, 0.0, angles[k])
        return cls(angles[0], angles[1], angles[2], angles[3], value, u, channels, dict(attributes or {}))

    @classmethod
    def of(cls, samples: BRDFSamples) -> ChannelSamples:
        """One channel; poses and shared errors are left behind."""
        wavelength = samples.attributes.get("wavelength_nm", "")
        channels = spectral([float(wavelength)]) if wavelength.replace(".", "", 1).isdigit() else SINGLE
        return cls(
            samples.theta_i, samples.phi_i, samples.theta_r, samples.phi_r, samples.f_r[:, None], samples.u_f_r[:, None],
            channels, samples.attributes,
        )  # fmt: skip

    def select(self, mask: NDArray[np.bool_] | NDArray[np.int64]) -> ChannelSamples:
        """The samples of a mask or of an index array."""
        names = ("theta_i", "phi_i", "theta_r", "phi_r", "f_r", "u_f_r")
        return replace(self, **{name: getattr(self, name)[mask] for name in names})

    def channel(self, which: str | None = None) -> BRDFSamples:
        """One channel, without the directions at which it was not measured.

        Parameters
        ----------
        which : str, optional
            A name of `channels`, or ``"luminance"`` of RGB. By default the luminance of RGB, Y of XYZ, the wavelength
            nearest to 555 nm.
        """
        attributes = dict(self.attributes)
        if self.channels.kind == "rgb" and which in (None, "luminance"):
            value, u = self.f_r @ LUMINANCE, np.sqrt(self.u_f_r**2 @ LUMINANCE**2)
            name = "luminance of linear RGB"
        else:
            k = self.channels.main if which is None else self.channels.index(which)
            value, u, name = self.f_r[:, k], self.u_f_r[:, k], self.channels.names[k]
            if self.channels.wavelengths_nm is not None:
                attributes["wavelength_nm"] = f"{self.channels.wavelengths_nm[k]:.10g}"
        if len(self.channels) > 1:
            attributes["channel"] = name
            attributes["n_channels"] = str(len(self.channels))
        keep = np.isfinite(value)
        if not np.any(keep):
            raise DatasetError(f"channel {name} has no valid value; choose another one")
        return BRDFSamples.plain(
            self.theta_i[keep], self.phi_i[keep], self.theta_r[keep], self.phi_r[keep], value[keep], u[keep], attributes
        )

    def all_channels(self) -> tuple[BRDFSamples, ...]:
        """`channel` of each."""
        return tuple(self.channel(name) for name in self.channels.names)
