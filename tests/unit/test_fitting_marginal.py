"""What is integrated out, against integrals on grids made from plain NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from fitting import marginal, optimum
from fitting.likelihood import Problem
from fitting.linear import coefficients
from gonio import brdf
from gonio.samples import BRDFSamples
from tests.unit.test_fitting_likelihood import f_r_reference, random_samples

SETTINGS = {"free": ["ggx.k_s"], "fix": {"ggx.f_0": 0.5}}


def measured(n=12, noise=0.3):
    rng = np.random.default_rng(8)
    theta, phi = rng.uniform(0.0, 1.2, (2, n)), rng.uniform(0, 2 * np.pi, (2, n))
    s = BRDFSamples.plain(theta[0], phi[0], theta[1], phi[1], np.ones(n), np.ones(n))
    f = f_r_reference(s.omega_i(), s.omega_r(), 0.4, 0.6, 0.5, 0.5)
    return BRDFSamples.plain(theta[0], phi[0], theta[1], phi[1], f + noise * 0.1 * rng.standard_normal(n), 0.1 * noise)


def chi2_on_grid(s, alpha, albedo, k_s):
    """chi^2 for all pairs of coefficients, shape (len(albedo), len(k_s))."""
    base = [f_r_reference(s.omega_i(), s.omega_r(), *c, alpha, 0.5) for c in ((1.0, 0.0), (0.0, 1.0))]
    left = s.f_r - albedo[:, None, None] * base[0] - k_s[None, :, None] * base[1]
    return np.sum((left / s.u_f_r) ** 2, axis=-1)


def target_of(problem):
    mode = optimum.find(problem, np.random.default_rng(1))[0]
    return marginal.of(problem, mode, np.random.default_rng(2)), mode


def test_the_integral_over_two_coefficients_is_that_on_a_grid():
    s = measured()
    target, _ = target_of(Problem(s, brdf.parse("lambertian+ggx"), **SETTINGS))
    assert target.marginalised == ("lambertian.albedo", "ggx.k_s")
    alpha = np.array([0.35, 0.5, 0.7])
    u = target.space.unbounded(alpha[:, None])
    c = np.linspace(-6.0, 7.0, 801)  # flat in the range, so the extension is N(0.5, 2)
    ghost = ((c - 0.5) / marginal.REACH) ** 2
    expected = [
        np.log(np.sum(np.exp(-0.5 * (chi2_on_grid(s, a, c, c) + ghost[:, None] + ghost[None, :])))) for a in alpha
    ]
    got = target.log_probability(u) - target.space.natural(u)[1]
    assert np.diff(got) == pytest.approx(np.diff(expected), abs=1e-6)


def test_the_integral_over_a_scale_of_the_noise_as_well():
    s = measured(n=40, noise=0.5)
    problem = Problem(s, brdf.parse("lambertian+ggx"), free=["ggx.k_s", "noise.scale"], fix={"ggx.f_0": 0.5})
    target, mode = target_of(problem)
    assert target.marginalised == ("lambertian.albedo", "ggx.k_s", "noise.scale")
    scale_0 = problem.space.natural(mode.u[None])[0][0, problem.space.names.index("noise.scale")]
    alpha = np.array([0.4, 0.5, 0.6])
    u = target.space.unbounded(alpha[:, None])
    c, ln_s = np.linspace(-2.0, 3.0, 601), np.linspace(-2.0, 2.0, 201)
    ghost = ((c - 0.5) * scale_0 / marginal.REACH) ** 2
    expected = []
    for a in alpha:
        square = chi2_on_grid(s, a, c, c) + ghost[:, None] + ghost[None, :]
        expected.append(np.log(sum(np.sum(np.exp(-0.5 * square * np.exp(-2 * l) - len(s) * l)) for l in ln_s)))
    got = target.log_probability(u) - target.space.natural(u)[1]
    assert np.diff(got) == pytest.approx(np.diff(expected), abs=1e-5)


@pytest.mark.parametrize("free", [["ggx.k_s"], ["ggx.k_s", "noise.scale"]])
def test_draws_are_those_of_the_posterior(free):
    """Weighted draws for one alpha against the posterior cut to [0, 1] on a grid: means and sds within 4 Monte Carlo sd."""
    s = measured(n=40, noise=0.8)
    problem = Problem(s, brdf.parse("lambertian+ggx"), free=free, fix={"ggx.f_0": 0.5})
    target, _ = target_of(problem)
    n = 40_000
    u = np.repeat(target.space.unbounded(np.array([[0.5]])), n, axis=0)
    drawn = target.draw(u, np.random.default_rng(3))
    weight = np.exp(drawn.log_weight)
    assert 0.5 < np.mean(weight > 0) < 1.0  # the cut matters
    effective = weight.sum() ** 2 / np.sum(weight**2)
    c = (np.arange(400) + 0.5) / 400
    ln_s = np.linspace(-1.0, 1.0, 101) if "noise.scale" in free else np.zeros(1)
    square = chi2_on_grid(s, 0.5, c, c)
    density = sum(np.exp(-0.5 * square * np.exp(-2 * l) - len(s) * l) for l in ln_s)
    density /= density.sum()
    for k, share in enumerate((density.sum(axis=1), density.sum(axis=0))):
        x = drawn.x[:, k]
        mean = share @ c
        sd = np.sqrt(share @ (c - mean) ** 2)
        got = weight @ np.where(weight > 0, x, 0.0) / weight.sum()
        got_sd = np.sqrt(weight @ np.where(weight > 0, x - got, 0.0) ** 2 / weight.sum())
        assert got == pytest.approx(mean, abs=4 * sd / np.sqrt(effective) + 1e-4)
        assert got_sd == pytest.approx(sd, rel=4 / np.sqrt(effective) + 1e-3)


def test_densities_of_draws_are_those_of_the_whole_problem():
    s = measured(n=40)
    problem = Problem(s, brdf.parse("lambertian+ggx"), free=["ggx.k_s", "noise.scale"])
    target, mode = target_of(problem)
    left = [i for i, name in enumerate(problem.space.names) if name not in target.marginalised]
    drawn = target.draw(np.repeat(mode.u[None, left], 20, axis=0), np.random.default_rng(3))
    inside = np.isfinite(drawn.log_weight)
    x = drawn.x[inside]
    direct = problem.log_likelihood(x)[0] + problem.space.log_density(x)
    assert np.ptp(drawn.log_posterior[inside] - direct) < 1e-8  # a constant


def test_nothing_is_integrated_out_where_it_would_not_be_exact():
    s = random_samples(np.random.default_rng(3), 60)  # an angle's error in each sample: variances follow the slope
    assert target_of(Problem(s, brdf.parse("lambertian+ggx")))[0].marginalised == ()
    s = measured(n=40)
    assert target_of(Problem(s, brdf.parse("lambertian+ggx"), discrepancy=True))[0].marginalised == ()
    assert target_of(Problem(s, brdf.parse("lambertian+ggx"), student=4.0))[0].marginalised == ()
    negative = BRDFSamples.plain(s.theta_i, s.phi_i, s.theta_r, s.phi_r, -np.abs(s.f_r), s.u_f_r)  # all of it is cut off
    assert target_of(Problem(negative, brdf.parse("lambertian+ggx")))[0].marginalised == ()


def test_of_each_term_one_parameter_counts_as_linear():
    problem = Problem(measured(), brdf.parse("lambertian+ggx+phong"), free=["ggx.k_s"])
    assert [(c.name, c.factor) for c in coefficients(problem)] == [
        ("lambertian.albedo", True), ("ggx.k_s", True), ("phong.k_s", True)
    ]  # fmt: skip
    held = Problem(measured(), brdf.parse("lambertian+ggx"), fix={"lambertian.albedo": 0.2})
    assert [(c.name, c.factor) for c in coefficients(held)] == [("ggx.f_0", False)]
