r"""From scattered BRDF samples to the nodes of a table, by local regression (`gonio.brdf.regression`).

Coordinates are functions that are smooth and single-valued for an isotropic, reciprocal, mirror-symmetric BRDF, so that
no sample is torn from its neighbour at theta_h = 0 or theta_d = 0, where azimuths lose their meaning:

.. math:: x_1 = \frac{\ln(1 + \tan^2(\theta_h/2)/c^2)}{\ln(1 + 1/c^2)},\quad
          x_2 = \frac{\ln(1.1/(0.1+\cos\theta_d))}{\ln 11},\quad x_3 = (\cos\theta_i - \cos\theta_r)^2 .

With c near half the roughness, the logarithm of a GGX lobe is a straight line in x_1.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from gonio.brdf import tabulated
from gonio.brdf.base import BRDF
from gonio.brdf.regression import FEWEST, MISMATCH, Data, at_nodes, choose
from gonio.errors import DatasetError
from gonio.samples import BRDFSamples

Array = NDArray[np.float64]
MANY = 4_000  # more samples than this are averaged in cells of half a node step
MOST = 20_000  # and in larger cells if more than this remain


def coordinates(omega_i: Array, omega_r: Array) -> Array:
    """tan(theta_h/2), x_2 and x_3 of pairs of directions, shape (n, 3)."""
    s, e = omega_i + omega_r, omega_i - omega_r
    length = np.linalg.norm(s, axis=-1)
    th = np.hypot(s[..., 0], s[..., 1]) / (length + s[..., 2])
    x_2 = np.log(1.1 / (0.1 + 0.5 * length)) / np.log(11.0)  # |s| = 2 cos(theta_d)
    return np.stack((th, x_2, e[..., 2] ** 2), axis=-1)


def grid_position(omega_i: Array, omega_r: Array, shape: tuple[int, int, int], scale: float) -> Array:
    """Position on the table's axes in numbers of nodes, shape (n, 3)."""
    s, e = omega_i + omega_r, omega_i - omega_r
    length, st = np.linalg.norm(s, axis=-1), np.hypot(s[..., 0], s[..., 1])
    across = np.abs(s[..., 0] * e[..., 1] - s[..., 1] * e[..., 0])
    along = np.abs(e[..., 2]) * length
    total = along + np.hypot(along, across)
    c = np.divide(across, total, out=np.zeros_like(total), where=total > 0)
    a = np.arcsinh(st / (length + s[..., 2]) / scale) / np.arcsinh(1.0 / scale)  # t = scale sinh(h k)
    return np.asarray(np.stack((a, np.linalg.norm(e, axis=-1) / (length + 2.0), c), axis=-1) * (np.array(shape) - 1))


def regress(
    samples: BRDFSamples,
    *,
    fill: BRDF | None,
    shape: tuple[int, int, int],
    scale: float | None,
    progress: Callable[[int, int], None] | None,
) -> tabulated.TabulatedBRDF:
    """Table of the samples; `gonio.brdf.tabulated.tabulate` says what goes in and out."""
    omega_i, omega_r = samples.omega_i(), samples.omega_r()
    x, f, u = coordinates(omega_i, omega_r), samples.f_r, samples.u_f_r
    if len(f) < FEWEST:
        raise DatasetError(f"a table needs at least {FEWEST} samples, there are {len(f)}; fit a model instead")
    if not np.any(f > 0):
        raise DatasetError(f"none of the {len(f)} samples is positive; check the dark frames and the quantity")
    u, known = working_uncertainty(f, u)
    chunks = -(-math.prod(shape) // 2048)
    total = chunks + 4

    def tell(done: int) -> None:
        if progress is not None:
            progress(done, total)

    tell(0)
    some = np.random.default_rng(0).permutation(len(f))[:MANY]
    settings, errors = choose(Data(x[some], f[some], u[some], known))
    # nodes as dense as the lobe is narrow
    spread = scale or float(np.clip(0.5 * settings.c, tabulated.LEAST_SCALE, tabulated.SCALE))
    position = grid_position(omega_i, omega_r, shape, spread)
    data = Data(x, f, u, known)
    if len(f) > MANY:
        data = Data(*_binned(x, f, u, position, shape), known)
        settings, errors = choose(data)
    tell(4)
    node_i, node_r, below = tabulated.node_directions(shape, spread)
    targets = coordinates(node_i.reshape(-1, 3), node_r.reshape(-1, 3))
    cell = tuple(np.rint(position).astype(np.int64).T)
    measured = np.zeros(shape, dtype=bool)
    measured[cell] = True
    # where azimuth has no meaning, one sample measures the node at all of them
    measured[0] |= measured[0].any(axis=-1, keepdims=True)
    measured[:, 0] |= measured[:, 0].any(axis=-1, keepdims=True)
    eta, sigma, far = at_nodes(data, settings, errors, targets, measured.ravel(), lambda done: tell(4 + done))
    # standard deviation of a log-normal value over its median's: what is badly known may be far above
    sigma = np.minimum(sigma, 2.0)
    eta, relative_u = eta.reshape(shape), np.sqrt(np.expm1(sigma**2)).reshape(shape)
    far = far.reshape(shape)
    value = np.exp(eta)

    coverage = np.where(far, tabulated.EXTRAPOLATED, tabulated.INTERPOLATED).astype(np.uint8)
    coverage[measured] = tabulated.MEASURED
    if fill is not None:
        value[far] = fill.evaluate(node_i[far], node_r[far])
        relative_u = np.where(far, misfit(fill, samples, known), relative_u)
        coverage[far] = tabulated.MODEL
    coverage[below] = tabulated.BELOW_HORIZON
    attributes = {
        **samples.attributes,
        "quantity": "brdf",
        "n_samples": str(len(samples)),
        "regression": (
            f"ln f local polynomial of order {settings.order} over {settings.neighbours} neighbours, "
            f"lobe scale c = {settings.c:g}, error scale {errors:.3g}"
        ),
        "fill": "none" if fill is None else repr(fill),
        "uncertainty": "k = 1; random errors, scatter and interpolation; shared errors are not included",
    }
    return tabulated.TabulatedBRDF(value, value * relative_u, coverage, attributes, spread)


def working_uncertainty(f: Array, u: Array) -> tuple[Array, bool]:
    """Working uncertainty of each sample, and whether it was known for most of them."""
    known = np.isfinite(u) & (u > 0)
    if np.count_nonzero(known) >= len(f) / 2:
        relative = float(np.median(u[known] / np.maximum(np.abs(f[known]), np.median(np.abs(f)))))
        return np.where(known, u, relative * np.abs(f) + np.median(u[known])), True
    # negative values can only be noise: they tell its size where nothing else does
    negative = f[f < 0]
    absolute = float(np.sqrt(np.mean(negative**2))) if len(negative) else 1e-3 * float(np.median(np.abs(f)))
    return np.hypot(MISMATCH * np.abs(f), absolute), False


def _binned(x: Array, f: Array, u: Array, position: Array, shape: tuple[int, int, int]) -> tuple[Array, Array, Array]:
    """Weighted means over cells of half a node step, doubled until few enough are left."""
    size = 0.5
    while True:
        counts = np.ceil((np.array(shape) - 1) / size).astype(np.int64) + 1
        cell = np.rint(position / size).astype(np.int64)
        key = (cell[:, 0] * counts[1] + cell[:, 1]) * counts[2] + cell[:, 2]
        _, inverse = np.unique(key, return_inverse=True)
        groups = int(inverse.max()) + 1
        if groups <= MOST or size >= 16:
            break
        size *= 2.0 ** (1 / 3) if groups < 2 * MOST else 2.0
    weight = 1.0 / (u**2 + (MISMATCH * np.abs(f)) ** 2 + 1e-300)
    # within a cell a common mean weight, or the smaller values would win
    mean_weight = np.bincount(inverse, weight) / np.bincount(inverse)
    count = np.bincount(inverse).astype(float)
    columns = [np.bincount(inverse, x[:, i]) / count for i in range(3)]
    mean_f = np.bincount(inverse, f) / count
    return np.stack(columns, axis=-1), mean_f, 1.0 / np.sqrt(mean_weight * count)


def misfit(fill: BRDF, samples: BRDFSamples, known: bool) -> float:
    """Relative standard uncertainty of a fitted model off the samples: twice its robust misfit on them."""
    predicted = fill.evaluate(samples.omega_i(), samples.omega_r())
    deviation = np.abs(samples.f_r - predicted)
    u = np.nan_to_num(samples.u_f_r) if known else np.zeros_like(deviation)
    excess = np.sqrt(np.maximum(deviation**2 - u**2, 0.0)) / np.maximum(predicted, 1e-300)
    return float(np.clip(2.0 * np.quantile(excess, 0.683), 0.02, 2.0))
