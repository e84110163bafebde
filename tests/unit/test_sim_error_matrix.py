"""Every instruction of Protocol 2.0 with every way to get it wrong, against the error numbers of the manual.

Source: ROBOTIS e-Manual, DYNAMIXEL Protocol 2.0, "Error" of the status packet and the description of each instruction; the
control table's "Bus Watchdog(98)", "Shutdown(63)" and "Status Return Level(68)".
"""

from __future__ import annotations

from collections.abc import Callable

import pytest

from sim.dynamixel import Fault, Servo
from sim.dynamixel.control_table import MODELS, Model
from sim.dynamixel.packet import ALERT, BROADCAST, Instruction, Packet, Parser, encode
from tests.dynamixel_host import (
    ACCESS,
    CRC,
    DATA_LENGTH,
    DATA_LIMIT,
    DATA_RANGE,
    GOAL,
    INSTRUCTION,
    RESULT_FAIL,
    TORQUE,
    WATCHDOG,
    Host,
)  # fmt: skip

CLEAR_ALL, BACK_UP, RESTORE = b"\x01\x44\x58\x4c\x22", b"\x01CTRL", b"\x02CTRL"


def at(address: int, data: bytes = b"") -> bytes:
    """Parameters of a write."""
    return address.to_bytes(2, "little") + data


def of(address: int, length: int) -> bytes:
    """Parameters of a read."""
    return at(address, length.to_bytes(2, "little"))


def word(value: int, size: int = 4) -> bytes:
    return value.to_bytes(size, "little", signed=value < 0)


def plain(host: Host) -> None:
    """A servo as it comes."""


def torque(host: Host) -> None:
    host.write(TORQUE, 1)


def moving(host: Host) -> None:
    host.write(112, 20)
    host.write(TORQUE, 1)
    host.write(GOAL, 4000)
    host.t += 0.2


def registered(host: Host) -> None:
    host.send(1, Instruction.REG_WRITE, at(65, b"\x01"))


def backed_up(host: Host) -> None:
    host.send(1, Instruction.BACKUP, BACK_UP)


def barked(host: Host) -> None:
    host.write(TORQUE, 1)
    host.write(WATCHDOG, 1)
    host.t += 1.0


def shut_down(host: Host) -> None:
    host.bus.inject(Fault("hardware", at_time_s=host.t))
    host.t += 1.0


State = Callable[[Host], None]
READS: list[tuple[str, State, bytes, int]] = [
    ("whole register", plain, of(132, 4), 0),
    ("part of a register", plain, of(133, 1), 0),
    ("several registers", plain, of(122, 25), 0),
    ("not defined", plain, of(14, 1), ACCESS),
    ("across a gap", plain, of(11, 4), ACCESS),
    ("beyond the table", plain, of(5000, 1), ACCESS),
    ("no byte", plain, of(132, 0), DATA_LENGTH),
    ("no length", plain, at(132), DATA_LENGTH),
    ("no address", plain, b"", DATA_LENGTH),
]
WRITES: list[tuple[str, State, bytes, int]] = [
    ("whole register", plain, at(65, b"\x01"), 0),
    ("two registers", plain, at(108, word(5) + word(6)), 0),
    ("read-only", plain, at(132, word(1)), ACCESS),
    ("not defined", plain, at(14, b"\0"), ACCESS),
    ("beyond the table", plain, at(5000, b"\0"), ACCESS),
    ("EEPROM under torque", torque, at(9, b"\0"), ACCESS),
    ("RAM under torque", torque, at(65, b"\x01"), 0),
    ("above the range", plain, at(65, b"\x02"), DATA_RANGE),
    ("below the range", plain, at(20, word(-1_044_480)), DATA_RANGE),
    ("no such mode", plain, at(11, b"\x02"), DATA_RANGE),
    ("no such drive mode", plain, at(10, b"\x02"), DATA_RANGE),
    ("no such ID", plain, at(7, b"\xfd"), DATA_RANGE),
    ("first half of a register", plain, at(116, b"\0\x08"), DATA_LENGTH),
    ("from its second byte", plain, at(117, word(0)), DATA_LENGTH),
    ("second register cut", plain, at(108, word(5) + b"\0\0"), DATA_LENGTH),
    ("no data", plain, at(65), DATA_LENGTH),
    ("no address", plain, b"", DATA_LENGTH),
    ("goal beyond the position limit", plain, at(116, word(4096)), DATA_LIMIT),
    ("negative goal in position mode", plain, at(116, word(-1)), DATA_LIMIT),
    ("velocity beyond its limit", plain, at(104, word(1000)), DATA_LIMIT),
    ("goal after the watchdog's bark", barked, at(116, word(100)), DATA_RANGE),
    ("velocity after the watchdog's bark", barked, at(104, word(1)), DATA_RANGE),
    ("watchdog cleared", barked, at(98, b"\0"), 0),
    ("torque after a shutdown", shut_down, at(64, b"\x01"), ALERT | RESULT_FAIL),
    ("LED after a shutdown", shut_down, at(65, b"\x01"), ALERT),
]
OTHERS: list[tuple[str, int, State, bytes, int]] = [
    ("ping", Instruction.PING, plain, b"", 0),
    ("ping after a shutdown", Instruction.PING, shut_down, b"", ALERT),
    ("action of nothing", Instruction.ACTION, plain, b"", INSTRUCTION),
    ("action", Instruction.ACTION, registered, b"", 0),
    ("factory reset, ID kept", Instruction.FACTORY_RESET, plain, b"\x01", 0),
    ("factory reset of what", Instruction.FACTORY_RESET, plain, b"\x03", DATA_RANGE),
    ("factory reset without option", Instruction.FACTORY_RESET, plain, b"", DATA_RANGE),
    ("reboot", Instruction.REBOOT, plain, b"", 0),
    ("clear", Instruction.CLEAR, plain, CLEAR_ALL, 0),
    ("clear during a move", Instruction.CLEAR, moving, CLEAR_ALL, RESULT_FAIL),
    ("clear with a wrong key", Instruction.CLEAR, plain, CLEAR_ALL[:-1] + b"\x21", DATA_RANGE),
    ("clear without key", Instruction.CLEAR, plain, b"", DATA_RANGE),
    ("back up", Instruction.BACKUP, plain, BACK_UP, 0),
    ("restore", Instruction.BACKUP, backed_up, RESTORE, 0),
    ("restore of nothing", Instruction.BACKUP, plain, RESTORE, RESULT_FAIL),
    ("back up under torque", Instruction.BACKUP, torque, BACK_UP, RESULT_FAIL),
    ("restore under torque", Instruction.BACKUP, lambda h: (backed_up(h), torque(h))[0], RESTORE, RESULT_FAIL),
    ("back up with a wrong key", Instruction.BACKUP, plain, b"\x01CTRX", DATA_RANGE),
    ("no instruction", 0x77, plain, b"", INSTRUCTION),
]
MATRIX = [
    *((f"read: {what}", Instruction.READ, *rest) for what, *rest in READS),
    *((f"write: {what}", Instruction.WRITE, *rest) for what, *rest in WRITES),
    *((f"reg write: {what}", Instruction.REG_WRITE, *rest) for what, *rest in WRITES),
    *OTHERS,
]


@pytest.mark.parametrize("model", MODELS.values(), ids=list(MODELS))
def test_every_violation_has_its_number(model: Model) -> None:
    """All wrong cases are collected, so that one failure shows the whole pattern."""
    wrong = []
    for what, instruction, prepare, params, error in MATRIX:
        host = Host(Servo(1, model))
        prepare(host)
        answers = host.send(1, instruction, params)
        if [answer.params[0] for answer in answers] != [error]:
            wrong.append((what, answers, error))
        elif error & 0x7F and len(answers[0].params) != 1:
            wrong.append((what, "an error has no data", answers))
    assert wrong == []


def test_limits_of_current_and_pwm() -> None:
    xm430, xl430 = Host(), Host(Servo(1, MODELS["XL430-W250"]))
    for host in (xm430, xl430):
        host.write(36, 400)
        errors = [host.write(100, value) for value in (400, -400, 401, -401, 886)]
        assert errors == [0, 0, DATA_LIMIT, DATA_LIMIT, DATA_RANGE]
    xm430.write(38, 500)
    assert [xm430.write(102, value) for value in (500, -501, 1194)] == [0, DATA_LIMIT, DATA_RANGE]
    assert xl430.write(102, 1) == ACCESS  # no current control
    assert [xl430.write(11, mode) for mode in (0, 5, 1)] == [DATA_RANGE, DATA_RANGE, 0]


@pytest.mark.parametrize("instruction", [i for i in Instruction if i < Instruction.STATUS])
def test_a_wrong_checksum_is_told_whatever_was_asked_and_nothing_is_done(instruction: int) -> None:
    host = Host()
    frame = bytearray(encode(1, instruction, at(65, b"\x01")))
    frame[-1] ^= 0x80
    ((_, reply),) = host.bus.feed(bytes(frame), 0.0)
    assert Parser().receive(reply) == [Packet(1, Instruction.STATUS, bytes((CRC,)))]
    assert host.read(65, 1) == 0


@pytest.mark.parametrize(("what", "instruction", "prepare", "params", "error"), MATRIX, ids=[row[0] for row in MATRIX])
def test_a_broadcast_is_answered_by_pings_alone(
    what: str, instruction: int, prepare: State, params: bytes, error: int
) -> None:
    host = Host()
    prepare(host)
    assert len(host.send(BROADCAST, instruction, params)) == (instruction == Instruction.PING)


@pytest.mark.parametrize("level", [0, 1, 2])
def test_the_status_return_level_says_who_is_answered(level: int) -> None:
    for what, instruction, prepare, params, _ in MATRIX:
        host = Host()
        prepare(host)
        host.write(68, level)
        least = {Instruction.PING: 0, Instruction.READ: 1}.get(instruction, 2)  # type: ignore[call-overload]
        assert len(host.send(1, instruction, params)) == (level >= least), what


def test_reads_of_many_carry_each_servos_own_error() -> None:
    """One address that only one of the models has: the other answers Access and no data, and its neighbour still answers."""
    host = Host(Servo(1, MODELS["XL430-W250"]), Servo(2))
    answers = host.send(BROADCAST, Instruction.SYNC_READ, of(102, 2) + b"\x01\x02")
    assert [answer.params for answer in answers] == [bytes((ACCESS,)), b"\0" + word(1193, 2)]
    items = b"".join(bytes((id,)) + of(address, 2) for id, address in ((2, 102), (1, 102), (2, 14)))
    answers = host.send(BROADCAST, Instruction.BULK_READ, items)
    assert [answer.params for answer in answers] == [b"\0" + word(1193, 2), bytes((ACCESS,)), bytes((ACCESS,))]
    (answer,) = host.send(BROADCAST, Instruction.FAST_SYNC_READ, of(102, 2) + b"\x01\x02")
    assert (answer.params[0], answer.params[6]) == (ACCESS, 0)  # ERR ID data(2) CRC(2), then the next
