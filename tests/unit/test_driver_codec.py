"""Instructions and registers of the servo driver as the maker has them: the manual's examples, the SDK's control tables."""

from __future__ import annotations

from importlib.resources import files
from itertools import product

import pytest

from drivers.dynamixel import registers as reg
from drivers.dynamixel.sdk import Packets, Port


class Recorder:
    """The far end of a serial line: keeps what is written, gives back what is to be read."""

    def __init__(self, answer: bytes = b"") -> None:
        self.written = b""
        self.answer = answer

    def write(self, data: list[int]) -> int:
        self.written += bytes(data)
        return len(data)

    def read(self, size: int) -> bytes:
        data, self.answer = self.answer[:size], self.answer[size:]
        return data

    def reset_input_buffer(self) -> None:
        return


def transmit(instruction: int, parameters: bytes, servo_id: int = 1) -> bytes:
    far = Recorder()
    line = Port("none", timeout_s=0.1, now=lambda: 0.0)
    line.ser = far
    assert Packets().transmit(line, servo_id, instruction, parameters) == 0
    return far.written


@pytest.mark.parametrize(
    ("instruction", "parameters", "expected"),
    [
        # ROBOTIS e-manual, DYNAMIXEL Protocol 2.0, examples of each instruction
        (0x01, "", "FFFFFD00 01 0300 01 194E"),
        (0x02, "8400 0400", "FFFFFD00 01 0700 02 8400 0400 1D15"),
        (0x03, "7400 00020000", "FFFFFD00 01 0900 03 7400 00020000 CA89"),
        (0x08, "", "FFFFFD00 01 0300 08 2F4E"),
        # -131073 = FF FF FD FF, with the header stuffed
        (0x03, "7400 FFFFFDFF", "FFFFFD00 01 0A00 03 7400 FFFFFDFDFF 23E5"),
    ],
)
def test_instructions_are_those_of_the_manual(instruction: int, parameters: str, expected: str) -> None:
    assert transmit(instruction, bytes.fromhex(parameters)) == bytes.fromhex(expected)


def test_sync_write_is_that_of_the_manual() -> None:
    sent = transmit(0x83, bytes.fromhex("7400 0400 01 96000000 02 AA000000"), servo_id=0xFE)
    assert sent == bytes.fromhex("FFFFFD00 FE 1100 83 7400 0400 01 96000000 02 AA000000 8287")


def test_every_payload_of_header_bytes_survives_both_ways() -> None:
    """All payloads over {FF, FD, 00} up to six bytes, stuffed as the manual says: FF FF FD is sent as FF FF FD FD."""
    packets = Packets()
    for size in range(1, 7):
        for payload in product((0xFF, 0xFD, 0x00), repeat=size):
            data = bytes(payload)
            stuffed = data.replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
            assert transmit(0x03, data)[8:-2] == stuffed
            length = len(stuffed) + 4
            status = [0xFF, 0xFF, 0xFD, 0, 1, length & 0xFF, length >> 8, 0x55, 0, *stuffed, 0, 0]
            status = packets.removeStuffing(status)
            assert bytes(status[9 : 9 + size]) == data
            assert status[5] == size + 4


def test_registers_are_those_of_the_makers_table() -> None:
    """Addresses and sizes against the control tables that the vendor's SDK ships for each model."""
    registers = [value for value in vars(reg).values() if isinstance(value, reg.Register)]
    assert len(registers) > 30
    tables = files("dynamixel_easy_sdk") / "control_table"
    numbers = dict(
        line.split("\t")[:2] for line in (tables / "dynamixel.model").read_text().splitlines() if line[:1].isdigit()
    )
    for model in reg.MODELS.values():
        file = numbers[str(model.number)].strip()
        assert file == model.name.lower().replace("-", "_") + ".model"
        rows = (tables / file).read_text().split("[control table]")[1].splitlines()[2:]
        entries = {row.split("\t")[2].strip(): (int(row.split("\t")[0]), int(row.split("\t")[1])) for row in rows if row}
        for register in registers:
            name = register.name
            if name == "Present Current" and model.current_unit_a is None:
                name = "Present Load"
            if name in entries:
                assert (register.address, register.size) == entries[name], (model.name, name)
            elif name == "Current Limit":
                assert model.current_unit_a is None and model.highest_current == 0
            else:
                assert name in ("Protocol Type", "Protocol Version"), (model.name, name)


def test_the_block_has_no_gap() -> None:
    at = reg.BLOCK_ADDRESS
    for register in reg.BLOCK:
        assert register.address == at
        at += register.size
    assert (reg.BLOCK_ADDRESS, reg.BLOCK_SIZE) == (116, 31)
