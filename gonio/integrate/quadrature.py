"""One (term, cap) integral for each of many surface elements, by the rule of `gonio.integrate.cap`, order by order.

The error of a value is judged by how it differs from the two lower orders, plus the rounding of the sum. While the rule
converges the last difference is the error of the lower order, far above that of the value; where the differences do not
fall (an integrand with jumps or kinks), both count, twice.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gonio.brdf.base import Term, accumulate
from gonio.errors import IntegrationError
from gonio.integrate.adaptive import over_cap
from gonio.integrate.cap import ORDERS, cap_nodes, unit_rule
from gonio.integrate.frames import Elements
from gonio.source import Cap

Array = NDArray[np.float64]
EPS = float(np.finfo(float).eps)
_NO_LOBE = 1e9  # [rad]
_LARGEST = 1 << 24  # nodes for one surface element: 512 MiB


@dataclass
class Effort:
    """What a calculation cost: BRDF evaluations and the highest order used."""

    evaluations: int = 0
    order: int = 0

    def add(self, nodes: int, order: int) -> None:
        self.evaluations += nodes
        self.order = max(self.order, order)


class _Frame(NamedTuple):
    """First arguments of `cap_nodes`."""

    cos_n: float
    sin_n: float
    axis: Array
    half_angle: float
    about_normal: bool
    width: float
    symmetric: bool


class _Scratch:
    """Node arrays that grow to what the largest element needs."""

    def __init__(self) -> None:
        self.resize(1 << 14)

    def resize(self, size: int) -> None:
        self.directions, self.weights = np.empty((size, 3)), np.empty(size)
        self.viewer, self.f_r = np.empty((size, 3)), np.empty(size)


def integrate_cap(
    term: Term, cap: Cap, elements: Elements, *, rtol: float, atol: float, about_normal: bool | None, effort: Effort
) -> tuple[Array, Array]:
    """Reflected radiance of each element due to one term and one cap.

    Parameters
    ----------
    term : Term
        With values (no delta). One that is not plain goes to `gonio.integrate.adaptive`.
    cap : Cap
    elements : Elements, length n
    rtol, atol : float
        Tolerance per element. An element that does not reach it keeps its honest error.
    about_normal : bool or None
        Pole of the coordinates: the surface normal (the memo's local form) or the cap's axis (its viewer form, when the
        axis is the viewer's). None: the normal for wide caps, the axis for narrow ones.
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
    local = about_normal if about_normal is not None else cap.half_angle > 0.5
    if not term.plain:
        return over_cap(term, cap, elements, rtol=rtol, atol=atol, about_normal=local, effort=effort)
    width = term.lobe_width()
    axis_local = elements.local(cap.axis)
    value, error = np.zeros(len(elements)), np.zeros(len(elements))
    scratch = _Scratch()
    for k in range(len(elements)):
        axis = np.ascontiguousarray(axis_local[k])
        if cap.half_angle < np.pi / 2 and axis[2] <= -np.sin(cap.half_angle):
            continue  # the whole cap is below the horizon of this element
        symmetric = bool(axis[1] == 0.0) and term.model.isotropic
        cosine, sine = float(elements.cos_theta[k]), float(elements.sin_theta[k])
        frame = _Frame(cosine, sine, axis, cap.half_angle, local, width or _NO_LOBE, symmetric)
        totals: list[float] = []
        for order in ORDERS:
            total, nodes = _sum(term, cap, frame, order, scratch)
            effort.add(nodes, order)
            totals.append(total)
            rounding = 4.0 * EPS * abs(total) * (1.0 + 1.0 / frame.width)
            value[k], error[k] = total, _estimate(totals) + rounding
            if error[k] <= max(rtol * abs(total), atol):
                break
    return value, error


def _estimate(totals: list[float]) -> float:
    """Error of the last of a series of results of rising order."""
    if len(totals) == 1:
        return float("inf")
    last = abs(totals[-1] - totals[-2])
    if len(totals) == 2:
        return 2.0 * last
    before = abs(totals[-2] - totals[-3])
    return max(last, 0.03 * before) if last < 0.1 * before else 2.0 * max(last, before)


def _sum(term: Term, cap: Cap, frame: _Frame, order: int, scratch: _Scratch) -> tuple[float, int]:
    x, w = unit_rule(order)
    while (n := cap_nodes(*frame, x, w, scratch.directions, scratch.weights)) < 0:
        if scratch.weights.size >= _LARGEST:
            raise IntegrationError(f"{term.model.name} under {cap.kind}: more than {_LARGEST} nodes for one gradient")
        scratch.resize(2 * scratch.weights.size)
    directions, weights = scratch.directions[:n], scratch.weights[:n]
    viewer, f_r = scratch.viewer[:n], scratch.f_r[:n]
    viewer[:] = (-frame.sin_n, 0.0, frame.cos_n)
    f_r[:] = 0.0
    accumulate(term.model)(directions, viewer, term.values, term.weight, f_r)
    if cap.profile is not None:
        f_r *= cap.profile(directions @ frame.axis)
    return cap.radiance * float(np.dot(weights, f_r)), n
