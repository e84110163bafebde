"""A simulated rig served to other programs by a process of its own.

``python -m sim.serve`` (or ``gonio sim serve``) serves a `Simulation` on pseudo-terminals (TCP where there are none) and
sockets, on the wall's clock run faster, until it is told to stop or its parent is gone. It prints one line,
``ready {json}``, once everything answers.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from types import FrameType
from typing import IO, Any

from gonio.errors import ConfigurationError, GonioError
from sim.camera_link import CameraLink
from sim.clock import ScaledClock
from sim.links import Device, PtyLink, Pump, TcpLink
from sim.mjpeg import MjpegLink
from sim.scenario import Scenario
from sim.settings import Settings, read_file
from sim.simulation import Simulation

__all__ = ["Simulation", "serve"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the served simulator."""
    parser.add_argument("--config", type=Path, metavar="FILE", help="rig.toml (or JSON) to simulate")
    parser.add_argument("--pty", type=Path, metavar="LINK", help="name for the bus's pseudo-terminal")
    parser.add_argument("--lamp-pty", type=Path, metavar="LINK", help="name for the lamp's pseudo-terminal")
    parser.add_argument("--tcp", type=int, metavar="PORT", help="serve the bus on 127.0.0.1:PORT as well; 0 for any")
    parser.add_argument("--mjpeg", type=int, metavar="PORT", help="serve the camera as motion JPEG; 0 for any")
    parser.add_argument("--pace", action="store_true", help="let bytes take the time that they need on the wire")
    parser.add_argument("--log", type=Path, metavar="FILE", help="write what was true at each frame, a line of JSON each")
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
        pyserial opens), ``camera`` (host:port), ``tcp`` (the bus's URL, or null), ``mjpeg`` (an HTTP URL, or null),
        ``speed``, ``start_ns`` (rig time 0 on the system's monotonic clock), ``seed``, ``pid``. When a scenario brings the
        bus back: ``returned {json}`` with ``bus`` and ``tcp``.

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

    stack = ExitStack()
    stop = threading.Event()
    previous = _stop_on_signals(stop, options.parent)
    pump, tell = Pump(), announce or _print_line
    baud = simulation.settings.baud if options.pace else None
    cable = _Cable(pump, simulation.bus, simulated, options, baud, tell)
    simulation.pull_cable = cable.pull
    try:
        addresses = cable.plug(options.pty)
        lamp = _line(pump, simulation.lamp, simulated, options.lamp_pty)[1]
        mjpeg = None
        if options.mjpeg is not None:
            mjpeg = MjpegLink(simulation.camera, simulated, port=options.mjpeg)
            pump.add(mjpeg)
        if options.log is not None:
            log = stack.enter_context(_opened(options.log))
            simulation.camera.record = lambda entry: print(json.dumps(entry), file=log, flush=True)
        camera = CameraLink(simulation.camera, simulated)
        pump.add(camera)
        if options.parent:
            threading.Thread(target=_watch_parent, args=(stop,), daemon=True).start()
        ready = {
            "bus": addresses["bus"],
            "lamp": lamp,
            "camera": f"{camera.address[0]}:{camera.address[1]}",
            "tcp": addresses["tcp"],
            "mjpeg": mjpeg and mjpeg.url,
            "speed": simulated.speed,
            "start_ns": simulated.start_ns,
            "seed": simulation.settings.seed,
            "pid": os.getpid(),
        }
        tell(f"ready {json.dumps(ready)}")

        def stopped() -> bool:
            simulation.tick()
            cable.tick()
            return stop.is_set()

        pump.run(stopped)
    finally:
        pump.close()
        stack.close()
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


class _Cable:
    """The bus's connection to its clients, which a scenario may pull."""

    def __init__(
        self, pump: Pump, bus: Device, clock: ScaledClock, options: argparse.Namespace, baud: int | None,
        tell: Callable[[str], None],
    ) -> None:  # fmt: skip
        self._pump, self._bus, self._clock, self._options = pump, bus, clock, options
        self._baud = baud
        self._tell = tell
        self._links: list[PtyLink | TcpLink] = []
        self._name: Path | None = None
        self._back_at: float | None = None  # on the wall's clock

    def plug(self, name: Path | None) -> dict[str, str | None]:
        """Connect; return the addresses."""
        self._name = name
        link, address = _line(self._pump, self._bus, self._clock, name, self._baud)
        self._links = [link]
        tcp = None
        if self._options.tcp is not None:
            served = TcpLink(self._bus, self._clock, port=self._options.tcp, baud=self._baud)
            self._pump.add(served)
            self._links.append(served)
            tcp = f"socket://{served.address[0]}:{served.address[1]}"
        return {"bus": address, "tcp": tcp}

    def pull(self, for_s: float | None, name: str | None) -> None:
        """Disconnect everybody, for so many rig seconds; None for good."""
        for link in self._links:
            self._pump.drop(link)
        self._links = []
        if for_s is not None:
            self._back_at = time.monotonic() + for_s / self._clock.speed
            self._name = Path(name) if name else self._name

    def tick(self) -> None:
        """Connect again when it is time."""
        if self._back_at is not None and time.monotonic() >= self._back_at:
            self._back_at = None
            self._tell(f"returned {json.dumps(self.plug(self._name))}")


def _line(
    pump: Pump, device: Device, clock: ScaledClock, name: Path | None, baud: int | None = None
) -> tuple[PtyLink | TcpLink, str]:
    """Put a device on a pseudo-terminal, or on TCP where there are none and no name was asked for; with its address."""
    if sys.platform == "win32" and name is None:
        link = TcpLink(device, clock, baud=baud)
        pump.add(link)
        return link, f"socket://{link.address[0]}:{link.address[1]}"
    terminal = PtyLink(device, clock, name, baud)
    pump.add(terminal)
    return terminal, terminal.path


def _opened(path: Path) -> IO[str]:
    try:
        return path.open("w", encoding="utf-8")
    except OSError as error:
        raise ConfigurationError(f"{path} cannot be written ({error.strerror}); give another file for --log.") from error


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
