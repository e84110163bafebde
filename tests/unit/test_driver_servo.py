"""The servo driver against the protocol-level simulator, through the vendor's SDK, on a virtual clock: settings and motion.

The truths come from the simulator's own side of the line: its registers, its shaft, its log of instructions.
"""

from __future__ import annotations

import json
import math

import pytest

from drivers.dynamixel import Bus, Servo
from gonio.errors import ConfigurationError, LimitError
from gonio.interfaces import Axis
from sim.dynamixel.control_table import XL330_M288, XL430_W250, Model
from tests.servo_bench import DEG, POLL_S, Bench

COUNT = 2.0 * math.pi / 4096.0


def test_satisfies_the_axis_protocol(bench: Bench) -> None:
    assert isinstance(bench().servo(), Axis)


def test_connect_puts_the_settings_into_the_servo(bench: Bench) -> None:
    rig = bench()
    servo = rig.connected(lower=-90 * DEG, upper=45 * DEG)
    assert rig.register(52, 4) == 2048 - 1024
    assert rig.register(48, 4) == 2048 + 512
    assert rig.register(11, 1) == 3
    assert rig.register(9, 1) == 0
    # 60 deg/s = 10 rev/min, and 43.67 times 0.229 rev/min; 300 deg/s^2 = 3000 rev/min^2, 13.98 times 214.577
    assert rig.register(112, 4) == 43
    assert rig.register(108, 4) == 13
    assert rig.register(44, 4) == 43  # the servo's own limit
    assert rig.sim.torque
    described = servo.describe()
    assert described["model_number"] == 1020
    assert described["lower_deg"] == pytest.approx(-90)
    assert described["velocity_deg_s"] == pytest.approx(43 * 0.229 * 6)


def test_connect_turns_torque_on_without_a_jump(bench: Bench) -> None:
    rig = bench(initial_counts=2300.3)
    rig.connected()
    rig.clock.sleep(3.0)
    assert rig.sim.shaft_counts(rig.clock.now()) == pytest.approx(2300.3, abs=1.0)


def test_another_process_finds_everything_in_place(bench: Bench) -> None:
    """Connecting to a servo that is set up writes no EEPROM, moves nothing and never lets go."""
    rig = bench()
    servo = rig.connected()
    servo.move_to(30 * DEG)
    rig.finish(servo)
    at_rest = rig.sim.shaft_counts(rig.clock.now())
    addresses = (9, 10, 11, 48, 52, 64, 116)
    before = [rig.writes(address) for address in addresses]
    rig.bus.close()
    rig.bus = Bus(rig.bus.port_name, clock=rig.clock, now=rig.clock.now).open()
    bench.buses.append(rig.bus)
    again = rig.connected()
    assert [rig.writes(address) for address in addresses] == before
    rig.finish(again)
    assert rig.sim.shaft_counts(rig.clock.now()) == at_rest


def test_angle_is_measured_and_not_the_goal(bench: Bench) -> None:
    rig = bench(friction_counts=(2.6, 3.4))  # comes to rest about 3 counts from the goal
    servo = rig.connected()
    servo.move_to(30 * DEG)
    rig.finish(servo)
    reading = servo.read()
    shaft = rig.sim.shaft_counts(rig.clock.now())
    assert reading.position_counts == round(shaft)
    assert reading.angle == pytest.approx((round(shaft) - 2048) * COUNT)
    assert reading.goal_counts == 2048 + round(30 / 360 * 4096)
    assert abs(reading.position_counts - reading.goal_counts) >= 2
    assert not reading.moving
    assert 9.5 < reading.voltage_v < 16.0


@pytest.mark.parametrize(("direction", "zero"), [(1, 2048), (-1, 2048), (1, 1900), (-1, 2200)])
def test_sign_and_zero(bench: Bench, direction: int, zero: int) -> None:
    rig = bench(initial_counts=float(zero))
    servo = rig.connected(direction=direction, zero_counts=zero, lower=-60 * DEG, upper=60 * DEG)
    servo.move_to(45 * DEG)
    rig.finish(servo)
    assert rig.sim.shaft_counts(rig.clock.now()) == pytest.approx(zero + direction * 512, abs=4)
    assert servo.read().angle == pytest.approx(45 * DEG, abs=4 * COUNT)


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("approach", ["up", "down"])
def test_every_goal_is_approached_from_one_side(bench: Bench, approach: str, direction: int) -> None:
    """The play of the gears then lies on one flank: link minus shaft is the same at every goal."""
    rig = bench(backlash_counts=3.0)
    servo = rig.connected(approach=approach, direction=direction)
    lags = []
    for target in (20, 50, 10, 12, 12.5, -40, -39, 60):
        servo.move_to(target * DEG)
        rig.finish(servo)
        now = rig.clock.now()
        lags.append(rig.sim.output_counts(now) - rig.sim.shaft_counts(now))
    rising = (approach == "up") == (direction == 1)
    assert lags == pytest.approx([-1.5 if rising else 1.5] * len(lags))


def test_first_move_engages_the_play_even_on_the_direct_way(bench: Bench) -> None:
    """After connecting nobody knows on which flank the gears stand, so a short way up needs two legs."""
    rig = bench()
    servo = rig.connected()
    servo.move_to(0.5 * DEG)
    goals = rig.finish(servo)
    assert goals == [2048 + 6 - 23, 2048 + 6]


def test_a_longer_way_up_needs_one_leg_and_a_way_down_two(bench: Bench) -> None:
    rig = bench()
    servo = rig.connected()
    servo.move_to(30 * DEG)
    assert rig.finish(servo) == [2389]
    servo.move_to(29 * DEG)
    assert rig.finish(servo) == [2378 - 23, 2378]


def test_the_same_goal_again_is_approached_anew_unless_under_way(bench: Bench) -> None:
    rig = bench()
    servo = rig.connected()
    servo.move_to(30 * DEG)
    before = rig.writes(116)
    servo.move_to(30 * DEG)
    assert rig.writes(116) == before
    goals = rig.finish(servo)
    servo.move_to(30 * DEG)
    assert rig.finish(servo)[-1] == goals[-1]
    assert rig.writes(116) == before + 2  # back, and to the goal from its side


def test_overshoot_stays_inside_the_limits(bench: Bench) -> None:
    rig = bench()
    servo = rig.connected(lower=-30 * DEG, upper=30 * DEG)
    for target in (-28.5, -30, 30, -30):
        servo.move_to(target * DEG)
        for goal in rig.finish(servo):
            assert 2048 - 341 <= goal <= 2048 + 341


@pytest.mark.parametrize("angle", [100.01, -100.01, 180.0, float("nan")])
def test_a_move_beyond_a_limit_is_refused_before_a_byte_is_sent(bench: Bench, angle: float) -> None:
    rig = bench()
    servo = rig.connected()
    heard = len(rig.line.log)
    with pytest.raises(LimitError, match=r"[Aa]xis arm .* limits are -100 to 100 deg"):
        servo.move_to(angle * DEG)
    assert len(rig.line.log) == heard


def test_the_limit_itself_can_be_reached(bench: Bench) -> None:
    rig = bench()
    servo = rig.connected()
    servo.move_to(math.radians(100.0))
    rig.finish(servo)
    assert servo.read().angle == pytest.approx(100 * DEG, abs=4 * COUNT)


def test_settled_is_false_until_the_shaft_stands(bench: Bench) -> None:
    rig = bench()
    servo = rig.connected()
    servo.move_to(60 * DEG)
    while not servo.settled():
        rig.clock.sleep(0.003)
    now = rig.clock.now()
    assert rig.sim.shaft_counts(now) == rig.sim.shaft_counts(now - 0.05)


def test_a_small_step_is_not_taken_for_done_before_it_began(bench: Bench) -> None:
    """Within the tolerance of the old position every sign of rest is there at once; two equal readings are not."""
    rig = bench(friction_counts=(0.1, 0.4))
    servo = rig.connected(velocity=1.4 * DEG, acceleration=8 * DEG)
    servo.move_to(20 * DEG)
    rig.finish(servo)
    servo.move_to(20.6 * DEG)
    rig.finish(servo)
    assert rig.sim.shaft_counts(rig.clock.now()) == pytest.approx(2048 + round(20.6 / 360 * 4096), abs=0.5)


def test_stop_holds_where_the_axis_is(bench: Bench) -> None:
    rig = bench()
    servo = rig.connected()
    servo.move_to(90 * DEG)
    rig.clock.sleep(0.8)
    assert not servo.settled()
    seen = rig.sim.shaft_counts(rig.clock.now())
    servo.stop()
    rig.clock.sleep(2.0)
    assert rig.sim.torque
    assert rig.sim.shaft_counts(rig.clock.now()) == pytest.approx(seen, abs=8)
    assert rig.finish(servo)  # holding is being settled; the old goal does not come back
    assert rig.sim.shaft_counts(rig.clock.now()) == pytest.approx(seen, abs=8)


def test_bus_stop_ends_the_move_of_every_servo(bench: Bench) -> None:
    rig = bench()
    servo = rig.connected()
    servo.move_to(90 * DEG)
    rig.clock.sleep(0.8)
    seen = rig.sim.shaft_counts(rig.clock.now())
    rig.bus.stop_all()
    for _ in range(50):
        servo.settled()
        rig.clock.sleep(POLL_S)
    assert rig.sim.torque
    assert rig.sim.shaft_counts(rig.clock.now()) == pytest.approx(seen, abs=8)


def test_current_and_pwm_limits_are_written_and_read_back(bench: Bench) -> None:
    rig = bench()
    rig.sim.write(64, b"\x01", 0.0)
    servo = rig.connected(current_limit=1.0, pwm_limit=0.5)
    assert rig.register(38, 2) == 371  # of 2.69 mA
    assert rig.register(36, 2) == rig.register(100, 2) == 442  # of 885, the one at power-up and the one from now on
    described = servo.describe()
    assert described["current_limit_a"] == pytest.approx(0.998, abs=1e-3)
    assert described["pwm_limit"] == pytest.approx(0.4994, abs=1e-4)
    before = rig.writes(36)
    servo.connect()
    assert rig.writes(36) == before == 1  # EEPROM that is right is left alone
    untouched = bench()
    untouched.sim.write(36, (700).to_bytes(2, "little"), 0.0)
    assert untouched.connected().describe()["pwm_limit"] is None
    assert untouched.register(36, 2) == 700


def test_a_new_speed_is_no_reason_to_let_go(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    """The arm holds; the profile bounds the speed, and EEPROM keeps its old limit until `rig setup`."""
    rig = bench()
    rig.connected().close()
    rig.bus.close()
    bus = Bus(rig.bus.port_name, clock=rig.clock, now=rig.clock.now).open()
    try:
        Servo(bus, "arm", 1, lower=-100 * DEG, upper=100 * DEG, velocity=30 * DEG, acceleration=300 * DEG).connect()
    finally:
        bus.close()
    assert rig.writes(64) == 1  # torque on, once
    assert (rig.register(112, 4), rig.register(44, 4)) == (21, 43)
    assert "Velocity Limit stays as it is; `gonio rig setup` writes it" in caplog.text


def test_a_model_without_a_current_sensor_has_a_pwm_limit(bench: Bench) -> None:
    rig = bench(model=XL430_W250)
    rig.connected(model="XL430-W250", pwm_limit=0.8)
    assert rig.register(36, 2) == 708
    with pytest.raises(ConfigurationError, match=r"Axis arm: XL430-W250 has no current sensor.*use pwm_limit"):
        bench(model=XL430_W250).servo(model="XL430-W250", current_limit=0.5)


@pytest.mark.parametrize("level", [0, 1])
def test_a_servo_set_to_answer_little_is_told_to_answer_everything(bench: Bench, level: int) -> None:
    rig = bench()
    rig.sim.write(68, bytes([level]), 0.0)
    servo = rig.connected()
    servo.move_to(20 * DEG)
    rig.finish(servo)
    assert rig.register(68, 1) == 2


@pytest.mark.parametrize("model", [XL430_W250, XL330_M288], ids=lambda model: model.name)
def test_the_smaller_models(bench: Bench, model: Model) -> None:
    rig = bench(model=model)
    servo = rig.connected(model=model.name)
    servo.move_to(-20 * DEG)
    rig.finish(servo)
    reading = servo.read()
    assert reading.angle == pytest.approx(-20 * DEG, abs=4 * COUNT)
    assert math.isnan(reading.current_a) == (model is XL430_W250)  # it estimates load and has no current sensor


def test_the_description_goes_into_json(bench: Bench) -> None:
    text = json.dumps(bench().connected().describe(), allow_nan=False)
    assert json.loads(text)["firmware"] > 0
