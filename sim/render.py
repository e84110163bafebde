r"""What a camera sees of a specimen under a near lamp: rays, shapes, and the integral over lamp and lens.

Everything is done in the specimen's own frame. The lamp is a point, or a frosted globe of uniform radiance, which is a
uniform disk from wherever it is seen; the lens is a pinhole or a disk that is sharp in the plane z = 0. The radiance is

.. math:: L_r = \int f_r\,L_i \cos\theta_i\,\mathrm{d}\omega_i , \qquad
          \bar L = \frac1A\int L_r\,(\ell_0/\ell)^4\,\mathrm{d}A ,

over the globe's cone and over the lens, l the way from a place on the lens to where the ray is sharp: image irradiance goes
with L cos^4, and the sensor has the cos^4 of the lens's centre. A point lamp and a pinhole need one evaluation; otherwise
rules of the shared integrator (Gauss-Legendre in 1 - cos t and in the area of the lens, equal steps around) climb until
two agree to `RTOL` of each pixel, or it refuses. Where the specimen's rim or its horizon cuts lamp or lens, the integrand
jumps, and the pixel is as good as the rule's sampling: about a percent.

Convex shapes only: no place shades another. References: B. K. P. Horn, R. W. Sjoberg, MIT AI Memo 498, sections 9, 13.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.brdf import BRDF
from gonio.errors import ConfigurationError
from gonio.integrate.cap import unit_rule

Array = NDArray[np.float64]

RTOL = 2e-4
SHAPES = ("flat", "sphere", "cylinder", "board")
_FLAT, _SPHERE, _CYLINDER, _BOARD = range(4)
_RULES = ((1, 4), (2, 6), (3, 8), (4, 12), (6, 16), (9, 24), (13, 36), (19, 48))  # along the radius, around
_CUT = 3  # the least of them where something is cut
_PROBES = 1500  # pixels on which a rule is chosen
_FAINT = 1e-3  # of the brightest pixel: an error relative to less says nothing


@dataclass(frozen=True)
class Scene:
    """A specimen and a lamp at one moment.

    Attributes
    ----------
    brdf : BRDF
    frame : ndarray, shape (3, 3)
        Columns: the specimen's x, y and normal in the bench's frame.
    lamp : ndarray, shape (3,)
        Centre of the lamp in the bench's frame [mm].
    intensity : float
        Radiant intensity, the same in every direction [W/sr].
    lamp_radius : float
        Of the globe [mm]; 0 for a point.
    shape : str
        ``"flat"``: a disk of `radius` through the origin. ``"sphere"``: about the origin. ``"cylinder"``: about the
        specimen's y axis, closed at +- `half_length`. ``"board"``: a rectangle, +- `radius` by +- `half_length`.
    radius, half_length : float
        [mm]
    texture : ndarray, shape (rows, columns), optional
        Factor of the BRDF over the square or rectangle that holds a flat shape, row 0 at the largest y.
    """

    brdf: BRDF
    frame: Array
    lamp: Array
    intensity: float
    lamp_radius: float = 0.0
    shape: str = "flat"
    radius: float = 25.0
    half_length: float = 50.0
    texture: Array | None = None


def radiance(scene: Scene, eye: Array, rays: Array, lens_radius: float = 0.0) -> Array:
    """Radiance that reaches a camera along rays, averaged over its lens.

    Parameters
    ----------
    scene : Scene
    eye : ndarray, shape (3,)
        Centre of the lens [mm], above the plane z = 0; the lens lies parallel to it.
    rays : ndarray, shape (n, 3)
        Unit vectors from there.
    lens_radius : float, optional
        [mm]; 0 for a pinhole.

    Returns
    -------
    ndarray, shape (n,)
        [W m^-2 sr^-1]; 0 beside the specimen, behind it and where no light falls on it.

    Raises
    ------
    ConfigurationError
        If lamp and lens are too large for so narrow a lobe: no rule is fine enough.
    """
    if scene.lamp_radius == 0.0 and lens_radius == 0.0:
        return _seen(scene, eye, rays, None)[0]
    probe = np.ascontiguousarray(rays[:: max(1, len(rays) // _PROBES)])
    before, _ = _through(scene, eye, probe, lens_radius, _RULES[0])
    for number, rule in enumerate(_RULES[1:], start=1):
        now, whole = _through(scene, eye, probe, lens_radius, rule)
        if np.all(np.abs(now - before)[whole] <= RTOL * np.maximum(now, _FAINT * now.max(initial=0.0))[whole]):
            cut = bool(np.any((now > 0.0) & ~whole))
            return _through(scene, eye, rays, lens_radius, _RULES[max(number, _CUT)] if cut else rule)[0]
        before = now
    raise ConfigurationError(
        f"A lamp of radius {scene.lamp_radius:g} mm and a lens of {lens_radius:g} mm are too large for so narrow a lobe; "
        "make [sim.truth] lamp_radius_mm or lens_radius_mm smaller, or the sample rougher."
    )


def _through(
    scene: Scene, eye: Array, rays: Array, lens_radius: float, rule: tuple[int, int]
) -> tuple[Array, NDArray[np.bool_]]:
    """The mean over the lens by one rule, and where nothing cuts lamp or lens."""
    if lens_radius == 0.0:
        return _seen(scene, eye, rays, rule)
    with np.errstate(divide="ignore", invalid="ignore"):
        way = np.where(rays[:, 2] < 0.0, -eye[2] / rays[:, 2], 1.0)
    sharp = eye + way[:, None] * rays  # where the bundle meets, in the plane z = 0
    total, whole = np.zeros(len(rays)), np.ones(len(rays), np.bool_)
    for area, weight, phi in _polar(rule):
        offset = lens_radius * math.sqrt(area)
        place = eye + offset * np.array([math.cos(phi), math.sin(phi), 0.0])
        bundle = sharp - place
        length = np.sqrt(np.einsum("ij,ij->i", bundle, bundle))
        seen, lit = _seen(scene, place, bundle / length[:, None], rule)
        total += weight * (way / length) ** 4 * seen
        whole &= lit
    return total, whole


def _polar(rule: tuple[int, int]) -> list[tuple[float, float, float]]:
    """(share of the area within, weight, azimuth) of the nodes on a disk; the weights' sum is 1."""
    along, around = rule
    x, w = unit_rule(along)
    turns = 2.0 * math.pi * (np.arange(around)[None, :] + 0.5 * (np.arange(along) % 2)[:, None]) / around
    return [(float(x[k]), float(w[k]) / around, float(phi)) for k in range(along) for phi in turns[k]]


def _seen(scene: Scene, eye: Array, rays: Array, rule: tuple[int, int] | None) -> tuple[Array, NDArray[np.bool_]]:
    """Radiance along rays from one place, and whether they meet the specimen where all of the lamp is up."""
    out, lit = np.zeros(len(rays)), np.zeros(len(rays), np.bool_)
    if scene.intensity == 0.0:
        return out, lit
    room = _Room.of(len(rays))
    eye_local, lamp_local = eye @ scene.frame, scene.lamp @ scene.frame
    count = _trace(
        eye_local, np.ascontiguousarray(rays), scene.frame, SHAPES.index(scene.shape), scene.radius, scene.half_length,
        room.hit, room.place, room.normal, room.omega_r,
    )  # fmt: skip
    hit, place, normal, omega_r = room.hit[:count], room.place[:count], room.normal[:count], room.omega_r[:count]
    omega_i, flux = room.omega_i[:count], room.flux[:count]
    total, up = np.zeros(count), np.ones(count, np.bool_)
    globe = rule is not None and scene.lamp_radius > 0.0
    for versed, weight, phi in _polar(rule) if globe and rule is not None else [(0.0, 1.0, 0.0)]:
        _light(place, normal, lamp_local, 1e6 * scene.intensity * weight, scene.lamp_radius if globe else 0.0,
               versed, math.cos(phi), math.sin(phi), omega_i, flux)  # fmt: skip
        total += scene.brdf.evaluate(omega_i, omega_r) * flux
        if rule is not None:
            up &= flux > 0.0
    if scene.texture is not None:
        total *= _texture(scene, place)
    out[hit] = total
    lit[hit] = up
    return out, lit


def _texture(scene: Scene, place: Array) -> Array:
    """Factor at each place, shape (n,)."""
    assert scene.texture is not None
    rows, columns = scene.texture.shape
    half_y = scene.half_length if scene.shape == "board" else scene.radius
    # bilinear between the centres of the texels
    u = np.clip((place[:, 0] / scene.radius + 1.0) * 0.5 * columns - 0.5, 0.0, columns - 1.001)
    v = np.clip((1.0 - place[:, 1] / half_y) * 0.5 * rows - 0.5, 0.0, rows - 1.001)
    i, j = v.astype(np.intp), u.astype(np.intp)
    down, right = v - i, u - j
    map_ = scene.texture
    upper = map_[i, j] * (1.0 - right) + map_[i, j + 1] * right
    lower = map_[i + 1, j] * (1.0 - right) + map_[i + 1, j + 1] * right
    found: Array = upper * (1.0 - down) + lower * down
    return found


class _Room:
    """Arrays for one image, used again for the next of its size."""

    _last: _Room | None = None

    def __init__(self, size: int) -> None:
        self.size = size
        self.hit = np.empty(size, np.int64)
        self.place, self.normal, self.omega_r, self.omega_i = (np.empty((size, 3)) for _ in range(4))
        self.flux = np.empty(size)

    @classmethod
    def of(cls, size: int) -> _Room:
        if cls._last is None or cls._last.size != size:
            cls._last = cls(size)
        return cls._last


@jit.part
def _tangent(nx, ny, nz):  # type: ignore[no-untyped-def]
    """The surface's x axis: horizontal in the specimen's frame, along x at its top."""
    length = math.sqrt(nx * nx + nz * nz)
    if length < 1e-12:
        return 1.0, 0.0, 0.0
    return nz / length, 0.0, -nx / length  # y x n


@jit.part
def _local(vx, vy, vz, nx, ny, nz):  # type: ignore[no-untyped-def]
    """A vector in the frame of the surface."""
    tx, ty, tz = _tangent(nx, ny, nz)
    bx, by, bz = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx  # n x t
    return vx * tx + vy * ty + vz * tz, vx * bx + vy * by + vz * bz, vx * nx + vy * ny + vz * nz


def _trace_rays(eye, rays, frame, shape, radius, half_length, hit, place, normal, omega_r):  # type: ignore[no-untyped-def]
    count = 0
    ex, ey, ez = eye[0], eye[1], eye[2]
    for i in range(len(rays)):
        rx, ry, rz = rays[i, 0], rays[i, 1], rays[i, 2]
        dx = rx * frame[0, 0] + ry * frame[1, 0] + rz * frame[2, 0]
        dy = rx * frame[0, 1] + ry * frame[1, 1] + rz * frame[2, 1]
        dz = rx * frame[0, 2] + ry * frame[1, 2] + rz * frame[2, 2]
        nx, ny, nz = 0.0, 0.0, 1.0
        if shape in (_SPHERE, _CYLINDER):
            # |e + s d| = R, without the y components for a cylinder
            a, b, c = dx * dx + dz * dz, ex * dx + ez * dz, ex * ex + ez * ez - radius * radius
            if shape == _SPHERE:
                a, b, c = a + dy * dy, b + ey * dy, c + ey * ey
            inside = b * b - a * c
            if inside <= 0.0 or b >= 0.0:
                continue
            s = -(b + math.sqrt(inside)) / a
            x, y, z = ex + s * dx, ey + s * dy, ez + s * dz
            nx, nz = x / radius, z / radius
            if shape == _SPHERE:
                ny = y / radius
            elif abs(y) > half_length:
                continue
        else:
            if ez <= 0.0 or dz >= 0.0:
                continue
            s = -ez / dz
            x, y, z = ex + s * dx, ey + s * dy, 0.0
            if shape == _FLAT:
                if x * x + y * y > radius * radius:
                    continue
            elif abs(x) > radius or abs(y) > half_length:
                continue
        hit[count] = i
        place[count, 0], place[count, 1], place[count, 2] = x, y, z
        normal[count, 0], normal[count, 1], normal[count, 2] = nx, ny, nz
        omega_r[count, 0], omega_r[count, 1], omega_r[count, 2] = _local(-dx, -dy, -dz, nx, ny, nz)
        count += 1
    return count


def _light_places(place, normal, lamp, intensity, radius, versed, cos_phi, sin_phi, omega_i, flux):  # type: ignore[no-untyped-def]
    for i in range(len(place)):
        lx, ly, lz = lamp[0] - place[i, 0], lamp[1] - place[i, 1], lamp[2] - place[i, 2]
        d2 = lx * lx + ly * ly + lz * lz
        d = math.sqrt(d2)
        lx, ly, lz = lx / d, ly / d, lz / d
        nx, ny, nz = normal[i, 0], normal[i, 1], normal[i, 2]
        strength = intensity / d2  # of a point: I / d^2
        if radius > 0.0:
            # a node of the cone under which the globe is seen; L_i = I / (pi R^2) over 2 pi (1 - cos a) sr
            depth = 1.0 - math.sqrt(1.0 - radius * radius / d2)
            strength = intensity * 2.0 * depth / (radius * radius)
            t = depth * versed  # 1 - cos t
            sine = math.sqrt(t * (2.0 - t))
            if abs(lz) < 0.9:
                ux, uy, uz = ly, -lx, 0.0
            else:
                ux, uy, uz = 0.0, lz, -ly
            length = math.sqrt(ux * ux + uy * uy + uz * uz)
            ux, uy, uz = ux / length, uy / length, uz / length
            wx, wy, wz = ly * uz - lz * uy, lz * ux - lx * uz, lx * uy - ly * ux
            lx = (1.0 - t) * lx + sine * (cos_phi * ux + sin_phi * wx)
            ly = (1.0 - t) * ly + sine * (cos_phi * uy + sin_phi * wy)
            lz = (1.0 - t) * lz + sine * (cos_phi * uz + sin_phi * wz)
        x, y, z = _local(lx, ly, lz, nx, ny, nz)
        omega_i[i, 0], omega_i[i, 1], omega_i[i, 2] = x, y, z
        flux[i] = strength * max(z, 0.0)


_trace: Any = jit.kernel(_trace_rays)
_light: Any = jit.kernel(_light_places)
