"""Looking after the servos of a rig: find them, give them ids and settings, list their registers, stop them.

Nothing here moves an axis, and nothing is written that was not listed as a `Change` before. A rig that another process
holds is stopped by asking that process, as a Ctrl-C would.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from gonio.config import RigConfig
from gonio.errors import ConfigurationError, DeviceError
from gonio.rig.opening import WallClock, open_axes

if TYPE_CHECKING:
    from drivers.dynamixel import Bus, Servo
    from drivers.dynamixel.registers import Register

_HOLDER_S = 10.0  # for a process that was asked to stop to let go of the port
_STEP_S = 0.05
_SWITCH_S = 0.1  # for a rate to be on the line, and in the servo


@dataclass(frozen=True)
class Found:
    """A servo that answers: line rate [bit/s], id, model number and name, firmware."""

    baud: int
    id: int
    number: int
    model: str
    firmware: int


@dataclass(frozen=True)
class Change:
    """A register to be written.

    Attributes
    ----------
    axis : str
    found : Found
        The servo, as it answers now.
    register : str
    now, new : int
    """

    axis: str
    found: Found
    register: str
    now: int
    new: int


BusAt = Callable[[int], "Bus"]


def bus_at(config: RigConfig) -> BusAt:
    """Makes a bus on the rig's port at a line rate [bit/s]."""

    def make(baud: int) -> Bus:
        from drivers.dynamixel import Bus

        return Bus(config.bus.port, clock=WallClock(), baud=baud, timeout_s=config.bus.timeout_s)

    return make


def survey(make: BusAt, *, progress: Callable[[int, int], None] = lambda done, total: None) -> list[Found]:
    """All servos on a line, at every rate that the SDK offers; takes about a second for each."""
    from drivers.dynamixel import registers as reg

    names = {model.number: model.name for model in reg.MODELS.values()}
    found = []
    for done, baud in enumerate(reg.BAUD_CODES):
        progress(done, len(reg.BAUD_CODES))
        with make(baud) as bus:
            for servo_id, (number, firmware) in bus.scan().items():
                found.append(Found(baud, servo_id, number, names.get(number, f"model {number}"), firmware))
    progress(len(reg.BAUD_CODES), len(reg.BAUD_CODES))
    return found


def plan_changes(config: RigConfig, make: BusAt, found: Sequence[Found], *, axis: str | None = None) -> list[Change]:
    """What has to be written so that the servos are as rig.toml says.

    Parameters
    ----------
    config : RigConfig
    make : callable
    found : sequence of Found
        Of `survey`.
    axis : str, optional
        The only servo on the line becomes this axis, whatever its id.

    Raises
    ------
    ConfigurationError
        If an axis has no servo, or it is not clear which one is its.
    """
    changes = []
    for name, wanted in config.axes.items():
        if axis not in (None, name):
            continue
        servo = _servo_for(config, name, found, alone=axis is not None)
        with make(servo.baud) as bus:
            changes += _changes(bus, name, servo, config)
        if servo.id != wanted.id:
            changes.append(Change(name, servo, "ID", servo.id, wanted.id))
        if servo.baud != config.bus.baud:
            changes.append(Change(name, servo, "Baud Rate", _code(servo.baud), _code(config.bus.baud)))
    return changes


def _servo_for(config: RigConfig, axis: str, found: Sequence[Found], *, alone: bool) -> Found:
    wanted = config.axes[axis]
    listed = ", ".join(f"id {f.id} ({f.model}, {f.baud} bit/s)" for f in found) or "none"
    advice = f"connect this servo alone and use `gonio rig setup RIG.TOML --axis {axis}`"
    if alone:
        if len(found) != 1:
            raise ConfigurationError(f"--axis {axis} needs one servo on the line, {len(found)} answer: {listed}")
        servo = found[0]
    else:
        matching = [f for f in found if f.id == wanted.id]
        if len(matching) != 1:
            what = f"{len(matching)} servos have id {wanted.id}" if matching else f"no servo has id {wanted.id}"
            raise ConfigurationError(f"axis {axis}: {what}; servos found: {listed}; {advice}")
        servo = matching[0]
    if servo.model != wanted.model:
        raise ConfigurationError(
            f"axis {axis}: the servo with id {servo.id} is {servo.model}, rig.toml says {wanted.model}; correct one of them"
        )
    return servo


def _changes(bus: Bus, axis: str, servo: Found, config: RigConfig) -> list[Change]:
    """Of the settings in EEPROM, id and rate apart."""
    return [
        Change(axis, servo, register.name, now, new)
        for register, (now, new) in differences(bus, axis, servo.id, config).items()
    ]


def differences(bus: Bus, axis: str, servo_id: int, config: RigConfig) -> dict[Register, tuple[int, int]]:
    """Settings in a servo's EEPROM that are not as rig.toml says: what they are, and what they should be."""
    from drivers.dynamixel.commissioning import eeprom_changes

    return eeprom_changes(bus, servo_id, _as_axis(bus, axis, servo_id, config).settings)


def _as_axis(bus: Bus, axis: str, servo_id: int, config: RigConfig) -> Servo:
    """The axis as rig.toml has it, under the id that its servo has now; not connected."""
    from dataclasses import replace

    from gonio.rig.opening import servo_of

    return servo_of(bus, replace(config.axes[axis], id=servo_id), None)


def apply(config: RigConfig, make: BusAt, changes: Sequence[Change]) -> None:
    """Write changes, with torque off, rate last; each servo is then asked for at its new id and rate.

    Raises
    ------
    DeviceError
        If a servo keeps another value, or does not answer afterwards.
    """
    from drivers.dynamixel import registers as reg
    from drivers.dynamixel.commissioning import write_eeprom

    for axis in dict.fromkeys(change.axis for change in changes):
        own = {change.register: change for change in changes if change.axis == axis}
        servo = next(iter(own.values())).found
        new_id, baud = servo.id, servo.baud
        with make(servo.baud) as bus:
            bus.write(servo.id, reg.STATUS_RETURN_LEVEL, 2)
            bus.write(servo.id, reg.TORQUE_ENABLE, 0)
            write_eeprom(bus, servo.id, _as_axis(bus, axis, servo.id, config).settings)
            # as sync writes, which nobody answers: from which id and at which rate an answer would come is not documented
            if "ID" in own:
                new_id = own["ID"].new
                bus.sync_write(reg.SERVO_ID, {servo.id: new_id})
            if "Baud Rate" in own:
                baud = config.bus.baud
                bus.sync_write(reg.BAUD_RATE, {new_id: own["Baud Rate"].new})
                time.sleep(_SWITCH_S)
        with make(baud) as bus:
            number, _ = bus.ping(new_id)
            if number != servo.number:
                raise DeviceError(f"axis {axis}: model {number} answers for id {new_id}, {servo.number} was set up")


def _code(baud: int) -> int:
    from drivers.dynamixel import registers as reg

    if baud not in reg.BAUD_CODES:
        raise ConfigurationError(f"[bus] baud = {baud} is none of {', '.join(map(str, reg.BAUD_CODES))}")
    return reg.BAUD_CODES[baud]


def registers(config: RigConfig) -> dict[str, dict[str, int | str]]:
    """Every register of every axis, by axis and name."""
    from drivers.dynamixel.tables import dump

    with open_axes(config, connect=False) as opened:
        return {name: dump(opened.bus, axis.id, config.axes[name].model) for name, axis in opened.axes.items()}


def holder_of(config: RigConfig) -> int | None:
    """The process that holds the servos' port; None if none does."""
    from drivers.serial_port import holder

    return holder(config.bus.port)


def stop(config: RigConfig) -> int | None:
    """Stop all axes now; they hold with their torque on.

    Returns
    -------
    int or None
        The process that held the port and was asked to stop them; None if it was free, and they were stopped from here.

    Raises
    ------
    DeviceError
        If a servo cannot be reached, or the process does not let go of the port.
    """
    pid = holder_of(config)
    if pid is not None:
        os.kill(pid, signal.SIGINT)
        deadline = time.monotonic() + _HOLDER_S
        while holder_of(config) == pid:
            if time.monotonic() > deadline:
                raise DeviceError(
                    f"process {pid}, which holds {config.bus.port}, was asked to stop and still holds it after "
                    f"{_HOLDER_S:g} s; cut the power of the servos if anything moves"
                )
            time.sleep(_STEP_S)
    with open_axes(config, connect=False) as opened:
        opened.bus.stop_all()
    return pid
