"""Registers of the Dynamixel X series that gonio uses, as data: address, size, sign, unit.

Source: ROBOTIS e-manual, control tables of XM430-W350, XL430-W250 and XL330-M288 (emanual.robotis.com/docs/en/dxl/x).
The addresses are common to the series; what differs between models is in `MODELS`. Nothing here talks to a servo.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Any

from gonio.errors import ParameterError, ProtocolError

COUNTS_PER_TURN = 4096
VELOCITY_UNIT = 0.229 * 2.0 * math.pi / 60.0  # rad/s, 0.229 rev/min
ACCELERATION_UNIT = 214.577 * 2.0 * math.pi / 3600.0  # rad/s^2, 214.577 rev/min^2
WATCHDOG_UNIT_S = 0.020
FULL_PWM = 885  # the whole supply voltage
VOLTAGE_UNIT_V = 0.1


@dataclass(frozen=True)
class Register:
    """One entry of the control table.

    Attributes
    ----------
    name : str
        As the manual writes it.
    address, size : int
        First byte and number of bytes (1, 2 or 4).
    signed : bool
        Two's complement. The vendor's SDK takes every value as unsigned, so -1 counts would read as 4294967295.
    unit : str
        Of one count.
    """

    name: str
    address: int
    size: int
    signed: bool = False
    unit: str = "1"

    def encode(self, value: int) -> bytes:
        """Little-endian bytes of `value`; `ParameterError` if it does not fit."""
        try:
            return int(value).to_bytes(self.size, "little", signed=self.signed)
        except OverflowError:
            kind = "signed" if self.signed else "unsigned"
            raise ParameterError(f"{self.name} = {value} does not fit its {self.size} {kind} bytes.") from None

    def decode(self, data: bytes) -> int:
        """Value of exactly `size` bytes."""
        if len(data) != self.size:
            raise ProtocolError(f"{self.name} has {self.size} bytes, {len(data)} arrived.")
        return int.from_bytes(data, "little", signed=self.signed)


MODEL_NUMBER = Register("Model Number", 0, 2)
FIRMWARE_VERSION = Register("Firmware Version", 6, 1)
SERVO_ID = Register("ID", 7, 1)
BAUD_RATE = Register("Baud Rate", 8, 1)
RETURN_DELAY_TIME = Register("Return Delay Time", 9, 1, unit="2 us")
DRIVE_MODE = Register("Drive Mode", 10, 1)
OPERATING_MODE = Register("Operating Mode", 11, 1)
PROTOCOL_TYPE = Register("Protocol Type", 13, 1)
HOMING_OFFSET = Register("Homing Offset", 20, 4, True, "count")
MAX_VOLTAGE_LIMIT = Register("Max Voltage Limit", 32, 2, unit="0.1 V")
MIN_VOLTAGE_LIMIT = Register("Min Voltage Limit", 34, 2, unit="0.1 V")
PWM_LIMIT = Register("PWM Limit", 36, 2, unit="0.113 %")
CURRENT_LIMIT = Register("Current Limit", 38, 2)  # unit by model; not on XL430
VELOCITY_LIMIT = Register("Velocity Limit", 44, 4, unit="0.229 rev/min")
MAX_POSITION_LIMIT = Register("Max Position Limit", 48, 4, unit="count")
MIN_POSITION_LIMIT = Register("Min Position Limit", 52, 4, unit="count")
TORQUE_ENABLE = Register("Torque Enable", 64, 1)
STATUS_RETURN_LEVEL = Register("Status Return Level", 68, 1)
HARDWARE_ERROR_STATUS = Register("Hardware Error Status", 70, 1)
POSITION_D_GAIN = Register("Position D Gain", 80, 2)
POSITION_I_GAIN = Register("Position I Gain", 82, 2)
POSITION_P_GAIN = Register("Position P Gain", 84, 2)
BUS_WATCHDOG = Register("Bus Watchdog", 98, 1, True, "20 ms")
GOAL_PWM = Register("Goal PWM", 100, 2, True, "0.113 %")
PROFILE_ACCELERATION = Register("Profile Acceleration", 108, 4, unit="214.577 rev/min^2")
PROFILE_VELOCITY = Register("Profile Velocity", 112, 4, unit="0.229 rev/min")
GOAL_POSITION = Register("Goal Position", 116, 4, True, "count")
REALTIME_TICK = Register("Realtime Tick", 120, 2, unit="ms")
MOVING = Register("Moving", 122, 1)
MOVING_STATUS = Register("Moving Status", 123, 1)
PRESENT_PWM = Register("Present PWM", 124, 2, True, "0.113 %")
PRESENT_CURRENT = Register("Present Current", 126, 2, True)  # unit by model; Present Load on XL430
PRESENT_VELOCITY = Register("Present Velocity", 128, 4, True, "0.229 rev/min")
PRESENT_POSITION = Register("Present Position", 132, 4, True, "count")
VELOCITY_TRAJECTORY = Register("Velocity Trajectory", 136, 4, True, "0.229 rev/min")
POSITION_TRAJECTORY = Register("Position Trajectory", 140, 4, True, "count")
PRESENT_VOLTAGE = Register("Present Input Voltage", 144, 2, unit="0.1 V")
PRESENT_TEMPERATURE = Register("Present Temperature", 146, 1, unit="degC")

POSITION_MODE = 3
BAUD_CODES = {9_600: 0, 57_600: 1, 115_200: 2, 1_000_000: 3, 2_000_000: 4, 3_000_000: 5, 4_000_000: 6}
STATUS_PROFILE_ONGOING = 0x02
DRIVE_REVERSE, DRIVE_TIME_BASED, DRIVE_TORQUE_BY_GOAL = 0x01, 0x04, 0x08

HARDWARE_ERRORS = {
    0x01: "input voltage",
    0x04: "overheating",
    0x08: "encoder",
    0x10: "electrical shock",
    0x20: "overload",
}

STATUS_ERRORS = {
    1: "result fail",
    2: "instruction error",
    3: "CRC error",
    4: "data range error",
    5: "data length error",
    6: "data limit error",
    7: "access error",
}


def hardware_errors(bits: int) -> str:
    """Names of the bits of Hardware Error Status, e.g. ``"overheating, overload"``."""
    known = [name for bit, name in HARDWARE_ERRORS.items() if bits & bit]
    unknown = bits & ~sum(HARDWARE_ERRORS)
    return ", ".join([*known, *([f"unknown bits 0x{unknown:02x}"] if unknown else [])]) or "none"


BLOCK = (
    GOAL_POSITION, REALTIME_TICK, MOVING, MOVING_STATUS, PRESENT_PWM, PRESENT_CURRENT, PRESENT_VELOCITY,
    PRESENT_POSITION, VELOCITY_TRAJECTORY, POSITION_TRAJECTORY, PRESENT_VOLTAGE, PRESENT_TEMPERATURE,
)  # fmt: skip
"""Contiguous registers 116 to 146, read in one go: a servo's state at one instant, of a length no other reply has."""

BLOCK_ADDRESS = BLOCK[0].address
BLOCK_SIZE = sum(register.size for register in BLOCK)
_LETTER = {(1, False): "B", (2, False): "H", (4, False): "I", (1, True): "b", (2, True): "h", (4, True): "i"}
_BLOCK_LAYOUT = struct.Struct("<" + "".join(_LETTER[register.size, register.signed] for register in BLOCK))


@dataclass(frozen=True)
class Block:
    """A servo's state at one instant, in the servo's units.

    Attributes
    ----------
    goal, position, position_trajectory : int
        Counts.
    tick : int
        The servo's own clock [ms], wraps at 32768.
    moving, status, pwm, current, velocity, velocity_trajectory, voltage, temperature : int
        Raw registers.
    alert : bool
        The servo reports a hardware error.
    sent_s, received_s : float
        Rig time before the request and after the reply [s]; the state belongs to an instant between the two.
    """

    goal: int
    tick: int
    moving: int
    status: int
    pwm: int
    current: int
    velocity: int
    position: int
    velocity_trajectory: int
    position_trajectory: int
    voltage: int
    temperature: int
    alert: bool
    sent_s: float
    received_s: float

    @property
    def in_motion(self) -> bool:
        """The shaft turns or a profile runs."""
        return bool(self.moving) or bool(self.status & STATUS_PROFILE_ONGOING)


def decode_block(data: bytes, *, alert: bool, sent_s: float, received_s: float) -> Block:
    """Block of the `BLOCK_SIZE` bytes from `BLOCK_ADDRESS` on."""
    if len(data) != BLOCK_SIZE:
        raise ProtocolError(f"a state block has {BLOCK_SIZE} bytes, {len(data)} arrived.")
    values: list[Any] = [*_BLOCK_LAYOUT.unpack(data), alert, sent_s, received_s]
    return Block(*values)


@dataclass(frozen=True)
class ServoModel:
    """What differs between the models.

    Attributes
    ----------
    name : str
        As on the label.
    number : int
        Register Model Number.
    current_unit_a : float or None
        Of Present Current and Current Limit [A]; None where there is no current sensor.
    highest_current : int
        That Current Limit takes, in that unit; 0 where there is none.
    """

    name: str
    number: int
    current_unit_a: float | None
    highest_current: int


MODELS = {
    model.name: model
    for model in (
        ServoModel("XM430-W350", 1020, 0.00269, 1193),
        ServoModel("XM430-W210", 1030, 0.00269, 1193),
        ServoModel("XM540-W270", 1120, 0.00269, 2047),
        ServoModel("XM540-W150", 1130, 0.00269, 2047),
        ServoModel("XL430-W250", 1060, None, 0),
        ServoModel("XL330-M077", 1190, 0.001, 1750),
        ServoModel("XL330-M288", 1200, 0.001, 1750),
    )
}
