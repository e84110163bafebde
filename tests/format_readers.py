"""Readers of BRDF files as functions of two directions: what they are asked, their albedos, and one written for SSDD.

The reader of SSDD files comes from the format's definition and shares no code with gonio's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from gonio.formats import klems
from gonio.geometry import unit_vector

Array = NDArray[np.float64]
Reader = Callable[[Array, Array], Array]  # omega_i, omega_r (n, 3) -> f_r (n,)


def random_pairs(n: int, seed: int, reach_deg: float = 75.0) -> tuple[Array, Array]:
    """Pairs of directions, half of them around the mirror direction."""
    rng = np.random.default_rng(seed)
    cos = rng.uniform(math.cos(math.radians(reach_deg)), 1.0, (2, n))
    wi, wr = (unit_vector(np.arccos(c), rng.uniform(0, 2 * np.pi, n)) for c in cos)
    near = wi * [-1.0, -1.0, 1.0] + 0.1 * rng.standard_normal((n, 3))
    near /= np.linalg.norm(near, axis=1, keepdims=True)
    take = (np.arange(n) % 2 == 0) & (near[:, 2] > math.cos(math.radians(reach_deg)))
    return wi, np.where(take[:, None], near, wr)


def patch_points(basis: klems.Basis, patch: int, n: int, rng: np.random.Generator) -> Array:
    """Random directions (n, 3) of a patch, even in projected solid angle."""
    t0, t1, p0, p1 = basis.patches()[patch]
    s2 = rng.uniform(math.sin(t0) ** 2, math.sin(t1) ** 2, n)
    return unit_vector(np.arcsin(np.sqrt(s2)), rng.uniform(p0, p1, n))


def albedo(read: Reader, theta_i: float, n: int = 96) -> float:
    """Directional albedo by Gauss quadrature in half-vector angles around the mirror direction."""
    node, weight = np.polynomial.legendre.leggauss(n)
    wi = np.array([math.sin(theta_i), 0.0, math.cos(theta_i)])
    # theta_h = u^3 pi/2: nodes crowd at the lobe; d omega_r = 4 cos(theta_d) d omega_h
    u, w_u = 0.5 * (node + 1), 0.5 * weight
    theta_h, d_theta = u**3 * np.pi / 2, 1.5 * np.pi * u**2
    phi = np.pi * (np.arange(4 * n) + 0.5) / (4 * n) * 2
    h = unit_vector(theta_h[:, None], phi)
    dot = h @ wi
    wr = 2 * dot[..., None] * h - wi
    up = (dot > 0) & (wr[..., 2] > 1e-6)
    jacobian = 4 * dot * np.sin(theta_h)[:, None] * (d_theta * w_u)[:, None] * (2 * np.pi / len(phi))
    f = read(np.broadcast_to(wi, wr[up].shape), wr[up])
    return float(np.sum(f * wr[up][:, 2] * jacobian[up]))


def binned_albedo(read: Reader, theta_i: float, per_bin: int = 20, azimuths: int = 90) -> float:
    """Directional albedo of a look-up in MERL's bins, by midpoints within each bin of theta_h and random azimuths."""
    rng, n = np.random.default_rng(4), 90 * per_bin
    wi = np.array([math.sin(theta_i), 0.0, math.cos(theta_i)])
    u = (np.arange(n)[:, None] + 0.5) / n  # theta_h = u^2 pi/2 as in the bins
    theta, phi = u * u * np.pi / 2, 2 * np.pi * (np.arange(azimuths) + rng.random((n, 1))) / azimuths
    h = unit_vector(theta, phi)
    dot = h @ wi
    wr = 2 * dot[..., None] * h - wi
    up = (dot > 0) & (wr[..., 2] > 1e-6)
    jacobian = (4 * dot * np.sin(theta) * np.pi * u * 2 * np.pi / (n * azimuths))[up]
    return float(np.sum(read(np.broadcast_to(wi, wr[up].shape), wr[up]) * wr[up][:, 2] * jacobian))


def ssdd_reader(path: Path) -> Reader:
    """Linear interpolation in the four angles, as libbsdf does, from the text of the file."""
    lines = path.read_text(encoding="utf-8").splitlines()
    start = lines.index("DATA ascii")
    lists = {
        w[0]: [float(x) for x in w[1:]] for w in (line.split() for line in lines[:start]) if w and w[0].endswith("_LIST")
    }
    axes = [np.radians(lists[f"PARAM{k}_LIST"]) for k in (0, 2, 3)]
    values = np.array([float(line.split()[0]) for line in lines[start + 1 :]])
    grid = values.reshape(len(axes[2]), len(axes[1]), len(axes[0])).T
    table = RegularGridInterpolator(axes, grid)

    def read(wi: Array, wr: Array) -> Array:
        h = (wi + wr) / np.linalg.norm(wi + wr, axis=1, keepdims=True)
        theta_h, phi_h = np.arccos(np.clip(h[:, 2], -1, 1)), np.arctan2(h[:, 1], h[:, 0])
        c, s = np.cos(-phi_h), np.sin(-phi_h)
        x, y = c * wi[:, 0] - s * wi[:, 1], s * wi[:, 0] + c * wi[:, 1]
        c, s = np.cos(-theta_h), np.sin(-theta_h)
        dx, dz = c * x + s * wi[:, 2], -s * x + c * wi[:, 2]
        theta_d, phi_d = np.arccos(np.clip(dz, -1, 1)), np.abs(np.arctan2(y, dx))
        phi_d = np.minimum(phi_d, np.pi - phi_d)
        return np.asarray(table(np.stack((theta_h, theta_d, np.maximum(phi_d, 0.0)), axis=-1)))

    return read
