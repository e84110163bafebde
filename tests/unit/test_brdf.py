"""BRDF models against 40-digit evaluations of the primary formulas, and the rules that sums keep."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest

import gonio
from gonio.errors import GeometryError, ParameterError
from gonio.geometry import unit_vector


def ggx_reference(theta_i: float, phi_i: float, theta_r: float, phi_r: float, k_s: float, alpha: float, f_0: float) -> float:
    """Walter et al. 2007 eq. 33, Heitz 2014 eqs. 72 and 99, Schlick 1994, in angles of a normalised half vector."""
    with mpmath.workdps(40):
        ti, pi, tr, pr = (mpmath.mpf(a) for a in (theta_i, phi_i, theta_r, phi_r))
        a = mpmath.mpf(alpha)
        vi = [mpmath.sin(ti) * mpmath.cos(pi), mpmath.sin(ti) * mpmath.sin(pi), mpmath.cos(ti)]
        vr = [mpmath.sin(tr) * mpmath.cos(pr), mpmath.sin(tr) * mpmath.sin(pr), mpmath.cos(tr)]
        h = [x + y for x, y in zip(vi, vr, strict=True)]
        norm = mpmath.sqrt(sum(x * x for x in h))
        h = [x / norm for x in h]
        tan2 = (h[0] ** 2 + h[1] ** 2) / h[2] ** 2
        d = a**2 / (mpmath.pi * h[2] ** 4 * (a**2 + tan2) ** 2)
        lambda_i = (mpmath.sqrt(1 + a**2 * mpmath.tan(ti) ** 2) - 1) / 2
        lambda_r = (mpmath.sqrt(1 + a**2 * mpmath.tan(tr) ** 2) - 1) / 2
        g = 1 / (1 + lambda_i + lambda_r)
        cos_d = sum(x * y for x, y in zip(h, vr, strict=True))
        fresnel = f_0 + (1 - mpmath.mpf(f_0)) * (1 - cos_d) ** 5
        return float(k_s * fresnel * d * g / (4 * mpmath.cos(ti) * mpmath.cos(tr)))


_ANGLES = [0.0, 1e-8, 0.3, 1.0, math.radians(89.99)]


@pytest.mark.parametrize("alpha", [1.0, 0.3, 0.01, 1e-4])
@pytest.mark.parametrize("f_0", [0.0, 0.04, 1.0])
def test_ggx_at_forty_digits(alpha: float, f_0: float) -> None:
    brdf = gonio.brdf.make("ggx", k_s=0.7, alpha=alpha, f_0=f_0)
    for theta_i in _ANGLES:
        for theta_r in (*_ANGLES, theta_i + 1e-8 if theta_i < 1.5 else theta_i - 1e-8):
            for phi_r in (0.0, 0.7, math.pi, math.pi + 1e-8):
                truth = ggx_reference(theta_i, 0.0, theta_r, phi_r, 0.7, alpha, f_0)
                # at alpha = 1e-4 the rounding of the angles themselves is worth 1e-12
                tolerance = 1e-12 if alpha > 1e-3 else 1e-9
                assert float(brdf.f_r(theta_i, 0.0, theta_r, phi_r)) == pytest.approx(truth, rel=tolerance, abs=1e-20)


def test_reciprocity() -> None:
    rng = np.random.default_rng(4)
    wi = unit_vector(np.arccos(rng.uniform(0, 1, 2000)), rng.uniform(0, 7, 2000))
    wr = unit_vector(np.arccos(rng.uniform(0, 1, 2000)), rng.uniform(0, 7, 2000))
    for alpha in (1.0, 0.1, 1e-4):
        brdf = gonio.brdf.make("lambertian", albedo=0.3) + gonio.brdf.make("ggx", k_s=0.9, alpha=alpha, f_0=0.05)
        forward, backward = brdf.evaluate(wi, wr), brdf.evaluate(wr, wi)
        assert np.abs(forward / backward - 1).max() < 1e-13
        assert np.all(forward > 0)


def test_below_the_horizon_is_zero_and_never_nan() -> None:
    brdf = gonio.brdf.make("lambertian", albedo=0.3) + gonio.brdf.make("ggx", k_s=1.0, alpha=0.2, f_0=0.05)
    theta = np.array([0.0, 1.0, math.pi / 2 + 1e-12, 2.0, math.pi])
    value = brdf.f_r(theta[:, None], 0.0, theta[None, :], 1.0)
    below = (theta[:, None] > math.pi / 2) | (theta[None, :] > math.pi / 2)
    assert np.all(value[below] == 0.0) and np.all(value[~below] > 0.0)


def test_sums_scales_and_names() -> None:
    paper = gonio.brdf.make("lambertian", albedo=0.4)
    gloss = gonio.brdf.make("ggx", k_s=1.0, alpha=0.3, f_0=0.04)
    both = paper + 0.5 * gloss + gloss
    at = (0.3, 0.1, 0.8, 2.0)
    assert float(both.f_r(*at)) == pytest.approx(float(paper.f_r(*at)) + 1.5 * float(gloss.f_r(*at)), rel=1e-15)
    assert list(both.parameters()) == [
        "lambertian.albedo", "ggx.k_s", "ggx.alpha", "ggx.f_0", "ggx2.k_s", "ggx2.alpha", "ggx2.f_0",
    ]  # fmt: skip
    assert [m.name for m in gonio.brdf.parse("lambertian + ggx")] == ["lambertian", "ggx"]
    assert sum([paper, gloss]).terms == (paper + gloss).terms
    assert paper.f_r(np.zeros((3, 1)), 0.0, np.zeros(4), 0.0).shape == (3, 4)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: gonio.brdf.make("lambertien", albedo=0.5), "did you mean 'lambertian'"),
        (lambda: gonio.brdf.make("ggx", k_s=1, alfa=0.1, f_0=0), "did you mean 'alpha'"),
        (lambda: gonio.brdf.make("ggx", k_s=1, alpha=0.1), "f_0"),
        (lambda: gonio.brdf.make("lambertian", albedo=1.5), r"1\.5 is outside \[0, 1\]"),
        (lambda: gonio.brdf.make("lambertian", albedo=math.nan), "nan is outside"),
        (lambda: -1.0 * gonio.brdf.make("lambertian", albedo=0.5), "cannot be scaled"),
        (lambda: gonio.brdf.make("specular", rho=1.0).f_r(0.1, 0.0, 0.1, math.pi), "delta function"),
    ],
)
def test_bad_parameters_are_told(call: object, words: str) -> None:
    with pytest.raises(ParameterError, match=words):
        call()  # type: ignore[operator]


def test_bad_angles_are_told() -> None:
    with pytest.raises(GeometryError, match="theta_i"):
        gonio.brdf.make("lambertian", albedo=0.5).f_r(-0.1, 0.0, 0.1, 0.0)
