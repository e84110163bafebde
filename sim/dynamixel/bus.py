"""Several servos on one line: bytes in, replies with their delays out.

The bus finds the servo that a packet is for, lets it execute the instruction and builds the status packet. It knows no
port and no clock: the caller says when the bytes arrived and delivers the replies. `sim.links` does that for a
pseudo-terminal, a TCP socket and an in-process port.

Not modelled: two servos with one ID answering over each other, Protocol 1.0. Delays hold the servos' Return Delay Time;
what the bytes need on the wire is the link's business.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

from sim.dynamixel.control_table import BAUD_RATES
from sim.dynamixel.faults import OF_REPLIES, OF_THE_SERVO, Fault
from sim.dynamixel.packet import (
    ALERT,
    BROADCAST,
    Damaged,
    ErrorNumber,
    Instruction,
    Packet,
    Parser,
    encode_fast_status,
    encode_status,
)
from sim.dynamixel.servo import Refused, Servo

Reply = tuple[float, bytes]  # seconds after the last byte of what was on the line before it, and the bytes

_LEVEL_READ, _LEVEL_ALL = 1, 2
_RESETS_ALL_BEFORE = 42  # firmware that obeys a factory reset of everything by broadcast


@dataclass
class _Counts:
    """What a servo has seen so far, for faults that strike at the n-th event."""

    instructions: int = 0
    replies: int = 0
    struck: set[int] = field(default_factory=set)
    since: dict[int, int] = field(default_factory=dict)  # by fault: the event at which one of a given time began


class DynamixelBus:
    """A line with servos on it.

    Parameters
    ----------
    servos : iterable of Servo
    faults : sequence of Fault, optional
        What goes wrong; `inject` adds more later.

    Attributes
    ----------
    servos : tuple of Servo
    baudrate : int or None
        Speed of the host's port [bit/s]; a servo set to another hears nothing. None: not known, everybody hears.
    log : deque of (float, Packet)
        The last instruction packets, with the times of their arrival [s].
    """

    def __init__(self, servos: Iterable[Servo], faults: Sequence[Fault] = ()) -> None:
        self.servos = tuple(servos)
        self.baudrate: int | None = None
        self.log: deque[tuple[float, Packet]] = deque(maxlen=10_000)
        self._faults: list[Fault] = []
        self._now = 0.0
        self._parser = Parser()
        self._counts = {servo: _Counts() for servo in self.servos}
        for fault in faults:
            self.inject(fault)

    def inject(self, fault: Fault) -> None:
        """Add a fault; its counts run from when the bus was made."""
        self._faults.append(fault)
        for servo in self.servos:
            if fault.kind in OF_THE_SERVO and fault.concerns(servo.id):
                servo.schedule(fault)

    def servo(self, id: int) -> Servo:
        """The servo with this ID.

        Raises
        ------
        KeyError
            If there is none.
        """
        for servo in self.servos:
            if servo.id == id:
                return servo
        raise KeyError(id)

    def feed(self, data: bytes, t: float) -> list[Reply]:
        """Take bytes that arrived at `t` [s]; return the replies that they cause, in order."""
        replies: list[Reply] = []
        self._now = t
        for packet in self._parser.receive(data):
            if isinstance(packet, Damaged):
                replies += self._damaged(packet, t)
            else:
                self.log.append((t, packet))
                replies += self._execute(packet, t)
        return replies

    def idle(self) -> None:
        """The line was silent for a while: servos forget an unfinished packet."""
        self._parser.reset()

    # ---- who hears, who answers --------------------------------------------------------------------------------

    def _listening(self, servo: Servo) -> bool:
        """Whether this servo is set to the speed of the line."""
        return self.baudrate is None or BAUD_RATES[servo.baud_code] == self.baudrate

    def _silent(self, servo: Servo, t: float) -> bool:
        counts = self._counts[servo]
        for k, fault in enumerate(self._faults):
            if fault.kind != "silent" or not fault.concerns(servo.id):
                continue
            if k not in counts.struck and (
                (fault.at_instruction is not None and counts.instructions >= fault.at_instruction)
                or (fault.at_goal_write is not None and servo.goal_writes >= fault.at_goal_write)
                or (fault.at_time_s is not None and t >= fault.at_time_s)
            ):
                counts.struck.add(k)
            until = fault.until_instruction
            if k in counts.struck and (until is None or counts.instructions < until):
                return True
        return False

    def _hears(self, servo: Servo, t: float) -> bool:
        """Count an instruction for this servo; False if it does not take part."""
        if not self._listening(servo):
            return False
        self._counts[servo].instructions += 1
        if self._silent(servo, t):
            return False
        servo.heard(t)
        return True

    def _ordered_error(self, servo: Servo) -> int:
        """Error number that a fault makes the servo answer with, or 0."""
        for k, fault in enumerate(self._faults):
            if fault.kind == "error" and self._due(k, servo, fault.at_instruction, self._counts[servo].instructions):
                return fault.number
        return 0

    def _due(self, k: int, servo: Servo, trigger: int | None, count: int) -> bool:
        """Whether the k-th fault strikes this servo's `count`-th event."""
        fault = self._faults[k]
        if not fault.concerns(servo.id):
            return False
        if fault.at_time_s is not None:
            if self._now < fault.at_time_s:
                return False
            trigger = self._counts[servo].since.setdefault(k, count)
        return fault.due_at(trigger, count)

    def _send(self, servo: Servo, delay: float, data: bytes) -> list[Reply]:
        """Put a reply on the line, unless a fault spoils it."""
        counts = self._counts[servo]
        counts.replies += 1
        sent = [data]
        for k, fault in enumerate(self._faults):
            if fault.kind in OF_REPLIES and self._due(k, servo, fault.at_reply, counts.replies):
                sent = [spoilt for reply in sent for spoilt in fault.spoil(reply, counts.replies)]
                delay += fault.delay_s
        return [(0.0 if k else delay, reply) for k, reply in enumerate(sent) if reply]

    # ---- instructions ------------------------------------------------------------------------------------------

    def _damaged(self, packet: Damaged, t: float) -> list[Reply]:
        for servo in self.servos:
            if servo.id == packet.id and packet.id != BROADCAST and self._hears(servo, t):
                return self._answer(servo, ErrorNumber.CRC)
        return []

    def _answer(self, servo: Servo, error: int, params: bytes = b"", level: int = _LEVEL_ALL) -> list[Reply]:
        if servo.status_return_level < level:
            return []
        return self._send(servo, servo.return_delay_s, self._status(servo, error, params))

    @staticmethod
    def _status(servo: Servo, error: int, params: bytes = b"") -> bytes:
        return encode_status(servo.id, error | (ALERT if servo.alert else 0), params)

    def _execute(self, packet: Packet, t: float) -> list[Reply]:
        many: dict[int, Callable[[bytes, float], list[Reply]]] = {
            Instruction.SYNC_READ: self._sync_read,
            Instruction.FAST_SYNC_READ: self._fast_sync_read,
            Instruction.BULK_READ: self._bulk_read,
            Instruction.FAST_BULK_READ: self._fast_bulk_read,
            Instruction.SYNC_WRITE: self._sync_write,
            Instruction.BULK_WRITE: self._bulk_write,
        }
        if packet.instruction == Instruction.STATUS:
            return []  # another servo's answer, heard on the shared line
        if packet.instruction in many:
            return many[packet.instruction](packet.params, t) if packet.id == BROADCAST else []
        if packet.id == BROADCAST:
            return self._broadcast(packet, t)
        replies = []
        for servo in self.servos:
            if servo.id == packet.id:
                if self._hears(servo, t):
                    replies += self._single(servo, packet, t)
            elif servo.shadow_id == packet.id and self._hears(servo, t):
                self._shadow(servo, packet, t)
        return replies

    def _single(self, servo: Servo, packet: Packet, t: float) -> list[Reply]:
        """An instruction for one servo, which answers."""
        ordered = self._ordered_error(servo)
        if ordered:
            return self._answer(servo, ordered, level=0)
        if packet.instruction == Instruction.PING:
            return self._answer(servo, 0, self._identity(servo), level=0)
        if packet.instruction == Instruction.READ:
            try:
                if len(packet.params) != 4:
                    raise Refused(ErrorNumber.DATA_LENGTH)
                data = servo.read(_word(packet.params, 0), _word(packet.params, 2), t)
            except Refused as refused:
                return self._answer(servo, refused.number, level=_LEVEL_READ)
            return self._answer(servo, 0, data, level=_LEVEL_READ)
        # A reboot and a factory reset answer first; the answer is then that of the servo as it was.
        if packet.instruction == Instruction.REBOOT:
            replies = self._answer(servo, 0)
            servo.reboot(t)
            return replies
        if packet.instruction == Instruction.FACTORY_RESET and packet.params in (b"\xff", b"\x01", b"\x02"):
            replies = self._answer(servo, 0)
            servo.factory_reset(packet.params[0], t)
            return replies
        try:
            self._command(servo, packet, t)
        except Refused as refused:
            return self._answer(servo, refused.number)
        return self._answer(servo, 0)

    @staticmethod
    def _command(servo: Servo, packet: Packet, t: float) -> None:
        """Instructions whose answer is only whether it worked."""
        params = packet.params
        if packet.instruction in (Instruction.WRITE, Instruction.REG_WRITE):
            if len(params) < 3:
                raise Refused(ErrorNumber.DATA_LENGTH)
            store = servo.write if packet.instruction == Instruction.WRITE else servo.reg_write
            store(_word(params, 0), params[2:], t)
        elif packet.instruction == Instruction.ACTION:
            servo.action(t)
        elif packet.instruction == Instruction.CLEAR:
            servo.clear(params, t)
        elif packet.instruction == Instruction.BACKUP:
            servo.back_up(params, t)
        elif packet.instruction == Instruction.FACTORY_RESET:
            raise Refused(ErrorNumber.DATA_RANGE)
        else:
            raise Refused(ErrorNumber.INSTRUCTION)

    def _shadow(self, servo: Servo, packet: Packet, t: float) -> None:
        """A write under the secondary ID: RAM only, and no answer."""
        if packet.instruction == Instruction.WRITE and len(packet.params) > 2:
            self._quietly(lambda: servo.write(_word(packet.params, 0), packet.params[2:], t, eeprom=False))

    def _broadcast(self, packet: Packet, t: float) -> list[Reply]:
        """Everybody executes and nobody answers, but to a ping."""
        replies: list[Reply] = []
        for servo in sorted(self.servos, key=lambda servo: servo.id):
            if not self._hears(servo, t):
                continue
            if packet.instruction == Instruction.PING:
                replies += self._send(servo, servo.return_delay_s, self._status(servo, 0, self._identity(servo)))
            elif packet.instruction == Instruction.REBOOT:
                servo.reboot(t)
            elif packet.instruction == Instruction.FACTORY_RESET and packet.params in (b"\x01", b"\x02", b"\xff"):
                if packet.params != b"\xff" or servo.firmware < _RESETS_ALL_BEFORE:
                    servo.factory_reset(packet.params[0], t)
            elif packet.instruction != Instruction.READ:
                self._quietly(lambda servo=servo: self._command(servo, packet, t))  # type: ignore[misc]
        return replies

    @staticmethod
    def _identity(servo: Servo) -> bytes:
        return servo.model.number.to_bytes(2, "little") + bytes((servo.firmware,))

    @staticmethod
    def _quietly(command: Callable[[], None]) -> None:
        try:
            command()
        except Refused:
            return  # the servo would say so, but it was not asked to answer

    # ---- several servos at once --------------------------------------------------------------------------------

    def _sync_read(self, params: bytes, t: float) -> list[Reply]:
        if len(params) < 5:
            return []
        address, length = _word(params, 0), _word(params, 2)
        return self._reads([(id, address, length) for id in params[4:]], t)

    def _bulk_read(self, params: bytes, t: float) -> list[Reply]:
        return self._reads(_bulk_items(params), t)

    def _reads(self, items: list[tuple[int, int, int]], t: float) -> list[Reply]:
        """Servos answer in turn, each after the one before it; one that is missing silences the rest."""
        replies: list[Reply] = []
        hearing = {id for id, _, _ in items if any(s.id == id and self._hears(s, t) for s in self.servos)}
        for id, address, length in items:
            if id not in hearing or self.servo(id).status_return_level < _LEVEL_READ:
                break
            servo = self.servo(id)
            error, data = self._read_part(servo, address, length, t)
            replies += self._send(servo, servo.return_delay_s, self._status(servo, error, data))
        return replies

    def _read_part(self, servo: Servo, address: int, length: int, t: float) -> tuple[int, bytes]:
        ordered = self._ordered_error(servo)
        if ordered:
            return ordered, b""
        try:
            return 0, servo.read(address, length, t)
        except Refused as refused:
            return refused.number, b""

    def _fast_sync_read(self, params: bytes, t: float) -> list[Reply]:
        if len(params) < 5:
            return []
        address, length = _word(params, 0), _word(params, 2)
        return self._fast_reads([(id, address, length) for id in params[4:]], t)

    def _fast_bulk_read(self, params: bytes, t: float) -> list[Reply]:
        return self._fast_reads(_bulk_items(params), t)

    def _fast_reads(self, items: list[tuple[int, int, int]], t: float) -> list[Reply]:
        """One packet written by all; it stays unfinished if a servo of the chain is missing."""
        parts: list[tuple[int, int, bytes]] = []
        delay = 0.0
        last: Servo | None = None
        hearing = {id for id, _, _ in items if any(s.id == id and self._hears(s, t) for s in self.servos)}
        for id, address, length in items:
            if id not in hearing:
                break
            servo = self.servo(id)
            if servo.status_return_level < _LEVEL_READ or not servo.reads_fast:
                break
            error, data = self._read_part(servo, address, length, t)
            # The place of every part is fixed by the request, so a servo that cannot read fills its own with zeros.
            parts.append((error | (ALERT if servo.alert else 0), id, data.ljust(length, b"\0")))
            delay += servo.return_delay_s
            last = servo
        if last is None:
            return []
        total = sum(length + 4 for _, _, length in items) + 1
        return self._send(last, delay, encode_fast_status(parts, total))

    def _sync_write(self, params: bytes, t: float) -> list[Reply]:
        if len(params) < 4:
            return []
        address, length = _word(params, 0), _word(params, 2)
        step = length + 1
        self._writes([(params[k], address, params[k + 1 : k + step], length) for k in range(4, len(params), step)], t)
        return []

    def _bulk_write(self, params: bytes, t: float) -> list[Reply]:
        items = []
        k = 0
        while k + 5 <= len(params):
            length = _word(params, k + 3)
            items.append((params[k], _word(params, k + 1), params[k + 5 : k + 5 + length], length))
            k += 5 + length
        self._writes(items, t)
        return []

    def _writes(self, items: list[tuple[int, int, bytes, int]], t: float) -> None:
        for id, address, data, length in items:
            for servo in self.servos:
                if servo.id == id and self._hears(servo, t) and not self._ordered_error(servo) and len(data) == length:
                    self._quietly(lambda servo=servo, a=address, d=data: servo.write(a, d, t))  # type: ignore[misc]


def _word(data: bytes, at: int) -> int:
    return int.from_bytes(data[at : at + 2], "little")


def _bulk_items(params: bytes) -> list[tuple[int, int, int]]:
    return [(params[k], _word(params, k + 1), _word(params, k + 3)) for k in range(0, len(params) - 4, 5)]
