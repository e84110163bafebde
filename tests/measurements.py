"""Measurements of a material on a goniometer, made from rotation matrices alone, with their truth.

The rig: camera along +z, light arm gamma about y, sample pan about y and tilt about x, as in gonio; each axis has a zero
error shared by all poses and a fresh encoder error in each, and the white reference an error of scale. Nothing of the fit is
used.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from gonio.brdf import BRDF
from gonio.samples import BRDFSamples, SharedError

U_SCALE, U_ZERO, U_ENCODER = 0.01, math.radians(0.1), math.radians(0.025)
SHARED = ("shared.scale", "shared.arm", "shared.pan", "shared.tilt")


def rotation(axis: str, angle: np.ndarray) -> np.ndarray:
    c, s, o, i = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    rows = [[c, o, s], [o, i, o], [-s, o, c]] if axis == "y" else [[i, o, o], [o, c, -s], [o, s, c]]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def directions(gamma: np.ndarray, beta: np.ndarray, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Light and camera in the frame of the sample, each (n, 3)."""
    sample = rotation("y", beta) @ rotation("x", tau)
    light = np.stack((np.sin(gamma), np.zeros_like(gamma), np.cos(gamma)), axis=-1)
    return np.einsum("nji,nj->ni", sample, light), sample[:, 2, :]


def poses(rng: np.random.Generator, n: int) -> np.ndarray:
    """Arm, pan and tilt [rad], shape (3, n): lit and seen, half of them near the mirror condition."""
    pose = np.empty((3, 0))
    while pose.shape[1] < n:
        more = rng.uniform([[-1.5], [-0.9], [-0.7]], [[1.5], [0.9], [0.7]], (3, 8 * n))
        near = rng.random(8 * n) < 0.5
        more[0, near] = 2 * more[1, near] + rng.normal(0, 0.25, near.sum())
        wi, wr = directions(*more)
        pose = np.concatenate((pose, more[:, (wi[:, 2] > 0.15) & (wr[:, 2] > 0.15) & (abs(more[0]) < 1.7)]), axis=1)
    return pose[:, :n]


def measure(
    rng: np.random.Generator,
    f_r: Callable[[np.ndarray, np.ndarray], np.ndarray],
    n: int,
    u: Callable[[np.ndarray, np.ndarray], np.ndarray],
    u_encoder: float = U_ENCODER,
) -> tuple[BRDFSamples, dict[str, float]]:
    """Samples of a material, and the true values of their shared errors.

    Parameters
    ----------
    f_r : callable
        Of light and camera, (n, 3) each, in the frame of the sample [1/sr].
    n : int
    u : callable
        Standard uncertainty of a reading [1/sr], of the same.
    u_encoder : float
        Standard deviation of each axis in each pose [rad].
    """
    pose = poses(rng, n)
    scale, *zeros = rng.normal(0, [U_SCALE, U_ZERO, U_ZERO, U_ZERO])
    actual = pose + np.array(zeros)[:, None] + rng.normal(0, U_ENCODER, (3, n)) * (u_encoder / U_ENCODER)
    wi, wr = directions(*pose)
    noise = u(wi, wr)
    f = f_r(*directions(*actual)) * np.exp(scale) + rng.normal(0, noise)
    slopes = []
    for k in range(3):
        h = np.zeros((3, 1))
        h[k] = 1e-6
        slopes.append([(a - b) / 2e-6 for a, b in zip(directions(*(pose + h)), directions(*(pose - h)), strict=True)])
    zero = np.zeros((n, 3))
    d_omega_i, d_omega_r = (np.stack([zero, *(s[side] for s in slopes)], axis=-1) for side in (0, 1))
    d_ln_f = np.zeros((n, 4))
    d_ln_f[:, 0] = 1.0
    shared = (SharedError("scale", U_SCALE), *(SharedError(a, U_ZERO, u_encoder, "rad") for a in ("arm", "pan", "tilt")))
    samples = BRDFSamples(
        *angles(wi), *angles(wr), f, noise, np.arange(n), shared, d_omega_i, d_omega_r, d_ln_f
    )
    return samples, dict(zip(SHARED, map(float, (scale, *zeros)), strict=True))


def angles(w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Polar angle and azimuth of unit vectors (n, 3)."""
    return np.arccos(np.clip(w[:, 2], -1, 1)), np.arctan2(w[:, 1], w[:, 0]) % (2 * np.pi)


def material(brdf: BRDF) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """f_r of unit vectors."""
    return lambda wi, wr: brdf.f_r(*angles(wi), *angles(wr))
