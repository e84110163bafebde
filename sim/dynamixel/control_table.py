"""Control tables of the X-series models that the simulator knows, as data.

Addresses, sizes, access, defaults, ranges and units follow the control tables of the manufacturer's manual. A table says
what may be read and written, and since which firmware; what a register does is the business of `sim.dynamixel.servo`.
The motor's figures are those of the data sheet at its nominal voltage.

References
----------
ROBOTIS e-Manual, "Control Table of EEPROM Area" and "Control Table of RAM Area" of
https://emanual.robotis.com/docs/en/dxl/x/xm430-w350/, .../xl430-w250/ and .../xl330-m288/
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

RAM_START = 64  # everything below is EEPROM, locked while torque is on
BAUD_RATES = (9_600, 57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)


UNITS: Mapping[str, tuple[float, str]] = {
    "Return Delay Time": (2.0, "us"),
    "Homing Offset": (360.0 / 4096.0, "deg"),
    "Moving Threshold": (0.229, "rev/min"),
    "Temperature Limit": (1.0, "C"),
    "Max Voltage Limit": (0.1, "V"),
    "Min Voltage Limit": (0.1, "V"),
    "PWM Limit": (100.0 / 885.0, "%"),
    "Velocity Limit": (0.229, "rev/min"),
    "Max Position Limit": (360.0 / 4096.0, "deg"),
    "Min Position Limit": (360.0 / 4096.0, "deg"),
    "PWM Slope": (1.977, "mV/ms"),
    "Bus Watchdog": (20.0, "ms"),
    "Goal PWM": (100.0 / 885.0, "%"),
    "Goal Velocity": (0.229, "rev/min"),
    "Profile Acceleration": (214.577, "rev/min^2"),
    "Profile Velocity": (0.229, "rev/min"),
    "Goal Position": (360.0 / 4096.0, "deg"),
    "Realtime Tick": (1.0, "ms"),
    "Present PWM": (100.0 / 885.0, "%"),
    "Present Load": (0.1, "%"),
    "Present Velocity": (0.229, "rev/min"),
    "Present Position": (360.0 / 4096.0, "deg"),
    "Velocity Trajectory": (0.229, "rev/min"),
    "Position Trajectory": (360.0 / 4096.0, "deg"),
    "Present Input Voltage": (0.1, "V"),
    "Present Temperature": (1.0, "C"),
}
"""Of one count. Currents differ from model to model: `Motor.current_unit_a`. A profile's units are those of its
velocity-based form; a time-based one counts milliseconds."""


@dataclass(frozen=True)
class Motor:
    """What the data sheet says of motor and gear at the nominal voltage.

    Attributes
    ----------
    voltage_v : float
        Nominal [V].
    no_load_speed : float
        [rev/min]
    stall_torque_nm, stall_current_a : float
    current_unit_a : float or None
        One count of the current registers [A]; None if the model measures load instead.
    """

    voltage_v: float
    no_load_speed: float
    stall_torque_nm: float
    stall_current_a: float
    current_unit_a: float | None


@dataclass(frozen=True)
class Register:
    """One item of a control table.

    Attributes
    ----------
    address, size : int
        First byte and number of bytes (little endian).
    name : str
        As in the manual.
    writable : bool
        Read-write; otherwise read-only.
    default : int
        After a factory reset (EEPROM) or a reboot (RAM).
    lower, upper : int
        Smallest and largest value that a write may have.
    signed : bool
        Two's complement.
    since : int
        First firmware that has it.
    """

    address: int
    size: int
    name: str
    writable: bool
    default: int = 0
    lower: int = 0
    upper: int = 0
    signed: bool = False
    since: int = 0

    @property
    def unit(self) -> tuple[float, str]:
        """What one count means: a number and its unit; (1, "") for codes, bits and gains."""
        return UNITS.get(self.name, (1.0, ""))

    @property
    def eeprom(self) -> bool:
        """Kept without power and locked while torque is on."""
        return self.address < RAM_START


@dataclass(frozen=True)
class IndirectBlock:
    """`count` indirect addresses of two bytes from `address` on, and their data bytes from `data` on."""

    address: int
    data: int
    count: int


@dataclass(frozen=True)
class Model:
    """A servo model.

    Attributes
    ----------
    name : str
    number : int
        Model Number.
    firmware : int
        Firmware Version that a simulated servo reports unless it is made with another.
    motor : Motor
    newer_firmware : int
        First firmware with fast reads, control table backup, startup configuration and torque on by goal.
    operating_modes : tuple of int
        0 current, 1 velocity, 3 position, 4 extended position, 5 current-based position, 16 PWM.
    registers : tuple of Register
        In order of address.
    indirect : tuple of IndirectBlock
    indirect_range : tuple of int
        Smallest and largest address that an indirect address may point at.
    """

    name: str
    number: int
    firmware: int
    motor: Motor
    newer_firmware: int
    operating_modes: tuple[int, ...]
    registers: tuple[Register, ...]
    indirect: tuple[IndirectBlock, ...]
    indirect_range: tuple[int, int]

    @cached_property
    def at(self) -> Mapping[int, Register]:
        """Registers by first address."""
        return {register.address: register for register in self.registers}

    @cached_property
    def covering(self) -> Mapping[int, Register]:
        """Registers by every address that they cover."""
        return {register.address + k: register for register in self.registers for k in range(register.size)}

    @cached_property
    def by_name(self) -> Mapping[str, Register]:
        """Registers by name."""
        return {register.name: register for register in self.registers}

    @cached_property
    def size(self) -> int:
        """Bytes in the table."""
        last = self.registers[-1]
        return last.address + last.size


_TURNS = 1_048_575  # 256 revolutions either way [pulse]
_OFFSET = 1_044_479


def _ram(current: str | None, current_limit: int, fastest: int, gains: tuple[int, ...], newer: int) -> list[Register]:
    """The RAM area; `current` names register 126, and register 102 exists unless the model measures load."""
    velocity_i, velocity_p, position_d, position_i, position_p = gains
    registers = [
        Register(64, 1, "Torque Enable", True, 0, 0, 1),
        Register(65, 1, "LED", True, 0, 0, 1),
        Register(68, 1, "Status Return Level", True, 2, 0, 2),
        Register(69, 1, "Registered Instruction", False),
        Register(70, 1, "Hardware Error Status", False),
        Register(76, 2, "Velocity I Gain", True, velocity_i, 0, 16_383),
        Register(78, 2, "Velocity P Gain", True, velocity_p, 0, 16_383),
        Register(80, 2, "Position D Gain", True, position_d, 0, 16_383),
        Register(82, 2, "Position I Gain", True, position_i, 0, 16_383),
        Register(84, 2, "Position P Gain", True, position_p, 0, 16_383),
        Register(88, 2, "Feedforward 2nd Gain", True, 0, 0, 16_383),
        Register(90, 2, "Feedforward 1st Gain", True, 0, 0, 16_383),
        Register(98, 1, "Bus Watchdog", True, 0, 0, 127, signed=True),
        Register(100, 2, "Goal PWM", True, 885, -885, 885, signed=True),
    ]
    if current is None:
        current = "Present Load"
    else:
        registers.append(Register(102, 2, "Goal Current", True, current_limit, -current_limit, current_limit, signed=True))
    return [
        *registers,
        Register(104, 4, "Goal Velocity", True, 0, -fastest, fastest, signed=True),
        Register(108, 4, "Profile Acceleration", True, 0, 0, 32_767),
        Register(112, 4, "Profile Velocity", True, 0, 0, 32_767),
        Register(116, 4, "Goal Position", True, 0, -_TURNS, _TURNS, signed=True),
        Register(120, 2, "Realtime Tick", False),
        Register(122, 1, "Moving", False),
        Register(123, 1, "Moving Status", False),
        Register(124, 2, "Present PWM", False, signed=True),
        Register(126, 2, current, False, signed=True),
        Register(128, 4, "Present Velocity", False, signed=True),
        Register(132, 4, "Present Position", False, signed=True),
        Register(136, 4, "Velocity Trajectory", False, signed=True),
        Register(140, 4, "Position Trajectory", False, signed=True),
        Register(144, 2, "Present Input Voltage", False),
        Register(146, 1, "Present Temperature", False),
        Register(147, 1, "Backup Ready", False, since=newer),
    ]


def _eeprom(
    number: int,
    firmware: int,
    temperature: int,
    voltages: tuple[int, int, int, int],
    current_limit: int,
    velocities: tuple[int, int],
    shutdown: int,
    newer: int,
    fastest_baud: int = 7,
) -> list[Register]:
    """The EEPROM area; `voltages` are max, min, upper, lower; a current limit of 0 means that there is none."""
    max_voltage, min_voltage, highest, lowest = voltages
    velocity_limit, fastest = velocities
    registers = [
        Register(0, 2, "Model Number", False, number),
        Register(2, 4, "Model Information", False),
        Register(6, 1, "Firmware Version", False, firmware),
        Register(7, 1, "ID", True, 1, 0, 252),
        Register(8, 1, "Baud Rate", True, 1, 0, fastest_baud),
        Register(9, 1, "Return Delay Time", True, 250, 0, 254),
        Register(10, 1, "Drive Mode", True, 0, 0, 0x0D),
        Register(11, 1, "Operating Mode", True, 3, 0, 16),
        Register(12, 1, "Secondary(Shadow) ID", True, 255, 0, 255),
        Register(13, 1, "Protocol Type", True, 2, 2, 2),
        Register(20, 4, "Homing Offset", True, 0, -_OFFSET, _OFFSET, signed=True),
        Register(24, 4, "Moving Threshold", True, 10, 0, 1_023),
        Register(31, 1, "Temperature Limit", True, temperature, 0, 100),
        Register(32, 2, "Max Voltage Limit", True, max_voltage, lowest, highest),
        Register(34, 2, "Min Voltage Limit", True, min_voltage, lowest, highest),
        Register(36, 2, "PWM Limit", True, 885, 0, 885),
    ]
    if current_limit:
        registers.append(Register(38, 2, "Current Limit", True, current_limit, 0, current_limit))
    return [
        *registers,
        Register(44, 4, "Velocity Limit", True, velocity_limit, 0, fastest),
        Register(48, 4, "Max Position Limit", True, 4_095, 0, 4_095),
        Register(52, 4, "Min Position Limit", True, 0, 0, 4_095),
        Register(60, 1, "Startup Configuration", True, 0, 0, 3, since=newer),
        Register(63, 1, "Shutdown", True, shutdown, 0, 0xFF),
    ]


def _indirect(blocks: tuple[IndirectBlock, ...], limits: tuple[int, int]) -> list[Register]:
    registers, first = [], 1
    for block in blocks:
        for k in range(block.count):
            address = Register(
                block.address + 2 * k, 2, f"Indirect Address {first + k}", True, block.data + k, limits[0], limits[1]
            )
            registers += [address, Register(block.data + k, 1, f"Indirect Data {first + k}", True, 0, 0, 0xFF)]
        first += block.count
    return registers


def _model(
    name: str,
    *,
    number: int,
    firmware: int,
    motor: Motor,
    newer_firmware: int,
    eeprom: list[Register],
    ram: list[Register],
    blocks: tuple[IndirectBlock, ...],
    indirect_range: tuple[int, int],
) -> Model:
    registers = sorted([*eeprom, *ram, *_indirect(blocks, indirect_range)], key=lambda register: register.address)
    modes = (1, 3, 4, 16) if motor.current_unit_a is None else (0, 1, 3, 4, 5, 16)
    return Model(name, number, firmware, motor, newer_firmware, modes, tuple(registers), blocks, indirect_range)


_X430_BLOCKS = (IndirectBlock(168, 224, 28), IndirectBlock(578, 634, 28))

XM430_W350 = _model(
    "XM430-W350",
    number=1020,
    firmware=46,
    motor=Motor(12.0, 46.0, 4.1, 2.3, 2.69e-3),
    newer_firmware=45,
    eeprom=_eeprom(1020, 46, 80, (160, 95, 160, 95), 1_193, (200, 1_023), 52, 45),
    ram=_ram("Present Current", 1_193, 1_023, (1_920, 100, 0, 0, 800), 45),
    blocks=_X430_BLOCKS,
    indirect_range=(64, 661),
)

XL430_W250 = _model(
    "XL430-W250",
    number=1060,
    firmware=46,
    motor=Motor(11.1, 57.0, 1.4, 1.3, None),
    newer_firmware=45,
    eeprom=_eeprom(1060, 46, 72, (140, 60, 140, 60), 0, (265, 1_023), 52, 45),
    ram=_ram(None, 0, 1_023, (1_000, 100, 4_000, 0, 640), 45),
    blocks=_X430_BLOCKS,
    indirect_range=(64, 661),
)

XL330_M288 = _model(
    "XL330-M288",
    number=1200,
    firmware=47,
    motor=Motor(5.0, 103.0, 0.52, 1.5, 1e-3),
    newer_firmware=46,
    eeprom=[
        *_eeprom(1200, 47, 70, (70, 35, 70, 31), 1_750, (445, 2_047), 53, 46, 6),
        Register(62, 1, "PWM Slope", True, 140, 0, 255),
    ],
    ram=_ram("Present Current", 1_750, 2_047, (1_600, 180, 0, 0, 400), 46),
    blocks=(IndirectBlock(168, 208, 20),),
    indirect_range=(64, 227),
)

MODELS: Mapping[str, Model] = {model.name: model for model in (XM430_W350, XL430_W250, XL330_M288)}
