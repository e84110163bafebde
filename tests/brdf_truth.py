"""What every BRDF model is held against: a grid of directions, an evaluation at 40 digits, and properties of all of them.

The directions of the grid are doubles and count as exact: a formula is evaluated at 40 digits at just these vectors, so the
rounding of an angle is never counted as an error of the model. A length that is 1 to 1 eps only matters in two places, near
grazing mirrors and where the phase angle is small; `Geometry` therefore takes h from the vectors as they are, and the phase
angle from their sum and difference. A test writes its formula from the primary source, in the angles and vectors of
`Geometry`, and not as the model rearranges it:

    def lambert(g: Geometry, albedo: mpf) -> mpf:
        return albedo / pi

    def test_at_forty_digits() -> None:
        assert compare("lambertian", lambert, [{"albedo": 0.3}, {"albedo": 1.0}]) <= 1e-12
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import mpmath
import numpy as np
import pytest
from hypothesis import strategies as st
from mpmath import mpf
from numpy.typing import NDArray

import gonio
from gonio.brdf import families
from gonio.errors import ParameterError

Array = NDArray[np.float64]
DIGITS = 40
TINY = 1e-290  # values below it are 0: what underflows has no digits
GRAZING = math.radians(89.99)
THETAS = (0.0, 1e-8, 0.3, 1.0, 1.4, GRAZING)
DPHIS = (0.0, 0.5, 0.5 * math.pi, 2.5, math.pi)
BESIDE = (0.0, 1e-8, 1e-4)  # off the exact mirror and the exact retro direction [rad]


def _unit(theta: float, phi: float) -> Array:
    return np.array([math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)])


@functools.cache
def pairs(thin: int = 1) -> tuple[Array, Array]:
    """The grid: unit vectors omega_i, omega_r, each (n, 3); only every `thin`-th of the ordinary pairs.

    Pairs 1e-8 and 1e-4 rad beside the mirror and the retro direction, in the plane of incidence and across it, the exact
    ones and those at the normal and at 89.99 degrees are always in it.
    """
    azimuth = 0.7
    ordinary, special = [], []
    for ti in THETAS:
        for tr in THETAS:
            for dphi in DPHIS:
                ordinary.append((_unit(ti, azimuth), _unit(tr, azimuth + dphi)))
    for ti in THETAS:
        w = _unit(ti, azimuth)
        special += [(w, w.copy()), (w, w * [-1.0, -1.0, 1.0]), (w, np.array([0.0, 0.0, 1.0]))]  # exact to the last bit
        for off in BESIDE[1:]:
            for side in (0.0, math.pi):
                tr = ti - off if ti > 1.5 else ti + off
                special.append((w, _unit(tr, azimuth + side)))
                special.append((w, _unit(ti, azimuth + side + off / max(math.sin(ti), 0.1))))
    chosen = ordinary[::thin] + special
    omega_i, omega_r = (np.ascontiguousarray([pair[k] for pair in chosen]) for k in (0, 1))
    omega_i.flags.writeable = omega_r.flags.writeable = False
    return omega_i, omega_r


class Geometry:
    """A pair of directions at the digits of the mpmath context, and the angles that sources write their formulas in [rad].

    Vectors are tuples of three mpf. theta_d is the angle between omega_i and the half vector h; g is the phase angle
    between omega_i and omega_r; dphi in [0, pi] is 0 on the side of the incident light.
    """

    def __init__(self, omega_i: Sequence[float], omega_r: Sequence[float]) -> None:
        self.wi, self.wr = (tuple(mpf(c) for c in w) for w in (omega_i, omega_r))
        self.mu_i, self.mu_r = self.wi[2], self.wr[2]

    @functools.cached_property
    def h(self) -> tuple[mpf, mpf, mpf]:
        return unit([a + b for a, b in zip(self.wi, self.wr, strict=True)])

    @functools.cached_property
    def mu_h(self) -> mpf:
        return self.h[2]

    @functools.cached_property
    def tan2_h(self) -> mpf:
        """tan^2 theta_h."""
        return (self.h[0] ** 2 + self.h[1] ** 2) / self.h[2] ** 2

    @functools.cached_property
    def cos_g(self) -> mpf:
        return mpmath.cos(self.g)

    @functools.cached_property
    def g(self) -> mpf:
        apart, along = ([a + sign * b for a, b in zip(self.wi, self.wr, strict=True)] for sign in (-1, 1))
        return 2 * mpmath.atan2(mpmath.norm(apart), mpmath.norm(along))

    @functools.cached_property
    def cos_d(self) -> mpf:
        """cos theta_d = omega_i . h = omega_r . h."""
        return mpmath.cos(self.g / 2)

    @functools.cached_property
    def theta_i(self) -> mpf:
        return mpmath.atan2(mpmath.hypot(self.wi[0], self.wi[1]), self.mu_i)

    @functools.cached_property
    def theta_r(self) -> mpf:
        return mpmath.atan2(mpmath.hypot(self.wr[0], self.wr[1]), self.mu_r)

    @functools.cached_property
    def theta_h(self) -> mpf:
        return mpmath.atan2(mpmath.hypot(self.h[0], self.h[1]), self.mu_h)

    @functools.cached_property
    def dphi(self) -> mpf:
        """Difference of the azimuths; 0 where one of them has none."""
        (xi, yi, _), (xr, yr, _) = self.wi, self.wr
        return abs(mpmath.atan2(xi * yr - yi * xr, xi * xr + yi * yr))


def unit(v: Sequence[Any]) -> tuple[mpf, mpf, mpf]:
    x, y, z = (mpf(c) for c in v)
    length = mpmath.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


def compare(
    name: str,
    formula: Callable[..., mpf],
    sets: Iterable[Mapping[str, Any]],
    *,
    thin: int = 1,
    digits: int = DIGITS,
) -> float:
    """Worst relative error of a model over the grid and over parameter sets; prints it and where it is.

    Parameters
    ----------
    name : str
        As for `gonio.brdf.make`.
    formula : callable
        ``formula(geometry, **numbers) -> f_r`` at 40 digits; gets the numbers of a set as mpf, taken exactly. Choices
        (strings and flags) of a set go to `gonio.brdf.make` only. An mpf below `TINY` is held against 0.
    sets : iterable of mapping
        Arguments of `gonio.brdf.make`.
    thin : int
        Of `pairs`, where the formula is slow.
    """
    omega_i, omega_r = pairs(thin)
    worst, where, count = 0.0, "nowhere", 0
    geometries = [Geometry(*pair) for pair in zip(omega_i, omega_r, strict=True)]
    for given in sets:
        got = gonio.brdf.make(name, **given).evaluate(omega_i, omega_r)
        numbers = {key: mpf(value) for key, value in given.items() if not isinstance(value, str | bool)}
        for k in range(len(got)):
            with mpmath.workdps(digits):
                true = formula(geometries[k], **numbers)
                error = _error(float(got[k]), true)
            count += 1
            if error > worst:
                worst, where = (
                    error,
                    f"{given}, {_where(omega_i[k], omega_r[k])}: {float(got[k])!r}, not {mpmath.nstr(true, 17)}",
                )
    print(f"{name}: worst relative error {worst:.1e} of {count} values, at {where}")
    return worst


def _error(got: float, true: mpf) -> float:
    if abs(true) < TINY:
        return 0.0 if abs(got) <= 2 * TINY else math.inf
    return float(abs(mpf(got) - true) / abs(true)) if math.isfinite(got) else math.inf


def _where(wi: Array, wr: Array) -> str:
    g = Geometry(wi, wr)
    i, r, d, apart = (float(mpmath.degrees(a)) for a in (g.theta_i, g.theta_r, g.dphi, g.g))
    return f"theta_i = {i:.9g}, theta_r = {r:.9g}, dphi = {d:.9g}, g = {apart:.9g} deg"


# --- properties -----------------------------------------------------------------------------------------------------------


@functools.lru_cache(maxsize=256)
def random_pairs(count: int, seed: int) -> tuple[Array, Array]:
    """Random directions of the whole sphere, many of them near the horizon, the normal, the mirror and each other."""
    rng = np.random.default_rng(seed)

    def some(n: int) -> Array:
        z = np.where(rng.random(n) < 0.3, 10.0 ** rng.uniform(-9, 0, n), rng.random(n))
        z *= rng.choice([-1.0, 1.0, 1.0, 1.0], n)
        phi, s = rng.uniform(0, 2 * np.pi, n), np.sqrt((1 - z) * (1 + z))
        return np.stack((s * np.cos(phi), s * np.sin(phi), z), axis=-1)

    wi, wr = some(count), some(count)
    near = rng.random(count)
    off = rng.normal(size=(count, 3)) * (10.0 ** rng.uniform(-10, -1, count))[:, None]
    wr = np.where((near < 0.2)[:, None], wi * [-1.0, -1.0, 1.0] + off, wr)
    wr = np.where((near > 0.8)[:, None], wi + off, wr)
    return wi, wr / np.linalg.norm(wr, axis=1, keepdims=True)


def reciprocity(brdf: gonio.BRDF, count: int = 2000, seed: int = 1) -> float:
    """Worst relative difference of f_r with the directions exchanged.

    Asserts that all are finite, none negative, and those at or below the horizon 0.
    """
    wi, wr = random_pairs(count, seed)
    forward, backward = brdf.evaluate(wi, wr), brdf.evaluate(wr, wi)
    for wrong, what in (
        (~np.isfinite(forward), "not finite"),
        (forward < 0, "negative"),
        (((wi[:, 2] <= 0) | (wr[:, 2] <= 0)) & (forward != 0), "not 0 below the horizon"),
    ):
        assert not np.any(wrong), f"{brdf!r} is {what} for {wi[wrong][0]}, {wr[wrong][0]}: {forward[wrong][0]}"
    scale = np.maximum(np.maximum(forward, backward), TINY)
    return float(np.max(np.abs(forward - backward) / scale))


def largest_albedo(brdf: gonio.BRDF, *, rtol: float = 1e-6) -> float:
    """Largest directional albedo through the shared integrator, less its stated error."""
    thetas_deg = (0.0, 30.0, 60.0, 80.0, 89.0)
    estimates = [gonio.directional_albedo(brdf, math.radians(t), rtol=rtol) for t in thetas_deg]
    return max(float(e.value - e.error) for e in estimates)


def parameter_sets(name: str, **choices: Any) -> st.SearchStrategy[dict[str, Any]]:
    """Hypothesis: arguments of `gonio.brdf.make` inside the declared ranges, ends included; wide ranges by logarithm."""
    model = families.find(name).model(**choices)

    def numbers(lower: float, upper: float) -> st.SearchStrategy[float]:
        even = st.floats(lower, upper)
        if lower > 0 and upper / lower > 100 and math.isfinite(upper):
            even |= st.floats(math.log(lower), math.log(upper)).map(lambda x: min(max(math.exp(x), lower), upper))
        return even | st.sampled_from([lower, upper])

    fixed = {p.name: numbers(p.lower, p.upper) for p in model.parameters}
    return st.fixed_dictionaries(fixed).map(lambda given: {**given, **choices})


def check_refusals(name: str, given: Mapping[str, Any], **choices: Any) -> None:
    """Outside each end of each range, and not a number: one clear sentence with the parameter's name."""
    for parameter in families.find(name).model(**choices).parameters:
        ends = (math.nextafter(parameter.lower, -math.inf), math.nextafter(parameter.upper, math.inf), math.nan, math.inf)
        for value in ends:
            with pytest.raises(ParameterError, match=rf"{parameter.name} = .* is outside \["):
                gonio.brdf.make(name, **{**given, **choices, parameter.name: value})
