"""The simulated camera as drivers and OpenCV see it: streams with old frames, exposure controls, files, motion JPEG."""

from __future__ import annotations

import math
import threading

import cv2
import numpy as np
import pytest

from drivers.opencv_camera import OpenCVCamera
from gonio.errors import ConfigurationError, DeviceError, MeasurementError
from sim.board import charuco
from sim.capture import PROFILES, SimCapture, write_images
from sim.clock import ScaledClock
from sim.links import Pump
from sim.mjpeg import MjpegLink
from sim.serve import Simulation

DARK = 100.0  # counts that the covered sensor never reaches


def bench(specimen="white", clock=None, camera=None, **truth):
    sizes = {"width": 32, "height": 24, "pixel_mm": 1.0, "errors": False, "lamp_drift_per_hour": 0.0, "backlash_deg": 0.0}
    simulation = Simulation({"camera": camera or {}, "sim": {"truth": {**sizes, **truth}}}, clock=clock)
    simulation.lamp.feed(b"OUTP ON\n", 0.0)
    simulation.camera.mount(specimen)
    return simulation


def stream(simulation, profile="v4l2"):
    return SimCapture(simulation.camera, simulation.clock, profile)


def manual(capture, value):
    assert capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, 1.0) and capture.set(cv2.CAP_PROP_EXPOSURE, value)
    assert capture.set(cv2.CAP_PROP_CONVERT_RGB, 0.0)


@pytest.mark.parametrize("profile", ["v4l2", "dshow"])
def test_a_driver_waits_for_old_frames_and_new_exposures(profile):
    """Rationale: the driver's whole way with a live camera. Expected: counts go with the exposure that it reports."""
    simulation = bench()
    capture = stream(simulation, profile)
    camera = OpenCVCamera(
        0, backend=profile, clock=simulation.clock, bit_depth=12, linear=True, stale_frames=PROFILES[profile].buffers
        + PROFILES[profile].latency, open_capture=lambda device, backend: capture,
    )  # fmt: skip
    exposures = (0.004, 0.016) if profile == "v4l2" else (2.0**-8, 2.0**-6)
    signals = []
    for exposure in exposures:
        simulation.clock.sleep(1.0)  # frames grow old
        frame = camera.capture(exposure, label="x")
        assert frame.exposure_s == pytest.approx(exposure) and frame.data.dtype == np.uint16
        signals.append(frame.data[10:14, 14:18].mean() - 64.0)
    assert signals[1] / signals[0] == pytest.approx(exposures[1] / exposures[0], rel=0.02)


@pytest.mark.parametrize(("profile", "stale"), [("v4l2", 4), ("dshow", 2)])
def test_frames_that_nobody_took_come_first(profile, stale):
    """Expected: as many old frames as the backend has buffers, showing what was there then, and then the present."""
    simulation = bench()
    capture = stream(simulation, profile)
    assert capture.read()[0]
    simulation.clock.sleep(1.0001)  # just into an exposure, whose middle is still to come
    simulation.camera.mount("trap")
    bright = [capture.read()[1].mean() > DARK for _ in range(stale + 2)]
    assert bright == [True] * stale + [False] * 2


def test_fewer_buffers_leave_fewer_old_frames():
    simulation = bench()
    capture = stream(simulation)
    manual(capture, 100)
    assert capture.set(cv2.CAP_PROP_BUFFERSIZE, 1.0) and capture.get(cv2.CAP_PROP_BUFFERSIZE) == 1.0
    simulation.clock.sleep(1.0)
    simulation.camera.mount("trap")
    assert [capture.read()[1].mean() > DARK for _ in range(3)] == [True, False, False]
    assert not stream(bench(), "dshow").set(cv2.CAP_PROP_BUFFERSIZE, 1.0)


def test_a_new_exposure_takes_frames_to_arrive():
    simulation = bench()
    capture = stream(simulation)
    manual(capture, 20)
    for _ in range(6):
        capture.grab()
    before = capture.read()[1].mean()
    assert capture.set(cv2.CAP_PROP_EXPOSURE, 100)
    levels = [capture.read()[1].mean() > 2 * before for _ in range(4)]
    assert levels == [False] * (PROFILES["v4l2"].latency - 1) + [True] * (5 - PROFILES["v4l2"].latency)


def test_automatic_exposure_is_on_until_it_is_switched_off():
    """Expected: it aims at 45 % of full scale whatever the light; locked controls; then counts follow the light."""
    simulation = bench(responsivity=3e6)
    capture = stream(simulation)
    assert capture.get(cv2.CAP_PROP_AUTO_EXPOSURE) == 3.0
    assert not capture.set(cv2.CAP_PROP_EXPOSURE, 100)
    capture.set(cv2.CAP_PROP_CONVERT_RGB, 0.0)

    def level():
        for _ in range(8):
            capture.grab()
        return capture.read()[1].mean() - 64.0

    full = level()
    assert full == pytest.approx(0.45 * (4095 - 64), rel=0.05)
    simulation.lamp.feed(b"SOUR:LEV 0.5\n", simulation.clock.now())
    assert level() == pytest.approx(full, rel=0.05)
    assert capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, 1.0)
    held = level()
    simulation.lamp.feed(b"SOUR:LEV 0.25\n", simulation.clock.now())
    assert level() == pytest.approx(0.5 * held, rel=0.05)


def test_exposures_have_the_units_and_limits_of_their_backend():
    v4l2, dshow = stream(bench()), stream(bench(), "dshow")
    manual(v4l2, 200)
    assert v4l2.get(cv2.CAP_PROP_EXPOSURE) == 200.0
    assert [v4l2.set(cv2.CAP_PROP_EXPOSURE, value) for value in (0, 334, 333, 1.5)] == [False, False, True, False]
    assert dshow.get(cv2.CAP_PROP_AUTO_EXPOSURE) == -1.0 and not dshow.set(cv2.CAP_PROP_AUTO_EXPOSURE, 0.25)
    assert [dshow.set(cv2.CAP_PROP_EXPOSURE, value) for value in (-6, -4)] == [True, False]
    assert dshow.get(cv2.CAP_PROP_EXPOSURE) == -6.0


def test_a_gamma_curve_is_found_out_and_can_be_switched_off():
    simulation = bench(response="gamma")
    capture = stream(simulation)
    assert capture.get(cv2.CAP_PROP_GAMMA) == 220.0 and not simulation.camera.describe()["linear"]
    assert capture.set(cv2.CAP_PROP_GAMMA, 100.0) and capture.get(cv2.CAP_PROP_GAMMA) == 100.0
    manual(capture, 40)
    assert capture.set(cv2.CAP_PROP_GAIN, 2.0) and not capture.set(cv2.CAP_PROP_GAIN, 99.0)
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(30.0)


def test_old_frames_show_the_motor_where_it_was():
    """Rationale: what makes a stale frame dangerous is that it shows another angle."""
    simulation = bench("sample")
    capture = stream(simulation)
    manual(capture, 100)
    arm = simulation.servos["arm"]
    arm.write(64, b"\x01", simulation.clock.now())
    arm.write(116, (3000).to_bytes(4, "little"), simulation.clock.now())
    simulation.clock.sleep(3.0)
    capture.read()
    capture.read()
    shown = [entry["angles_deg"]["arm"] for entry in simulation.camera.log]
    assert shown[0] == pytest.approx(0.0, abs=10.0) and shown[1] > shown[0]
    for _ in range(3):
        capture.read()
    assert simulation.camera.log[-1]["angles_deg"]["arm"] == pytest.approx(83.7, abs=0.6)


def test_eight_bits_in_colour_unless_raw_is_asked_for():
    capture = stream(bench())
    frame = capture.read()[1]
    assert (frame.dtype, frame.shape) == (np.uint8, (24, 32, 3))
    capture.release()
    assert capture.read() == (False, None) and not capture.isOpened()
    with pytest.raises(ConfigurationError, match="no backend profile 'msmf'"):
        stream(bench(), "msmf")


def test_the_truth_is_logged_with_every_frame():
    simulation = bench("sample")
    simulation.camera.capture(0.016, label="pose 0")
    (entry,) = simulation.camera.log
    assert entry == {
        "label": "pose 0", "exposure_s": 0.016, "t_s": 0.008, "specimen": "sample", "lamp": 1.0,
        "angles_deg": {name: pytest.approx(0.0, abs=1e-9) for name in ("arm", "pan", "tilt")},
    }  # fmt: skip


# ---- real OpenCV ---------------------------------------------------------------------------------------------------


def test_sixteen_bit_sequences_reach_opencv_exactly(tmp_path):
    simulation = bench(camera={"bit_depth": 16, "gain_dn_per_e": 4.0})
    pattern = str(tmp_path / "frame_%04d.png")
    again = bench(camera={"bit_depth": 16, "gain_dn_per_e": 4.0})
    shots = [(0.016, f"shot {k}") for k in range(3)]
    assert len(write_images(simulation.camera, pattern, shots)) == 3
    capture = cv2.VideoCapture(pattern, cv2.CAP_IMAGES)
    for exposure, label in shots:
        ok, data = capture.read()
        assert ok and data.dtype == np.uint16
        np.testing.assert_array_equal(data.squeeze(), again.camera.capture(exposure, label=label).data)
    assert not capture.read()[0]
    driver = OpenCVCamera(
        pattern, backend="images", clock=simulation.clock, exposure="fixed", fixed_exposure_s=0.016, bit_depth=16,
    )
    assert driver.capture(0.016, label="x").saturation_dn == 65535
    with pytest.raises(DeviceError, match="cannot be written"):
        write_images(simulation.camera, tmp_path / "missing" / "%d.png", shots[:1])


def test_motion_jpeg_over_http_reaches_opencv_with_old_frames():
    """Expected: frames that were sent before the specimen changed come first, whatever OpenCV's buffers; then the dark."""
    clock = ScaledClock(20.0)
    simulation = bench(clock=clock)
    link = MjpegLink(simulation.camera, clock)
    ahead, wanted = threading.Event(), [10]
    picture = link.picture

    def counted():
        if link.frames >= wanted[0]:
            ahead.set()
        return picture()

    link.picture = counted
    pump, stop = Pump(link), threading.Event()
    thread = threading.Thread(target=pump.run, args=(stop.is_set, 0.005))
    thread.start()
    try:
        capture = cv2.VideoCapture(link.url, cv2.CAP_FFMPEG)
        assert capture.isOpened() and capture.read()[0]
        ahead.clear()
        wanted[0] = link.frames + 20
        assert ahead.wait(30.0)
        simulation.camera.mount("trap")
        assert capture.read()[1].mean() > 20.0  # of the bright specimen
        levels = [capture.read()[1].mean()]
        while levels[-1] > 20.0 and len(levels) < 2000:
            levels.append(capture.read()[1].mean())
        assert 2 <= len(levels) < 2000
        capture.release()
    finally:
        stop.set()
        thread.join()
        pump.close()


def test_the_board_is_found_by_opencvs_detector_where_it_is():
    """Expected: all corners, within 0.2 pixels of where pan and tilt and the pinhole put them."""
    simulation = bench("board", width=480, height=360, pixel_mm=0.1, psf_sigma_px=0.7)
    pan, tilt = simulation.servos["pan"], simulation.servos["tilt"]
    for servo, counts in ((pan, 2048 + 200), (tilt, 2048 - 150)):
        servo.write(64, b"\x01", 0.0)
        servo.write(116, counts.to_bytes(4, "little"), 0.0)
    simulation.clock.sleep(5.0)
    frame = simulation.camera.capture(0.02, label="board").data
    image = (frame >> 4).astype(np.uint8)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(charuco(8, 6, 4.0)).detectBoard(image)
    corners, ids = corners.reshape(-1, 2), ids.ravel()
    assert len(ids) == 7 * 5
    angles = {name: math.radians(a) for name, a in simulation.camera.log[-1]["angles_deg"].items()}
    cp, sp, ct, st = (f(angles[n]) for n in ("pan", "tilt") for f in (math.cos, math.sin))
    for (u, v), number in zip(corners, ids, strict=True):
        x, y = 4.0 * (number % 7 + 1) - 16.0, 12.0 - 4.0 * (number // 7 + 1)
        # R_y(pan) R_x(tilt) (x, y, 0), then through the pinhole at 600 mm onto z = 0
        place = np.array([cp * x + sp * st * y, ct * y, -sp * x + cp * st * y])
        seen = place[:2] * 600 / (600 - place[2])
        assert (u, v) == pytest.approx((seen[0] / 0.1 + 239.5, 179.5 - seen[1] / 0.1), abs=0.2)


@pytest.mark.parametrize("profile", ["v4l2", "dshow"])
def test_late_frames_are_found_with_the_lamp(profile):
    """Rationale: the driver may not know how late a camera's frames are. Expected: it finds out, and may then hurry."""
    simulation = bench()
    capture = stream(simulation, profile)
    camera = OpenCVCamera(
        0, backend=profile, clock=simulation.clock, bit_depth=12, open_capture=lambda device, backend: capture
    )

    def light(on):
        simulation.lamp.feed(b"OUTP ON\n" if on else b"OUTP OFF\n", simulation.clock.now())

    exposure_s = 0.016 if profile == "v4l2" else 2.0**-6
    assert 1 <= camera.measure_late(light, exposure_s) <= 3
    simulation.clock.sleep(1.0)
    simulation.camera.mount("trap")
    assert camera.capture(exposure_s, label="trap").data.mean() < DARK
    with pytest.raises(MeasurementError, match="does not show whether the light is on"):
        camera.measure_late(light, exposure_s)
