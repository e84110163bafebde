"""Where sums over a cap are 0, or next to nothing: is it the far tail of a lobe that the nodes did not meet?

The lobe is highest where the cap comes nearest to the mirror direction. f_r there, and at some points of the rim around, as
the half vector's distance is not quite that of the directions, bounds the integral from above.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.brdf.base import Term, accumulate
from gonio.integrate.model_sums import sum_over_nodes

Array = NDArray[np.float64]
UNDERFLOW = 1e-280  # what is 0 may be as much
_AROUND = np.pi / 8.0 * np.array([0.0, 1.0, -1.0, 2.0, -2.0, 3.0, -3.0, 4.0, -4.0])  # on the rim, from the nearest point
_COSINES, _SINES = np.cos(_AROUND), np.sin(_AROUND)
POINTS = len(_AROUND)
_UP = 1e-12  # least height of a direction
_BETWEEN = 0.95  # of a lobe's exponent at these points: the least anywhere
_MARGIN = 10.0


@jit.part
def ceiling(weigh, ax, ay, az, s, c, sine, cosine, points, nodes, parameters):  # type: ignore[no-untyped-def]
    """Sum of f_r [1/sr], not below its largest value, over the `points` of a disk around a where it is highest.

    For a view at (-s, 0, c); `weigh` is the address that `model_sums.over_nodes` gives, `nodes` (4 or more, 9 or more) is
    written.
    """
    along = s * ax + c * az
    x, y, z = s - along * ax, -along * ay, c - along * az  # towards the mirror direction
    length = math.sqrt(x * x + y * y + z * z)
    if along >= cosine or length < 1e-12:
        points, nodes[0, 0], nodes[1, 0], nodes[2, 0], nodes[3, 0] = 1, s, 0.0, max(c, _UP), 1.0
    else:
        x, y, z = x / length, y / length, z / length
        u, v, w = ay * z - az * y, az * x - ax * z, ax * y - ay * x
        for k in range(points):
            e, f = sine * _COSINES[k], sine * _SINES[k]
            nodes[0, k], nodes[1, k] = cosine * ax + e * x + f * u, cosine * ay + e * y + f * v
            nodes[2, k], nodes[3, k] = max(cosine * az + e * z + f * w, _UP), 1.0
    return sum_over_nodes(weigh, nodes, points, s, c, parameters)


@jit.model
def nothing(most, solid, floor):  # type: ignore[no-untyped-def]
    """Whether no integral over a solid angle, of f_r with that `ceiling`, is above the floor."""
    return most <= 0.0 or (most < 1.0 and _MARGIN * solid * math.exp(_BETWEEN * math.log(most)) <= floor)


def upper_bound(term: Term, axis: Array, half_angle: float, cos_n: Array, sin_n: Array) -> Array:
    """Bound (n,) of the integral of f_r cos theta_i over a cap above the horizon [1]; axis (n, 3) in the local frames."""
    mirror = np.stack((sin_n, np.zeros_like(sin_n), cos_n), axis=-1)
    along = np.einsum("ni,ni->n", axis, mirror)[:, None]
    towards = mirror - along * axis
    length = np.linalg.norm(towards, axis=1, keepdims=True)
    towards = np.divide(towards, length, out=np.zeros_like(towards), where=length > 0.0)
    beside = np.cross(axis, towards)
    rim = math.sin(half_angle) * (_COSINES[:, None, None] * towards + _SINES[:, None, None] * beside)
    rim += math.cos(half_angle) * axis
    # where the rim sets, and the horizon below the mirror direction
    flat = np.maximum(np.hypot(axis[:, 0], axis[:, 1]), 1e-300)
    cosine = math.cos(half_angle) / flat
    azimuth = np.arctan2(axis[:, 1], axis[:, 0]) + np.arccos(np.clip(cosine, -1.0, 1.0)) * np.array([[1.0], [-1.0]])
    azimuth = np.concatenate((azimuth, np.zeros((1, len(axis)))))
    low = np.stack((np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)), axis=-1)
    rim_cosine = math.cos(half_angle)
    sets, ahead, mirrored = np.abs(cosine)[None] <= 1.0, axis[None, :, 0] >= rim_cosine, (along >= rim_cosine).T
    at = np.concatenate((rim, low, mirror[None]))
    lit = np.concatenate((rim[..., 2] > 0.0, sets, sets, ahead, mirrored))
    at[..., 2] = np.maximum(at[..., 2], _UP)
    f_r, viewer = np.zeros(at[..., 0].size), np.tile(mirror * np.array([-1.0, 1.0, 1.0]), (len(at), 1))
    accumulate(term.model)(np.ascontiguousarray(at.reshape(-1, 3)), viewer, term.values, 1.0, f_r)
    most = np.max(np.where(lit, f_r.reshape(len(at), -1), 0.0), axis=0)
    faint = (most > 0.0) & (most < 1.0)
    most[faint] = most[faint] ** _BETWEEN
    return np.asarray(_MARGIN * 4.0 * math.pi * math.sin(0.5 * min(half_angle, math.pi)) ** 2 * most)
