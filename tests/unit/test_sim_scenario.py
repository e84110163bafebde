"""Faults of the simulated rig: read from TOML, and striking when they should."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest

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


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[[fault]]\nkind = "tired"\naxis = "pan"\nat_s = 1', "kind = 'tired' is not known"),
        ('[[fault]]\nkind = "silent"\naxis = "pen"\nat_s = 1', "axis = 'pen' is no axis"),
        ('[[fault]]\nkind = "silent"\naxis = "pan"', "needs one trigger"),
        ('[[fault]]\nkind = "silent"\naxis = "pan"\nat_s = 1\nat_pose = 3', "at_pose and at_s"),
        ('[[fault]]\nkind = "lamp_out"\naxis = "pan"\nat_s = 1', "no key 'axis'"),
        ('[[fault]]\nkind = "overload"\naxis = "pan"\nat_reply = 1', "needs at_goal_write or at_time_s"),
        ('[[fault]]\nkind = "drop"\naxis = "pan"\nat_s = 1', "not seconds"),
        ('[[fault]]\nkind = "silent"\naxis = "pan"\nat_pose = 1.5', "whole number"),
        ('[[faults]]\nkind = "silent"', "did you mean 'fault'"),
        ("fault = 3", "list of tables"),
    ],
)
def test_a_scenario_that_cannot_happen_is_refused(text, message):
    with pytest.raises(ConfigurationError, match=message):
        Scenario.from_mapping(tomllib.loads(text))
