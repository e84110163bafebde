"""One posterior by four methods: importance sampling, emcee, a dense grid made from plain NumPy, and dynesty.

Rationale: each has its own way to be wrong. On the grid the two linear coefficients are Gaussian given roughness and scale,
so their distribution functions are sums of normal ones; nothing of `fitting` is used for it. Expected: the grid's
distribution function at a method's quantile is the quantile's level within 4 of its Monte Carlo standard errors.
"""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
from scipy import stats

from fitting import Rule, fit
from fitting.likelihood import Problem
from gonio import brdf
from gonio.samples import BRDFSamples, SharedError
from tests.gates import record
from tests.unit.test_fitting_likelihood import f_r_reference

LEVELS = np.array([0.025, 0.16, 0.5, 0.84, 0.975])
NAMES = ("lambertian.albedo", "ggx.alpha", "ggx.f_0", "shared.scale")
U_SCALE = 0.01


@functools.cache
def measured():
    """60 samples of a glossy paint with a shared error of scale."""
    rng = np.random.default_rng(12)
    n = 60
    theta_i = rng.uniform(0.0, 1.2, n)
    theta_r = np.clip(theta_i + rng.normal(0.0, 0.3, n), 0.0, 1.3)
    phi = math.pi + rng.normal(0.0, 0.4, n)
    plain = BRDFSamples.plain(theta_i, 0.0, theta_r, phi, np.ones(n), np.ones(n))
    f = f_r_reference(plain.omega_i(), plain.omega_r(), 0.4, 1.0, 0.3, 0.3)
    u = 0.05 * f + 0.002
    reading = f * math.exp(rng.normal(0.0, U_SCALE)) + rng.normal(0.0, u)
    zero = np.zeros((n, 3, 1))
    return BRDFSamples(
        plain.theta_i, plain.phi_i, plain.theta_r, plain.phi_r, reading, u, plain.pose, (SharedError("scale", U_SCALE),),
        zero, zero, np.ones((n, 1)),
    )  # fmt: skip


@functools.cache
def grid():
    """ln alpha and delta on a grid: nodes, weights (sum 1), means (..., 2) and covariances (..., 2, 2) of albedo and f_0."""
    s = measured()
    ln_alpha, delta = np.linspace(math.log(0.2), math.log(0.45), 121), np.linspace(-5 * U_SCALE, 5 * U_SCALE, 51)
    mean, covariance = np.empty((121, 51, 2)), np.empty((121, 51, 2, 2))
    log_weight = np.empty((121, 51))
    for i, l in enumerate(ln_alpha):
        white, mirror, rest = (
            f_r_reference(s.omega_i(), s.omega_r(), *numbers, math.exp(l), f_0)
            for *numbers, f_0 in ((1, 0, 0), (0, 1, 1), (0, 1, 0))
        )
        for j, d in enumerate(delta):
            b = np.column_stack((white, mirror - rest)) * math.exp(d) / s.u_f_r[:, None]
            y = (s.f_r - rest * math.exp(d)) / s.u_f_r
            normal = b.T @ b
            c = np.linalg.solve(normal, b.T @ y)
            mean[i, j], covariance[i, j] = c, np.linalg.inv(normal)
            chi2 = np.sum((y - b @ c) ** 2)
            prior = stats.norm.logpdf(l, math.log(0.2), 0.9) + stats.norm.logpdf(d, 0.0, U_SCALE)
            log_weight[i, j] = -0.5 * chi2 - 0.5 * np.linalg.slogdet(normal)[1] + prior
    weight = np.exp(log_weight - log_weight.max())
    return ln_alpha, delta, weight / weight.sum(), mean, covariance


def probability(name, x):
    """The grid's distribution function of a parameter at x."""
    ln_alpha, delta, weight, mean, covariance = grid()
    if name in ("lambertian.albedo", "ggx.f_0"):
        k = int(name == "ggx.f_0")
        return float(np.sum(weight * stats.norm.cdf(x, mean[..., k], np.sqrt(covariance[..., k, k]))))
    nodes, share = (ln_alpha, weight.sum(axis=1)) if name == "ggx.alpha" else (delta, weight.sum(axis=0))
    # the integral up to half a step beyond each node
    edges = nodes + 0.5 * (nodes[1] - nodes[0])
    return float(np.interp(math.log(x) if name == "ggx.alpha" else x, edges, np.cumsum(share)))


def worst_of(draws, ess):
    """Largest distance of a quantile's level from the grid's, in Monte Carlo standard errors: draws (n, 4), ess (4,)."""
    apart = []
    for k, name in enumerate(NAMES):
        got = np.array([probability(name, x) for x in np.quantile(draws[:, k], LEVELS)])
        apart.append(np.max(np.abs(got - LEVELS) / np.sqrt(LEVELS * (1 - LEVELS) / ess[k])))
    return float(max(apart))


@pytest.mark.parametrize("chain", [False, True], ids=["importance", "emcee"])
def test_quantiles_are_those_of_the_grid(chain):
    posterior = fit(measured(), seed=3, chain=chain, rule=Rule(effective=8000))
    assert posterior.names == NAMES
    assert posterior.diagnostics["method"] == ("emcee" if chain else "importance sampling")
    assert posterior.diagnostics["marginalised"] == ["lambertian.albedo", "ggx.f_0"]
    assert worst_of(posterior.flat(), list(posterior.diagnostics["ess"].values())) < 4.0


def test_with_nothing_integrated_out_the_quantiles_are_the_same():
    """Student's t with 10^6 degrees of freedom is Gauss, and forbids it."""
    posterior = fit(measured(), seed=3, student=1e6)
    assert posterior.diagnostics["marginalised"] == []
    assert worst_of(posterior.flat(), list(posterior.diagnostics["ess"].values())) < 4.0


@pytest.mark.gate
def test_quantiles_of_dynesty():
    """Nested sampling of the same likelihood, priors by their own inverse distribution functions."""
    dynesty = pytest.importorskip("dynesty")
    problem = Problem(measured(), brdf.parse("lambertian+ggx"))
    ends = stats.norm.cdf(np.log([1e-4, 1.0]), math.log(0.2), 0.9)

    def natural(cube):
        alpha = math.exp(stats.norm.ppf(ends[0] + cube[1] * (ends[1] - ends[0]), math.log(0.2), 0.9))
        return np.array([cube[0], alpha, cube[2], U_SCALE * stats.norm.ppf(cube[3])])

    sampler = dynesty.NestedSampler(
        lambda x: float(problem.log_likelihood(x[None])[0][0]), natural, 4, nlive=800, rstate=np.random.default_rng(1)
    )
    sampler.run_nested(print_progress=False)
    result = sampler.results
    weight = np.exp(result.logwt - result.logz[-1])
    ess = float(weight.sum() ** 2 / np.sum(weight**2))
    draws = result.samples_equal(rstate=np.random.default_rng(2))
    walk, quick = (fit(measured(), seed=3, chain=chain) for chain in (True, False))
    figures = {
        "importance sampling": worst_of(quick.flat(), list(quick.diagnostics["ess"].values())),
        "emcee": worst_of(walk.flat(), list(walk.diagnostics["ess"].values())),
        "dynesty": worst_of(draws, np.full(4, ess)),
    }
    record(
        "one posterior by four methods: quantiles of 4 parameters against a dense grid",
        ", ".join(f"{name} {value:.1f}" for name, value in figures.items()),
        "largest distance at most 4 Monte Carlo standard errors",
        "1, 2, 3",
        "pytest -m gate tests/unit/test_fitting_agreement.py",
    )
    assert max(figures.values()) < 4.0
