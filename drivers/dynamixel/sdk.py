"""The vendor's packet code (dynamixel-sdk) with its traps closed; framing and CRC stay the vendor's.

Two subclasses, of the port and of the Protocol 2.0 packets. They change what is wrong in dynamixel-sdk 4.0.5 to 4.1.0
and nothing else:

- instructions are byte-stuffed (the SDK stuffs a copy and sends the original), and replies are unstuffed as the manual
  says (the SDK loses a byte of ``FF FF FD FF FD FD``);
- packet timeouts run on a given clock, not on the wall's calendar time, and cannot be set back by each transmission;
- a wait sleeps in the port's read instead of spinning;
- a line that babbles for ever, or a clock that stands still, ends in an error instead of a hang.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from dynamixel_sdk.port_handler import PortHandler
from dynamixel_sdk.protocol2_packet_handler import Protocol2PacketHandler

from drivers.serial_port import open_port
from gonio.errors import DeviceError, ProtocolError

HEADER = b"\xff\xff\xfd"
ID_AT, LENGTH_AT, INSTRUCTION_AT, ERROR_AT, PARAMETERS_AT = 4, 5, 7, 8, 9

_BABBLE_BYTES = 8192  # far more than any one answer, broadcast ping of 253 servos included
_STUCK_READS = 20_000


class Port(PortHandler):  # type: ignore[misc]
    """Port of the SDK on any pyserial URL.

    Parameters
    ----------
    url : str
        Path or pyserial URL.
    timeout_s : float
        Margin of every packet timeout beyond the time its bytes take on the line [s].
    now : callable
        Seconds, never going back: the clock that the timeouts run on.
    """

    def __init__(self, url: str, *, timeout_s: float, now: Callable[[], float]) -> None:
        super().__init__(url)
        self.is_open: bool = False
        self.timeout_s = timeout_s
        self._now = now
        self._received = 0
        self._empty_reads = 0
        self._empty_since = 0.0

    def setupPort(self, cflag_baud: int) -> bool:
        if self.is_open:
            self.closePort()
        self.ser = open_port(self.port_name, baud=cflag_baud)
        self.is_open = True
        self.tx_time_per_byte = 10_000.0 / cflag_baud  # ms
        return True

    def getCurrentTime(self) -> float:
        return self._now() * 1000.0

    def setPacketTimeout(self, packet_length: int) -> None:
        self.setPacketTimeoutMillis(self.tx_time_per_byte * packet_length + self.timeout_s * 1000.0)

    def setPacketTimeoutMillis(self, msec: float) -> None:
        super().setPacketTimeoutMillis(msec)
        self._received = 0
        self._empty_reads = 0

    def readPort(self, length: int) -> bytes:
        data = bytes(self.ser.read(length))
        if data:
            self._received += len(data)
            self._empty_reads = 0
            if self._received > _BABBLE_BYTES:
                raise ProtocolError(
                    f"Port {self.port_name}: {self._received} bytes and no end to the answer; "
                    "check that all servos have the same baud rate and that no two share an id."
                )
            return data
        if self._empty_reads == 0:
            self._empty_since = self._now()
        self._empty_reads += 1
        if self._empty_reads > _STUCK_READS and self._now() == self._empty_since:
            raise DeviceError(
                f"Port {self.port_name}: the clock of the packet timeouts stands still; give the bus the clock of its port."
            )
        return data


class Packets(Protocol2PacketHandler):  # type: ignore[misc]
    """Protocol 2.0 packets of the SDK with stuffing repaired in both directions."""

    def addStuffing(self, packet: list[int]) -> list[int]:
        packet[:] = super().addStuffing(packet)
        return packet

    def removeStuffing(self, packet: list[int]) -> list[int]:
        length = packet[LENGTH_AT] | packet[LENGTH_AT + 1] << 8
        end = INSTRUCTION_AT + length - 2  # where the CRC starts
        body = bytes(packet[INSTRUCTION_AT:end]).replace(HEADER + b"\xfd", HEADER)
        length = len(body) + 2
        packet[INSTRUCTION_AT:end] = body
        packet[LENGTH_AT], packet[LENGTH_AT + 1] = length & 0xFF, length >> 8
        return packet

    def transmit(self, port: Port, servo_id: int, instruction: int, parameters: bytes = b"", answer: int = 0) -> int:
        """Send one instruction and start the timeout of its answer of `answer` data bytes; the SDK's result code."""
        length = len(parameters) + 3
        packet = [0] * (length + 7)
        packet[ID_AT], packet[INSTRUCTION_AT] = servo_id, instruction
        packet[LENGTH_AT], packet[LENGTH_AT + 1] = length & 0xFF, length >> 8
        packet[INSTRUCTION_AT + 1 : INSTRUCTION_AT + 1 + len(parameters)] = parameters
        result: Any = self.txPacket(port, packet)
        port.setPacketTimeout(answer + 11)
        return int(result)
