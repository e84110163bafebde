"""One (term, cap) integral for each of many surface elements, by the rule of `gonio.integrate.cap`, order by order.

Elements advance together: those that miss the tolerance at one order go on to the next. The error of a value is judged by
how it differs from lower orders, plus the rounding of the sum. While the rule converges the last difference is the
error of the lower order, far above that of the value; where the differences do not fall (an integrand with jumps or kinks
that nobody declared), the largest of them counts. No element starts at an order too low to resolve its narrowest feature.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.brdf.base import Term
from gonio.brdf.kernels import accumulate
from gonio.errors import IntegrationError
from gonio.integrate import threads as tiling
from gonio.integrate.adaptive import edge_rounding
from gonio.integrate.cap import NODE_ROWS, ring_nodes, unit_rule
from gonio.integrate.frames import Elements
from gonio.integrate.lights import over_cap
from gonio.integrate.panels import NO_LAYER
from gonio.integrate.tails import ROUNDING, UNDERFLOW, upper_bound
from gonio.source import Cap

Array = NDArray[np.float64]
EPS = float(np.finfo(float).eps)
ORDERS = (8, 16, 24, 32, 48, 64, 80, 104)  # nodes per panel: in eights, as loops take them
_FROM = ((1e-5, 0), (3e-9, 1), (1e-11, 2), (0.0, 3))  # rtol at least this: start with that order
_PER_WIDTH, _PER_LAYER = 1.3, 2.0  # nodes per unit of the sinh maps of lobe and horizon that the first order must have
_NO_LOBE = 1e9  # [rad]
_LIMB = 1e-150  # least cosine of the view: an infinite slope gives the limit
_TILE = 1 << 14  # nodes evaluated at once: they stay in the cache
_WORTH = 1 << 15  # nodes below which several threads gain nothing
_LARGEST = 1 << 24  # nodes for one surface element: 640 MiB
_FEW = 256  # surface elements up to which cells are tried where no order suits
_NARROW = 0.6  # half angle [rad] up to which a cap may be integrated about its own axis
_BROAD = 0.5  # lobe width [rad] from which a lobe does not matter for that choice


@dataclass
class Effort:
    """What a calculation cost: BRDF evaluations and the highest order used."""

    evaluations: int = 0
    order: int = 0

    def add(self, nodes: int, order: int) -> None:
        self.evaluations += nodes
        self.order = max(self.order, order)


class _Scene(NamedTuple):
    """What the tiles of one integral share; arrays over the elements."""

    term: Term
    cap: Cap
    cos_n: Array
    sin_n: Array
    axis: Array
    about_normal: NDArray[np.bool_]
    width: float
    depth: float
    planes: Array
    symmetric: NDArray[np.bool_]


def integrate_cap(
    term: Term,
    cap: Cap,
    elements: Elements,
    *,
    rtol: float,
    atol: float,
    about_normal: bool | None,
    effort: Effort,
    threads: int = 1,
    cautious: bool = True,
) -> tuple[Array, Array]:
    """Reflected radiance of each element due to one term and one cap.

    Parameters
    ----------
    term : Term
        With values (no delta). Anisotropic ones, those with features and functions of the user's go to
        `gonio.integrate.adaptive`.
    cap : Cap
    elements : Elements, length n
    rtol, atol : float
        Tolerance per element. An element that does not reach it keeps its honest error.
    about_normal : bool or None
        Pole of the coordinates: the surface normal (the memo's local form) or the cap's axis (its viewer form, when the
        axis is the viewer's). None: whichever suits each element.
    effort : Effort
        Added to.
    threads : int, optional
    cautious : bool, optional
        Refine until the estimate is a quarter of the tolerance and report at least half of the tolerance: differences of
        sums are sometimes small by chance. False: bare estimates, for callers with checks of their own.

    Returns
    -------
    value, error : ndarray, shape (n,)
        [W m^-2 sr^-1].

    Raises
    ------
    IntegrationError
        If an element would need more than 16 million nodes.
    """
    if term.model.own or not term.mirror_only:
        local = cap.half_angle > _NARROW if about_normal is None else about_normal
        return over_cap(
            term, cap, elements, rtol=0.3 * rtol, atol=0.3 * atol, about_normal=local, effort=effort, threads=threads
        )
    scene = scene_of(term, cap, elements, about_normal)
    n = len(elements)
    value, error = np.zeros(n), np.zeros(n)
    lit = lit_elements(scene)
    unit = rounding(scene)
    first = first_orders(scene, rtol)
    done = ~lit
    totals = np.full((5, n), np.nan)  # of the last orders, newest first
    kinked = scene.planes.shape[1] > 0
    crossed = lit & _rim_crosses_kink(scene) if kinked and cautious else np.zeros(n, dtype=np.bool_)
    done |= crossed
    for k, order in enumerate(orders_of(scene)):
        active = np.flatnonzero(~done & (first <= k))
        if not active.size:
            continue
        now, nodes = order_sums(scene, active, order, threads)
        effort.add(nodes, order)
        totals[1:, active] = totals[:-1, active]
        totals[0, active] = now
        value[active] = now
        allowed = np.maximum(rtol * np.abs(now), atol)
        estimate, slack = _estimate(totals[:, active], term.model.pieces), unit[active] * np.abs(now)
        done[active] = estimate + slack <= (0.25 if cautious else 1.0) * allowed
        error[active] = slack + (np.maximum(2.0 * estimate, 0.5 * allowed) if cautious else estimate)
        if np.all(done):
            break
    blind = _blind(scene, lit & ~crossed & (value == 0.0), error)
    matters = error > ROUNDING * np.max(np.abs(value), initial=0.0)
    missed, blind = ~done & matters, blind & matters
    if not kinked:  # a few that no order suits, such as of tables, whose pieces have borders that are not known
        missed &= unit * np.abs(value) < 0.1 * np.maximum(rtol * np.abs(value), atol)
        missed &= cautious and np.count_nonzero(missed) <= _FEW
    if cautious and np.count_nonzero(blind) <= _FEW:
        missed |= blind
    rest = np.flatnonzero(crossed | missed)
    if rest.size:
        local = about_normal is not False
        by_cells, left = over_cap(
            term, cap, elements.select(rest), rtol=0.3 * rtol, atol=0.3 * atol, about_normal=local, effort=effort,
            threads=threads,
        )  # fmt: skip
        better = crossed[rest] | (left < error[rest])
        value[rest[better]], error[rest[better]] = by_cells[better], left[better]
    return value, error


def _blind(scene: _Scene, none: NDArray[np.bool_], error: Array) -> NDArray[np.bool_]:
    """Of the elements `none`, with a value of 0, those whose nodes all missed a lobe's tail; sets the errors of all."""
    index = np.flatnonzero(none)
    blind = np.zeros(len(none), dtype=np.bool_)
    if index.size:
        bound = upper_bound(scene.term, scene.axis[index], scene.cap.half_angle, scene.cos_n[index], scene.sin_n[index])
        error[index] = abs(scene.cap.radiance * scene.term.weight) * np.maximum(bound, UNDERFLOW)
        blind[index] = bound > 0.0
    return blind


def scene_of(term: Term, cap: Cap, elements: Elements, about_normal: bool | None) -> _Scene:
    """What the rules need to know of a term, a cap and surface elements; arguments as of `integrate_cap`."""
    axis = np.ascontiguousarray(elements.local(cap.axis))
    n, width = len(elements), term.lobe_width() or _NO_LOBE
    if not term.kinked:
        planes = np.empty((n, 0, 4))
    else:
        each = [term.kinks(viewer) for viewer in elements.viewer()]
        planes = np.full((n, max((len(p) for p in each), default=0), 4), (0.0, 0.0, 1.0, 2.0))  # a plane out of reach
        for k, rows in enumerate(each):
            planes[k, : len(rows)] = rows
    if about_normal is not None:
        local = np.full(n, about_normal)
    elif cap.half_angle >= math.pi or planes.shape[1]:
        local = np.ones(n, dtype=np.bool_)
    elif width > _BROAD:
        local = np.full(n, cap.half_angle > _NARROW)
    else:  # a rim through the lobe is smooth about the cap's axis; a grazing view's lobe, a streak, only about the normal
        mirror = np.arccos(np.clip(elements.sin_theta * axis[:, 0] + elements.cos_theta * axis[:, 2], -1.0, 1.0))
        inside = (cap.half_angle - mirror) / width
        least = -3.0 if cap.half_angle > _NARROW else -10.0 if cap.half_angle > 0.5 * _NARROW else -np.inf
        local = (inside > 10.0) | (inside < least) | (elements.cos_theta < 0.2)
    symmetric = (axis[:, 1] == 0.0) & term.model.isotropic & (not term.model.own)
    cos_n = np.maximum(elements.cos_theta, _LIMB)
    depth = term.layer_width() if term.model.shadowed else NO_LAYER
    return _Scene(term, cap, cos_n, elements.sin_theta, axis, local, width, depth, planes, symmetric)


def lit_elements(scene: _Scene) -> NDArray[np.bool_]:
    """Elements above whose horizon some of the cap is."""
    if scene.cap.half_angle > math.pi / 2:
        return np.ones(len(scene.cos_n), dtype=np.bool_)
    return np.asarray(scene.axis[:, 2] > -math.sin(scene.cap.half_angle))


def orders_of(scene: _Scene) -> tuple[int, ...]:
    """Orders that may be tried: where there are kinks, cells are next after the first few."""
    return ORDERS[:-3] if scene.planes.shape[1] else ORDERS


def _rim_crosses_kink(scene: _Scene) -> NDArray[np.bool_]:
    """Elements for which a kink meets the cap's rim: rings are not smooth there, and their orders can agree on less."""
    if scene.cap.half_angle >= math.pi:
        return np.zeros(len(scene.cos_n), dtype=np.bool_)
    centre, half = scene.planes[:, :, :3], np.arccos(np.clip(scene.planes[:, :, 3], -1.0, 1.0))
    apart = np.arccos(np.clip(np.einsum("nkj,nj->nk", centre, scene.axis), -1.0, 1.0))
    rim = scene.cap.half_angle
    meet = (np.abs(apart - half) < rim) & (rim < np.minimum(apart + half, 2.0 * math.pi - apart - half))
    return np.asarray(np.any(meet & (np.abs(scene.planes[:, :, 3]) < 1.0), axis=1))


def rounding(scene: _Scene) -> Array:
    """Relative rounding error of the sums: 1 eps of a direction is eps / width of a lobe, or of what a horizon leaves."""
    width = scene.width * np.maximum(scene.cos_n, min(scene.width, 1.0))
    return np.asarray(4.0 * EPS * (1.0 + 1.0 / width) + edge_rounding(scene.axis, scene.cap.half_angle))


def first_orders(scene: _Scene, rtol: float) -> NDArray[np.intp]:
    """Index of the order to start with: by the tolerance, and such that no feature falls between the nodes."""
    start = next(k for least, k in _FROM if rtol >= least)
    if scene.width >= 10.0:
        return np.full(len(scene.cos_n), start)
    needed = np.full(len(scene.cos_n), _PER_WIDTH * math.asinh(1.0 / scene.width))
    if scene.depth < NO_LAYER:
        needed = np.maximum(needed, _PER_LAYER * np.arcsinh(1.0 / np.maximum(scene.cos_n, 1e-15)))
    return np.maximum(start, np.minimum(np.searchsorted(ORDERS, needed), len(ORDERS) - 3))


def _estimate(totals: Array, pieces: bool) -> Array:
    """Error of the newest of a series of results of rising order, shape (k, n), newest first, NaN before the first.

    Of a model made of pieces the differences fall by chance: the largest of the last three counts.
    """
    steps = np.abs(np.diff(totals, axis=0))
    step, earlier, third = steps[:3]
    if pieces:
        return np.where(np.isnan(third), np.inf, np.max(steps[:3], axis=0))
    largest = np.max(np.nan_to_num(steps), axis=0)
    converging = (step < 0.1 * earlier) & (np.isnan(third) | (earlier < 0.5 * third))
    slow = np.maximum(np.maximum(step, earlier), 0.5 * largest)
    three = np.where(converging, np.maximum(step, 0.005 * earlier), slow)
    return np.where(np.isnan(step), np.inf, np.where(np.isnan(earlier), 2.0 * step, three))


def order_sums(scene: _Scene, active: NDArray[np.intp], order: int, threads: int) -> tuple[Array, int]:
    """Sums of one order for the elements of index `active`, and how many nodes they took."""
    size = max(1, _TILE // (3 * order * order))
    out = np.empty(active.size)
    work = functools.partial(_tile, scene, active, out, order, size)
    if 3 * order * order * active.size < _WORTH:
        threads = 1
    return out, sum(tiling.run(work, range(0, active.size, size), threads))


def _tile(scene: _Scene, active: NDArray[np.intp], out: Array, order: int, size: int, at: int) -> int:
    x, w = unit_rule(order)
    some = active[at : at + size]
    cos_n, sin_n = scene.cos_n[some], scene.sin_n[some]
    nodes = tiling.scratch("nodes", lambda: np.empty((NODE_ROWS, 2 * _TILE)))
    starts = np.zeros(some.size + 1, dtype=np.int64)
    done = total = 0
    while done < some.size:
        m = ring_nodes(
            some[done:], scene.cos_n, scene.sin_n, scene.axis, scene.cap.half_angle, scene.about_normal, scene.width,
            scene.depth, scene.planes, scene.symmetric, x, w, nodes, starts,
        )  # fmt: skip
        if m == 0:  # one element alone needs more
            if nodes.shape[1] >= _LARGEST:
                raise IntegrationError(
                    f"{scene.term.model.name} under {scene.cap.kind}: more than {_LARGEST} nodes for one gradient"
                )
            nodes = np.empty((NODE_ROWS, 4 * nodes.shape[1]))
            continue
        count = int(starts[m])
        if scene.cap.profile is not None:
            nodes[3, :count] *= scene.cap.profile(nodes[4, :count])
        sums = weighted_sums(scene.term)(nodes, starts[: m + 1], cos_n[done : done + m], sin_n[done : done + m])
        out[at + done : at + done + m] = scene.cap.radiance * sums
        total += count
        done += m
    return total


def weighted_sums(term: Term) -> Callable[[Array, NDArray[np.int64], Array, Array], Array]:
    """``f(nodes, starts (m + 1,), cos_n (m,), sin_n (m,)) -> (m,)``: weight * f_r summed over the nodes of each element."""
    if term.model.function is None:
        return functools.partial(_array_sums, term)

    def sums(nodes: Array, starts: NDArray[np.int64], cos_n: Array, sin_n: Array) -> Array:
        out = np.empty(len(cos_n))
        _compiled_sums(term.model.function)(
            nodes[0], nodes[1], nodes[2], nodes[3], starts, cos_n, sin_n, term.values, term.weight, out
        )
        return out

    return sums


@functools.cache
def _compiled_sums(function: Any) -> Any:
    def sum_nodes(x, y, z, weights, starts, cos_n, sin_n, p, weight, out):  # type: ignore[no-untyped-def]
        for k in range(out.size):
            total = 0.0
            xr, zr = -sin_n[k], cos_n[k]
            for j in range(starts[k], starts[k + 1]):
                total += weights[j] * function(x[j], y[j], z[j], xr, 0.0, zr, p)
            out[k] = weight * total

    return jit.kernel(sum_nodes)


def _array_sums(term: Term, nodes: Array, starts: NDArray[np.int64], cos_n: Array, sin_n: Array) -> Array:
    count = int(starts[-1])
    length = np.diff(starts)
    viewer = np.repeat(np.stack((-sin_n, np.zeros_like(sin_n), cos_n), axis=-1), length, axis=0)
    f_r = np.zeros(count)
    accumulate(term.model)(np.ascontiguousarray(nodes[:3, :count].T), viewer, term.values, term.weight, f_r)
    running = np.concatenate(([0.0], np.cumsum(nodes[3, :count] * f_r)))
    return np.asarray(running[starts[1:]] - running[starts[:-1]])
