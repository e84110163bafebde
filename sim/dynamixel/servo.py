"""One X-series servo: control table, firmware behaviour, and a shaft that moves.

Nothing ticks: every question is answered for the time at which it is asked, from profiles in closed form. The encoder
reports whole counts of a shaft that comes to rest between them, and `Servo.output_counts` says where the link is that
the shaft drives (see `sim.dynamixel.shaft`).

Not modelled: velocity, current and PWM modes; reverse, time-based profiles and torque-on-by-goal; ringing at the end
of a move; gravity (the shaft stays when torque goes off); the time that a reboot takes; current and temperature beyond
a plausible reading. Registers of what is not modelled refuse values other than the default with a Data Range error.

References
----------
ROBOTIS e-Manual, XM430-W350, https://emanual.robotis.com/docs/en/dxl/x/xm430-w350/, and DYNAMIXEL Protocol 2.0,
https://emanual.robotis.com/docs/en/dxl/protocol2/
"""

from __future__ import annotations

import math

from sim.dynamixel import motion
from sim.dynamixel.control_table import XM430_W350, Model, Register
from sim.dynamixel.faults import Fault
from sim.dynamixel.motion import ACCELERATION_UNIT, COUNTS_PER_TURN, VELOCITY_UNIT
from sim.dynamixel.packet import ErrorNumber
from sim.dynamixel.shaft import Shaft

IN_POSITION_COUNTS = 16  # "smaller than a predefined value", the manual says; it does not say which
FOLLOWING_ERROR_COUNTS = 64  # as little known
WATCHDOG_UNIT_S = 0.020

_SHAPE_BITS = {"step": 0, "rectangle": 1, "triangle": 2, "trapezoid": 3}
_GOALS = frozenset((100, 102, 104, 116))  # read-only while a bus watchdog error is active


class Refused(Exception):
    """Not an error of ours: the servo answers with an error number."""

    def __init__(self, number: ErrorNumber) -> None:
        super().__init__(number.name)
        self.number = number


class Servo:
    """A servo with its registers, its shaft and the link that it drives.

    Parameters
    ----------
    id : int
        0 to 252.
    model : Model, optional
    initial_counts : float, optional
        Where the shaft is when power comes on [counts].
    backlash_counts : float, optional
        Play between shaft and link, from flank to flank [counts]; 0.25 degrees by default.
    friction_counts : tuple of float, optional
        Smallest and largest distance from the goal at which friction stops the shaft [counts].
    seed : int, optional
        Of the friction.
    baud_code : int, optional
        Baud Rate register as a previous user left it; 3 is 1 Mbit/s, the factory's 1 is 57.6 kbit/s.
    """

    def __init__(
        self,
        id: int,
        model: Model = XM430_W350,
        *,
        initial_counts: float = 2048.0,
        backlash_counts: float = 0.25 / 360.0 * COUNTS_PER_TURN,
        friction_counts: tuple[float, float] = (0.2, 3.0),
        seed: int = 0,
        baud_code: int = 3,
    ) -> None:
        self.model = model
        self._memory = bytearray(model.size)
        self._shaft = Shaft(
            initial_counts,
            fastest=model.no_load_speed / 60.0 * COUNTS_PER_TURN,
            backlash=backlash_counts,
            friction=friction_counts,
            seed=f"{seed}:{id}",
        )
        self._trajectory = motion.rest(0.0, initial_counts)
        self._fold = 0  # counts that make Present Position start within one turn
        self._goal_pending = False  # a goal was written while torque was off
        self._registered: tuple[int, bytes] | None = None
        self._last_instruction = 0.0
        self._goal_writes = 0
        self._faults: list[tuple[Fault, float | None]] = []
        for register in model.registers:
            self._poke(register, register.default)
        self._poke(model.by_name["ID"], id)
        self._poke(model.by_name["Baud Rate"], baud_code)
        self._start_ram(0.0)

    # ---- what the world and the bus ask ------------------------------------------------------------------------

    @property
    def id(self) -> int:
        """Register 7."""
        return self._memory[7]

    @property
    def shadow_id(self) -> int:
        """Register 12; 253 and above is none."""
        return self._memory[12]

    @property
    def baud_code(self) -> int:
        """Register 8."""
        return self._memory[8]

    @property
    def status_return_level(self) -> int:
        """Register 68."""
        return self._memory[68]

    @property
    def return_delay_s(self) -> float:
        """Register 9 [s]."""
        return self._memory[9] * 2e-6

    @property
    def alert(self) -> bool:
        """Hardware Error Status is not zero."""
        return self._memory[70] != 0

    @property
    def torque(self) -> bool:
        """Register 64."""
        return self._memory[64] != 0

    @property
    def goal_writes(self) -> int:
        """How often Goal Position was written."""
        return self._goal_writes

    def shaft_counts(self, t: float) -> float:
        """Where the shaft is, before the encoder rounds and without homing offset [counts]."""
        self.advance(t)
        return self._shaft.at(t)[0]

    def output_counts(self, t: float) -> float:
        """Where the link is [counts].

        After an increasing approach longer than the play it is ``shaft - backlash / 2``, after a decreasing one
        ``shaft + backlash / 2``.
        """
        self.advance(t)
        return self._shaft.link(t)

    def advance(self, t: float) -> None:
        """Let everything happen that was due by `t` [s]: scheduled faults and the bus watchdog."""
        for fault, moment in list(self._faults):
            if moment is not None and t >= moment:
                self._faults.remove((fault, moment))
                self._strike(fault, moment)
        watchdog = self._peek("Bus Watchdog")
        if watchdog > 0 and self.torque:
            due = self._last_instruction + watchdog * WATCHDOG_UNIT_S
            if t > due:
                self._halt(due)
                self._poke(self.model.by_name["Bus Watchdog"], -1)
                self._poke(self.model.by_name["Profile Acceleration"], 0)
                self._poke(self.model.by_name["Profile Velocity"], 0)

    def schedule(self, fault: Fault) -> None:
        """Have a ``"hardware"`` or ``"stuck"`` fault happen at its time or goal write."""
        self._faults.append((fault, fault.at_time_s))

    def heard(self, t: float) -> None:
        """An instruction packet for this servo arrived; feeds the bus watchdog."""
        self.advance(t)
        self._last_instruction = t

    # ---- instructions ------------------------------------------------------------------------------------------

    def read(self, address: int, length: int, t: float) -> bytes:
        """Read `length` bytes from `address`.

        Raises
        ------
        Refused
            Access, if a byte is not defined; Data Length, if none is asked for.
        """
        self.advance(t)
        if length < 1:
            raise Refused(ErrorNumber.DATA_LENGTH)
        self._refresh(t)
        where = [self._resolve(a) for a in range(address, address + length)]
        if any(a not in self.model.covering for a in where):
            raise Refused(ErrorNumber.ACCESS)
        return bytes(self._memory[a] for a in where)

    def write(self, address: int, data: bytes, t: float, *, eeprom: bool = True) -> None:
        """Write `data` at `address`, all or nothing.

        Raises
        ------
        Refused
            Access, Data Length, Data Range or Data Limit.
        """
        self.advance(t)
        for register, value in self._items(address, data, eeprom):
            self._apply(register, value, t)

    def reg_write(self, address: int, data: bytes, t: float) -> None:
        """Check a write and keep it for `action`; a second one replaces the first."""
        self.advance(t)
        self._items(address, data, True)
        self._registered = (address, data)
        self._memory[69] = 1

    def action(self, t: float) -> None:
        """Execute the registered write.

        Raises
        ------
        Refused
            Instruction error, if there is none.
        """
        if self._registered is None:
            raise Refused(ErrorNumber.INSTRUCTION)
        (address, data), self._registered = self._registered, None
        self._memory[69] = 0
        self.write(address, data, t)

    def reboot(self, t: float) -> None:
        """Restart: RAM to defaults, torque off, hardware errors cleared, turns forgotten."""
        self.advance(t)
        self._halt(t)
        self._start_ram(t)

    def factory_reset(self, option: int, t: float) -> None:
        """Defaults everywhere; 0x01 keeps the ID, 0x02 keeps ID and baud rate.

        Raises
        ------
        Refused
            Data Range, if `option` is another.
        """
        if option not in (0xFF, 0x01, 0x02):
            raise Refused(ErrorNumber.DATA_RANGE)
        kept = {0xFF: (), 0x01: (7,), 0x02: (7, 8)}[option]
        for register in self.model.registers:
            if register.eeprom and register.address not in kept:
                self._poke(register, register.default)
        self.reboot(t)

    def clear(self, params: bytes, t: float) -> None:
        """Clear the multi-turn position.

        Raises
        ------
        Refused
            Data Range, if `params` are not the manual's; Result Fail, if the shaft moves.
        """
        self.advance(t)
        if params != b"\x01\x44\x58\x4c\x22":
            raise Refused(ErrorNumber.DATA_RANGE)
        if not self._shaft.done(t):
            raise Refused(ErrorNumber.RESULT_FAIL)
        self._fold_position(t)

    # ---- registers ---------------------------------------------------------------------------------------------

    def _peek(self, name: str) -> int:
        register = self.model.by_name[name]
        raw = self._memory[register.address : register.address + register.size]
        return int.from_bytes(raw, "little", signed=register.signed)

    def _poke(self, register: Register, value: int) -> None:
        end = register.address + register.size
        mask = (1 << 8 * register.size) - 1
        self._memory[register.address : end] = (value & mask).to_bytes(register.size, "little")

    def _set(self, name: str, value: int) -> None:
        self._poke(self.model.by_name[name], value)

    def _resolve(self, address: int) -> int:
        """Follow an indirect address to the byte that it stands for."""
        for block in self.model.indirect:
            if block.data <= address < block.data + block.count:
                slot = block.address + 2 * (address - block.data)
                return int.from_bytes(self._memory[slot : slot + 2], "little")
        return address

    def _items(self, address: int, data: bytes, eeprom: bool) -> list[tuple[Register, int]]:
        """Split a write into registers and values, and refuse it if one of them may not be written."""
        if not data:
            raise Refused(ErrorNumber.DATA_LENGTH)
        where = [self._resolve(a) for a in range(address, address + len(data))]
        items = []
        k = 0
        while k < len(data):
            register = self.model.covering.get(where[k])
            if register is None or not register.writable or (register.eeprom and (self.torque or not eeprom)):
                raise Refused(ErrorNumber.ACCESS)
            wanted = list(range(register.address, register.address + register.size))
            if where[k : k + register.size] != wanted:
                raise Refused(ErrorNumber.DATA_LENGTH)
            value = int.from_bytes(data[k : k + register.size], "little", signed=register.signed)
            self._check(register, value)
            items.append((register, value))
            k += register.size
        return items

    def _check(self, register: Register, value: int) -> None:
        if not register.lower <= value <= register.upper:
            # What lies outside the limits that the user set, and inside those of the table, is a Data Limit error.
            limit = register.address == 116 and self._peek("Operating Mode") == 3
            raise Refused(ErrorNumber.DATA_LIMIT if limit else ErrorNumber.DATA_RANGE)
        if register.address in _GOALS and self._peek("Bus Watchdog") < 0:
            raise Refused(ErrorNumber.DATA_RANGE)
        if register.address == 11 and value not in self.model.operating_modes:
            raise Refused(ErrorNumber.DATA_RANGE)
        if register.address == 64 and value == 1 and self._memory[70] & self._memory[63]:
            raise Refused(ErrorNumber.RESULT_FAIL)  # shut down; only a reboot restores torque
        lower, upper = register.lower, register.upper
        if register.address == 116 and self._peek("Operating Mode") == 3:
            lower, upper = self._peek("Min Position Limit"), self._peek("Max Position Limit")
        elif register.address == 104:
            lower, upper = -self._peek("Velocity Limit"), self._peek("Velocity Limit")
        elif register.address == 102:
            lower, upper = -self._peek("Current Limit"), self._peek("Current Limit")
        elif register.address == 100:
            lower, upper = -self._peek("PWM Limit"), self._peek("PWM Limit")
        if not lower <= value <= upper:
            raise Refused(ErrorNumber.DATA_LIMIT)

    def _apply(self, register: Register, value: int, t: float) -> None:
        before = self._peek(register.name)
        self._poke(register, value)
        if register.address == 116:
            self._goal_written(t)
        elif register.address == 64 and value != before:
            if value:
                self._torque_on(t)
            else:
                self._halt(t)
        elif register.address == 11 and value != before:
            if value == 3:
                self._fold_position(t)
            for name in ("Position D Gain", "Position I Gain", "Position P Gain", "Velocity I Gain", "Velocity P Gain"):
                self._set(name, self.model.by_name[name].default)
            self._set("Profile Acceleration", 0)
            self._set("Profile Velocity", 0)
            self._set("Goal PWM", self._peek("PWM Limit"))

    def _refresh(self, t: float) -> None:
        """Bring the registers that change by themselves up to date."""
        position, velocity = self._shaft.at(t)
        wanted, wanted_velocity = self._trajectory.at(t)
        present = round(position - self._fold) + self._offset
        following = round(wanted - self._fold) + self._offset
        if not self.torque and not self._goal_pending:
            self._set("Goal Position", present)
        goal = self._peek("Goal Position")
        ongoing = not self._trajectory.done(t)
        speed = round(velocity / VELOCITY_UNIT)
        status = int(self.torque and not ongoing and abs(goal - present) <= IN_POSITION_COUNTS)
        status |= int(ongoing) << 1
        status |= int(self.torque and abs(following - present) > FOLLOWING_ERROR_COUNTS) << 3
        status |= _SHAPE_BITS[self._trajectory.shape] << 4
        self._set("Realtime Tick", int(t * 1000.0) & 0x7FFF)
        self._set("Moving", int(ongoing or abs(speed) > self._peek("Moving Threshold")))
        self._set("Moving Status", status)
        effort = 0
        if self.torque:
            pull = goal - present if not ongoing else (40 if wanted_velocity > 0 else -40)
            effort = max(-400, min(400, pull if not self._shaft.stuck else 10 * (goal - present)))
        self._set("Present PWM", effort)
        self._set("Present Load" if "Present Load" in self.model.by_name else "Present Current", effort)
        self._set("Present Velocity", speed)
        self._set("Present Position", present)
        self._set("Velocity Trajectory", round(wanted_velocity / VELOCITY_UNIT))
        self._set("Position Trajectory", following)
        self._set("Present Input Voltage", (self._peek("Max Voltage Limit") + self._peek("Min Voltage Limit")) // 2)
        self._set("Present Temperature", 31)

    @property
    def _offset(self) -> int:
        """Homing Offset, which position mode ignores beyond a quarter turn."""
        offset = self._peek("Homing Offset")
        return 0 if self._peek("Operating Mode") == 3 and abs(offset) > COUNTS_PER_TURN // 4 else offset

    # ---- motion ------------------------------------------------------------------------------------------------

    def _start_ram(self, t: float) -> None:
        for register in self.model.registers:
            if not register.eeprom:
                self._poke(register, register.default)
        self._goal_pending = False
        self._registered = None
        self._last_instruction = t
        self._set("Goal PWM", self._peek("PWM Limit"))
        if "Goal Current" in self.model.by_name:
            self._set("Goal Current", self._peek("Current Limit"))
        self._fold_position(t)

    def _fold_position(self, t: float) -> None:
        """Make Present Position start within one turn; the shaft does not move."""
        position = self._shaft.at(t)[0]
        self._fold = COUNTS_PER_TURN * (round(position) // COUNTS_PER_TURN)

    def _torque_on(self, t: float) -> None:
        """Hold the present position, unless a goal was written while torque was off: that one is then executed."""
        if self._peek("Operating Mode") == 3:
            self._fold_position(t)
        if self._goal_pending:
            self._go(t)
        else:
            self._trajectory = motion.rest(t, self._shaft.at(t)[0])
            self._set("Goal Position", round(self._shaft.at(t)[0] - self._fold) + self._offset)

    def _halt(self, t: float) -> None:
        """Stand still here, at once."""
        self._shaft.hold(t)
        self._trajectory = motion.rest(t, self._shaft.at(t)[0])
        self._goal_pending = False

    def _goal_written(self, t: float) -> None:
        self._goal_writes += 1
        if self.torque:
            self._go(t)
        else:
            self._goal_pending = True
        for fault, due in list(self._faults):
            if due is None and fault.at_goal_write == self._goal_writes:
                self._faults.remove((fault, due))
                self._faults.append((fault, t + fault.after_s))
        self.advance(t)

    def _go(self, t: float) -> None:
        """Start a profile from where the shaft is to the goal."""
        self._goal_pending = False
        goal = self._peek("Goal Position") - self._offset + self._fold
        profile_velocity = self._peek("Profile Velocity") * VELOCITY_UNIT or math.inf
        profile_acceleration = self._peek("Profile Acceleration") * ACCELERATION_UNIT or math.inf
        wanted, wanted_velocity = self._trajectory.at(t)
        self._trajectory = motion.plan(t, wanted, wanted_velocity, goal, profile_velocity, profile_acceleration)
        self._shaft.go(t, goal, profile_velocity, profile_acceleration)

    def _strike(self, fault: Fault, t: float) -> None:
        if fault.kind == "stuck":
            self._shaft.seize(t)
        elif fault.kind == "hardware":
            self._memory[70] |= fault.bits
            if self._memory[70] & self._memory[63]:
                self._halt(t)
                self._memory[64] = 0
