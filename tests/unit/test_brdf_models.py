"""Phong, Oren-Nayar and a user's functions: values at 40 digits, limits, what they declare, what is refused."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest

import gonio
from gonio import jit
from gonio.errors import ParameterError
from gonio.geometry import unit_vector
from tests.registered import compiled, typical

make = gonio.brdf.make
_THETAS = [0.0, 1e-8, 0.3, 1.0, math.radians(89.99)]
_PHIS = [0.0, 0.7, math.pi / 2, 2.5, math.pi, math.pi + 1e-8, 3 * math.pi / 2]


def _geometries() -> list[tuple[float, float, float]]:
    return [(ti, tr, phi) for ti in _THETAS for tr in (*_THETAS, ti + 1e-8 if ti < 1.5 else ti - 1e-8) for phi in _PHIS]


def phong_reference(ti: float, tr: float, dphi: float, k_s: float, n: float) -> float:
    """Lafortune & Willems 1994, in angles: m.w = cos theta_i cos theta_r - sin theta_i sin theta_r cos dphi."""
    with mpmath.workdps(40):
        a, b, f = mpmath.mpf(ti), mpmath.mpf(tr), mpmath.mpf(dphi)
        along = mpmath.cos(a) * mpmath.cos(b) - mpmath.sin(a) * mpmath.sin(b) * mpmath.cos(f)
        return float(k_s * (mpmath.mpf(n) + 2) / (2 * mpmath.pi) * along ** mpmath.mpf(n)) if along > 0 else 0.0


@pytest.mark.parametrize("n", [0.0, 1.0, 2.5, 50.0, 1e4, 1e8])
def test_phong_at_forty_digits(n: float) -> None:
    brdf = make("phong", k_s=0.7, n=n)
    for ti, tr, dphi in _geometries():
        truth = phong_reference(ti, tr, dphi, 0.7, n)
        # off the peak one rounding of m.w counts n times; far off a sharp peak both are 0
        assert float(brdf.f_r(ti, 0.0, tr, dphi)) == pytest.approx(truth, rel=1e-13 + 1e-15 * min(n, 1e4), abs=1e-12)


def test_phong_peak_keeps_its_digits_next_to_the_mirror_direction() -> None:
    for n in (1e6, 1e8):
        for off in (0.0, 0.3, 1.0):
            tr = 0.7 + off / math.sqrt(n)
            got = float(make("phong", k_s=1.0, n=n).f_r(0.7, 0.0, tr, math.pi))
            assert got == pytest.approx(phong_reference(0.7, tr, math.pi, 1.0, n), rel=1e-11)


def oren_nayar_reference(ti: float, tr: float, dphi: float, albedo: float, sigma: float) -> float:
    """Oren & Nayar 1994, the qualitative model in its printed form, with alpha and beta and their tangent."""
    with mpmath.workdps(40):
        s2 = mpmath.mpf(sigma) ** 2
        a, b = 1 - s2 / (2 * (s2 + mpmath.mpf("0.33"))), mpmath.mpf("0.45") * s2 / (s2 + mpmath.mpf("0.09"))
        alpha, beta = mpmath.mpf(max(ti, tr)), mpmath.mpf(min(ti, tr))
        shape = max(mpmath.mpf(0), mpmath.cos(dphi)) * mpmath.sin(alpha) * mpmath.tan(beta)
        return float(albedo / mpmath.pi * (a + b * shape))


@pytest.mark.parametrize("sigma", [0.0, 1e-6, math.radians(20), 0.9, math.pi / 2])
def test_oren_nayar_at_forty_digits(sigma: float) -> None:
    brdf = make("oren_nayar", albedo=0.8, sigma=sigma)
    for ti, tr, dphi in _geometries():
        truth = oren_nayar_reference(ti, tr, dphi, 0.8, sigma)
        # next to the horizon 1 ulp of the angle is 1e-12 of its cosine
        near = 1e-14 if min(ti, tr) < 1.5 else 1e-11
        assert float(brdf.f_r(ti, 0.0, tr, dphi)) == pytest.approx(truth, rel=near)


def test_oren_nayar_limits() -> None:
    """sigma = 0 is Lambert; retro-reflection exceeds the mirror side; at normal viewing nothing depends on azimuth."""
    at = (np.array([0.2, 1.0, 1.5]), 0.4, 0.9, np.array([0.1, 2.0, 3.5]))
    lambert = make("lambertian", albedo=0.6).f_r(*at)
    assert make("oren_nayar", albedo=0.6, sigma=0.0).f_r(*at) == pytest.approx(lambert, rel=1e-15)
    rough = make("oren_nayar", albedo=0.6, sigma=0.5, variant="qualitative")
    assert float(rough.f_r(0.8, 0.0, 0.8, 0.0)) > 1.3 * float(rough.f_r(0.8, 0.0, 0.8, math.pi))
    assert np.ptp(rough.f_r(0.8, np.linspace(0, 6, 9), 0.0, 0.0)) == 0.0


@pytest.mark.parametrize(
    "brdf", [make("phong", k_s=0.9, n=0.0), make("phong", k_s=0.9, n=7.0), make("phong", k_s=0.9, n=1e6),
             make("oren_nayar", albedo=0.9, sigma=0.4)], ids=repr,
)  # fmt: skip
def test_reciprocal_and_zero_below_the_horizon(brdf: gonio.BRDF) -> None:
    rng = np.random.default_rng(2)
    wi = unit_vector(np.arccos(rng.uniform(-1, 1, 4000)), rng.uniform(0, 7, 4000))
    wr = unit_vector(np.arccos(rng.uniform(-1, 1, 4000)), rng.uniform(0, 7, 4000))
    forward, backward = brdf.evaluate(wi, wr), brdf.evaluate(wr, wi)
    assert np.all(np.isfinite(forward)) and np.all(forward >= 0)
    assert forward == pytest.approx(backward, rel=1e-13, abs=1e-300)
    assert np.all(forward[(wi[:, 2] <= 0) | (wr[:, 2] <= 0)] == 0)


def test_a_direction_that_is_nan_gives_nan() -> None:
    up = np.array([0.0, 0.0, 1.0])
    lambert, ggx = make("lambertian", albedo=0.5), make("ggx", k_s=1.0, alpha=0.1, f_0=1.0)
    python = gonio.brdf.from_function(lambda omega_i, omega_r: np.full(len(omega_i), 0.1))
    for brdf in (lambert, lambert + ggx, python):
        for at in range(3):
            bad = up.copy()
            bad[at] = np.nan
            assert np.all(np.isnan([brdf.evaluate(bad, up), brdf.evaluate(up, bad)]))
        assert brdf.evaluate(up, up) > 0.0 == brdf.evaluate(-up, up)


def test_kinks_are_declared_where_the_slope_jumps() -> None:
    """On each side of a declared plane the derivative across it differs; away from the planes it does not."""
    wr = unit_vector(0.8, 0.3)
    for brdf, count in ((make("oren_nayar", albedo=1.0, sigma=0.5), 2), (make("phong", k_s=1.0, n=1.0), 1)):
        planes = brdf.terms[0].kinks(wr)
        assert planes.shape == (count, 4)
        assert np.linalg.norm(planes[:, :3], axis=1) == pytest.approx(np.ones(count), rel=1e-15)
        for c in planes:
            # a point of the plane above the horizon, on the viewer's side where Oren-Nayar has its second term
            across = np.cross(c[:3], [0.0, 0.0, 1.0]) if abs(c[2]) < 0.9 else np.array([math.cos(0.3), math.sin(0.3), 0.0])
            on = c[3] * c[:3] + math.sqrt(1 - c[3] ** 2) * (across / np.linalg.norm(across) * 0.6 + np.array([0, 0, 0.8]))
            if abs(c[2]) > 0.9:
                on = c[3] * c[:3] + math.sqrt(1 - c[3] ** 2) * across
            elif abs(c[2]) > 1e-9:
                up = np.cross(across / np.linalg.norm(across), c[:3])
                on = 0.6 * across / np.linalg.norm(across) + 0.8 * up * math.copysign(1.0, up[2])
            slopes = []
            for h in (-1e-6, 1e-6):
                near, far = (on + f * h * c[:3] for f in (1.0, 2.0))
                value = [float(brdf.evaluate(w / np.linalg.norm(w), wr)) for w in (near, far)]
                slopes.append((value[1] - value[0]) / h)
            assert abs(slopes[1] - slopes[0]) > 0.01
    sharp = make("phong", k_s=1.0, n=100.0).terms[0]  # next to its cut f_r is nothing
    assert len(sharp.kinks(wr)) == 0 and len(sharp.edges(wr)) == 1
    assert len(make("ggx", k_s=1.0, alpha=0.1, f_0=1.0).terms[0].kinks(wr)) == 0


def test_kinks_of_many_directions_are_those_of_each() -> None:
    wr = unit_vector(np.array([[0.0, 0.8, 1.5], [0.4, 1.0, 1.2]]), 0.3)
    kinked = 0
    for model in compiled():
        if model.kinks is None:
            continue
        kinked += 1
        planes = model.kinks(typical(model), wr)
        assert planes.shape == (2, 3, planes.shape[2], 4)
        for at in np.ndindex(2, 3):
            assert np.array_equal(planes[at], model.kinks(typical(model), wr[at])), model.expression
        assert np.linalg.norm(planes[..., :3], axis=-1) == pytest.approx(np.ones(planes.shape[:-1]), rel=1e-15)
    assert kinked >= 5


# --- functions ------------------------------------------------------------------------------------------------------------


def retro(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float) -> float:
    return 0.3 * (1.0 + xi * xr + yi * yr + zi * zr) / math.pi


def test_a_function_of_arrays_and_a_compiled_one_agree() -> None:
    rng = np.random.default_rng(3)
    wi = unit_vector(np.arccos(rng.uniform(-1, 1, 300)), rng.uniform(0, 7, 300))
    wr = unit_vector(np.arccos(rng.uniform(-1, 1, 300)), rng.uniform(0, 7, 300))
    lit = (wi[:, 2] > 0) & (wr[:, 2] > 0)
    truth = np.where(lit, 0.3 * (1 + np.sum(wi * wr, axis=1)) / math.pi, 0.0)
    table = {"scale": 0.3}  # a dict is beyond numba: this one is called from Python

    def scalar_in_python(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float) -> float:
        return table["scale"] * (1.0 + xi * xr + yi * yr + zi * zr) / math.pi

    made = {
        "compiled": gonio.brdf.from_function(retro, reciprocal=True),
        "already compiled": gonio.brdf.from_function(jit.model(retro)),
        "python": gonio.brdf.from_function(scalar_in_python),
        "arrays": gonio.brdf.from_function(lambda wi, wr: 0.3 * (1 + np.sum(wi * wr, axis=-1)) / math.pi, name="mine"),
    }
    for how, brdf in made.items():
        assert brdf.evaluate(wi, wr) == pytest.approx(truth, rel=1e-14, abs=1e-300), how
        assert (brdf.terms[0].model.array_function is None) == ("compiled" in how)
        assert brdf.terms[0].model.own and not brdf.terms[0].model.delta
    both = 2.0 * made["arrays"] + make("lambertian", albedo=0.5)
    assert both.evaluate(wi, wr) == pytest.approx(2 * truth + 0.5 / math.pi * lit, rel=1e-14, abs=1e-300)
    assert repr(both) == "2 * mine() + lambertian(albedo=0.5)"


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: gonio.brdf.from_function(lambda a, b, c: a), "takes 3 arguments"),
        (lambda: gonio.brdf.from_function(lambda wi, wr: np.full(len(wi), np.nan)), "finite and never negative"),
        (lambda: gonio.brdf.from_function(lambda wi, wr: wi[:, 0]), "finite and never negative"),
        (lambda: gonio.brdf.from_function(lambda wi, wr: wi), r"return \("),
        (lambda: gonio.brdf.from_function(lambda a, b, c, d, e, f: -1.0, name="dark"), "dark: f_r = -1"),
        (lambda: gonio.brdf.from_function(retro, lobe_width=0.0), "lobe_width"),
        (lambda: make("phong", k_s=1.0, n=-1.0), "outside"),
        (lambda: make("phong", k_s=1.0, n=math.inf), "outside"),
        (lambda: make("oren_nayar", albedo=0.5), "sigma"),
        (lambda: make("oren_nayar", albedo=0.5, sigma=0.3, variant="qualitatif"), "did you mean 'qualitative'"),
        (lambda: make("ggx", k_s=1, alpha=0.1, f_0=0, variant="x"), "leave it out"),
    ],
)
def test_bad_models_are_told(call: object, words: str) -> None:
    with pytest.raises(ParameterError, match=words):
        call()  # type: ignore[operator]
