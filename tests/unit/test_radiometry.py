"""Radiometry against a bench written out here: own rotation matrices, own camera, known BRDF and errors.

Geometry: camera at +z, lamp on an arm about y at fixed distance, specimen R_y(pan) R_x(tilt). The true joint angles are
those of the encoders plus a zero error. The camera is EMVA 1288's, with Poisson electrons, read noise and rounding; the
exact one instead dithers, so that the mean of a region is the level to 1 part in 1e8.
"""

from __future__ import annotations

import numpy as np
import pytest

import gonio.brdf
from gonio.calibration import CameraNoise, stack_darks
from gonio.errors import GeometryError, MeasurementError, ParameterError
from gonio.interfaces import Frame
from gonio.kinematics import Joints, jacobian
from gonio.radiometry import Bracket, Setup, image_irradiance, merge_bracket, read_bracket, reduce

DEG = np.pi / 180
BETA = 0.99
WHITE = Joints(30 * DEG, 15 * DEG, 0.0)


# ---- merging


def merge_trials(rate, seed, trials=60000, bits=12):
    """Many brackets of one pixel: EMVA camera, three exposures 8 apart. Returns merged rates and predicted sd."""
    rng = np.random.default_rng(seed)
    gain, read, offset, full = 0.25, 4.0, 64.0, 2**bits - 1
    t = np.array([0.002, 0.016, 0.128])
    electrons = rng.poisson((rate / gain * t)[:, None], (3, trials)) + read * rng.standard_normal((3, trials))
    counts = np.clip(np.rint(gain * electrons + offset), 0, full)
    merged = merge_bracket(counts - offset, t, (gain * read) ** 2 + 1 / 12, gain, 0.95 * full - offset)
    return merged.rate, np.sqrt(merged.variance)


@pytest.mark.parametrize("rate", [2e2, 1e3, 1e4, 2e4, 1e5, 2.2e5, 5e5, 1.5e6])
def test_merge_is_unbiased_and_predicts_its_scatter(rate):
    """Bias at most 0.2 %, scatter within 5 % of the prediction, from 25 DN in the longest exposure to near saturation."""
    merged, sd = merge_trials(rate, seed=int(rate))
    standard_error = merged.std() / np.sqrt(len(merged))
    assert abs(merged.mean() / rate - 1) <= 0.002 + 3 * standard_error / rate
    assert standard_error < 0.002 * rate
    assert 0.95 < np.sqrt(np.mean(sd**2)) / merged.std() < 1.05


def test_weights_from_the_noisy_pixel_would_be_biased():
    """The reason for iterating: at 13 DN the plug-in rule is 1.7 % low; the same trials merged are not."""
    rng = np.random.default_rng(12)
    gain, read, rate, t = 0.25, 4.0, 100.0, np.array([0.064, 0.096, 0.128])
    electrons = rng.poisson((rate / gain * t)[:, None], (3, 200000)) + read * rng.standard_normal((3, 200000))
    signal = np.rint(gain * electrons)
    plug_in = t[:, None] ** 2 / ((gain * read) ** 2 + 1 / 12 + gain * np.maximum(signal, 0))
    naive = (plug_in * signal / t[:, None]).sum(axis=0) / plug_in.sum(axis=0)
    merged = merge_bracket(signal, t, (gain * read) ** 2 + 1 / 12, gain, np.inf)
    assert naive.mean() / rate < 0.985
    assert merged.rate.mean() / rate == pytest.approx(1.0, abs=0.002)


@pytest.mark.parametrize("rate", [2.2e4, 2.5e4, 2.8e4, 2.95e4, 3.05e4, 3.5e4])
def test_region_is_unbiased_where_its_longest_exposure_begins_to_saturate(rate):
    """Which exposures count must not depend on the noise of the result: 0.95 of saturation is at 3e4 DN/s here."""
    rng = np.random.default_rng(int(rate))
    bench = Bench(rng=rng, shape=(12, 12))
    bench.full, bench.exposures = 4095, (0.002, 0.016, 0.128)
    darks = stack_darks(bench.darks())
    noise = CameraNoise(bench.gain, bench.read)
    found = []
    for _ in range(300):
        found.append(read_bracket([bench.frame(rate, t, 0.0) for t in bench.exposures], darks, noise, None))
    values, u = np.array([r.rate for r in found]), np.array([np.hypot(r.u_rate, r.u_dark) for r in found])
    assert np.isfinite(values).all() and all(r.used[1] for r in found)
    assert abs(values.mean() / rate - 1) < 5e-4
    assert 0.87 < np.std((values - rate) / u) < 1.13  # standard error 4 %


def test_saturated_exposures_do_not_count_and_none_left_is_nan():
    t = np.array([0.01, 0.1])
    rate = 2e4
    merged = merge_bracket(np.minimum(rate * t, 1000.0), t, 1.0, 0.25, 950.0)
    assert merged.weight[1] == 0.0 and merged.rate == rate
    none = merge_bracket([2000.0, 2000.0], t, 1.0, 0.25, 950.0)
    assert np.isnan(none.rate) and np.isnan(none.variance)


def test_negative_signals_are_kept():
    merged = merge_bracket([-1.0, -2.0], [0.01, 0.1], 1.0, 0.25, 1000.0)
    assert merged.rate < 0.0 and merged.variance > 0.0


# ---- a bench of the test's own


def rotation(axis, angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) if axis == "y" else np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


class Bench:
    """Light on a specimen, counts in a camera."""

    def __init__(self, zero=(0.0, 0.0, 0.0), beta_true=BETA, drift=0.0, rng=None, scale=4.0e6, shape=(32, 32)):
        self.zero, self.beta_true, self.drift, self.rng, self.scale, self.shape = zero, beta_true, drift, rng, scale, shape
        self.gain, self.read, self.offset, self.full = 0.25, 4.0, 64.0, 65535
        self.exposures = (0.002, 0.016)
        self.brdf = gonio.brdf.make("lambertian", albedo=0.5) + gonio.brdf.make("ggx", k_s=1.0, alpha=0.3, f_0=0.06)

    def rate(self, joints, specimen, time_s):
        """L_r cos-weighted: f_r cos theta_i at the true angles, times the lamp."""
        arm, pan, tilt = np.asarray(joints) + self.zero
        frame = rotation("y", pan) @ rotation("x", tilt)
        lamp = frame.T @ rotation("y", arm) @ [0, 0, 1]
        camera = frame.T @ [0, 0, 1]
        if lamp[2] <= 0 or camera[2] <= 0:
            return 0.0
        f_r = self.beta_true / np.pi if specimen == "white" else float(self.brdf.evaluate(lamp, camera))
        return self.scale * (1 + self.drift * time_s) * f_r * lamp[2]  # [DN/s]

    def frame(self, rate, exposure_s, time_s):
        level = rate * exposure_s
        if self.rng is None:
            ramp = (np.arange(np.prod(self.shape)) + 0.5) / np.prod(self.shape)
            counts = np.floor(level + self.offset + ramp.reshape(self.shape))
        else:
            electrons = self.rng.poisson(level / self.gain, self.shape)
            counts = np.rint(self.gain * (electrons + self.read * self.rng.standard_normal(self.shape)) + self.offset)
        data = np.clip(counts, 0, self.full).astype(np.uint16)
        return Frame(data, exposure_s, 1.0, time_s + 0.5 * exposure_s, 16, True, self.full, f"{exposure_s}")

    def bracket(self, joints, specimen="sample", time_s=0.0, pose=-1):
        rate = self.rate(joints, specimen, time_s)
        return Bracket([self.frame(rate, t, time_s) for t in self.exposures], Joints(*joints), pose)

    def darks(self, count=16):
        return [self.frame(0.0, t, 0.0) for t in self.exposures for _ in range(count)]

    def setup(self, **changes):
        known = {"beta": BETA, "u_beta": 0.005, "u_zero": (1e-3, 2e-3, 3e-3)} | changes
        return Setup(CameraNoise(self.gain, self.read), (0, 0, self.shape[1], self.shape[0]), **known)

    def scan(self, poses, times=None, white_times=(0.0,), white=WHITE, repeats=2, **changes):
        times = np.zeros(len(poses)) if times is None else times
        whites = [[self.bracket(white, "white", t) for _ in range(repeats)] for t in white_times]
        brackets = [self.bracket(j, "sample", t, k) for k, (j, t) in enumerate(zip(poses, times, strict=True))]
        return reduce(self.darks(), whites, brackets, self.setup(**changes))


def random_poses(n, seed):
    """Joint angles with lamp and camera at most 75 degrees from the normal."""
    rng = np.random.default_rng(seed)
    out = []
    while len(out) < n:
        joints = rng.uniform([-100 * DEG, -70 * DEG, -40 * DEG], [100 * DEG, 70 * DEG, 40 * DEG])
        arm, pan, tilt = joints
        if min(np.cos(tilt) * np.cos(arm - pan), np.cos(tilt) * np.cos(pan)) > np.cos(75 * DEG):
            out.append(joints)
    return np.array(out)


def test_lambertian_sample_gives_albedo_over_pi_at_every_angle():
    bench = Bench()
    bench.brdf = gonio.brdf.make("lambertian", albedo=0.4)
    samples = bench.scan(random_poses(40, 1))
    np.testing.assert_allclose(samples.f_r, 0.4 / np.pi, rtol=2e-6)
    assert samples.attributes["quantity"] == "brdf"
    assert [s.name for s in samples.shared] == ["scale", "arm", "pan", "tilt"]
    np.testing.assert_array_equal(samples.pose, np.arange(40))


def test_glossy_sample_without_errors_gives_its_own_brdf():
    bench = Bench()
    samples = bench.scan(random_poses(40, 2), white=Joints(-40 * DEG, 5 * DEG, 20 * DEG))
    expected = bench.brdf.f_r(samples.theta_i, samples.phi_i, samples.theta_r, samples.phi_r)
    np.testing.assert_allclose(samples.f_r, expected, rtol=5e-6)


def contract(bench, samples, delta):
    """The expected reading as gonio.samples defines it, for values `delta` of the shared errors."""
    omega_i = samples.omega_i() + samples.d_omega_i @ delta
    omega_r = samples.omega_r() + samples.d_omega_r @ delta
    omega_i /= np.linalg.norm(omega_i, axis=-1, keepdims=True)
    omega_r /= np.linalg.norm(omega_r, axis=-1, keepdims=True)
    return bench.brdf.evaluate(omega_i, omega_r) * np.exp(samples.d_ln_f @ delta)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("white", [WHITE, Joints(-40 * DEG, 5 * DEG, 20 * DEG)])
def test_zero_errors_act_as_the_sensitivities_say(axis, white):
    """Readings of a bench with a zero error against the contract: the rest is of second order in the error."""
    poses = random_poses(30, 3)
    worst = []
    for size in (4e-3, 2e-3):
        zero = np.zeros(3)
        zero[axis] = size
        bench = Bench(zero=zero)
        samples = bench.scan(poses, white=white)
        predicted = contract(bench, samples, np.array([0.0, *zero]))
        ignored = contract(bench, samples, np.zeros(4))
        worst.append(np.max(np.abs(samples.f_r / predicted - 1)))
        assert np.max(np.abs(samples.f_r / ignored - 1)) > 0.5 * size
        assert worst[-1] < 0.2 * np.max(np.abs(samples.f_r / ignored - 1))
    assert worst[0] < 100 * 4e-3**2
    assert worst[1] < 0.35 * worst[0]


def test_d_ln_f_alone_is_the_derivative_of_the_cosines():
    """On a Lambertian sample the directions do not matter, so the reading's slope is d_ln_f itself."""
    poses = random_poses(30, 4)
    for axis in range(3):
        f_r = []
        for sign in (1, -1):
            zero = np.zeros(3)
            zero[axis] = sign * 1e-3
            bench = Bench(zero=zero)
            bench.brdf = gonio.brdf.make("lambertian", albedo=0.4)
            samples = bench.scan(poses)
            f_r.append(samples.f_r)
        slope = (np.log(f_r[0]) - np.log(f_r[1])) / 2e-3
        np.testing.assert_allclose(slope, samples.d_ln_f[:, 1 + axis], atol=3e-3)
        jac = jacobian(*poses.T)[0]
        np.testing.assert_array_equal(samples.d_omega_i[:, :, 1:4], jac)


def test_a_wrong_white_scales_every_reading():
    bench = Bench(beta_true=BETA * 1.01)  # the white is brighter than certified, so all readings come out too low
    samples = bench.scan(random_poses(10, 5))
    expected = bench.brdf.f_r(samples.theta_i, samples.phi_i, samples.theta_r, samples.phi_r)
    np.testing.assert_allclose(samples.f_r * 1.01, expected, rtol=5e-6)
    np.testing.assert_array_equal(samples.d_ln_f[:, 0], 1.0)
    assert np.all(samples.d_omega_i[:, :, 0] == 0.0) and np.all(samples.d_omega_r[:, :, 0] == 0.0)


def test_prior_of_the_scale_holds_beta_and_the_whites_own_angles():
    samples = Bench().scan(random_poses(3, 6), u_encoder=5e-3, u_beta=0.004)
    tan = np.tan(15 * DEG)  # theta_i of the white: arm - pan, so both encoders matter; tilt does not at tilt = 0
    assert samples.shared[0].u == pytest.approx(np.sqrt(0.004**2 + 2 * (5e-3 * tan) ** 2), rel=1e-3)
    assert [s.u for s in samples.shared[1:]] == [1e-3, 2e-3, 3e-3]
    assert all(s.u_sample == 5e-3 and s.unit == "rad" for s in samples.shared[1:])
    default = Bench().scan(random_poses(3, 6))
    assert default.shared[1].u_sample == pytest.approx(360 / 4096 / np.sqrt(12) * DEG)


def test_linear_lamp_drift_is_corrected_and_its_uncertainty_shared():
    poses, times = random_poses(21, 7), np.linspace(0.0, 1000.0, 21)
    bench = Bench(drift=2e-5)
    samples = bench.scan(poses, times, white_times=(0.0, 1000.0))
    expected = bench.brdf.f_r(samples.theta_i, samples.phi_i, samples.theta_r, samples.phi_r)
    np.testing.assert_allclose(samples.f_r, expected, rtol=5e-6)
    drift = samples.shared[4]
    assert drift.name == "drift" and drift.u == pytest.approx(0.02 / 1.01 / np.sqrt(12), rel=1e-3)
    sensitivity = samples.d_ln_f[:, 4]
    assert sensitivity[[0, -1]] == pytest.approx([0.0, 0.0], abs=1e-3)
    assert sensitivity[10] == pytest.approx(1.0, rel=1e-3)
    # without the second block the same scan is wrong by the drift
    held = bench.scan(poses, times, white_times=(0.0,))
    assert held.f_r[-1] / expected[-1] == pytest.approx(1.02, rel=1e-4)
    assert held.attributes["white_not_bracketed"] == "20"


def test_noise_of_the_samples_is_that_predicted():
    """3000 samples of three geometries by the noisy camera: unbiased, and scattered as u_f_r says."""
    bench = Bench(rng=np.random.default_rng(8), shape=(6, 6), scale=2e6)
    three = np.radians([[60.0, 30.0, 0.0], [20.0, -40.0, 10.0], [80.0, 10.0, 5.0]])
    samples = bench.scan(np.repeat(three, 1000, axis=0), repeats=200)
    expected = bench.brdf.f_r(samples.theta_i, samples.phi_i, samples.theta_r, samples.phi_r)
    pulls = ((samples.f_r - expected) / samples.u_f_r).reshape(3, 1000)
    ratio = pulls.std(axis=1)
    assert np.all((ratio > 0.92) & (ratio < 1.08))  # standard error of a standard deviation: 2.2 %
    for k in range(3):
        mean = samples.f_r[1000 * k : 1000 * (k + 1)].mean() / expected[1000 * k] - 1
        assert abs(mean) < 4 * np.hypot(np.mean(samples.u_f_r / samples.f_r) / np.sqrt(1000), 3e-4)
    assert samples.attributes["gain_origin"] == "nominal"


def test_a_wrong_nominal_gain_is_found_from_the_whites_repeats():
    bench = Bench(rng=np.random.default_rng(9), shape=(16, 16))
    setup = bench.setup()
    wrong = Setup(CameraNoise(0.5, 2.0), setup.roi, setup.beta, setup.u_beta, setup.u_zero)
    whites = [[bench.bracket(WHITE, "white") for _ in range(20)]]
    samples = reduce(bench.darks(), whites, [bench.bracket(WHITE, pose=0)], wrong)
    assert samples.attributes["gain_origin"] == "measured"
    assert float(samples.attributes["gain_dn_per_e"]) == pytest.approx(0.25, rel=0.08)


# ---- what is refused or left out


def test_saturated_poses_are_left_out_and_counted():
    bench = Bench(scale=3e7)
    bench.brdf = gonio.brdf.make("lambertian", albedo=0.1) + gonio.brdf.make("ggx", k_s=1.0, alpha=0.05, f_0=0.9)
    bench.exposures = (0.001, 0.004)
    mirror, aside = (50 * DEG, 25 * DEG, 0.0), (10 * DEG, -50 * DEG, 0.0)
    samples = bench.scan([mirror, aside])
    assert list(samples.pose) == [1]
    assert samples.attributes["left_out_saturated"] == "1 (poses 0)"
    assert samples.attributes["poses"] == "2"
    with pytest.raises(MeasurementError, match="1 are saturated in every exposure"):
        bench.scan([mirror])


def test_poses_behind_the_surface_are_left_out_and_counted():
    samples = Bench().scan([(30 * DEG, 15 * DEG, 0.0), (80 * DEG, -20 * DEG, 0.0)])
    assert list(samples.pose) == [0]
    assert samples.attributes["left_out_behind"] == "1 (poses 1)"


def test_a_black_sample_keeps_negative_readings():
    bench = Bench(rng=np.random.default_rng(10), shape=(4, 4))
    bench.brdf = gonio.brdf.make("lambertian", albedo=0.0)
    samples = bench.scan(random_poses(200, 11))
    assert np.sum(samples.f_r < 0) > 50
    assert abs(np.mean(samples.f_r / samples.u_f_r)) < 0.5


def test_a_curved_camera_is_refused():
    class Curved(Bench):
        def frame(self, rate, exposure_s, time_s):
            return super().frame(rate * (1 - rate * exposure_s / 1e6), exposure_s, time_s)

    with pytest.raises(MeasurementError, match="not linear"):
        Curved().scan(random_poses(10, 12))


def test_frames_without_darks_of_their_kind_are_refused():
    bench = Bench()
    darks = stack_darks(bench.darks(2))
    noise = CameraNoise(bench.gain, bench.read)
    with pytest.raises(MeasurementError, match=r"0\.5 s and no dark frames of it .*0\.002 s, 0\.016 s"):
        read_bracket([bench.frame(1.0, 0.5, 0.0)], darks, noise, None)
    gamma = Frame(np.zeros((32, 32), np.uint16), 0.002, 1.0, 0.0, 16, False, 65535, "pose 3 exposure 0")
    with pytest.raises(MeasurementError, match=r"pose 3 exposure 0.*gamma"):
        read_bracket([gamma], darks, noise, None)
    loud = Frame(np.zeros((32, 32), np.uint16), 0.002, 2.0, 0.0, 16, True, 65535, "x")
    with pytest.raises(MeasurementError, match="gain 2"):
        read_bracket([loud], darks, noise, None)
    with pytest.raises(MeasurementError, match="no frame"):
        read_bracket([], darks, noise, None)


def test_a_scan_without_white_or_with_the_white_turned_away_is_refused():
    bench = Bench()
    with pytest.raises(MeasurementError, match="no white"):
        bench.scan(random_poses(2, 13), white_times=())
    with pytest.raises(MeasurementError, match="white"):
        bench.scan(random_poses(2, 13), white=Joints(80 * DEG, -20 * DEG, 0.0))


def test_time_of_a_reading_is_the_middle_of_its_exposures():
    bench = Bench()
    darks = stack_darks(bench.darks(2))
    reading = read_bracket(bench.bracket(WHITE, time_s=7.0).frames, darks, CameraNoise(0.25, 4.0), None)
    assert reading.time_s == pytest.approx(7.0, abs=1e-12)
    assert reading.used.all()


def test_progress_counts_the_poses():
    bench, calls = Bench(), []
    poses = (bench.bracket(WHITE, pose=k) for k in range(3))
    whites = [[bench.bracket(WHITE, "white")]]
    reduce(bench.darks(2), whites, poses, bench.setup(), total=3, progress=lambda *a: calls.append(a))
    assert calls == [("reduce", 1, 3), ("reduce", 2, 3), ("reduce", 3, 3)]


# ---- image irradiance


def test_image_irradiance_against_the_solid_angle_of_the_lens():
    """E = L times the projected solid angle of a small lens: cos^4 off axis, two for distance, one for each tilt."""
    radius, distance = 1e-4, 1.0
    for alpha in (0.0, 0.3, 0.9):
        slant = distance / np.cos(alpha)
        expected = 5.0 * np.pi * radius**2 * np.cos(alpha) / slant**2 * np.cos(alpha)
        assert image_irradiance(5.0, 2 * radius, distance, alpha) == pytest.approx(expected, rel=1e-12)


def test_image_irradiance_refuses_no_lens_and_rays_from_behind():
    with pytest.raises(ParameterError):
        image_irradiance(1.0, 0.0, 1.0)
    with pytest.raises(GeometryError):
        image_irradiance(1.0, 1.0, 1.0, np.pi / 2)
