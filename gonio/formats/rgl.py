r"""RGL's measured BRDF (``.bsdf``), as Mitsuba's ``measured`` reads it: RGB or spectral, isotropic or not.

A tensor file whose value table is :math:`f_r\cos\theta_r`, divided by ndf/(4 sigma) where the flag ``jacobian`` is set, on
a square that a warp (``vndf``) maps to half vectors: :math:`u_\theta=\sqrt{2\theta_h/\pi}`,
:math:`u_\phi=(\phi_h-\phi_i+\pi)/2\pi`; in anisotropic files, which have more than two ``phi_i``, the azimuth is absolute.

Written is the identity warp, with ``ndf = 4``, ``sigma = 1`` and ``jacobian = 1``, which every reader takes the same way,
even those that ignore the flag: the table is :math:`f_r\cos\theta_r` itself on a regular grid, 0 where a direction is
below the horizon. ``luminance`` is the density by which Mitsuba samples. Values are float32. One channel is written as
three equal ones.

Read is any such file: samples stand at the warped grid nodes. Real files hold negative RGB (out of gamut) and are
reciprocal to some 10 % only; nothing is mended here.

References
----------
.. [1] J. Dupuy, W. Jakob, "An Adaptive Parameterization for Efficient Material Acquisition and Rendering", ACM TOG 37(6),
   2018. doi:10.1145/3272127.3275059
.. [2] mitsuba-renderer/mitsuba3, src/bsdfs/measured.cpp, include/mitsuba/core/distr_2d.h (the warp).
.. [3] C. de Boor, "Good approximation by splines with variable knots", 1973 (knots for the L2 norm).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gonio.channels import RGB, Channels, ChannelSamples, spectral
from gonio.errors import DatasetError
from gonio.formats import rows, tensor
from gonio.formats.material import Material
from gonio.geometry import angles, unit_vector

Array = NDArray[np.float64]
MOST_ROWS = 3_000_000
SEEN = 0.17  # cos(theta_r) above which the choice of incidences minds the error
LOWEST = 1e-3  # cos(theta_r) below which f_r cannot be had from f_r cos(theta_r) in float32


def sniff(head: bytes) -> bool:
    """The container's mark."""
    return head[:12] == tensor.MAGIC


def half_vectors(n: int) -> tuple[Array, Array]:
    """theta_h (n,) and phi_h - phi_i (n,) [rad] of the regular grid."""
    u = np.linspace(0.0, 1.0, n)
    return u * u * np.pi / 2, (2.0 * u - 1.0) * np.pi


def incidences(n: int, material: Material) -> Array:
    """n incident polar angles [rad] from 0 to 89.5 degrees, closer where the material's table bends more.

    Readers interpolate linearly between them at a fixed half vector. The error of a chord is h^2/8 times the second
    derivative, so its mean square is smallest where the density of nodes goes as the 2/5th power of that [3]_.
    """
    theta = np.radians(np.linspace(0.0, 89.5, 180))
    theta_h, phi_h = half_vectors(32)
    bend = np.zeros(len(theta))
    for azimuth in (0.0,) if material.isotropic else (0.0, np.pi / 3, 2 * np.pi / 3):
        m = unit_vector(theta_h[None, :], phi_h[:, None] + (azimuth if material.isotropic else 0.0)).reshape(-1, 3)
        g = np.full((len(theta), len(material.channels), len(m)), np.nan)
        for t, polar in enumerate(theta):
            wi = unit_vector(polar, azimuth)
            wr = 2.0 * (m @ wi)[:, None] * m - wi
            up = (m @ wi > 0) & (wr[:, 2] > SEEN)
            g[t][:, up] = material.evaluate(np.broadcast_to(wi, wr[up].shape), wr[up]) * wr[up][:, 2]
        size = np.maximum(g[1:-1], 1e-3 * np.nanmax(g) + 1e-300)
        bend[1:-1] += np.nanmean(((g[2:] - 2.0 * g[1:-1] + g[:-2]) / size) ** 2, axis=(1, 2))
    bend[0], bend[-1] = bend[1], bend[-2]
    wide = np.convolve(np.pad(np.sqrt(bend), 2, mode="edge"), np.full(5, 0.2), mode="valid")
    density = wide**0.4
    density = np.maximum(density, 0.3 * density.mean()) + 1e-9
    reached = np.concatenate(([0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))))
    return np.interp(np.linspace(0.0, reached[-1], n), reached, theta)


def write(path: Path, material: Material, attributes: Mapping[str, str] | None = None) -> None:
    """Write a material: spectral if it is, else RGB; anisotropic with incident azimuths if it is."""
    channels = material.channels
    if channels.kind == "xyz":
        raise DatasetError(f"{path}: an RGL file holds RGB or a spectrum, these data are X, Y, Z; convert them to RGB first")
    width = material.lobe_width()
    n = 192 if width < 0.03 else 128 if width < 0.3 else 64
    theta_i, phi_i = incidences(72, material), np.zeros(1)
    if not material.isotropic:  # as many as `read` takes
        n, theta_i, phi_i = 64, incidences(24, material), np.linspace(-np.pi, np.pi, 25)
    theta_h, phi_h = half_vectors(n)
    m = unit_vector(theta_h[None, :], phi_h[:, None])  # (n phi, n theta, 3)
    copies = 3 if channels.kind == "single" else 1
    value = np.empty((len(phi_i), len(theta_i), len(channels) * copies, n, n), dtype=np.float32)
    luminance = np.empty((len(phi_i), len(theta_i), n, n), dtype=np.float32)
    u_theta = np.linspace(0.0, 1.0, n)
    for p, azimuth in enumerate(phi_i):
        for t, polar in enumerate(theta_i):
            wi = unit_vector(polar, azimuth)
            dot = m @ wi
            wr = 2.0 * dot[..., None] * m - wi
            up = (dot > 0) & (wr[..., 2] > 0)
            f = np.zeros((len(channels), n, n))
            f[:, up] = material.evaluate(np.broadcast_to(wi, wr[up].shape), wr[up]) * wr[up][:, 2]
            value[p, t] = np.repeat(f, copies, axis=0)
            # density on the square: f cos times d(omega_r)/d(u)
            area = np.maximum(2.0 * np.pi**2 * u_theta * np.sin(theta_h), 1e-6) * 4.0 * np.maximum(dot, 0.0)
            luminance[p, t] = f.mean(axis=0) * area + 1e-4
    told = {**material.attributes, **(attributes or {})}
    text = "BRDF f_r cos(theta_r) [1/sr]; " + "; ".join(f"{k}: {v}" for k, v in sorted(told.items()))
    fields: dict[str, NDArray[np.generic]] = {
        "description": np.frombuffer(rows.one_line(text, 4000).encode(), dtype="u1"),
        "theta_i": theta_i.astype("<f4"),
        "phi_i": phi_i.astype("<f4"),
        "ndf": np.full((2, 2), 4.0, dtype="<f4"),
        "sigma": np.ones((2, 2), dtype="<f4"),
        "vndf": np.ones((len(phi_i), len(theta_i), 2, 2), dtype="<f4"),
        "luminance": luminance,
        "jacobian": np.ones(1, dtype="u1"),
    }
    if channels.wavelengths_nm is None:
        fields["rgb"] = value
    else:
        order = np.argsort(channels.wavelengths_nm)
        fields["spectra"] = np.ascontiguousarray(value[:, :, order])
        fields["wavelengths"] = np.array(channels.wavelengths_nm, dtype="<f4")[order]
    rows.put(path, tensor.pack(fields))


def read(path: Path) -> ChannelSamples:
    """Samples at the nodes of the value table; `DatasetError` if a field is missing, misshapen or not finite."""
    with np.errstate(invalid="ignore", over="ignore"):  # of numbers that are then refused
        fields, channels, value = _fields(path)
    theta_i, phi_i = (np.asarray(fields[name], dtype=float) for name in ("theta_i", "phi_i"))
    isotropic = len(phi_i) <= 2
    vndf = np.asarray(fields["vndf"], dtype=float)
    scaled = int(np.asarray(fields["jacobian"]).ravel()[0]) == 1
    n = value.shape[-1]
    s = np.stack(np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n)), axis=-1).reshape(-1, 2)  # x, y
    found: list[list[Array]] = [[], [], []]
    for p, azimuth in enumerate(phi_i):
        for t, polar in enumerate(theta_i):
            wi = unit_vector(polar, azimuth)
            u = _warp(vndf[p, t], s)
            theta_h, phi_h = u[:, 0] ** 2 * np.pi / 2, (2 * u[:, 1] - 1) * np.pi + (azimuth if isotropic else 0.0)
            m = unit_vector(theta_h, phi_h)
            dot = m @ wi
            wr = 2.0 * dot[:, None] * m - wi
            keep = (dot > 0) & (wr[:, 2] > LOWEST)
            keep[(u[:, 1] == 1.0) | ((u[:, 0] == 0.0) & (u[:, 1] > 0.0))] = False  # the seam and the pole, once
            factor = np.ones(len(u))
            if scaled:
                at = np.array([[np.sqrt(2 * polar / np.pi), (azimuth + np.pi) / (2 * np.pi)]])
                ndf, sigma = (np.asarray(fields[name], dtype=float) for name in ("ndf", "sigma"))
                factor = _bilinear(ndf, u) / (4.0 * np.maximum(_bilinear(sigma, at)[0], 1e-12))
            f = value[p, t].reshape(len(channels), -1).T * factor[:, None]
            found[0].append(np.broadcast_to(wi, wr.shape)[keep])
            found[1].append(wr[keep])
            found[2].append(f[keep] / wr[keep][:, 2:])
    wi, wr, f = (np.concatenate(part) for part in found)
    if not len(f):
        raise DatasetError(f"{path} holds no value above the horizon")
    if channels is RGB and np.array_equal(f[:, 0], f[:, 1]) and np.array_equal(f[:, 0], f[:, 2]):
        f, channels = f[:, :1], Channels(("value",))
    attributes = {
        "quantity": "brdf",
        "source_quantity": "brdf_cos, divided by cos(theta_r)",
        "source_format": "rgl",
        "jacobian": str(scaled).lower(),
        "n_negative": str(int(np.count_nonzero(f < 0))),
    }
    theta, phi = angles(wi)
    theta_r, phi_r = angles(wr)
    return ChannelSamples.make(theta, phi, theta_r, phi_r, f, channels, attributes=attributes)


def _fields(path: Path) -> tuple[tensor.Fields, Channels, Array]:
    """Fields with shapes that fit each other, channels, values (p, t, c, n, n)."""
    fields = tensor.read(path)
    shapes = {"theta_i": 1, "phi_i": 1, "vndf": 4, "ndf": 2, "sigma": 2}
    for name, dimensions in shapes.items():
        if name not in fields:
            raise DatasetError(f"{path}: the field {name} is missing; it is no measured BRDF")
        if fields[name].ndim != dimensions or fields[name].size == 0 or fields[name].dtype.kind != "f":
            raise DatasetError(f"{path}: the field {name} has shape {fields[name].shape}; it is no measured BRDF")
    fields.setdefault("jacobian", np.zeros(1, dtype="u1"))
    kind = "rgb" if "rgb" in fields else "spectra"
    if kind not in fields or fields[kind].ndim != 5 or fields["jacobian"].size != 1:
        raise DatasetError(f"{path} has neither a table rgb nor spectra of five dimensions; it is no measured BRDF")
    value = np.asarray(fields[kind], dtype=float)
    p, t, c, n, n2 = value.shape
    head = (len(fields["phi_i"]), len(fields["theta_i"]))
    if (p, t) != head or fields["vndf"].shape[:2] != head or n != n2 or n < 2 or min(fields["vndf"].shape[2:]) < 2:
        raise DatasetError(f"{path}: {kind} {value.shape}, vndf {fields['vndf'].shape} and {head} incidences do not fit")
    if p * t * n * n > MOST_ROWS:
        raise DatasetError(f"{path} has {p * t * n * n} values per channel, at most {MOST_ROWS} are read; thin the file")
    if kind == "rgb" and c != 3:
        raise DatasetError(f"{path}: rgb has {c} channels; the file is damaged")
    for name in (*shapes, kind):
        if not np.all(np.isfinite(np.asarray(fields[name], dtype=float))):
            raise DatasetError(f"{path}: a value of {name} is not finite; the file is damaged")
    theta, phi = (np.asarray(fields[name], dtype=float) for name in ("theta_i", "phi_i"))
    if np.any(theta < 0) or np.any(theta > np.pi / 2 + 1e-6) or np.any(np.abs(phi) > 2 * np.pi + 1e-6):
        raise DatasetError(f"{path}: theta_i or phi_i is outside its range; the file is damaged")
    vndf = np.asarray(fields["vndf"], dtype=float)
    if np.any(vndf < 0) or np.any(vndf.sum(axis=(2, 3)) <= 0):
        raise DatasetError(f"{path}: vndf is negative or 0 everywhere; the file is damaged")
    if kind == "rgb":
        return fields, RGB, value
    waves = fields.get("wavelengths")
    if waves is None or waves.shape != (c,) or not np.all(np.isfinite(waves.astype(float))):
        raise DatasetError(f"{path}: wavelengths do not fit the {c} spectra; the file is damaged")
    return fields, spectral(waves.astype(float), str(path)), value


def _bilinear(table: Array, u: Array) -> Array:
    """Table (h, w) at positions u (n, 2) = (x along w, y along h), both in [0, 1]."""
    h, w = table.shape
    x, y = np.clip(u[:, 0], 0, 1) * (w - 1), np.clip(u[:, 1], 0, 1) * (h - 1)
    i, j = np.minimum(x.astype(int), max(w - 2, 0)), np.minimum(y.astype(int), max(h - 2, 0))
    i1, j1 = np.minimum(i + 1, w - 1), np.minimum(j + 1, h - 1)
    a, b = x - i, y - j
    low, high = ((1 - a) * table[k, i] + a * table[k, i1] for k in (j, j1))
    return np.asarray((1 - b) * low + b * high)


def _warp(density: Array, s: Array) -> Array:
    """Positions (n, 2) that a bilinear density (h, w) gives to uniform s (n, 2); both (x, y) [2]_."""
    h, w = density.shape
    rows_ = np.concatenate((np.zeros((h, 1)), np.cumsum(0.5 * (density[:, 1:] + density[:, :-1]), axis=1)), axis=1)  # (h, w)
    total = rows_[:, -1]
    marginal = np.concatenate(([0.0], np.cumsum(0.5 * (total[1:] + total[:-1]))))
    y = s[:, 1] * marginal[-1]
    j = np.clip(np.searchsorted(marginal, y, side="right") - 1, 0, h - 2)
    b = _invert(y - marginal[j], total[j], total[j + 1])
    conditional = (1 - b)[:, None] * rows_[j] + b[:, None] * rows_[j + 1]  # (n, w)
    x = s[:, 0] * conditional[:, -1]
    i = np.clip(np.sum(conditional <= x[:, None], axis=1) - 1, 0, w - 2)
    at = np.arange(len(s))
    c0, c1 = ((1 - b) * density[j, i + k] + b * density[j + 1, i + k] for k in (0, 1))
    a = _invert(x - conditional[at, i], c0, c1)
    return np.stack(((i + a) / (w - 1), (j + b) / (h - 1)), axis=-1)


def _invert(area: Array, left: Array, right: Array) -> Array:
    """Where in [0, 1] the area under a line from left to right reaches `area`."""
    slope, both = left - right, left + right
    flat = np.abs(slope) < 1e-4 * both
    root = np.sqrt(np.maximum(left**2 - 2.0 * area * slope, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        out = np.where(flat, 2.0 * area / both, (left - root) / slope)
    return np.asarray(np.clip(np.nan_to_num(out), 0.0, 1.0))
