"""The simulated camera: its noise against the EMVA 1288 model, its clock, and the messages that carry its frames."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gonio.errors import DeviceError, ProtocolError
from gonio.interfaces import Camera
from sim.camera import MessageParser, decode_frame, encode_frame, encode_message
from sim.serve import Simulation

GAIN, READ_NOISE, OFFSET = 0.25, 4.0, 64.0


def rig(seed=1, lamp=True, specimen="white", **truth):
    simulation = Simulation({"sim": {"seed": seed, "truth": {"errors": False, "backlash_deg": 0.0, **truth}}})
    if lamp:
        simulation.lamp.feed(b"OUTP ON\n", 0.0)
    simulation.camera.mount(specimen)
    return simulation


def test_photon_transfer_gives_gain_and_read_noise_put_in():
    """Rationale: half the variance of a difference of two like frames against their mean is a line.

    Expected: its slope is the gain K, its intercept K^2 sigma_d^2 + 1/12 (read noise and quantisation).
    """
    camera = rig(lamp_drift_per_hour=0.0, dark_current_e_s=0.0).camera
    means, variances = [], []
    for exposure in (1e-5, *np.linspace(0.001, 0.036, 12)):
        for k in range(3):
            a, b = (camera.capture(exposure, label=f"{exposure} {k} {side}").data.astype(float) for side in "ab")
            means.append(0.5 * (a + b).mean() - OFFSET)
            variances.append(np.mean((a - b) ** 2) / 2)
    weights = 1 / np.array(variances)  # the variance of a variance goes with its square
    slope, intercept = np.polyfit(means, variances, 1, w=weights)
    assert slope == pytest.approx(GAIN, rel=0.005)
    assert intercept == pytest.approx((GAIN * READ_NOISE) ** 2 + 1 / 12, rel=0.03)


def test_mean_counts_are_those_of_radiance_times_exposure():
    """Expected at the image's centre: K (R beta / pi I / d^2 + dark) t + offset, R the responsivity."""
    camera = rig(lamp_drift_per_hour=0.0).camera
    centre = np.mean([camera.capture(0.016, label=f"mean {k}").data[58:62, 78:82] for k in range(100)])
    rate = 3.25e5 * 0.99 / math.pi / 0.5**2
    expected = GAIN * (rate + 20.0) * 0.016 + OFFSET
    assert centre == pytest.approx(expected, abs=4 * math.sqrt(GAIN * expected / 1600))
    assert 0.35 < centre / 4095 < 0.45  # a white at normal incidence fills 40 % of the range


def test_dark_frames_have_offset_dark_current_and_read_noise():
    camera = rig(lamp=False, dark_current_e_s=200.0).camera
    dark = np.stack([camera.capture(0.128, label=f"dark 2 {k}").data.astype(float) for k in range(16)])
    variance = GAIN**2 * (READ_NOISE**2 + 200 * 0.128) + 1 / 12
    assert dark.mean() == pytest.approx(OFFSET + GAIN * 200 * 0.128, abs=4 * math.sqrt(variance / dark.size))
    assert dark.var() == pytest.approx(variance, rel=0.01)


def test_noise_belongs_to_the_label_and_not_to_the_order():
    """Rationale: a resumed scan must see the noise that it would have seen."""
    labels = ["dark 0 0", "pose 0 exposure 0", "pose 0 exposure 1", "pose 1 exposure 0"]
    first, second = rig(lamp=False), rig(lamp=False)
    forward = {label: first.camera.capture(0.016, label=label).data for label in labels}
    backward = {label: second.camera.capture(0.016, label=label).data for label in reversed(labels)}
    for label in labels:
        np.testing.assert_array_equal(forward[label], backward[label])
    flat = np.stack([forward[label].ravel() for label in labels]).astype(float)
    assert np.all(np.abs(np.corrcoef(flat) - np.eye(4)) < 5 / math.sqrt(flat.shape[1]))
    other_seed = rig(seed=2, lamp=False).camera.capture(0.016, label=labels[0]).data
    assert np.any(other_seed != forward[labels[0]])


def test_the_converter_saturates_at_all_bits_set():
    frame = rig().camera.capture(0.128, label="white")
    assert frame.saturation_dn == frame.data.max() == 4095
    assert frame.data.dtype == np.uint16 and frame.bit_depth == 12 and frame.linear


def test_an_exposure_takes_its_time_and_sees_its_middle():
    simulation = rig(specimen="sample")
    pan = simulation.servos["pan"]
    pan.write(64, b"\x01", 0.0)
    pan.write(112, (200).to_bytes(4, "little"), 0.0)  # profile velocity, about 275 degrees/s
    pan.write(116, (2748).to_bytes(4, "little"), 0.0)
    frame = simulation.camera.capture(0.1, label="moving")
    assert frame.timestamp_s == simulation.clock.now() == pytest.approx(0.1)
    np.testing.assert_array_equal(frame.data, simulation.camera.expose(0.05, 0.1, "moving"))
    assert np.any(frame.data != simulation.camera.expose(0.0, 0.1, "moving"))


def test_veiling_glare_spreads_light_and_keeps_its_sum():
    """Expected: x = (1 - g) x0 + g mean(x0): a small specimen's image keeps its mean, the background gets g of it."""
    parts = {"specimen_radius_mm": 5.0, "lamp_drift_per_hour": 0.0}
    clean, veiled = (
        np.mean([r.camera.capture(0.016, label=str(k)).data for k in range(20)], axis=0) - OFFSET
        for r in (rig(**parts), rig(**parts, veiling_glare=0.1))
    )
    assert veiled.mean() == pytest.approx(clean.mean(), rel=2e-3)
    assert veiled[:10].mean() - clean[:10].mean() == pytest.approx(0.1 * clean.mean(), rel=0.03)


@pytest.mark.parametrize("exposure", [0.0, -1.0, 61.0, math.nan])
def test_impossible_exposures_are_refused(exposure):
    with pytest.raises(DeviceError, match="cannot expose"):
        rig().camera.capture(exposure, label="x")


def test_it_is_a_camera():
    assert isinstance(rig().camera, Camera)


# ---- messages ------------------------------------------------------------------------------------------------------


def test_a_frame_survives_its_message_whole_and_byte_by_byte():
    frame = rig().camera.capture(0.016, label="pose 3 exposure 1")
    data = encode_frame(frame) + encode_message({"ok": True})
    whole = MessageParser().receive(data)
    parser = MessageParser()
    pieces = [message for k in range(len(data)) for message in parser.receive(data[k : k + 1])]
    assert whole == pieces and len(whole) == 2
    again = decode_frame(*whole[0])
    np.testing.assert_array_equal(again.data, frame.data)
    assert (again.exposure_s, again.label, again.timestamp_s) == (0.016, "pose 3 exposure 1", frame.timestamp_s)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(st.binary(max_size=64), st.integers(0, 300))
def test_any_bytes_are_messages_or_a_protocol_error(tail, cut):
    good = encode_message({"ok": True, "text": "x" * 50}, b"payload")
    parser = MessageParser()
    try:
        parser.receive(good[:cut] + tail)
    except ProtocolError:
        return


@pytest.mark.parametrize(
    "change", [{"shape": [3, 3]}, {"shape": [0, 0]}, {"shape": 7}, {"exposure_s": None}, {"metadata": 3}], ids=repr
)
def test_a_frame_that_does_not_fit_its_header_is_refused(change):
    ((header, payload),) = MessageParser().receive(encode_frame(rig().camera.capture(0.016, label="x")))
    with pytest.raises(ProtocolError):
        decode_frame({**header, **change}, payload)
