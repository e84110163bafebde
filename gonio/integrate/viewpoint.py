"""Viewers off the axis and surfaces with a grain.

A viewer elsewhere sees the same scene turned: beams, caps, lobes and harmonics are turned with him, so that all fast methods
hold; environment maps and a user's functions stay where they are and are integrated element by element. A surface with a
grain, an anisotropic BRDF, needs to be told which way it runs.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gonio import jit
from gonio.brdf.base import BRDF
from gonio.errors import GeometryError, IntegrationError, ParameterError
from gonio.fields import Field, FunctionField, Harmonics, Lobes
from gonio.geometry import angles, unit_vector
from gonio.integrate import closed_forms
from gonio.integrate.frames import Elements
from gonio.integrate.lights import over_field
from gonio.integrate.plan import Method, Step, plan
from gonio.integrate.results import MapValues, insist
from gonio.source import Cap, Collimated, Part, Source

Array = NDArray[np.float64]
EPS = float(np.finfo(float).eps)


def with_grain(brdf: BRDF, elements: Elements, tangent: ArrayLike | None) -> Elements:
    """The elements in frames whose x axis is the grain's; as they are for an isotropic BRDF.

    Raises
    ------
    ParameterError
        If the BRDF is anisotropic and there is no tangent, or it is not finite.
    """
    grained = [term.model.name for term in brdf.terms if not term.model.isotropic]
    if tangent is not None and not np.all(np.isfinite(tangent)):
        raise ParameterError("tangent must be finite: the rotation of the surface's x axis about its normal [rad]")
    if not grained:
        return elements
    if tangent is None:
        raise ParameterError(
            f"{grained[0]} is anisotropic: give tangent=, the rotation [rad] of its x axis about the normal, from the "
            "direction (1, 0, p) of the surface"
        )
    return elements.turned(tangent)


def depends_on_user(brdf: BRDF, source: Source) -> bool:
    """Whether a function of the user's takes part, so that errors are estimates."""
    return any(t.model.own for t in brdf.terms) or any(isinstance(p, FunctionField) for p in source.parts)


def seen_from(
    viewer: tuple[float, float],
    brdf: BRDF,
    source: Source,
    p: Array,
    q: Array,
    rtol: float,
    atol: float,
    tangent: ArrayLike | None,
) -> MapValues:
    """The reflectance map for a distant viewer in the direction (theta, phi) [rad]; `gonio.reflectance_map` explains."""
    from gonio.integrate import reflectance_map

    rotation = _rotation(*viewer)
    grain = None if tangent is None else np.broadcast_to(np.asarray(tangent, dtype=float), p.shape).ravel()
    upright = Elements.from_gradient(p.ravel(), q.ravel())
    normal = _normals(upright) @ rotation.T
    seen = np.flatnonzero(normal[:, 2] > 0)
    value, error = np.zeros(p.size), np.zeros(p.size)
    p_seen, q_seen = -normal[seen, 0] / normal[seen, 2], -normal[seen, 1] / normal[seen, 2]
    turned = Elements.from_gradient(p_seen, q_seen)
    with_grain(brdf, upright, grain)  # complains before anything is computed
    own = None if grain is None else _grain_seen(upright, turned, grain, seen, rotation)

    fast: list[Part] = []
    slow: list[Field] = []
    for part in Source.of(source).parts:
        if isinstance(part, Field) and not isinstance(part, Lobes | Harmonics):
            slow.append(part)
        else:
            fast.append(_turned_part(part, rotation))
    impulses: list[tuple[float, float, float]] = []
    steps: list[Step] = []
    if fast:
        try:
            got = reflectance_map(brdf, Source(fast), p_seen, q_seen, rtol=rtol, atol=atol, tangent=own)
        except IntegrationError as exc:
            if not isinstance(exc.best, MapValues):
                raise
            got = exc.best
        value[seen], error[seen] = got.value, got.error
        steps += got.plan
        impulses = _impulses_back(got.impulses, rotation)
    if slow:
        placed = replace(turned, view=rotation)
        for step in plan(brdf, Source(slow)):
            assert isinstance(step.part, Field)
            start = time.perf_counter() - jit.getting_ready_s()
            if step.method is Method.ZERO:
                v, e = np.zeros(len(seen)), np.zeros(len(seen))
            elif step.method is Method.MIRROR:
                v, e = closed_forms.mirror_cap(step.term, step.part, placed)
            else:
                step.method, step.reason = Method.FIELD, "viewer off axis: quadrature per gradient"
                elements = placed if step.term.model.isotropic else with_grain(brdf, placed, own)
                v, e = over_field(step.term, step.part, elements, rtol=rtol, atol=atol / len(slow), effort=step.effort)
            value[seen] += v
            error[seen] += e
            step.error = float(np.max(np.divide(e, np.abs(v), out=np.zeros_like(e), where=v != 0), initial=0.0))
            step.seconds = max(0.0, time.perf_counter() - jit.getting_ready_s() - start)
            steps.append(step)
    bound = not depends_on_user(brdf, Source.of(source))
    result = MapValues(value.reshape(p.shape), error.reshape(p.shape), impulses, steps, error_is_bound=bound)
    return insist(result, rtol, atol)


def _rotation(theta: float, phi: float) -> Array:
    """Matrix that turns the viewer's direction to z."""
    if not (math.isfinite(theta) and math.isfinite(phi) and 0 <= theta <= math.pi):
        raise GeometryError(
            f"viewer at theta = {math.degrees(theta):g}, phi = {math.degrees(phi):g} degrees; choose 0 <= theta <= 180 "
            "degrees and a finite phi"
        )
    c, s, cf, sf = math.cos(theta), math.sin(theta), math.cos(phi), math.sin(phi)
    return np.array([[c * cf, c * sf, -s], [-sf, cf, 0.0], unit_vector(theta, phi)])


def _normals(elements: Elements) -> Array:
    e = elements
    return np.stack((e.sin_theta * e.cos_phi, e.sin_theta * e.sin_phi, e.cos_theta), axis=-1)


def _turned_part(part: Part, rotation: Array) -> Part:
    def turned(axis: tuple[float, float, float]) -> tuple[float, float, float]:
        x, y, z = rotation @ np.array(axis)
        if math.hypot(x, y) < 4.0 * EPS:  # along the viewer's axis: symmetric, and fast
            x, y, z = 0.0, 0.0, math.copysign(1.0, z)
        return float(x), float(y), float(z)

    if isinstance(part, Collimated):
        return replace(part, direction=turned(part.direction))
    if isinstance(part, Cap):
        same = part.half_angle >= math.pi and part.profile is None
        return part if same else replace(part, axis=turned(part.axis))
    if isinstance(part, Harmonics):
        return part.turned(rotation)
    assert isinstance(part, Lobes)
    theta, phi = angles(part.axes() @ rotation.T)
    return replace(part, theta=theta, phi=phi)


def _grain_seen(upright: Elements, turned: Elements, grain: Array, seen: NDArray[np.intp], rotation: Array) -> Array:
    """The grain as an angle from (1, 0, p') of the turned scene."""
    local = upright.select(seen).turned(grain[seen])
    assert local.turn is not None
    e, c, s = local, np.cos(local.turn), np.sin(local.turn)
    x = np.stack((e.cos_theta * e.cos_phi, e.cos_theta * e.sin_phi, -e.sin_theta), axis=-1)
    y = np.stack((-e.sin_phi, e.cos_phi, np.zeros(len(e))), axis=-1)
    world = (c[:, None] * x + s[:, None] * y) @ rotation.T
    e = turned
    along = e.cos_theta * (world[:, 0] * e.cos_phi + world[:, 1] * e.sin_phi) - e.sin_theta * world[:, 2]
    across = world[:, 1] * e.cos_phi - world[:, 0] * e.sin_phi
    start = turned.turned(0.0).turn
    assert start is not None
    return np.asarray(np.arctan2(across, along) - start)


def _impulses_back(impulses: list[tuple[float, float, float]], rotation: Array) -> list[tuple[float, float, float]]:
    """Impulses in the scene's own gradients: dp dq = (1 + p^2 + q^2)^(3/2) d omega_n in both."""
    back = []
    for p, q, weight in impulses:
        x, y, z = np.array([-p, -q, 1.0]) @ rotation
        if z > 0:  # the surface is z(x, y) no longer where its normal points below
            p1, q1 = float(-x / z) + 0.0, float(-y / z) + 0.0
            back.append((p1, q1, weight * ((1.0 + p1 * p1 + q1 * q1) / (1.0 + p * p + q * q)) ** 1.5))
    return back
