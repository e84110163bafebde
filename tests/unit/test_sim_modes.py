"""Operating modes, drive modes, backup, firmware gates, and what loads a simulated servo.

Rules from the ROBOTIS e-Manual (XM430-W350, Protocol 2.0); torque and heat from statics and one time constant, written out.
"""

from __future__ import annotations

import math

import pytest

from sim.dynamixel import Fault, Servo
from sim.dynamixel.control_table import MODELS
from sim.dynamixel.load import Load
from sim.dynamixel.packet import ALERT, BROADCAST, Instruction
from tests.dynamixel_host import (
    ACCESS,
    DATA_RANGE,
    GOAL,
    HARDWARE_ERROR,
    INSTRUCTION,
    MODE,
    MOVING_STATUS,
    POSITION,
    PROFILE_ACCELERATION,
    PROFILE_VELOCITY,
    TORQUE,
    VELOCITY,
    Host,
)  # fmt: skip

PWM, CURRENT, GOAL_PWM, GOAL_CURRENT, P_GAIN, I_GAIN, TEMPERATURE = 124, 126, 100, 102, 84, 82, 146
BACK_UP, RESTORE = b"\x01CTRL", b"\x02CTRL"


def running(*servos: Servo, mode: int = 3, faults: tuple[Fault, ...] = ()) -> Host:
    host = Host(*servos, faults=faults)
    host.write(MODE, mode)
    host.write(PROFILE_VELOCITY, 200)
    host.write(PROFILE_ACCELERATION, 100)
    host.write(TORQUE, 1)
    return host


def test_pwm_mode_turns_as_fast_as_its_share_of_the_voltage() -> None:
    host = running(mode=16)
    assert host.read(GOAL_PWM, 2) == 0
    host.write(GOAL_PWM, -442)
    host.t = 5.0
    assert host.read(VELOCITY, 4, signed=True) == pytest.approx(-46 / 0.229 * 442 / 885, abs=1)
    assert host.read(PWM, 2, signed=True) == pytest.approx(-442, abs=0.06 * 885)  # and friction's share
    host.write(TORQUE, 0)
    assert host.read(VELOCITY, 4) == 0


def test_current_mode_turns_only_against_more_than_friction() -> None:
    host = running(mode=0)
    assert host.read(GOAL_CURRENT, 2) == 0
    host.write(GOAL_CURRENT, 20)  # 54 mA: 0.1 N m, below the gear's friction of 0.2
    host.t = 2.0
    assert host.read(VELOCITY, 4) == 0
    host.write(GOAL_CURRENT, 400)
    host.t = 20.0
    assert host.read(VELOCITY, 4) == round(46 / 0.229)


def test_position_modes_differ_in_their_range() -> None:
    host = running(mode=5)
    host.move(-3000, 20.0)
    assert host.position() == pytest.approx(-3000, abs=3)
    assert host.read(MOVING_STATUS, 1) == 0b110001


def test_reverse_mode_turns_the_axis_and_not_the_homing_offset() -> None:
    host = Host(Servo(1, initial_counts=1000.0))
    host.write(10, 1)
    assert host.position() == 4096 - 1000
    host.write(20, 10)
    assert host.position() == 4096 - 1000 + 10
    host.write(TORQUE, 1)
    host.move(3500)
    assert host.position() == pytest.approx(3500, abs=3)
    assert host.bus.servo(1).shaft_counts(host.t) == pytest.approx(4096 - 3490, abs=3)


def test_torque_on_by_goal() -> None:
    host = Host()
    host.write(10, 8)
    host.move(2500)
    assert (host.read(TORQUE, 1), host.position()) == (1, pytest.approx(2500, abs=3))


def test_backup_keeps_what_the_manual_lists_and_startup_restores_it() -> None:
    host = Host()
    for address, value in ((9, 7), (P_GAIN, 900), (PROFILE_VELOCITY, 123), (65, 1), (60, 3)):
        assert host.write(address, value) == 0
    assert host.read(147, 1) == 0
    assert host.send(1, Instruction.BACKUP, BACK_UP)[0].params == b"\0"
    assert host.read(147, 1) == 1
    host.write(9, 99)
    assert host.send(1, Instruction.BACKUP, RESTORE)[0].params == b"\0"
    assert host.read(9, 1) == 7
    host.send(1, Instruction.REBOOT)  # Startup Configuration: torque on, RAM restored
    assert [host.read(a, s) for a, s in ((TORQUE, 1), (P_GAIN, 2), (PROFILE_VELOCITY, 4), (65, 1))] == [1, 900, 123, 0]


def test_older_firmware_lacks_what_the_manual_dates() -> None:
    old, newer = Host(Servo(1, firmware=41)), Host(Servo(1, firmware=44))
    assert old.send(1, Instruction.PING)[0].params[3] == 41
    assert [old.write(10, bits) for bits in (1, 4, 8)] == [0, DATA_RANGE, DATA_RANGE]
    assert [newer.write(10, bits) for bits in (4, 8)] == [0, DATA_RANGE]
    for host in (old, newer):
        assert host.write(60, 1) == ACCESS
        assert host.send(1, Instruction.READ, b"\x93\0\x01\0")[0].params == bytes((ACCESS,))
        assert host.send(1, Instruction.BACKUP, BACK_UP)[0].params == bytes((INSTRUCTION,))
        assert host.send(BROADCAST, Instruction.FAST_SYNC_READ, b"\x84\0\x04\0\x01") == []
        host.write(9, 7)
        host.send(BROADCAST, Instruction.FACTORY_RESET, b"\xff")  # not executed since 42
    assert (old.read(9, 1), newer.read(9, 1)) == (250, 7)


# ---- weight, obstacles, heat ---------------------------------------------------------------------------------------

WEIGHT = Load(torque_nm=1.0, hanging_counts=0.0)  # horizontal at 1024


def test_a_weight_pulls_the_shaft_from_its_goal_unless_an_integral_gain_holds_it() -> None:
    """Expected: P gain 800 gives 800 / 128 of 885 PWM per count, 4.1 N m at full; 1 N m is then 34.5 counts, 3 degrees."""
    host = running(Servo(1, load=WEIGHT, friction_counts=(0.0, 0.0)))
    host.move(1024)
    droop = 1.0 / (4.1 * 800 / 128 / 885)
    assert host.position() == pytest.approx(1024 - droop, abs=1)
    assert host.read(CURRENT, 2, signed=True) * 2.69e-3 == pytest.approx(2.3 / 4.1, rel=0.02)
    assert host.read(PWM, 2, signed=True) == pytest.approx(885 / 4.1, rel=0.02)
    host.write(TORQUE, 0)
    host.t += 10.0
    assert host.position() == pytest.approx(0, abs=1)  # nothing holds it: it hangs
    host.write(I_GAIN, 100)
    host.write(TORQUE, 1)
    host.move(1024)
    assert host.position() == 1024


def test_a_weight_that_the_current_limit_cannot_hold_hangs_where_it_can() -> None:
    """Expected: Goal Current 0.2 A gives 0.357 N m; sin(angle) = 0.357."""
    host = running(Servo(1, load=WEIGHT, friction_counts=(0.0, 0.0)), mode=5)
    host.write(GOAL_CURRENT, round(0.2 / 2.69e-3))
    host.write(I_GAIN, 100)
    host.move(1024)
    held = round(0.2 / 2.69e-3) * 2.69e-3 * 4.1 / 2.3
    assert host.position() == pytest.approx(math.asin(held) * 4096 / (2 * math.pi), abs=2)
    assert host.read(HARDWARE_ERROR, 1) == 0  # so little is no overload


def test_an_obstacle_stops_the_shaft_and_the_overload_protection_cuts_in() -> None:
    host = running(faults=(Fault("obstacle", at_goal_write=1, after_s=0.2, ahead_counts=100.0),))
    host.write(GOAL, 4000)
    host.t = 0.2
    there = host.position() + 100
    host.t = 1.0
    assert host.position() == pytest.approx(there, abs=1)
    assert host.read(CURRENT, 2) == 855  # the stall current
    assert host.read(MOVING_STATUS, 1) >> 3 & 1
    host.t = 4.0
    answer = host.send(1, Instruction.READ, b"\x46\0\x01\0")[0]
    assert answer.params == bytes((ALERT, 0x20))
    assert host.read(TORQUE, 1) == 0
    host.send(1, Instruction.REBOOT)
    host.write(TORQUE, 1)
    host.move(2100)  # back from it is free
    assert host.position() == pytest.approx(2100, abs=3)


def test_holding_heats_until_the_temperature_limit_cuts_in() -> None:
    """Expected: 31 C + 45 K/A^2 I^2 (1 - exp(-t / 600 s)), I the holding current; the limit's time solved from that."""
    host = running(Servo(1, load=Load(1.7, 0.0), friction_counts=(0.0, 0.0)))
    host.write(TORQUE, 0)
    host.write(31, 50)
    host.write(I_GAIN, 100)
    host.write(TORQUE, 1)
    host.move(1024, 300.0)
    rise = 45 * (1.7 / 4.1 * 2.3) ** 2
    started = 300.0
    assert host.read(TEMPERATURE, 1) == pytest.approx(31 + rise * (1 - math.exp(-started / 600)), abs=1)
    due = -600 * math.log(1 - 19 / rise)
    host.t = due - 5.0
    assert host.read(HARDWARE_ERROR, 1) == 0
    host.t = due + 5.0
    assert (host.read(HARDWARE_ERROR, 1), host.read(TORQUE, 1)) == (0x04, 0)
    host.t = due + 3600.0
    assert host.read(TEMPERATURE, 1) == 31


def test_a_wrong_supply_is_an_input_voltage_error() -> None:
    host = Host(Servo(1, supply_v=18.0))
    assert host.read(144, 2) == 180
    assert (host.read(HARDWARE_ERROR, 1), host.send(1, Instruction.PING)[0].params[0]) == (0x01, ALERT)


def test_speed_follows_the_supply() -> None:
    host = Host(Servo(1, supply_v=10.0))
    host.write(TORQUE, 1)
    host.write(GOAL, 4095)
    host.t = 0.3
    assert host.read(VELOCITY, 4) == round(46 * 10 / 12 / 0.229)


def test_a_servo_reboots_in_the_middle_of_a_move() -> None:
    host = running(faults=(Fault("reboot", at_goal_write=1, after_s=0.2),))
    host.write(GOAL, 4000)
    host.t = 3.0
    assert [host.read(a, s) for a, s in ((TORQUE, 1), (PROFILE_VELOCITY, 4), (HARDWARE_ERROR, 1))] == [0, 0, 0]
    assert 2048 < host.position() < 3000


def test_encoder_harmonics_are_between_the_reading_and_the_link() -> None:
    """Expected: the readings do not know of them; the link is off by the sum of the waves."""
    waves = ((1, 5.0, 0.3), (2, 2.0, 1.0))
    plain, wavy = (Servo(1, backlash_counts=0.0, harmonics=h) for h in ((), waves))
    for servo in (plain, wavy):
        servo.write(64, b"\x01", 0.0)
        servo.write(116, (3000).to_bytes(4, "little"), 0.0)
    assert plain.read(POSITION, 4, 10.0) == wavy.read(POSITION, 4, 10.0)
    turn = 2 * math.pi * plain.output_counts(10.0) / 4096
    off = 5.0 * math.sin(turn + 0.3) + 2.0 * math.sin(2 * turn + 1.0)
    assert wavy.output_counts(10.0) - plain.output_counts(10.0) == pytest.approx(off, abs=1e-9)


def test_where_things_were_is_remembered() -> None:
    """A camera's old frame shows the past, also after new orders."""
    servo = Servo(1)
    servo.write(64, b"\x01", 0.0)
    servo.write(116, (3000).to_bytes(4, "little"), 1.0)
    moments = (0.5, 1.1, 1.2, 1.9)
    seen = [servo.output_counts(t) for t in moments]
    servo.write(116, (1000).to_bytes(4, "little"), 2.0)
    servo.output_counts(9.0)
    assert [servo.output_counts(t) for t in moments] == seen
    assert seen[0] == 2048.0 and seen[0] < seen[1] < seen[2] < seen[3]


@pytest.mark.parametrize("model", MODELS.values(), ids=list(MODELS))
def test_load_or_current_by_model(model) -> None:
    host = running(Servo(1, model, load=Load(0.2 * model.motor.stall_torque_nm, 0.0), friction_counts=(0.0, 0.0)))
    host.write(I_GAIN, 100)
    host.move(1024)
    expected = 200 if model.motor.current_unit_a is None else 0.2 * model.motor.stall_current_a / model.motor.current_unit_a
    assert host.read(CURRENT, 2, signed=True) == pytest.approx(expected, abs=1)
