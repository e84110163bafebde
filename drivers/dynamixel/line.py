"""Transactions on one Dynamixel line (Protocol 2.0), so that no answer is taken for another's.

Status packets carry neither an address nor a sequence number. After a timeout the late answer may therefore arrive as
the answer to the next question. So every answer is checked for sender and exact length, and a servo that still owes an
answer, after a timeout or an interrupt, is asked nothing until the line has been drained and the servo fenced by a read
whose *length* changes each time. One lock, one transaction at a time; after it the port is free, whatever happened. It
knows no registers, and never uses the calendar clock.

References: ROBOTIS e-manual, DYNAMIXEL Protocol 2.0 (emanual.robotis.com/docs/en/dxl/protocol2).
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress

from dynamixel_sdk.robotis_def import (
    BROADCAST_ID,
    COMM_RX_CORRUPT,
    COMM_RX_TIMEOUT,
    COMM_SUCCESS,
    INST_READ,
    INST_SYNC_READ,
)

from drivers.dynamixel.sdk import ERROR_AT, ID_AT, LENGTH_AT, PARAMETERS_AT, Packets, Port
from drivers.serial_port import PortLostError, port_errors
from gonio.errors import DeviceError, DeviceTimeoutError, ProtocolError

logger = logging.getLogger(__name__)

_FENCE_LENGTHS = (8, 9, 10, 11, 12)  # from address 0; all hold the id, none is the length of another answer
_ID_ADDRESS = 7
_DRAIN_LIMIT_S = 5.0
_HASTY_TIMEOUT_S = 0.05  # above the latency of a USB adapter, there and back
_STATUS_CRC = 3
_RETURN_STEP_S = 0.1


class Line:
    """A line, and the questions asked on it.

    Parameters
    ----------
    url : str
        Path or pyserial URL.
    baud : int
        Line rate [bit/s].
    timeout_s, drain_s : float
        Time to answer, and silence that ends a drain [s], both on `now`.
    now : callable
        Seconds of the port's own time, never going back.
    attempts : int
        Tries of one transaction before it is an error.
    return_s : float
        How long a port that is lost may take to come back, under its name or as another match of its pattern [s], of the
        wall's time.
    label : callable
        A servo id as messages name it.

    Attributes
    ----------
    lock : threading.RLock
        Hold it to keep several transactions together.
    timeouts : int
        Tries that got no valid answer.
    failing : set of int
        Servos that did not answer the last time.
    returns : int
        How often the port was lost and came back.
    """

    def __init__(
        self,
        url: str,
        *,
        baud: int,
        timeout_s: float,
        drain_s: float,
        now: Callable[[], float],
        attempts: int,
        return_s: float,
        label: Callable[[int], str],
    ) -> None:
        self.url = url
        self.baud = baud
        self.timeout_s = timeout_s
        self.drain_s = drain_s
        self.attempts = attempts
        self.lock = threading.RLock()
        self.timeouts = 0
        self.failing: set[int] = set()
        self.returns = 0
        self._now = now
        self._return_s = return_s
        self._label = label
        self._port = Port(url, timeout_s=timeout_s, now=now)
        self._packets = Packets()
        self._owing: set[int] = set()  # servos whose answer may still come
        self._asked: set[int] = set()  # servos that were ever asked
        self._fences = 0

    def open(self) -> None:
        """Open the port."""
        with self.lock:
            self._port.baudrate = self.baud
            if not self._port.setBaudRate(self.baud):
                raise DeviceError(
                    f"Port {self.url}: the Dynamixel SDK does not offer {self.baud} baud; "
                    "use 57600, 115200, 1000000, 2000000, 3000000 or 4000000."
                )

    def close(self) -> None:
        """Close the port."""
        with self.lock:
            if self._port.is_open:
                self._port.closePort()

    def tell(self, instruction: int, parameters: bytes) -> None:
        """Broadcast an instruction that nobody answers."""
        with self.lock:
            try:
                self._tell(instruction, parameters)
            except PortLostError:
                if not self._return_s:
                    raise
                self._come_back()
                self._tell(instruction, parameters)

    def _tell(self, instruction: int, parameters: bytes) -> None:
        with self._transaction():
            self._sent(self._packets.transmit(self._port, BROADCAST_ID, instruction, parameters))

    def scan(self) -> dict[int, tuple[int, int]]:
        """All servos that answer a broadcast ping, id -> (model number, firmware)."""
        with self._transaction():
            found, result = self._packets.broadcastPing(self._port)
        if result not in (COMM_SUCCESS, COMM_RX_TIMEOUT) and not found:
            raise ProtocolError(
                f"Port {self.url}: answers to a broadcast ping collide; check that no two servos share an id."
            )
        return {int(servo_id): (int(model), int(firmware)) for servo_id, (model, firmware) in sorted(found.items())}

    def distrust(self, servo_id: int) -> None:
        """Drain and fence before this servo is asked anything more: an answer that came was not to the question."""
        self._owing.add(servo_id)

    def ask(
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

        A hasty one has a single short try and leaves the line as it is. `started` is called just before each try.
        """
        allowed = 1 if hasty else self.attempts
        result = COMM_RX_TIMEOUT
        with self.lock:
            for attempt in range(1, allowed + 1):
                self._port.timeout_s = self.timeout_s
                if hasty:
                    self._port.timeout_s = min(self.timeout_s, _HASTY_TIMEOUT_S)
                try:
                    if not hasty and servo_id in self._owing and not self._fence(servo_id):
                        break
                    started()
                    result, data, error = self._exchange(servo_id, instruction, parameters, length)
                except PortLostError:
                    if hasty or attempt == allowed or not self._return_s:
                        raise
                    self._come_back()
                    continue
                if result == COMM_SUCCESS and error & 0x7F != _STATUS_CRC:
                    self.failing.discard(servo_id)
                    return data, error
                if result == COMM_SUCCESS:
                    logger.info("%s got a damaged instruction, try %d", self._label(servo_id), attempt)
                    result = COMM_RX_CORRUPT
                else:
                    self.timeouts += 1
                    logger.info("%s: no valid answer (%d), try %d", self._label(servo_id), result, attempt)
            self.failing.add(servo_id)
        raise self._silence(servo_id, result)

    def read_all(
        self,
        servo_ids: Sequence[int],
        address: int,
        length: int,
        *,
        started: Callable[[], None],
        believed: Callable[[int, bytes, int], bool],
    ) -> None:
        """One sync read: servos answer one instruction in turn. A single try, and only what is beyond doubt.

        The first answer that is missing, damaged, of another servo, of another length or not believed ends it: nothing
        that comes after is listened to, and every one of the servos is fenced before it is asked again. Nothing is asked
        while one of them owes an answer. Ask those one by one that have not answered; that fences them, and names the
        culprit.

        Parameters
        ----------
        servo_ids : sequence of int
            In the order in which they are to answer.
        address, length : int
            Of the registers.
        started : callable
            Called just before the question.
        believed : callable
            Called with servo id, data and error byte as each answer comes; False if it cannot be one to this question.
        """
        parameters = address.to_bytes(2, "little") + length.to_bytes(2, "little") + bytes(servo_ids)
        with self.lock:
            if self._owing & set(servo_ids):
                return
            self._port.timeout_s = self.timeout_s
            try:
                started()
                with self._transaction():
                    self._owing |= set(servo_ids)
                    self._asked |= set(servo_ids)
                    self._sent(self._packets.transmit(self._port, BROADCAST_ID, INST_SYNC_READ, parameters, length))
                    for servo_id in servo_ids:
                        packet, result = self._packets.rxPacket(self._port, False)
                        status = self._status(packet, length) if result == COMM_SUCCESS else None
                        if status is None or packet[ID_AT] != servo_id or status[1] & 0x7F == _STATUS_CRC:
                            self.timeouts += 1
                            logger.info("%s: no valid answer (%d) to a sync read", self._label(servo_id), result)
                            return
                        self._port.setPacketTimeout(length + 11)  # of the next one
                        if not believed(servo_id, *status):
                            return
                    self._owing -= set(servo_ids)
                    self.failing -= set(servo_ids)
            except PortLostError:
                if not self._return_s:
                    raise
                self._come_back()

    def _come_back(self) -> None:
        """Open the port again, as soon as it is there; then every servo may still owe an answer."""
        end_s = time.monotonic() + self._return_s
        logger.warning("port %s is lost; waiting up to %g s for it", self.url, self._return_s)
        while True:
            try:
                with suppress(Exception):  # the port is gone, and so are its ways to be closed
                    self._port.closePort()
                self._port.is_open = False
                self.open()
            except DeviceError:
                if time.monotonic() >= end_s:
                    raise
                time.sleep(_RETURN_STEP_S)
                continue
            self.returns += 1
            self._owing |= self._asked
            return

    def _exchange(self, servo_id: int, instruction: int, parameters: bytes, length: int) -> tuple[int, bytes, int]:
        """One try; the SDK's result, data, error byte. Answers of other servos or other lengths are passed over."""
        with self._transaction():
            self._owing.add(servo_id)
            self._asked.add(servo_id)
            self._sent(self._packets.transmit(self._port, servo_id, instruction, parameters, length))
            while True:
                packet, result = self._packets.rxPacket(self._port, False)
                if result != COMM_SUCCESS:
                    return result, b"", 0
                status = self._status(packet, length)
                if status is not None and packet[ID_AT] == servo_id:
                    self._owing.discard(servo_id)
                    return result, *status
                logger.info("port %s: passed over a stray answer of servo id %d", self.url, packet[ID_AT])

    @staticmethod
    def _status(packet: Sequence[int], length: int) -> tuple[bytes, int] | None:
        """Data and error byte of a status packet; None if it is not the answer to a question for `length` bytes."""
        count = (packet[LENGTH_AT] | packet[LENGTH_AT + 1] << 8) - 4  # instruction, error, CRC
        error = packet[ERROR_AT]
        if count != (0 if error & 0x7F else length):  # a status with an error number carries no data
            return None
        return bytes(packet[PARAMETERS_AT : PARAMETERS_AT + count]), error

    def _fence(self, servo_id: int) -> bool:
        """Drain; then True once the servo answers a question that no earlier one can have been.

        The others that owe an answer are fenced after the same drain: in a move each of them has to hear something in time,
        or its watchdog stops it.
        """
        for _ in range(self.attempts):
            self._drain()
            if self._fenced(servo_id):
                for other in sorted(self._owing - self.failing):
                    self._fenced(other)
                return True
        return False

    def _fenced(self, servo_id: int) -> bool:
        """One try of a question with an answer of a length of its own."""
        self._fences += 1
        length = _FENCE_LENGTHS[self._fences % len(_FENCE_LENGTHS)]
        parameters = (0).to_bytes(2, "little") + length.to_bytes(2, "little")
        result, data, error = self._exchange(servo_id, INST_READ, parameters, length)
        if result == COMM_SUCCESS and not error & 0x7F and data[_ID_ADDRESS] == servo_id:
            return True
        self._owing.add(servo_id)
        return False

    def _drain(self) -> None:
        """Read and discard until the line has been idle for `drain_s`."""
        with self._transaction():
            start = quiet_since = self._now()
            while self._now() - quiet_since < self.drain_s:
                if self._port.readPort(256):
                    quiet_since = self._now()
                if self._now() - start > _DRAIN_LIMIT_S + self.drain_s:
                    raise ProtocolError(
                        f"Port {self.url} does not fall silent within {_DRAIN_LIMIT_S:.0f} s; "
                        "check the baud rate and that no other program talks on the line."
                    )

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        """Leave the port free, whatever happens in between (the SDK leaves it marked as in use)."""
        with self.lock:
            if not self._port.is_open:
                raise DeviceError(f"Port {self.url} is closed; open the bus first.")
            self._port.is_using = False
            try:
                with port_errors(f"Port {self.url}"):
                    yield
            finally:
                self._port.is_using = False

    def _sent(self, result: int) -> None:
        if result != COMM_SUCCESS:
            raise DeviceError(
                f"Port {self.url} did not take an instruction ({self._packets.getTxRxResult(result)}); "
                "reconnect the adapter and resume."
            )

    def _silence(self, servo_id: int, result: int) -> DeviceError:
        if result == COMM_RX_CORRUPT:
            return ProtocolError(
                f"{self._label(servo_id)} answers in damaged packets at {self.baud} baud; "
                "check the cable and that no two servos share the id."
            )
        return DeviceTimeoutError(
            f"{self._label(servo_id)} gives no answer within {self._port.timeout_s:g} s at {self.baud} baud; "
            "check its power, cable, id and baud rate."
        )
