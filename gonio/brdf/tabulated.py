r"""A BRDF as a table over Rusinkiewicz's half and difference angles, with an uncertainty and a coverage flag at every node.

Nodes are even steps of :math:`a = \sqrt{\tan(\theta_h/2)}` (quadratic in theta_h near 0, where lobes are narrow), of
:math:`\tan(\theta_d/2)` and of :math:`\tan(\phi_d/2)`. All three come from lengths of sums and differences of the two unit
vectors, so a look-up needs square roots and no transcendental function. phi_d is folded into [0, pi/2], which makes
every table reciprocal and mirror-symmetric by construction. The fourth root of f_r is interpolated by Catmull-Rom cubics,
once differentiable, and raised again: six decades are one and a half, and no value can be negative.

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
from gonio.errors import DatasetError
from gonio.halfdiff import directions
from gonio.samples import BRDFSamples

Array = NDArray[np.float64]
SHAPE = (48, 32, 16)  # nodes along theta_h, theta_d, phi_d

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
    n_h, n_d, n_p = int(p[0]), int(p[1]), int(p[2])
    # s = wi + wr, |s| = 2 cos theta_d; e = wi - wr, |e| = 2 sin theta_d
    sx, sy, sz = xi + xr, yi + yr, zi + zr
    ex, ey, ez = xi - xr, yi - yr, zi - zr
    st2 = sx * sx + sy * sy
    s, st, e = math.sqrt(st2 + sz * sz), math.sqrt(st2), math.sqrt(ex * ex + ey * ey + ez * ez)
    a = math.sqrt(st / (s + sz)) * (n_h - 1)  # tan(theta_h / 2) = sin / (1 + cos)
    b = e / (s + 2.0) * (n_d - 1)
    # cos phi_d = -e_z |s| / (2 |s_t| sin theta_d), sin phi_d = (s_x e_y - s_y e_x) / (2 |s_t| sin theta_d)
    across, along = 2.0 * abs(xr * yi - xi * yr), abs(ez) * s
    length = along + math.sqrt(along * along + across * across)
    c = across / length * (n_p - 1) if length > 0.0 else 0.0

    i, j, k = min(int(a), n_h - 2), min(int(b), n_d - 2), min(int(c), n_p - 2)
    u, v, w = a - i, b - j, c - k
    q = 0.0
    for m in range(4):
        ii = i + m - 1  # the function is even about theta_h = 0, theta_d = 0, phi_d = 0 and phi_d = pi/2
        ii = 1 if ii < 0 else min(ii, n_h - 1)
        row = 0.0
        for n in range(4):
            jj = j + n - 1
            jj = 1 if jj < 0 else min(jj, n_d - 1)
            at = 3 + (ii * n_d + jj) * n_p + k
            before = p[at - 1] if k > 0 else p[at + 1]
            after = p[at + 2] if k < n_p - 2 else p[at]
            row += _weight(n, v) * (
                _weight(0, w) * before + _weight(1, w) * p[at] + _weight(2, w) * p[at + 1] + _weight(3, w) * after
            )
        q += _weight(m, u) * row
    q = max(q, 0.0)
    q *= q
    return q * q


@jit.model
def _weight(m: int, t: float) -> float:
    """Catmull-Rom weight of node m - 1 at fraction t between nodes 0 and 1."""
    if m == 0:
        return t * (-0.5 + t * (1.0 - 0.5 * t))
    if m == 1:
        return 1.0 + t * t * (1.5 * t - 2.5)
    if m == 2:
        return t * (0.5 + t * (2.0 - 1.5 * t))
    return t * t * (0.5 * t - 0.5)


def _lobe_width(packed: Array) -> float:
    """Half width [rad] in theta_h of the narrowest peak around theta_h = 0; 1 where no column has one."""
    n_h, n_d, n_p = (int(n) for n in packed[:3])
    f = packed[3:].reshape(n_h, n_d, n_p) ** 4
    theta_h = 2.0 * np.arctan(np.linspace(0.0, 1.0, n_h) ** 2)
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
    parameters=(),  # the parameter array is the packed table: three sizes, then the fourth roots of f_r
    function=tabulated_f_r,
    doc="Table over half and difference angles, cubic in the fourth root of f_r.",
    reference="Rusinkiewicz, Eurographics Workshop on Rendering, 1998",
    lobe_width=_lobe_width,
    energy_bounded=False,
    pieces=True,
)


def nodes(shape: tuple[int, int, int] = SHAPE) -> tuple[Array, Array, Array]:
    """Node angles theta_h, theta_d, phi_d of a table of that shape [rad]; phi_d in [0, pi/2]."""
    check_shape(shape)
    a, b, c = (np.linspace(0.0, 1.0, n) for n in shape)
    return 2.0 * np.arctan(a * a), 2.0 * np.arctan(b), 2.0 * np.arctan(c)


def check_shape(shape: tuple[int, ...]) -> None:
    """Refuse a table that cannot be interpolated or that would fill the memory."""
    if len(shape) != 3 or min(shape) < 4 or math.prod(int(n) for n in shape) > 20_000_000:
        raise DatasetError(
            f"a table of shape {tuple(shape)} cannot be used: give three sizes of at least 4 nodes and at most "
            "20 million nodes together"
        )


def node_directions(shape: tuple[int, int, int] = SHAPE) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Directions at which the nodes stand.

    Returns
    -------
    omega_i, omega_r : ndarray, shape (*shape, 3)
        Above the horizon; a node beyond it is moved along theta_h = theta_d towards the normal until both directions are
        one degree above it.
    below : ndarray of bool, shape (*shape)
        The node itself is at or below the horizon.
    """
    theta_h, theta_d, phi_d = np.meshgrid(*nodes(shape), indexing="ij")
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
    """

    value: Array
    u: Array
    coverage: NDArray[np.uint8]
    attributes: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_shape(self.value.shape)
        for name, array in (("u", self.u), ("coverage", self.coverage)):
            if array.shape != self.value.shape:
                raise DatasetError(f"table: {name} has shape {array.shape}, value has {self.value.shape}")
        if not np.all(np.isfinite(self.value)) or np.any(self.value < 0):
            raise DatasetError("table: a value is negative or not finite; the file is damaged")
        if np.any(self.u < 0) or np.any(np.isinf(self.u)):
            raise DatasetError("table: an uncertainty is negative or infinite; the file is damaged")
        if np.any(self.coverage > max(COVERAGE)):
            raise DatasetError(f"table: coverage {int(self.coverage.max())} is unknown; known are 0 to {max(COVERAGE)}")

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of nodes along theta_h, theta_d, phi_d."""
        n_h, n_d, n_p = self.value.shape
        return n_h, n_d, n_p

    def nodes(self) -> tuple[Array, Array, Array]:
        """Node angles theta_h, theta_d, phi_d [rad]."""
        return nodes(self.shape)

    def brdf(self) -> BRDF:
        """The table as a BRDF of one term, for evaluation and for the integrator."""
        return _packed(self.value)

    def u_brdf(self) -> BRDF:
        """The table's uncertainty, to be evaluated as a BRDF is [1/sr]."""
        return _packed(np.nan_to_num(self.u))

    def counts(self) -> dict[str, int]:
        """Number of nodes by coverage."""
        return {name: int(np.count_nonzero(self.coverage == flag)) for flag, name in COVERAGE.items()}

    def samples(self) -> BRDFSamples:
        """The nodes above the horizon as samples, without those that were extrapolated or taken from a model."""
        omega_i, omega_r, _ = node_directions(self.shape)
        known = (self.coverage == MEASURED) | (self.coverage == INTERPOLATED)
        wi, wr = omega_i[known], omega_r[known]
        theta_i, theta_r = (np.arctan2(np.hypot(w[:, 0], w[:, 1]), w[:, 2]) for w in (wi, wr))
        phi_i, phi_r = (np.mod(np.arctan2(w[:, 1], w[:, 0]), 2 * np.pi) for w in (wi, wr))
        keep = (theta_i < np.pi / 2) & (theta_r < np.pi / 2)
        return BRDFSamples.plain(
            theta_i[keep], phi_i[keep], theta_r[keep], phi_r[keep], self.value[known][keep], self.u[known][keep],
            attributes=dict(self.attributes),
        )  # fmt: skip

    def save(self, path: str | Path) -> None:
        """Write the table as NetCDF."""
        from gonio.formats import netcdf

        netcdf.write(Path(path), table=self)

    @classmethod
    def load(cls, path: str | Path) -> TabulatedBRDF:
        """Read a table from NetCDF; `DatasetError` if the file holds none."""
        from gonio.formats import netcdf

        return netcdf.read_table(Path(path))


def _packed(f: Array) -> BRDF:
    root = np.sqrt(np.sqrt(f))
    return BRDF([Term(TABULATED, np.concatenate((np.array(f.shape, dtype=float), root.ravel())))])


def from_brdf(brdf: BRDF, shape: tuple[int, int, int] = SHAPE) -> TabulatedBRDF:
    """The table of a BRDF that is known everywhere: every node above the horizon counts as taken from a model."""
    omega_i, omega_r, below = node_directions(shape)
    value = brdf.evaluate(omega_i, omega_r)
    coverage = np.where(below, BELOW_HORIZON, MODEL).astype(np.uint8)
    return TabulatedBRDF(value, np.zeros(shape), coverage, {"quantity": "brdf", "source": repr(brdf)})


def tabulate(
    samples: BRDFSamples,
    *,
    fill: BRDF | None = None,
    shape: tuple[int, int, int] = SHAPE,
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
    progress : callable, optional
        Called with (done, total).

    Raises
    ------
    DatasetError
        If there are too few samples, or no positive one.
    """
    from gonio.brdf.scattered import regress

    check_shape(shape)
    return regress(samples, fill=fill, shape=shape, progress=progress)
