"""The servo driver against the protocol-level simulator, through the vendor's SDK, on a virtual clock.

The truths come from the simulator's own side of the line: its registers, its shaft, its log of instructions.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import pytest

from drivers.dynamixel import Bus, Servo
from gonio.errors import (
    ConfigurationError,
    DeviceError,
    DeviceTimeoutError,
    HardwareStatusError,
    LimitError,
)
from gonio.interfaces import Axis
from sim import port
from sim.clock import VirtualClock
from sim.dynamixel.bus import DynamixelBus
from sim.dynamixel.control_table import XL330_M288, XL430_W250, Model
from sim.dynamixel.faults import Fault
from sim.dynamixel.servo import Servo as SimServo

DEG = math.pi / 180.0
COUNT = 2.0 * math.pi / 4096.0
POLL_S = 0.02


@dataclass
class Rig:
    """One simulated servo, and the driver that drives it."""

    clock: VirtualClock
    sim: SimServo
    line: DynamixelBus
    bus: Bus

    def servo(self, **changes: object) -> Servo:
        options: dict[str, object] = {
            "lower": -100 * DEG,
            "upper": 100 * DEG,
            "velocity": 60 * DEG,
            "acceleration": 300 * DEG,
        }
        return Servo(self.bus, "arm", 1, **(options | changes))  # type: ignore[arg-type]

    def connected(self, **changes: object) -> Servo:
        servo = self.servo(**changes)
        servo.connect()
        return servo

    def finish(self, servo: Servo) -> list[int]:
        """Poll until settled; the goals seen on the way."""
        goals: list[int] = []
        for _ in range(5000):
            goal = self.register(116, 4)
            if not goals or goals[-1] != goal:
                goals.append(goal)
            if servo.settled():
                return goals
            self.clock.sleep(POLL_S)
        raise AssertionError("never settled")

    def register(self, address: int, size: int) -> int:
        return int.from_bytes(self.sim.read(address, size, self.clock.now()), "little", signed=True)

    def writes(self, address: int) -> int:
        """Write instructions to this address so far."""
        return sum(p.instruction == 3 and int.from_bytes(p.params[:2], "little") == address for _, p in self.line.log)


class Bench:
    """Makes rigs, and takes them off the process-wide list of simulated ports."""

    def __init__(self) -> None:
        self.buses: list[Bus] = []

    def __call__(self, faults: Sequence[Fault] = (), *, attempts: int = 3, **servo: object) -> Rig:
        clock = VirtualClock()
        sim = SimServo(1, **servo)  # type: ignore[arg-type]
        line = DynamixelBus([sim], faults)
        url = port.attach(f"driver-{len(self.buses)}", line, clock)
        bus = Bus(url, clock=clock, now=clock.now, attempts=attempts).open()
        self.buses.append(bus)
        return Rig(clock, sim, line, bus)

    def close(self) -> None:
        for k, bus in enumerate(self.buses):
            bus.close()
            port.detach(f"driver-{k}")


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    yield bench
    bench.close()


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


def test_overload_says_what_happened_and_that_torque_is_off(bench: Bench) -> None:
    rig = bench([Fault("hardware", at_goal_write=1, after_s=0.3)])
    servo = rig.connected()
    servo.move_to(90 * DEG)
    with pytest.raises(HardwareStatusError, match=r"Axis arm \(id 1 .*overload.*torque is off.*reboot"):
        rig.finish(servo)
    with pytest.raises(HardwareStatusError):
        servo.read()


def test_hardware_error_at_connect(bench: Bench) -> None:
    rig = bench([Fault("hardware", at_time_s=0.0, bits=0x04)])
    with pytest.raises(HardwareStatusError, match="overheating"):
        rig.connected()


def test_stall_names_goal_and_position_and_lets_go(bench: Bench) -> None:
    rig = bench([Fault("stuck", at_goal_write=1, after_s=0.5)])
    servo = rig.connected()
    servo.move_to(90 * DEG)
    with pytest.raises(DeviceError, match=r"no progress for 2 s: it stands at \d+\.\d\d deg.*goal is 90\.00 deg"):
        rig.finish(servo)
    assert rig.register(116, 4) == pytest.approx(rig.sim.shaft_counts(rig.clock.now()), abs=2)
    assert rig.sim.torque


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


def test_too_much_current_stops_the_move_and_names_both_currents(bench: Bench) -> None:
    """An obstacle: the servo pushes with its stall current, 2.3 A, long before the move counts as stalled."""
    rig = bench([Fault("obstacle", at_goal_write=1, after_s=0.5, ahead_counts=5.0)])
    servo = rig.connected(current_limit=1.0)
    servo.move_to(90 * DEG)
    with pytest.raises(DeviceError, match=r"draws 2\.\d\d A at \d+\.\d\d deg .*to 90\.00 deg, its limit is 1\.00 A"):
        rig.finish(servo)
    assert rig.clock.now() < 1.3
    assert rig.sim.torque
    assert rig.register(116, 4) == pytest.approx(rig.sim.shaft_counts(rig.clock.now()), abs=2)


def test_the_current_of_a_move_is_not_too_much(bench: Bench) -> None:
    rig = bench()
    servo = rig.connected(current_limit=1.0)
    for angle in (60.0, -60.0, 0.0):
        servo.move_to(angle * DEG)
        rig.finish(servo)


def test_a_servo_that_falls_silent(bench: Bench) -> None:
    rig = bench([Fault("silent", servo_id=1, at_goal_write=1)])
    servo = rig.connected()
    with pytest.raises(DeviceTimeoutError, match=r"Axis arm \(id 1 on sim://.*no answer within 0.5 s.*check its power"):
        servo.move_to(40 * DEG)
        rig.finish(servo)
    with pytest.raises(DeviceTimeoutError, match="cut the power"):
        rig.bus.stop_all()


def test_a_servo_that_loses_its_torque(bench: Bench) -> None:
    rig = bench()
    servo = rig.connected()
    servo.move_to(40 * DEG)
    rig.clock.sleep(0.3)
    rig.sim.reboot(rig.clock.now())
    with pytest.raises(DeviceError, match="lost its torque"):
        rig.finish(servo)


def test_watchdog_stops_a_servo_that_nobody_asks(bench: Bench) -> None:
    rig = bench()
    servo = rig.connected(watchdog_s=0.2)
    servo.move_to(90 * DEG)
    rig.clock.sleep(0.3)
    rig.clock.sleep(5.0)
    assert rig.sim.shaft_counts(rig.clock.now()) < 2048 + 0.5 * 1024
    with pytest.raises(DeviceError, match="own watchdog"):
        rig.finish(servo)
    assert rig.register(112, 4) == 43  # a tripped watchdog clears the profile
    servo.move_to(10 * DEG)
    rig.finish(servo)
    assert rig.register(98, 1) == 0


def test_outside_its_limits_at_connect_it_stays_loose(bench: Bench) -> None:
    rig = bench(initial_counts=3500.0)
    with pytest.raises(LimitError, match=r"stands at 127\.\d+ deg, outside its limits of -100 to 100 deg"):
        rig.connected()
    assert not rig.sim.torque


def test_wrong_model(bench: Bench) -> None:
    with pytest.raises(DeviceError, match=r"model number 1020 \(XM430-W350\), rig.toml says XL430-W250"):
        bench().connected(model="XL430-W250")


def test_before_connect_nothing_moves(bench: Bench) -> None:
    rig = bench()
    servo = rig.servo()
    with pytest.raises(DeviceError, match="not connected"):
        servo.move_to(0.0)
    assert not rig.line.log


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lower": 10 * DEG, "upper": -10 * DEG}, "not below"),
        ({"upper": 190 * DEG}, "counts 910 to 4210"),
        ({"direction": 2}, "direction 2"),
        ({"model": "AX-12"}, "'AX-12' is not known"),
        ({"velocity": 0.0}, "above 0"),
        ({"overshoot": 0.5 * DEG}, "overshoot 0.5 deg"),
        ({"approach": "sideways"}, "up, down or any"),
        ({"watchdog_s": 3.0}, "0 to 2.54"),
        ({"current_limit": 5.0}, r"current limit 5 A is outside 0 to 3\.21 A of XM430-W350"),
        ({"pwm_limit": 1.2}, r"PWM limit 1\.2 is outside 0 to 1"),
    ],
)
def test_parameters_outside_their_range(bench: Bench, changes: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        bench().servo(**changes)


def test_two_axes_with_one_id(bench: Bench) -> None:
    rig = bench()
    rig.servo()
    with pytest.raises(ConfigurationError, match="both have id 1"):
        rig.servo()


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
