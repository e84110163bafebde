"""One Dynamixel line (Protocol 2.0) through the vendor's SDK, so that no answer is taken for another's.

Status packets carry neither an address nor a sequence number. After a timeout the late answer may therefore arrive as
the answer to the next question. So: every answer is checked for sender and exact length; after any timeout the line is
drained until it is idle and then fenced by a read whose *length* changes each time; and the state of a servo is one
block read of a length that nothing else has, believed only when two in a row agree.

It refuses Protocol 1.0 (its checksum accepts 1.3 % of two-bit errors), never uses the calendar clock, and never sends
from a signal handler: one lock, one transaction at a time. It knows counts, not angles.

References: ROBOTIS e-manual, DYNAMIXEL Protocol 2.0 (emanual.robotis.com/docs/en/dxl/protocol2).
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Protocol

from dynamixel_sdk.robotis_def import (
    BROADCAST_ID,
    COMM_RX_CORRUPT,
    COMM_RX_TIMEOUT,
    COMM_SUCCESS,
    INST_PING,
    INST_READ,
    INST_REBOOT,
    INST_SYNC_WRITE,
    INST_WRITE,
)

from drivers.dynamixel.registers import (
    BLOCK_ADDRESS,
    BLOCK_SIZE,
    GOAL_POSITION,
    HARDWARE_ERROR_STATUS,
    SERVO_ID,
    STATUS_ERRORS,
    TORQUE_ENABLE,
    Block,
    Register,
    decode_block,
    hardware_errors,
)
from drivers.dynamixel.sdk import ERROR_AT, ID_AT, LENGTH_AT, PARAMETERS_AT, Packets, Port
from drivers.serial_port import port_errors
from gonio.errors import ConfigurationError, DeviceError, DeviceTimeoutError, HardwareStatusError, ProtocolError
from gonio.interfaces import Clock

logger = logging.getLogger(__name__)

_FENCE_LENGTHS = (8, 9, 10, 11, 12)  # from address 0; all hold the id, none is the length of another answer
_DRAIN_LIMIT_S = 5.0
_HASTY_TIMEOUT_S = 0.05  # above the latency of a USB adapter, there and back
_STATUS_CRC = 3
_MOTION_SLACK_COUNTS = 4.0
_TOP_SPEED_COUNTS_S = 8000.0  # 117 rev/min, beyond every X-series servo


class Member(Protocol):
    """What the bus must know of a servo to stop it."""

    @property
    def name(self) -> str: ...

    def clip(self, counts: int) -> int:
        """Nearest position that the servo's own limits accept."""
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
        self.baud = baud
        self.timeout_s = timeout_s
        self.drain_s = drain_s
        self.attempts = attempts
        self.timeouts = 0
        """Transactions that got no valid answer since the bus was opened."""
        self._now = now
        self._port = Port(port, timeout_s=timeout_s, now=now)
        self._packets = Packets()
        self._lock = threading.RLock()
        self._members: dict[int, Member] = {}
        self._last: dict[int, int] = {}  # last position seen [counts]
        self._failing: set[int] = set()  # did not answer the last time
        self._fences = 0

    # -- life

    def open(self) -> Bus:
        """Open the port."""
        with self._lock:
            self._port.baudrate = self.baud
            if not self._port.setBaudRate(self.baud):
                raise DeviceError(
                    f"Port {self.port_name}: the Dynamixel SDK does not offer {self.baud} baud; "
                    "use 57600, 115200, 1000000, 2000000, 3000000 or 4000000."
                )
        return self

    def close(self) -> None:
        """Close the port. Servos keep their torque and hold."""
        with self._lock:
            if self._port.is_open:
                self._port.closePort()

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
        data, _ = self._ask(servo_id, INST_PING, b"", 3)
        return data[0] | data[1] << 8, data[2]

    def scan(self) -> dict[int, tuple[int, int]]:
        """All servos on the line, id -> (model number, firmware); takes about a second."""
        with self._lock, self._transaction():
            found, result = self._packets.broadcastPing(self._port)
        if result not in (COMM_SUCCESS, COMM_RX_TIMEOUT) and not found:
            raise ProtocolError(
                f"Port {self.port_name}: answers to a broadcast ping collide; check that no two servos share an id."
            )
        return {int(servo_id): (int(model), int(firmware)) for servo_id, (model, firmware) in sorted(found.items())}

    def read(self, servo_id: int, register: Register) -> int:
        """Value of a register."""
        parameters = register.address.to_bytes(2, "little") + register.size.to_bytes(2, "little")
        data, error = self._ask(servo_id, INST_READ, parameters, register.size)
        self._refuse(servo_id, f"reading {register.name}", error)
        return register.decode(data)

    def write(self, servo_id: int, register: Register, value: int, *, hasty: bool = False) -> bool:
        """Write a register and wait for the acknowledgement; True if the servo raises its alert bit."""
        parameters = register.address.to_bytes(2, "little") + register.encode(value)
        _, error = self._ask(servo_id, INST_WRITE, parameters, 0, hasty=hasty)
        self._refuse(servo_id, f"{register.name} = {value}", error)
        return bool(error & 0x80)

    def sync_write(self, register: Register, values: Mapping[int, int]) -> None:
        """Write one register of several servos at once. No servo answers: read back what matters."""
        parameters = register.address.to_bytes(2, "little") + register.size.to_bytes(2, "little")
        for servo_id, value in values.items():
            parameters += bytes([servo_id]) + register.encode(value)
        with self._lock, self._transaction():
            self._sent(self._packets.transmit(self._port, BROADCAST_ID, INST_SYNC_WRITE, parameters))

    def reboot(self, servo_id: int) -> None:
        """Restart a servo: torque goes off, RAM registers fall back to their defaults."""
        self._ask(servo_id, INST_REBOOT, b"", 0)

    # -- state

    def block(self, servo_id: int, *, hasty: bool = False) -> Block:
        """State of a servo now."""
        parameters = BLOCK_ADDRESS.to_bytes(2, "little") + BLOCK_SIZE.to_bytes(2, "little")
        sent_s = 0.0

        def started() -> None:
            nonlocal sent_s
            sent_s = self.clock.now()

        data, error = self._ask(servo_id, INST_READ, parameters, BLOCK_SIZE, hasty=hasty, started=started)
        received_s = self.clock.now()
        self._refuse(servo_id, "reading its state", error)
        block = decode_block(data, alert=bool(error & 0x80), sent_s=sent_s, received_s=received_s)
        self._last[servo_id] = block.position
        return block

    def agreed_block(self, servo_id: int) -> Block:
        """The later of two consecutive blocks that agree: same goal, and no farther apart than a servo can turn."""
        earlier = self.block(servo_id)
        tries = 2 * self.attempts
        for _ in range(tries):
            later = self.block(servo_id)
            moved = abs(later.position - earlier.position)
            turning = earlier.in_motion or later.in_motion
            reach = _MOTION_SLACK_COUNTS
            if turning:
                reach += _TOP_SPEED_COUNTS_S * (later.received_s - earlier.sent_s)
            if later.goal == earlier.goal and moved <= reach:
                return later
            earlier = later
        raise ProtocolError(
            f"{self.label(servo_id)}: {tries} pairs of readings in a row disagree, the last by "
            f"{moved} counts where {reach:.0f} are possible; check the cable, and that no two servos share an id."
        )

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
        with self._lock:
            self._port.is_using = False
            order = sorted(self._members, key=lambda servo_id: servo_id in self._failing)
            late = [servo_id for servo_id in order if not self._stop(servo_id, hasty=True)]
            unreached = [servo_id for servo_id in late if not self._stop(servo_id, hasty=False)]
        if unreached:
            names = " and ".join(self.label(servo_id) for servo_id in unreached)
            raise DeviceTimeoutError(
                f"{names} cannot be reached to be stopped; "
                "cut the power of the servos if anything moves."
            )

    def _stop(self, servo_id: int, *, hasty: bool) -> bool:
        """Tell one servo to hold where it is; True if it said that it does."""
        member = self._members[servo_id]
        try:
            if not hasty:  # a hasty question may still be answered
                self._port.timeout_s = self.timeout_s
                self._drain()
                self._fence(servo_id)
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

    # -- transactions

    def _ask(
        self,
        servo_id: int,
        instruction: int,
        parameters: bytes,
        length: int,
        *,
        hasty: bool = False,
        started: Callable[[], None] = lambda: None,
    ) -> tuple[bytes, int]:
        """One instruction and its status: data of `length` bytes (or none with an error number), error byte.

        A hasty one has a single short try and leaves the line as it is.
        """
        allowed = 1 if hasty else self.attempts
        with self._lock:
            self._port.timeout_s = min(self.timeout_s, _HASTY_TIMEOUT_S) if hasty else self.timeout_s
            for attempt in range(1, allowed + 1):
                started()
                result, data, error = self._exchange(servo_id, instruction, parameters, length)
                if result == COMM_SUCCESS:
                    if error & 0x7F != _STATUS_CRC:
                        self._failing.discard(servo_id)
                        return data, error
                    logger.info("%s got a damaged instruction, try %d", self.label(servo_id), attempt)
                    result = COMM_RX_CORRUPT
                    continue
                self.timeouts += 1
                logger.info("%s: no valid answer (%d), try %d", self.label(servo_id), result, attempt)
                if hasty:
                    break
                self._drain()
                if attempt < allowed and not self._fence(servo_id):
                    break
            self._failing.add(servo_id)
        raise self._silence(servo_id, result)

    def _exchange(self, servo_id: int, instruction: int, parameters: bytes, length: int) -> tuple[int, bytes, int]:
        """One try; the SDK's result, data, error byte. Answers of other servos or other lengths are passed over."""
        with self._transaction():
            self._sent(self._packets.transmit(self._port, servo_id, instruction, parameters, length))
            while True:
                packet, result = self._packets.rxPacket(self._port, False)
                if result != COMM_SUCCESS:
                    return result, b"", 0
                count = (packet[LENGTH_AT] | packet[LENGTH_AT + 1] << 8) - 4  # instruction, error, CRC
                error = packet[ERROR_AT]
                # a status with an error number carries no data
                if packet[ID_AT] == servo_id and count == (0 if error & 0x7F else length):
                    return result, bytes(packet[PARAMETERS_AT : PARAMETERS_AT + count]), error
                logger.info("port %s: passed over a stray answer of servo id %d", self.port_name, packet[ID_AT])

    def _fence(self, servo_id: int) -> bool:
        """After a timeout: True once the servo answers a question that no earlier one can have been."""
        for _ in range(self.attempts):
            self._fences += 1
            length = _FENCE_LENGTHS[self._fences % len(_FENCE_LENGTHS)]
            parameters = (0).to_bytes(2, "little") + length.to_bytes(2, "little")
            result, data, error = self._exchange(servo_id, INST_READ, parameters, length)
            if result == COMM_SUCCESS and not error & 0x7F and data[SERVO_ID.address] == servo_id:
                return True
            self._drain()
        return False

    def _drain(self) -> None:
        """Read and discard until the line has been idle for `drain_s`."""
        with self._lock, self._transaction():
            start = quiet_since = self._now()
            while self._now() - quiet_since < self.drain_s:
                if self._port.readPort(256):
                    quiet_since = self._now()
                if self._now() - start > _DRAIN_LIMIT_S + self.drain_s:
                    raise ProtocolError(
                        f"Port {self.port_name} does not fall silent within {_DRAIN_LIMIT_S:.0f} s; "
                        "check the baud rate and that no other program talks on the line."
                    )

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        """Leave the port free, whatever happens in between (the SDK leaves it marked as in use)."""
        if not self._port.is_open:
            raise DeviceError(f"Port {self.port_name} is closed; open the bus first.")
        self._port.is_using = False
        try:
            with port_errors(f"Port {self.port_name}"):
                yield
        finally:
            self._port.is_using = False

    def _sent(self, result: int) -> None:
        if result != COMM_SUCCESS:
            raise DeviceError(
                f"Port {self.port_name} did not take an instruction ({self._packets.getTxRxResult(result)}); "
                "reconnect the adapter and resume."
            )

    def _refuse(self, servo_id: int, what: str, error: int) -> None:
        if error & 0x7F:
            reason = STATUS_ERRORS.get(error & 0x7F, f"unknown error {error & 0x7F}")
            raise DeviceError(
                f"{self.label(servo_id)} refused {what}: {reason}"
                f"{', and it reports a hardware error' if error & 0x80 else ''}; "
                "check its model, operating mode and limits in rig.toml."
            )

    def _silence(self, servo_id: int, result: int) -> DeviceError:
        if result == COMM_RX_CORRUPT:
            return ProtocolError(
                f"{self.label(servo_id)} answers in damaged packets at {self.baud} baud; "
                "check the cable and that no two servos share the id."
            )
        return DeviceTimeoutError(
            f"{self.label(servo_id)} gives no answer within {self._port.timeout_s:g} s at {self.baud} baud; "
            "check its power, cable, id and baud rate."
        )
