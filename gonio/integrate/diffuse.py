r"""Diffuse surfaces under uniform caps: closed forms (14b, 14c, and the part of a disk above the horizon).

The radiance is :math:`\rho L_0 E/\pi`, with E the integral of the cosine over what of the cap is above the horizon. Of a cap
of half angle delta at most 90 degrees, whose axis is gamma from the normal, that is all of it for
:math:`\cos\gamma\ge\sin\delta`, :math:`E = \pi\sin^2\delta\cos\gamma`; otherwise, by Lambert's integral along the rim up to
the azimuth :math:`\psi_0` about the axis at which it sets, and along the horizon,

.. math:: E = \psi_0\sin^2\delta\cos\gamma + z\sin^2\delta + (\arctan z - z), \quad
          \cos\psi_0 = -\cot\delta\cot\gamma,\ z = \tan\delta\sin\gamma\sin\psi_0 .

What is left of a cap that has almost set is a sum of strips along the horizon, of which none is negative.

References
----------
.. [1] B. K. P. Horn, R. W. Sjoberg, MIT AI Memo 498, 1978, section 14.
.. [2] J. H. Lambert, Photometria, 1760; J. M. Snyder, "Area Light Sources for Real-Time Graphics", MSR-TR-96-11, 1996.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.brdf.base import Term
from gonio.integrate.cap import unit_rule
from gonio.integrate.closed_forms import diffuse_albedo
from gonio.integrate.grid import BLOCK, EPS, Gradients, block
from gonio.source import Cap

Array = NDArray[np.float64]
_LOW = 0.2  # psi_0 [rad] below which the sum's terms cancel too much
_NODES, _WEIGHTS = unit_rule(9)


@jit.model
def rest_of_arctan(z):  # type: ignore[no-untyped-def]
    """arctan z - z, z >= 0, without cancellation."""
    if z > 0.3:
        return math.atan(z) - z
    z2, total = z * z, 0.0
    for k in range(16, 0, -1):
        total = 1.0 / (2 * k + 1) - z2 * total
    return -z * z2 * total


@jit.model
def strips(rho, up, end):  # type: ignore[no-untyped-def]
    """Cosine over a segment, as seen on the plane that touches the sphere at the cap's axis: rho = tan delta."""
    total = 0.0
    for k in range(_NODES.size):
        psi = end * _NODES[k]
        across, along = rho * math.sin(psi), rho * math.cos(psi)
        b2 = 1.0 + along * along
        b = math.sqrt(b2)
        strip = across / (b2 * (1.0 + rho * rho)) + math.atan(across / b) / (b2 * b)
        height = 2.0 * up * rho * math.sin(0.5 * (end + psi)) * math.sin(0.5 * (end - psi))
        total += _WEIGHTS[k] * end * across * height * strip
    return total


@jit.model
def lit(az, up, sine, cosine):  # type: ignore[no-untyped-def]
    """E of a cap of sin delta, cos delta; az, up: cosine and sine of its axis's angle from the normal."""
    if az >= sine:
        return math.pi * sine * sine * az
    if az <= -sine:
        return 0.0
    above, below = max(0.0, sine * up + cosine * az), max(0.0, sine * up - cosine * az)
    end = 2.0 * math.atan2(math.sqrt(above), math.sqrt(below))
    if end < _LOW:
        return strips(sine / cosine, up, end)
    z = math.sqrt(above * below) / cosine
    return max(0.0, sine * sine * (end * az + z) + rest_of_arctan(z))


def _all_lit(p, q, start, stop, axis, sine, cosine, scale, value, error):  # type: ignore[no-untyped-def]
    rows, worst, done = np.empty((6, BLOCK)), 0.0, start
    c, s, cf, sf = rows[0], rows[1], rows[2], rows[3]
    while done < stop:
        n = block(p, q, done, stop, rows)
        for k in range(n):
            along, across = axis[0] * cf[k] + axis[1] * sf[k], axis[1] * cf[k] - axis[0] * sf[k]
            az, ax = along * s[k] + axis[2] * c[k], along * c[k] - axis[2] * s[k]
            if az > -sine:
                total = scale * lit(az, math.sqrt(ax * ax + across * across), sine, cosine)
                # a few eps of cos gamma count against what is above the horizon
                relative = EPS * (1e4 + 16.0 / (az + sine)) if az < sine else EPS * (16.0 + 4.0 / az)
                value[done + k] += total
                error[done + k] += total * relative
                worst = max(worst, relative)
        done += n
    return worst


def _all_facing(p, q, start, stop, axis, a, b, slack, value, error):  # type: ignore[no-untyped-def]
    rows, done = np.empty((6, BLOCK)), start
    c, s, cf, sf = rows[0], rows[1], rows[2], rows[3]
    while done < stop:
        n = block(p, q, done, stop, rows)
        for k in range(n):
            value[done + k] += a + b * ((axis[0] * cf[k] + axis[1] * sf[k]) * s[k] + axis[2] * c[k])
            error[done + k] += slack
        done += n


_lit = jit.kernel(_all_lit, fastmath=False)
_facing = jit.kernel(_all_facing, fastmath=False)


def suits(term: Term, cap: Cap) -> bool:
    """Whether `add` holds."""
    return term.model.diffuse and cap.profile is None and (cap.half_angle >= math.pi or cap.half_angle <= 0.5 * math.pi)


def add(term: Term, cap: Cap, gradients: Gradients, tile: tuple[int, int], value: Array, error: Array) -> float:
    """Add value and error on one tile; returns the largest relative error."""
    full = diffuse_albedo(term) * cap.radiance
    axis = np.array(cap.axis)
    if cap.half_angle < 0.5 * math.pi:
        sine, cosine = math.sin(cap.half_angle), math.cos(cap.half_angle)
        return float(_lit(gradients.p, gradients.q, *tile, axis, sine, cosine, full / math.pi, value, error))
    a, b = (0.5 * full, 0.5 * full) if cap.half_angle < math.pi else (full, 0.0)
    _facing(gradients.p, gradients.q, *tile, axis, a, b, 8.0 * EPS * full, value, error)
    return 8.0 * EPS
