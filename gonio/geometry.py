r"""Directions, surface gradients and the two coordinate systems of the memo.

Viewer-oriented: z towards the viewer, as the image is orthographic; a direction has polar angle theta from z and azimuth
phi from x. Local: z along the surface normal, x the tangent along which the slope runs, so that the viewer always stands
in the local x-z plane, on the -x side. Angles are radians, azimuths are returned in [0, 2 pi).

This module knows no light and no material.

References
----------
.. [1] B. K. P. Horn, R. W. Sjoberg, "Calculating the Reflectance Map", MIT AI Memo 498, 1978, sections 10 to 12.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gonio.errors import GeometryError

Array = NDArray[np.float64]
TWO_PI = 2.0 * np.pi


def wrap(phi: ArrayLike) -> Array:
    """Azimuth folded into [0, 2 pi)."""
    folded = np.mod(np.asarray(phi, dtype=float), TWO_PI)
    return np.where(folded >= TWO_PI, 0.0, folded)  # mod rounds -1e-17 up to 2 pi


def unit_vector(theta: ArrayLike, phi: ArrayLike) -> Array:
    """Unit vector of polar angle and azimuth.

    Parameters
    ----------
    theta, phi : array_like, shapes broadcast to (...)
        Polar angle from z and azimuth from x [rad].

    Returns
    -------
    ndarray, shape (..., 3)
    """
    theta, phi = np.broadcast_arrays(np.asarray(theta, dtype=float), np.asarray(phi, dtype=float))
    s = np.sin(theta)
    return np.stack((s * np.cos(phi), s * np.sin(phi), np.cos(theta)), axis=-1)


def angles(vector: ArrayLike) -> tuple[Array, Array]:
    """Polar angle and azimuth of a vector of any length, accurate to the last digits near the poles too.

    Parameters
    ----------
    vector : array_like, shape (..., 3)

    Returns
    -------
    theta, phi : ndarray, shape (...)
        Polar angle in [0, pi] and azimuth in [0, 2 pi) [rad]; phi = 0 on the z axis.
    """
    v = np.asarray(vector, dtype=float)
    theta = np.arctan2(np.hypot(v[..., 0], v[..., 1]), v[..., 2])
    on_axis = (v[..., 0] == 0.0) & (v[..., 1] == 0.0)
    return theta, np.where(on_axis, 0.0, wrap(np.arctan2(v[..., 1], v[..., 0])))


def normal_from_gradient(p: ArrayLike, q: ArrayLike) -> tuple[Array, Array]:
    """Polar angles of the surface normal (-p, -q, 1) of a surface z(x, y) with p = dz/dx, q = dz/dy (memo, section 11).

    Parameters
    ----------
    p, q : array_like, shapes broadcast to (...)
        Surface gradient [1]. One of the two may be infinite: the limit is returned.

    Returns
    -------
    theta_n, phi_n : ndarray, shape (...)
        [rad]; phi_n = 0 at p = q = 0, where it is undefined.

    Raises
    ------
    GeometryError
        If a component is NaN, or both are infinite.

    Examples
    --------
    >>> theta_n, phi_n = normal_from_gradient(-1.0, 0.0)
    >>> float(theta_n), float(phi_n)
    (0.7853981633974483, 0.0)
    """
    p, q = _gradient(p, q)
    theta_n = np.arctan2(np.hypot(p, q), 1.0)
    flat = (p == 0.0) & (q == 0.0)
    return theta_n, np.where(flat, 0.0, wrap(np.arctan2(-q, -p)))


def gradient_from_normal(theta_n: ArrayLike, phi_n: ArrayLike) -> tuple[Array, Array]:
    """Surface gradient of a normal; the inverse of `normal_from_gradient`.

    Parameters
    ----------
    theta_n, phi_n : array_like, shapes broadcast to (...)
        Polar angles of the normal [rad], ``0 <= theta_n < pi/2``.

    Returns
    -------
    p, q : ndarray, shape (...)

    Raises
    ------
    GeometryError
        If theta_n is outside [0, pi/2): such a normal is seen edge-on or from behind and has no gradient.
    """
    theta_n, phi_n = np.asarray(theta_n, dtype=float), np.asarray(phi_n, dtype=float)
    bad = ~((theta_n >= 0.0) & (theta_n < np.pi / 2)) | ~np.isfinite(phi_n)
    if np.any(bad):
        worst = np.broadcast_to(theta_n, bad.shape)[bad].flat[0]
        raise GeometryError(
            f"theta_n = {np.degrees(worst):g} degrees has no gradient: give 0 <= theta_n < 90 degrees and a finite phi_n"
        )
    t = np.tan(theta_n)
    return -t * np.cos(phi_n) + 0.0, -t * np.sin(phi_n) + 0.0  # + 0.0: no negative zeros


def normal_cosines(p: ArrayLike, q: ArrayLike) -> tuple[Array, Array, Array, Array]:
    """cos and sin of theta_n and of phi_n straight from the gradient, without a trigonometric function.

    Returns
    -------
    cos_theta_n, sin_theta_n, cos_phi_n, sin_phi_n : ndarray, shape (...)
        At p = q = 0: (1, 0, 1, 0).
    """
    p, q = _gradient(p, q)
    slope = np.hypot(p, q)
    length = np.hypot(slope, 1.0)
    steep, flat = np.isinf(slope), slope == 0.0
    with np.errstate(invalid="ignore", divide="ignore"):
        cos_theta, sin_theta = 1.0 / length, np.where(steep, 1.0, slope / length)
        cos_phi = np.where(flat, 1.0, np.where(np.isinf(p), -np.sign(p), np.where(np.isinf(q), 0.0, -p / slope)))
        sin_phi = np.where(flat, 0.0, np.where(np.isinf(q), -np.sign(q), np.where(np.isinf(p), 0.0, -q / slope)))
    return cos_theta, sin_theta, cos_phi + 0.0, sin_phi + 0.0


def local_from_viewer(
    theta_s: ArrayLike, phi_s: ArrayLike, theta_n: ArrayLike, phi_n: ArrayLike
) -> tuple[Array, Array]:
    r"""Local direction of a source given in viewer-oriented coordinates (memo, section 12).

    .. math::
        \cos\theta_i &= \cos\theta_s\cos\theta_n + \sin\theta_s\sin\theta_n\cos(\phi_s-\phi_n) \\
        \sin\theta_i\cos(\phi_r-\phi_i) &= \cos\theta_s\sin\theta_n - \sin\theta_s\cos\theta_n\cos(\phi_s-\phi_n) \\
        \sin\theta_i\sin(\phi_r-\phi_i) &= \sin\theta_s\sin(\phi_s-\phi_n)

    Returns
    -------
    theta_i, phi_difference : ndarray, shape (...)
        theta_i in [0, pi] and phi_r - phi_i in [0, 2 pi) [rad]; the viewer is at theta_r = theta_n.
    """
    return _rotate(theta_s, np.subtract(phi_s, phi_n), theta_n)


def viewer_from_local(
    theta_i: ArrayLike, phi_difference: ArrayLike, theta_n: ArrayLike, phi_n: ArrayLike
) -> tuple[Array, Array]:
    """Viewer-oriented direction of a source given locally; the inverse of `local_from_viewer` (memo, section 12).

    Returns
    -------
    theta_s, phi_s : ndarray, shape (...)
        [rad]; phi_s in [0, 2 pi).
    """
    theta_s, delta = _rotate(theta_i, phi_difference, theta_n)  # the transformation is its own inverse
    return theta_s, wrap(delta + np.asarray(phi_n, dtype=float))


def _rotate(theta: ArrayLike, delta: ArrayLike, theta_n: ArrayLike) -> tuple[Array, Array]:
    theta, delta, theta_n = (np.asarray(a, dtype=float) for a in (theta, delta, theta_n))
    st, ct, sn, cn = np.sin(theta), np.cos(theta), np.sin(theta_n), np.cos(theta_n)
    cd, sd = np.cos(delta), np.sin(delta)
    return angles(np.stack(np.broadcast_arrays(ct * sn - st * cn * cd, st * sd, ct * cn + st * sn * cd), axis=-1))


def _gradient(p: ArrayLike, q: ArrayLike) -> tuple[Array, Array]:
    p, q = np.asarray(p, dtype=float), np.asarray(q, dtype=float)
    if np.any(np.isnan(p)) or np.any(np.isnan(q)):
        raise GeometryError("a gradient is NaN: give finite p and q")
    if np.any(np.isinf(p) & np.isinf(q)):
        raise GeometryError(
            "p and q are both infinite, so the direction of the slope is undefined: give one of them finite"
        )
    return p, q
