"""Several servos on one line: registers, states, and stopping them all.

The state of a servo is one block read of a length that nothing else has, believed only when two in a row agree; the states
of several come in by one sync read of the same block. Framing and CRC are the vendor's (`drivers.dynamixel.sdk`), timeouts
and late answers are dealt with in `drivers.dynamixel.line`. It refuses Protocol 1.0, whose checksum accepts 1 % of two-bit
errors, and never sends from a signal handler. It knows counts, not angles.

References: ROBOTIS e-manual, DYNAMIXEL Protocol 2.0 (emanual.robotis.com/docs/en/dxl/protocol2).
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

from dynamixel_sdk.robotis_def import INST_PING, INST_READ, INST_REBOOT, INST_SYNC_WRITE, INST_WRITE

from drivers.dynamixel.line import Line
from drivers.dynamixel.registers import (
    BLOCK_ADDRESS,
    BLOCK_SIZE,
    GOAL_POSITION,
    HARDWARE_ERROR_STATUS,
    STATUS_ERRORS,
    TORQUE_ENABLE,
    Block,
    Register,
    decode_block,
    hardware_errors,
)
from drivers.dynamixel.ticks import TickClock
from gonio.errors import ConfigurationError, DeviceError, DeviceTimeoutError, HardwareStatusError, ProtocolError
from gonio.interfaces import Clock

logger = logging.getLogger(__name__)

_MOTION_SLACK_COUNTS = 4.0
_TOP_SPEED_COUNTS_S = 8000.0  # 117 rev/min, beyond every X-series servo


class RefusedError(DeviceError):
    """A servo answered with an error number."""


class Member(Protocol):
    """What the bus must know of a servo to stop it."""

    @property
    def name(self) -> str: ...

    def clip(self, counts: int) -> int:
        """Nearest position that the servo's own limits accept."""
        ...

    def disarm(self) -> None:
        """Its watchdog off: one that has tripped takes no goal before."""
        ...

    def halted(self, goal: int) -> None:
        """The bus has told this servo to hold `goal` [counts]; forget the move."""
        ...


class Bus:
    """A line of servos.

    Parameters
    ----------
    port : str
        Path or pyserial URL.
    clock : Clock
        Rig time: motion happens on it.
    baud : int, optional
        Line rate [bit/s].
    timeout_s : float, optional
        Time beyond the wire time that a servo has to answer [s], on `now`. Half a second forgives a busy computer.
    now : callable, optional
        Seconds of the port's own time, never going back. ``time.monotonic`` for everything but an in-process
        simulator on a virtual clock, which needs that clock's.
    drain_s : float, optional
        After a timeout, how long the line must be silent [s], on `now`.
    attempts : int, optional
        Tries of one transaction before it is an error.
    return_s : float, optional
        How long an adapter that was unplugged may take to come back [s, of the wall's time], under its name or, if `port`
        is a pattern (``/dev/serial/by-id/*FTDI*``), under another one.
    protocol : float, optional
        2.0; anything else is refused.
    """

    def __init__(
        self,
        port: str,
        *,
        clock: Clock,
        baud: int = 1_000_000,
        timeout_s: float = 0.5,
        now: Callable[[], float] = time.monotonic,
        drain_s: float = 0.25,
        attempts: int = 3,
        return_s: float = 0.0,
        protocol: float = 2.0,
    ) -> None:
        if protocol != 2.0:
            raise ConfigurationError(
                f"Port {port}: Dynamixel Protocol {protocol} is not supported, only 2.0; "
                "its one-byte checksum lets wrong angles pass: set the servos' Protocol Type (13) to 2."
            )
        if not timeout_s > 0.0 or not drain_s > 0.0 or attempts < 1:
            raise ConfigurationError(
                f"Port {port}: timeout_s = {timeout_s} and drain_s = {drain_s} must be above 0, "
                f"attempts = {attempts} at least 1."
            )
        self.port_name = port
        self.clock = clock
        self._line = Line(
            port, baud=baud, timeout_s=timeout_s, drain_s=drain_s, now=now, attempts=attempts, return_s=return_s,
            label=self.label,
        )
        self._members: dict[int, Member] = {}
        self._last: dict[int, int] = {}  # last position seen [counts]
        self._ticks: dict[int, TickClock] = {}

    @property
    def timeouts(self) -> int:
        """Tries that got no valid answer since the bus was made."""
        return self._line.timeouts

    # -- life

    def open(self) -> Bus:
        """Open the port."""
        self._line.open()
        return self

    def close(self) -> None:
        """Close the port. Servos keep their torque and hold."""
        self._line.close()

    def __enter__(self) -> Bus:
        return self.open()

    def __exit__(self, *exc: object) -> None:
        self.close()

    def register(self, servo_id: int, member: Member) -> None:
        """Make a servo known, for messages and for `stop_all`."""
        if servo_id in self._members and self._members[servo_id] is not member:
            raise ConfigurationError(
                f"Axes {self._members[servo_id].name} and {member.name} both have id {servo_id}; "
                "every servo on a line needs its own."
            )
        self._members[servo_id] = member

    def label(self, servo_id: int) -> str:
        """The servo as a message names it."""
        member = self._members.get(servo_id)
        place = f"id {servo_id} on {self.port_name}"
        return f"Axis {member.name} ({place})" if member else f"The servo with {place}"

    # -- registers

    def ping(self, servo_id: int) -> tuple[int, int]:
        """Model number and firmware version."""
        data, _ = self._line.ask(servo_id, INST_PING, b"", 3)
        return data[0] | data[1] << 8, data[2]

    def scan(self) -> dict[int, tuple[int, int]]:
        """All servos on the line, id -> (model number, firmware); takes about a second."""
        return self._line.scan()

    def read(self, servo_id: int, register: Register) -> int:
        """Value of a register."""
        parameters = register.address.to_bytes(2, "little") + register.size.to_bytes(2, "little")
        data, error = self._line.ask(servo_id, INST_READ, parameters, register.size)
        self._refuse(servo_id, f"reading {register.name}", error)
        return register.decode(data)

    def write(self, servo_id: int, register: Register, value: int, *, hasty: bool = False) -> bool:
        """Write a register and wait for the acknowledgement; True if the servo raises its alert bit."""
        parameters = register.address.to_bytes(2, "little") + register.encode(value)
        _, error = self._line.ask(servo_id, INST_WRITE, parameters, 0, hasty=hasty)
        self._refuse(servo_id, f"{register.name} = {value}", error)
        return bool(error & 0x80)

    def command(self, servo_id: int, register: Register, value: int) -> None:
        """Write a register; `HardwareStatusError` if the servo then raises its alert bit."""
        if self.write(servo_id, register, value):
            raise self.hardware_fault(servo_id)

    def sync_write(self, register: Register, values: Mapping[int, int]) -> None:
        """Write one register of several servos at once. No servo answers: read back what matters."""
        parameters = register.address.to_bytes(2, "little") + register.size.to_bytes(2, "little")
        for servo_id, value in values.items():
            parameters += bytes([servo_id]) + register.encode(value)
        self._line.tell(INST_SYNC_WRITE, parameters)

    def reboot(self, servo_id: int) -> None:
        """Restart a servo: torque goes off, RAM registers fall back to their defaults."""
        self._ticks.pop(servo_id, None)  # its clock begins anew
        self._line.ask(servo_id, INST_REBOOT, b"", 0)

    # -- state

    def block(self, servo_id: int, *, hasty: bool = False) -> Block:
        """State of a servo now.

        A state that is not of the time at which it was asked for (`TickClock`) is not believed: the line is drained, and
        the servo asked again. A hasty question goes without this.

        Raises
        ------
        ProtocolError
            If no state makes sense.
        """
        with self._line.lock:
            doubted: Block | None = None
            for _ in range(self._line.attempts):
                state = self._state(servo_id, hasty)
                clock = self._ticks.setdefault(servo_id, TickClock(state))
                if hasty or clock.accepts(state):
                    self._last[servo_id] = state.position
                    return state
                logger.info("%s: a state of another time (tick %d), asked again", self.label(servo_id), state.tick)
                if doubted is not None and clock.restarted(doubted, state):
                    self._ticks[servo_id] = TickClock(state)
                    return state
                self._line.distrust(servo_id)
                doubted = state
            del self._ticks[servo_id]  # the rig's clock may have stood still; the next question begins anew
        raise ProtocolError(
            f"{self.label(servo_id)}: {self._line.attempts} states in a row are of other times than the questions; "
            "check the cable, the adapter, that no two servos share an id, and that a simulator runs at speed 1."
        )

    def _state(self, servo_id: int, hasty: bool) -> Block:
        parameters = BLOCK_ADDRESS.to_bytes(2, "little") + BLOCK_SIZE.to_bytes(2, "little")
        sent_s = 0.0

        def started() -> None:
            nonlocal sent_s
            sent_s = self.clock.now()

        data, error = self._line.ask(servo_id, INST_READ, parameters, BLOCK_SIZE, hasty=hasty, started=started)
        return self._decoded(servo_id, data, error, sent_s)

    def _decoded(self, servo_id: int, data: bytes, error: int, sent_s: float) -> Block:
        received_s = self.clock.now()
        self._refuse(servo_id, "reading its state", error)
        return decode_block(data, alert=bool(error & 0x80), sent_s=sent_s, received_s=received_s)

    def blocks(self, servo_ids: Sequence[int]) -> dict[int, Block]:
        """States of several servos, by one sync read of all of them.

        A servo whose answer is missing, damaged, out of turn or of another time is asked again by itself, as `block` does:
        an error bears its name.

        Raises
        ------
        DeviceError
            If a servo refuses, or does not answer when it is asked by itself.
        """
        with self._line.lock:
            found = self._states(servo_ids) if len(servo_ids) > 1 else {}
            return {servo_id: found.get(servo_id) or self.block(servo_id) for servo_id in servo_ids}

    def _states(self, servo_ids: Sequence[int]) -> dict[int, Block]:
        """What a sync read brings and can be believed."""
        found: dict[int, Block] = {}
        sent_s = 0.0

        def started() -> None:
            nonlocal sent_s
            sent_s = self.clock.now()

        def believed(servo_id: int, data: bytes, error: int) -> bool:
            state = self._decoded(servo_id, data, error, sent_s)
            if not self._ticks.setdefault(servo_id, TickClock(state)).accepts(state):
                logger.info("%s: a state of another time (tick %d)", self.label(servo_id), state.tick)
                return False
            self._last[servo_id] = state.position
            found[servo_id] = state
            return True

        self._line.read_all(servo_ids, BLOCK_ADDRESS, BLOCK_SIZE, started=started, believed=believed)
        return found

    def agreed_block(self, servo_id: int) -> Block:
        """The later of two consecutive blocks that agree: same goal, and no farther apart than a servo can turn."""
        earlier = self.block(servo_id)
        tries = 2 * self._line.attempts
        for _ in range(tries):
            later = self.block(servo_id)
            moved, reach = _apart(earlier, later)
            if later.goal == earlier.goal and moved <= reach:
                return later
            earlier = later
        raise ProtocolError(
            f"{self.label(servo_id)}: {tries} pairs of readings in a row disagree, the last by "
            f"{moved} counts where {reach:.0f} are possible; check the cable, and that no two servos share an id."
        )

    def agreed_blocks(self, servo_ids: Sequence[int]) -> dict[int, Block]:
        """`agreed_block` of several servos, by two sync reads in a row; by itself where those do not agree."""
        with self._line.lock:
            earlier, later = self.blocks(servo_ids), self.blocks(servo_ids)
            agreed: dict[int, Block] = {}
            for servo_id in servo_ids:
                first, second = earlier[servo_id], later[servo_id]
                moved, reach = _apart(first, second)
                agrees = second.goal == first.goal and moved <= reach
                agreed[servo_id] = second if agrees else self.agreed_block(servo_id)
            return agreed

    def hardware_fault(self, servo_id: int) -> HardwareStatusError:
        """What a servo that raises its alert bit says is wrong with it; to be raised by the caller."""
        bits = self.read(servo_id, HARDWARE_ERROR_STATUS)
        holds = bool(self.read(servo_id, TORQUE_ENABLE))
        state = "it still holds" if holds else "its torque is off, and only a reboot or power-cycle gives it back"
        return HardwareStatusError(
            f"{self.label(servo_id)} reports {hardware_errors(bits)} (hardware error status 0x{bits:02x}); {state}: "
            "find the cause, restart the servo, then resume."
        )

    # -- stop

    def stop_all(self) -> None:
        """Stop every registered servo now and hold: goal := present, torque stays on.

        Call it from ordinary code, never from a signal handler. A first pass gives each servo one short try and stops
        it at once, so that a silent one does not keep the others moving; a second pass insists. A servo that does not
        answer is sent the last position seen, which lies on the path behind it.

        Raises
        ------
        DeviceTimeoutError
            If a servo cannot be reached; the others have been stopped.
        """
        with self._line.lock:
            order = sorted(self._members, key=lambda servo_id: servo_id in self._line.failing)
            late = [servo_id for servo_id in order if not self._stop(servo_id, hasty=True)]
            unreached = [servo_id for servo_id in late if not self._stop(servo_id, hasty=False)]
        if unreached:
            names = " and ".join(self.label(servo_id) for servo_id in unreached)
            raise DeviceTimeoutError(
                f"{names} cannot be reached to be stopped; cut the power of the servos if anything moves."
            )

    def _stop(self, servo_id: int, *, hasty: bool) -> bool:
        """Tell one servo to hold where it is; True if it said that it does."""
        member = self._members[servo_id]
        try:
            if not hasty:
                member.disarm()
            goal = member.clip(self.block(servo_id, hasty=hasty).position)
            self.write(servo_id, GOAL_POSITION, goal, hasty=hasty)
        except DeviceError as error:
            logger.warning("stop: %s", error)
            if servo_id in self._last:
                goal = member.clip(self._last[servo_id])
                self.sync_write(GOAL_POSITION, {servo_id: goal})  # it may hear although it does not answer
                member.halted(goal)
            return False
        member.halted(goal)
        return True

    def _refuse(self, servo_id: int, what: str, error: int) -> None:
        if error & 0x7F:
            reason = STATUS_ERRORS.get(error & 0x7F, f"unknown error {error & 0x7F}")
            raise RefusedError(
                f"{self.label(servo_id)} refused {what}: {reason}"
                f"{', and it reports a hardware error' if error & 0x80 else ''}; "
                "check its model, operating mode and limits in rig.toml."
            )


def _apart(earlier: Block, later: Block) -> tuple[int, float]:
    """How far apart two states of a servo are, and how far it can have turned in between [counts]."""
    reach = _MOTION_SLACK_COUNTS
    if earlier.in_motion or later.in_motion:
        reach += _TOP_SPEED_COUNTS_S * (later.received_s - earlier.sent_s)
    return abs(later.position - earlier.position), reach
