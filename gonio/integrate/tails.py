r"""Where sums over a cap are 0, or next to nothing: is it the far tail of a lobe that the nodes did not meet?

The lobe is highest where the cap comes nearest to the mirror direction, and f_r there bounds the integral from above, if it
falls with the angle from that direction. Where it falls with the half vector's angle, :math:`f_r \sim e^{-E}` with
:math:`E \sim \tan^2\theta_h` or :math:`\ln(1+\tan^2\theta_h)` and

.. math:: \tan\theta_h = \frac{|(\omega_i+\omega_r)_{xy}|}{(\omega_i+\omega_r)_z} ,

a point less than :math:`d = 2\sin\delta` away has at least the share :math:`((1-d/|..|_{xy})/(1+d/|..|_z))^2` of E.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.brdf.base import Term
from gonio.brdf.kernels import accumulate
from gonio.integrate.model_sums import sum_over_nodes

Array = NDArray[np.float64]
ROUNDING = 1e-13  # of the largest value of a map: errors below it are met by any tolerance
NOTHING = 1e-250  # [W m^-2 sr^-1], the same: where numbers underflow
UNDERFLOW = 1e-280  # what is 0 may be as much
_AROUND = np.pi / 8.0 * np.array([0.0, 1.0, -1.0, 2.0, -2.0, 3.0, -3.0, 4.0, -4.0])  # on the rim, from the nearest point
_COSINES, _SINES = np.cos(_AROUND), np.sin(_AROUND)
_UP = 1e-12  # least height of a direction
_BETWEEN = 0.95  # of a lobe's exponent at these points: the least anywhere
_MARGIN = 10.0


@jit.part
def most_in_disk(weigh, ax, ay, az, s, c, sine, cosine, by_half, node, parameters):  # type: ignore[no-untyped-def]
    """Bound of the integral of f_r cos theta_i [1] over a disk around a, for a view at (-s, 0, c).

    `weigh` is the address that `model_sums.over_nodes` gives; `by_half`: the half vector's angle counts; `node`, of 4 rows
    or more, is written.
    """
    along = s * ax + c * az
    x, y, z = s - along * ax, -along * ay, c - along * az  # towards the mirror direction
    length = math.sqrt(x * x + y * y + z * z)
    if along >= cosine or length < 1e-12:
        return math.inf
    e = sine / length
    x, y, z = cosine * ax + e * x, cosine * ay + e * y, max(cosine * az + e * z, _UP)
    node[0, 0], node[1, 0], node[2, 0], node[3, 0] = x, y, z, 1.0
    f_r, share = sum_over_nodes(weigh, node, 1, s, c, parameters), 1.0
    if by_half:
        h = math.hypot(x - s, y)
        share = max(0.0, 1.0 - 2.0 * sine / h) / (1.0 + 2.0 * sine / (z + c)) if h > 0.0 else 0.0
    exponent = share * share * math.log(max(f_r, 1e-307))
    return _MARGIN * math.pi * sine * sine * math.exp(exponent) if f_r < 1.0 else math.inf


def upper_bound(term: Term, axis: Array, half_angle: float, cos_n: Array, sin_n: Array) -> Array:
    """Bound (n,) of the integral of f_r cos theta_i over a cap above the horizon [1]; axis (n, 3) in the local frames."""
    mirror = np.stack((sin_n, np.zeros_like(sin_n), cos_n), axis=-1)
    at, lit = _nearest(axis, half_angle, mirror)
    f_r, viewer = np.zeros(lit.size), np.tile(mirror * np.array([-1.0, 1.0, 1.0]), (len(at), 1))
    accumulate(term.model)(np.ascontiguousarray(at.reshape(-1, 3)), viewer, term.values, 1.0, f_r)
    most = np.max(np.where(lit, f_r.reshape(lit.shape), 0.0), axis=0)
    faint = (most > 0.0) & (most < 1.0)
    most[faint] = most[faint] ** _BETWEEN
    return np.asarray(_MARGIN * 4.0 * math.pi * math.sin(0.5 * half_angle) ** 2 * most)


def _nearest(axis: Array, half_angle: float, mirror: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Directions (k, n, 3) of each cap where a lobe around `mirror` (n, 3) may be highest, and which are lit (k, n)."""
    cosine, sine = math.cos(half_angle), math.sin(half_angle)
    along = np.einsum("ni,ni->n", axis, mirror)
    towards = mirror - along[:, None] * axis
    length = np.linalg.norm(towards, axis=1, keepdims=True)
    towards = np.divide(towards, length, out=np.zeros_like(towards), where=length > 0.0)
    beside = np.cross(axis, towards)
    rim = cosine * axis + sine * (_COSINES[:, None, None] * towards + _SINES[:, None, None] * beside)
    # where the rim sets, and the horizon below the mirror direction
    flat = cosine / np.maximum(np.hypot(axis[:, 0], axis[:, 1]), 1e-300)
    azimuth = np.arctan2(axis[:, 1], axis[:, 0]) + np.arccos(np.clip(flat, -1.0, 1.0)) * np.array([[1.0], [-1.0], [0.0]])
    azimuth[2] = 0.0
    low = np.stack((np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)), axis=-1)
    sets = np.abs(flat) <= 1.0
    lit = np.concatenate((rim[..., 2] > 0.0, np.stack((sets, sets, axis[:, 0] >= cosine, along >= cosine))))
    at = np.concatenate((rim, low, mirror[None]))
    at[..., 2] = np.maximum(at[..., 2], _UP)
    return at, lit
