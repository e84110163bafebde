r"""From joint angles to directions and back, for a fixed camera, a light arm and a pan-tilt sample stage.

World frame: the specimen's reference point is the origin and the camera looks down from +z, so v = (0, 0, 1). The arm
turns about y and carries the lamp at l = (sin arm, 0, cos arm). The specimen pans about y, then tilts about its own x:

.. math:: [t\ b\ n] = R_y(\mathrm{pan})\, R_x(\mathrm{tilt}), \qquad
          n = (\sin\beta\cos\tau,\ -\sin\tau,\ \cos\beta\cos\tau).

Seen from the specimen's local frame (t, b, n) this is short: with beta = pan, tau = tilt, gamma = arm

.. math:: \omega_i &= (\sin(\gamma-\beta),\ \sin\tau\cos(\gamma-\beta),\ \cos\tau\cos(\gamma-\beta)) \\
          \omega_r &= (-\sin\beta,\ \sin\tau\cos\beta,\ \cos\tau\cos\beta).

Angles are radians. The module knows ideal axes only: zeros, backlash and encoders belong to the caller. It refuses to
choose among solutions; it invents none where lamp and camera are in line (`inverse` marks those as singular).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gonio.errors import GeometryError
from gonio.geometry import angles, wrap
from gonio.interfaces import AxisLimits

Array = NDArray[np.float64]
AXES = ("arm", "pan", "tilt")
SINGULAR = 1e-9
"""Lamp and camera count as in line (or opposite) when the sine of the angle between them is below this."""


class Joints(NamedTuple):
    """Joint angles of one pose [rad]."""

    arm: float
    pan: float
    tilt: float


def forward(arm: ArrayLike, pan: ArrayLike, tilt: ArrayLike) -> tuple[Array, Array]:
    """Directions to the lamp and to the camera in the local frame of the specimen.

    Parameters
    ----------
    arm, pan, tilt : array_like, shapes broadcast to (...)
        Joint angles [rad].

    Returns
    -------
    omega_i, omega_r : ndarray, shape (..., 3)
        Unit vectors in (t, b, n). The third component is negative where the lamp or the camera is behind the surface.

    Examples
    --------
    Lamp at 60 degrees, specimen turned half of it: the mirror configuration.

    >>> omega_i, omega_r = forward(np.radians(60), np.radians(30), 0.0)
    >>> np.allclose(omega_i, [0.5, 0, 0.75**0.5]), np.allclose(omega_r, [-0.5, 0, 0.75**0.5])
    (True, True)
    """
    arm, pan, tilt = _joints(arm, pan, tilt)
    return _on_circle(arm - pan, tilt), _on_circle(-pan, tilt)


def four_angles(arm: ArrayLike, pan: ArrayLike, tilt: ArrayLike) -> tuple[Array, Array, Array, Array]:
    """theta_i, phi_i, theta_r, phi_r of joint angles, each of shape (...) [rad]; phi in [0, 2 pi), 0 on the normal."""
    omega_i, omega_r = forward(arm, pan, tilt)
    return *angles(omega_i), *angles(omega_r)


def jacobian(arm: ArrayLike, pan: ArrayLike, tilt: ArrayLike) -> tuple[Array, Array]:
    """Derivatives of the two directions with respect to the joint angles.

    Parameters
    ----------
    arm, pan, tilt : array_like, shapes broadcast to (...)
        Joint angles [rad].

    Returns
    -------
    d_omega_i, d_omega_r : ndarray, shape (..., 3, 3)
        ``d_omega[..., k, j]``: derivative of component k with respect to joint j of (arm, pan, tilt) [1/rad].
    """
    arm, pan, tilt = _joints(arm, pan, tilt)
    i_angle, i_tilt = _circle_slopes(arm - pan, tilt)
    r_angle, r_tilt = _circle_slopes(-pan, tilt)
    zero = np.zeros_like(r_angle)
    return np.stack((i_angle, -i_angle, i_tilt), axis=-1), np.stack((zero, -r_angle, r_tilt), axis=-1)


@dataclass(frozen=True)
class Solutions:
    """Joint angles that realise a geometry.

    Attributes
    ----------
    arm, pan, tilt : ndarray, shape (..., 4)
        [rad]; NaN where `singular`. The four are (+arm, +tilt), (+arm, -tilt), (-arm, +tilt), (-arm, -tilt). The first
        and the last have phi_r - phi_i of one sign, the other two of the opposite sign.
    distinct : ndarray of bool, shape (..., 4)
        False for a solution that repeats an earlier one (in plane tilt = 0, so only two differ) and where `singular`.
    separation : ndarray, shape (...)
        Angle between lamp and camera [rad].
    singular : ndarray of bool, shape (...)
        Lamp and camera in line or opposite: the plane of the arm does not fix the specimen's azimuth.
    """

    arm: Array
    pan: Array
    tilt: Array
    distinct: NDArray[np.bool_]
    separation: Array
    singular: NDArray[np.bool_]

    def joints(self) -> list[Joints]:
        """The distinct solutions of a single geometry (shape () only)."""
        if self.separation.shape != ():
            raise GeometryError(f"joints() lists one geometry, this holds {self.separation.shape}; use the arrays")
        rows = np.stack((self.arm, self.pan, self.tilt), axis=-1)[self.distinct]
        return [Joints(float(arm), float(pan), float(tilt)) for arm, pan, tilt in rows]


def inverse(theta_i: ArrayLike, theta_r: ArrayLike, dphi: ArrayLike) -> Solutions:
    r"""All joint angles that realise a geometry on an isotropic specimen.

    Parameters
    ----------
    theta_i, theta_r : array_like, shapes broadcast to (...)
        Polar angles [rad], ``0 <= theta < pi/2``.
    dphi : array_like
        phi_r - phi_i [rad], any sign; pi is the mirror side. The solutions have either sign of it.

    Returns
    -------
    Solutions

    Raises
    ------
    GeometryError
        If a polar angle is outside its range or an angle is not finite.

    Notes
    -----
    Camera, lamp and normal form a spherical triangle with sides g (camera to lamp), theta_r (camera to normal), theta_i
    (lamp to normal) and the angle dphi at the normal. Haversines give g, and with the angle A at the camera

    .. math:: \sin g\,\sin A &= \sin\theta_i\,|\sin\Delta\phi| \\
              \sin g\,\cos A &= \cos\theta_i\sin\theta_r - \sin\theta_i\cos\theta_r\cos\Delta\phi \\
              n &= (\sin\theta_r\cos A,\ \pm\sin\theta_r\sin A,\ \cos\theta_r) .

    Nothing is divided by sin g, and the differences of nearly equal cosines are written out as haversines.
    """
    theta_i, theta_r, dphi = np.broadcast_arrays(*(np.asarray(a, dtype=float) for a in (theta_i, theta_r, dphi)))
    for name, theta in (("theta_i", theta_i), ("theta_r", theta_r)):
        bad = ~((theta >= 0.0) & (theta < np.pi / 2))
        if np.any(bad):
            raise GeometryError(f"{name} = {np.degrees(theta[bad].flat[0]):g} degrees: give 0 <= {name} < 90 degrees")
    if not np.all(np.isfinite(dphi)):
        raise GeometryError("phi_r - phi_i is not finite: give an angle")
    half = 0.5 * np.abs(np.remainder(dphi + np.pi, 2 * np.pi) - np.pi)
    sin_half, cos_half = _snap(np.sin(half)), _snap(np.cos(half))  # in plane means exactly in plane
    si, sr, cr = np.sin(theta_i), np.sin(theta_r), np.cos(theta_r)

    # hav g = hav(theta_i - theta_r) + sin theta_i sin theta_r hav(dphi), and the same for the supplement
    near = np.sqrt(np.sin(0.5 * (theta_i - theta_r)) ** 2 + si * sr * sin_half**2)
    far = np.sqrt(np.cos(0.5 * (theta_i + theta_r)) ** 2 + si * sr * cos_half**2)
    separation = np.asarray(2.0 * np.arctan2(near, far))
    singular = np.asarray(2.0 * near * far < SINGULAR)

    across = 2.0 * si * sin_half * cos_half  # sin g sin A
    along = np.sin(theta_r - theta_i) + 2.0 * si * cr * sin_half**2  # sin g cos A
    a = np.arctan2(across, along)
    n_x, n_y = sr * np.cos(a), sr * np.where(across == 0.0, 0.0, np.sin(a))  # sin(pi) is not 0
    pan = np.arctan2(n_x, cr)
    tilt = np.arctan2(n_y, np.hypot(n_x, cr))

    in_plane = tilt == 0.0
    once, twice = ~singular, ~singular & ~in_plane
    distinct = np.stack((once, twice, once, twice), axis=-1)
    nan = np.where(singular, np.nan, 0.0)
    return Solutions(
        arm=np.stack((separation, separation, -separation, -separation), axis=-1) + nan[..., None],
        pan=np.stack((pan, pan, -pan, -pan), axis=-1) + nan[..., None],
        tilt=np.stack((tilt, -tilt, tilt, -tilt), axis=-1) + nan[..., None],
        distinct=distinct,
        separation=separation,
        singular=singular,
    )


def obstacles(
    arm: float, pan: float, tilt: float, limits: Mapping[str, AxisLimits], *, g_min: float = 0.0
) -> tuple[str, ...]:
    """Why a pose cannot be taken; empty if it can.

    Parameters
    ----------
    arm, pan, tilt : float
        Joint angles [rad].
    limits : mapping of axis name to AxisLimits
        Travel of each axis; an axis that is missing is not limited.
    g_min : float
        Smallest angle between lamp and camera at which the lamp does not hide the specimen [rad].

    Returns
    -------
    tuple of str
        One sentence part for each obstacle, with both numbers in degrees.
    """
    reasons = []
    for name, value in zip(AXES, (arm, pan, tilt), strict=True):
        if name not in limits:
            continue
        low, high = limits[name].lower, limits[name].upper
        if not low <= value <= high:
            reasons.append(
                f"{name} {np.degrees(value):.2f} deg is outside {np.degrees(low):.2f} to {np.degrees(high):.2f} deg"
            )
    separation = abs(np.remainder(arm + np.pi, 2 * np.pi) - np.pi)
    if separation < g_min:
        reasons.append(
            f"the lamp is {np.degrees(separation):.2f} deg from the camera's axis and hides the specimen"
            f" below {np.degrees(g_min):.2f} deg"
        )
    omega_i, omega_r = forward(arm, pan, tilt)
    for what, omega in (("lamp", omega_i), ("camera", omega_r)):
        if omega[2] <= 0.0:
            reasons.append(f"the {what} is {np.degrees(angles(omega)[0]):.2f} deg from the normal, behind the surface")
    return tuple(reasons)


@dataclass(frozen=True)
class Reach:
    """What a rig can do about one geometry.

    Attributes
    ----------
    solutions : tuple of Joints
        The solutions within all limits, in the order of `inverse`.
    reasons : tuple of str
        Why the others cannot be taken, each with its joint angles.
    """

    solutions: tuple[Joints, ...]
    reasons: tuple[str, ...]


def reach(
    theta_i: float, theta_r: float, dphi: float, limits: Mapping[str, AxisLimits], *, g_min: float = 0.0
) -> Reach:
    """The solutions of one geometry that a rig can take, and reasons for those it cannot.

    Parameters
    ----------
    theta_i, theta_r, dphi : float
        As in `inverse` [rad].
    limits, g_min
        As in `obstacles`.
    """
    found = inverse(theta_i, theta_r, dphi)
    if found.singular:
        return Reach((), (f"lamp and camera are in line: they are {np.degrees(found.separation):.2f} deg apart",))
    solutions, reasons = [], []
    for joints in found.joints():
        against = obstacles(*joints, limits, g_min=g_min)
        if against:
            arm, pan, tilt = np.degrees(joints)
            reasons.append(f"arm {arm:.2f}, pan {pan:.2f}, tilt {tilt:.2f} deg: " + "; ".join(against))
        else:
            solutions.append(joints)
    return Reach(tuple(solutions), tuple(reasons))


def phi_difference(phi_i: ArrayLike, phi_r: ArrayLike) -> Array:
    """phi_r - phi_i in [0, 2 pi) [rad]."""
    return wrap(np.subtract(phi_r, phi_i))


def _joints(arm: ArrayLike, pan: ArrayLike, tilt: ArrayLike) -> tuple[Array, Array, Array]:
    arrays = [np.asarray(a, dtype=float) for a in (arm, pan, tilt)]
    for name, array in zip(AXES, arrays, strict=True):
        if not np.all(np.isfinite(array)):
            raise GeometryError(f"joint angle {name} is not finite: give an angle")
    a, b, c = np.broadcast_arrays(*arrays)
    return a, b, c


def _on_circle(angle: Array, tilt: Array) -> Array:
    """R_x(-tilt) (sin angle, 0, cos angle): a direction in the arm's plane, seen from the specimen; shape (..., 3)."""
    c = np.cos(angle)
    return np.stack((np.sin(angle), np.sin(tilt) * c, np.cos(tilt) * c), axis=-1) + 0.0  # + 0.0: no negative zeros


def _circle_slopes(angle: Array, tilt: Array) -> tuple[Array, Array]:
    """Derivatives of `_on_circle` with respect to angle and tilt, each of shape (..., 3)."""
    s, c, st, ct = np.sin(angle), np.cos(angle), np.sin(tilt), np.cos(tilt)
    return np.stack((c, -st * s, -ct * s), axis=-1), np.stack((np.zeros_like(c), ct * c, -st * c), axis=-1)


def _snap(value: Array) -> Array:
    return np.where(np.abs(value) < 1e-15, 0.0, value)
