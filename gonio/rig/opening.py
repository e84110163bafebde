"""Opens the devices that a rig file names, real or simulated, behind the same interfaces.

`drivers` and `sim` are loaded only when a rig needs them. ``port = "sim"`` starts the simulator: in a
process of its own on pseudo-terminals and a socket, or in this one on a virtual clock. It measures nothing.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import logging
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gonio.config import AxisConfig, CameraConfig, RigConfig, SimConfig
from gonio.config.rig import CAMERA_PLUGINS
from gonio.errors import ConfigurationError, DeviceError, DeviceTimeoutError, GonioError
from gonio.interfaces import Axis, AxisGroup, Camera, Clock, Lamp

if TYPE_CHECKING:
    from drivers.dynamixel import Bus, Servo, ServoGroup

logger = logging.getLogger(__name__)

START_TIMEOUT_S = 90.0
"""How long a simulator may take to answer [s]: on a fresh machine it compiles first."""
STOP_TIMEOUT_S = 5.0

Ask = Callable[[str], None]
"""Shows a text to a person and returns when it is done."""

_WHAT = {"white": "the white reference", "sample": "the sample"}
_number = itertools.count(1)


class WallClock:
    """The wall's monotonic clock; satisfies `gonio.interfaces.Clock`."""

    def now(self) -> float:
        """Seconds since an arbitrary start."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Wait."""
        if seconds > 0:
            time.sleep(seconds)


class Rig:
    """Open devices; made by `open_rig`.

    Attributes
    ----------
    config : RigConfig
    clock : Clock
    axes : dict of str to Axis
        ``"arm"``, ``"pan"``, ``"tilt"``.
    group : AxisGroup
        The same, together.
    camera : Camera or None
    lamp : Lamp
    simulator_pid : int or None
        The process of a simulated rig that has one of its own.
    """

    def __init__(
        self, config: RigConfig, clock: Clock, bus: Bus, axes: Mapping[str, Servo], camera: Camera | None, lamp: Lamp,
        mount: Callable[[str], None], truth: Callable[[], Mapping[str, Any] | None],
        simulator_pid: int | None = None,
    ) -> None:  # fmt: skip
        self.config = config
        self.clock = clock
        self.axes: dict[str, Axis] = dict(axes)
        self.group: AxisGroup = _together(bus, axes)
        self.camera = camera
        self.lamp = lamp
        self.simulator_pid = simulator_pid
        self._bus = bus
        self._mount = mount
        self._mounted: str | None = None
        self._truth = truth

    def mount(self, specimen: str) -> None:
        """Have ``"sample"`` or ``"white"`` on the stage when it returns: by a person, or by the simulator."""
        if specimen not in _WHAT:
            raise ConfigurationError(f"there is no specimen {specimen!r}; it is one of: {', '.join(_WHAT)}")
        if specimen != self._mounted:
            self._mount(specimen)
            self._mounted = specimen

    def stop(self) -> None:
        """All axes stop now and hold with their torque on; the lamp goes off unless a person would have to switch it.

        Raises
        ------
        DeviceError
            The first failure, after everything has been tried.
        """
        errors: list[DeviceError] = []
        steps: list[Callable[[], None]] = [self._bus.stop_all]
        if self.config.lamp.kind != "manual":
            steps.append(lambda: self.lamp.set_output(False))
        for step in steps:
            try:
                step()
            except DeviceError as error:
                errors.append(error)
        if errors:
            raise errors[0]

    def truth(self) -> Mapping[str, Any] | None:
        """What a simulated rig hides from the measurement; None of a real one."""
        return self._truth()

    def describe(self) -> dict[str, object]:
        """All devices, for the run's metadata (JSON-compatible)."""
        return {
            "name": self.config.name,
            "simulated": self.config.simulated,
            "axes": {name: dict(axis.describe()) for name, axis in self.axes.items()},
            "camera": None if self.camera is None else dict(self.camera.describe()),
            "lamp": dict(self.lamp.describe()),
        }


@contextmanager
def open_rig(config: RigConfig, *, ask: Ask | None = None, faults: bool = True) -> Iterator[Rig]:
    """Open a rig; leaving the context closes it, with the servos' torque on.

    Parameters
    ----------
    config : RigConfig
    ask : callable, optional
        How a person is asked to change the specimen or to switch a manual lamp; without it such a rig cannot be opened.
    faults : bool, optional
        Whether the scenario of a simulated rig strikes. A resumed scan goes without: what failed has been repaired.

    Raises
    ------
    DeviceError
        If a device does not answer, or is not what the file says.
    ConfigurationError
        If nobody can be asked.
    """
    with ExitStack() as stack:
        yield _simulated(config, stack, faults) if config.simulated else _real(config, stack, ask)


@dataclass(frozen=True)
class OpenAxes:
    """The axes of a rig without its camera and lamp.

    Attributes
    ----------
    config : RigConfig
    clock : Clock
    bus : Bus
    axes : dict of str to Servo
    group : ServoGroup
        The same, together.
    """

    config: RigConfig
    clock: Clock
    bus: Bus
    axes: dict[str, Servo]
    group: ServoGroup


@contextmanager
def open_axes(config: RigConfig, *, connect: bool = True) -> Iterator[OpenAxes]:
    """Open the servos' line alone; leaving the context closes it, with their torque on.

    Parameters
    ----------
    config : RigConfig
        Of a real rig, or of a simulator that serves its line on a port: what ``port = "sim"`` starts would end with it.
    connect : bool, optional
        Check every servo, write the axis's settings and switch its torque on; else nothing is sent.

    Raises
    ------
    ConfigurationError
        If the rig is simulated within gonio.
    DeviceError
        If the port or a servo does not answer.
    """
    from drivers.dynamixel import Bus

    if config.simulated:
        raise ConfigurationError(
            '[bus] port = "sim" is a simulator that lasts for one command; start `gonio sim serve --pty /tmp/bus` beside it '
            'and write port = "/tmp/bus"'
        )
    clock = WallClock()
    with ExitStack() as stack:
        bus = Bus(config.bus.port, clock=clock, baud=config.bus.baud, timeout_s=config.bus.timeout_s)
        stack.callback(bus.close)
        bus.open()
        servos = {name: servo_of(bus, axis, config.bus.watchdog_s or None) for name, axis in config.axes.items()}
        for servo in servos.values():
            stack.callback(_quietly, servo.close)
            if connect:
                servo.connect()
        yield OpenAxes(config, clock, bus, servos, _together(bus, servos))


def serve_simulator(arguments: Sequence[str], announce: Callable[[str], None] | None = None) -> int:
    """Serve a simulated rig until told to stop; see `sim.serve.serve`."""
    from sim.serve import serve

    return serve(list(arguments), announce=announce)


def _real(config: RigConfig, stack: ExitStack, ask: Ask | None) -> Rig:
    from drivers.dynamixel import Bus
    from drivers.scpi_lamp import ManualLamp, ScpiLamp

    def mount(specimen: str) -> None:
        if ask is None:
            raise ConfigurationError(f"nobody can be asked to put {_WHAT[specimen]} on the stage; run it in a terminal")
        ask(f"Put {_WHAT[specimen]} on the stage.")

    clock = WallClock()
    lamp: Lamp
    if config.lamp.kind == "manual":
        if ask is None:
            raise ConfigurationError('[lamp] kind = "manual": nobody can be asked to switch it; run it in a terminal')
        lamp = ManualLamp(ask)
    else:
        lamp = ScpiLamp(config.lamp.port, baud=config.lamp.baud, timeout_s=config.lamp.timeout_s)
    stack.callback(lamp.close)
    camera = _camera(config.camera, clock)
    if camera is not None:
        stack.callback(camera.close)
    bus = Bus(
        config.bus.port, clock=clock, baud=config.bus.baud, timeout_s=config.bus.timeout_s, return_s=config.bus.return_s
    )
    axes = _connect(bus, config, stack, watchdog_s=config.bus.watchdog_s or None)
    return Rig(config, clock, bus, axes, camera, lamp, mount, lambda: None)


def _camera(config: CameraConfig, clock: Clock) -> Camera | None:
    if config.kind == "none":
        return None
    if config.kind != "opencv":
        return _plugged_in(config, clock)
    from drivers.opencv_camera import OpenCVCamera

    return OpenCVCamera(
        config.device,
        backend=config.backend,
        clock=clock,
        exposure="fixed" if config.fixed else "manual",
        fixed_exposure_s=config.exposures_s[0] if config.fixed else None,
        width=config.width,
        height=config.height,
        fourcc=config.fourcc,
        gain=config.gain,
        bit_depth=config.bit_depth,
        saturation_dn=config.saturation_dn,
        linear=config.linear,
        channel=config.channel,
        stale_frames=config.stale_frames,
    )


def _plugged_in(config: CameraConfig, clock: Clock) -> Camera:
    """A camera of another package: the entry point is called with the clock and [camera.options]."""
    points = [point for point in entry_points(group=CAMERA_PLUGINS) if point.name == config.kind]
    owner = " and ".join(point.dist.name if point.dist else "an unnamed package" for point in points)
    if len({point.value for point in points}) != 1:
        raise ConfigurationError(f"there are {len(points)} cameras {config.kind!r}, by {owner or 'no package'}; have one")
    try:
        camera = points[0].load()(clock=clock, **config.options)
    except GonioError:
        raise
    except Exception as error:  # whatever the code of others raises
        raise DeviceError(
            f"the camera {config.kind!r} of {owner} ({points[0].value}) cannot be opened, {type(error).__name__}: {error}; "
            "check [camera.options] against its manual"
        ) from error
    if not isinstance(camera, Camera):
        raise ConfigurationError(f"{owner}: {points[0].value} makes a {type(camera).__name__}, which is no gonio camera")
    return camera


def _connect(bus: Bus, config: RigConfig, stack: ExitStack, *, watchdog_s: float | None = None) -> dict[str, Servo]:
    """Open the bus and connect all axes."""
    stack.callback(bus.close)
    bus.open()
    servos = {name: servo_of(bus, axis, watchdog_s) for name, axis in config.axes.items()}
    for servo in servos.values():
        stack.callback(_quietly, servo.close)
        servo.connect()
    return servos


def _together(bus: Bus, servos: Mapping[str, Servo]) -> ServoGroup:
    from drivers.dynamixel import ServoGroup

    return ServoGroup(bus, servos)


def servo_of(bus: Bus, axis: AxisConfig, watchdog_s: float | None) -> Servo:
    """The servo that an axis is; it is not connected yet."""
    from drivers.dynamixel import Servo

    return Servo(
        bus,
        axis.name,
        axis.id,
        model=axis.model,
        zero_counts=axis.zero_counts,
        direction=axis.direction,
        lower=axis.lower,
        upper=axis.upper,
        velocity=axis.velocity,
        acceleration=axis.acceleration,
        approach=axis.approach,
        overshoot=axis.overshoot,
        tolerance_counts=axis.tolerance_counts,
        watchdog_s=watchdog_s,
        current_limit=axis.current_limit_a,
        pwm_limit=axis.pwm_limit,
    )


def _simulated(config: RigConfig, stack: ExitStack, faults: bool) -> Rig:
    sim = config.sim or SimConfig(speed=40.0, seed=1, process=True, scenario=None)
    return (_served if sim.process else _in_process)(config, sim, stack, faults)


def _in_process(config: RigConfig, sim: SimConfig, stack: ExitStack, faults: bool) -> Rig:
    """The simulator in this process: virtual time, nothing waits, the same run twice."""
    from drivers.dynamixel import Bus
    from drivers.scpi_lamp import ScpiLamp
    from sim.scenario import Scenario
    from sim.serve import Simulation

    scenario = Scenario.load(Path(sim.scenario)) if sim.scenario and faults else None
    simulation = Simulation(tomllib.loads(config.text), scenario=scenario)
    stack.callback(simulation.close)
    urls = simulation.attach(f"rig{next(_number)}-")
    clock = simulation.clock
    lamp = ScpiLamp(urls["lamp"], baud=config.lamp.baud, timeout_s=config.lamp.timeout_s, now=clock.now)
    stack.callback(lamp.close)
    bus = Bus(urls["bus"], clock=clock, baud=config.bus.baud, timeout_s=config.bus.timeout_s, now=clock.now)
    axes = _connect(bus, config, stack, watchdog_s=config.bus.watchdog_s or None)
    camera = simulation.camera
    return Rig(config, clock, bus, axes, camera, lamp, camera.mount, camera.truth)


def _served(config: RigConfig, sim: SimConfig, stack: ExitStack, faults: bool) -> Rig:
    """The simulator in a process of its own, which ends with this one."""
    from drivers.dynamixel import Bus
    from drivers.scpi_lamp import ScpiLamp
    from sim.camera import SocketCamera
    from sim.clock import ScaledClock

    ready = _start_simulator(config, sim, stack, faults)
    clock = ScaledClock(float(ready["speed"]), int(ready["start_ns"]))
    camera = SocketCamera(ready["camera"])
    stack.callback(camera.close)
    lamp = ScpiLamp(ready["lamp"], baud=config.lamp.baud, timeout_s=config.lamp.timeout_s)
    stack.callback(lamp.close)
    bus = Bus(ready["bus"], clock=clock, baud=config.bus.baud, timeout_s=config.bus.timeout_s)
    axes = _connect(bus, config, stack)
    return Rig(config, clock, bus, axes, camera, lamp, camera.mount, camera.truth, int(ready["pid"]))


def _start_simulator(config: RigConfig, sim: SimConfig, stack: ExitStack, faults: bool) -> dict[str, Any]:
    """Start ``python -m sim.serve`` and wait for its line; the process is stopped when `stack` closes."""
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="gonio-")))
    document = tomllib.loads(config.text)
    document.get("sim", {}).pop("scenario", None)
    (folder / "rig.json").write_text(json.dumps(document, default=str), encoding="utf-8")
    command = [sys.executable, "-m", "sim.serve", "--config", str(folder / "rig.json"), "--parent"]
    if sim.scenario and faults:
        command += ["--scenario", sim.scenario]
    complaints = stack.enter_context((folder / "complaints.txt").open("w+", encoding="utf-8"))
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=complaints, text=True, encoding="utf-8"
    )
    stack.callback(_end, process)
    lines: list[str] = []
    assert process.stdout is not None
    reader = threading.Thread(target=_read_line, args=(process.stdout, lines), daemon=True)
    reader.start()
    reader.join(START_TIMEOUT_S)
    if reader.is_alive():
        raise DeviceTimeoutError(f"the simulator does not answer within {START_TIMEOUT_S:g} s; see whether the host is busy")
    word, _, rest = (lines[0] if lines else "").partition(" ")
    if word != "ready":
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(STOP_TIMEOUT_S)
        complaints.seek(0)
        told = complaints.read(4000).strip().splitlines()
        reason = told[-1] if told else f"it ended with code {process.returncode}"
        wrong = ConfigurationError if process.returncode == ConfigurationError.exit_code else DeviceError
        raise wrong(f"the simulator does not start: {reason}")
    ready: dict[str, Any] = json.loads(rest)
    logger.info("simulator: %s", ready)
    return ready


def _read_line(stream: Any, lines: list[str]) -> None:
    lines.append(stream.readline())


def _end(process: subprocess.Popen[str]) -> None:
    """The simulator stops when its standard input ends; if it does not, it is made to."""
    assert process.stdin is not None
    assert process.stdout is not None
    with contextlib.suppress(OSError):
        process.stdin.close()
    try:
        process.wait(STOP_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    process.stdout.close()


def _quietly(close: Callable[[], None]) -> None:
    """Closing must not hide the error that made it necessary."""
    try:
        close()
    except DeviceError as error:
        logger.warning("closing: %s", error)
