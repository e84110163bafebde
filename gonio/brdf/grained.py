r"""A BRDF with a grain as a table over all four half and difference angles.

Nodes: even steps of phi_h (a full turn) and of phi_d (half a turn: the other half is reciprocal), theta_h and theta_d as in
`gonio.brdf.tabulated`. Cubic in the fourth root of f_r along all four; reciprocal and never negative by construction. A
look-up costs two arc tangents, as no algebraic coordinate is periodic and even.

Scattered samples become nodes by the same local regression as without a grain (`gonio.brdf.regression`), with coordinates
that are smooth where azimuths have no meaning:

.. math:: (h_x, h_y)\,\frac{g(t)}{t},\quad x_2(\theta_d),\quad e_x^2 - e_y^2,\quad 2 e_x e_y,

with h of length t along the half vector's azimuth, :math:`g(t)^2 = \ln(1+t^2/c^2)`, and :math:`e = (\omega_i - \omega_r)/2`,
whose squares do not change when the two directions are swapped. Where the samples do not reach, values are extrapolated
and flagged.

A reflectance map of it needs `tangent=`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.brdf import regression, scattered, tabulated
from gonio.brdf.base import BRDF, Model, Term
from gonio.brdf.packed import BUCKETS, CELL, LARGE, SMALL, buckets, cells, cubic, weights
from gonio.brdf.tabulated import tangents
from gonio.errors import DatasetError
from gonio.halfdiff import directions, half_difference
from gonio.samples import BRDFSamples

Array = NDArray[np.float64]
SHAPE = (36, 24, 12, 12)  # nodes along phi_h, theta_h, theta_d, phi_d
START = 5 + BUCKETS  # sizes and number of buckets, the buckets; then cells and values
FEWEST = 60


@jit.model
def grained_f_r(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float, p: list[float]) -> float:
    if not (zi > 0.0 and zr > 0.0):
        return 0.0
    n_q, n_h, n_d, n_p = int(p[0]) & SMALL, int(p[1]) & SMALL, int(p[2]) & SMALL, int(p[3]) & SMALL
    sx, sy, sz = xi + xr, yi + yr, zi + zr
    ex, ey, ez = xi - xr, yi - yr, zi - zr
    st2 = sx * sx + sy * sy
    s, e = math.sqrt(st2 + sz * sz), math.sqrt(ex * ex + ey * ey + ez * ez)
    t = math.sqrt(st2) / (s + sz)  # tan(theta_h / 2)
    b = e / (s + 2.0) * (n_d - 1)
    if st2 > 1e-24:
        phi_h = math.atan2(sy, sx)
        phi_d = math.atan2(sx * ey - sy * ex, -ez * s)
    else:  # the half vector is the normal: its azimuth is taken as 0
        phi_h, phi_d = 0.0, math.atan2(ey, ex)
    a = (phi_h / (2.0 * math.pi)) % 1.0 * n_q
    c = (phi_d / math.pi) % 1.0 * n_p

    i = int(p[5 + (min(int(math.sqrt(t) * BUCKETS), BUCKETS - 1) & SMALL)]) & SMALL
    while i < n_h - 2 and t > p[START + CELL * (i + 1)]:
        i += 1
    at = (START + CELL * i) & LARGE
    u = (t - p[at]) * p[at + 1]
    g, j, k = min(int(a), n_q - 1) & SMALL, min(int(b), n_d - 2) & SMALL, min(int(c), n_p - 1) & SMALL
    along, rows, columns = weights(a - g), weights(b - j), weights(c - k)
    row = n_p + 3
    plane = ((n_d + 2) * row) & LARGE
    turn = ((n_h + 2) * plane) & LARGE  # from one azimuth of the half vector to the next
    first = (START + CELL * (n_h - 1) + g * turn + i * plane + j * row + k) & LARGE
    q = 0.0
    for n in range(4):
        q += along[n] * cubic(p, at + 2, first + n * turn, plane, row, u, rows, columns)
    q = max(q, 0.0)
    q *= q
    return q * q


def _lobe_width(packed: Array) -> float:
    """Half width [rad] in theta_h of the narrowest peak, over the azimuths of the half vector; 1 without one."""
    n_q, n_h, n_d, n_p = (int(n) for n in packed[:4])
    t = np.append(packed[START : START + CELL * (n_h - 1) : CELL], 1.0)
    f = packed[START + CELL * (n_h - 1) :].reshape(n_q + 3, n_h + 2, n_d + 2, n_p + 3)[1:-2, 1:-1, 1, 1] ** 4  # theta_d = 0
    width = 1.0
    for column in f:
        if column[0] > 2.0 * column[-1]:
            below = np.flatnonzero(column < 0.5 * (column[0] + column[-1]))
            width = min(width, 2.0 * math.atan(float(t[max(int(below[0]), 1)])))
    return width


GRAINED = Model(
    name="grained",
    parameters=(),  # the parameter array is the packed table
    function=grained_f_r,
    doc="Table over all four half and difference angles, cubic in the fourth root of f_r.",
    reference="Rusinkiewicz, Eurographics Workshop on Rendering, 1998",
    lobe_width=_lobe_width,
    isotropic=False,
    energy_bounded=False,
)


def check_shape(shape: tuple[int, ...]) -> None:
    """Refuse a table that cannot be interpolated or that would fill the memory."""
    if len(shape) != 4 or min(shape) < 4 or shape[0] % 2 or math.prod(int(n) for n in shape) > 20_000_000:
        raise DatasetError(
            f"a table of shape {tuple(shape)} cannot be used: give an even number of phi_h, at least 4 nodes of each angle "
            "and at most 20 million together"
        )


def nodes(shape: tuple[int, int, int, int], scale: float) -> tuple[Array, Array, Array, Array]:
    """Node angles phi_h, theta_h, theta_d, phi_d [rad]; phi_d in [0, pi)."""
    check_shape(shape)
    n_q, n_h, n_d, n_p = shape
    phi_h, phi_d = 2 * np.pi * np.arange(n_q) / n_q, np.pi * np.arange(n_p) / n_p
    return phi_h, 2 * np.arctan(tangents(n_h, scale)), 2 * np.arctan(np.linspace(0.0, 1.0, n_d)), phi_d


def node_directions(shape: tuple[int, int, int, int], scale: float) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Directions (*shape, 3) of the nodes, those beyond the horizon moved up to one degree above it, and which these are."""
    q, h, d, p = np.meshgrid(*nodes(shape, scale), indexing="ij")
    lowest = math.sin(math.radians(1.0))

    def height(s: Array) -> Array:
        return np.asarray(np.cos(s * h) * np.cos(s * d) - np.sin(s * h) * np.sin(s * d) * np.abs(np.cos(p)))

    below = height(np.ones_like(h)) <= 1e-12
    low, high = np.zeros_like(h), np.ones_like(h)
    for _ in range(40):
        middle = 0.5 * (low + high)
        up = height(middle) >= lowest
        low, high = np.where(up, middle, low), np.where(up, high, middle)
    s = np.where(below, low, 1.0)
    omega_i, omega_r = directions(s * h, q, s * d, p)
    return omega_i, omega_r, below


@dataclass(frozen=True)
class GrainedTable:
    """A reciprocal BRDF on a grid of four angles; attributes as of `gonio.brdf.tabulated.TabulatedBRDF`."""

    value: Array
    u: Array
    coverage: NDArray[np.uint8]
    attributes: Mapping[str, str] = field(default_factory=dict)
    scale: float = tabulated.SCALE

    def __post_init__(self) -> None:
        check_shape(self.value.shape)
        tangents(self.value.shape[1], self.scale)
        tabulated.check_values(self.value, self.u, self.coverage)

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Number of nodes along phi_h, theta_h, theta_d, phi_d."""
        n_q, n_h, n_d, n_p = self.value.shape
        return n_q, n_h, n_d, n_p

    def nodes(self) -> tuple[Array, Array, Array, Array]:
        """Node angles phi_h, theta_h, theta_d, phi_d [rad]."""
        return nodes(self.shape, self.scale)

    def brdf(self) -> BRDF:
        """The table as a BRDF of one term."""
        return _packed(self.value, self.scale)

    def u_brdf(self) -> BRDF:
        """The table's uncertainty, to be evaluated as a BRDF is [1/sr]."""
        return _packed(np.nan_to_num(self.u), self.scale)

    def counts(self) -> dict[str, int]:
        """Number of nodes by coverage."""
        return {name: int(np.count_nonzero(self.coverage == flag)) for flag, name in tabulated.COVERAGE.items()}

    def samples(self) -> BRDFSamples:
        """The nodes above the horizon as samples, without those that were extrapolated or taken from a model."""
        omega_i, omega_r, _ = node_directions(self.shape, self.scale)
        known = (self.coverage == tabulated.MEASURED) | (self.coverage == tabulated.INTERPOLATED)
        return tabulated.plain_samples(omega_i[known], omega_r[known], self.value[known], self.u[known], self.attributes)


def _packed(f: Array, scale: float) -> BRDF:
    root = np.sqrt(np.sqrt(f))
    half = f.shape[0] // 2
    opposite = np.roll(root[:, 1:2], half, axis=0)  # beyond theta_h = 0 lies the opposite azimuth
    root = np.concatenate((opposite, root, root[:, -1:]), axis=1)
    root = np.concatenate((root[:, :, 1:2], root, root[:, :, -1:]), axis=2)
    root = np.concatenate((root[..., -1:], root, root[..., :2]), axis=3)
    root = np.concatenate((root[-1:], root, root[:2]), axis=0)
    t = tangents(f.shape[1], scale)
    head = np.array([*f.shape, BUCKETS], dtype=float)
    return BRDF([Term(GRAINED, np.concatenate((head, buckets(t), cells(t).ravel(), root.ravel())))])


def from_brdf(brdf: BRDF, shape: tuple[int, int, int, int] = SHAPE) -> GrainedTable:
    """The table of a BRDF that is known everywhere: every node above the horizon counts as taken from a model."""
    widths = [w for w in (term.lobe_width() for term in brdf.terms) if w is not None]
    scale = tabulated.scale_for(min(widths, default=None))
    omega_i, omega_r, below = node_directions(shape, scale)
    coverage = np.where(below, tabulated.BELOW_HORIZON, tabulated.MODEL).astype(np.uint8)
    attributes = {"quantity": "brdf", "source": repr(brdf)}
    return GrainedTable(brdf.evaluate(omega_i, omega_r), np.zeros(shape), coverage, attributes, scale)


class _Grained(regression.Data):
    """Samples in coordinates of all four angles."""

    def tangent(self) -> Array:
        """tan(theta_h/2) of the samples, shape (n,)."""
        return np.hypot(self.x[:, 0], self.x[:, 1])

    def metric(self, x: Array, settings: regression.Settings) -> Array:
        """Rows t cos(phi_h), t sin(phi_h), x_2, e_x^2 - e_y^2, 2 e_x e_y under the settings."""
        t2 = x[:, 0] ** 2 + x[:, 1] ** 2
        g = np.sqrt(np.log1p(t2 / settings.c**2) / np.log1p(1.0 / settings.c**2))
        stretch = settings.w_1 * np.divide(g, np.sqrt(t2), out=np.ones_like(g), where=t2 > 0)
        return np.stack(
            (stretch * x[:, 0], stretch * x[:, 1], x[:, 2], settings.w_3 * x[:, 3], settings.w_3 * x[:, 4]), axis=-1
        )


def coordinates(omega_i: Array, omega_r: Array) -> Array:
    """What `_Grained.metric` takes, shape (n, 5)."""
    s, e = omega_i + omega_r, 0.5 * (omega_i - omega_r)
    length = np.linalg.norm(s, axis=-1)
    tangent = s[..., :2] / (length + s[..., 2])[..., None]  # tan(theta_h / 2) along phi_h
    x_2 = np.log(1.1 / (0.1 + 0.5 * length)) / np.log(11.0)
    return np.stack(
        (tangent[..., 0], tangent[..., 1], x_2, e[..., 0] ** 2 - e[..., 1] ** 2, 2 * e[..., 0] * e[..., 1]), axis=-1
    )


def shown_by(samples: BRDFSamples) -> bool:
    """Whether samples show a grain: left out, they are predicted twice as well with the incident azimuth as without."""
    if len(samples.f_r) < FEWEST or len(np.unique(np.round(samples.phi_i, 6))) < 3 or not np.any(samples.f_r > 0):
        return False
    some = samples.select(np.random.default_rng(0).permutation(len(samples.f_r))[: scattered.MANY])
    u, known = scattered.working_uncertainty(some.f_r, some.u_f_r)
    omega_i, omega_r = some.omega_i(), some.omega_r()
    isotropic = regression.Data(scattered.coordinates(omega_i, omega_r), some.f_r, u, known)
    grained = _Grained(coordinates(omega_i, omega_r), some.f_r, u, known)
    errors = [regression.left_out_error(data, regression.choose(data)[0]) for data in (isotropic, grained)]
    return errors[1] < 0.25 * errors[0]  # squares


def tabulate(
    samples: BRDFSamples,
    shape: tuple[int, int, int, int] = SHAPE,
    *,
    fill: BRDF | None = None,
    scale: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> GrainedTable:
    """A table from scattered samples of a material with a grain, at least 60.

    Every node is the local regression of its neighbours; beyond them it is a straight line with an uncertainty that grows
    with the distance, flagged ``extrapolated``. `fill`, `scale` and `progress` as of `gonio.brdf.tabulated.tabulate`.
    """
    f = samples.f_r
    if len(f) < FEWEST:
        raise DatasetError(f"a table with a grain needs at least {FEWEST} samples, there are {len(f)}; fit a model instead")
    if not np.any(f > 0):
        raise DatasetError(f"none of the {len(f)} samples is positive; check the dark frames and the quantity")
    total = -(-math.prod(shape) // 2048) + 1

    def tell(done: int) -> None:
        if progress is not None:
            progress(done, total)

    tell(0)
    u, known = scattered.working_uncertainty(f, samples.u_f_r)
    data = _Grained(coordinates(samples.omega_i(), samples.omega_r()), f, u, known)
    settings, errors = regression.choose(data)
    tell(1)
    spread = scale or float(np.clip(0.5 * settings.c, tabulated.LEAST_SCALE, tabulated.SCALE))
    omega_i, omega_r, below = node_directions(shape, spread)
    targets = coordinates(omega_i.reshape(-1, 3), omega_r.reshape(-1, 3))
    measured = np.zeros(shape, dtype=bool)
    measured[_nearest_nodes(samples.omega_i(), samples.omega_r(), shape, spread)] = True
    found = regression.at_nodes(data, settings, errors, targets, measured.ravel(), lambda done: tell(1 + done))
    eta, sigma, far = (x.reshape(shape) for x in found)
    value, relative = np.exp(eta), np.sqrt(np.expm1(np.minimum(sigma, 2.0) ** 2))
    coverage = np.where(far, tabulated.EXTRAPOLATED, tabulated.INTERPOLATED).astype(np.uint8)
    coverage[measured] = tabulated.MEASURED
    if fill is not None:
        value[far] = fill.evaluate(omega_i[far], omega_r[far])
        relative[far] = scattered.misfit(fill, samples, known)
        coverage[far] = tabulated.MODEL
    coverage[below] = tabulated.BELOW_HORIZON
    attributes = {
        **samples.attributes,
        "quantity": "brdf",
        "n_samples": str(len(samples)),
        "grain": "phi_h = 0 along x",
        "fill": "none" if fill is None else repr(fill),
        "uncertainty": "k = 1; random errors, scatter and interpolation; shared errors are not included",
    }
    return GrainedTable(value, value * relative, coverage, attributes, spread)


def _nearest_nodes(
    omega_i: Array, omega_r: Array, shape: tuple[int, int, int, int], scale: float
) -> tuple[NDArray[np.int64], ...]:
    """Node numbers nearest to pairs of directions (n, 3), one array for each axis."""
    theta_h, phi_h, theta_d, phi_d = half_difference(omega_i, omega_r)
    position = (
        phi_h / (2 * np.pi) * shape[0],
        np.arcsinh(np.tan(theta_h / 2) / scale) / np.arcsinh(1.0 / scale) * (shape[1] - 1),
        np.tan(theta_d / 2) * (shape[2] - 1),
        np.mod(phi_d, np.pi) / np.pi * shape[3],
    )
    q, h, d, p = (np.rint(x).astype(np.int64) for x in position)
    return q % shape[0], h, d, p % shape[3]
