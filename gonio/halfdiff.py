"""Rusinkiewicz's half and difference angles, both ways.

References
----------
.. [1] S. M. Rusinkiewicz, "A New Change of Variables for Efficient BRDF Representation", Eurographics Workshop on
   Rendering, 1998. doi:10.1007/978-3-7091-6453-2_2
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gonio.geometry import angles, unit_vector

Array = NDArray[np.float64]


def half_difference(omega_i: ArrayLike, omega_r: ArrayLike) -> tuple[Array, Array, Array, Array]:
    """Half and difference angles of two directions.

    Parameters
    ----------
    omega_i, omega_r : array_like, shapes broadcast to (..., 3)
        Unit vectors away from the surface, normal along z; not opposite to each other.

    Returns
    -------
    theta_h, phi_h, theta_d, phi_d : ndarray, shape (...)
        [rad]; theta_d in [0, pi/2], azimuths in [0, 2 pi). Swapping the two directions adds pi to phi_d.
    """
    wi, wr = np.asarray(omega_i, dtype=float), np.asarray(omega_r, dtype=float)
    total, difference = wi + wr, wi - wr
    theta_h, phi_h = angles(total)
    # theta_d from both lengths, as acos loses half the digits near 0
    theta_d = np.arctan2(np.linalg.norm(difference, axis=-1), np.linalg.norm(total, axis=-1))
    # d = R_y(-theta_h) R_z(-phi_h) omega_i; its x and y are those of (omega_i - omega_r)/2, which is orthogonal to h
    c, s = np.cos(phi_h), np.sin(phi_h)
    x = c * difference[..., 0] + s * difference[..., 1]
    y = -s * difference[..., 0] + c * difference[..., 1]
    x = np.cos(theta_h) * x - np.sin(theta_h) * difference[..., 2]
    _, phi_d = angles(np.stack(np.broadcast_arrays(x, y, np.zeros_like(x)), axis=-1))
    return theta_h, phi_h, theta_d, phi_d


def directions(theta_h: ArrayLike, phi_h: ArrayLike, theta_d: ArrayLike, phi_d: ArrayLike) -> tuple[Array, Array]:
    """The two directions of half and difference angles; the inverse of `half_difference`.

    Returns
    -------
    omega_i, omega_r : ndarray, shape (..., 3)
        Unit vectors; either may point below the surface, where no BRDF is defined.
    """
    theta_h, phi_h, theta_d, phi_d = np.broadcast_arrays(
        *(np.asarray(a, dtype=float) for a in (theta_h, phi_h, theta_d, phi_d))
    )

    def turned(d: Array) -> Array:  # R_z(phi_h) R_y(theta_h) d
        ch, sh, c, s = np.cos(theta_h), np.sin(theta_h), np.cos(phi_h), np.sin(phi_h)
        x, z = ch * d[..., 0] + sh * d[..., 2], -sh * d[..., 0] + ch * d[..., 2]
        return np.stack((c * x - s * d[..., 1], s * x + c * d[..., 1], z), axis=-1)

    return turned(unit_vector(theta_d, phi_d)), turned(unit_vector(theta_d, phi_d + np.pi))
