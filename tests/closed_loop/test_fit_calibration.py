"""Simulation-based calibration: parameters from the prior, a measurement of them, a fit; the truth's rank is uniform.

Rationale: if and only if a sampler draws from p(parameters | data), the rank of the true value among L draws is uniform over
many sets (Talts, Betancourt, Simpson, Vehtari & Gelman 2018, arXiv:1804.06788), for every parameter, shared errors included,
and for the likelihood of the data (Modrak et al. 2023, doi:10.1214/23-BA1404), which sees what single parameters do not.
Uncertainties follow a reference material and not the true one, as they must not tell the parameters.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from fitting import Rule, fit
from fitting.likelihood import Problem
from gonio import brdf
from tests.gates import record
from tests.measurements import U_ENCODER, material, measure

L = 99
BINS = 10
LEAST_P = 0.005
IMAGES = Path(__file__).parents[2] / "docs" / "images"
# the model, what is held, the encoder's error in each sample, the reference material of the uncertainties
CASES = {
    "lambertian": ("lambertian", {}, U_ENCODER, {"lambertian": {"albedo": 0.5}}),
    "lambertian+ggx": (
        "lambertian+ggx", {}, 0.0, {"lambertian": {"albedo": 0.5}, "ggx": {"k_s": 1.0, "alpha": 0.3, "f_0": 0.3}},
    ),
    "lambertian+ggx, encoder noise": (
        "lambertian+ggx", {}, U_ENCODER, {"lambertian": {"albedo": 0.5}, "ggx": {"k_s": 1.0, "alpha": 0.3, "f_0": 0.3}},
    ),
    "lambertian+ward": (
        "lambertian+ward", {}, 0.0, {"lambertian": {"albedo": 0.5}, "ward": {"k_s": 0.4, "alpha": 0.3}},
    ),
    "oren_nayar": ("oren_nayar", {}, U_ENCODER, {"oren_nayar": {"albedo": 0.5, "sigma": 0.4}}),
    "hapke": (
        "hapke", {"hapke.theta_bar": 0.0}, U_ENCODER,
        {"hapke": {"w": 0.6, "b": 0.3, "c": 0.3, "B_0": 0.0, "h": 0.05, "theta_bar": 0.0}},
    ),
}  # fmt: skip


def from_prior(rng, parameter):
    """One draw, by rejection where the range cuts the prior."""
    kind, a, b = parameter.prior
    while True:
        value = rng.uniform(a, b) if kind == "uniform" else math.exp(rng.normal(a, b))
        if parameter.lower <= value <= parameter.upper:
            return value


def simulated(case, seed, n=100):
    """A measurement of a material from the prior, and all true parameters that are free."""
    model, fix, u_encoder, reference = CASES[case]
    rng = np.random.default_rng([seed, list(CASES).index(case)])
    truth, parts = {}, []
    for one in brdf.parse(model):
        values = {}
        for p in one.parameters:
            name = f"{one.name}.{p.name}"
            held = fix.get(name, p.fixed)
            values[p.name] = held if held is not None else from_prior(rng, p)
            if held is None:
                truth[name] = values[p.name]
        parts.append(brdf.make(one.name, **values))
    usual = sum(brdf.make(name, **values) for name, values in reference.items())
    samples, errors = measure(
        rng, material(sum(parts)), n, lambda wi, wr: 0.02 * material(usual)(wi, wr) + 1e-3, u_encoder
    )
    return samples, truth | errors


def ranks(case, seed, understated=1.0):
    """Rank of the truth among L draws, for each parameter and for the likelihood; and how the draws were made."""
    model, fix, *_ = CASES[case]
    samples, truth = simulated(case, seed)
    samples = replace(samples, u_f_r=understated * samples.u_f_r)
    posterior = fit(
        samples, model, fix=fix, seed=seed, discrepancy=False, rule=Rule(effective=2000, drift=0.05, max_steps=4000)
    )
    draws = posterior.thin(L, np.random.default_rng(seed))
    true = np.array([truth[name] for name in posterior.names])
    problem = Problem(samples, brdf.parse(model), fix=fix)
    likely = problem.log_likelihood(np.vstack((draws, true)))[0]
    found = dict(zip(posterior.names, map(int, np.sum(draws < true, axis=0)), strict=True))
    found["likelihood"] = int(np.sum(likely[:-1] < likely[-1]))
    return found, posterior.diagnostics["method"] == "emcee", posterior.converged


def p_values(table):
    """chi^2 test of uniform ranks in `BINS` bins, for each column of a table (sets, quantities)."""
    return {
        name: float(stats.chisquare(np.bincount(np.array(column) * BINS // (L + 1), minlength=BINS)).pvalue)
        for name, column in table.items()
    }


def smallest_by_holm(p):
    """The least of the p values, times their number: Holm's first step, and the only one that decides whether any fails."""
    return len(p) * min(p.values())


def band(sets, coverage=0.95, trials=4000):
    """Half-width of a simultaneous band of the ranks' distribution function, in binomial sds at each rank; simulated."""
    rng = np.random.default_rng(0)
    counts = np.cumsum(np.array([np.bincount(r, minlength=L + 1) for r in rng.integers(0, L + 1, (trials, sets))]), axis=1)
    z = np.arange(1, L + 1) / (L + 1)
    sd = np.sqrt(sets * z * (1 - z))
    return float(np.quantile(np.max(np.abs(counts[:, :-1] - sets * z) / sd, axis=1), coverage))


def draw(case, table, path):
    """Distribution functions of the ranks minus that of uniform ones, with the simultaneous band of 95 %."""
    from matplotlib.figure import Figure

    sets = len(next(iter(table.values())))
    z = np.arange(1, L + 1) / (L + 1)
    half = band(sets) * np.sqrt(z * (1 - z) / sets)
    figure = Figure(figsize=(6.0, 3.2), layout="constrained")
    axes = figure.subplots()
    axes.fill_between(z, -half, half, color="0.88", label="95 %, all ranks at once")
    for name, column in table.items():
        share = np.cumsum(np.bincount(column, minlength=L + 1))[:-1] / sets
        axes.plot(z, share - z, lw=1, label=name)
    axes.set(xlabel="rank / (L + 1)", ylabel="share of sets minus uniform", title=f"{case}, {sets} sets")
    axes.legend(fontsize=6, ncols=2)
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path, dpi=80, metadata={"Software": None})


def run(case, sets, understated=1.0):
    table, walks, lost = {}, 0, 0
    for seed in range(sets):
        found, walked, converged = ranks(case, seed, understated)
        walks, lost = walks + walked, lost + (not converged)
        for name, rank in found.items():
            table.setdefault(name, []).append(rank)
    return table, walks, lost


@pytest.mark.parametrize("case", ["lambertian+ggx", "oren_nayar"])
def test_a_slice(case):
    """12 sets: ranks exist and are not all on one side. The proof is the gate's."""
    table, _, _ = run(case, 12)
    assert len(table) == len(simulated(case, 0)[1]) + 1
    for name, column in table.items():
        assert 0 < np.mean(column) < L, name
    print(p_values(table))


def test_the_test_sees_what_it_should():
    """Uniform ranks pass; ranks of an interval that is 0.7 times too narrow fail."""
    rng = np.random.default_rng(1)
    uniform = {"x": rng.integers(0, L + 1, 300)}
    narrow = {"x": np.floor(stats.norm.cdf(rng.normal(0, 1 / 0.7, 300)) * (L + 1)).astype(int)}
    assert smallest_by_holm(p_values(uniform)) > LEAST_P
    assert smallest_by_holm(p_values(narrow)) < LEAST_P
    assert 2.5 < band(300, trials=500) < 3.5


@pytest.mark.gate
@pytest.mark.parametrize("case", list(CASES))
def test_ranks_are_uniform(case):
    table, walks, lost = run(case, 300)
    p = p_values(table)
    draw(case, table, IMAGES / f"sbc_{list(CASES).index(case)}.png")
    worst = min(p, key=p.get)
    record(
        f"simulation-based calibration, {case}",
        f"least p {p[worst]:.3f} ({worst}) of {len(p)} quantities, times their number {smallest_by_holm(p):.3f}; "
        f"{walks} of 300 sets by emcee, {lost} not converged",
        "rank chi2 p > 0.005 for each, by Holm; L = 99",
        "0 to 299",
        f'pytest -m gate tests/closed_loop/test_fit_calibration.py -k "uniform and {case.split("+")[-1].split(",")[0]}"',
    )
    assert smallest_by_holm(p) > LEAST_P, p


@pytest.mark.gate
def test_understated_uncertainties_fail():
    table, _, _ = run("lambertian+ggx", 300, understated=0.7)
    p = p_values(table)
    record(
        "simulation-based calibration, lambertian+ggx with uncertainties understated by 0.7",
        f"p times their number {smallest_by_holm(p):.1e} ({min(p, key=p.get)})",
        "p <= 0.005: the test must fail",
        "0 to 299",
        'pytest -m gate tests/closed_loop/test_fit_calibration.py -k understated',
    )
    assert smallest_by_holm(p) < LEAST_P
