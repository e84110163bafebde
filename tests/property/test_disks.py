"""Rules for small disks: their error bound at random scenes, closed forms, and the seams between rules."""

from __future__ import annotations

import math
from collections.abc import Iterator

import mpmath
import numpy as np
import pytest

import gonio
from gonio.brdf.base import BRDF
from gonio.geometry import normal_from_gradient
from gonio.integrate import disk, scene_radiance
from gonio.integrate.frames import Elements
from gonio.integrate.tails import UNDERFLOW, upper_bound
from gonio.source import Cap
from tests import problems
from tests.independent import reflected_radiance

make_brdf, make_source = gonio.brdf.make, gonio.source.make


@pytest.mark.parametrize("degree", disk._DEGREES)
def test_rules_integrate_polynomials_exactly(degree: int) -> None:
    """Moments of the unit disk in closed form: mean of x^i y^j = G((i+1)/2) G((j+1)/2) / (pi (i/2+j/2+1) G(i/2+j/2+1))."""
    x, y, w = disk._flat(degree)
    for total in range(degree + 1):
        for i in range(total + 1):
            j = total - i
            mean = 0.0
            if i % 2 == 0 and j % 2 == 0:
                half = 0.5 * total + 1.0
                mean = math.gamma(0.5 * (i + 1)) * math.gamma(0.5 * (j + 1)) / (math.gamma(half) * half * math.pi)
            assert float(w @ (x**i * y**j)) == pytest.approx(mean, abs=1e-14)


def _above_horizon(gamma: float, delta: float) -> float:
    """Integral of the cosine over the part above the horizon of a cap that it cuts: rings about the normal, 30 digits."""
    with mpmath.workdps(30):
        cut_g, cut_d = mpmath.mpf(gamma), mpmath.mpf(delta)

        def ring(u: mpmath.mpf) -> mpmath.mpf:
            middle, half = (mpmath.pi / 2 + abs(cut_g - cut_d)) / 2, (mpmath.pi / 2 - abs(cut_g - cut_d)) / 2
            t = middle - half * mpmath.cos(u)
            x = (mpmath.cos(cut_d) - mpmath.cos(t) * mpmath.cos(cut_g)) / (mpmath.sin(t) * mpmath.sin(cut_g))
            return 2 * mpmath.acos(min(mpmath.mpf(1), max(mpmath.mpf(-1), x))) * mpmath.sin(t) * mpmath.cos(t) * half * (
                mpmath.sin(u)
            )

        inner = mpmath.pi * mpmath.sin(max(cut_d - cut_g, mpmath.mpf(0))) ** 2
        return float(inner + mpmath.quad(ring, [0, mpmath.pi / 2, mpmath.pi]))


@pytest.mark.parametrize("half_angle", [1e-6, 0.004, 0.3, 1.0])
@pytest.mark.parametrize("risen", [-0.999, -0.9, -0.3, 0.4, 0.99, 1.5])
def test_diffuse_surface_under_a_disk(half_angle: float, risen: float) -> None:
    """White paper under a disk whose centre stands `risen` half angles above its horizon, against mpmath."""
    gamma = math.pi / 2 - risen * half_angle
    sun = make_source("disk", theta=gamma, phi=0.0, half_angle=half_angle, radiance=1.0)
    paper = make_brdf("lambertian", albedo=1.0)
    got = gonio.reflectance_map(paper, sun, 0.0, 0.0, rtol=1e-3)
    (cap,) = sun.parts
    assert isinstance(cap, Cap)
    truth = _above_horizon(math.acos(cap.axis[2]), half_angle) if risen < 1.0 else math.pi * math.sin(half_angle) ** 2 * (
        cap.axis[2]
    )
    assert abs(float(got.value) - truth / math.pi) <= float(got.error)
    assert float(got.error) <= 1e-10 * float(got.value) / min(1.0, (1.0 + risen) * half_angle)


def _models(rng: np.random.Generator) -> Iterator[BRDF]:
    yield make_brdf("ggx", k_s=1.0, alpha=10 ** rng.uniform(-3, 0), f_0=0.04)
    yield make_brdf("beckmann", k_s=1.0, alpha=10 ** rng.uniform(-3, 0), f_0=0.04)
    yield make_brdf("phong", k_s=1.0, n=10 ** rng.uniform(0.3, 3.5))
    yield make_brdf("blinn_phong", k_s=1.0, n=10 ** rng.uniform(0, 3))
    yield make_brdf("lommel_seeliger", w=rng.uniform(0.1, 1.0))
    yield make_brdf("oren_nayar", albedo=0.8, sigma=rng.uniform(0.0, 0.9))


@pytest.mark.parametrize("seed", range(3))
def test_disks_are_honest_at_random(seed: int) -> None:
    """Half angles of 0.06 to 17 degrees anywhere in the sky, against the general rule at 1e-11."""
    rng = np.random.default_rng([20, seed])
    checked = 0
    for rtol in (1e-3, 1e-6, 1e-9):
        for brdf in _models(rng):
            sun = make_source(
                "disk", theta=rng.uniform(0, 2), phi=rng.uniform(0, 6), half_angle=10 ** rng.uniform(-3, -0.5), radiance=1.0
            )
            (cap,) = sun.parts
            assert isinstance(cap, Cap)
            p, q = rng.normal(size=(2, 45)) * 10 ** rng.uniform(-1, 1)
            x, y, z = cap.axis
            near = rng.normal(size=(2, 15)) * (cap.half_angle + 0.1)
            p[:15], q[:15] = -x / (1.0 + z) + near[0], -y / (1.0 + z) + near[1]
            if abs(x) > 0.05:  # the horizon through the disk, or next to it
                q[15:30] = rng.normal(size=15)
                p[15:30] = (z - q[15:30] * y - rng.uniform(-1, 3, 15) * cap.half_angle) / x
            try:
                got = gonio.reflectance_map(brdf, sun, p, q, rtol=rtol)
            except gonio.errors.IntegrationError as exc:
                got = exc.best
            truth = scene_radiance(brdf, sun, *normal_from_gradient(p, q), form="viewer", rtol=1e-11)
            off = np.abs(got.value - truth.value) - (got.error + truth.error)
            worst = int(np.argmax(off))
            assert off[worst] <= 0.0, (brdf, cap, float(p[worst]), float(q[worst]), got.value[worst], got.error[worst], rtol)
            checked += len(p)
    assert checked == 3 * 6 * 45


# --- tails --------------------------------------------------------------------------------------------------------------


def _off_the_lobe(rng: np.random.Generator, tilt: float, away: float, half_angle: float) -> dict[str, object]:
    """A disk whose centre is `away` from the direction that a surface of that tilt towards +x mirrors."""
    c, s, chi = math.cos(2 * tilt), math.sin(2 * tilt), rng.uniform(0, 2 * math.pi)
    mirror, across = np.array([s, 0.0, c]), np.array([c, 0.0, -s])
    aside = math.cos(chi) * across + math.sin(chi) * np.array([0.0, 1.0, 0.0])
    x, y, z = math.cos(away) * mirror + math.sin(away) * aside
    return {"kind": "disk", "theta": math.acos(z), "phi": math.atan2(y, x), "half_angle": half_angle, "radiance": 1.0}


def _lobes(rng: np.random.Generator, kinds: int) -> dict[str, object]:
    n = 10 ** rng.uniform(0, 4)
    leaning = {"C_xy": rng.uniform(-1, 1), "C_z": rng.uniform(0.2, 1)}
    models: list[dict[str, object]] = [{"model": "phong"}, {"model": "blinn_phong"}, {"model": "lafortune", **leaning}]
    return {"k_s": 1.0, "n": n, **models[rng.integers(kinds)]}


@pytest.mark.parametrize("others", [0, 3, 600])
def test_where_only_the_tail_of_a_lobe_is_lit(others: int) -> None:
    """Rationale: nodes meet nothing, or next to nothing, of a lobe of a high power whose cut, a right angle away, is there.

    The value is good to the tolerance, however small, or nothing next to the brightest of many gradients; the error is
    never below what is missing. Against the independent evaluation, down to what underflows.
    """
    rng = np.random.default_rng([21, others])
    faint = 0
    for k in range(100 if others < 600 else 25):
        term, rtol, tilt = _lobes(rng, 3 if others < 600 else 2), (1e-3, 1e-6, 1e-9)[k % 3], rng.uniform(0, 1.5)
        half_angle = 10 ** rng.uniform(-3, -0.46) if k % 4 or others == 600 else rng.uniform(0.35, 1.2)
        away = (math.pi / 2 if k % 2 else rng.uniform(0.3, 2.0)) + half_angle * rng.uniform(-1.05, 1.0)
        part = _off_the_lobe(rng, tilt, away, half_angle)
        p, q = rng.normal(scale=1.5, size=(2, 1 + others))
        p[0], q[0] = -math.tan(tilt), 0.0
        p[1:4], q[1:4] = p[0] + 0.02 * p[1:4], 0.02 * q[1:4]
        got = gonio.reflectance_map(problems.make_brdf([term]), problems.make_source([part]), p, q, rtol=rtol)
        for j in range(min(len(p), 4)):
            scene, value, error = {"brdf": [term], "source": [part], "p": p[j], "q": q[j]}, got.value[j], got.error[j]
            truth = reflected_radiance(scene, "normal", 1e-11)
            assert abs(value - truth) <= error + 1e-10 * truth + 1e-290, (scene, value, error, truth)
            assert error <= max(rtol * value, 1e-13 * np.max(got.value), 1e-250), (scene, value, error)
            faint += 0.0 < truth < 1e-40
    assert faint > 5


def test_the_bound_of_a_tail_is_above_it() -> None:
    """For caps of any size and all views, cut by the horizon or not."""
    rng = np.random.default_rng(22)
    for _ in range(150):
        term, tilt, half_angle = _lobes(rng, 2), rng.uniform(0, 1.5), 10 ** rng.uniform(-3, 0.19)
        part = _off_the_lobe(rng, tilt, rng.uniform(0, 2.5), half_angle)
        (cap,), element = problems.make_source([part]).parts, Elements.from_gradient(-math.tan(tilt), 0.0)
        assert isinstance(cap, Cap)
        brdf = problems.make_brdf([term])
        bound = upper_bound(brdf.terms[0], element.local(cap.axis), half_angle, element.cos_theta, element.sin_theta)
        truth = reflected_radiance({"brdf": [term], "source": [part], "p": -math.tan(tilt), "q": 0.0}, "normal", 1e-6)
        assert truth <= max(float(bound[0]), UNDERFLOW), (term, part, tilt)


def test_a_disk_beyond_the_cut_or_below_the_horizon_gives_nothing() -> None:
    for n in (3.0, 46.54, 1e4):
        lobe = make_brdf("phong", k_s=1.0, n=n)
        for theta, p in ((math.radians(95.0), 0.0), (0.3, -math.tan(math.radians(80.0)))):  # set; 143 degrees off the lobe
            sun = make_source("disk", theta=theta, phi=0.0, half_angle=0.05, radiance=1.0)
            got = gonio.reflectance_map(lobe, sun, p, 0.0)
            assert float(got.value) == 0.0 and float(got.error) <= 1e-250
