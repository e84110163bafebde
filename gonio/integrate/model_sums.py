"""What the rules for disks need of a model: weighted sums of its values, called by address.

The rules themselves, most of the code, do not depend on the model and are compiled once; a model under a disk is ready a
fraction of a second later.
"""

from __future__ import annotations

import functools
import math
from typing import Any

from gonio import jit

_OVER_NODES = "float64(float64[:,::1], int64, float64, float64, float64[::1])"
_OVER_RULE = "void(float64[:,::1], int64, float64[:,::1], int64, int64, float64[::1], float64[:,::1])"

sum_over_nodes = jit.calling(_OVER_NODES)
sums_over_rule = jit.calling(_OVER_RULE)


@functools.cache
def over_nodes(function: Any) -> int:
    """Address for ``sum_over_nodes(address, nodes (4, ...), count, sin_n, cos_n, parameters)``: for one surface element.

    Rows of `nodes`: directions x, y, z in the local frame, z > 0, and weights, of which each is multiplied by f_r.
    """

    def weigh(nodes, count, s, c, parameters):  # type: ignore[no-untyped-def]
        x, y, z, weights = nodes[0], nodes[1], nodes[2], nodes[3]
        total = 0.0
        for j in range(count):
            total += weights[j] * function(x[j], y[j], z[j], -s, 0.0, c, parameters)
        return total

    return jit.address(weigh, _OVER_NODES)


@functools.cache
def over_rule(function: Any) -> int:
    """Address for ``sums_over_rule(address, frames (11, ...), m, nodes (4, ...), first, last, parameters, out (3, ...))``.

    For each of m surface elements, whose disk's axis and two tangents are rows of `frames`, with sin and cos of theta_n: the
    sum of f_r cos theta_i over the nodes `first` to `last` of a rule about that axis, into row 0 of `out`; the largest and
    the least f_r at these nodes, into rows 1 and 2.
    """

    def apply(frames, m, nodes, first, last, parameters, out):  # type: ignore[no-untyped-def]
        some, high, low = out[0, :m], out[1, :m], out[2, :m]
        some[:], high[:], low[:] = 0.0, 0.0, math.inf
        ax, ay, az, s, c = frames[0, :m], frames[1, :m], frames[2, :m], frames[9, :m], frames[10, :m]
        ex, ey, ez, fx, fy, fz = (
            frames[3, :m], frames[4, :m], frames[5, :m], frames[6, :m], frames[7, :m], frames[8, :m]
        )  # fmt: skip
        for j in range(first, last):
            t, u, v, weight = nodes[0, j], nodes[1, j], nodes[2, j], nodes[3, j]
            for k in range(m):
                zi = t * az[k] + u * ez[k] + v * fz[k]
                xi, yi = t * ax[k] + u * ex[k] + v * fx[k], t * ay[k] + u * ey[k] + v * fy[k]
                f = function(xi, yi, zi, -s[k], 0.0, c[k], parameters)
                some[k] += weight * zi * f
                high[k] = f if f > high[k] else high[k]
                low[k] = f if f < low[k] else low[k]

    return jit.address(apply, _OVER_RULE, apart=True)
