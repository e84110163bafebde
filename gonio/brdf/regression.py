r"""Local regression with a log link: ln f of the nearest samples, and how well it is known.

Around each target the nearest samples, weighted by distance [1]_ and by their variance, are fitted with ln f linear or
quadratic in the coordinates by Fisher scoring [2]_ on f itself, so that noise around zero stays unbiased. The settings are
those with the smallest leave-one-out error, and the leave-one-out residuals also calibrate the uncertainty: no parametric
model of the material enters. What the coordinates are, a subclass of `Data` or `gonio.brdf.scattered` says.

References
----------
.. [1] W. S. Cleveland, S. J. Devlin, "Locally Weighted Regression", JASA 83(403), 1988 (tricube weights).
.. [2] P. McCullagh, J. A. Nelder, Generalized Linear Models, 2nd ed., 1989, section 2.5 (Fisher scoring).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
CLOUD = 32  # nearest samples that tell whether a node lies among them
FEWEST = 12
MISMATCH = 0.02  # relative error of a local polynomial that the weights allow for
OUTSIDE = 3.3  # squared distance from its neighbours' middle, in their variances, beyond which a node is extrapolated
TRIALS = 400  # samples left out, one at a time, to choose the settings


@dataclass(frozen=True)
class Settings:
    """What leave-one-out chooses: scale c, metric weights of x_1 and x_3, polynomial order, neighbours."""

    c: float = 0.1
    w_1: float = 2.0
    w_3: float = 1.0
    order: int = 1
    neighbours: int = 12


@dataclass(frozen=True)
class Local:
    """Local fits: ln f, its standard error, how far outside its neighbours each target is, distance of the nearest."""

    eta: Array  # (m,)
    sigma: Array  # (m,)
    outside: Array  # (m,) squared distance of the target from its neighbours' middle, in their variances
    nearest: Array  # (m,)


def at_nodes(
    data: Data,
    settings: Settings,
    scale: float,
    targets: Array,
    measured: NDArray[np.bool_],
    tell: Callable[[int], None],
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """ln f, its standard error and whether it is extrapolated, at the targets (m, k).

    Outside its neighbours, or far from all of them, a node gets a straight line only, and an error that grows with the
    distance; not where a sample measured it.
    """
    found = []
    for chunk in range(-(-len(targets) // 2048)):
        found.append(data.fit(targets[chunk * 2048 : (chunk + 1) * 2048], settings))
        tell(chunk + 1)
    local = Local(*(np.concatenate([getattr(part, n) for part in found]) for n in ("eta", "sigma", "outside", "nearest")))
    spacing = data.spacing(targets, settings)
    far = ((local.outside > OUTSIDE) & (local.nearest > 0.7 * spacing)) | (local.nearest > 4.0 * spacing)
    far &= ~measured
    eta, sigma = local.eta.copy(), scale * local.sigma * np.sqrt(1.0 + (local.nearest / spacing) ** 2 / 4.0)
    sigma *= _excess(data, settings, scale, targets)
    if np.any(far):
        straight = data.fit(targets[far], replace(settings, order=1, neighbours=max(settings.neighbours, 12)))
        eta[far] = straight.eta
        beyond = np.sqrt(np.maximum(straight.outside - 1.0, 0.0)) + straight.nearest / spacing[far] / 4.0
        sigma[far] = np.hypot(np.maximum(scale, 1.0) * straight.sigma, 0.2 + 0.3 * beyond)
    return eta, sigma, far


class Data:
    """Samples in coordinates, ready for neighbour searches under changing settings."""

    def __init__(self, x: Array, f: Array, u: Array, known: bool) -> None:
        self.x, self.f, self.u, self.known = x, f, u, known
        positive = f[f > 0]
        self.floor = max(1e-6 * float(np.quantile(positive, 0.99)), 0.3 * float(positive.min()))
        self._tree: tuple[tuple[float, float, float], object, Array] | None = None

    def tangent(self) -> Array:
        """tan(theta_h/2) of the samples, shape (n,)."""
        return np.asarray(self.x[:, 0])

    def metric(self, x: Array, settings: Settings) -> Array:
        c2 = settings.c**2
        x_1 = np.log1p(x[:, 0] ** 2 / c2) / np.log1p(1.0 / c2)
        return np.stack((settings.w_1 * x_1, x[:, 1], settings.w_3 * x[:, 2]), axis=-1)

    def tree(self, settings: Settings) -> tuple[object, Array]:
        from scipy.spatial import cKDTree

        key = (settings.c, settings.w_1, settings.w_3)
        if self._tree is None or self._tree[0] != key:
            points = self.metric(self.x, settings)
            self._tree = (key, cKDTree(points), points)
        return self._tree[1], self._tree[2]

    def spacing(self, targets: Array, settings: Settings) -> Array:
        """Distance of samples near each target from their own third neighbour, the median of eight."""
        tree, points = self.tree(settings)
        distance, _ = tree.query(points, 4)  # type: ignore[attr-defined]
        _, index = tree.query(self.metric(targets, settings), min(8, len(points)))  # type: ignore[attr-defined]
        return np.asarray(np.maximum(np.median(distance[:, 3][index], axis=1), 1e-9))

    def fit(self, targets: Array, settings: Settings, leave_out: NDArray[np.int64] | None = None) -> Local:
        """Local fits at the targets (m, k); with `leave_out`, target j ignores sample leave_out[j]."""
        tree, points = self.tree(settings)
        at = self.metric(targets, settings)
        k = min(settings.neighbours, len(points) - (leave_out is not None))
        order = settings.order if k >= 14 + 10 * (self.x.shape[1] - 3) else 1
        if leave_out is None:
            distance, index = tree.query(at, k)  # type: ignore[attr-defined]
        else:
            distance, index = tree.query(at, k + 1)  # type: ignore[attr-defined]
            own = index == leave_out[:, None]
            own[~own.any(axis=1), -1] = True
            distance, index = distance[~own].reshape(-1, k), index[~own].reshape(-1, k)
        reach = 1.05 * distance[:, -1:] + 1e-12
        kernel = (1.0 - (distance / reach) ** 3) ** 3 + 1e-6
        z = (points[index] - at[:, None, :]) / reach[..., None]  # (m, k, 3)
        dimensions = z.shape[2]
        columns = [np.ones(z.shape[:2]), *np.moveaxis(z, -1, 0)]
        if order == 2:
            columns += [z[..., i] * z[..., j] for i in range(dimensions) for j in range(i, dimensions)]
        design = np.stack(columns, axis=-1)
        f, u2 = self.f[index], self.u[index] ** 2

        raised = np.maximum(f, np.maximum(self.floor, 0.5 * np.sqrt(u2)))
        log_f = np.log(raised)
        low, high = log_f.min(axis=1, keepdims=True) - 1.0, log_f.max(axis=1, keepdims=True) + 1.0
        eta, response = log_f, log_f
        mu = raised
        for _ in range(5):
            noise = u2 + (MISMATCH * mu) ** 2
            precision = kernel * mu * mu / noise  # of the working response ln mu + (f - mu)/mu
            beta, first = _solve(design, precision, response)
            eta = np.clip(np.einsum("mkp,mp->mk", design, beta), low, high)
            mu = np.exp(eta)
            response = eta + np.clip(f / mu - 1.0, -3.0, 3.0)
        center = np.clip(beta[:, 0], low[:, 0], high[:, 0])
        smoother = precision * np.einsum("mkp,mp->mk", design, first)
        variance = np.sum(smoother**2 * noise / (mu * mu), axis=1)
        return Local(center, np.sqrt(variance), self._outside(at, settings), distance[:, 0])

    def _outside(self, at: Array, settings: Settings) -> Array:
        """How far each target is from the middle of the samples around it, squared, in variances of their coordinates.

        The larger of the worst coordinate's and half of all three's: 3 on a face or an edge of a full box.
        """
        tree, points = self.tree(settings)
        distance, index = tree.query(at, min(CLOUD, len(points)))  # type: ignore[attr-defined]
        z = (points[index] - at[:, None, :]) / (distance[:, -1:, None] + 1e-12)
        mean = z.mean(axis=1)
        spread = np.swapaxes(z, 1, 2) @ z / z.shape[1] - mean[:, :, None] * mean[:, None, :] + 1e-4 * np.eye(z.shape[2])
        every = np.einsum("mi,mi->m", mean, np.linalg.solve(spread, mean[..., None])[..., 0])
        single = np.max(mean**2 / np.diagonal(spread, axis1=1, axis2=2), axis=1)
        return np.asarray(np.maximum(single, every / 2.0))


def _solve(design: Array, precision: Array, response: Array) -> tuple[Array, Array]:
    """Weighted least squares for all targets: coefficients, and the first row of the inverse normal matrix."""
    weighted = design * precision[..., None]
    normal = np.swapaxes(weighted, 1, 2) @ design
    ridge = np.full(design.shape[2], 1e-3)
    ridge[0] = 1e-9
    normal += ridge * np.eye(len(ridge)) * precision.sum(axis=1)[:, None, None]
    right = np.einsum("mkp,mk->mp", weighted, response)
    unit = np.zeros_like(right)
    unit[:, 0] = 1.0
    both = np.linalg.solve(normal, np.stack((right, unit), axis=-1))
    return both[..., 0], both[..., 1]


def left_out(data: Data) -> NDArray[np.int64]:
    """The samples that are left out, one at a time, to judge settings."""
    n = len(data.f)
    return np.unique(np.linspace(0, n - 1, min(n, TRIALS)).astype(np.int64))


def left_out_error(data: Data, settings: Settings) -> float:
    """Mean square of the relative leave-one-out residuals, each at most a half."""
    which = left_out(data)
    f, noise = data.f[which], data.u[which] if data.known else 0.0
    mu = np.exp(data.fit(data.x[which], settings, which).eta)
    r = 2.0 * (f - mu) / (np.abs(f) + mu + 2.0 * noise + data.floor)
    return float(np.mean(np.minimum(np.abs(r), 0.5) ** 2))


def choose(data: Data) -> tuple[Settings, float]:
    """Settings with the smallest leave-one-out error, one coordinate at a time, and the scale of the standard errors."""
    n = len(data.f)
    # a lobe narrower than the samples resolve would be a spike of our own making
    near = np.sort(data.tangent()[data.tangent() > 1e-6])
    finest = 0.5 * float(near[min(4, len(near) - 1)]) if len(near) else 1.0
    best = Settings(c=max(0.1, finest), neighbours=min(12, n - 1))
    least = left_out_error(data, best)
    orders = [(1, 8), (1, 20), (2, 16), (2, 24), (2, 40), (2, 64)]
    ladder: list[dict[str, list[float]] | list[tuple[int, int]]] = [
        {"c": [0.001, 0.003, 0.01, 0.03, 0.3, 1.0]},
        orders,
        {"w_1": [0.7, 1.4, 4.0]},
        {"w_3": [0.3, 3.0]},
        {"c": [0.002, 0.005, 0.01, 0.03, 0.06, 0.1, 0.18, 0.3]},
        orders,
    ]
    for rung in ladder:
        if isinstance(rung, list):
            options = [replace(best, order=o, neighbours=k) for o, k in rung if k < n]
        else:
            pairs = [(name, v) for name, values in rung.items() for v in values if name != "c" or v >= finest]
            options = [replace(best, **{name: value}) for name, value in pairs]  # type: ignore[arg-type]
        for option in options:
            if option != best and (e := left_out_error(data, option)) < 0.995 * least:
                best, least = option, e

    # scale of the standard errors: two thirds of the leave-one-out residuals within one of them
    which = left_out(data)
    local = data.fit(data.x[which], best, which)
    f, noise, mu = data.f[which], data.u[which] if data.known else 0.0, np.exp(local.eta)
    deviation = np.abs(f - mu)
    inside = local.outside < OUTSIDE
    if np.count_nonzero(inside) < FEWEST:
        inside[:] = True
    low, high = 0.4, 30.0
    for _ in range(40):
        middle = np.sqrt(low * high)
        pull = deviation / np.sqrt(noise**2 + (middle * mu * local.sigma) ** 2 + 1e-300)
        if np.quantile(pull[inside], 0.683) > 1.0:
            low = middle
        else:
            high = middle
    return best, float(np.sqrt(low * high))


def _excess(data: Data, settings: Settings, scale: float, targets: Array) -> Array:
    """Factor on the standard error at each target from the leave-one-out residuals around it.

    Where the surface bends more than a local polynomial follows, the residuals of the samples there say so.
    """
    every = np.arange(len(data.f))
    mu, sigma = np.empty(len(every)), np.empty(len(every))
    for start in range(0, len(every), 2048):
        part = every[start : start + 2048]
        local = data.fit(data.x[part], settings, part)
        mu[part], sigma[part] = np.exp(local.eta), local.sigma
    noise = data.u if data.known else np.zeros_like(data.u)
    pull2 = np.minimum((data.f - mu) ** 2 / (noise**2 + (scale * mu * sigma) ** 2 + 1e-300), 400.0)
    tree, _ = data.tree(settings)
    _, index = tree.query(data.metric(targets, settings), min(8, len(every)))  # type: ignore[attr-defined]
    # shrunk towards 1 by four pseudo-residuals
    return np.asarray(np.sqrt(np.maximum((pull2[index].sum(axis=1) + 4.0) / (index.shape[1] + 4.0), 1.0)))
