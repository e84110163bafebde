"""What is wrong with a rig's connections, and the command that mends it.

It looks at serial ports, who may open them and who holds them, the adapters' latency, cameras, and, given a rig file, at the
servos and the lamp. It opens what is free, moves nothing and writes nothing.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from gonio.config import RigConfig
from gonio.errors import GonioError
from gonio.rig import service

_LATENCY = Path("/sys/bus/usb-serial/devices")
_VIDEO = Path("/sys/class/video4linux")
_SLOW_MS = 4


@dataclass(frozen=True)
class Finding:
    """One line of the diagnosis.

    Attributes
    ----------
    subject : str
        What was looked at.
    state : str
        What was seen.
    mend : str
        What to do about it; empty if nothing is wrong.
    """

    subject: str
    state: str
    mend: str = ""


def examine(config: RigConfig | None = None, file: str = "RIG.TOML") -> Iterator[Finding]:
    """Findings about this computer, and about a rig, read from `file`, if one is given; each as soon as it is known."""
    ports = dict(_ports())
    real = config is not None and not config.simulated
    if real and config is not None and "://" not in config.bus.port:
        ports.setdefault(config.bus.port, "[bus] port of the rig file")
    if not ports:
        yield Finding("serial ports", "none", "plug the servos' adapter in; on a virtual machine pass it through")
    for path, what in ports.items():
        yield _port(path, what)
        yield from _latency(path)
    yield from _cameras(needed=config is None or config.camera.kind == "opencv")
    if real and config is not None:
        yield from _servos(config, f"gonio rig setup {file}")
        yield from _lamp(config)


def _ports() -> list[tuple[str, str]]:
    from serial.tools import list_ports

    found = [(p.device, p.description) for p in list_ports.comports()]
    return sorted((device, what) for device, what in found if what != "n/a")  # a board's own empty sockets


def _port(path: str, what: str) -> Finding:
    from drivers.serial_port import holder

    name = f"port {path}"
    if not Path(path).exists():
        return Finding(name, "does not exist", "plug it in, or correct the name in rig.toml")
    if not os.access(path, os.R_OK | os.W_OK):
        return Finding(name, f"{what}; this user may not open it", "sudo usermod -aG dialout $USER, then log in again")
    pid = holder(path)
    if pid is not None:
        return Finding(name, f"{what}; held by process {pid} ({_command(pid)})", f"end it, for example: kill -INT {pid}")
    return Finding(name, f"{what}; free")


def _command(pid: int) -> str:
    """What a process is called, where the system tells."""
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
    except OSError:
        return "name unknown"
    return " ".join(word.decode(errors="replace") for word in words[:6]).strip()


def _latency(path: str) -> Iterator[Finding]:
    """The FTDI driver's latency timer, 16 ms unless set: it adds to every answer."""
    timer = _LATENCY / Path(path).name / "latency_timer"
    try:
        milliseconds = int(timer.read_text())
    except (OSError, ValueError):
        return
    mend = f"echo 1 | sudo tee {timer}" if milliseconds > _SLOW_MS else ""
    yield Finding(f"latency of {path}", f"{milliseconds} ms an answer", mend)


def _cameras(*, needed: bool) -> Iterator[Finding]:
    devices = sorted(_VIDEO.glob("video*")) if _VIDEO.exists() else []
    for device in devices:
        path = Path("/dev") / device.name
        try:
            label = (device / "name").read_text().strip()
        except OSError:
            label = "camera"
        if os.access(path, os.R_OK | os.W_OK):
            yield Finding(f"camera {path}", f"{label}; free to open")
        else:
            yield Finding(
                f"camera {path}", f"{label}; this user may not open it", "sudo usermod -aG video $USER, then log in again"
            )
    if _VIDEO.parent.exists() and not devices:
        mend = 'plug the camera in, or write [camera] kind = "none"' if needed else ""
        yield Finding("cameras", "none that Linux lists", mend)


def _servos(config: RigConfig, setup: str) -> Iterator[Finding]:
    from drivers.dynamixel import registers as reg

    names = {model.number: model.name for model in reg.MODELS.values()}
    try:
        with service.bus_at(config)(config.bus.baud) as bus:
            found = bus.scan()
            for name, axis in config.axes.items():
                subject = f"axis {name} (id {axis.id})"
                if axis.id not in found:
                    yield Finding(subject, f"no answer at {config.bus.baud} bit/s", f"check power and cable, then {setup}")
                    continue
                number, firmware = found[axis.id]
                state = f"{names.get(number, f'model {number}')}, firmware {firmware}"
                errors = bus.read(axis.id, reg.HARDWARE_ERROR_STATUS)
                volts = bus.read(axis.id, reg.PRESENT_VOLTAGE) * reg.VOLTAGE_UNIT_V
                delay = bus.read(axis.id, reg.RETURN_DELAY_TIME)
                state += f", {volts:.1f} V"
                if names.get(number) != axis.model:
                    yield Finding(subject, f"{state}; rig.toml says {axis.model}", "correct model or id in rig.toml")
                elif errors:
                    yield Finding(subject, f"{state}; {reg.hardware_errors(errors)}", "find the cause, then power-cycle it")
                elif delay:
                    yield Finding(subject, f"{state}; answers {2 * delay} us late", setup)
                elif changes := service.differences(bus, name, axis.id, config):
                    differing = ", ".join(f"{r.name} is {now}, rig.toml means {new}" for r, (now, new) in changes.items())
                    yield Finding(subject, f"{state}; {differing}", setup)
                else:
                    yield Finding(subject, state)
            spare = sorted(set(found) - {axis.id for axis in config.axes.values()})
            if spare:
                yield Finding("further servos", f"ids {', '.join(map(str, spare))}, of no axis")
    except GonioError as error:
        yield Finding(f"bus {config.bus.port}", str(error), "see the message")


def _lamp(config: RigConfig) -> Iterator[Finding]:
    if config.lamp.kind != "scpi":
        return
    from drivers.scpi_lamp import ScpiLamp

    try:
        with ScpiLamp(config.lamp.port, baud=config.lamp.baud, timeout_s=config.lamp.timeout_s) as lamp:
            yield Finding(f"lamp on {config.lamp.port}", str(lamp.describe()["identity"]))
    except GonioError as error:
        yield Finding(f"lamp on {config.lamp.port}", str(error), "see the message")
