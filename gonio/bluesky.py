"""A rig's devices in the shape of ``bluesky.protocols``, for facilities that run their plans with bluesky.

    import gonio.bluesky
    from bluesky import RunEngine
    from bluesky.plans import grid_scan
    from gonio.config import load_rig
    from gonio.rig import open_rig

    with open_rig(load_rig("lab/rig.toml")) as rig:
        bench = gonio.bluesky.devices(rig)
        RunEngine()(grid_scan([bench.camera], bench.arm, -60, 60, 13, bench.pan, 0, 30, 4))

Nothing of bluesky is imported: the shapes are enough. At this edge angles are in degrees, and the names say so. Each action
runs in a thread of its own, which only polls; a device is asked by one thread at a time. What bluesky has no word for,
journal, resume and an immediate stop by Ctrl-C, is `gonio scan`'s.

References: bluesky, "Hardware interface" (blueskyproject.io/bluesky/main/hardware.html).
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any, Protocol

import numpy as np

from gonio.errors import ConfigurationError, DeviceError
from gonio.interfaces import Axis, Camera, Clock, Frame, Lamp

_POLL_S = 0.02


class BenchRig(Protocol):
    """What `devices` needs of a rig (see `gonio.rig.Rig`)."""

    @property
    def axes(self) -> Mapping[str, Axis]: ...

    @property
    def camera(self) -> Camera | None: ...

    @property
    def lamp(self) -> Lamp: ...

    @property
    def clock(self) -> Clock: ...

    @property
    def config(self) -> Any: ...


def devices(rig: BenchRig) -> SimpleNamespace:
    """All devices of an open rig: ``arm``, ``pan``, ``tilt``, ``lamp``, and ``camera`` if it has one."""
    found: dict[str, Any] = {name: BlueskyAxis(axis, rig.clock) for name, axis in rig.axes.items()}
    found["lamp"] = BlueskyLamp(rig.lamp)
    if rig.camera is not None:
        found["camera"] = BlueskyCamera(rig.camera, exposure_s=rig.config.camera.exposures_s[0], roi=rig.config.camera.roi)
    return SimpleNamespace(**found)


class Status:
    """An action under way; satisfies ``bluesky.protocols.Status``.

    Parameters
    ----------
    label : str
        What is done, for messages.
    action : callable
        Does it, in a thread; an exception is its failure.
    """

    def __init__(self, label: str, action: Callable[[], None]) -> None:
        self._label = label
        self._action = action
        self._finished = threading.Event()
        self._error: BaseException | None = None
        self._lock = threading.Lock()
        self._callbacks: list[Callable[[Status], None]] = []
        threading.Thread(target=self._run, name=label, daemon=True).start()

    def _run(self) -> None:
        try:
            self._action()
        except Exception as error:  # noqa: BLE001 - whatever it was, the plan that waits must hear of it
            self._error = error
        with self._lock:
            self._finished.set()
            callbacks, self._callbacks = self._callbacks, []
        for callback in callbacks:
            callback(self)

    def add_callback(self, callback: Callable[[Status], None]) -> None:
        """Call `callback` with this status at the end; at once if that is past."""
        with self._lock:
            if not self._finished.is_set():
                self._callbacks.append(callback)
                return
        callback(self)

    def exception(self, timeout: float | None = 0.0) -> BaseException | None:
        """Why it failed, after waiting up to `timeout` [s] for the end; None if it did not."""
        if not self._finished.wait(timeout):
            raise TimeoutError(f"{self._label}: not finished within {timeout} s")
        return self._error

    @property
    def done(self) -> bool:
        """It has ended."""
        return self._finished.is_set()

    @property
    def success(self) -> bool:
        """It has ended well."""
        return self.done and self._error is None

    def __repr__(self) -> str:
        state = f"failed: {self._error}" if self._error else "done" if self.done else "under way"
        return f"<{self._label}, {state}>"


class _Device:
    """Name and configuration, which all of them have."""

    parent = None

    def __init__(self, name: str, identity: Callable[[], Mapping[str, object]]) -> None:
        self._name = name
        self._identity = identity

    @property
    def name(self) -> str:
        """Key of its readings."""
        return self._name

    def read_configuration(self) -> dict[str, dict[str, Any]]:
        """Identity and settings, each under the device's name."""
        return {f"{self._name}_{key}": _reading(_plain(value)) for key, value in self._identity().items()}

    def describe_configuration(self) -> dict[str, dict[str, Any]]:
        """Of `read_configuration`."""
        return {
            f"{self._name}_{key}": _key(self._name, "number" if isinstance(_plain(value), float) else "string")
            for key, value in self._identity().items()
        }


class BlueskyAxis(_Device):
    """An axis: Movable, Readable, Locatable, Stoppable, Checkable, Configurable.

    Parameters
    ----------
    axis : Axis
    clock : Clock
        Of the rig.
    """

    def __init__(self, axis: Axis, clock: Clock) -> None:
        super().__init__(f"{axis.name}_deg", axis.describe)
        self._axis = axis
        self._clock = clock
        self._lock = threading.RLock()
        self._move = 0  # number of the latest; an earlier one is off
        self._stopped_well = False
        self._setpoint_deg: float | None = None

    @property
    def hints(self) -> dict[str, Any]:
        """What plots show."""
        return {"fields": [self._name]}

    def check_value(self, value: float) -> None:
        """Raise `LimitError` if an angle [deg] is out of reach; nothing is sent."""
        self._axis.check(math.radians(value))

    def set(self, value: float) -> Status:
        """Move to an angle [deg]."""
        with self._lock:
            self._axis.move_to(math.radians(value))
            self._setpoint_deg = float(value)
            self._move += 1
            number = self._move

        def wait() -> None:
            while True:
                with self._lock:
                    if number != self._move:
                        if self._stopped_well:
                            return
                        raise DeviceError(f"Axis {self._axis.name} was stopped on its way to {value:g} degrees.")
                    if self._axis.settled():
                        return
                self._clock.sleep(_POLL_S)

        return Status(f"axis {self._axis.name} to {value:g} degrees", wait)

    def stop(self, success: bool = True) -> None:
        """Stop now and hold. A move under way ends, and has failed unless `success`: a pause of the engine is no failure."""
        with self._lock:
            self._move += 1
            self._stopped_well = success
            self._axis.stop()

    def read(self) -> dict[str, dict[str, Any]]:
        """The measured angle [deg], and the servo's goal and health."""
        with self._lock:
            now = self._axis.read()
        values = {
            self._name: math.degrees(now.angle),
            f"{self._name}_setpoint": math.nan if self._setpoint_deg is None else self._setpoint_deg,
            f"{self._axis.name}_current_a": now.current_a,
            f"{self._axis.name}_temperature_c": now.temperature_c,
            f"{self._axis.name}_voltage_v": now.voltage_v,
        }
        return {key: _reading(value) for key, value in values.items()}

    def describe(self) -> dict[str, dict[str, Any]]:
        """Of `read`."""
        units = ("deg", "deg", "A", "degC", "V")
        return {key: _key(self._name, "number", units=unit) for key, unit in zip(self.read(), units, strict=True)}

    def locate(self) -> dict[str, float]:
        """Set point and measured angle [deg]."""
        with self._lock:
            angle = math.degrees(self._axis.read().angle)
        return {"setpoint": angle if self._setpoint_deg is None else self._setpoint_deg, "readback": angle}


class BlueskyCamera(_Device):
    """A camera: Triggerable, Readable, Configurable. It reads the mean of a region, not whole images.

    Parameters
    ----------
    camera : Camera
    exposure_s : float
        [s].
    roi : tuple of int
        Region that is averaged: x0, y0, width, height [pixel].
    """

    def __init__(self, camera: Camera, *, exposure_s: float, roi: tuple[int, int, int, int]) -> None:
        super().__init__("camera", camera.describe)
        self._camera = camera
        self._roi = roi
        self._lock = threading.Lock()
        self._count = 0
        self._frame: Frame | None = None
        self.exposure_s = exposure_s

    @property
    def hints(self) -> dict[str, Any]:
        """What plots show."""
        return {"fields": [f"{self._name}_mean_dn"]}

    def trigger(self) -> Status:
        """Expose a fresh frame."""
        self._count += 1
        label = f"{self._name} {self._count}"

        def expose() -> None:
            with self._lock:
                self._frame = self._camera.capture(self.exposure_s, label=label)

        return Status(label, expose)

    def read(self) -> dict[str, dict[str, Any]]:
        """Mean and standard deviation of the region [DN], the share of saturated pixels, the exposure [s]."""
        frame = self._frame
        if frame is None:
            raise ConfigurationError(f"{self._name} has not been triggered; trigger it, then read it.")
        x0, y0, width, height = self._roi
        pixels = frame.data[y0 : y0 + height, x0 : x0 + width]
        values = {
            f"{self._name}_mean_dn": float(np.mean(pixels)),
            f"{self._name}_std_dn": float(np.std(pixels)),
            f"{self._name}_saturated": float(np.mean(pixels >= frame.saturation_dn)),
            f"{self._name}_exposure_s": frame.exposure_s,
        }
        return {key: _reading(value) for key, value in values.items()}

    def describe(self) -> dict[str, dict[str, Any]]:
        """Of `read`."""
        units = {"mean_dn": "DN", "std_dn": "DN", "saturated": "1", "exposure_s": "s"}
        return {f"{self._name}_{key}": _key(self._name, "number", units=unit) for key, unit in units.items()}


class BlueskyLamp(_Device):
    """A lamp: Movable, Readable, Stoppable, Configurable; its value is the drive level, 0 (off) to 1."""

    def __init__(self, lamp: Lamp) -> None:
        super().__init__("lamp", lamp.describe)
        self._lamp = lamp
        self._lock = threading.Lock()
        self._level = 0.0

    def set(self, value: float) -> Status:
        """Set the level and switch on; 0 switches off."""

        def switch() -> None:
            with self._lock:
                if value > 0.0:
                    self._lamp.set_level(value)
                self._lamp.set_output(value > 0.0)
                self._level = float(value)

        return Status(f"{self._name} to {value:g}", switch)

    def stop(self, success: bool = True) -> None:
        """Nothing moves; the lamp stays as it is."""

    def read(self) -> dict[str, dict[str, Any]]:
        """The level that was set."""
        return {self._name: _reading(self._level)}

    def describe(self) -> dict[str, dict[str, Any]]:
        """Of `read`."""
        return {self._name: _key(self._name, "number", units="1")}


def _reading(value: Any) -> dict[str, Any]:
    return {"value": value, "timestamp": time.time()}


def _key(source: str, dtype: str, *, units: str | None = None) -> dict[str, Any]:
    key = {"source": f"gonio:{source}", "dtype": dtype, "shape": []}
    return key if units is None else key | {"units": units}


def _plain(value: object) -> float | str:
    """A number or a text."""
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else str(value)
