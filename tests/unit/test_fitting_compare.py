"""Comparison of models on data whose model is known."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

import gonio
from fitting import fit
from fitting.compare import compare, incidences
from gonio.cli.compare import split
from gonio.cli.main import main
from gonio.errors import ParameterError
from gonio.samples import BRDFSamples
from tests.unit.test_fitting_recovery import QUICK, scan

BLACK = Path(__file__).parents[1] / "data" / "optics-blacks" / "AnoBlackEC1onAlum.bsdf"


@pytest.mark.parametrize(("right", "wrong"), [("beckmann", "ggx"), ("ggx", "beckmann")])
def test_the_model_that_made_the_data_wins_and_the_other_one_is_inadequate(right, wrong):
    """200 samples of 1 % with the errors of a rig; the wrong lobe is behind by more than 10 standard errors."""
    found = compare(scan(4, 200, lobe=right).samples, [f"lambertian+{wrong}", f"lambertian+{right}"])
    best, other = found.scores
    assert best.model == f"lambertian+{right}"
    gap, error = found.difference(other, "loo")
    print(f"{other.model}: behind by {gap:.0f} +- {error:.0f}, chi2/N = {other.chi2_per_n:.2f}, not {best.chi2_per_n:.2f}")
    assert gap > 10 * error > 0
    gap, error = found.difference(other, "incidence")
    assert gap > 4 * error
    assert not found.faults(best) and found.faults(other)
    assert best.chi2_per_n == pytest.approx(1.0, abs=4 * math.sqrt(2 / 200)) and other.chi2_per_n > 3
    assert best.noise < 0.005 < other.noise
    told = found.verdict()
    assert "beyond doubt" in told[0] and told[1] == f"adequate: lambertian+{right}"
    assert told[2].startswith(f"not adequate: lambertian+{wrong}: chi2/N = ")


def test_loo_of_paper_is_that_of_the_exact_leave_one_out_fits():
    """A Lambertian surface, sd known: with a flat prior the albedo without reading j is normal, and so is the prediction."""
    rng = np.random.default_rng(3)
    n, u = 30, 0.004
    y = 0.5 / math.pi + rng.normal(0, u, n)
    theta = rng.uniform(0.1, 1.2, n)
    samples = BRDFSamples.plain(theta, 0.0, 0.3, 2.0, y, u)
    found = compare(samples, ["lambertian"], fix={"noise.discrepancy": 1e-4}).scores[0]
    rest = (y.sum() - y) / (n - 1)
    exact = stats.norm.logpdf(y, rest, u * math.sqrt(1 + 1 / (n - 1)))
    assert found.loo == pytest.approx(exact, abs=0.02)
    assert found.effective_parameters == pytest.approx(
        np.sum(stats.norm.logpdf(y, y.mean(), u * math.sqrt(1 + 1 / n)) - exact), abs=0.15
    )
    group = incidences(theta)
    assert set(np.bincount(group)) == {3}
    for g in range(10):
        out = group == g
        expected = stats.norm.logpdf(y[out], y[~out].mean(), u * math.sqrt(1 + 1 / 27))
        assert found.incidence[out] == pytest.approx(expected, abs=0.03)


def test_residuals_that_follow_their_neighbours_are_no_noise():
    """A grating of 5 % on paper, noise not stated: chi2/N says nothing, the neighbours do."""
    theta = np.linspace(0.0, 1.2, 200)
    y = 0.5 / math.pi * (1.0 + 0.05 * np.sin(20 * theta))
    held = {"noise.absolute": 1e-3}
    found = compare(BRDFSamples.plain(0.5, 0.0, theta, 2.0, y), ["lambertian"], fix=held)
    assert found.scores[0].alike > 0.95
    assert found.verdict()[0].startswith("no model is adequate: lambertian: ")
    assert "state no uncertainty" in found.verdict()[1]
    assert math.isnan(found.scores[0].chi2_per_n)
    noisy = 0.5 / math.pi * (1.0 + 0.05 * np.random.default_rng(2).normal(size=200))
    assert (
        compare(BRDFSamples.plain(0.5, 0.0, theta, 2.0, noisy), ["lambertian"], fix=held).verdict()[0]
        == "adequate: lambertian"
    )


def glass(top, seed):
    """400 samples of 2 % of a rough dielectric, both directions at most `top` degrees from the normal."""
    rng = np.random.default_rng(seed)
    theta_i = np.radians(rng.uniform(5.0, top, 400))
    theta_r = np.clip(theta_i + rng.normal(0, 0.25, 400), 0.0, math.radians(top))
    dphi = math.pi + rng.normal(0, 0.3, 400)
    truth = gonio.brdf.make("lambertian", albedo=0.3)
    truth += gonio.brdf.make("microfacet", fresnel="dielectric", k_s=0.8, alpha=0.2, n=1.5)
    f = truth.f_r(theta_i, 0.0, theta_r, dphi)
    return BRDFSamples.plain(theta_i, 0.0, theta_r, dphi, f * (1 + 0.02 * rng.normal(size=400)), 0.02 * f)


@pytest.mark.parametrize(("top", "named"), [(50, True), (80, False)])
def test_index_and_weight_that_nothing_past_60_degrees_tells_apart_are_named(top, named):
    model = "lambertian+microfacet[fresnel=dielectric]"
    advice = fit(glass(top, 1), model, free=["microfacet.k_s"], seed=1, rule=QUICK).diagnostics["advice"]
    assert any("microfacet.n and microfacet.k_s only together" in said for said in advice) == named


def test_incidences_are_those_of_the_data_where_they_are_few():
    assert incidences(np.radians([10.0, 30.0, 10.0, 70.0])).tolist() == [0, 1, 0, 2]
    assert np.all(np.diff(incidences(np.linspace(0, 1.5, 95))) >= 0)


def test_models_are_split_at_commas_outside_brackets():
    assert split("a, b[c=d,e=f]+g,h") == ["a", "b[c=d,e=f]+g", "h"]


def test_what_makes_no_sense_is_refused(capsys):
    samples = BRDFSamples.plain([0.3, 0.5], 0.0, [0.5, 0.6], 3.0, [0.2, 0.2], 0.01)
    with pytest.raises(ParameterError, match="name each model once"):
        compare(samples, ["lambertian", "lambertian"])
    with pytest.raises(ParameterError, match=r"fix ggx\.f_0: none of the models has it"):
        compare(samples, ["lambertian"], fix={"ggx.f_0": 0.04})
    assert main(["compare", str(BLACK), "--models", "lambertian,phongg"]) == 2
    assert "phongg" in capsys.readouterr().err


def test_the_command_on_a_measured_black(capsys):
    assert main(["compare", str(BLACK), "--models", "lambertian+ggx,lambertian+beckmann", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    first, second = found["models"]
    assert {first["model"], second["model"]} == {"lambertian+ggx", "lambertian+beckmann"}
    assert found["samples"] == 647 and first["incidence"][0] == 0.0 < second["incidence"][0]
    assert not first["adequate"] and first["systematic"] > 0.5
    assert any(said.startswith("no model is adequate") for said in found["verdict"])


def test_a_model_that_needs_more_noise_than_a_better_one_is_not_adequate():
    """Lambert's law on a rough wall of Oren and Nayar, 2 % noise that nobody stated."""
    rng = np.random.default_rng(5)
    theta_i, theta_r, phi_r = rng.uniform(0, 1.2, 80), rng.uniform(0, 1.2, 80), rng.uniform(0, 6.2, 80)
    f = gonio.brdf.make("oren_nayar", albedo=0.6, sigma=0.5).f_r(theta_i, 0.0, theta_r, phi_r)
    samples = BRDFSamples.plain(theta_i, 0.0, theta_r, phi_r, f * (1.0 + 0.02 * rng.normal(size=80)))
    found = compare(samples, ["lambertian", "oren_nayar"], fix={"noise.absolute": 1e-3})
    assert [s.model for s in found.scores] == ["oren_nayar", "lambertian"]
    assert not found.faults(found.scores[0])
    assert found.scores[0].noise == pytest.approx(0.02, abs=0.006)
    assert found.scores[1].noise > 0.05
    assert any("where oren_nayar is by" in said for said in found.faults(found.scores[1])), found.faults(found.scores[1])


def test_a_few_readings_decide_nothing():
    one = compare(BRDFSamples.plain([0.3], [0.0], [0.5], [3.0], [0.2], [0.01]), ["lambertian", "lambertian+ggx"]).verdict()
    assert "but not surely" in one[0]
    assert "1 readings are few: what describes them may be wrong elsewhere" in one
    nothing = compare(BRDFSamples.plain([0.3, 0.5, 0.7], 0.0, 0.5, 3.0, np.zeros(3), 0.01), ["lambertian"])
    assert nothing.scores[0].parameters["lambertian.albedo"][0] < 0.05
