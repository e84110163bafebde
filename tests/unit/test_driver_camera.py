"""The OpenCV camera: real image files through cv2, and a stand-in for the hardware that no test machine has.

The stand-in sits where ``cv2.VideoCapture`` sits and models what cameras really do: units of the backend, a queue of old
frames, an exposure that takes frames to arrive, automatic exposure that is on. It does not model noise.
"""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.opencv_camera import OpenCVCamera
from gonio.errors import ConfigurationError, DeviceError
from gonio.interfaces import Camera
from sim.clock import VirtualClock

cv2 = pytest.importorskip("cv2")


# -- image files


def sequence(folder: Path, count: int, dtype: Any = np.uint16, channels: int = 1) -> tuple[str, list[np.ndarray[Any, Any]]]:
    rng = np.random.default_rng(5)
    shape = (6, 8) if channels == 1 else (6, 8, channels)
    images = [rng.integers(0, np.iinfo(dtype).max, shape, dtype=dtype, endpoint=True) for _ in range(count)]
    for k, image in enumerate(images):
        assert cv2.imwrite(str(folder / f"frame_{k:04d}.png"), image)
    return str(folder / "frame_%04d.png"), images


def files(pattern: str, **changes: Any) -> OpenCVCamera:
    options: dict[str, Any] = {"backend": "images", "exposure": "fixed", "fixed_exposure_s": 0.016, "clock": VirtualClock()}
    return OpenCVCamera(pattern, **(options | changes))


def test_sixteen_bits_arrive_exactly(tmp_path: Path) -> None:
    pattern, images = sequence(tmp_path, 3)
    camera = files(pattern)
    assert isinstance(camera, Camera)
    for k, image in enumerate(images):
        frame = camera.capture(0.016, label=f"pose {k}")
        np.testing.assert_array_equal(frame.data, image)
        assert frame.data.dtype == np.uint16
        assert (frame.bit_depth, frame.saturation_dn, frame.exposure_s) == (16, 65535, 0.016)
        assert frame.label == f"pose {k}"
        assert not frame.linear
    with pytest.raises(DeviceError, match="no more images"):
        camera.capture(0.016, label="one too many")
    camera.close()


def test_eight_bits_stay_eight(tmp_path: Path) -> None:
    pattern, images = sequence(tmp_path, 1, np.uint8)
    frame = files(pattern, linear=True).capture(0.016, label="")
    np.testing.assert_array_equal(frame.data, images[0])
    assert (frame.bit_depth, frame.saturation_dn) == (8, 255)
    assert frame.linear


def test_stale_frames_are_thrown_away(tmp_path: Path) -> None:
    pattern, images = sequence(tmp_path, 6)
    camera = files(pattern, stale_frames=2)
    np.testing.assert_array_equal(camera.capture(0.016, label="").data, images[2])
    np.testing.assert_array_equal(camera.capture(0.016, label="").data, images[5])


def test_exposure_of_files_cannot_be_set(tmp_path: Path) -> None:
    pattern, _ = sequence(tmp_path, 1)
    with pytest.raises(ConfigurationError, match=r"backend images cannot set an exposure; write exposure = \"fixed\""):
        OpenCVCamera(pattern, backend="images", clock=VirtualClock())
    with pytest.raises(ConfigurationError, match=r"fixed exposure of 0\.016 s, 0\.002 s was asked for"):
        files(pattern).capture(0.002, label="")
    with pytest.raises(ConfigurationError, match="needs fixed_exposure_s"):
        files(pattern, fixed_exposure_s=None)


def test_colour_needs_a_choice(tmp_path: Path) -> None:
    pattern, images = sequence(tmp_path, 2, channels=3)
    with pytest.raises(DeviceError, match="3 channels and channel is None; write channel = 0 to 2"):
        files(pattern).capture(0.016, label="")
    np.testing.assert_array_equal(files(pattern, channel=1).capture(0.016, label="").data, images[0][:, :, 1])


def test_counts_beyond_the_bit_depth_are_noticed(tmp_path: Path) -> None:
    pattern, _ = sequence(tmp_path, 1)
    with pytest.raises(DeviceError, match=r"16-bit pixels up to \d+, bit_depth says 12 bits \(up to 4095\)"):
        files(pattern, bit_depth=12).capture(0.016, label="")


def test_a_frame_of_another_size_is_noticed(tmp_path: Path) -> None:
    pattern, _ = sequence(tmp_path, 2)
    cv2.imwrite(str(tmp_path / "frame_0001.png"), np.zeros((4, 4), np.uint16))
    camera = files(pattern)
    camera.capture(0.016, label="")
    with pytest.raises(DeviceError, match="4 x 4 pixels after 8 x 6"):
        camera.capture(0.016, label="")


def test_files_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match="cannot be opened with backend images"):
        files(str(tmp_path / "none_%04d.png"))


def test_a_backend_that_does_not_exist() -> None:
    with pytest.raises(ConfigurationError, match="'auto' is not known; one of v4l2, dshow"):
        OpenCVCamera(0, backend="auto", clock=VirtualClock())


# -- hardware


class StandIn:
    """A camera in the place of ``cv2.VideoCapture``; every frame shows in its pixels how long it was exposed.

    The exposure that is set works `latency` frames later, and `queue` finished frames wait to be read. A further one has
    to be waited for.
    """

    def __init__(self, backend: str = "v4l2", *, queue: int = 4, latency: int = 2, automatic: float | None = None) -> None:
        self.backend = backend
        self.longest = 333.0 if backend == "v4l2" else -3.0
        self.stuck_automatic = automatic
        self.properties: dict[int, float] = {cv2.CAP_PROP_GAIN: 0.0, cv2.CAP_PROP_EXPOSURE: 20.0}
        if backend == "v4l2":
            self.properties[cv2.CAP_PROP_AUTO_EXPOSURE] = 3.0 if automatic is None else automatic
            self.properties[cv2.CAP_PROP_GAMMA] = 120.0
        self.clock = VirtualClock()
        self.queued = queue
        self.pipeline = deque([self.properties[cv2.CAP_PROP_EXPOSURE]] * (queue + latency))
        self.sets: list[tuple[int, float]] = []
        self.released = False

    def isOpened(self) -> bool:
        return True

    def release(self) -> None:
        self.released = True

    def get(self, prop: int) -> float:
        return self.properties.get(prop, -1.0)

    def set(self, prop: int, value: float) -> bool:
        self.sets.append((prop, value))
        if prop not in self.properties or (prop == cv2.CAP_PROP_AUTO_EXPOSURE and self.stuck_automatic is not None):
            return False
        if prop == cv2.CAP_PROP_AUTO_EXPOSURE and value not in (1.0, 3.0):
            return False
        self.properties[prop] = min(value, self.longest) if prop == cv2.CAP_PROP_EXPOSURE else value
        return True

    def grab(self) -> bool:
        if self.queued:
            self.queued -= 1
        else:
            self.clock.sleep(1.0 / 30.0)
        self.now = self.pipeline.popleft()
        self.pipeline.append(self.properties[cv2.CAP_PROP_EXPOSURE])
        return True

    def read(self) -> tuple[bool, np.ndarray[Any, Any]]:
        self.grab()
        return True, np.full((4, 5), abs(self.now), np.uint16)


def hardware(device: StandIn, **changes: Any) -> OpenCVCamera:
    options: dict[str, Any] = {"backend": device.backend, "clock": device.clock, "open_capture": lambda *_: device}
    return OpenCVCamera(0, **(options | changes))


def test_v4l2_counts_in_steps_of_100_microseconds() -> None:
    device = StandIn()
    camera = hardware(device)
    assert device.get(cv2.CAP_PROP_AUTO_EXPOSURE) == 1.0
    frame = camera.capture(0.01603, label="")
    assert device.get(cv2.CAP_PROP_EXPOSURE) == 160.0
    assert frame.exposure_s == pytest.approx(0.016)
    assert frame.metadata["exposure_requested_s"] == 0.01603


@pytest.mark.parametrize("backend", ["dshow", "msmf"])
def test_windows_counts_in_powers_of_two(backend: str) -> None:
    device = StandIn(backend)
    frame = hardware(device).capture(0.016, label="")
    assert device.get(cv2.CAP_PROP_EXPOSURE) == -6.0
    assert frame.exposure_s == 1 / 64


def test_a_frame_is_exposed_as_its_label_says() -> None:
    """In spite of 4 frames in the queue and 2 more on their way, at each change of exposure."""
    camera = hardware(StandIn())
    for exposure_s in (0.002, 0.016, 0.002, 0.0333, 0.0001):
        frame = camera.capture(exposure_s, label="")
        assert np.all(frame.data == round(exposure_s / 1e-4))
        assert frame.exposure_s == pytest.approx(exposure_s)


def test_an_exposure_that_the_camera_shortens_in_silence_is_noticed() -> None:
    with pytest.raises(DeviceError, match=r"exposure of 0\.128 s: 1280 \(100 us\) was set, 333 reads back"):
        hardware(StandIn()).capture(0.128, label="")


def test_automatic_exposure_that_stays_on_is_refused() -> None:
    device = StandIn(automatic=3.0)
    with pytest.raises(DeviceError, match=r"keeps its automatic exposure on \(property reads 3, manual is 1 or 0\.25\)"):
        hardware(device)
    assert device.released
    with pytest.raises(DeviceError, match="keeps its automatic exposure on"):
        hardware(StandIn(automatic=3.0), exposure="fixed", fixed_exposure_s=0.002)


def test_gain_reads_back_or_is_refused() -> None:
    frame = hardware(StandIn(), gain=2.0).capture(0.002, label="")
    assert frame.gain == 2.0
    device = StandIn()
    del device.properties[cv2.CAP_PROP_GAIN]
    with pytest.raises(DeviceError, match="keeps gain -1, 2 was set"):
        hardware(device, gain=2.0)


def test_gamma_is_switched_off_or_contradicts_linear() -> None:
    device = StandIn()
    assert hardware(device, linear=True).capture(0.002, label="").linear
    assert device.get(cv2.CAP_PROP_GAMMA) == 100.0

    class Stubborn(StandIn):
        def set(self, prop: int, value: float) -> bool:
            return prop != cv2.CAP_PROP_GAMMA and super().set(prop, value)

    with pytest.raises(DeviceError, match="keeps gamma 120, linear needs 100"):
        hardware(Stubborn(), linear=True)


def test_settings_are_recorded_as_they_read_back() -> None:
    described = hardware(StandIn()).describe()
    assert described["backend"] == "v4l2"
    settings = described["settings"]
    assert isinstance(settings, dict)
    assert settings["auto_exposure"] == 1.0
    assert settings["gamma"] == 100.0
    assert settings["buffer_size"] == -1.0  # not offered, and said so


def test_motion_jpeg_is_never_linear() -> None:
    with pytest.raises(ConfigurationError, match="MJPG is compressed"):
        hardware(StandIn(), fourcc="MJPG", linear=True)


def test_exposure_must_be_positive() -> None:
    camera = hardware(StandIn())
    for exposure_s in (0.0, -1.0, float("nan")):
        with pytest.raises(ConfigurationError, match="must be above 0"):
            camera.capture(exposure_s, label="")
