"""A pair of directions for the second opinion of tests/independent.py, its numbers found in two ways.

A model there is one formula of a `Pair`. `from_angles` counts everything from polar angles and an azimuth, `from_vectors`
from the components of unit vectors; nothing of gonio is used.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Circle = tuple[Array, float, bool]
Feature = tuple[Array, float]


@dataclass(frozen=True)
class Pair:
    """Numbers of the incident directions (n,) and of the one reflected direction, the viewer's.

    Attributes
    ----------
    mu_i, sin_i, theta_i : ndarray, shape (n,)
        Cosine, sine and angle [rad] of the incident direction from the normal.
    mu_r, sin_r, theta_r : float
    dot : ndarray
        Product of the two directions' tangential parts.
    psi : ndarray
        Angle between their azimuths [rad], 0 towards the viewer, pi towards the mirror.
    across : ndarray
        Square length of the tangential part of their sum.
    total, apart : ndarray
        Square length of their sum and of their difference.
    """

    mu_i: Array
    sin_i: Array
    theta_i: Array
    mu_r: float
    sin_r: float
    theta_r: float
    dot: Array
    psi: Array
    across: Array
    total: Array
    apart: Array

    @property
    def tan2_h(self) -> Array:
        """Square tangent of the half vector's polar angle."""
        return self.across / (self.mu_i + self.mu_r) ** 2

    @property
    def mu_h(self) -> Array:
        return (self.mu_i + self.mu_r) / np.sqrt(self.total)

    @property
    def cos_d(self) -> Array:
        """Cosine between a direction and the half vector."""
        return np.minimum(1.0, 0.5 * np.sqrt(self.total))


def from_angles(surface: Any, theta_i: Array, u: Array) -> Pair:
    """From the polar angle of the incident direction and its azimuth from the mirror direction."""
    theta_i, u = np.broadcast_arrays(np.asarray(theta_i, dtype=float), np.asarray(u, dtype=float))
    theta_r = surface.theta_r
    sin_i, mu_i = np.sin(theta_i), np.cos(theta_i)
    product = sin_i * surface.sin_r
    off2 = np.sin((theta_i - theta_r) / 2) ** 2
    across = 4 * np.cos((theta_i + theta_r) / 2) ** 2 * off2 + 4 * product * np.sin(u / 2) ** 2
    around = np.abs(np.mod(u + np.pi, 2 * np.pi) - np.pi)
    return Pair(
        mu_i, sin_i, theta_i, surface.cos_r, surface.sin_r, theta_r, -product * np.cos(u), np.pi - around,
        across, across + (mu_i + surface.cos_r) ** 2, 4 * off2 + 4 * product * np.cos(u / 2) ** 2,
    )  # fmt: skip


def from_vectors(surface: Any, w: Array) -> Pair:
    """From unit vectors w (n, 3) in viewer's coordinates; the viewer is (0, 0, 1)."""
    viewer = np.array([0.0, 0.0, 1.0])
    t, b, mu_i = w @ surface.tangent, w @ surface.binormal, np.maximum(w @ surface.normal, 1e-300)
    r_t, r_b = float(viewer @ surface.tangent), float(viewer @ surface.binormal)
    dot = t * r_t + b * r_b
    sin_i = np.hypot(t, b)
    total, apart = w + viewer, w - viewer
    return Pair(
        mu_i, sin_i, np.arctan2(sin_i, mu_i), surface.cos_r, surface.sin_r, surface.theta_r, dot,
        np.arctan2(np.abs(t * r_b - b * r_t), dot), (t + r_t) ** 2 + (b + r_b) ** 2,
        np.sum(total**2, axis=1), np.sum(apart**2, axis=1),
    )  # fmt: skip


def equal_elevation(surface: Any) -> list[Circle]:
    """The circle theta_i = theta_r; none seen from straight above."""
    return [] if surface.flat else [(surface.normal, surface.theta_r, False)]
