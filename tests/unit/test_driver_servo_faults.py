"""What the servo driver reports as a fault and what it refuses, against the simulator on a virtual clock."""

from __future__ import annotations

import pytest

from gonio.errors import (
    ConfigurationError,
    DeviceError,
    DeviceTimeoutError,
    HardwareStatusError,
    LimitError,
)
from sim.dynamixel.faults import Fault
from tests.servo_bench import DEG, Bench


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
