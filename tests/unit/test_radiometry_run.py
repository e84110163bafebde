"""Reducing a run from its journal: the real store, frames whose content is known."""

from __future__ import annotations

import numpy as np
import pytest

from gonio import config
from gonio.errors import MeasurementError
from gonio.interfaces import Frame
from gonio.radiometry import reduce_run
from gonio.scan.records import BlockRecord, PoseRecord
from gonio.scan.store import Run

EXPOSURES = (0.002, 0.016, 0.128)
OFFSET = 64
WHITE_RATE = 20000.0  # [DN/s] at theta_i = 15 degrees


def frame(rate, exposure_s, label):
    level = min(rate * exposure_s + OFFSET, 4095.0)
    ramp = ((np.arange(19200) * 0.6180339887498949) % 1.0).reshape(120, 160)  # dithers: any region has the mean `level`
    data = np.minimum(np.floor(level + ramp), 4095).astype(np.uint16)
    return Frame(data, exposure_s, 1.0, 5.0, 12, True, 4095, label, {"camera": "test"})


def joints(arm, pan, tilt=0.0):
    return {"arm": np.radians(arm), "pan": np.radians(pan), "tilt": np.radians(tilt)}


def fill(run, poses, white_times=(0.0, 100.0)):
    for e, t in enumerate(EXPOSURES):
        frames = [frame(0.0, t, f"dark {e} {k}") for k in range(4)]
        run.commit_block(BlockRecord("dark", e, {}, 0.0, 0, (t,), 4, False), frames)
    for block, time_s in enumerate(white_times):
        rate = WHITE_RATE * (1 + 1e-4 * time_s)
        frames = [frame(rate, t, f"white {block} {r} exposure {e}") for r in range(2) for e, t in enumerate(EXPOSURES)]
        run.commit_block(BlockRecord("white", block, joints(30, 15), time_s, 0, EXPOSURES, 2, True), frames)
    for index, (angles, rate, time_s) in enumerate(poses):
        record = PoseRecord(index, 0.1, 0.1, 3.1, joints(0, 0), angles, {}, time_s, 0)  # the goals are wrong on purpose
        run.commit_pose(record, [frame(rate, t, f"pose {index} exposure {e}") for e, t in enumerate(EXPOSURES)])


@pytest.fixture
def run(tmp_path):
    with Run.create(tmp_path / "run", kind="scan", documents=config.default_documents()) as run:
        yield run


def scale_by_hand(rig, repeats):
    """Certificate, photon and read noise of a white block (EMVA 1288: variance K S + K^2 sigma_d^2 + 1/12 per pixel; the
    exposures weighted by their precision), and encoders that round, at the white's angles: d ln cos(arm - pan) = tan 15 deg.
    """
    camera, (_, _, width, height) = rig.camera, rig.camera.roi
    gain, t = camera.gain_dn_per_e, np.array(EXPOSURES)
    per_pixel = gain * WHITE_RATE * t + (gain * camera.read_noise_e) ** 2 + 1 / 12
    photons = 1 / np.sqrt(repeats * width * height * np.sum(t**2 / per_pixel)) / WHITE_RATE
    encoders = np.sqrt(2) * np.tan(np.radians(15)) * (2 * np.pi / 4096) / np.sqrt(12)
    return np.sqrt(rig.white.u_beta**2 + photons**2 + encoders**2)


def test_samples_come_from_measured_angles_and_the_drifting_white(run):
    """A sample that reads half the white's rate, at the white's angles and at others."""
    rig = config.parse_rig(run.document("rig.toml"))
    fill(run, [(joints(30, 15), 1e4, 0.0), (joints(60, 0), 1e4, 100.0), (joints(20, -40, 10), 5e3, 50.0)])
    calls = []
    samples = reduce_run(run, rig, lambda *a: calls.append(a))
    cos_i = [np.cos(np.radians(15)), 0.5, np.cos(np.radians(60)) * np.cos(np.radians(10))]
    ratio = np.array([0.5, 0.5 / 1.01, 0.25 / 1.005]) * np.cos(np.radians(15)) / cos_i
    np.testing.assert_allclose(samples.f_r, ratio * rig.white.beta / np.pi, rtol=2e-4)
    assert samples.theta_i == pytest.approx(np.arccos(cos_i))
    assert samples.theta_r[:2] == pytest.approx(np.radians([15, 0]), abs=1e-12)
    assert calls[-1] == ("reduce", 3, 3)
    assert [s.name for s in samples.shared] == ["scale", "arm", "pan", "tilt", "drift"]
    assert samples.shared[0].u == pytest.approx(scale_by_hand(rig, repeats=2), rel=2e-3)
    assert samples.shared[1].u == pytest.approx(np.radians(0.1))
    assert samples.attributes["rig"] == rig.name and samples.attributes["white_not_bracketed"] == "0"


def test_samples_survive_the_journal_and_come_out_the_same_twice(run):
    rig = config.parse_rig(run.document("rig.toml"))
    fill(run, [(joints(30, 15), 1e4, 20.0), (joints(60, 10, -5), 2e3, 40.0)])
    first, second = reduce_run(run, rig), reduce_run(run, rig)
    run.write_samples(first)
    back = run.read_samples()
    for name in ("f_r", "u_f_r", "d_ln_f", "d_omega_i", "d_omega_r", "theta_i", "phi_r", "pose"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
        np.testing.assert_array_equal(getattr(first, name), getattr(back, name))
    assert back.attributes == first.attributes and back.shared == first.shared


def test_a_run_without_poses_or_white_is_refused(run):
    rig = config.parse_rig(run.document("rig.toml"))
    with pytest.raises(MeasurementError, match="no completed pose"):
        reduce_run(run, rig)
    fill(run, [(joints(30, 15), 1e4, 0.0)], white_times=())
    with pytest.raises(MeasurementError, match="no white"):
        reduce_run(run, rig)


def test_a_white_block_of_broken_brackets_is_refused(run):
    rig = config.parse_rig(run.document("rig.toml"))
    fill(run, [(joints(30, 15), 1e4, 0.0)])
    record = BlockRecord("white", 7, joints(30, 15), 200.0, 0, EXPOSURES, 2, True)
    run.commit_block(record, [frame(1e4, t, f"white 7 0 exposure {e}") for e, t in enumerate(EXPOSURES[:2])])
    with pytest.raises(MeasurementError, match="white block 7 holds 2 frames"):
        reduce_run(run, rig)
