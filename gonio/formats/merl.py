"""MERL ``.binary``: an isotropic BRDF on 90 x 90 x 180 half and difference angles, three colour planes.

Little-endian ``int32`` 90, 90, 180, then the planes red, green, blue of float64, each ordered theta_h, theta_d, phi_d
(fastest). Bin k of theta_h begins at k^2/90 degrees, of theta_d and phi_d at k degrees; phi_d covers half a turn, as the
other half is reciprocal. f_r [1/sr] = stored value times 1/1500, 1.15/1500, 1.66/1500. A negative value marks a direction
pair below the horizon or one never measured.

The database's own code, and most readers after it, give every direction pair of a bin the bin's one value. So what is
written is the bin's mean, weighted with cos(theta_i) cos(theta_r) d omega_i d omega_r as far as it is above the horizon:
then such a reader reflects the right energy. (Values at the edges of bins would make a metal of alpha = 0.1 reflect 7 % too
much.) A program that takes the lower edges for nodes and interpolates sees the lobe shifted by half a bin; docs/formats.md
has the figures. Read are values at the centres of bins. A single channel is written three times, and read as one.

References
----------
.. [1] W. Matusik, H. Pfister, M. Brand, L. McMillan, "A Data-Driven Reflectance Model", ACM TOG 22(3), 2003, and the
   reading code distributed with the MERL BRDF database.
.. [2] M. Roberts, "The Unreasonable Effectiveness of Quasirandom Sequences", 2018 (the additive recurrence R_d).
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gonio import files
from gonio.brdf.base import BRDF
from gonio.channels import RGB, SINGLE, ChannelSamples
from gonio.errors import DatasetError
from gonio.formats.material import Material
from gonio.halfdiff import directions

Array = NDArray[np.float64]
SHAPE = (90, 90, 180)
CELLS = 90 * 90 * 180
SCALE = (1.0 / 1500.0, 1.15 / 1500.0, 1.66 / 1500.0)
HEADER = np.array(SHAPE, dtype="<i4").tobytes()
SIZE = 12 + 3 * CELLS * 8
LOWEST = 0.035  # cosine, of 88 degrees, below which a bin is not read
DRAWS = 30_000  # bins looked at when a file is thinned to samples


def sniff(head: bytes) -> bool:
    """The three sizes open the file."""
    return head[:12] == HEADER


def read(path: Path) -> ChannelSamples:
    """About 20 000 RGB samples at the centres of bins, spread evenly over the table's coordinates by an R3 sequence [2]_.

    Scattered bins rather than every n-th: a fit or a table learns more from them, and leave-one-out errors mean something.
    Without uncertainty (NaN), which the format cannot hold.
    """
    planes = read_planes(path)
    take = _scattered()
    stored = np.stack([plane[tuple(take)] for plane in planes], axis=-1)
    value = np.where(stored >= 0, stored * np.array(SCALE), np.nan)
    theta_h, theta_d, phi_d = edges()
    low = theta_h[take[0]], theta_d[take[1]], phi_d[take[2]]  # (n,) each
    high = theta_h[take[0] + 1], theta_d[take[1] + 1], phi_d[take[2] + 1]
    h, d, p = (0.5 * (a + b) for a, b in zip(low, high, strict=True))
    omega_i, omega_r = directions(h, np.zeros_like(h), d, p)
    # the corner nearest the horizon: where f_r cos cos bends within a bin, its mean is not the value at its centre
    corner = directions(high[0], np.zeros_like(h), high[1], np.where(p < np.pi / 2, low[2], high[2]))
    above = (corner[0][..., 2] > LOWEST) & (corner[1][..., 2] > LOWEST)
    valid = np.all(stored >= 0, axis=-1)
    keep = above & np.any(stored >= 0, axis=-1)
    if not np.any(keep):
        raise DatasetError(f"{path}: no value is valid; the file holds no BRDF")
    theta_i, theta_r = (np.arccos(np.clip(w[..., 2], -1, 1))[keep] for w in (omega_i, omega_r))
    phi_i, phi_r = (np.mod(np.arctan2(w[..., 1], w[..., 0]), 2 * np.pi)[keep] for w in (omega_i, omega_r))
    value, channels = value[keep], RGB
    if np.allclose(value, value[:, 1:2], rtol=1e-13, atol=0.0, equal_nan=True):
        value, channels = value[:, 1:2], SINGLE
    attributes = {
        "quantity": "brdf",
        "source_quantity": "brdf, linear RGB" if channels is RGB else "brdf, three equal channels read as one",
        "source_format": "merl",
        "n_missing": str(int(np.count_nonzero(above & ~valid))),
        "thinning": f"{np.count_nonzero(keep)} of {CELLS} bins, scattered evenly, at their centres",
    }
    return ChannelSamples.make(theta_i, phi_i, theta_r, phi_r, value, channels, attributes=attributes)


def read_planes(path: Path) -> Array:
    """The stored values, shape (3, 90, 90, 180): red, green, blue; not scaled, negative where invalid."""
    size = files.size_of(path)
    head = files.head(path, 12)
    sizes = [int(n) for n in np.frombuffer(head, dtype="<i4")] if len(head) == 12 else []
    if head != HEADER:
        raise DatasetError(f"{path} begins with the sizes {sizes}, a MERL file with {list(SHAPE)}; it is no MERL file")
    if size != SIZE:
        raise DatasetError(f"{path} has {size} bytes, a MERL file has {SIZE}; it is cut or damaged: fetch it again")
    data = np.frombuffer(files.read_bytes(path), dtype="<f8", offset=12).astype(float)
    if not np.all(np.isfinite(data)):
        bad = int(np.flatnonzero(~np.isfinite(data))[0])
        raise DatasetError(f"{path}: value {bad} of {data.size} is not finite; the file is damaged")
    if float(np.abs(data).max()) > 1e12:
        raise DatasetError(f"{path}: a value of {np.abs(data).max():g} is no reflectance; the file is damaged")
    return data.reshape(3, *SHAPE)


def edges() -> tuple[Array, Array, Array]:
    """Bin edges of theta_h (91,), theta_d (91,) and phi_d (181,) [rad]."""
    k = np.arange(91.0)
    return np.radians(k * k / 90.0), np.radians(k), np.radians(np.arange(181.0))


def write(path: Path, material: Material) -> None:
    """Write an isotropic material: linear RGB, or one channel three times.

    Raises
    ------
    DatasetError
        If the file cannot be written, the material has a grain, or its values are not finite.
    """
    if not material.isotropic:
        raise DatasetError(f"{path}: a MERL file holds isotropic BRDFs only; choose rgl, ssdd or a format of rows")
    if material.channels.kind == "xyz":
        raise DatasetError(f"{path}: a MERL file holds linear RGB, these data are X, Y, Z; export one channel")
    if material.channels.kind != "rgb":
        material = material.one()
    planes = [bin_means(brdf) for brdf in material.brdfs]
    if not all(np.all(np.isfinite(plane)) for plane in planes):
        raise DatasetError(f"{path}: the BRDF is not finite everywhere, so no MERL file can be made from it")
    pairs = zip(planes * (3 // len(planes)), SCALE, strict=True)
    stored = np.concatenate([np.where(values >= 0, values / scale, -1.0).ravel() for values, scale in pairs])

    def put(temporary: Path) -> None:
        temporary.write_bytes(HEADER + stored.astype("<f8").tobytes())

    files.replace_atomically(path, put)


def bin_means(brdf: BRDF) -> Array:
    """Mean f_r [1/sr] of each bin, shape (90, 90, 180); -1 where a whole bin is below the horizon.

    Gauss's rule of two points along each angle. A bin whose points are all below the horizon, though a corner of it is
    above, holds the value at its highest corner.
    """
    theta_h, theta_d, phi_d = edges()
    inside = np.array([0.5 - math.sqrt(1 / 12), 0.5 + math.sqrt(1 / 12)])
    one = np.radians(1.0)
    d = (theta_d[:90, None] + one * inside).reshape(-1, 1)
    p = (phi_d[:180, None] + one * inside).reshape(-1)
    along, across, up = np.sin(d) * np.cos(p), np.sin(d) * np.sin(p), np.cos(d) + 0.0 * p  # the difference vector (180, 360)
    out = np.full(SHAPE, -1.0)
    for row in range(SHAPE[0]):
        h = (theta_h[row] + (theta_h[row + 1] - theta_h[row]) * inside)[:, None, None]
        c, s = np.cos(h), np.sin(h)
        cos_i, cos_r = c * up - s * along, c * up + s * along  # (2, 180, 360)
        above = (cos_i > 0) & (cos_r > 0)
        # d omega_i d omega_r = 4 cos(theta_d) d omega_h d omega_d
        weight = np.where(above, s * np.sin(d) * up * cos_i * cos_r, 0.0)
        wi = np.stack((c * along + s * up, across + 0.0 * h, cos_i), axis=-1)[above]
        wr = np.stack((s * up - c * along, 0.0 * h - across, cos_r), axis=-1)[above]
        energy = np.zeros_like(weight)
        energy[above] = weight[above] * brdf.evaluate(wi, wr)
        total, sums = (x.reshape(2, 90, 2, 180, 2).sum(axis=(0, 2, 4)) for x in (weight, energy))
        known = total > 0
        out[row][known] = sums[known] / total[known]
        k, j = np.nonzero(~known)
        # towards phi_d = 90 degrees both directions rise
        highest = np.where(phi_d[j] < np.pi / 2, phi_d[j] + one * (1 - 1e-9), phi_d[j])
        wi, wr = directions(np.full(k.shape, theta_h[row]), 0.0, theta_d[k], highest)
        corner = (wi[:, 2] > 1e-12) & (wr[:, 2] > 1e-12)
        if np.any(corner):
            out[row][k[corner], j[corner]] = brdf.evaluate(wi[corner], wr[corner])
    return out


def _scattered() -> NDArray[np.int64]:
    """Bin numbers along theta_h, theta_d, phi_d, shape (3, n): distinct direction pairs, evenly over the table's axes."""
    ratio = 1.2207440846057596  # the real root of x^4 = x + 1
    step = ratio ** -np.arange(1.0, 4.0)
    a, b, c = np.mod(0.5 + np.arange(1.0, DRAWS + 1)[:, None] * step, 1.0).T
    # bins k of theta_h = 2 atan(a^2) = k^2/90 degrees, theta_d = 2 atan(b); phi_d evenly over half a turn
    k_h = np.sqrt(90.0 * np.degrees(2.0 * np.arctan(a * a))).astype(np.int64)
    k_d = np.degrees(2.0 * np.arctan(b)).astype(np.int64)
    k_p = (180.0 * c).astype(np.int64)
    k_p[(k_h == 0) | (k_d == 0)] = 0  # there all phi_d are one direction pair
    return np.asarray(np.unique(np.stack((k_h, k_d, k_p)), axis=1))
