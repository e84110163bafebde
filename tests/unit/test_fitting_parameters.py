"""Priors and parameters: what is free, what is held, and that the walked coordinates change nothing."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy import stats

from fitting.parameters import Declared, Space, declare
from fitting.priors import prior
from gonio import brdf
from gonio.errors import ParameterError

GGX = brdf.parse("lambertian+ggx")


@pytest.mark.parametrize(
    ("given", "lower", "upper", "expected"),
    [
        (("uniform", 0.2, 0.7), 0.0, 1.0, stats.uniform(0.2, 0.5)),
        (("log_uniform", 0.01, 1.0), 1e-4, 1.0, stats.loguniform(0.01, 1.0)),
        (("normal", 0.5, 0.05), 0.0, 1.0, stats.norm(0.5, 0.05)),
        (("normal", 0.1, 2.0), -math.inf, math.inf, stats.norm(0.1, 2.0)),
        (("log_normal", math.log(0.1), 0.3), 1e-4, 1.0, stats.lognorm(0.3, scale=0.1)),
        (("half_normal", 0.2), 0.0, 100.0, stats.halfnorm(scale=0.2)),
    ],
)
def test_draws_and_densities_are_those_of_scipy(given, lower, upper, expected):
    q = prior(given, lower, upper, "x")
    draws = q.draw(np.random.default_rng(3), 4000)
    assert stats.kstest(draws, expected.cdf).pvalue > 1e-3
    x = expected.ppf(np.linspace(0.1, 0.9, 9))
    difference = q.log_density(x) - expected.logpdf(x)
    assert np.ptp(difference) < 1e-9  # equal up to the normalisation
    sd = np.log(draws).std() if q.logarithmic else draws.std()
    assert q.sd() == pytest.approx(sd, rel=0.06)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (("unifrm", 0, 1), "unknown"),
        ((), "unknown"),
        (("uniform", 0.1), "takes 2"),
        (("uniform", 0.1, math.nan), "finite"),
        (("uniform", 0.7, 0.2), "empty"),
        (("log_uniform", 0.0, 1.0), "empty"),
        (("normal", 0.5, -1.0), "positive"),
        (("uniform", 2.0, 3.0), "leaves nothing"),
    ],
)
def test_a_bad_prior_is_refused_with_its_name(given, said):
    with pytest.raises(ParameterError, match=said) as caught:
        prior(given, 0.0, 1.0, "ggx.alpha")
    assert "ggx.alpha" in str(caught.value)


def test_defaults_hold_what_the_registry_holds():
    space = Space(declare(GGX))
    assert space.names == ("lambertian.albedo", "ggx.alpha", "ggx.f_0")
    assert space.fixed == {"ggx.k_s": 1.0}
    freed = Space(declare(GGX), free=["ggx.k_s"], fix={"ggx.f_0": 0.04})
    assert freed.names == ("lambertian.albedo", "ggx.k_s", "ggx.alpha")
    assert freed.fixed == {"ggx.f_0": 0.04}
    assert np.array_equal(freed.full(np.array([[0.1, 0.2, 0.3]])), [[0.1, 0.2, 0.3, 0.04]])


def test_a_second_term_of_one_model_has_names_of_its_own():
    names = Space(declare(brdf.parse("ggx+ggx"))).names
    assert names == ("ggx.alpha", "ggx.f_0", "ggx2.alpha", "ggx2.f_0")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"free": ["ggx.ks"]}, "did you mean 'ggx.k_s'"),
        ({"fix": {"lambertian.albdo": 0.1}}, "did you mean 'lambertian.albedo'"),
        ({"priors": {"ggx.beta": ("uniform", 0, 1)}}, "no parameter 'ggx.beta'"),
        ({"fix": {"ggx.f_0": 2.0}}, r"ggx.f_0 = 2 is outside \[0, 1\]"),
        ({"fix": {"ggx.f_0": math.nan}}, "outside"),
        ({"fix": {"ggx.f_0": 0.1}, "free": ["ggx.f_0"]}, "at once"),
        ({"fix": {"ggx.f_0": 0.1}, "priors": {"ggx.f_0": ("uniform", 0, 1)}}, "choose one"),
    ],
)
def test_a_wrong_name_or_value_is_one_sentence(options, said):
    with pytest.raises(ParameterError, match=said):
        Space(declare(GGX), **options)


def test_a_delta_function_cannot_be_fitted():
    with pytest.raises(ParameterError, match="delta function"):
        declare(brdf.parse("lambertian+specular"))


def test_the_density_of_the_walked_coordinate_holds_the_jacobian():
    """Histogram-free: the prior density of u integrates to that of x over any interval."""
    declared = [
        Declared("a", 0.0, 1.0, ("uniform", 0.1, 0.9)),
        Declared("b", 1e-4, 1.0, ("log_normal", math.log(0.2), 0.9)),
        Declared("c", -math.inf, math.inf, ("normal", 0.3, 0.02)),
        Declared("d", 1e-4, 3.0, ("half_normal", 0.3)),
        Declared("e", 1e-4, 1.0, ("log_uniform", 1e-3, 0.5)),
        Declared("f", 0.0, 1.0, ("normal", 0.9, 0.2)),
    ]
    for one in declared:
        space = Space([one])
        q = space.priors[0]
        u = np.linspace(-7.0, 7.0, 200_001)[:, None]
        x, log_density = space.natural(u)
        density = np.exp(log_density - log_density.max())
        x = x[:, 0]
        edges = np.quantile(q.draw(np.random.default_rng(1), 2000), [0.0, 0.2, 0.5, 0.8, 1.0])
        walked = np.array([density[(x >= a) & (x < b)].sum() for a, b in itertools.pairwise(edges)])
        grid = [np.linspace(a, b, 20_001) for a, b in itertools.pairwise(edges)]
        direct = np.array([np.trapezoid(np.exp(q.log_density(g)), g) for g in grid])
        assert walked / walked.sum() == pytest.approx(direct / direct.sum(), rel=2e-3), one.name


def test_values_at_the_very_edge_stay_inside():
    space = Space(declare(GGX))
    x, log_prior = space.natural(np.array([[-60.0, 60.0, 0.0], [60.0, -60.0, 50.0]]))
    lower, upper = [q.lower for q in space.priors], [q.upper for q in space.priors]
    assert np.all((x >= lower) & (x <= upper))
    assert np.all(np.isfinite(log_prior))
    assert np.all(np.isfinite(space.unbounded(np.array([lower, upper]))))
