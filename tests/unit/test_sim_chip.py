"""What the simulated sensor does to light, each effect against its definition; photon transfer of many frames as a gate."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gonio.errors import ConfigurationError
from sim.chip import Chip
from sim.settings import Settings
from sim.world import generator
from tests import gates


def chip(seed=1, camera=None, **truth):
    sizes = {"width": 64, "height": 48, "dark_current_e_s": 0.0}
    return Chip(Settings.from_mapping({"camera": camera or {}, "sim": {"truth": {**sizes, **truth}}}).sensor, seed)


def even(made, value=1.0):
    return np.full(made.sensor.width * made.sensor.height, value)


def photon_transfer(frames, levels, size, seed):
    """(gain, PRNU) from pairs and means of flat frames, as EMVA 1288 has it.

    Half the variance of differences against the mean is a line whose slope is the gain. The variance over pixels of a mean
    of frames, less what is left of the noise, is (PRNU mean)^2.
    """
    made = chip(prnu=0.01, responsivity=1e4, width=size, height=size, pixel_mm=1e-3)
    pairs = frames // levels // 2
    means, variances, spreads = [], [], []
    for e in np.linspace(0.05, 1.2, levels):
        total, noise = np.zeros((size, size)), 0.0
        for k in range(pairs):
            a, b = (made.expose(made.electrons(even(made)), float(e), generator(seed, f"{e} {k} {s}")) for s in "ab")
            noise += np.mean((a.astype(float) - b) ** 2) / 2 / pairs
            total += (a.astype(float) + b) / (2 * pairs)
        means.append(total.mean() - made.sensor.offset_dn)
        variances.append(noise)
        spreads.append((total.var() - noise / (2 * pairs)) / means[-1] ** 2)
    slope, _ = np.polyfit(means, variances, 1, w=1 / np.array(variances))
    return slope, math.sqrt(np.mean(spreads[levels // 2 :]))


def read_noise(frames, size, seed, gain):
    """From pairs of dark frames [electrons]."""
    made = chip(width=size, height=size)
    dark = [made.expose(made.electrons(even(made, 0.0)), 1e-3, generator(seed, f"dark {k}")) for k in range(frames)]
    halves = [np.var(a.astype(float) - b) / 2 for a, b in zip(dark[::2], dark[1::2], strict=True)]
    return math.sqrt(np.mean(halves) - 1 / 12) / gain


def test_photon_transfer_with_prnu():
    """A short slice of the gate."""
    gain, prnu = photon_transfer(frames=48, levels=12, size=96, seed=3)
    assert gain == pytest.approx(0.25, rel=0.02)
    assert prnu == pytest.approx(0.01, rel=0.05)
    assert read_noise(8, 96, 3, gain) == pytest.approx(4.0, rel=0.03)


@pytest.mark.gate
def test_photon_transfer_of_a_thousand_frames():
    gain, prnu = photon_transfer(frames=800, levels=10, size=256, seed=0)
    read = read_noise(200, 256, 0, gain)
    found = [value / put - 1 for value, put in ((gain, 0.25), (read, 4.0), (prnu, 0.01))]
    gates.record(
        "photon transfer of 1000 frames of the simulated sensor",
        "gain {:+.2f} %, read noise {:+.2f} %, PRNU {:+.2f} %".format(*(100 * x for x in found)),
        "each within 1 % of what was put in",
        "0",
        "pytest -m gate tests/unit/test_sim_chip.py",
    )
    assert max(map(abs, found)) <= 0.01


@pytest.mark.parametrize("mean", [0.5, 5.0, 29.0, 31.0, 300.0])
def test_shot_noise_has_the_variance_of_its_mean_on_both_sides_of_the_switch(mean):
    """Expected at gain 1: mean + read noise^2 + 1/12; and below 30 electrons Poisson's skew 1 / sqrt(mean)."""
    made = chip(width=256, height=256, responsivity=mean, pixel_mm=1e-4, camera={"gain_dn_per_e": 1.0, "read_noise_e": 2.0})
    counts = made.expose(made.electrons(even(made)), 1.0, generator(1, str(mean))).astype(float) - 64
    n = counts.size
    variance = mean + 4 + 1 / 12
    assert counts.mean() == pytest.approx(mean, abs=4 * math.sqrt(variance / n))
    assert counts.var() == pytest.approx(variance, rel=4 * math.sqrt(3 / n))
    if mean < 30:
        skew = np.mean((counts - counts.mean()) ** 3) / counts.std() ** 3
        assert skew == pytest.approx(mean / variance**1.5, abs=0.05)


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_every_bit_depth_ends_at_all_bits_set(bits):
    made = chip(camera={"bit_depth": bits, "gain_dn_per_e": 0.25, "offset_dn": 4.0})
    counts = made.expose(made.electrons(even(made, 1e6)), 10.0, generator(1, "x"))
    assert counts.dtype == np.uint16 and counts.min() == counts.max() == made.sensor.saturation_dn == 2**bits - 1


def test_fall_off_is_cos4_and_vignetting_comes_on_top():
    """Expected: (z / l)^4 for the field angle, times 1 - v (r / corner)^2."""
    plain, vignetted = chip(pixel_mm=10.0), chip(pixel_mm=10.0, vignetting=0.3)
    a, b = plain.electrons(even(plain)), vignetted.electrons(even(vignetted))
    x, y = 315.0, 235.0  # the corner pixel's centre
    assert a[0, 0] / 3.25e5 == pytest.approx((600 / math.sqrt(600**2 + x * x + y * y)) ** 4)
    assert b[0, 0] / a[0, 0] == pytest.approx(0.7)
    assert b[0, 32] / a[0, 32] == pytest.approx(1 - 0.3 * (5.0**2 + y * y) / (x * x + y * y))


def test_point_spread_is_a_gaussian_of_its_width_and_keeps_the_light():
    made = chip(psf_sigma_px=1.5, pixel_mm=1e-4, responsivity=1.0)
    image = np.zeros(64 * 48)
    image[24 * 64 + 32] = 1.0
    spread = made.electrons(image)
    across = spread.sum(axis=0)
    centre = np.arange(64) - 32
    assert spread.sum() == pytest.approx(1.0, rel=1e-6)
    assert np.sum(across * centre**2) == pytest.approx(1.5**2, rel=0.02)


def test_pixel_gains_are_fixed_and_of_their_spread():
    made, again, other = chip(prnu=0.02), chip(prnu=0.02), chip(seed=2, prnu=0.02)
    flat = chip().electrons(even(made))
    ratio = made.electrons(even(made)) / flat
    assert ratio.std() == pytest.approx(0.02, rel=4 / math.sqrt(2 * ratio.size))
    np.testing.assert_array_equal(made.electrons(even(made)), again.electrons(even(made)))
    assert np.any(made.electrons(even(made)) != other.electrons(even(made)))


def test_colour_filters_and_coloured_light():
    made = chip(cfa="RGGB", cfa_response=[0.6, 1.0, 0.5], pixel_mm=1e-4, responsivity=1.0)
    white, red = made.electrons(even(made)), made.electrons(even(made), (3.0, 0.0, 0.0))
    assert white[:2, :2] == pytest.approx(np.array([[0.6, 1.0], [1.0, 0.5]]))
    assert red[:2, :2] == pytest.approx(np.array([[1.8, 0.0], [0.0, 0.0]]))
    mono = chip(pixel_mm=1e-4, responsivity=1.0)
    assert mono.electrons(even(mono), (3.0, 0.0, 0.0))[0, 0] == pytest.approx(1.0)


def test_gamma_bends_the_response_and_keeps_its_ends():
    """Expected: full scale times (signal / full scale) to the power 1 / 2.2, without read noise to the count."""
    made = chip(response="gamma", gamma=2.2, pixel_mm=1e-4, responsivity=1.0, camera={"read_noise_e": 0.0, "bit_depth": 8,
                "gain_dn_per_e": 1e-6, "offset_dn": 0.0})  # fmt: skip
    for signal in (0.01, 0.1, 0.5, 0.999):
        counts = made.expose(made.electrons(even(made, signal * 255e6)), 1.0, generator(1, str(signal)))
        assert counts[0, 0] == pytest.approx(255 * signal ** (1 / 2.2), abs=0.6)


@pytest.mark.parametrize(
    ("truth", "message"),
    [
        ({"cfa": "RGBY"}, "no pattern of four colours"),
        ({"response": "log"}, "write linear or gamma"),
        ({"prnu": -1}, "prnu = -1 is outside"),
        ({"cfa_response": [1, 2]}, "3 numbers"),
    ],
)
def test_an_impossible_sensor_is_refused(truth, message):
    with pytest.raises(ConfigurationError, match=message):
        chip(**truth)
