"""Faults of the simulated rig: read from TOML, and striking when they should."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest
import serial

from gonio.errors import ConfigurationError, DeviceError
from sim.dynamixel.packet import Instruction, encode
from sim.scenario import Scenario
from sim.serve import Simulation

PING_PAN = encode(2, Instruction.PING)


def rig(text):
    simulation = Simulation(scenario=Scenario.from_mapping(tomllib.loads(text)))
    simulation.lamp.feed(b"OUTP ON\n", 0.0)
    return simulation


def pings(simulation):
    return simulation.bus.feed(PING_PAN, simulation.clock.now())


def error_byte(simulation):
    ((_, reply),) = pings(simulation)
    return reply[8]


def test_a_servo_falls_silent_at_its_pose():
    simulation = rig('[[fault]]\nkind = "silent"\naxis = "pan"\nat_pose = 2')
    for pose in range(2):
        simulation.camera.capture(0.01, label=f"pose {pose} exposure 0")
        assert pings(simulation)
    simulation.camera.capture(0.01, label="pose 20 exposure 0")
    assert pings(simulation)
    simulation.camera.capture(0.01, label="pose 2 exposure 0")
    assert not pings(simulation)
    assert simulation.bus.feed(encode(1, Instruction.PING), simulation.clock.now())


@pytest.mark.parametrize(("kind", "bit"), [("overload", 0x20), ("overheat", 0x04), ("voltage", 0x01)])
def test_a_hardware_error_shows_in_alert_and_register(kind, bit):
    simulation = rig(f'[[fault]]\nkind = "{kind}"\naxis = "pan"\nafter_frames = 1')
    simulation.camera.capture(0.01, label="a")
    assert error_byte(simulation) == 0
    simulation.camera.capture(0.01, label="b")
    assert error_byte(simulation) == 0x80
    assert simulation.servos["pan"].read(70, 1, simulation.clock.now()) == bytes((bit,))


def test_an_error_status_answers_every_time_with_its_number():
    simulation = rig('[[fault]]\nkind = "error_status"\naxis = "pan"\nat_pose = 0\nnumber = 7')
    assert error_byte(simulation) == 0
    simulation.camera.capture(0.01, label="pose 0 exposure 0")
    assert error_byte(simulation) == error_byte(simulation) == 7


def test_a_time_is_kept_by_the_servo_itself():
    simulation = rig('[[fault]]\nkind = "silent"\naxis = "pan"\nat_s = 5.0')
    simulation.clock.sleep(4.9)
    assert pings(simulation)
    simulation.clock.sleep(0.2)
    assert not pings(simulation)


def test_lamp_goes_out_and_camera_goes_away():
    simulation = rig('[[fault]]\nkind = "lamp_out"\nat_pose = 1\n[[fault]]\nkind = "camera_unplugged"\nat_pose = 2')
    simulation.camera.mount("white")
    lit, dark = (simulation.camera.capture(0.016, label=f"pose {k} exposure 0").data for k in (0, 1))
    assert np.mean(lit) > 1000 and np.mean(dark) == pytest.approx(64.0, abs=1.0)
    assert simulation.lamp.feed(b"OUTP?\n", 0.0) == [(0.0, b"1\n")]  # it does not know
    with pytest.raises(DeviceError, match=r"is gone: no frame for 'pose 2 exposure 0'"):
        simulation.camera.capture(0.016, label="pose 2 exposure 0")


def reply_from(simulation):
    return [reply for _, reply in pings(simulation)]


GOOD = encode(2, Instruction.STATUS, b"\0\xfc\x03\x2e")


def bits_wrong(reply):
    return sum((a ^ b).bit_count() for a, b in zip(reply, GOOD, strict=True))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('"drop"', lambda replies: replies == []),
        ('"truncate"\nlost_bytes = 5', lambda replies: replies == [GOOD[:-5]]),
        ('"corrupt"', lambda replies: bits_wrong(replies[0]) == 1),
        ('"corrupt"\nflips = 7', lambda replies: bits_wrong(replies[0]) == 7),
        ('"corrupt"\nflips = 12\nburst = true', lambda replies: bits_wrong(replies[0]) == 12),
        ('"duplicate"', lambda replies: replies == [GOOD, GOOD]),
        ('"wrong_id"', lambda replies: replies == [encode(3, Instruction.STATUS, b"\0\xfc\x03\x2e")]),
        ('"error_status"\nnumber = 4', lambda replies: replies[0][8] == 4),
    ],
)
@pytest.mark.parametrize("trigger", ["at_s = 2.0", "at_pose = 1"])
def test_answers_are_spoilt_from_a_time_or_a_pose_on(text, expected, trigger):
    simulation = rig(f'[[fault]]\naxis = "pan"\n{trigger}\nkind = {text}')
    assert reply_from(simulation) == [GOOD]
    simulation.clock.sleep(2.0)
    simulation.camera.capture(0.01, label="pose 1 exposure 0")
    for _ in range(3):
        assert expected(reply_from(simulation))


def test_every_second_answer_and_one_alone():
    simulation = rig('[[fault]]\nkind = "drop"\naxis = "pan"\nat_s = 1\nevery = 2')
    simulation.clock.sleep(1.0)
    assert [len(reply_from(simulation)) for _ in range(5)] == [0, 1, 0, 1, 0]
    simulation = rig('[[fault]]\nkind = "drop"\naxis = "pan"\nat_reply = 2')
    assert [len(reply_from(simulation)) for _ in range(4)] == [1, 0, 1, 1]


@pytest.mark.parametrize("delay_s", [0.001, 0.04, 0.5])
def test_late_answers(delay_s):
    simulation = rig(f'[[fault]]\nkind = "delay"\naxis = "pan"\nat_reply = 1\ndelay_s = {delay_s}')
    ((late, _),), ((soon, _),) = pings(simulation), pings(simulation)
    assert late - soon == pytest.approx(delay_s)


@pytest.mark.parametrize(("kind", "bit"), [("obstacle", 0x20), ("reboot", 0)])
def test_what_happens_in_the_middle_of_a_move(kind, bit):
    simulation = rig(f'[[fault]]\nkind = "{kind}"\naxis = "pan"\nat_goal_write = 1\nafter_s = 0.2')
    pan = simulation.servos["pan"]
    pan.write(64, b"\x01", 0.0)
    pan.write(112, (100).to_bytes(4, "little"), 0.0)
    pan.write(116, (4000).to_bytes(4, "little"), 0.0)
    simulation.clock.sleep(6.0)
    assert pan.read(70, 1, 6.0) == bytes((bit,))
    assert pan.read(64, 1, 6.0) == b"\0"
    assert 2048 < pan.shaft_counts(6.0) < 2800


def test_frames_are_torn_and_repeated():
    """Expected: a repeated frame is the one before; a torn one has its upper half new and its lower half old."""
    simulation = rig('[[fault]]\nkind = "frame_repeated"\nat_pose = 1\n[[fault]]\nkind = "frame_torn"\nat_pose = 2')
    clean = rig("fault = []")
    seen, true = (
        [bench.camera.capture(0.016, label=f"pose {k} exposure 0").data for k in range(4)] for bench in (simulation, clean)
    )
    np.testing.assert_array_equal(seen[0], true[0])
    np.testing.assert_array_equal(seen[1], true[0])
    half = len(true[2]) // 2
    np.testing.assert_array_equal(seen[2], np.concatenate((true[2][:half], true[1][half:])))
    np.testing.assert_array_equal(seen[3], true[3])


def test_the_bus_goes_and_comes_back_under_another_name():
    simulation = rig('[[fault]]\nkind = "disconnect"\nat_pose = 1\nfor_s = 5\nreturn_as = "elsewhere"')
    url = simulation.attach("there-")["bus"]
    port = serial.serial_for_url(url, 1_000_000, timeout=0.1)
    port.write(PING_PAN)
    assert len(port.read(14)) == 14
    simulation.camera.capture(0.01, label="pose 1 exposure 0")
    with pytest.raises(serial.SerialException):
        port.write(PING_PAN)
    for gone in (url, "sim://elsewhere"):
        with pytest.raises(serial.SerialException, match="could not open"):
            serial.serial_for_url(gone)
    simulation.clock.sleep(5.0)
    with serial.serial_for_url("sim://elsewhere", 1_000_000, timeout=0.1) as back:
        back.write(PING_PAN)
        assert len(back.read(14)) == 14
    simulation.close()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[[fault]]\nkind = "tired"\naxis = "pan"\nat_s = 1', "kind = 'tired' is not known"),
        ('[[fault]]\nkind = "silent"\naxis = "pen"\nat_s = 1', "axis = 'pen' is no axis"),
        ('[[fault]]\nkind = "silent"\naxis = "pan"', "needs one trigger"),
        ('[[fault]]\nkind = "silent"\naxis = "pan"\nat_s = 1\nat_pose = 3', "at_pose and at_s"),
        ('[[fault]]\nkind = "lamp_out"\naxis = "pan"\nat_s = 1', "no key 'axis'"),
        ('[[fault]]\nkind = "overload"\naxis = "pan"\nat_reply = 1', "needs at_goal_write or at_time_s"),
        ('[[fault]]\nkind = "drop"\naxis = "pan"\nat_goal_write = 1', "needs at_reply or at_time_s"),
        ('[[fault]]\nkind = "corrupt"\naxis = "pan"\nat_s = 1\nflips = 0', "above 0"),
        ('[[fault]]\nkind = "corrupt"\naxis = "pan"\nat_s = 1\nburst = 3', "true or false"),
        ('[[fault]]\nkind = "lamp_out"\nat_s = 1\nfor_s = 2', "no key 'for_s'"),
        ('[[fault]]\nkind = "silent"\naxis = "pan"\nat_pose = 1.5', "whole number"),
        ('[[faults]]\nkind = "silent"', "did you mean 'fault'"),
        ("fault = 3", "list of tables"),
    ],
)
def test_a_scenario_that_cannot_happen_is_refused(text, message):
    with pytest.raises(ConfigurationError, match=message):
        Scenario.from_mapping(tomllib.loads(text))
