"""One (term, cap) integral at many slopes, for a table in theta_n: a few probes of each piece tell what order all need.

The slopes of a piece differ so little that the rule of `gonio.integrate.cap` converges alike at all of them. So orders are
compared at the probes. The nodes, which are many more, take two low ones; that the difference of these, times the probes'
rate of convergence, is small tells that the nodes are no worse than the probes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gonio.brdf.base import Term
from gonio.integrate import radial
from gonio.integrate.quadrature import (
    EPS,
    Effort,
    first_orders,
    integrate_cap,
    lit_elements,
    order_sums,
    orders_of,
    rounding,
    scene_of,
)
from gonio.source import Cap

Array = NDArray[np.float64]
_SAFETY = 3.0  # of the difference of two orders, as an error of the lower one at all places
_LEAST = 1e-5  # rtol by which the first order is chosen: the least that resolves the features


def sample(
    term: Term,
    cap: Cap,
    tau: Array,
    probes: int,
    finer: NDArray[np.intp],
    *,
    rtol: float,
    atol: float,
    effort: Effort,
    threads: int,
) -> tuple[Array, Array]:
    """Reflected radiance at the places of pieces.

    Parameters
    ----------
    term : Term
    cap : Cap
        Its axis is the view axis.
    tau : ndarray, shape (k, n)
        tan(theta_n / 2); of each piece, the last `probes` tell what order it needs.
    probes : int
    finer : ndarray of int, shape (k,)
        How many orders more than the probes ask for.
    rtol, atol : float
        Tolerance of each value.
    effort : Effort
        Added to.
    threads : int

    Returns
    -------
    value, error : ndarray, shape (k, n)
        [W m^-2 sr^-1]; errors are estimates.
    """
    (pieces, places), elements = tau.shape, radial.elements(tau.ravel())
    value, error = np.zeros(tau.size), np.zeros(tau.size)
    if term.model.own or term.model.pieces or not term.mirror_only:
        left = np.arange(tau.size)
    else:
        scene = scene_of(term, cap, elements, None)
        least = atol / rtol + 1e-300  # values below it need no digits
        # orders are compared within a piece among the slopes with the same pole of the coordinates
        groups, group = 2 * pieces, 2 * (np.arange(tau.size) // places) + scene.about_normal
        first, found, loss, rate = np.zeros(groups, dtype=np.intp), np.full(groups, -1), np.zeros(groups), np.ones(groups)
        np.maximum.at(first, group, first_orders(scene, _LEAST))
        exact = rounding(scene)
        limit = np.maximum(rtol, _SAFETY * exact)  # of relative errors
        lit = lit_elements(scene)
        probe = lit & (np.arange(tau.size) % places >= places - probes)
        orders = orders_of(scene)

        def advance(active: NDArray[np.intp], k: int) -> Array:
            """Sums of order k into `value`; how they differ from what was there, in units of the limit."""
            now, nodes = order_sums(scene, active, orders[k], threads)
            effort.add(nodes, orders[k])
            step = np.abs(now - value[active]) / (np.maximum(np.abs(now), least) * limit[active])
            value[active] = now
            return np.asarray(step)

        before = np.zeros(tau.size)
        for k in range(len(orders)):
            active = np.flatnonzero(probe & (found[group] < 0) & (first[group] <= k))
            if not active.size:
                continue
            step, mine = advance(active, k), group[active]
            largest, slowest = np.full(groups, -1.0), np.zeros(groups)
            np.maximum.at(largest, mine, step)
            np.maximum.at(slowest, mine, step / np.maximum(before[active], EPS / limit[active]))
            before[active] = step
            enough = (largest >= 0.0) & (first < k) & (_SAFETY * largest <= 1.0)
            found[enough], loss[enough], rate[enough] = k, _SAFETY * largest[enough], np.minimum(slowest[enough], 1.0)
        error = np.where(lit, loss[group], np.inf)
        nodal = lit & ~probe & (found[group] >= 0)
        # the order below the last of the probes, and one less: by the probes' rate their difference tells the error
        upper = np.maximum(found - 1 + np.repeat(finer, 2), first + 1)
        upper = np.minimum(upper, len(orders) - 1)
        rate[upper >= found] = 1.0
        for k in np.unique(upper[group[nodal]]):
            active = np.flatnonzero(nodal & (upper[group] == k))
            advance(active, k - 1)
            step = advance(active, k)
            error[active] = np.maximum(error[active], _SAFETY * rate[group[active]] * step)
        left = np.flatnonzero(lit & ((found[group] < 0) | (error > 1.0) | (value == 0.0)))
        error = np.where(lit, (error * limit + exact) * np.maximum(np.abs(value), least), 0.0)
    if left.size:
        value[left], error[left] = integrate_cap(
            term, cap, elements.select(left), rtol=rtol, atol=atol, about_normal=None, effort=effort, threads=threads,
            cautious=False,
        )  # fmt: skip
    return value.reshape(tau.shape), error.reshape(tau.shape)
