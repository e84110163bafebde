"""The scenes of the benchmark, their formulas as a user without gonio would write them, and their true values.

A scene is plain data as in `tests.independent`. The formulas serve the peers: once for numbers (`math`), once for arrays
(`numpy`), in unit vectors, without a trigonometric function where none is needed, so that no peer loses by clumsiness. The
truths come from `tests.independent`, which shares no code with gonio; tests/data/benchmark_truths.json keeps them.
"""

from __future__ import annotations

import functools
import itertools
import json
import math
import types
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import gonio
from tests.independent import reflected_radiance
from tests.problems import make_brdf, make_source

Array = NDArray[np.float64]
Formula = Callable[..., Any]
FILE = Path(__file__).parents[1] / "data" / "benchmark_truths.json"
N = 64  # pixels along each axis of the map
AXIS = np.linspace(-3.0, 3.0, N)
FAINT = 1e-6  # pixels fainter than this part of the brightest are left out: their relative error means nothing
SUN = (-1 / 3, -1 / 7)  # a pixel of that map: the gradient that mirrors the sun and the disk to the viewer
NUMBERS = types.SimpleNamespace(sqrt=math.sqrt, exp=math.exp, maximum=max, arccos=math.acos, arctan2=math.atan2)


def _towards(p: float, q: float) -> dict[str, float]:
    """Direction of a source that the gradient (p, q) mirrors to the viewer: twice the normal's angle."""
    return {"theta": 2.0 * math.atan(math.hypot(p, q)), "phi": math.atan2(-q, -p)}


def _glossy(alpha: float) -> list[dict[str, Any]]:
    return [{"model": "lambertian", "albedo": 0.5}, {"model": "ggx", "k_s": 1.0, "alpha": alpha, "f_0": 0.04}]


def _studio(theta: Any, phi: Any) -> Any:
    """Radiance 0.2 and four von Mises-Fisher lobes of concentration 10 to 100, on angles."""
    x, y, z = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)
    return 0.2 + lobes(np, _LOBES)(x, y, z)


_LOBES = {
    "kind": "lobes", "amplitude": [1.0, 2.0, 1.5, 0.5], "kappa": [10.0, 30.0, 100.0, 60.0],
    "theta": [0.3, 0.7, 1.2, 1.0], "phi": [0.4, 1.0, 2.5, 4.2],
}  # fmt: skip
SURFACES: dict[str, list[dict[str, Any]]] = {
    "lambert": [{"model": "lambertian", "albedo": 0.8}],
    "oren_nayar": [{"model": "oren_nayar", "albedo": 0.8, "sigma": math.radians(20.0)}],
    "phong 50": [{"model": "phong", "k_s": 1.0, "n": 50.0}],
    "ggx 0.3": _glossy(0.3),
    "ggx 0.1": _glossy(0.1),
    "ggx 0.02": _glossy(0.02),
}


def lobes(m: Any, part: dict[str, Any]) -> Formula:
    """Radiance of von Mises-Fisher lobes."""
    axes = [
        (a, k, math.sin(t) * math.cos(f), math.sin(t) * math.sin(f), math.cos(t))
        for a, k, t, f in zip(part["amplitude"], part["kappa"], part["theta"], part["phi"], strict=True)
    ]
    return lambda x, y, z: sum(a * m.exp(k * (u * x + v * y + w * z - 1.0)) for a, k, u, v, w in axes)


@functools.cache
def lights() -> dict[str, list[dict[str, Any]]]:
    """Sources by name."""
    theta, phi = np.meshgrid(np.pi * (np.arange(64) + 0.5) / 64, 2 * np.pi * (np.arange(128) + 0.5) / 128, indexing="ij")
    grid = _studio(theta, phi).round(6).tolist()
    return {
        "beam": [{"kind": "collimated", **_towards(*SUN), "irradiance": 1.0}],
        "sphere": [{"kind": "uniform", "radiance": 1.0}],
        "sky": [{"kind": "hemispherical", "radiance": 1.0}],
        "overcast": [{"kind": "overcast", "zenith_radiance": 1.0}],
        "disk 5": [{"kind": "disk", **_towards(*SUN), "half_angle": math.radians(5.0), "radiance": 1.0}],
        "disk 0.25": [{"kind": "disk", **_towards(*SUN), "half_angle": math.radians(0.25), "radiance": 1.0}],
        "vmf": [{"kind": "uniform", "radiance": 0.2}, _LOBES],
        "map": [{"kind": "environment_map", "radiance": grid, "interpolation": "bilinear"}],
    }


@dataclass(frozen=True)
class Scene:
    """A surface under a source."""

    surface: str
    light: str

    @property
    def name(self) -> str:
        return f"{self.surface} + {self.light}"

    @property
    def glossy(self) -> bool:
        return self.surface.startswith("ggx")

    @property
    def kind(self) -> str:
        """Of the source's first part."""
        return str(lights()[self.light][0]["kind"])

    @property
    def data(self) -> dict[str, Any]:
        return {"brdf": SURFACES[self.surface], "source": lights()[self.light]}

    @property
    def uncertainty(self) -> float:
        """Relative, of the truths: two methods, or two orders, agree to it."""
        if self.kind != "environment_map":
            return 1e-11
        return 1e-8 if self.surface == "oren_nayar" else 1e-10

    def brdf(self) -> gonio.BRDF:
        return make_brdf(SURFACES[self.surface])

    def source(self) -> gonio.source.Source:
        return make_source(lights()[self.light])

    def f_r(self, m: Any) -> Formula:
        """f_r(xi, yi, zi, xr, zr) with the reflected direction at (xr, 0, zr) in the local frame; zi > 0."""
        terms = [_MODELS[t["model"]](m, t) for t in SURFACES[self.surface]]
        return terms[0] if len(terms) == 1 else lambda *w: sum(f(*w) for f in terms)

    def radiance(self, m: Any) -> Formula:
        """L_i(x, y, z) of a viewer-oriented direction."""
        parts = [_RADIANCES[p["kind"]](m, p) for p in lights()[self.light]]
        return parts[0] if len(parts) == 1 else lambda *w: sum(f(*w) for f in parts)


def scenes() -> list[Scene]:
    return [Scene(surface, light) for light in lights() for surface in SURFACES]


def _lambertian(m: Any, t: dict[str, Any]) -> Formula:
    return lambda xi, yi, zi, xr, zr: t["albedo"] / math.pi


def _ggx(m: Any, t: dict[str, Any]) -> Formula:
    k_s, a2, f_0 = t["k_s"], t["alpha"] ** 2, t["f_0"]

    def f(xi: Any, yi: Any, zi: Any, xr: Any, zr: Any) -> Any:
        x, z = xi + xr, zi + zr
        s2 = x * x + yi * yi
        l2 = s2 + z * z
        d = l2 / (a2 * z * z + s2)
        c = 1.0 - 0.5 * m.sqrt(l2)
        c2 = c * c
        g = zr * m.sqrt(zi * zi + a2 * (1.0 - zi * zi)) + zi * m.sqrt(zr * zr + a2 * (1.0 - zr * zr))
        return (0.5 * k_s * a2 / math.pi) * (f_0 + (1.0 - f_0) * c2 * c2 * c) * d * d / g

    return f


def _phong(m: Any, t: dict[str, Any]) -> Formula:
    scale, n = t["k_s"] * (t["n"] + 2.0) / (2.0 * math.pi), t["n"]
    return lambda xi, yi, zi, xr, zr: scale * m.maximum(0.0, zi * zr - xi * xr) ** n


def _oren_nayar(m: Any, t: dict[str, Any]) -> Formula:
    s2 = t["sigma"] ** 2
    a, b = t["albedo"] / math.pi * (1.0 - 0.5 * s2 / (s2 + 0.33)), t["albedo"] / math.pi * 0.45 * s2 / (s2 + 0.09)
    return lambda xi, yi, zi, xr, zr: a + b * m.maximum(0.0, xi * xr) / m.maximum(zi, zr)


def _environment_map(m: Any, part: dict[str, Any]) -> Formula:
    rows, columns = np.array(part["radiance"]).shape
    down, across = rows / math.pi, columns / (2.0 * math.pi)
    if m is NUMBERS:
        grid = part["radiance"]

        def at(x: float, y: float, z: float) -> float:
            u = min(max(math.acos(max(-1.0, min(1.0, z))) * down - 0.5, 0.0), rows - 1.0)
            v = math.atan2(y, x) * across - 0.5
            i, j = min(int(u), rows - 2), math.floor(v)
            u, v, j, k = u - i, v - j, j % columns, (j + 1) % columns
            return float(
                (1 - u) * ((1 - v) * grid[i][j] + v * grid[i][k]) + u * ((1 - v) * grid[i + 1][j] + v * grid[i + 1][k])
            )

        return at
    # one row and column more on each side, so that the lookup needs no case
    padded = np.pad(np.pad(np.array(part["radiance"]), ((1, 1), (0, 0)), "edge"), ((0, 0), (1, 1)), "wrap")
    flat, stride = padded.ravel(), columns + 2

    def of(x: Array, y: Array, z: Array) -> Array:
        u, v = np.arccos(np.clip(z, -1.0, 1.0)) * down + 0.5, (np.arctan2(y, x) % (2.0 * np.pi)) * across + 0.5
        i, j = u.astype(np.intp), v.astype(np.intp)
        u, v, at = u - i, v - j, i * stride + j
        above = flat[at] + v * (flat[at + 1] - flat[at])
        under = flat[at + stride] + v * (flat[at + stride + 1] - flat[at + stride])
        return above + u * (under - above)

    return of


def _disk(m: Any, part: dict[str, Any]) -> Formula:
    t, f, rim = part["theta"], part["phi"], math.cos(part["half_angle"])
    u, v, w = math.sin(t) * math.cos(f), math.sin(t) * math.sin(f), math.cos(t)
    return lambda x, y, z: part["radiance"] * (u * x + v * y + w * z > rim)


_MODELS = {"lambertian": _lambertian, "ggx": _ggx, "phong": _phong, "oren_nayar": _oren_nayar}
_RADIANCES: dict[str, Callable[[Any, dict[str, Any]], Formula]] = {
    "uniform": lambda m, part: lambda x, y, z: part["radiance"],
    "hemispherical": lambda m, part: lambda x, y, z: part["radiance"] * (z > 0.0),
    "overcast": lambda m, part: lambda x, y, z: part["zenith_radiance"] / 3.0 * (1.0 + 2.0 * z) * (z > 0.0),
    "disk": _disk,
    "lobes": lobes,
    "environment_map": _environment_map,
}


def sample() -> NDArray[np.intp]:
    """Pixels (row of q, column of p) at which errors are measured, shape (20, 2).

    Twelve by chance, on which peers are timed; then the one that mirrors the sun, the two that the sun's terminator crosses
    closest, a corner, and four around the first.
    """
    i, j = (int(np.argmin(np.abs(AXIS - c))) for c in (SUN[1], SUN[0]))
    sun = _towards(*SUN)
    across = math.sin(sun["theta"]) * (AXIS[None, :] * math.cos(sun["phi"]) + AXIS[:, None] * math.sin(sun["phi"]))
    above = (math.cos(sun["theta"]) - across) / np.sqrt(1.0 + AXIS[None, :] ** 2 + AXIS[:, None] ** 2)
    edge = np.argsort(np.where(above > 0, above, 2.0).ravel())[0], np.argsort(np.where(above < 0, -above, 2.0).ravel())[0]
    special = [(i, j), *(divmod(int(k), N) for k in edge), (0, N - 1)]
    near = [(i, j + 1), (i + 1, j), (i - 1, j - 1), (i, j - 2)]
    return np.concatenate((np.random.default_rng(7).integers(0, N, (12, 2)), special, near)).astype(np.intp)


def truths(scene: Scene, kept: dict[str, list[float]]) -> Array:
    """Scene radiance at the `sample`, shape (20,); computed where `kept` (by name of the scene) does not hold it."""
    if scene.name not in kept:
        at = [(float(AXIS[j]), float(AXIS[i])) for i, j in sample()]
        if scene.kind == "environment_map":
            kept[scene.name] = [texel_by_texel(scene, p, q, 24) for p, q in at]
        else:
            kept[scene.name] = [reflected_radiance({**scene.data, "p": p, "q": q}, "normal") for p, q in at]
    return np.array(kept[scene.name])


def relative_error(values: Array, true: Array) -> float:
    """Largest over the pixels that are not faint, NaN without any; the first of `true` belong to `values`."""
    seen = true[: len(values)] > FAINT * np.max(true)
    if not np.any(seen):
        return float("nan")
    off = np.abs(values - true[: len(values)])[seen] / true[: len(values)][seen]
    return float(np.max(off, initial=0.0))


def texel_by_texel(scene: Scene, p: float, q: float, order: int) -> float:
    """Scene radiance under a bilinear map: Gauss-Legendre in every texel that the surface sees, cut at its horizon.

    `tests.independent` would arrange the 64 x 128 edges for hours.
    """
    rows, columns = np.array(lights()[scene.light][0]["radiance"]).shape
    theta_n, phi_n = math.atan(math.hypot(p, q)), math.atan2(-q, -p)
    c, s = math.cos(theta_n), math.sin(theta_n)
    f_r, radiance = scene.f_r(np), scene.radiance(np)
    touch = (math.pi / 2 - theta_n, math.pi / 2 + theta_n)  # rings that the horizon touches
    cells = (np.arange(columns) + 0.5) * (2.0 * math.pi / columns) - phi_n
    cells = np.mod(cells + math.pi, 2.0 * math.pi) - math.pi
    crossed = np.arctan2(c, -s * np.cos(cells))  # rings on which the horizon crosses the edge of a column
    rings = np.unique([0.0, *touch, *((np.arange(rows) + 0.5) * math.pi / rows), *crossed])
    rings = rings[rings <= touch[1]]
    x, w = np.polynomial.legendre.leggauss(order)
    x, w = 0.5 * (x + 1.0), 0.5 * w
    total = 0.0
    for a, b in itertools.pairwise(rings):
        for u, v in zip(x, w, strict=True):
            t, dt = a + (b - a) * u * u * (3.0 - 2.0 * u), (b - a) * 6.0 * u * (1.0 - u) * v
            st, ct = math.sin(t), math.cos(t)
            reach = math.pi if t <= touch[0] else math.acos(max(-1.0, -(c * ct) / (s * st)))
            edges = np.sort(np.concatenate((cells[np.abs(cells) < reach], [-reach, reach])))
            psi = edges[:-1, None] + np.diff(edges)[:, None] * x
            along, across = st * np.cos(psi), st * np.sin(psi)
            zi = np.maximum(along * s + ct * c, 0.0)
            light = radiance(*(along * math.cos(phi_n) - across * math.sin(phi_n),
                               along * math.sin(phi_n) + across * math.cos(phi_n), np.full_like(psi, ct)))  # fmt: skip
            value = f_r(along * c - ct * s, across, zi, -s, c) * light * zi
            total += float(np.sum(value * w * np.diff(edges)[:, None])) * st * dt
    return total


def load_truths() -> dict[str, list[float]]:
    """What the file keeps; nothing if the scenes are others by now."""
    if not FILE.exists():
        return {}
    table = json.loads(FILE.read_text(encoding="utf-8"))
    return dict(table["values"]) if table["scenes"] == _fingerprint() else {}


def save_truths(kept: dict[str, list[float]]) -> None:
    FILE.write_text(json.dumps({"scenes": _fingerprint(), "values": kept}, indent=0) + "\n", encoding="utf-8")


def _fingerprint() -> str:
    import hashlib

    text = json.dumps([SURFACES, lights(), sample().tolist(), AXIS.tolist()])
    return hashlib.sha256(text.encode()).hexdigest()[:16]
