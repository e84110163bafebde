"""Tables over four angles: a grain comes back, turned as it was; truths are a model at other directions."""

from __future__ import annotations

import math

import numpy as np
import pytest

import gonio
from gonio.brdf import grained
from gonio.errors import ConfigurationError, DatasetError
from gonio.samples import BRDFSamples
from tests import materials


def pairs(n: int, seed: int, reach_deg: float = 70.0) -> tuple[np.ndarray, ...]:
    """theta_i, phi_i, theta_r, phi_r, half of them near the mirror direction."""
    rng = np.random.default_rng(seed)
    theta_i, theta_r = np.radians(rng.uniform(0, reach_deg, (2, n)))
    phi_i, phi_r = rng.uniform(0, 2 * np.pi, (2, n))
    near = rng.random(n) < 0.5
    theta_r = np.where(near, np.clip(theta_i + 0.2 * rng.standard_normal(n), 0, math.radians(reach_deg)), theta_r)
    phi_r = np.where(near, phi_i + np.pi + 0.3 * rng.standard_normal(n), phi_r)
    return theta_i, phi_i, theta_r, np.mod(phi_r, 2 * np.pi)


@pytest.fixture(scope="module")
def truth() -> gonio.BRDF:
    return materials.turned(math.radians(20), 0.25, 0.6).brdfs[0]


def test_table_of_a_model_between_its_nodes(truth: gonio.BRDF) -> None:
    table = grained.from_brdf(truth, (36, 24, 10, 12)).brdf()
    at = pairs(2000, 1)
    relative = np.abs(table.f_r(*at) / truth.f_r(*at) - 1)
    assert np.median(relative) < 2e-3 and np.quantile(relative, 0.99) < 0.03
    # the same directions turned by 90 degrees are another part of the grain
    wrong = np.abs(table.f_r(at[0], at[1] + np.pi / 2, at[2], at[3] + np.pi / 2) / truth.f_r(*at) - 1)
    assert np.median(wrong) > 0.05


def test_reciprocal_and_never_negative(truth: gonio.BRDF) -> None:
    table = grained.from_brdf(truth, (12, 12, 8, 8)).brdf()
    theta_i, phi_i, theta_r, phi_r = pairs(500, 2, 88.0)
    f = table.f_r(theta_i, phi_i, theta_r, phi_r)
    assert np.all(f >= 0) and np.all(np.isfinite(f))
    np.testing.assert_allclose(table.f_r(theta_r, phi_r, theta_i, phi_i), f, rtol=1e-9)
    assert float(table.f_r(1.7, 0.0, 0.3, 0.0)) == 0.0
    assert math.isfinite(float(table.f_r(0.0, 0.0, 0.0, 0.0))) and math.isfinite(
        float(table.f_r(0.5, 1.0, 0.5, 1.0 + np.pi))
    )


def test_scattered_samples_with_a_grain(truth: gonio.BRDF) -> None:
    theta_i, phi_i, theta_r, phi_r = pairs(1500, 3)
    f = truth.f_r(theta_i, phi_i, theta_r, phi_r)
    noisy = f * (1 + 0.01 * np.random.default_rng(4).standard_normal(len(f)))
    table = grained.tabulate(BRDFSamples.plain(theta_i, phi_i, theta_r, phi_r, noisy, 0.01 * f), (16, 12, 8, 8))
    at = pairs(1500, 5, 65.0)
    expected = truth.f_r(*at)
    relative = np.abs(table.brdf().f_r(*at) / expected - 1)
    pull = np.abs(table.brdf().f_r(*at) - expected) / table.u_brdf().f_r(*at)
    assert np.median(relative) < 0.04
    assert np.quantile(pull, 0.683) < 1.3
    counts = table.counts()
    assert counts["measured"] > 500 and counts["extrapolated"] > 0 and counts["below_horizon"] > 0


def test_a_grain_is_seen_in_scattered_samples_and_only_there(truth: gonio.BRDF) -> None:
    """No two directions are measured at two azimuths, so only what predicts the others can tell."""
    at, rng = pairs(800, 7), np.random.default_rng(8)
    for brdf, there in ((truth, True), (materials.paint(0.3, 0.3), False)):
        f = brdf.f_r(*at)
        assert grained.shown_by(BRDFSamples.plain(*at, f * (1 + 0.02 * rng.standard_normal(len(f))), 0.02 * f)) is there
    one = BRDFSamples.plain(at[0], 0.0, at[2], at[3], truth.f_r(at[0], 0.0, at[2], at[3]))
    assert not grained.shown_by(one)


def test_map_of_a_table_with_a_grain_needs_its_tangent(truth: gonio.BRDF) -> None:
    table = grained.from_brdf(truth, (24, 16, 8, 8)).brdf()
    lamp = gonio.source.collimated(0.5, 0.3)
    with pytest.raises(ConfigurationError, match="tangent"):
        gonio.reflectance_map(table, lamp, 0.2, 0.1)
    found = float(gonio.reflectance_map(table, lamp, 0.0, 0.0, tangent=0.4).value)
    # at the flat place the frame's x axis is turned by 0.4 rad: f_r cos(theta_i) by hand
    expected = float(table.f_r(0.5, 0.3 - 0.4, 0.0, 0.0)) * math.cos(0.5)
    assert found == pytest.approx(expected, rel=1e-9)


def test_what_cannot_become_a_table() -> None:
    up = np.zeros(30)
    with pytest.raises(DatasetError, match="at least 60 samples, there are 30"):
        grained.tabulate(BRDFSamples.plain(up, up, up, up, up + 1.0))
    with pytest.raises(DatasetError, match="even number of phi_h"):
        grained.from_brdf(gonio.brdf.make("lambertian", albedo=0.5), (5, 4, 4, 4))
