"""The simulator's codec against the byte examples of the manufacturer's manual.

Source of the examples: ROBOTIS e-Manual, DYNAMIXEL Protocol 2.0, https://emanual.robotis.com/docs/en/dxl/protocol2/.
Two checksums there are misprints (control table restore, fast bulk read); the values here follow from the manual's own
polynomial, which all other examples confirm.
"""

from __future__ import annotations

from dataclasses import replace

import pytest

from sim.dynamixel import DynamixelBus, Servo
from sim.dynamixel.control_table import XM430_W350
from sim.dynamixel.packet import (
    BROADCAST,
    Damaged,
    Instruction,
    Packet,
    Parser,
    crc16,
    encode,
    encode_fast_status,
    encode_status,
    stuff,
    unstuff,
)

ALL = BROADCAST
INSTRUCTIONS = [
    ("ping", "FFFFFD00 01 0300 01 194E", Packet(1, Instruction.PING)),
    ("ping all", "FFFFFD00 FE 0300 01 3142", Packet(ALL, Instruction.PING)),
    ("read", "FFFFFD00 01 0700 02 8400 0400 1D15", Packet(1, Instruction.READ, b"\x84\0\x04\0")),
    ("write", "FFFFFD00 01 0900 03 7400 00020000 CA89", Packet(1, Instruction.WRITE, b"\x74\0\0\x02\0\0")),
    ("reg write", "FFFFFD00 01 0900 04 6800 C8000000 AE8E", Packet(1, Instruction.REG_WRITE, b"\x68\0\xc8\0\0\0")),
    ("action", "FFFFFD00 01 0300 05 02CE", Packet(1, Instruction.ACTION)),
    ("factory reset", "FFFFFD00 01 0400 06 01 A1E6", Packet(1, Instruction.FACTORY_RESET, b"\x01")),
    ("reboot", "FFFFFD00 01 0300 08 2F4E", Packet(1, Instruction.REBOOT)),
    ("clear", "FFFFFD00 01 0800 10 01 44584C22 B1DC", Packet(1, Instruction.CLEAR, b"\x01DXL\x22")),
    ("backup", "FFFFFD00 01 0800 20 01 4354524C 16F5", Packet(1, Instruction.BACKUP, b"\x01CTRL")),
    ("restore", "FFFFFD00 01 0800 20 02 4354524C 9EF5", Packet(1, Instruction.BACKUP, b"\x02CTRL")),
    (
        "sync read",
        "FFFFFD00 FE 0900 82 8400 0400 01 02 CEFA",
        Packet(ALL, Instruction.SYNC_READ, b"\x84\0\x04\0\x01\x02"),
    ),
    (
        "sync write",
        "FFFFFD00 FE 1100 83 7400 0400 01 96000000 02 AA000000 8287",
        Packet(ALL, Instruction.SYNC_WRITE, b"\x74\0\x04\0\x01\x96\0\0\0\x02\xaa\0\0\0"),
    ),
    (
        "bulk read",
        "FFFFFD00 FE 0D00 92 01 9000 0200 02 9200 0100 1A05",
        Packet(ALL, Instruction.BULK_READ, b"\x01\x90\0\x02\0\x02\x92\0\x01\0"),
    ),
    (
        "bulk write",
        "FFFFFD00 FE 1000 93 01 2000 0200 A000 02 1F00 0100 50 B768",
        Packet(ALL, Instruction.BULK_WRITE, b"\x01\x20\0\x02\0\xa0\0\x02\x1f\0\x01\0\x50"),
    ),
    (
        "fast sync read",
        "FFFFFD00 FE 0A00 8A 8400 0400 03 07 04 20F2",
        Packet(ALL, Instruction.FAST_SYNC_READ, b"\x84\0\x04\0\x03\x07\x04"),
    ),
    (
        "fast bulk read",
        "FFFFFD00 FE 1200 9A 03 8400 0400 07 7C00 0200 04 9200 0100 DA2D",
        Packet(ALL, Instruction.FAST_BULK_READ, b"\x03\x84\0\x04\0\x07\x7c\0\x02\0\x04\x92\0\x01\0"),
    ),
    (
        "stuffed write of -131073",
        "FFFFFD00 01 0A00 03 7400 FFFFFDFDFF 23E5",
        Packet(1, Instruction.WRITE, b"\x74\0\xff\xff\xfd\xff"),
    ),
    ("read of 126, 6 bytes", "FFFFFD00 01 0700 02 7E00 0600 36D1", Packet(1, Instruction.READ, b"\x7e\0\x06\0")),
]
STATUSES = [
    ("ping 1", "FFFFFD00 01 0700 55 00 0604 26 655D", 1, 0, b"\x06\x04\x26"),
    ("ping 2", "FFFFFD00 02 0700 55 00 0604 26 6F6D", 2, 0, b"\x06\x04\x26"),
    ("position 166", "FFFFFD00 01 0800 55 00 A6000000 8CC0", 1, 0, b"\xa6\0\0\0"),
    ("position 2079", "FFFFFD00 02 0800 55 00 1F080000 BABE", 2, 0, b"\x1f\x08\0\0"),
    ("voltage", "FFFFFD00 01 0600 55 00 7700 C369", 1, 0, b"\x77\0"),
    ("temperature", "FFFFFD00 02 0500 55 00 24 8BA9", 2, 0, b"\x24"),
    ("done", "FFFFFD00 01 0400 55 00 A10C", 1, 0, b""),
    ("stuffed", "FFFFFD00 01 0B00 55 00 FFFFFDFDFFFFFF 586C", 1, 0, b"\xff\xff\xfd\xff\xff\xff"),
    ("error 1", "FFFFFD00 01 0400 55 01 A48C", 1, 1, b""),
    ("error 2", "FFFFFD00 01 0400 55 02 AE8C", 1, 2, b""),
    ("error 3", "FFFFFD00 01 0400 55 03 AB0C", 1, 3, b""),
    ("error 4", "FFFFFD00 01 0400 55 04 BA8C", 1, 4, b""),
    ("error 5", "FFFFFD00 01 0400 55 05 BF0C", 1, 5, b""),
    ("error 6", "FFFFFD00 01 0400 55 06 B50C", 1, 6, b""),
    ("error 7", "FFFFFD00 01 0400 55 07 B08C", 1, 7, b""),
    ("alert", "FFFFFD00 01 0400 55 80 A28F", 1, 0x80, b""),
    ("alert and error 7", "FFFFFD00 01 0400 55 87 B30F", 1, 0x87, b""),
]


def test_the_checksum_has_its_check_value() -> None:
    assert crc16(b"123456789") == 0xFEE8
    assert crc16(b"6789", crc16(b"12345")) == 0xFEE8


@pytest.mark.parametrize(("text", "packet"), [v[1:] for v in INSTRUCTIONS], ids=[v[0] for v in INSTRUCTIONS])
def test_instructions_of_the_manual(text: str, packet: Packet) -> None:
    frame = bytes.fromhex(text)
    assert encode(packet.id, packet.instruction, packet.params) == frame
    assert Parser().receive(frame) == [packet]


@pytest.mark.parametrize(("text", "id", "error", "data"), [v[1:] for v in STATUSES], ids=[v[0] for v in STATUSES])
def test_statuses_of_the_manual(text: str, id: int, error: int, data: bytes) -> None:
    frame = bytes.fromhex(text)
    assert encode_status(id, error, data) == frame
    assert Parser().receive(frame) == [Packet(id, Instruction.STATUS, bytes((error,)) + data)]


def test_fast_statuses_of_the_manual() -> None:
    sync = "FFFFFD00 FE 1900 55 00 03 A6000000 8408 00 07 1F080000 16CA 00 04 FF030000 D19E"
    parts = [(0, 3, b"\xa6\0\0\0"), (0, 7, b"\x1f\x08\0\0"), (0, 4, b"\xff\x03\0\0")]
    assert encode_fast_status(parts, 0x19) == bytes.fromhex(sync)
    bulk = "FFFFFD00 FE 1400 55 00 03 A6000000 67A4 00 07 A501 2474 00 04 1F D9C1"
    assert encode_fast_status([(0, 3, b"\xa6\0\0\0"), (0, 7, b"\xa5\x01"), (0, 4, b"\x1f")], 0x14) == bytes.fromhex(bulk)


def test_all_instructions_in_one_stream_whole_and_byte_by_byte() -> None:
    stream = b"".join(bytes.fromhex(text) for _, text, _ in INSTRUCTIONS)
    wanted = [packet for _, _, packet in INSTRUCTIONS]
    assert Parser().receive(stream) == wanted
    parser = Parser()
    assert [packet for byte in stream for packet in parser.receive(bytes((byte,)))] == wanted
    assert parser.pending == 0


@pytest.mark.parametrize("noise", [b"\0", b"\xff", b"\xff\xff", b"\xff\xff\xfd", b"\xff\xff\xfd\x00\x01\xff\xff", b"hello"])
def test_noise_before_a_packet_costs_no_packet(noise: bytes) -> None:
    frame = encode(1, Instruction.PING)
    assert Parser().receive(noise + frame) == [Packet(1, Instruction.PING)]


def test_a_truncated_packet_costs_no_other() -> None:
    frame = encode(1, Instruction.WRITE, b"\x74\0\0\x02\0\0")
    for cut in range(8, len(frame)):
        found = Parser().receive(frame[:cut] + encode(2, Instruction.PING))
        assert found[-1] == Packet(2, Instruction.PING)


def test_a_wrong_bit_is_a_damaged_packet() -> None:
    frame = bytearray(encode(1, Instruction.WRITE, b"\x74\0\0\x02\0\0"))
    frame[11] ^= 0x10
    assert Parser().receive(bytes(frame)) == [Damaged(1, Instruction.WRITE)]


def test_an_unstuffed_packet_is_dropped_and_the_next_one_heard() -> None:
    """What dynamixel-sdk 4.1.0 sends for a goal of -131073: its transmitter never stuffs."""
    unstuffed = bytes.fromhex("FFFFFD00 01 0900 03 7400 FFFFFDFF CB05")
    assert Parser().receive(unstuffed + encode(1, Instruction.PING)) == [Packet(1, Instruction.PING)]


def _as_in_the_manual() -> DynamixelBus:
    """Servos in the state of the manual's examples: XM430-W210, firmware 38, and one of a firmware with fast reads."""
    old = replace(XM430_W350, number=1030)
    positions = {1: 166.0, 2: 2079.0, 3: 166.0, 7: 2079.0, 4: 1023.0}
    servos = [
        Servo(id, old, firmware=38 if id < 3 else 45, initial_counts=position, supply_v=11.9)
        for id, position in positions.items()
    ]
    return DynamixelBus(servos)


DIALOGUES = [
    ("ping", ["ping 1"]),
    ("ping all", ["ping 1", "ping 2"]),
    ("read", ["position 166"]),
    ("write", ["done"]),
    ("reg write", ["done"]),
    ("factory reset", ["done"]),
    ("reboot", ["done"]),
    ("clear", ["done"]),
    ("sync read", ["position 166", "position 2079"]),
    ("sync write", []),
    ("bulk write", []),
]


@pytest.mark.parametrize(("asked", "answered"), DIALOGUES, ids=[row[0] for row in DIALOGUES])
def test_dialogues_of_the_manual(asked: str, answered: list[str]) -> None:
    """The manual's instruction in, byte for byte, and byte for byte the manual's status out."""
    frames = {name: text for name, text, _ in INSTRUCTIONS}
    statuses = {name: bytes.fromhex(text) for name, text, *_ in STATUSES}
    bus = _as_in_the_manual()
    got = [reply for _, reply in bus.feed(bytes.fromhex(frames[asked]), 0.0)]
    if asked == "ping all":
        got = got[:2]
    assert got == [statuses[name] for name in answered]


def test_bulk_and_fast_dialogues_of_the_manual() -> None:
    frames = {name: bytes.fromhex(text) for name, text, _ in INSTRUCTIONS}
    bus = _as_in_the_manual()
    first, second = (reply for _, reply in bus.feed(frames["bulk read"], 0.0))
    assert first == bytes.fromhex("FFFFFD00 01 0600 55 00 7700 C369")  # 11.9 V
    assert second == encode_status(2, 0, b"\x1f")  # 31 C here, 36 C there
    ((_, fast),) = bus.feed(frames["fast sync read"], 0.0)
    assert fast == bytes.fromhex("FFFFFD00 FE 1900 55 00 03 A6000000 8408 00 07 1F080000 16CA 00 04 FF030000 D19E")
    ((_, fast),) = bus.feed(frames["fast bulk read"], 0.0)
    assert fast[:14] == bytes.fromhex("FFFFFD00 FE 1400 55 00 03 A6000000")
    assert [fast[k] for k in (16, 17, 22, 23)] == [0, 7, 0, 4] and crc16(fast[:-2]) == int.from_bytes(fast[-2:], "little")


def test_stuffed_dialogues_of_the_manual() -> None:
    """A goal of -131073 arrives, and a current of -1 with a velocity of -3 comes back stuffed."""
    bus = DynamixelBus([Servo(1)])
    bus.feed(encode(1, Instruction.WRITE, b"\x0b\0\x04"), 0.0)
    assert bus.feed(bytes.fromhex("FFFFFD00 01 0A00 03 7400 FFFFFDFDFF 23E5"), 0.0)[0][1] == encode_status(1, 0)
    ((_, reply),) = bus.feed(encode(1, Instruction.READ, b"\x74\0\x04\0"), 0.0)
    assert reply == encode_status(1, 0, b"\xff\xff\xfd\xff") and b"\xff\xff\xfd\xfd\xff" in reply


def test_stuffing_both_ways() -> None:
    # All payloads of up to seven bytes out of those that make headers.
    payloads = [b""]
    for _ in range(7):
        payloads += [payload + bytes((byte,)) for payload in payloads[-(3**_) :] for byte in (0xFF, 0xFD, 0x00)]
    for payload in payloads:
        assert unstuff(stuff(payload)) == payload
        assert Parser().receive(encode(1, Instruction.WRITE, payload)) == [Packet(1, Instruction.WRITE, payload)]
        assert Parser().receive(encode_status(1, 0, payload)) == [Packet(1, Instruction.STATUS, b"\0" + payload)]
