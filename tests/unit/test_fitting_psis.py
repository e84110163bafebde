"""Pareto-smoothed weights against ratios whose tail is known.

Draws x of rate r for an exponential of rate 1 have ratios exp((r - 1) x) / r, and P(ratio > t) falls as t^(-r / (r - 1)): a
Pareto tail of shape k = (r - 1) / r, so k-hat has a truth, and so has the mean of x under the target, which is 1.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from fitting import psis


@pytest.mark.parametrize("rate", [1.25, 1.5, 2.0, 3.0])
def test_k_hat_is_the_shape_of_the_tail(rate):
    rng = np.random.default_rng(1)
    x = rng.exponential(1.0 / rate, (200, 4000))
    log_weights, k_hat = psis.smooth((rate - 1.0) * x)
    assert np.mean(k_hat) == pytest.approx((rate - 1.0) / rate, abs=0.03)
    assert np.exp(log_weights).sum(axis=1) == pytest.approx(np.ones(200), abs=1e-12)


def test_smoothing_lowers_the_error_where_the_variance_is_infinite():
    """k = 0.6: the spread of the estimate with raw weights against that with smoothed ones, 400 repetitions."""
    rng = np.random.default_rng(2)
    x = rng.exponential(0.4, (400, 1000))
    smooth = np.exp(psis.smooth(1.5 * x)[0])
    raw = np.exp(1.5 * x)
    raw /= raw.sum(axis=1, keepdims=True)
    error = [float(np.sqrt(np.mean((np.sum(w * x, axis=1) - 1.0) ** 2))) for w in (smooth, raw)]
    assert error[0] < 0.9 * error[1]


def test_only_the_tail_is_changed_and_its_order_kept():
    rng = np.random.default_rng(3)
    given = rng.normal(size=1000)
    log_weights, _ = psis.smooth(given)
    m = psis.tail_length(1000)
    order = np.argsort(given)
    shift = log_weights[order] - given[order]
    assert np.ptp(shift[: 1000 - m]) < 1e-12
    assert np.ptp(shift[1000 - m :]) > 1e-6
    assert np.all(np.diff(log_weights[order]) >= 0)


def test_weights_without_a_tail_are_defined():
    equal, k_hat = psis.smooth(np.full((2, 100), 3.0))
    assert np.all(k_hat == -np.inf)
    assert np.exp(equal) == pytest.approx(np.full((2, 100), 0.01))
    rows = np.vstack((np.full(100, -np.inf), np.where(np.arange(100) < 2, 0.0, -np.inf)))
    log_weights, k_hat = psis.smooth(rows)
    assert np.all(k_hat == np.inf)
    assert np.exp(log_weights[0]) == pytest.approx(np.full(100, 0.01))
    assert np.exp(log_weights[1, :2]) == pytest.approx([0.5, 0.5])
    assert psis.smooth(np.zeros(4))[1] == np.inf


def test_effective_number_and_limit():
    assert psis.effective(np.log(np.full(50, 0.02))) == pytest.approx(50.0)
    assert psis.limit(1000) == pytest.approx(1.0 - 1.0 / 3.0)
    assert psis.limit(10**6) == 0.7
    assert math.isfinite(psis.limit(1))
