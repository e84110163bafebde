"""Data that cannot tell much, or nothing: a defined result that says so, or one clear sentence."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from fitting import Rule, fit
from gonio.errors import ConvergenceError, DatasetError
from gonio.samples import BRDFSamples
from tests.unit.test_fitting_likelihood import f_r_reference
from tests.unit.test_fitting_recovery import scan


@pytest.mark.parametrize(
    "samples",
    [
        BRDFSamples.plain([0.3], [0.0], [0.5], [3.0], [0.2], [0.01]),
        BRDFSamples.plain([0.3, 0.3], 0.0, [0.5, 0.6], 3.0, [0.0, 0.0]),
        BRDFSamples.plain(np.full(9, 0.5), 0.0, np.linspace(0, 1.4, 9), 3.0, np.full(9, 0.3), 0.01),
        BRDFSamples.plain(np.full(9, 0.5), 0.0, 0.5, 3.0, np.full(9, 0.3)),
        BRDFSamples.plain(np.full(9, 0.5), 0.0, np.linspace(0, 1.4, 9), 3.0, np.full(9, -0.3), 0.01),
    ],
    ids=["one sample", "all zero, unknown noise", "one theta_i", "one geometry, no scatter", "negative"],
)
def test_degenerate_data_give_a_defined_result(samples):
    posterior = fit(samples, seed=1, rule=Rule(ensembles=2, taus=5, first=100, max_steps=300))
    assert np.all(np.isfinite(posterior.draws))
    values = posterior.flat()[:, :3]
    assert np.all((values >= 0) & (values <= 1))
    assert posterior.brdf().f_r(0.3, 0.0, 0.3, math.pi) >= 0
    assert posterior.diagnostics["advice"]


def test_rows_that_are_not_numbers_are_refused():
    with pytest.raises(DatasetError, match=r"f_r holds a value that is not finite; remove those rows first"):
        BRDFSamples.plain([0.3, 0.3], 0.0, [0.5, 0.6], 3.0, [0.2, math.nan], 0.01)
    with pytest.raises(DatasetError, match=r"theta_r holds a value that is not finite"):
        BRDFSamples.plain([0.3, 0.3], 0.0, [0.5, math.nan], 3.0, [0.2, 0.2], 0.01)


def test_every_row_twice_is_every_row_once_with_a_smaller_uncertainty():
    s = scan(5, 60).samples
    twice = s.select(np.repeat(np.arange(60), 2))
    one = fit(replace(s, u_f_r=s.u_f_r / math.sqrt(2)), seed=1, shared=False, discrepancy=False)
    two = fit(twice, seed=1, shared=False, discrepancy=False)
    for name, row in one.summary().items():
        assert two.summary()[name]["median"] == pytest.approx(row["median"], abs=0.1 * row["sd"]), name
        assert two.summary()[name]["sd"] == pytest.approx(row["sd"], rel=0.1), name


def test_a_lobe_that_no_sample_sees_is_said_to_be_unknown():
    """All samples are on the lamp's side, where a lobe of alpha = 0.02 is nothing: the albedo is known, of the lobe only
    that it is not so wide as to reach there. Expected: quantiles of draws of the prior, weighted by the likelihood, with the
    albedo, Gaussian given the rest, integrated out."""
    rng = np.random.default_rng(1)
    n, u = 60, 0.01
    theta_i, theta_r, phi = rng.uniform(0.4, 1.0, n), rng.uniform(0.4, 1.2, n), rng.uniform(-1.0, 1.0, n) % (2 * math.pi)
    plain = BRDFSamples.plain(theta_i, 0.0, theta_r, phi, np.ones(n), u)
    f = f_r_reference(plain.omega_i(), plain.omega_r(), 0.4, 1.0, 0.02, 0.05)
    s = replace(plain, f_r=f + rng.normal(0, u, n))
    posterior = fit(s, seed=1, rule=Rule(ensembles=2, taus=20, drift=0.3, max_steps=3000))
    alpha, f_0 = np.exp(rng.normal(math.log(0.2), 0.9, 100_000)), rng.uniform(0.0, 1.0, 100_000)
    total, square = np.zeros(100_000), np.zeros(100_000)
    for wi, wr, y in zip(s.omega_i(), s.omega_r(), s.f_r, strict=True):
        left = y - f_r_reference(wi, wr, 0.0, 1.0, alpha, f_0)
        total += left
        square += left**2
    middle, width = math.pi * total / n, math.pi * u / math.sqrt(n)
    inside = stats.norm.cdf((1.0 - middle) / width) - stats.norm.cdf(-middle / width)
    log_weight = -0.5 * (square - total**2 / n) / u**2
    weight = np.where(alpha <= 1.0, np.exp(log_weight - log_weight.max()) * inside, 0.0)
    effective = weight.sum() ** 2 / np.sum(weight**2)
    assert effective > 5000
    levels = np.array([0.025, 0.16, 0.5, 0.84, 0.975])
    for k, x in enumerate((middle + width * rng.standard_normal(len(middle)), alpha, f_0)):
        order = np.argsort(x)
        got = np.interp(np.quantile(posterior.flat()[:, k], levels), x[order], np.cumsum(weight[order]) / weight.sum())
        ess = 1.0 / (1.0 / effective + 1.0 / posterior.diagnostics["ess"][posterior.names[k]])
        assert np.all(np.abs(got - levels) < 4.0 * np.sqrt(levels * (1 - levels) / ess)), (posterior.names[k], got)
    assert "hardly constrain ggx.alpha" in " ".join(posterior.diagnostics["advice"])


def test_samples_that_no_parameter_explains_are_named():
    theta = np.linspace(0.0, 1.2, 5)
    f = np.array([0.2, 0.2, 1e99, 0.2, 0.2])
    with pytest.raises(ConvergenceError, match=r"lambertian\.albedo = .* sample 2 should read"):
        fit(BRDFSamples.plain(theta, 0.0, 0.3, 2.0, f, np.full(5, 1e-80)), "lambertian", seed=1)
