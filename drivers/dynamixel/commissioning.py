"""Bringing a servo into service: is it the right one, is it healthy, does it hold the axis's settings?

What is already right is not written again. EEPROM takes a write only while torque is off, so torque goes off, for a
moment and with a warning in the log, if and only if a setting there has to change that nothing else keeps. `torque_on` then
gives it back. It moves nothing.

References: ROBOTIS e-manual, XM430-W350, sections on Drive Mode, Operating Mode, PWM, Current, Velocity and Position Limit
(emanual.robotis.com/docs/en/dxl/x/xm430-w350).
"""

from __future__ import annotations

import logging

from drivers.dynamixel import registers as reg
from drivers.dynamixel.bus import Bus
from drivers.dynamixel.joint import Joint
from drivers.dynamixel.settings import Settings
from gonio.errors import DeviceError, HardwareStatusError, LimitError

logger = logging.getLogger(__name__)

_IN_RAM_TOO = {reg.VELOCITY_LIMIT, reg.CURRENT_LIMIT, reg.PWM_LIMIT}  # the profile, gonio's watch, Goal PWM bound the same


def commission(bus: Bus, servo_id: int, settings: Settings) -> dict[str, object]:
    """Check the servo, give it the settings, and return its identity (JSON-compatible); torque stays, or is off.

    Raises
    ------
    DeviceError
        With the first thing that is wrong.
    """
    identity = _identify(bus, servo_id, settings.model)
    identity |= _check_health(bus, servo_id)
    write_eeprom(bus, servo_id, settings)
    if bus.read(servo_id, reg.BUS_WATCHDOG) != 0:  # tripped, or left armed by a process that died
        bus.write(servo_id, reg.BUS_WATCHDOG, 0)
    profile = {
        reg.PROFILE_ACCELERATION: settings.profile_acceleration,
        reg.PROFILE_VELOCITY: settings.profile_velocity,
    }
    _write_checked(bus, servo_id, profile, "lower the axis's velocity")
    if settings.pwm_limit is not None:
        _write_checked(bus, servo_id, {reg.GOAL_PWM: settings.pwm_limit}, "power-cycle it and retry")
    for register in (reg.HOMING_OFFSET, reg.POSITION_P_GAIN, reg.POSITION_I_GAIN, reg.POSITION_D_GAIN):
        identity[register.name.lower().replace(" ", "_")] = bus.read(servo_id, register)
    return identity


def torque_on(bus: Bus, servo_id: int, joint: Joint) -> int:
    """Torque on without a jump; returns the goal at which the servo holds [counts].

    Raises
    ------
    LimitError
        If it stands outside the joint's limits.
    DeviceError
        If the torque stays off.
    """
    present = bus.agreed_block(servo_id)
    holds = bool(bus.read(servo_id, reg.TORQUE_ENABLE))
    goal = joint.clip(present.position)
    if abs(goal - present.position) > joint.tolerance_counts:
        raise LimitError(
            f"{bus.label(servo_id)} stands at {joint.degrees(present.position):.2f} deg, outside its limits of "
            f"{joint.limits_text}; {'switch its torque off and ' if holds else ''}turn it into them by hand, "
            "or correct the limits."
        )
    if holds and not present.in_motion:
        goal = present.goal  # a new one would only move it
    if present.goal != goal:
        bus.command(servo_id, reg.GOAL_POSITION, goal)
    if not holds:
        bus.command(servo_id, reg.TORQUE_ENABLE, 1)
        if not bus.read(servo_id, reg.TORQUE_ENABLE):
            raise DeviceError(f"{bus.label(servo_id)} does not switch its torque on; power-cycle it and retry.")
    return bus.block(servo_id).goal


def _identify(bus: Bus, servo_id: int, model: reg.ServoModel) -> dict[str, object]:
    number, firmware = bus.ping(servo_id)
    if number != model.number:
        found = next((m.name for m in reg.MODELS.values() if m.number == number), "a model unknown to gonio")
        raise DeviceError(
            f"{bus.label(servo_id)} is model number {number} ({found}), rig.toml says {model.name} ({model.number}); "
            "correct the model or the id."
        )
    # A servo set to answer only pings or reads is told to answer everything; a retry then gets its answer.
    bus.write(servo_id, reg.STATUS_RETURN_LEVEL, 2)
    protocol = bus.read(servo_id, reg.PROTOCOL_TYPE)
    if protocol != 2:
        raise DeviceError(
            f"{bus.label(servo_id)} has Protocol Type {protocol}, gonio needs 2; set it with the maker's tool."
        )
    return {"model": model.name, "model_number": number, "firmware": firmware, "id": servo_id}


def _check_health(bus: Bus, servo_id: int) -> dict[str, object]:
    if bus.read(servo_id, reg.HARDWARE_ERROR_STATUS):
        raise bus.hardware_fault(servo_id)
    volts = bus.read(servo_id, reg.PRESENT_VOLTAGE) * reg.VOLTAGE_UNIT_V
    low = bus.read(servo_id, reg.MIN_VOLTAGE_LIMIT) * reg.VOLTAGE_UNIT_V
    high = bus.read(servo_id, reg.MAX_VOLTAGE_LIMIT) * reg.VOLTAGE_UNIT_V
    if not low <= volts <= high:
        raise HardwareStatusError(
            f"{bus.label(servo_id)} has a supply of {volts:.1f} V, its range is {low:.1f} to {high:.1f} V; "
            "check the power supply."
        )
    return {"voltage_v": round(volts, 1)}


def eeprom_changes(bus: Bus, servo_id: int, settings: Settings) -> dict[reg.Register, tuple[int, int]]:
    """Registers in EEPROM that differ from the settings: what they hold, and what they should."""
    # `direction` in rig.toml reverses; a time-based profile would take our velocity for milliseconds; torque that
    # comes on with a goal would undo the order in which it is switched on.
    unwanted = reg.DRIVE_REVERSE | reg.DRIVE_TIME_BASED | reg.DRIVE_TORQUE_BY_GOAL
    wanted = {
        reg.RETURN_DELAY_TIME: 0,
        reg.DRIVE_MODE: bus.read(servo_id, reg.DRIVE_MODE) & ~unwanted,
        reg.OPERATING_MODE: reg.POSITION_MODE,  # the mode in which the servo itself keeps to its limits
        reg.MAX_POSITION_LIMIT: settings.high,
        reg.MIN_POSITION_LIMIT: settings.low,
        reg.VELOCITY_LIMIT: settings.profile_velocity,
    }
    if settings.current_limit is not None:
        wanted[reg.CURRENT_LIMIT] = settings.current_limit
    if settings.pwm_limit is not None:
        wanted[reg.PWM_LIMIT] = settings.pwm_limit
    found = {register: bus.read(servo_id, register) for register in wanted}
    return {register: (found[register], value) for register, value in wanted.items() if found[register] != value}


def write_eeprom(bus: Bus, servo_id: int, settings: Settings) -> None:
    """Put the settings into EEPROM, with torque off for a moment if something has to change.

    Limits that registers in RAM keep as well are no reason to let go of an arm; they are then left, with a warning.
    """
    changes = {register: value for register, (_, value) in eeprom_changes(bus, servo_id, settings).items()}
    if not changes:
        return
    if bus.read(servo_id, reg.TORQUE_ENABLE):
        names = ", ".join(register.name for register in changes)
        if changes.keys() <= _IN_RAM_TOO:
            logger.warning(
                "%s holds with its torque on, so %s stays as it is; `gonio rig setup` writes it", bus.label(servo_id), names
            )
            return
        logger.warning("%s: torque off for a moment to change %s", bus.label(servo_id), names)
        bus.write(servo_id, reg.TORQUE_ENABLE, 0)
    _write_checked(bus, servo_id, changes, "power-cycle it and retry")


def _write_checked(bus: Bus, servo_id: int, values: dict[reg.Register, int], remedy: str) -> None:
    for register, value in values.items():
        bus.write(servo_id, register, value)
        found = bus.read(servo_id, register)
        if found != value:
            raise DeviceError(f"{bus.label(servo_id)} keeps {register.name} = {found}, {value} was written; {remedy}.")
