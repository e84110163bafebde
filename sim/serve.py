"""The simulated rig put together: in this process, or served to others by a process of its own.

`Simulation` holds the clock, the world, the servos on their bus, the lamp and the camera. In-process it runs on a
virtual clock and is reached under ``sim://`` URLs. ``python -m sim.serve`` serves one on pseudo-terminals (TCP where
there are none) and a socket, on the wall's clock run faster, until it is told to stop or its parent is gone. It prints
one line, ``ready {json}``, once everything answers.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gonio.errors import ConfigurationError, DeviceError, GonioError
from gonio.interfaces import Clock
from sim.camera import MessageParser, SimulatedCamera, encode_frame, encode_message
from sim.clock import ScaledClock, VirtualClock
from sim.dynamixel.bus import DynamixelBus
from sim.dynamixel.control_table import MODELS
from sim.dynamixel.servo import Servo
from sim.lamp import ScpiLamp
from sim.links import Device, Link, PtyLink, Pump, TcpLink
from sim.port import attach, detach
from sim.render import radiance
from sim.scenario import Scenario
from sim.settings import Settings, read_file
from sim.world import COUNTS_PER_TURN, Truth, World


class Simulation:
    """A simulated rig.

    Parameters
    ----------
    config : mapping, optional
        A parsed rig.toml; what is missing has defaults.
    clock : Clock, optional
        A `VirtualClock` of its own by default.
    scenario : Scenario, optional
        What goes wrong.

    Attributes
    ----------
    settings : Settings
    truth : Truth
    clock : Clock
    servos : dict of str to Servo
        By axis.
    bus : DynamixelBus
    lamp : ScpiLamp
    world : World
    camera : SimulatedCamera

    Examples
    --------
    >>> rig = Simulation()
    >>> urls = rig.attach("doctest-")
    >>> urls["bus"]
    'sim://doctest-bus'
    >>> rig.close()
    """

    def __init__(
        self,
        config: Mapping[str, Any] | None = None,
        *,
        clock: Clock | None = None,
        scenario: Scenario | None = None,
    ) -> None:
        self.settings = Settings.from_mapping(config)
        self.truth = Truth.draw(self.settings)
        self.clock: Clock = VirtualClock() if clock is None else clock
        self._scenario = scenario or Scenario()
        self._attached: list[str] = []
        ids = {name: joint.servo_id for name, joint in self.settings.axes.items()}
        self.servos: dict[str, Servo] = {}
        for name, joint in self.settings.axes.items():
            if joint.model not in MODELS:
                raise ConfigurationError(
                    f"[axes.{name}] model = {joint.model!r} is not simulated; choose one of {', '.join(MODELS)}."
                )
            self.servos[name] = Servo(
                joint.servo_id,
                MODELS[joint.model],
                initial_counts=joint.zero_counts,
                backlash_counts=self.truth.backlash * COUNTS_PER_TURN / (2.0 * np.pi),
                friction_counts=self.truth.friction_counts,
                harmonics=self.truth.harmonics[name],
                load=self.truth.loads[name],
                supply_v=self.truth.supply_v,
                seed=self.settings.seed,
            )
        self.bus = DynamixelBus(self.servos.values(), self._scenario.known_to_servos(ids))
        self.lamp = ScpiLamp(
            drift_per_hour=self.truth.lamp_drift_per_hour,
            warm_up=self.truth.lamp_warm_up,
            channels=self.truth.lamp_channels,
        )
        self.world = World(self.settings, self.truth, self.servos, self.lamp)
        self.camera = SimulatedCamera(self.world, self.clock, self._strike)

    def attach(self, prefix: str = "") -> dict[str, str]:
        """Make bus and lamp reachable in this process; return their pyserial URLs by name.

        `prefix` tells several simulations in one process apart.
        """
        urls = {
            "bus": attach(f"{prefix}bus", self.bus, self.clock),
            "lamp": attach(f"{prefix}lamp", self.lamp, self.clock),
        }
        self._attached += [f"{prefix}bus", f"{prefix}lamp"]
        return urls

    def warm_up(self) -> None:
        """Compile what the first frame needs, so that it comes as fast as the others."""
        for specimen in ("white", "sample"):
            self.world.mount(specimen)
            lit = replace(self.world.scene(0.0), intensity=1.0)
            rate = self.camera.chip.electrons(radiance(lit, self.camera.chip.eye, self.camera.chip.rays))
        self.camera.chip.expose(rate, 1.0, np.random.default_rng(0))

    def close(self) -> None:
        """Detach from the ``sim://`` URLs."""
        while self._attached:
            detach(self._attached.pop())

    def _strike(self, label: str) -> None:
        now = self.clock.now()
        for fault in self._scenario.due(label, self.camera.frames, now):
            if fault.kind == "lamp_out":
                self.lamp.burnt_out_at = now
            elif fault.kind == "lamp_silent":
                self.lamp.silent = True
            elif fault.kind == "camera_unplugged":
                self.camera.unplugged = True
            elif fault.axis is not None:
                self.bus.inject(fault.for_servo(self.servos[fault.axis].id, now))


# ---- served to others ----------------------------------------------------------------------------------------------


class CameraLink:
    """The camera's listening socket on 127.0.0.1, on any free port; satisfies `sim.links.Link`."""

    def __init__(self, camera: SimulatedCamera, clock: ScaledClock) -> None:
        self._camera = camera
        self._clock = clock
        self.closed = False
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.setblocking(False)
        self.address: tuple[str, int] = self._listener.getsockname()[:2]

    def fileno(self) -> int:
        """Of the listening socket."""
        return self._listener.fileno()

    def on_readable(self) -> Sequence[Link]:
        """Accept a client."""
        if self._camera.unplugged:
            self.close()
            return ()
        try:
            client, _ = self._listener.accept()
        except OSError:
            return ()
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return (_CameraConnection(self._camera, self._clock, client),)

    def due(self) -> float | None:
        """Never, but at once when the camera was unplugged; exposures belong to the connections."""
        return 0.0 if self._camera.unplugged else None

    def on_due(self) -> None:
        """The camera was unplugged."""
        self.close()

    def close(self) -> None:
        """Listen no longer."""
        self.closed = True
        self._listener.close()


class _CameraConnection:
    """One client of the camera: requests in, an exposure that takes its scaled time, a frame out."""

    def __init__(self, camera: SimulatedCamera, clock: ScaledClock, client: socket.socket) -> None:
        self._camera = camera
        self._clock = clock
        self._socket = client
        self._parser = MessageParser()
        self._requests: deque[dict[str, Any]] = deque()
        self._unsent = memoryview(b"")
        self._retry_at = 0.0
        self._then: Callable[[], None] | None = None  # next step of a running exposure
        self._then_due = 0.0
        self._lost = False
        self.closed = False

    def fileno(self) -> int:
        return self._socket.fileno()

    def on_readable(self) -> Sequence[Link]:
        try:
            data = self._socket.recv(65_536)
        except BlockingIOError:
            return ()
        except OSError:
            data = b""
        try:
            if not data:
                raise ConnectionResetError
            self._requests.extend(header for header, _ in self._parser.receive(data))
        except (OSError, GonioError):  # gone, or talking nonsense
            self._lose()
            return ()
        self._serve()
        return ()

    def due(self) -> float | None:
        if self._lost:
            return 0.0
        if len(self._unsent):
            return self._retry_at
        return None if self._then is None else self._then_due

    def on_due(self) -> None:
        if self._lost:
            self.close()
            return
        self._flush()
        if self._then is not None and time.monotonic() >= self._then_due:
            step, self._then = self._then, None
            step()
            self._serve()

    def close(self) -> None:
        self.closed = True
        self._socket.close()

    def _lose(self) -> None:
        """Give the connection up; its descriptor stays until `on_due`, so that no new client gets the same number."""
        self._lost = True
        self._then = None
        self._requests.clear()
        self._unsent = memoryview(b"")

    def _serve(self) -> None:
        """Take the next request when none is running."""
        while self._requests and self._then is None and not self._lost:
            request = self._requests.popleft()
            try:
                self._execute(request)
            except ConfigurationError as error:
                self._send(encode_message({"ok": False, "kind": "configuration", "error": str(error)}))
            except GonioError as error:
                if self._camera.unplugged:
                    self._lose()
                else:
                    self._send(encode_message({"ok": False, "kind": "device", "error": str(error)}))

    def _execute(self, request: Mapping[str, Any]) -> None:
        what = request.get("do")
        if what == "describe":
            description = {**self._camera.describe(), "speed": self._clock.speed}
            self._send(encode_message({"ok": True, "description": description}))
        elif what == "truth":
            self._send(encode_message({"ok": True, "truth": self._camera.truth()}))
        elif what == "mount":
            self._camera.mount(str(request.get("specimen")))
            self._send(encode_message({"ok": True}))
        elif what == "capture":
            exposure_s, label = request.get("exposure_s"), request.get("label")
            if isinstance(exposure_s, bool) or not isinstance(exposure_s, int | float) or not isinstance(label, str):
                raise DeviceError("A capture needs exposure_s, a number, and label, a string.")
            exposure = self._camera.begin(float(exposure_s), label)
            self._later(exposure, lambda: self._middle(exposure, label))
        else:
            raise DeviceError(f"The simulated camera does not know how to {what!r}.")

    def _middle(self, exposure_s: float, label: str) -> None:
        data = self._camera.expose(self._clock.now(), exposure_s, label)
        self._later(exposure_s, lambda: self._end(data, exposure_s, label))

    def _end(self, data: NDArray[np.uint16], exposure_s: float, label: str) -> None:
        self._send(encode_frame(self._camera.finish(data, exposure_s, label)))

    def _later(self, exposure_s: float, step: Callable[[], None]) -> None:
        """Do `step` when half of the exposure is over."""
        self._then_due = time.monotonic() + 0.5 * exposure_s / self._clock.speed
        self._then = step

    def _send(self, data: bytes) -> None:
        self._unsent = memoryview(bytes(self._unsent) + data)
        self._flush()

    def _flush(self) -> None:
        if len(self._unsent) and not self._lost:
            try:
                self._unsent = self._unsent[self._socket.send(self._unsent) :]
            except BlockingIOError:
                self._retry_at = time.monotonic() + 0.001
            except OSError:
                self._lose()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the served simulator."""
    parser.add_argument("--config", type=Path, metavar="FILE", help="rig.toml (or JSON) to simulate")
    parser.add_argument("--pty", type=Path, metavar="LINK", help="name for the bus's pseudo-terminal")
    parser.add_argument("--lamp-pty", type=Path, metavar="LINK", help="name for the lamp's pseudo-terminal")
    parser.add_argument("--tcp", type=int, metavar="PORT", help="serve the bus on 127.0.0.1:PORT as well; 0 for any")
    parser.add_argument("--scenario", type=Path, metavar="FILE", help="TOML list of faults")
    parser.add_argument("--speed", type=float, help="rig seconds per wall second")
    parser.add_argument("--seed", type=int, help="of the errors and the noise")
    parser.add_argument("--parent", action="store_true", help="stop when standard input ends")


def serve(argv: Sequence[str] | None = None, *, announce: Callable[[str], None] | None = None) -> int:
    """Serve a simulated rig until SIGTERM, SIGINT or SIGHUP, or, with ``--parent``, SIGTERM or the end of standard input.

    Parameters
    ----------
    argv : sequence of str, optional
        Options; those of the process by default.
    announce : callable, optional
        Gets the line ``ready {json}``; standard output by default. The JSON object has ``bus`` and ``lamp`` (what
        pyserial opens), ``camera`` (host:port), ``tcp`` (the bus's URL, or null), ``speed``, ``start_ns`` (rig time 0 on the
        system's monotonic clock), ``seed``, ``pid``.

    Returns
    -------
    int
        Exit code: 0 once told to stop.

    Raises
    ------
    GonioError
        If the configuration cannot be used, or a terminal or a port cannot be had.
    """
    parser = argparse.ArgumentParser(prog="gonio sim serve", description="Serve a simulated rig.")
    add_arguments(parser)
    options = parser.parse_args(argv)
    config = read_file(options.config) if options.config else {}
    overrides = {key: value for key in ("speed", "seed") if (value := getattr(options, key)) is not None}
    if overrides:
        config = {**config, "sim": {**config.get("sim", {}), **overrides}}
    simulated = ScaledClock(Settings.from_mapping(config).speed)
    simulation = Simulation(config, clock=simulated, scenario=_scenario(options, config))
    simulation.warm_up()

    stop = threading.Event()
    previous = _stop_on_signals(stop, options.parent)
    pump = Pump()
    try:
        bus = _line(pump, simulation.bus, simulated, options.pty)
        lamp = _line(pump, simulation.lamp, simulated, options.lamp_pty)
        tcp = None
        if options.tcp is not None:
            link = TcpLink(simulation.bus, simulated, port=options.tcp)
            pump.add(link)
            tcp = f"socket://{link.address[0]}:{link.address[1]}"
        camera = CameraLink(simulation.camera, simulated)
        pump.add(camera)
        if options.parent:
            threading.Thread(target=_watch_parent, args=(stop,), daemon=True).start()
        ready = {
            "bus": bus,
            "lamp": lamp,
            "camera": f"{camera.address[0]}:{camera.address[1]}",
            "tcp": tcp,
            "speed": simulated.speed,
            "start_ns": simulated.start_ns,
            "seed": simulation.settings.seed,
            "pid": os.getpid(),
        }
        (announce or _print_line)(f"ready {json.dumps(ready)}")
        pump.run(stop.is_set)
    finally:
        pump.close()
        for number, handler in previous.items():
            signal.signal(number, handler)
    return 0


def _scenario(options: argparse.Namespace, config: Mapping[str, Any]) -> Scenario | None:
    """From ``--scenario``, else from ``[sim] scenario``, a path relative to the rig.toml."""
    if options.scenario is not None:
        return Scenario.load(options.scenario)
    named = config.get("sim", {}).get("scenario")
    if not named:
        return None
    return Scenario.load(options.config.parent / named if options.config else Path(named))


def _line(pump: Pump, device: Device, clock: ScaledClock, name: Path | None) -> str:
    """Put a device on a pseudo-terminal, or on TCP where there are none and no name was asked for."""
    if sys.platform == "win32" and name is None:
        link = TcpLink(device, clock)
        pump.add(link)
        return f"socket://{link.address[0]}:{link.address[1]}"
    terminal = PtyLink(device, clock, name)
    pump.add(terminal)
    return terminal.path


def _stop_on_signals(stop: threading.Event, has_parent: bool) -> dict[int, Any]:
    """Stop on signals, if this is the main thread; return the handlers that were there.

    Ctrl-C in a terminal reaches parent and child; the parent still has to stop the axes then, so a child goes on.
    """

    def handler(number: int, frame: FrameType | None) -> None:
        if not has_parent or number == signal.SIGTERM:
            stop.set()

    previous: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        for name in ("SIGTERM", "SIGINT", "SIGHUP"):
            number = getattr(signal, name, None)
            if number is not None:
                previous[number] = signal.signal(number, handler)
    return previous


def _watch_parent(stop: threading.Event) -> None:
    """Set `stop` when standard input ends, as it does when the process at its other end is gone."""
    with suppress(OSError):
        while os.read(0, 4096):
            continue
    stop.set()


def _print_line(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> int:
    """``python -m sim.serve``: one sentence and an exit code when something is wrong."""
    try:
        return serve()
    except GonioError as error:
        sys.stderr.write(f"{error}\n")
        return error.exit_code


if __name__ == "__main__":
    sys.exit(main())
