r"""A BRDF as a table over Rusinkiewicz's half and difference angles, with an uncertainty and a coverage flag at every node.

With :math:`t = \tan(\theta_h/2)`, nodes stand at :math:`t_k = s\sinh(hk)`, evenly within a lobe of scale s and at even
ratios beyond it, and at even steps of :math:`\tan(\theta_d/2)` and of :math:`\tan(\phi_d/2)`. All three come from lengths of
sums and differences of the two unit vectors, and the node below t from a look-up list, so an evaluation needs square roots
and no transcendental function. phi_d is folded into [0, pi/2], which makes every table reciprocal and mirror-symmetric by
construction. The fourth root of f_r is interpolated by Catmull-Rom cubics (on uneven nodes: Hermite cubics whose slopes are
those of parabolas through three nodes), once differentiable, and raised again: six decades are one and a half, and no value
can be negative.

It refuses anisotropy: phi_h is not a coordinate. Nodes beyond the horizon carry a continuation for the interpolation's
sake; f_r is 0 there. How scattered samples become nodes is in `gonio.brdf.scattered`.

References
----------
.. [1] S. M. Rusinkiewicz, "A New Change of Variables for Efficient BRDF Representation", Eurographics Workshop on
   Rendering, 1998. doi:10.1007/978-3-7091-6453-2_2
.. [2] E. Catmull, R. Rom, "A class of local interpolating splines", Computer Aided Geometric Design, 1974.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.brdf.base import BRDF, Model, Term
from gonio.brdf.packed import BUCKETS, CELL, LARGE, SMALL, buckets, cells, cubic, weights
from gonio.errors import DatasetError
from gonio.halfdiff import directions
from gonio.samples import BRDFSamples

Array = NDArray[np.float64]
SHAPE = (48, 32, 16)  # nodes along theta_h, theta_d, phi_d
SCALE = 0.1  # of the nodes along theta_h where nothing is known of a lobe
LEAST_SCALE = 2e-4
HEAD = 4 + BUCKETS  # sizes and number of buckets, then the buckets, the cells and the values

BELOW_HORIZON, MEASURED, INTERPOLATED, EXTRAPOLATED, MODEL = 0, 1, 2, 3, 4
COVERAGE = {
    BELOW_HORIZON: "below_horizon",
    MEASURED: "measured",
    INTERPOLATED: "interpolated",
    EXTRAPOLATED: "extrapolated",
    MODEL: "model",
}


@jit.model
def tabulated_f_r(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float, p: list[float]) -> float:
    if not (zi > 0.0 and zr > 0.0):
        return 0.0
    n_h, n_d, n_p = int(p[0]) & SMALL, int(p[1]) & SMALL, int(p[2]) & SMALL
    # s = wi + wr, |s| = 2 cos theta_d; e = wi - wr, |e| = 2 sin theta_d
    sx, sy, sz = xi + xr, yi + yr, zi + zr
    ex, ey, ez = xi - xr, yi - yr, zi - zr
    st2 = sx * sx + sy * sy
    s, e = math.sqrt(st2 + sz * sz), math.sqrt(ex * ex + ey * ey + ez * ez)
    t = math.sqrt(st2) / (s + sz)  # tan(theta_h / 2) = sin / (1 + cos)
    b = e / (s + 2.0) * (n_d - 1)
    # cos phi_d = -e_z |s| / (2 |s_t| sin theta_d), sin phi_d = (s_x e_y - s_y e_x) / (2 |s_t| sin theta_d)
    across, along = 2.0 * abs(xr * yi - xi * yr), abs(ez) * s
    length = along + math.sqrt(along * along + across * across)
    c = across / length * (n_p - 1) if length > 0.0 else 0.0

    i = int(p[4 + (min(int(math.sqrt(t) * BUCKETS), BUCKETS - 1) & SMALL)]) & SMALL
    while i < n_h - 2 and t > p[HEAD + CELL * (i + 1)]:
        i += 1
    at = (HEAD + CELL * i) & LARGE
    u = (t - p[at]) * p[at + 1]
    j, k = min(int(b), n_d - 2) & SMALL, min(int(c), n_p - 2) & SMALL
    # the table has a row of mirrored nodes before its first and after its last one, so all 64 values are there
    plane, row = (n_d + 2) * (n_p + 2), n_p + 2
    first = (HEAD + CELL * (n_h - 1) + i * plane + j * row + k) & LARGE
    q: float = cubic(p, at + 2, first, plane, row, u, weights(b - j), weights(c - k))
    q = max(q, 0.0)
    q *= q
    return q * q


def _lobe_width(packed: Array) -> float:
    """Half width [rad] in theta_h of the narrowest peak around theta_h = 0; 1 where no column has one."""
    n_h, n_d, n_p = (int(n) for n in packed[:3])
    t = np.append(packed[HEAD : HEAD + CELL * (n_h - 1) : CELL], 1.0)
    f = packed[HEAD + CELL * (n_h - 1) :].reshape(n_h + 2, n_d + 2, n_p + 2)[1:-1, 1:-1, 1:-1] ** 4
    theta_h = 2.0 * np.arctan(t)
    width = 1.0
    for j in range(n_d // 2):  # theta_d up to about 53 degrees: beyond, the horizon cuts the lobe
        column = f[:, j, n_p - 1]  # phi_d = 90 degrees: above the horizon at any theta_h
        peak, foot = float(column[0]), float(column[-1])
        if peak > 2.0 * foot:
            below = np.flatnonzero(column < 0.5 * (peak + foot))
            width = min(width, float(theta_h[max(int(below[0]), 1)]))
    return width


TABULATED = Model(
    name="tabulated",
    parameters=(),  # the parameter array is the packed table
    function=tabulated_f_r,
    doc="Table over half and difference angles, cubic in the fourth root of f_r.",
    reference="Rusinkiewicz, Eurographics Workshop on Rendering, 1998",
    lobe_width=_lobe_width,
    energy_bounded=False,
    pieces=True,
)


def nodes(shape: tuple[int, int, int] = SHAPE, scale: float = SCALE) -> tuple[Array, Array, Array]:
    """Node angles theta_h, theta_d, phi_d of a table of that shape and scale of theta_h [rad]; phi_d in [0, pi/2]."""
    check_shape(shape)
    _, b, c = (np.linspace(0.0, 1.0, n) for n in shape)
    return 2.0 * np.arctan(tangents(shape[0], scale)), 2.0 * np.arctan(b), 2.0 * np.arctan(c)


def tangents(n: int, scale: float) -> Array:
    """The n nodes of t = tan(theta_h / 2), from 0 to 1."""
    if not LEAST_SCALE <= scale <= 10.0:
        raise DatasetError(f"a table whose nodes have the scale {scale:g}: it must be from {LEAST_SCALE:g} to 10")
    t = scale * np.sinh(np.linspace(0.0, math.asinh(1.0 / scale), n))
    t[0], t[-1] = 0.0, 1.0
    return t


def scale_for(lobe_width: float | None) -> float:
    """Scale of the nodes for a lobe of that half width in half-vector angle [rad]: a third of it, in t."""
    return SCALE if lobe_width is None else float(np.clip(lobe_width / 6.0, LEAST_SCALE, 0.3))


def check_shape(shape: tuple[int, ...]) -> None:
    """Refuse a table that cannot be interpolated or that would fill the memory."""
    if len(shape) != 3 or min(shape) < 4 or math.prod(int(n) for n in shape) > 20_000_000:
        raise DatasetError(
            f"a table of shape {tuple(shape)} cannot be used: give three sizes of at least 4 nodes and at most "
            "20 million nodes together"
        )


def check_values(value: Array, u: Array, coverage: NDArray[np.uint8]) -> None:
    """Refuse numbers that no table has: negative, not finite, flags unknown, shapes that differ."""
    for name, array in (("u", u), ("coverage", coverage)):
        if array.shape != value.shape:
            raise DatasetError(f"table: {name} has shape {array.shape}, value has {value.shape}")
    if not np.all(np.isfinite(value)) or np.any(value < 0):
        raise DatasetError("table: a value is negative or not finite; the file is damaged")
    if np.any(u < 0) or np.any(np.isinf(u)):
        raise DatasetError("table: an uncertainty is negative or infinite; the file is damaged")
    if np.any(coverage > max(COVERAGE)):
        raise DatasetError(f"table: coverage {int(coverage.max())} is unknown; known are 0 to {max(COVERAGE)}")


def plain_samples(omega_i: Array, omega_r: Array, value: Array, u: Array, attributes: Mapping[str, str]) -> BRDFSamples:
    """Nodes (n,) at pairs of directions (n, 3) as samples, without those at the horizon."""
    theta_i, theta_r = (np.arctan2(np.hypot(w[:, 0], w[:, 1]), w[:, 2]) for w in (omega_i, omega_r))
    phi_i, phi_r = (np.mod(np.arctan2(w[:, 1], w[:, 0]), 2 * np.pi) for w in (omega_i, omega_r))
    keep = (theta_i < np.pi / 2) & (theta_r < np.pi / 2)
    at = theta_i[keep], phi_i[keep], theta_r[keep], phi_r[keep]
    return BRDFSamples.plain(*at, value[keep], u[keep], attributes=dict(attributes))


def node_directions(shape: tuple[int, int, int] = SHAPE, scale: float = SCALE) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Directions at which the nodes stand.

    Returns
    -------
    omega_i, omega_r : ndarray, shape (*shape, 3)
        Above the horizon; a node beyond it is moved along theta_h = theta_d towards the normal until both directions are
        one degree above it.
    below : ndarray of bool, shape (*shape)
        The node itself is at or below the horizon.
    """
    theta_h, theta_d, phi_d = np.meshgrid(*nodes(shape, scale), indexing="ij")
    lowest = math.sin(math.radians(1.0))

    def height(t: Array) -> Array:  # the smaller of cos theta_i and cos theta_r
        return np.asarray(
            np.cos(t * theta_h) * np.cos(t * theta_d) - np.sin(t * theta_h) * np.sin(t * theta_d) * np.cos(phi_d)
        )

    one = np.ones_like(theta_h)
    below = height(one) <= 1e-12
    low, high = np.zeros_like(theta_h), one.copy()
    for _ in range(50):
        middle = 0.5 * (low + high)
        up = height(middle) >= lowest
        low, high = np.where(up, middle, low), np.where(up, high, middle)
    t = np.where(below, low, 1.0)
    omega_i, omega_r = directions(t * theta_h, np.zeros_like(theta_h), t * theta_d, phi_d)
    return omega_i, omega_r, below


@dataclass(frozen=True)
class TabulatedBRDF:
    """An isotropic, reciprocal BRDF on a grid.

    Attributes
    ----------
    value : ndarray, shape (n_h, n_d, n_p)
        f_r [1/sr] at the nodes of `nodes`, never negative.
    u : ndarray, same shape
        Standard uncertainty of `value` [1/sr] from random errors, scatter and interpolation; shared errors (scale, axis
        zeros) are not in it.
    coverage : ndarray of uint8, same shape
        Keys of `COVERAGE`: 0 below the horizon, 1 measured, 2 interpolated, 3 extrapolated, 4 from a fitted model.
    attributes : mapping of str to str
    scale : float
        Of the nodes along theta_h; `scale_for` a lobe.
    """

    value: Array
    u: Array
    coverage: NDArray[np.uint8]
    attributes: Mapping[str, str] = field(default_factory=dict)
    scale: float = SCALE

    def __post_init__(self) -> None:
        check_shape(self.value.shape)
        tangents(self.value.shape[0], self.scale)
        check_values(self.value, self.u, self.coverage)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of nodes along theta_h, theta_d, phi_d."""
        n_h, n_d, n_p = self.value.shape
        return n_h, n_d, n_p

    def nodes(self) -> tuple[Array, Array, Array]:
        """Node angles theta_h, theta_d, phi_d [rad]."""
        return nodes(self.shape, self.scale)

    def brdf(self) -> BRDF:
        """The table as a BRDF of one term, for evaluation and for the integrator."""
        return _packed(self.value, self.scale)

    def u_brdf(self) -> BRDF:
        """The table's uncertainty, to be evaluated as a BRDF is [1/sr]."""
        return _packed(np.nan_to_num(self.u), self.scale)

    def coverage_at(self, omega_i: Array, omega_r: Array) -> NDArray[np.uint8]:
        """Coverage flag at pairs of directions (..., 3): that of the nearest node, below the horizon 0.

        A direction next to a node that was measured, though not at it, is interpolated.
        """
        from gonio.brdf.scattered import grid_position

        wi, wr = np.broadcast_arrays(np.asarray(omega_i, dtype=float), np.asarray(omega_r, dtype=float))
        position = grid_position(wi.reshape(-1, 3), wr.reshape(-1, 3), self.shape, self.scale)
        nearest = tuple(np.rint(position).astype(np.int64).T)
        found = self.coverage[nearest].copy()
        apart = np.max(np.abs(position - np.rint(position)), axis=1) > 0.1
        found[(found == MEASURED) & apart] = INTERPOLATED
        up = (wi.reshape(-1, 3)[:, 2] > 0) & (wr.reshape(-1, 3)[:, 2] > 0)
        found[up & (found == BELOW_HORIZON)] = EXTRAPOLATED  # between the horizon and the first node above it
        found[~up] = BELOW_HORIZON
        return np.asarray(found.reshape(wi.shape[:-1]))

    def counts(self) -> dict[str, int]:
        """Number of nodes by coverage."""
        return {name: int(np.count_nonzero(self.coverage == flag)) for flag, name in COVERAGE.items()}

    def samples(self) -> BRDFSamples:
        """The nodes above the horizon as samples, without those that were extrapolated or taken from a model."""
        omega_i, omega_r, _ = node_directions(self.shape, self.scale)
        known = (self.coverage == MEASURED) | (self.coverage == INTERPOLATED)
        return plain_samples(omega_i[known], omega_r[known], self.value[known], self.u[known], self.attributes)

    def save(self, path: str | Path) -> None:
        """Write the table as NetCDF."""
        from gonio.brdf.tables import Tables

        Tables((self,)).save(path)

    @classmethod
    def load(cls, path: str | Path) -> TabulatedBRDF:
        """Read a table from NetCDF; `DatasetError` if the file holds none, or one with a grain or several channels."""
        from gonio.brdf.tables import Tables

        found = Tables.load(path)
        if not isinstance(found.main, cls) or len(found.tables) > 1:
            raise DatasetError(
                f"{path} holds a table with a grain or several channels; read it with gonio.brdf.tables.Tables"
            )
        return found.main


def _packed(f: Array, scale: float) -> BRDF:
    root = np.sqrt(np.sqrt(f))
    # mirrored nodes around: even about theta_h = 0, theta_d = 0, phi_d = 0 and phi_d = pi/2, level beyond the others
    root = np.concatenate((root[1:2], root, root[-1:]), axis=0)
    root = np.concatenate((root[:, 1:2], root, root[:, -1:]), axis=1)
    root = np.concatenate((root[:, :, 1:2], root, root[:, :, -2:-1]), axis=2)
    t = tangents(f.shape[0], scale)
    head = np.array([*f.shape, BUCKETS], dtype=float)
    return BRDF([Term(TABULATED, np.concatenate((head, buckets(t), cells(t).ravel(), root.ravel())))])


def from_brdf(brdf: BRDF, shape: tuple[int, int, int] = SHAPE, scale: float | None = None) -> TabulatedBRDF:
    """The table of a BRDF that is known everywhere: every node above the horizon counts as taken from a model.

    Nodes follow the narrowest lobe that a term declares, unless a scale is given.
    """
    if scale is None:
        widths = [w for w in (term.lobe_width() for term in brdf.terms) if w is not None]
        scale = scale_for(min(widths, default=None))
    omega_i, omega_r, below = node_directions(shape, scale)
    value = brdf.evaluate(omega_i, omega_r)
    coverage = np.where(below, BELOW_HORIZON, MODEL).astype(np.uint8)
    return TabulatedBRDF(value, np.zeros(shape), coverage, {"quantity": "brdf", "source": repr(brdf)}, scale)


def tabulate(
    samples: BRDFSamples,
    *,
    fill: BRDF | None = None,
    shape: tuple[int, int, int] = SHAPE,
    scale: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> TabulatedBRDF:
    """A table from scattered samples by local regression; see `gonio.brdf.scattered` for how.

    Parameters
    ----------
    samples : BRDFSamples
        At least 12. Samples without uncertainty get theirs from the scatter around the regression.
    fill : BRDF, optional
        A fitted BRDF that supplies the nodes which the samples do not reach; they are flagged ``model``. Without it such
        nodes are extrapolated, flagged so, with a large uncertainty.
    shape : tuple of int
        Nodes along theta_h, theta_d, phi_d.
    scale : float, optional
        Of the nodes along theta_h; by default as dense as the samples show the lobe to be narrow.
    progress : callable, optional
        Called with (done, total).

    Raises
    ------
    DatasetError
        If there are too few samples, or no positive one.
    """
    from gonio.brdf.scattered import regress

    check_shape(shape)
    return regress(samples, fill=fill, shape=shape, scale=scale, progress=progress)
