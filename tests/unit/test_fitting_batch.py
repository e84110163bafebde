"""Fits of many pixels, held to truths that share nothing with them: closed forms, a grid, the material's own parameters."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest
from scipy import stats

from fitting import tiles
from fitting.batch import STATUS, Job, weighted_quantiles
from gonio.errors import DatasetError, ParameterError
from gonio.samples import BRDFSamples, SharedError
from tests.unit.test_fitting_recovery import material

N = 50


def directions(seed, n=N):
    """Angles of samples, half of them near the mirror condition."""
    rng = np.random.default_rng(seed)
    theta_i = rng.uniform(0.0, 1.2, n)
    near = rng.random(n) < 0.6
    theta_r = np.where(near, np.clip(theta_i + rng.normal(0, 0.3, n), 0.0, 1.3), rng.uniform(0.0, 1.2, n))
    return theta_i, np.zeros(n), theta_r, np.where(near, math.pi + rng.normal(0, 0.3, n), rng.uniform(0, 2 * math.pi, n))


def template(seed=5, n=N, u=0.01):
    return BRDFSamples.plain(*directions(seed, n), np.full(n, 0.2), u)


def plastics(seed, pixels, samples):
    """Truths (p, 3) and noisy readings with their uncertainties, (p, n) each; the formula of the tests."""
    rng = np.random.default_rng(seed)
    truth = np.column_stack(
        (rng.uniform(0.05, 0.95, pixels), np.exp(rng.uniform(-2.5, -0.7, pixels)), rng.uniform(0.02, 0.6, pixels))
    )
    wi, wr = samples.omega_i(), samples.omega_r()
    f = np.array([material(wi, wr, *row) for row in truth])
    u = 0.02 * f + 1e-3
    return truth, f + u * rng.normal(size=f.shape), u


JOB = Job(template(), "lambertian+ggx")


def test_intervals_cover_the_truth_as_often_as_they_say():
    """1,000 pixels; bounds are 3.3 binomial standard deviations, the seed is fixed."""
    truth, readings, u = plastics(6, 1000, JOB.samples)
    found = JOB.fit(readings, u)
    assert found.names == ("lambertian.albedo", "ggx.alpha", "ggx.f_0")
    assert np.mean(found.status == 0) > 0.99
    q = found.quantiles
    inside95 = np.mean((q[:, :, 0] <= truth) & (truth <= q[:, :, 4]), axis=0)
    inside68 = np.mean((q[:, :, 1] <= truth) & (truth <= q[:, :, 3]), axis=0)
    assert np.all(np.abs(inside95 - 0.95) < 0.023), inside95
    assert np.all(np.abs(inside68 - 0.68) < 0.049), inside68
    assert found.chi2_per_n.mean() == pytest.approx((N - 3) / N, abs=4 * math.sqrt(2 / N / 1000))
    assert np.max(np.abs(found.mean - truth) / found.sd) < 6.0


def test_quantiles_are_those_of_the_exact_posterior_at_the_edge_of_a_range():
    """Albedos that the readings put at 0 and 1: a Gauss cut to [0, 1], far from a Gauss."""
    samples = template(u=0.2)
    readings = np.array([[0.002] * N, [0.99 / math.pi] * N, [1.3 / math.pi] * N, [0.5 / math.pi] * N])
    found = Job(samples, "lambertian", draws=4096).fit(readings)
    sd = 0.2 * math.pi / math.sqrt(N)
    for k, reading in enumerate(readings[:, 0]):
        mean = reading * math.pi
        exact = stats.truncnorm(-mean / sd, (1.0 - mean) / sd, mean, sd)
        assert found.quantiles[k, 0] == pytest.approx(exact.ppf([0.025, 0.16, 0.5, 0.84, 0.975]), abs=0.02 * exact.std())
        assert found.mean[k, 0] == pytest.approx(exact.mean(), abs=0.01 * exact.std())
        assert found.sd[k, 0] == pytest.approx(exact.std(), rel=0.02)


def test_a_shared_scale_widens_every_pixel():
    """albedo and scale: the exact sd of their sum, from N readings of 1 % and a scale of 3 %."""
    n, u_scale = 20, 0.03
    plain = template(n=n, u=0.01 * 0.5 / math.pi)
    zero = np.zeros((n, 3, 1))
    samples = BRDFSamples(
        **(vars(plain) | {"shared": (SharedError("scale", u_scale),), "d_omega_i": zero, "d_omega_r": zero,
                          "d_ln_f": np.ones((n, 1))})
    )  # fmt: skip
    readings = np.full((1, n), 0.5 / math.pi)
    found = Job(samples, "lambertian").fit(readings)
    assert found.names == ("lambertian.albedo", "shared.scale")
    assert found.sd[0, 0] == pytest.approx(0.5 * math.hypot(u_scale, 0.01 / math.sqrt(n)), rel=0.03)
    alone = Job(samples, "lambertian", shared=False).fit(readings)
    assert alone.sd[0, 0] == pytest.approx(0.005 / math.sqrt(n), rel=0.02)


def test_a_pixel_does_not_depend_on_its_neighbours():
    _, readings, u = plastics(8, 40, JOB.samples)
    whole = JOB.fit(readings, u)
    for rows in (slice(0, 1), slice(7, 30)):
        part = JOB.fit(readings[rows], u[rows])
        for name, array in part.arrays().items():
            assert array.tobytes() == whole.arrays()[name][rows].tobytes(), name


def test_missing_readings_are_left_out():
    """NaN readings: the same as a job that never had those directions."""
    _, readings, u = plastics(9, 4, JOB.samples)
    readings[:, 30:] = np.nan
    found = JOB.fit(readings, u)
    fewer = Job(JOB.samples.select(np.arange(30)), JOB.model).fit(readings[:, :30], u[:, :30])
    assert found.mean == pytest.approx(fewer.mean, rel=1e-9)
    assert found.chi2_per_n == pytest.approx(fewer.chi2_per_n, rel=1e-9)


def test_pixels_without_readings_and_unknown_noise():
    _, readings, _ = plastics(10, 3, JOB.samples)
    readings[1] = np.nan
    samples = BRDFSamples.plain(*directions(5), np.median(readings[::2], axis=0))
    found = Job(samples, "lambertian+ggx").fit(readings)
    assert STATUS[found.status[1]] == "no readings"
    assert np.all(np.isnan(found.mean[1])) and np.isnan(found.chi2_per_n[1])
    relative = found.names.index("noise.relative")
    assert np.all(np.abs(found.mean[::2, relative] - 0.02) < 4 * found.sd[::2, relative])


def test_contraction_of_a_sum_of_which_only_the_total_is_known():
    """Two diffuse terms; the truth is a sum over a grid."""
    samples = template(n=20, u=0.3 / math.pi)
    found = Job(samples, "lambertian+lambertian", draws=4096).fit(np.full((1, 20), 1.0 / math.pi))
    a = (np.arange(1000) + 0.5) / 1000
    density = np.exp(-10.0 * ((a[:, None] + a - 1.0) / 0.3) ** 2).sum(axis=1)
    variance = np.average((a - 0.5) ** 2, weights=density)
    assert found.contraction[0] == pytest.approx([1.0 - 12.0 * variance] * 2, abs=0.03)


def test_a_curved_valley_is_not_taken_for_a_result():
    """Near-normal samples of one lobe: k_s and f_0 enter as their product, known to 0.4 %; draws cannot follow that."""
    samples = BRDFSamples.plain(np.full(30, 0.1), 0.0, np.linspace(0.0, 0.4, 30), math.pi, np.full(30, 0.5), 0.01)
    _, readings, u = plastics(11, 12, samples)
    both = Job(samples, "lambertian+ggx", free=("ggx.k_s",)).fit(readings, u)
    assert [STATUS[k] for k in both.status] == ["weights not to be trusted"] * 12


def test_weighted_quantiles_of_equal_weights_are_plain_ones():
    x = np.random.default_rng(1).normal(size=(2, 2000, 3))
    found = weighted_quantiles(x, np.full((2, 2000), 1 / 2000), (0.1, 0.5))
    assert found == pytest.approx(np.moveaxis(np.quantile(x, (0.1, 0.5), axis=1), 0, -1), abs=5e-3)


def test_what_makes_no_sense_is_refused():
    with pytest.raises(DatasetError, match=r"shape \(2, 49\)"):
        JOB.fit(np.ones((2, 49)))
    with pytest.raises(DatasetError, match="not positive"):
        JOB.fit(np.ones((2, N)), np.zeros((2, N)))
    with pytest.raises(DatasetError, match="infinite"):
        JOB.fit(np.full((2, N), np.inf))
    with pytest.raises(ParameterError, match="draws = 10"):
        Job(JOB.samples, JOB.model, draws=10)
    with pytest.raises(ParameterError, match=r"did you mean 'ggx\.alpha'"):
        Job(JOB.samples, JOB.model, fix={"ggx.alfa": 0.1}).fit(np.ones((1, N)))


class Rows:
    """Readings in memory."""

    def __init__(self, readings, u):
        self.readings, self.u = readings, u

    def read(self, start, stop):
        return self.readings[start:stop], self.u[start:stop]


class Kept(dict):
    """Estimates in memory."""

    def has(self, start, stop):
        return (start, stop) in self

    def write(self, start, stop, estimates):
        self[start, stop] = estimates


def bytes_of(kept):
    return {tile: {name: a.tobytes() for name, a in e.arrays().items()} for tile, e in kept.items()}


def test_processes_give_the_same_bytes_and_tiles_that_exist_are_skipped():
    _, readings, u = plastics(12, 22, JOB.samples)
    source, cut = Rows(readings, u), tiles.cut(22, 1, 2)
    here, there = Kept(), Kept()
    assert tiles.run(JOB, source, here, cut) == 11
    seen = []
    assert tiles.run(JOB, source, there, cut, processes=2, progress=lambda *n: seen.append(n)) == 11
    assert seen[0] == (0, 11) and seen[-1] == (11, 11)
    assert bytes_of(here) == bytes_of(there)
    del here[4, 6]
    assert tiles.run(JOB, source, here, cut) == 1
    assert bytes_of(here) == bytes_of(there)


def test_a_job_is_the_same_after_a_journey():
    again = pickle.loads(pickle.dumps(JOB))
    assert again.digest() == JOB.digest()
    assert Job(JOB.samples, JOB.model, fix={"ggx.f_0": 0.04}).digest() != JOB.digest()


def test_tiles_are_whole_rows():
    assert tiles.cut(5, 100, 250) == [(0, 2), (2, 4), (4, 5)]
    assert tiles.cut(2, 5000) == [(0, 1), (1, 2)]
    with pytest.raises(ParameterError, match="a tile of 0 pixels"):
        tiles.cut(5, 1, 0)
