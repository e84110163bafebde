"""One X-series servo: the firmware's behaviour between a control table and a motor.

Nothing ticks: every question is answered for the time at which it is asked, from profiles in closed form. The encoder
reports whole counts of a shaft that comes to rest between them, and `Servo.output_counts` says where the link is that
the shaft drives (see `sim.dynamixel.shaft`); what the motor feels is in `sim.dynamixel.drive`.

Not modelled: the time that a reboot takes, RC protocols, the gains' dynamics (the proportional gain says how far a load
pulls the shaft from its goal, an integral gain that it does not), the LED's blinking.

References
----------
ROBOTIS e-Manual, XM430-W350, https://emanual.robotis.com/docs/en/dxl/x/xm430-w350/, and DYNAMIXEL Protocol 2.0,
https://emanual.robotis.com/docs/en/dxl/protocol2/
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

from sim.dynamixel.control_table import XM430_W350, Model, Register
from sim.dynamixel.drive import Drive
from sim.dynamixel.faults import INPUT_VOLTAGE, OVERHEATING, OVERLOAD, Fault
from sim.dynamixel.load import Load
from sim.dynamixel.memory import Memory, Refused
from sim.dynamixel.modes import (
    GOAL_OF_MODE,
    POSITION,
    TORQUE_BY_GOAL,
    check,
    homing_offset,
    initial_goals,
    refresh,
    sign,
    start,
)
from sim.dynamixel.motion import COUNTS_PER_TURN
from sim.dynamixel.packet import ErrorNumber

__all__ = ["Refused", "Servo"]

WATCHDOG_UNIT_S = 0.020
_GAINS = ("Position D Gain", "Position I Gain", "Position P Gain", "Velocity I Gain", "Velocity P Gain")


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
    harmonics : sequence of tuple of float, optional
        Errors of the encoder: (n, amplitude [counts], phase [rad]) of each wave; the shaft's true place is
        ``e + sum(amplitude sin(n 2 pi e / 4096 + phase))`` where the encoder says e.
    load : Load, optional
        Weight of the joint.
    supply_v : float, optional
        Voltage of the supply [V]; the model's nominal one by default.
    seed : int, optional
        Of the friction.
    baud_code : int, optional
        Baud Rate register as a previous user left it; 3 is 1 Mbit/s, the factory's 1 is 57.6 kbit/s.
    firmware : int, optional
        Version; the model's by default. Older ones lack what the manual dates.
    """

    def __init__(
        self,
        id: int,
        model: Model = XM430_W350,
        *,
        initial_counts: float = 2048.0,
        backlash_counts: float = 0.25 / 360.0 * COUNTS_PER_TURN,
        friction_counts: tuple[float, float] = (0.2, 3.0),
        harmonics: tuple[tuple[int, float, float], ...] = (),
        load: Load | None = None,
        supply_v: float | None = None,
        seed: int = 0,
        baud_code: int = 3,
        firmware: int | None = None,
    ) -> None:
        self.model = model
        self.firmware = model.firmware if firmware is None else firmware
        self._memory = Memory(model, self.firmware)
        self._drive = Drive(
            model.motor,
            initial_counts,
            backlash=backlash_counts,
            friction=friction_counts,
            load=load or Load(),
            supply_v=model.motor.voltage_v if supply_v is None else supply_v,
            seed=f"{seed}:{id}",
        )
        self._harmonics = tuple(harmonics)
        self._fold = 0  # counts that make Present Position start within one turn
        self._goal_pending = False  # a goal was written while torque was off
        self._registered: tuple[int, bytes] | None = None
        self._last_instruction = 0.0
        self._goal_writes = 0
        self._faults: list[tuple[Fault, float | None]] = []
        self._memory["ID"] = id
        self._memory["Baud Rate"] = baud_code
        self._start_ram(0.0)

    # ---- what the world and the bus ask ------------------------------------------------------------------------

    @property
    def id(self) -> int:
        """Register 7."""
        return self._memory["ID"]

    @property
    def shadow_id(self) -> int:
        """Register 12; 253 and above is none."""
        return self._memory["Secondary(Shadow) ID"]

    @property
    def baud_code(self) -> int:
        """Register 8."""
        return self._memory["Baud Rate"]

    @property
    def status_return_level(self) -> int:
        """Register 68."""
        return self._memory["Status Return Level"]

    @property
    def return_delay_s(self) -> float:
        """Register 9 [s]."""
        return self._memory["Return Delay Time"] * 2e-6

    @property
    def alert(self) -> bool:
        """Hardware Error Status is not zero."""
        return self._memory["Hardware Error Status"] != 0

    @property
    def torque(self) -> bool:
        """Register 64."""
        return self._memory["Torque Enable"] != 0

    @property
    def reads_fast(self) -> bool:
        """Whether the firmware knows fast reads, the backup and what came with them."""
        return self.firmware >= self.model.newer_firmware

    @property
    def goal_writes(self) -> int:
        """How often Goal Position was written."""
        return self._goal_writes

    def shaft_counts(self, t: float) -> float:
        """What the encoder sees, before it rounds and without homing offset [counts]."""
        self.advance(t)
        return self._drive.shaft.at(t)[0]

    def output_counts(self, t: float) -> float:
        """Where the link is [counts], also at a time that has passed.

        After an increasing approach longer than the play it is ``shaft - backlash / 2``, after a decreasing one
        ``shaft + backlash / 2``; the encoder's harmonics come on top.
        """
        self.advance(t)
        link = self._drive.shaft.link(t)
        turn = 2.0 * math.pi * link / COUNTS_PER_TURN
        return link + sum(amplitude * math.sin(n * turn + phase) for n, amplitude, phase in self._harmonics)

    def advance(self, t: float) -> None:
        """Let everything happen that was due by `t` [s], in order: faults, watchdog, overload, heat."""
        while (event := self._next_event(t)) is not None:
            event()

    def schedule(self, fault: Fault) -> None:
        """Have a fault of the servo itself happen at its time or goal write."""
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
        if not self.torque and not self._goal_pending:
            self._memory["Goal Position"] = self._reading(self._drive.shaft.at(t)[0])
        refresh(self._memory, self._drive, self.model, self._reading, t)
        return self._memory.read(address, length)

    def write(self, address: int, data: bytes, t: float, *, eeprom: bool = True) -> None:
        """Write `data` at `address`, all or nothing.

        Raises
        ------
        Refused
            Access, Data Length, Data Range or Data Limit; Result Fail for torque after a shutdown.
        """
        self.advance(t)
        for register, value in self._checked(address, data, eeprom):
            self._apply(register, value, t)

    def reg_write(self, address: int, data: bytes, t: float) -> None:
        """Check a write and keep it for `action`; a second one replaces the first."""
        self.advance(t)
        self._checked(address, data, True)
        self._registered = (address, data)
        self._memory["Registered Instruction"] = 1

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
        self._memory["Registered Instruction"] = 0
        self.write(address, data, t)

    def reboot(self, t: float) -> None:
        """Restart: RAM to defaults, torque off, hardware errors cleared, turns forgotten; then as configured."""
        self._drive.release(t)
        self._start_ram(t)
        startup = self._memory["Startup Configuration"] if self.reads_fast else 0
        if startup & 2:
            self._memory.restore(eeprom=False)
        if startup & 1:
            self._memory["Torque Enable"] = 1
            self._torque_on(t)

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
            if register.eeprom and register.writable and register.address not in kept:
                self._memory[register.name] = register.default
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
        if not self._drive.shaft.done(t):
            raise Refused(ErrorNumber.RESULT_FAIL)
        self._fold_position(t)

    def back_up(self, params: bytes, t: float) -> None:
        """Keep the control table, or bring back the EEPROM that was kept.

        Raises
        ------
        Refused
            Instruction, by older firmware; Data Range, if `params` are not the manual's; Result Fail, while torque is
            on or without a backup.
        """
        self.advance(t)
        if not self.reads_fast:
            raise Refused(ErrorNumber.INSTRUCTION)
        if params not in (b"\x01CTRL", b"\x02CTRL"):
            raise Refused(ErrorNumber.DATA_RANGE)
        restore = params[0] == 2
        if self.torque or (restore and not self._memory.backed_up):
            raise Refused(ErrorNumber.RESULT_FAIL)
        if restore:
            self._memory.restore(eeprom=True)
            self._fold_position(t)
        else:
            self._memory.back_up()

    # ---- registers ---------------------------------------------------------------------------------------------

    def _checked(self, address: int, data: bytes, eeprom: bool) -> list[tuple[Register, int]]:
        items = self._memory.items(address, data, eeprom=eeprom and not self.torque)
        for register, value in items:
            check(self._memory, self.model, self.firmware, register, value)
        return items

    def _apply(self, register: Register, value: int, t: float) -> None:
        before = self._memory[register.name]
        self._memory[register.name] = value
        if register.address == 116:
            self._goal_written(t)
        elif register.address in (100, 102, 104) and self.torque:
            if register.address == GOAL_OF_MODE[self._memory["Operating Mode"]]:
                self._go(t)
        elif register.address == 64 and value != before:
            if value:
                self._torque_on(t)
            else:
                self._drive.release(t)
                self._goal_pending = False
        elif register.address == 10 and value != before:
            self._fold_position(t)
        elif register.address == 11 and value != before:
            if value == POSITION:
                self._fold_position(t)
            for name in _GAINS:
                self._memory[name] = self.model.by_name[name].default
            self._memory["Profile Acceleration"] = 0
            self._memory["Profile Velocity"] = 0
            initial_goals(self._memory)

    def _reading(self, raw: float) -> int:
        """Encoder counts as the registers have them."""
        return round(sign(self._memory) * raw - self._fold) + homing_offset(self._memory)

    # ---- motion ------------------------------------------------------------------------------------------------

    def _start_ram(self, t: float) -> None:
        for register in self.model.registers:
            if not register.eeprom:
                self._memory[register.name] = register.default
        self._goal_pending = False
        self._registered = None
        self._last_instruction = t
        initial_goals(self._memory)
        self._fold_position(t)

    def _fold_position(self, t: float) -> None:
        """Make Present Position start within one turn; the shaft does not move."""
        position = sign(self._memory) * self._drive.shaft.at(t)[0]
        self._fold = COUNTS_PER_TURN * (round(position) // COUNTS_PER_TURN)

    def _torque_on(self, t: float) -> None:
        """Hold the present position, unless a goal was written while torque was off: that one is then executed."""
        mode = self._memory["Operating Mode"]
        if mode == POSITION:
            self._fold_position(t)
        if not self._goal_pending and GOAL_OF_MODE[mode] == 116:
            here = self._drive.shaft.at(t)[0]
            self._memory["Goal Position"] = self._reading(here)
            self._drive.hold(t)
            self._drive.on = True
        else:
            self._go(t)

    def _goal_written(self, t: float) -> None:
        self._goal_writes += 1
        by_goal = self._memory["Drive Mode"] & TORQUE_BY_GOAL
        if by_goal and not self._memory["Hardware Error Status"] & self._memory["Shutdown"]:
            self._memory["Torque Enable"] = 1
        if not self.torque:
            self._goal_pending = True
        elif GOAL_OF_MODE[self._memory["Operating Mode"]] == 116:
            self._go(t)
        for fault, due in list(self._faults):
            if due is None and fault.at_goal_write == self._goal_writes:
                self._faults.remove((fault, due))
                self._faults.append((fault, t + fault.after_s))
        self.advance(t)

    def _go(self, t: float) -> None:
        """Start towards the goal of the operating mode."""
        self._goal_pending = False
        start(self._memory, self._drive, self.model, self._fold, t)

    # ---- what happens by itself --------------------------------------------------------------------------------

    def _next_event(self, t: float) -> Callable[[], None] | None:
        """The first thing that is due by `t` [s] and has not happened yet."""
        memory, drive = self._memory, self._drive
        first, event = t, None
        for fault, moment in self._faults:
            if moment is not None and moment <= first:
                first, event = moment, functools.partial(self._strike, fault, moment)
        errors = memory["Hardware Error Status"]
        watchdog = memory["Bus Watchdog"]
        if watchdog > 0 and self.torque:
            due = self._last_instruction + watchdog * WATCHDOG_UNIT_S
            if due < first:  # after that time, not at it
                first, event = due, functools.partial(self._bark, due)
        if (rests := drive.rests_at()) <= first:
            first, event = rests, functools.partial(drive.settle, rests)
        if not errors & OVERLOAD and (overloaded := drive.overloaded_at()) <= first:
            first, event = overloaded, functools.partial(self._fail, OVERLOAD, overloaded)
        if not errors & OVERHEATING and (hot := drive.heat.reaches(memory["Temperature Limit"])) <= first:
            first, event = hot, functools.partial(self._fail, OVERHEATING, hot)
        volts = 10.0 * drive.supply_v
        if not errors & INPUT_VOLTAGE and not memory["Min Voltage Limit"] <= volts <= memory["Max Voltage Limit"]:
            event = functools.partial(self._fail, INPUT_VOLTAGE, self._last_instruction)
        return event

    def _bark(self, due: float) -> None:
        """The bus watchdog found nobody."""
        self._drive.hold(due)
        self._memory["Bus Watchdog"] = -1
        self._memory["Profile Acceleration"] = 0
        self._memory["Profile Velocity"] = 0

    def _fail(self, bits: int, t: float) -> None:
        """Hardware Error Status gets `bits`; torque goes off if Shutdown says so."""
        self._memory["Hardware Error Status"] |= bits
        if self._memory["Hardware Error Status"] & self._memory["Shutdown"]:
            self._drive.release(t)
            self._goal_pending = False
            self._memory["Torque Enable"] = 0

    def _strike(self, fault: Fault, t: float) -> None:
        self._faults.remove((fault, t))
        if fault.kind == "stuck":
            self._drive.shaft.seize(t)
        elif fault.kind == "obstacle":
            self._drive.obstruct(t, fault.ahead_counts)
        elif fault.kind == "reboot":
            self.reboot(t)
        else:
            self._fail(fault.bits, t)
