"""The compiled likelihood against plain NumPy written from the formulas."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from fitting.likelihood import BLOCK, Problem
from gonio import brdf
from gonio.errors import DatasetError, ParameterError
from gonio.samples import BRDFSamples, SharedError

MODEL = brdf.parse("lambertian+ggx")


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def f_r_reference(wi, wr, albedo, k_s, alpha, f_0):
    """Lambert + GGX by angles and half vector: Walter et al. 2007 eq. 33, Heitz 2014 eqs. 72 and 99, Schlick 1994."""
    h = unit(wi + wr)
    tan2_h = 1.0 / h[..., 2] ** 2 - 1.0
    d = 1.0 / (np.pi * alpha**2 * h[..., 2] ** 4 * (1.0 + tan2_h / alpha**2) ** 2)

    def big_lambda(w):
        return 0.5 * (-1.0 + np.sqrt(1.0 + alpha**2 * (1.0 / w[..., 2] ** 2 - 1.0)))

    g = 1.0 / (1.0 + big_lambda(wi) + big_lambda(wr))
    fresnel = f_0 + (1.0 - f_0) * (1.0 - np.sum(wi * h, axis=-1)) ** 5
    return albedo / np.pi + k_s * fresnel * d * g / (4.0 * wi[..., 2] * wr[..., 2])


def random_samples(rng, n, k=3):
    theta = rng.uniform(0.0, 1.3, (2, n))
    phi = rng.uniform(0.0, 2 * np.pi, (2, n))
    plain = BRDFSamples.plain(theta[0], phi[0], theta[1], phi[1], rng.uniform(0.1, 1.0, n), rng.uniform(0.01, 0.1, n))
    shared = tuple(SharedError(f"e{i}", 0.01, [0.004, 0.0, 0.002][i]) for i in range(k))
    d = rng.standard_normal((2, n, 3, k))
    d[..., 2] = 0.0  # the last one turns nothing
    return replace(plain, shared=shared, d_omega_i=d[0], d_omega_r=d[1], d_ln_f=rng.standard_normal((n, k)))


def expectation(s, albedo, k_s, alpha, f_0, delta):
    """The definition in gonio.samples, word for word."""
    wi, wr = unit(s.omega_i() + s.d_omega_i @ delta), unit(s.omega_r() + s.d_omega_r @ delta)
    return f_r_reference(wi, wr, albedo, k_s, alpha, f_0) * np.exp(s.d_ln_f @ delta)


@pytest.mark.parametrize("n", [1, 40, BLOCK + 7])
def test_expected_readings_variances_and_likelihood(n):
    s = random_samples(np.random.default_rng(n), n)
    u = s.u_f_r.copy()
    u[:: 3] = np.nan
    s = replace(s, u_f_r=u)
    problem = Problem(s, MODEL, free=["ggx.k_s"], discrepancy=True)
    rng = np.random.default_rng(2)
    x = problem.space.draw(rng, 5)
    x[:, problem.space.names.index("ggx.alpha")] = rng.uniform(0.1, 0.9, 5)
    mean, var = problem.predict(x)
    log_likelihood, chi2 = problem.log_likelihood(x)
    for row, m, v, ll, c in zip(x, mean, var, log_likelihood, chi2, strict=True):
        p = dict(zip(problem.space.names, row, strict=True))
        args = [p[name] for name in ("lambertian.albedo", "ggx.k_s", "ggx.alpha", "ggx.f_0")]
        delta = np.array([p["shared.e0"], p["shared.e1"], p["shared.e2"]])
        expected = expectation(s, *args, delta)
        assert m == pytest.approx(expected, rel=1e-12)
        s2 = np.where(np.isnan(u), (p["noise.relative"] * expected) ** 2 + p["noise.absolute"] ** 2, np.nan_to_num(u) ** 2)
        s2 += (p["noise.discrepancy"] * expected) ** 2
        for k, error in enumerate(s.shared):
            h = np.eye(3)[k] * 1e-5
            slope = (expectation(s, *args, delta + h) - expectation(s, *args, delta - h)) / 2e-5
            s2 += (slope * error.u_sample) ** 2
        assert v == pytest.approx(s2, rel=3e-4)
        assert c == pytest.approx(np.sum((s.f_r - m) ** 2 / v), rel=1e-12)
        assert ll == pytest.approx(-0.5 * np.sum((s.f_r - m) ** 2 / v + np.log(v)), rel=1e-12, abs=1e-9)


def test_held_shared_errors_do_not_turn_anything():
    s = random_samples(np.random.default_rng(3), 30)
    held = Problem(s, MODEL, shared=False)
    assert held.space.names == ("lambertian.albedo", "ggx.alpha", "ggx.f_0")
    x = np.array([[0.3, 0.2, 0.05], [0.1, 0.4, 0.5]])
    for row, mean in zip(x, held.predict(x)[0], strict=True):
        assert mean == pytest.approx(f_r_reference(s.omega_i(), s.omega_r(), row[0], 1.0, row[1], row[2]), rel=1e-12)
    fixed = Problem(s, MODEL, fix={"shared.e0": 0.01, "shared.e1": 0.0, "shared.e2": -0.02})
    expected = expectation(s, 0.3, 1.0, 0.2, 0.05, np.array([0.01, 0.0, -0.02]))
    assert fixed.predict(x[:1])[0][0] == pytest.approx(expected, rel=1e-12)


def test_one_walker_or_many_give_the_same_numbers():
    problem = Problem(random_samples(np.random.default_rng(3), 60), MODEL)
    u = np.random.default_rng(4).standard_normal((16, len(problem.space)))
    together = problem.log_probability(u)
    assert np.array_equal(together, [problem.log_probability(row[None])[0] for row in u])


def test_a_direction_pushed_below_the_horizon_stays_finite():
    s = BRDFSamples.plain([math.radians(89.99)], [0.0], [0.3], [3.0], [0.3], [0.01])
    d = np.zeros((1, 3, 1))
    d[0, 2, 0] = -1.0
    s = replace(s, shared=(SharedError("arm", 0.01, 0.001, "rad"),), d_omega_i=d, d_omega_r=d * 0, d_ln_f=np.zeros((1, 1)))
    problem = Problem(s, MODEL)
    u = np.random.default_rng(1).standard_normal((50, len(problem.space))) * 3
    assert np.all(np.isfinite(problem.log_probability(u)))


def test_the_density_is_never_nan():
    problem = Problem(random_samples(np.random.default_rng(3), 20), MODEL)
    u = np.random.default_rng(4).standard_normal((200, len(problem.space))) * 30
    assert not np.any(np.isnan(problem.log_probability(u)))


def test_what_cannot_be_fitted_is_one_sentence():
    s = random_samples(np.random.default_rng(3), 4)
    with pytest.raises(DatasetError, match="no samples"):
        Problem(s.select(np.array([], dtype=np.int64)), MODEL)
    with pytest.raises(DatasetError, match="sample 2 has u_f_r = 0"):
        Problem(replace(s, u_f_r=np.array([0.1, 0.1, 0.0, 0.1])), MODEL)
    with pytest.raises(DatasetError, match="sample 1 has f_r = 1e\\+200"):
        Problem(replace(s, f_r=np.array([0.1, 1e200, 0.1, 0.1])), MODEL)
    with pytest.raises(DatasetError, match="2 shared errors are called 'e0'"):
        Problem(replace(s, shared=(s.shared[0], s.shared[0], s.shared[2])), MODEL)
    with pytest.raises(ParameterError, match="every parameter of the model is fixed"):
        Problem(s, brdf.parse("lambertian"), fix={"lambertian.albedo": 0.5})
    with pytest.raises(DatasetError, match="f_r holds a value that is not finite"):
        BRDFSamples.plain([0.1], [0.0], [0.1], [0.0], [np.nan])
