"""Diagnostics against processes whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from fitting.diagnostics import advice, autocorrelation_time, contraction, entangled, misfit_limit, split_rhat


@pytest.mark.parametrize(("a", "tau"), [(0.9, 19.0), (0.5, 3.0), (0.0, 1.0)])
def test_autocorrelation_time_of_an_ar1_process(a, tau):
    """x_t = a x_{t-1} + noise has tau = (1 + a) / (1 - a)."""
    rng = np.random.default_rng(7)
    noise = rng.standard_normal((4000, 64, 1))
    chain = lfilter([1.0], [1.0, -a], noise, axis=0)[500:]
    assert autocorrelation_time(chain)[0] == pytest.approx(tau, rel=0.04)


def test_autocorrelation_time_sees_walkers_that_stay_apart():
    rng = np.random.default_rng(7)
    chain = rng.standard_normal((1000, 8, 1)) + np.where(np.arange(8) < 4, -5.0, 5.0)[None, :, None]
    assert autocorrelation_time(chain)[0] > 100


def test_a_series_that_never_moves_has_learnt_nothing():
    assert autocorrelation_time(np.ones((50, 4, 2))).tolist() == [50.0, 50.0]
    assert autocorrelation_time(np.ones((1, 4, 1))).tolist() == [1.0]


def test_rhat_of_agreeing_and_disagreeing_ensembles():
    rng = np.random.default_rng(5)
    draws = rng.standard_normal((4, 2000, 3))
    draws[0, :, 1] += 1.0  # one is elsewhere
    draws[0, :, 2] *= 3.0  # one is wider: only the folded statistic sees it
    rhat = split_rhat(draws)
    assert rhat[0] < 1.005
    assert rhat[1] > 1.05
    assert rhat[2] > 1.05


def test_rhat_of_a_drift_within_each_ensemble():
    rng = np.random.default_rng(5)
    draws = rng.standard_normal((4, 2000, 1)) + np.linspace(0, 2, 2000)[None, :, None]
    assert split_rhat(draws)[0] > 1.05


def test_rhat_is_undefined_without_draws():
    assert np.isnan(split_rhat(np.zeros((4, 3, 1)))).all()
    assert np.isnan(split_rhat(np.ones((4, 100, 1)))).all()


def test_contraction():
    assert contraction(2.0, 2.0) == 0.0
    assert contraction(2.0, 0.2) == pytest.approx(0.99)


def test_misfit_limit_is_wide_for_few_samples():
    assert misfit_limit(10_000) == 1.5
    assert misfit_limit(8) == pytest.approx(3.0)


GOOD = {
    "chi2_per_n": 1.0, "n_samples": 330, "n_parameters": 7, "contractions": {"ggx.alpha": 0.99}, "noise": "stated",
    "discrepancy": False, "acceptance": 0.25,
}  # fmt: skip


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"chi2_per_n": 3.2}, "chi2/N = 3.2"),
        ({"chi2_per_n": 3.2, "discrepancy": True}, "noise.discrepancy"),
        ({"chi2_per_n": 0.2}, "too large"),
        ({"contractions": {"ggx.f_0": 0.1}}, "hardly constrain ggx.f_0"),
        ({"n_samples": 5}, "5 samples for 7 parameters"),
        ({"noise": "inferred"}, "by construction"),
        ({"acceptance": 0.01}, "1.0% of the moves"),
    ],
)
def test_advice_names_what_is_wrong(change, said):
    assert advice(**GOOD) == []
    assert said in " ".join(advice(**(GOOD | change)))


def test_parameters_that_only_their_product_is_known_of_are_named():
    rng = np.random.default_rng(1)
    k_s = rng.uniform(0.2, 1.0, 2000)
    draws = np.column_stack((rng.normal(0.3, 0.01, 2000), k_s, 0.04 / k_s * (1.0 + 0.001 * rng.normal(size=2000))))
    (said,) = entangled(("lambertian.albedo", "ggx.k_s", "ggx.f_0"), draws)
    assert "ggx.f_0 and ggx.k_s only together (rank correlation -1.00)" in said
    assert entangled(("a", "b"), draws[:, :2]) == []
    assert entangled(("a",), draws[:, :1]) == []
    scale = 0.05 * np.random.default_rng(2).normal(size=(2000, 1))
    both = (1 + scale) * (1 + 0.005 * np.random.default_rng(3).normal(size=(2000, 2)))
    assert len(entangled(("a", "b"), both)) == 1
    assert entangled(("a", "b"), both, scale) == []
