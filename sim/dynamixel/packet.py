"""Dynamixel Protocol 2.0, bytes in and packets out, with no port in sight.

Written from the protocol's description alone and sharing no code with the vendor's SDK, which the drivers use: a mistake
in one cannot hide in the other. Any input is a packet, a `Damaged` packet, or nothing; the parser never raises.

It refuses to guess: a packet whose stuffing is wrong (a bare ``FF FF FD`` inside its body) is dropped and the parser
starts again at the inner header, as a receiver does that looks for headers byte by byte.

References
----------
ROBOTIS e-Manual, DYNAMIXEL Protocol 2.0, https://emanual.robotis.com/docs/en/dxl/protocol2/
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum

HEADER = b"\xff\xff\xfd\x00"
BROADCAST = 0xFE
MAX_LENGTH = 1024  # largest LEN field taken for a packet; anything above is noise that looks like a header

_MARK = b"\xff\xff\xfd"
_STUFFED = b"\xff\xff\xfd\xfd"


class Instruction(IntEnum):
    """Instruction codes."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    FACTORY_RESET = 0x06
    REBOOT = 0x08
    CLEAR = 0x10
    BACKUP = 0x20
    STATUS = 0x55
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A
    BULK_READ = 0x92
    BULK_WRITE = 0x93
    FAST_BULK_READ = 0x9A


class ErrorNumber(IntEnum):
    """Error numbers of a status packet, without the alert bit."""

    NONE = 0
    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


ALERT = 0x80  # bit of the error byte: Hardware Error Status is not zero


@dataclass(frozen=True)
class Packet:
    """One packet.

    Attributes
    ----------
    id : int
        Servo, or 0xFE for all.
    instruction : int
        0x55 for a status.
    params : bytes
        Parameters, unstuffed. Of a status, the first byte is the error byte.
    """

    id: int
    instruction: int
    params: bytes = b""


@dataclass(frozen=True)
class Damaged:
    """A frame of the right shape whose checksum is wrong; its fields may be wrong too."""

    id: int
    instruction: int


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ (0x8005 if crc & 0x8000 else 0)
        table.append(crc & 0xFFFF)
    return tuple(table)


_TABLE = _crc_table()


def crc16(data: bytes, crc: int = 0) -> int:
    """CRC-16, polynomial 0x8005, start 0, not reflected; `crc` continues an earlier sum.

    Examples
    --------
    >>> hex(crc16(b"123456789"))
    '0xfee8'
    """
    for byte in data:
        crc = ((crc << 8) ^ _TABLE[((crc >> 8) ^ byte) & 0xFF]) & 0xFFFF
    return crc


def stuff(body: bytes) -> bytes:
    """Insert FD after each ``FF FF FD`` of an instruction with its parameters."""
    return body.replace(_MARK, _STUFFED)


def unstuff(body: bytes) -> bytes:
    """Undo `stuff`."""
    return body.replace(_STUFFED, _MARK)


def encode(id: int, instruction: int, params: bytes = b"") -> bytes:
    """One packet as bytes; the length and the checksum count the stuffed body."""
    body = stuff(bytes((instruction,)) + params)
    head = HEADER + bytes((id,)) + (len(body) + 2).to_bytes(2, "little") + body
    return head + crc16(head).to_bytes(2, "little")


def encode_status(id: int, error: int, params: bytes = b"") -> bytes:
    """A status packet with its error byte."""
    return encode(id, Instruction.STATUS, bytes((error,)) + params)


def encode_fast_status(parts: Iterable[tuple[int, int, bytes]], length: int) -> bytes:
    """The one status packet that answers a fast read; several servos write it in turn.

    Parameters
    ----------
    parts : iterable of (error, id, data)
        What each servo appends. If a servo of the chain is missing the caller passes the parts before it, and the
        packet stays unfinished, as it does on the line.
    length : int
        LEN field that the first servo announces for the complete packet.

    Notes
    -----
    Each servo ends its part with a checksum of all bytes sent so far, so the last one is the packet's own. A fast
    status is not stuffed.
    """
    out = HEADER + bytes((BROADCAST,)) + length.to_bytes(2, "little") + bytes((Instruction.STATUS,))
    for error, id, data in parts:
        out += bytes((error, id)) + data
        out += crc16(out).to_bytes(2, "little")
    return out


class Parser:
    """Finds packets in a stream of bytes that may be cut anywhere and may hold garbage.

    Examples
    --------
    >>> Parser().receive(b"noise" + encode(1, Instruction.PING))
    [Packet(id=1, instruction=1, params=b'')]
    """

    def __init__(self) -> None:
        self._buffer = bytearray()

    @property
    def pending(self) -> int:
        """Bytes of a packet that is not complete yet."""
        return len(self._buffer)

    def reset(self) -> None:
        """Forget an unfinished packet, as a servo does when the line pauses for more than 1.5 ms."""
        self._buffer.clear()

    def receive(self, data: bytes) -> list[Packet | Damaged]:
        """Take bytes, return the packets that they complete."""
        self._buffer += data
        found: list[Packet | Damaged] = []
        while (packet := self._next()) is not None:
            if not isinstance(packet, bool):
                found.append(packet)
        return found

    def _next(self) -> Packet | Damaged | bool | None:
        """A packet, True after dropping bytes that begin none, or None if more bytes are needed."""
        buffer = self._buffer
        start = buffer.find(HEADER)
        if start < 0:
            # Keep what may be the beginning of a header.
            keep = next((k for k in (3, 2, 1) if buffer.endswith(HEADER[:k])), 0)
            del buffer[: len(buffer) - keep]
            return None
        del buffer[:start]
        if len(buffer) < 8:
            return None
        length = int.from_bytes(buffer[5:7], "little")
        if buffer[4] > BROADCAST or not 3 <= length <= MAX_LENGTH:
            del buffer[:3]
            return True
        end = 7 + length
        # A bare FF FF FD in the body, whether or not the rest has arrived, is the header of something else.
        inner = self._bare_header(min(len(buffer), end - 2))
        if inner:
            del buffer[:inner]
            return True
        if len(buffer) < end:
            return None
        frame = bytes(buffer[:end])
        if crc16(frame[:-2]) != int.from_bytes(frame[-2:], "little"):
            # If the end was lost, the next header begins where the checksum should be.
            header = buffer.find(_MARK, end - 4, end + 2)
            del buffer[: header if header >= 0 else end]
            return Damaged(frame[4], frame[7])
        del buffer[:end]
        body = unstuff(frame[7:-2])
        return Packet(frame[4], body[0], body[1:])

    def _bare_header(self, stop: int) -> int:
        """Index of an unstuffed ``FF FF FD`` between the length field and `stop`, or 0."""
        buffer = self._buffer
        at = buffer.find(_MARK, 7, stop)
        while at >= 0:
            if at + 3 >= stop:
                # The byte that would tell is not in the body. In a complete body that is an error of stuffing.
                return at if stop < len(buffer) else 0
            if buffer[at + 3] != 0xFD:
                return at
            at = buffer.find(_MARK, at + 4, stop)
        return 0
