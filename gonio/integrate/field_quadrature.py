"""One (term, field) integral for each of many surface elements, by panels that break at all features of both.

Lobes are integrated one by one in polar coordinates about their own axes, maps about the viewer's axis with panels between
their rows and columns, other fields about the surface normal. Any BRDF, any viewer; `gonio.integrate.rings` is the fast way
for an isotropic BRDF seen along the view axis.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gonio.brdf.base import Term, accumulate
from gonio.errors import IntegrationError
from gonio.fields import EnvironmentMap, Field, FunctionField, Harmonics, Lobes
from gonio.integrate.cap import unit_rule
from gonio.integrate.frames import Elements
from gonio.integrate.panels import sphere_nodes
from gonio.integrate.quadrature import Effort

Array = NDArray[np.float64]
EPS = float(np.finfo(float).eps)
_ORDERS = (6, 10, 16, 24, 36)
_MAP_ORDERS = (3, 4, 6, 9)  # within a texel the map is a low polynomial
_LARGEST = 1 << 24  # nodes for one surface element
_NONE = 1e9  # [rad], a width that means: no such feature


class _Patch(NamedTuple):
    """One set of nodes: coordinates, and the radiance to sum over them."""

    field: Field
    pole: tuple[float, float, float] | None  # viewer-oriented; None: the surface normal
    pole_width: float
    rings: Array
    columns: int
    longest: float


def _patches(field: Field) -> Iterator[_Patch]:
    nothing = np.empty(0)
    if isinstance(field, Lobes):
        for a, k, t, f, mu in zip(field.amplitude, field.kappa, field.theta, field.phi, field.axes(), strict=True):
            if a > 0.0:
                one = Lobes(*(np.array([v]) for v in (a, k, t, f)))
                yield _Patch(one, (float(mu[0]), float(mu[1]), float(mu[2])), 1.0 / math.sqrt(max(k, 1.0)), nothing, 0, 1.6)
    elif isinstance(field, EnvironmentMap):
        n_theta, n_phi = field.samples.shape
        yield _Patch(field, (0.0, 0.0, 1.0), _NONE, np.pi * (np.arange(n_theta) + 0.5) / n_theta, n_phi, math.pi)
    else:
        longest = 3.0 * field.detail if isinstance(field, FunctionField | Harmonics) else 0.3
        yield _Patch(field, None, _NONE, nothing, 0, min(1.6, longest))


def integrate_field(
    term: Term, field: Field, elements: Elements, *, rtol: float, atol: float, effort: Effort
) -> tuple[Array, Array]:
    """Reflected radiance of each element due to one term and one field.

    Parameters
    ----------
    term : Term
        With values at pairs of directions (no delta).
    field : Field
    elements : Elements, length n
    rtol, atol : float
        Tolerance per element. An element that does not reach it keeps its honest error.
    effort : Effort
        Added to.

    Returns
    -------
    value, error : ndarray, shape (n,)
        [W m^-2 sr^-1].

    Raises
    ------
    IntegrationError
        If an element would need more than 16 million nodes.
    """
    patches = tuple(_patches(field))
    # (n, 3, 3), from viewer-oriented to local
    turn = np.stack([elements.local(axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))], axis=-1)
    viewer = elements.viewer()
    value, error = np.zeros(len(elements)), np.zeros(len(elements))
    width = term.lobe_width() or _NONE
    for k in range(len(elements)):
        totals: list[float] = []
        for order in _MAP_ORDERS if isinstance(field, EnvironmentMap) else _ORDERS:
            total = math.fsum(_sum(term, patch, turn[k], viewer[k], width, order, effort) for patch in patches)
            totals.append(total)
            value[k] = total
            error[k] = _estimate(totals) + 4.0 * EPS * abs(total) * (1.0 + 1.0 / width + 1.0 / field.detail)
            if error[k] <= max(rtol * abs(total), atol):
                break
    return value, error


def _estimate(totals: list[float]) -> float:
    """Error of the last of a series of results of rising order."""
    if len(totals) == 1:
        return math.inf
    last = abs(totals[-1] - totals[-2])
    if len(totals) == 2:
        return 2.0 * last
    before = abs(totals[-2] - totals[-3])
    return max(last, 0.03 * before) if last < 0.1 * before else 2.0 * max(last, before)


def _sum(term: Term, patch: _Patch, turn: Array, viewer: Array, width: float, order: int, effort: Effort) -> float:
    x, w = unit_rule(order)
    pole = np.array((0.0, 0.0, 1.0)) if patch.pole is None else turn @ np.array(patch.pole)
    mirror = np.array((-viewer[0], -viewer[1], viewer[2]))
    planes = np.concatenate(([[0.0, 0.0, 1.0, 0.0]], term.kinks(viewer)))
    shift = 0.0
    if patch.columns:  # meridians of the map relative to where the kernel counts azimuths from
        away = np.array((0.0, 0.0, 1.0)) if abs(pole[2]) < 0.9999 else np.array((1.0, 0.0, 0.0))
        start = turn.T @ (away - (away @ pole) * pole)
        shift = math.pi / patch.columns - math.atan2(start[1], start[0])
    size = 1 << 14
    while True:
        directions, weights = np.empty((size, 3)), np.empty(size)
        n = sphere_nodes(
            pole, mirror, width, patch.pole_width, planes, patch.rings, patch.columns, shift, patch.longest, x, w,
            directions, weights,
        )  # fmt: skip
        if n >= 0:
            break
        size *= 4
        if size > _LARGEST:
            raise IntegrationError(f"{term.model.name} under {patch.field.kind}: more than {_LARGEST} nodes a gradient")
    effort.add(n, order)
    directions, weights = directions[:n], weights[:n]
    f_r = np.zeros(n)
    accumulate(term.model)(directions, np.ascontiguousarray(np.broadcast_to(viewer, (n, 3))), term.values, term.weight, f_r)
    return float(np.dot(weights, f_r * patch.field.at(directions @ turn)))
