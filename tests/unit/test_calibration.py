"""Calibration from synthetic frames whose gain, read noise and level were put in; seeded, bounds from statistics."""

from __future__ import annotations

import numpy as np
import pytest

from gonio.calibration import CameraNoise, Reference, crop, linearity, photon_transfer, stack_dark, stack_darks, white_block
from gonio.errors import ConfigurationError, MeasurementError
from gonio.interfaces import Frame

GAIN, READ, OFFSET, FULL = 0.25, 4.0, 64.0, 4095


def expose(rng, electrons, exposure_s=0.01, shape=(64, 64), label="", offset=OFFSET, fixed=0.0):
    """A frame of the EMVA 1288 camera: Poisson electrons, normal read noise, gain, offset, rounding, clipping."""
    counts = GAIN * (rng.poisson(electrons, shape) + READ * rng.standard_normal(shape)) + offset + fixed
    data = np.clip(np.rint(counts), 0, FULL).astype(np.uint16)
    return Frame(data, exposure_s, 1.0, 0.0, 12, True, FULL, label)


def test_photon_transfer_returns_the_gain_and_read_noise_put_in():
    rng = np.random.default_rng(3)
    pattern = rng.normal(0.0, 3.0, (64, 64))  # fixed pattern must not count as noise
    levels = np.linspace(200, 11000, 12)
    pairs = [(expose(rng, e, fixed=pattern), expose(rng, e, fixed=pattern)) for e in levels]
    found = photon_transfer(pairs, [OFFSET] * 12, FULL)
    assert found.noise.gain_dn_per_e == pytest.approx(GAIN, abs=4 * found.u_gain)
    assert found.u_gain < 0.01 * GAIN
    floor = photon_transfer(pairs, [OFFSET] * 12, FULL, dark_variance=(GAIN * READ) ** 2 + 1 / 12)
    assert floor.noise.read_noise_e * floor.noise.gain_dn_per_e == pytest.approx(READ * GAIN, rel=1e-12)
    assert floor.noise.gain_dn_per_e == pytest.approx(GAIN, abs=4 * floor.u_gain)
    assert floor.u_gain < found.u_gain
    assert np.isnan(found.saturation_dn)


def test_photon_transfer_has_no_bias_and_an_honest_uncertainty():
    pulls = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        pairs = [(expose(rng, e, shape=(16, 16)), expose(rng, e, shape=(16, 16))) for e in (100, 400, 1600, 6400)]
        found = photon_transfer(pairs, [OFFSET] * 4, FULL)
        pulls.append((found.noise.gain_dn_per_e - GAIN) / found.u_gain)
    assert abs(np.mean(pulls)) < 4 / np.sqrt(60)
    assert 0.75 < np.std(pulls) < 1.25


def test_photon_transfer_finds_saturation_and_leaves_it_out():
    rng = np.random.default_rng(4)
    levels = np.linspace(500, 20000, 40)
    pairs = [(expose(rng, e), expose(rng, e)) for e in levels]
    found = photon_transfer(pairs, [OFFSET] * 40, FULL)
    assert found.saturation_dn == pytest.approx(FULL - OFFSET, rel=0.05)
    assert found.signal[found.used].max() < 0.7 * FULL
    assert found.noise.gain_dn_per_e == pytest.approx(GAIN, abs=4 * found.u_gain)


def test_photon_transfer_refuses_a_camera_with_gamma_and_one_that_smooths():
    rng = np.random.default_rng(5)

    def gamma(frame):
        return FULL * ((frame.data - OFFSET).clip(0) / FULL) ** (1 / 2.2)

    levels = np.linspace(500, 10000, 10)
    pairs = [(gamma(expose(rng, e)), gamma(expose(rng, e))) for e in levels]
    with pytest.raises(MeasurementError, match=r"no line|not positive"):
        photon_transfer(pairs, [0.0] * 10, FULL)
    with pytest.raises(MeasurementError, match="use shorter exposures"):
        photon_transfer([(expose(rng, 15000), expose(rng, 15000))], [OFFSET], FULL)
    with pytest.raises(MeasurementError, match="one shape"):
        photon_transfer([(np.zeros((8, 8)), np.zeros((8, 9)))], [OFFSET], FULL)


def test_noise_model_is_that_of_the_standard():
    noise = CameraNoise(GAIN, READ)
    assert noise.variance(1000.0) == pytest.approx(1.0 + 1 / 12 + 250.0)
    assert noise.variance(-5.0) == noise.floor


def test_dark_stack_mean_and_variance():
    rng = np.random.default_rng(6)
    darks = stack_darks([expose(rng, 0, t) for t in (0.1, 0.01) for _ in range(16)], roi=(8, 4, 32, 20))
    assert list(darks) == [0.01, 0.1]
    dark = darks[0.1]
    assert dark.mean.shape == (20, 32) and dark.count == 16
    assert dark.mean.mean() == pytest.approx(OFFSET, abs=4 * np.sqrt(dark.mean_variance))
    truth = (GAIN * READ) ** 2 + 1 / 12
    assert dark.frame_variance == pytest.approx(truth, rel=4 * np.sqrt(2 / dark.degrees_of_freedom))
    assert dark.mean_variance == pytest.approx(truth / (16 * 640), rel=0.1)


def test_darks_that_are_not_dark_or_not_of_one_kind_are_refused():
    rng = np.random.default_rng(7)
    with pytest.raises(MeasurementError, match="not dark"):
        stack_dark([expose(rng, 12000), expose(rng, 12000)])
    with pytest.raises(MeasurementError, match="at least 2"):
        stack_dark([expose(rng, 0)])
    with pytest.raises(MeasurementError, match="do not belong together"):
        stack_dark([expose(rng, 0, 0.1), expose(rng, 0, 0.2)])


def test_a_region_outside_the_frame_is_refused():
    frame = expose(np.random.default_rng(8), 0, shape=(20, 30))
    assert crop(frame, (10, 5, 20, 15)).shape == (15, 20)
    assert crop(frame, None).shape == (20, 30)
    for roi in ((11, 5, 20, 15), (10, 6, 20, 15), (-1, 0, 5, 5), (0, 0, 0, 5)):
        with pytest.raises(ConfigurationError, match="30 x 20"):
            crop(frame, roi)


def test_linearity_of_a_linear_camera_is_one_within_its_uncertainty():
    rng = np.random.default_rng(9)
    t = np.array([0.002, 0.016, 0.128])
    truth = rng.uniform(1e3, 1e4, 300)[:, None] * t
    variance = 1.0 + GAIN * truth
    seen = truth + np.sqrt(variance) * rng.standard_normal(truth.shape)
    found = linearity(t, seen, variance, truth < 1200)
    assert np.all(np.abs(found.ratio - 1) < 4 * found.u_ratio)
    assert found.scenes[0] == 300 and 0 < found.scenes[1] < 300
    found.check()


def test_linearity_refuses_a_curved_camera_and_names_the_exposures():
    t = np.array([0.01, 0.1])
    truth = np.linspace(1000, 9000, 50)[:, None] * t
    curved = truth * (1 - 0.05 * truth / 900)
    found = linearity(t, curved, np.full_like(truth, 0.01), np.ones_like(truth, dtype=bool))
    assert found.deviation > 0.01
    with pytest.raises(MeasurementError, match=r"0\.1 s sees -.*0\.01 s"):
        found.check()
    found.check(limit=0.1)


def test_linearity_without_common_scenes_says_nothing():
    found = linearity([0.01, 0.1], [[10.0, 0.0]], [[1.0, 1.0]], [[True, False]])
    assert np.isnan(found.ratio[0]) and found.deviation == 0.0
    found.check()


def test_white_blocks_interpolate_the_drift_linearly():
    late = white_block([1000.0, 1010.0], [102.0, 102.0], [0.1, 0.1])
    blocks = [late, white_block([0.0, 10.0], [100.0, 100.0], [0.1, 0.1])]
    reference = Reference.of(blocks)
    assert [b.time_s for b in reference.blocks] == [5.0, 1005.0]
    value, u, bow, bracketed = reference.at([5.0, 255.0, 505.0, 1005.0, 2000.0, -3.0])
    np.testing.assert_allclose(value, [100.0, 100.5, 101.0, 102.0, 102.0, 100.0], rtol=1e-14)
    np.testing.assert_array_equal(bracketed, [True, True, True, True, False, False])
    single = 0.1 / np.sqrt(2)
    np.testing.assert_allclose(u[[0, 2, 3]], [single, single / np.sqrt(2), single])
    np.testing.assert_allclose(bow, [0, 0.75 * 2 / 100.5, 2 / 101.0, 0, 0, 0], atol=1e-15)
    assert reference.drift == pytest.approx(2 / 101)


def test_a_change_within_the_noise_is_no_drift_error():
    reference = Reference.of([white_block([0.0], [100.0], [0.2]), white_block([10.0], [100.3], [0.2])])
    assert np.all(reference.at([5.0])[2] == 0.0)
    one = Reference.of([white_block([0.0], [100.0], [0.2])])
    value, u, bow, bracketed = one.at([-1.0, 0.0, 50.0])
    assert np.all(value == 100.0) and np.all(u == 0.2) and np.all(bow == 0.0) and one.drift == 0.0
    np.testing.assert_array_equal(bracketed, [False, True, False])


def test_repeats_that_scatter_raise_the_uncertainty_and_never_lower_it():
    calm = white_block([0, 1, 2, 3], [100.0, 100.01, 99.99, 100.0], [0.2] * 4)
    assert calm.u == pytest.approx(0.1)
    wild = white_block([0, 1, 2, 3], [99.0, 101.0, 99.0, 101.0], [0.2] * 4)
    assert wild.u == pytest.approx(np.std([99, 101, 99, 101], ddof=1) / 2)  # = the scatter of the mean


def test_a_white_without_light_is_refused():
    with pytest.raises(MeasurementError, match="no light"):
        white_block([0.0], [0.3], [0.1])
    with pytest.raises(MeasurementError, match="no usable reading"):
        white_block([], [], [])
    with pytest.raises(MeasurementError, match="no white reference"):
        Reference.of([])
