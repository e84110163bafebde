"""The simulated servo bus by its bytes: error numbers, torque, limits, motion, faults, several servos at once.

The rules are those of the manufacturer's manual for XM430-W350 and Protocol 2.0.
"""

from __future__ import annotations

import pytest

from gonio.errors import ConfigurationError
from sim.dynamixel import Fault, Servo
from sim.dynamixel.control_table import XL430_W250
from sim.dynamixel.packet import BROADCAST, Instruction, Packet, Parser, encode
from tests.dynamixel_host import (
    ACCESS,
    CRC,
    DATA_LENGTH,
    DATA_LIMIT,
    DATA_RANGE,
    GOAL,
    HOMING_OFFSET,
    ID,
    INSTRUCTION,
    LED,
    MAX_POSITION,
    MIN_POSITION,
    MODE,
    MOVING,
    MOVING_STATUS,
    PROFILE_ACCELERATION,
    PROFILE_VELOCITY,
    REGISTERED,
    RESULT_FAIL,
    RETURN_DELAY,
    RETURN_LEVEL,
    SHADOW_ID,
    TORQUE,
    VELOCITY,
    WATCHDOG,
    Host,
)  # fmt: skip


def _ready(*servos: Servo, faults: tuple[Fault, ...] = ()) -> Host:
    """Torque on, 45.8 rev/min and 21 500 rev/min^2: a quarter turn takes 0.45 s."""
    host = Host(*servos, faults=faults)
    for servo in host.bus.servos:
        host.write(PROFILE_VELOCITY, 200, servo.id)
        host.write(PROFILE_ACCELERATION, 100, servo.id)
        host.write(TORQUE, 1, servo.id)
    return host


def test_ping_says_model_and_firmware() -> None:
    assert Host().send(1, Instruction.PING) == [Packet(1, Instruction.STATUS, b"\0\xfc\x03\x2e")]
    assert Host().send(9, Instruction.PING) == []
    both = Host(Servo(7), Servo(3, XL430_W250)).send(BROADCAST, Instruction.PING)
    assert [(p.id, int.from_bytes(p.params[1:3], "little")) for p in both] == [(3, 1060), (7, 1020)]


@pytest.mark.parametrize(
    ("params", "error"),
    [
        ((132).to_bytes(2, "little") + b"\0\0\0\0", ACCESS),  # Present Position is read-only
        ((14).to_bytes(2, "little") + b"\0", ACCESS),  # not defined
        ((5000).to_bytes(2, "little") + b"\0", ACCESS),  # beyond the table
        ((116).to_bytes(2, "little") + b"\0\x08", DATA_LENGTH),  # half a Goal Position
        ((117).to_bytes(2, "little") + b"\0\0\0\0", DATA_LENGTH),  # from its second byte
        ((64).to_bytes(2, "little"), DATA_LENGTH),
        ((64).to_bytes(2, "little") + b"\x02", DATA_RANGE),
        ((11).to_bytes(2, "little") + b"\x02", DATA_RANGE),  # no such mode
        ((116).to_bytes(2, "little") + (4096).to_bytes(4, "little"), DATA_LIMIT),
        ((116).to_bytes(2, "little") + b"\xff\xff\xff\xff", DATA_LIMIT),
        ((104).to_bytes(2, "little") + (201).to_bytes(4, "little"), DATA_LIMIT),  # Velocity Limit is 200
        ((65).to_bytes(2, "little") + b"\x01", 0),
    ],
)
def test_error_numbers_of_writes(params: bytes, error: int) -> None:
    assert Host().send(1, Instruction.WRITE, params)[0].params == bytes((error,))


def test_error_numbers_of_other_instructions() -> None:
    host = Host()
    assert host.send(1, Instruction.ACTION)[0].params == bytes((INSTRUCTION,))
    assert host.send(1, 0x77)[0].params == bytes((INSTRUCTION,))
    assert host.send(1, Instruction.CLEAR, b"\x01\x44")[0].params == bytes((DATA_RANGE,))
    assert host.send(1, Instruction.FACTORY_RESET, b"\x07")[0].params == bytes((DATA_RANGE,))
    # A read beyond the table or across a gap has an error and no data.
    assert host.send(1, Instruction.READ, b"\x94\x00\x04\x00")[0].params == bytes((ACCESS,))
    assert host.send(1, Instruction.READ, b"\x84\x00\x00\x00")[0].params == bytes((DATA_LENGTH,))
    damaged = bytearray(encode(1, Instruction.WRITE, b"\x41\x00\x01"))
    damaged[10] = 0
    assert Parser().receive(host.bus.feed(bytes(damaged), 0.0)[0][1]) == [Packet(1, Instruction.STATUS, bytes((CRC,)))]
    assert host.read(LED, 1) == 0


def test_a_write_is_all_or_nothing() -> None:
    host = Host()
    both = PROFILE_ACCELERATION.to_bytes(2, "little") + (5).to_bytes(4, "little") + (40_000).to_bytes(4, "little")
    assert host.send(1, Instruction.WRITE, both)[0].params == bytes((DATA_RANGE,))
    assert host.read(PROFILE_ACCELERATION, 4) == 0


def test_eeprom_is_locked_while_torque_is_on() -> None:
    host = Host()
    assert host.write(RETURN_DELAY, 0) == 0
    host.write(TORQUE, 1)
    assert host.write(RETURN_DELAY, 5) == ACCESS
    host.write(TORQUE, 0)
    assert host.write(ID, 42) == 0
    assert host.send(42, Instruction.PING)[0].id == 42


def test_return_delay_and_status_return_level() -> None:
    host = Host()
    assert host.bus.feed(encode(1, Instruction.PING), 0.0)[0][0] == pytest.approx(500e-6)
    host.write(RETURN_DELAY, 0)
    assert host.bus.feed(encode(1, Instruction.PING), 0.0)[0][0] == 0.0
    assert host.write(RETURN_LEVEL, 1) is None
    assert host.read(RETURN_LEVEL, 1) == 1
    host.write(RETURN_LEVEL, 0)
    assert host.send(1, Instruction.READ, b"\x44\x00\x01\x00") == []
    assert len(host.send(1, Instruction.PING)) == 1


def test_a_move_is_reported_while_it_lasts() -> None:
    host = _ready()
    host.write(GOAL, 3072)
    host.t += 0.2
    # 0.128 s of acceleration, then 200 * 0.229 rev/min: 3126.6 counts/s * (0.2 - 0.064) s.
    assert host.position() == pytest.approx(2048 + 3126.6 * 0.136, abs=2)
    assert host.read(140, 4) == pytest.approx(2048 + 3126.6 * 0.136, abs=1)
    assert (host.read(MOVING, 1), host.read(MOVING_STATUS, 1), host.read(VELOCITY, 4)) == (1, 0b110010, 200)
    host.t += 0.3
    assert (host.read(MOVING, 1), host.read(MOVING_STATUS, 1), host.read(VELOCITY, 4)) == (0, 0b110001, 0)
    assert 3072 - 3 <= host.position() <= 3072
    servo = host.bus.servo(1)
    assert host.position() == round(servo.shaft_counts(host.t))
    assert servo.shaft_counts(host.t) != round(servo.shaft_counts(host.t))
    assert servo.output_counts(host.t) == pytest.approx(servo.shaft_counts(host.t) - 0.5 * 0.25 / 360 * 4096)


def test_without_a_profile_the_motor_sets_the_pace() -> None:
    host = Host()
    host.write(TORQUE, 1)
    host.write(GOAL, 4095)
    host.t += 0.3
    assert host.read(140, 4) == 4095  # the trajectory is a step
    assert host.read(MOVING_STATUS, 1) == 0b001000  # not following it, not there
    assert host.read(VELOCITY, 4) == round(46 / 0.229)
    host.t += 1.0
    assert host.position() == pytest.approx(4095, abs=3)


def test_torque_on_holds_the_present_position_and_executes_a_goal_written_before() -> None:
    host = Host(Servo(1, initial_counts=1234.4))
    assert host.read(GOAL, 4) == 1234  # without torque it follows the shaft
    host.write(TORQUE, 1)
    host.t = 5.0
    assert host.bus.servo(1).shaft_counts(5.0) == 1234.4
    host.write(TORQUE, 0)
    host.write(GOAL, 2000)
    host.t = 10.0
    assert host.position() == 1234
    host.write(TORQUE, 1)
    host.t = 15.0
    assert host.position() == pytest.approx(2000, abs=3)


def test_torque_off_stops_the_shaft_and_stop_by_goal_holds_it() -> None:
    host = _ready()
    host.write(GOAL, 4000)
    host.t = 0.2
    host.write(TORQUE, 0)
    stopped = host.position()
    host.t = 5.0
    assert host.position() == stopped
    host.write(TORQUE, 1)
    host.write(GOAL, 100)
    host.t = 5.2
    here = host.position()
    host.write(GOAL, here)
    host.t = 10.0
    assert host.position() == pytest.approx(here, abs=3)
    assert host.read(TORQUE, 1) == 1


def test_position_limits_and_extended_mode() -> None:
    host = Host()
    host.write(MIN_POSITION, 1000)
    host.write(MAX_POSITION, 3000)
    assert (host.write(GOAL, 999), host.write(GOAL, 3001), host.write(GOAL, 3000)) == (DATA_LIMIT, DATA_LIMIT, 0)
    assert host.write(MODE, 4) == 0
    assert (host.write(GOAL, -131_073), host.write(GOAL, 1_048_576)) == (0, DATA_RANGE)
    host.write(TORQUE, 1)
    host.t = 1000.0
    assert host.position() == pytest.approx(-131_073, abs=3)
    before, shaft = host.position(), host.bus.servo(1).shaft_counts(host.t)
    assert host.send(1, Instruction.CLEAR, b"\x01\x44\x58\x4c\x22")[0].params == b"\0"
    assert host.position() == before % 4096
    assert host.bus.servo(1).shaft_counts(host.t) == shaft


def test_clear_is_refused_during_a_move() -> None:
    host = _ready()
    host.write(GOAL, 4000)
    host.t = 0.1
    assert host.send(1, Instruction.CLEAR, b"\x01\x44\x58\x4c\x22")[0].params == bytes((RESULT_FAIL,))


def test_homing_offset_moves_the_reading_and_not_the_shaft() -> None:
    host = Host()
    host.write(HOMING_OFFSET, -48)
    assert host.position() == 2000
    assert host.bus.servo(1).shaft_counts(0.0) == 2048.0
    host.write(TORQUE, 1)
    host.move(1000)
    assert host.position() == pytest.approx(1000, abs=3)
    assert host.bus.servo(1).shaft_counts(host.t) == pytest.approx(1048, abs=3)
    host.write(TORQUE, 0)
    host.write(HOMING_OFFSET, 1025)  # beyond a quarter turn: ignored in position mode
    assert host.position() == pytest.approx(1048, abs=3)


def test_reg_write_and_action() -> None:
    host = _ready()
    params = GOAL.to_bytes(2, "little") + (3000).to_bytes(4, "little")
    assert host.send(1, Instruction.REG_WRITE, params)[0].params == b"\0"
    assert host.read(REGISTERED, 1) == 1
    host.t = 5.0
    assert host.position() == 2048
    assert host.send(1, Instruction.ACTION)[0].params == b"\0"
    assert host.read(REGISTERED, 1) == 0
    host.t = 10.0
    assert host.position() == pytest.approx(3000, abs=3)


def test_overload_cuts_torque_and_alerts_until_reboot() -> None:
    host = _ready(faults=(Fault("hardware", servo_id=1, at_goal_write=1, after_s=0.2),))
    host.write(GOAL, 4000)
    host.t = 3.0
    answer = host.send(1, Instruction.READ, b"\x46\x00\x01\x00")[0]
    assert answer.params == b"\x80\x20"
    assert host.read(TORQUE, 1) == 0
    assert 2048 < host.position() < 3000
    assert host.write(TORQUE, 1) == 0x80 | RESULT_FAIL
    host.send(1, Instruction.REBOOT)
    assert host.send(1, Instruction.PING)[0].params[0] == 0
    assert host.write(TORQUE, 1) == 0


def test_a_hardware_error_that_shutdown_does_not_name_only_alerts() -> None:
    host = _ready(faults=(Fault("hardware", at_time_s=1.0, bits=0x01),))  # input voltage; Shutdown is 52
    host.t = 2.0
    assert host.send(1, Instruction.PING)[0].params[0] == 0x80
    assert host.read(TORQUE, 1) == 1


def test_bus_watchdog_stops_refuses_goals_and_clears() -> None:
    host = _ready()
    host.write(WATCHDOG, 5)  # 100 ms
    host.write(GOAL, 4000)
    host.t = 0.09
    assert host.read(WATCHDOG, 1, signed=True) == 5
    host.t = 5.0
    assert host.read(WATCHDOG, 1, signed=True) == -1
    at_trip = host.position()
    assert at_trip == pytest.approx(2048 + 3126.6 * (0.19 - 0.064), abs=2)
    assert host.write(GOAL, 3000) == DATA_RANGE
    assert host.read(TORQUE, 1) == 1
    assert host.write(WATCHDOG, 0) == 0
    host.move(3000)
    assert host.position() == pytest.approx(3000, abs=3)


def test_factory_reset_keeps_what_it_is_told() -> None:
    host = Host(Servo(5))
    host.write(RETURN_DELAY, 7, id=5)
    host.send(5, Instruction.FACTORY_RESET, b"\x02")
    assert (host.read(RETURN_DELAY, 1, id=5), host.read(8, 1, id=5)) == (250, 3)
    host.send(5, Instruction.FACTORY_RESET, b"\xff")
    assert (host.read(ID, 1), host.read(8, 1)) == (1, 1)


def test_secondary_id_takes_ram_writes_and_does_not_answer() -> None:
    host = Host(Servo(1), Servo(2))
    for id in (1, 2):
        host.write(SHADOW_ID, 100, id)
    assert host.write(LED, 1, id=100) is None
    assert host.write(RETURN_DELAY, 9, id=100) is None
    assert [host.read(LED, 1, id) for id in (1, 2)] == [1, 1]
    assert [host.read(RETURN_DELAY, 1, id) for id in (1, 2)] == [250, 250]


def test_indirect_addresses() -> None:
    host = Host()
    params = (168).to_bytes(2, "little") + b"".join(a.to_bytes(2, "little") for a in (132, 133, 134, 135, 65))
    assert host.send(1, Instruction.WRITE, params)[0].params == b"\0"
    assert host.read(224, 4) == 2048
    assert host.write(228, 1) == 0
    assert host.read(LED, 1) == 1
    assert host.send(1, Instruction.WRITE, b"\xe0\x00\x01")[0].params == bytes((ACCESS,))


def test_sync_read_answers_in_the_order_asked_and_ends_at_a_missing_servo() -> None:
    servos = [Servo(id, initial_counts=100.0 * id) for id in (1, 2, 3)]
    host = Host(*servos)
    ask = b"\x84\x00\x04\x00"
    answers = host.send(BROADCAST, Instruction.SYNC_READ, ask + b"\x03\x01\x02")
    assert [(p.id, int.from_bytes(p.params[1:], "little")) for p in answers] == [(3, 300), (1, 100), (2, 200)]
    answers = host.send(BROADCAST, Instruction.SYNC_READ, ask + b"\x01\x09\x02")
    assert [p.id for p in answers] == [1]
    items = b"\x02\x84\x00\x04\x00\x01\x07\x00\x01\x00"
    answers = host.send(BROADCAST, Instruction.BULK_READ, items)
    assert [(p.id, int.from_bytes(p.params[1:], "little")) for p in answers] == [(2, 200), (1, 1)]
    delays = [delay for delay, _ in host.bus.feed(encode(BROADCAST, Instruction.SYNC_READ, ask + b"\x01\x02"), 0.0)]
    assert delays == pytest.approx([500e-6, 500e-6])  # each after the one before it


def test_fast_sync_read_is_one_packet_and_stays_unfinished_without_a_servo() -> None:
    host = Host(*(Servo(id, initial_counts=100.0 * id) for id in (1, 2)))
    (_, frame), = host.bus.feed(encode(BROADCAST, Instruction.FAST_SYNC_READ, b"\x84\x00\x04\x00\x02\x01"), 0.0)
    (packet,) = Parser().receive(frame)
    assert isinstance(packet, Packet)
    assert packet.id == BROADCAST
    assert packet.params[:6] == b"\x00\x02" + (200).to_bytes(4, "little")
    assert packet.params[8:14] == b"\x00\x01" + (100).to_bytes(4, "little")
    (_, frame), = host.bus.feed(encode(BROADCAST, Instruction.FAST_SYNC_READ, b"\x84\x00\x04\x00\x02\x09"), 0.0)
    assert Parser().receive(frame) == []


def test_sync_and_bulk_write_reach_their_servos_and_nobody_answers() -> None:
    host = _ready(Servo(1), Servo(2))
    goals = b"\x01" + (1000).to_bytes(4, "little") + b"\x02" + (3000).to_bytes(4, "little")
    assert host.send(BROADCAST, Instruction.SYNC_WRITE, b"\x74\x00\x04\x00" + goals) == []
    host.t = 10.0
    assert [host.position(id) for id in (1, 2)] == [pytest.approx(1000, abs=3), pytest.approx(3000, abs=3)]
    assert host.send(BROADCAST, Instruction.BULK_WRITE, b"\x01\x41\x00\x01\x00\x01\x02\x44\x00\x01\x00\x01") == []
    assert (host.read(LED, 1, 1), host.read(RETURN_LEVEL, 1, 2)) == (1, 1)
    assert host.send(BROADCAST, Instruction.READ, b"\x84\x00\x04\x00") == []


def test_a_servo_set_to_another_baud_rate_hears_nothing() -> None:
    host = Host(Servo(1, baud_code=1), Servo(2))
    host.bus.baudrate = 1_000_000
    assert (len(host.send(1, Instruction.PING)), len(host.send(2, Instruction.PING))) == (0, 1)
    host.bus.baudrate = 57_600
    assert (len(host.send(1, Instruction.PING)), len(host.send(2, Instruction.PING))) == (1, 0)


def test_faults_of_answers_strike_when_they_are_told_to() -> None:
    host = Host(
        Servo(1),
        Servo(2),
        faults=(
            Fault("silent", servo_id=2, at_instruction=3, until_instruction=5),
            Fault("error", servo_id=1, at_instruction=2, every=3, number=4),
            Fault("drop", servo_id=1, at_reply=4),
        ),
    )
    assert [len(host.send(2, Instruction.PING)) for _ in range(6)] == [1, 1, 0, 0, 1, 1]
    answers = [host.send(1, Instruction.PING) for _ in range(6)]
    assert [a[0].params[0] if a else None for a in answers] == [0, 4, 0, None, 4, 0]


def test_corrupt_and_late_replies() -> None:
    host = Host(faults=(Fault("corrupt", at_reply=1), Fault("delay", at_reply=2, delay_s=0.5)))
    ping = encode(1, Instruction.PING)
    (_, spoilt), = host.bus.feed(ping, 0.0)
    (late, good), = host.bus.feed(ping, 0.0)
    assert late == pytest.approx(0.5005)
    assert sum(a != b for a, b in zip(spoilt, good, strict=True)) == 1


def test_a_silent_servo_neither_hears_nor_answers() -> None:
    host = _ready(Servo(1), Servo(2), faults=(Fault("silent", servo_id=1, at_goal_write=2),))
    host.move(1000)
    assert host.position() == pytest.approx(1000, abs=3)
    host.move(2000)
    assert host.send(1, Instruction.PING) == []
    host.write(GOAL, 3000)
    host.t += 10.0
    assert host.bus.servo(1).shaft_counts(host.t) == pytest.approx(2000, abs=3)
    assert len(host.send(2, Instruction.PING)) == 1


def test_a_stuck_axis_stands_while_its_profile_runs() -> None:
    host = _ready(faults=(Fault("stuck", at_goal_write=1, after_s=0.2),))
    host.move(4000)
    assert host.position() == pytest.approx(2048 + 3126.6 * 0.136, abs=2)
    assert (host.read(140, 4), host.read(MOVING, 1), host.read(MOVING_STATUS, 1)) == (4000, 0, 0b111000)
    assert host.read(126, 2) == 855  # the stall current, 2.3 A


def test_the_log_has_every_instruction_with_its_time() -> None:
    host = Host()
    host.t = 2.5
    host.send(1, Instruction.PING)
    assert list(host.bus.log) == [(2.5, Packet(1, Instruction.PING))]


def test_a_fault_of_a_scenario_is_checked() -> None:
    assert Fault.from_mapping({"kind": "silent", "at_time_s": 3}) == Fault("silent", at_time_s=3)
    with pytest.raises(ConfigurationError, match="unknown att_time_s"):
        Fault.from_mapping({"kind": "silent", "att_time_s": 3})
    with pytest.raises(ConfigurationError, match="kind 'dead' is not known"):
        Fault.from_mapping({"kind": "dead", "at_time_s": 3})
    with pytest.raises(ConfigurationError, match="needs at_reply"):
        Fault.from_mapping({"kind": "drop", "at_goal_write": 3})


def test_time_is_evaluated_and_not_ticked() -> None:
    """Asking often or once gives the same answer."""
    often, once = _ready(Servo(1, seed=3)), _ready(Servo(1, seed=3))
    for host in (often, once):
        host.write(GOAL, 3100)
    for k in range(1000):
        often.t = 0.001 * k
        often.position()
    often.t = once.t = 1.0
    for ask in (Servo.shaft_counts, Servo.output_counts):
        assert ask(often.bus.servo(1), 1.0) == ask(once.bus.servo(1), 1.0)
