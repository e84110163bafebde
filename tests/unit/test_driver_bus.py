"""The bus: late, lost and damaged answers, stopping. Against the simulator on a virtual clock.

A late answer is the dangerous one: it carries no address and, taken for the answer to the next question, is a wrong
angle without any error.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import pytest

from drivers.dynamixel import Bus, Servo
from drivers.dynamixel import registers as reg
from gonio.errors import ConfigurationError, DeviceError, DeviceTimeoutError, ParameterError, ProtocolError
from sim import port
from sim.clock import VirtualClock
from sim.dynamixel.bus import DynamixelBus
from sim.dynamixel.faults import Fault
from sim.dynamixel.servo import Servo as SimServo

DEG = math.pi / 180.0


@dataclass
class Line:
    clock: VirtualClock
    sims: dict[int, SimServo]
    line: DynamixelBus
    bus: Bus


class Lines:
    def __init__(self) -> None:
        self.made: list[Line] = []

    def __call__(self, faults: Sequence[Fault] = (), *, ids: Sequence[int] = (1, 2, 3), attempts: int = 3) -> Line:
        clock = VirtualClock()
        sims = {k: SimServo(k, initial_counts=2000.0 + 100 * k) for k in ids}
        line = DynamixelBus(list(sims.values()), faults)
        url = port.attach(f"bus-{len(self.made)}", line, clock)
        self.made.append(Line(clock, sims, line, Bus(url, clock=clock, now=clock.now, attempts=attempts).open()))
        return self.made[-1]


@pytest.fixture
def lines() -> Iterator[Lines]:
    lines = Lines()
    yield lines
    for k, made in enumerate(lines.made):
        made.bus.close()
        port.detach(f"bus-{k}")


# -- single transactions


def test_ping_and_scan(lines: Lines) -> None:
    made = lines()
    model, firmware = made.bus.ping(2)
    assert model == 1020
    assert made.bus.scan() == dict.fromkeys((1, 2, 3), (model, firmware))


def test_a_block_is_the_state_of_one_instant(lines: Lines) -> None:
    made = lines()
    block = made.bus.block(2)
    assert block.position == 2200
    assert block.velocity == 0
    assert not block.in_motion
    assert not block.alert
    assert 9.5 <= block.voltage * 0.1 <= 16.0
    assert block.sent_s < block.received_s


def test_signed_values_come_back_signed(lines: Lines) -> None:
    made = lines()
    made.bus.write(1, reg.OPERATING_MODE, 4)
    made.bus.write(1, reg.GOAL_POSITION, -131073)  # FF FF FD FF on the wire, which must be stuffed
    assert made.bus.read(1, reg.GOAL_POSITION) == -131073


@pytest.mark.parametrize(
    ("register", "value"), [(reg.GOAL_POSITION, 2**31), (reg.TORQUE_ENABLE, -1), (reg.BUS_WATCHDOG, 128)]
)
def test_a_value_that_does_not_fit_its_register(lines: Lines, register: reg.Register, value: int) -> None:
    made = lines()
    with pytest.raises(ParameterError, match=register.name):
        made.bus.write(1, register, value)
    assert not made.line.log


def test_a_refusal_names_register_value_and_reason(lines: Lines) -> None:
    made = lines()
    with pytest.raises(DeviceError, match=r"id 2 on sim://.* refused Goal Position = 4096: data (limit|range) error"):
        made.bus.write(2, reg.GOAL_POSITION, 4096)


@pytest.mark.parametrize("number", [1, 2, 4, 5, 6, 7])
def test_an_error_answer_is_never_a_value(lines: Lines, number: int) -> None:
    """The SDK gives the CRC bytes of an error answer for the value of a one- or two-byte register."""
    made = lines([Fault("error", servo_id=1, at_instruction=1, number=number)])
    with pytest.raises(DeviceError, match="refused reading Model Number"):
        made.bus.read(1, reg.MODEL_NUMBER)


def test_an_instruction_damaged_on_its_way_is_sent_again(lines: Lines) -> None:
    made = lines([Fault("error", servo_id=1, at_instruction=1, number=3)])
    assert made.bus.read(1, reg.MODEL_NUMBER) == 1020


def test_the_alert_bit_is_not_an_error_of_the_instruction(lines: Lines) -> None:
    made = lines([Fault("hardware", servo_id=1, at_time_s=0.0, bits=0x01)])
    made.clock.sleep(0.1)
    assert made.bus.write(1, reg.PROFILE_VELOCITY, 10) is True
    assert made.bus.read(1, reg.PROFILE_VELOCITY) == 10
    assert made.bus.block(1).alert
    assert "input voltage" in str(made.bus.hardware_fault(1))


# -- lost, damaged, late


@pytest.mark.parametrize("kind", ["drop", "corrupt"])
def test_a_lost_or_damaged_answer_is_asked_for_again(lines: Lines, kind: str) -> None:
    made = lines([Fault(kind, servo_id=1, at_reply=2)])  # type: ignore[arg-type]
    assert [made.bus.block(1).position for _ in range(4)] == [2100] * 4
    assert made.bus.timeouts == 1


@pytest.mark.parametrize("delay_s", [0.49, 0.501, 0.55, 0.7, 0.749, 0.76, 1.0, 1.3, 2.0])
def test_a_late_answer_is_never_taken_for_another_registers(lines: Lines, delay_s: float) -> None:
    """An answer of each length comes late by more than the timeout, the drain, the fence; every value stays right."""
    truth = {
        reg.PRESENT_POSITION: 2100,
        reg.PRESENT_VELOCITY: 0,
        reg.HOMING_OFFSET: 0,
        reg.PROFILE_VELOCITY: 7,
        reg.MODEL_NUMBER: 1020,
        reg.MAX_POSITION_LIMIT: 4095,
    }
    for nth in range(1, 9):
        made = lines([Fault("delay", servo_id=1, at_reply=nth + 1, delay_s=delay_s)])
        made.bus.write(1, reg.PROFILE_VELOCITY, 7)
        for _ in range(3):
            for register, value in truth.items():
                assert made.bus.read(1, register) == value, (nth, register.name)


def test_answers_that_come_late_again_and_again(lines: Lines) -> None:
    made = lines([Fault("delay", servo_id=1, at_reply=3, every=5, delay_s=0.6)], attempts=5)
    for _ in range(40):
        assert made.bus.read(1, reg.MODEL_NUMBER) == 1020
        assert made.bus.read(1, reg.MAX_VOLTAGE_LIMIT) == 160
        assert made.bus.agreed_block(1).position == 2100
    assert made.bus.timeouts > 10


def test_an_answer_of_another_servo_is_passed_over(lines: Lines, caplog: pytest.LogCaptureFixture) -> None:
    """Servo 1 speaks up while servo 2 is asked."""
    made = lines([Fault("delay", servo_id=1, at_reply=1, delay_s=0.75 + 1e-3)], attempts=1)
    with pytest.raises(DeviceTimeoutError):
        made.bus.block(1)
    with caplog.at_level(logging.INFO, "drivers.dynamixel.bus"):
        positions = [made.bus.block(2).position for _ in range(3)]
    assert positions == [2200] * 3


def test_silence_costs_a_bounded_time_and_names_the_remedy(lines: Lines) -> None:
    made = lines([Fault("silent", servo_id=2, at_instruction=1)])
    with pytest.raises(DeviceTimeoutError, match=r"id 2 on sim://.*1000000 baud; check its power, cable, id and baud rate"):
        made.bus.block(2)
    assert made.clock.now() < 5.0
    assert made.bus.block(3).position == 2300


def test_a_servo_that_comes_back_is_heard(lines: Lines) -> None:
    made = lines([Fault("silent", servo_id=1, at_instruction=2, until_instruction=4)])
    assert [made.bus.block(1).position for _ in range(3)] == [2100] * 3


def test_an_answer_that_an_interrupt_left_behind_is_not_read_later(lines: Lines) -> None:
    """Ctrl-C between question and answer; the answer, 31 bytes about a place long left, comes with the next one."""
    for k in range(30):  # it comes at another moment of the next transaction each time
        made = lines([Fault("delay", servo_id=1, at_reply=2, delay_s=0.3)])
        looks = [0]

        def now(clock: VirtualClock = made.clock, looks: list[int] = looks) -> float:
            looks[0] -= 1
            if looks[0] == 0:
                raise KeyboardInterrupt
            return clock.now()

        made.bus.close()
        made.bus = Bus(made.bus.port_name, clock=made.clock, now=now).open()
        assert made.bus.block(1).position == 2100
        looks[0] = 20  # after the question is out
        with pytest.raises(KeyboardInterrupt):
            made.bus.block(1)
        asked = made.line.log[-1][0]
        made.sims[1].write(64, b"\x01", made.clock.now())
        made.sims[1].write(116, (2500).to_bytes(4, "little"), made.clock.now())
        made.clock.advance_to(asked + 0.3 + (k - 10) * 1e-4)
        position = made.bus.block(1).position
        assert position == round(made.sims[1].shaft_counts(made.clock.now()))
        assert position > 2400


# -- stopping


def axes(made: Line) -> list[Servo]:
    servos = [
        Servo(made.bus, name, k, lower=-100 * DEG, upper=100 * DEG, velocity=60 * DEG, acceleration=300 * DEG)
        for k, name in enumerate(("arm", "pan", "tilt"), start=1)
    ]
    for servo in servos:
        servo.connect()
        servo.move_to(90 * DEG)
    made.clock.sleep(0.7)
    return servos


def test_stop_all_holds_every_axis_with_torque(lines: Lines) -> None:
    made = lines()
    axes(made)
    before = {k: sim.shaft_counts(made.clock.now()) for k, sim in made.sims.items()}
    start = made.clock.now()
    made.bus.stop_all()
    assert made.clock.now() - start < 0.02
    made.clock.sleep(3.0)
    for k, sim in made.sims.items():
        assert sim.torque
        assert sim.shaft_counts(made.clock.now()) == pytest.approx(before[k], abs=15)


def test_stop_all_reaches_the_others_when_one_is_silent(lines: Lines) -> None:
    made = lines()
    axes(made)
    made.line.inject(Fault("silent", servo_id=2, at_time_s=made.clock.now()))
    with pytest.raises(DeviceTimeoutError, match=r"Axis pan \(id 2 .*cut the power"):
        made.bus.stop_all()
    seen = {k: made.sims[k].shaft_counts(made.clock.now()) for k in (1, 3)}
    made.clock.sleep(3.0)
    for k, counts in seen.items():
        assert made.sims[k].shaft_counts(made.clock.now()) == pytest.approx(counts, abs=15)
        assert counts < 2048 + 1024 - 50


def test_stop_all_after_an_interrupted_transaction(lines: Lines) -> None:
    """Ctrl-C in the middle of a transaction leaves the SDK's port marked as in use; stopping still works."""
    made = lines()
    pressed: list[bool] = []

    def now() -> float:
        if pressed:
            pressed.clear()
            raise KeyboardInterrupt
        return made.clock.now()

    made.bus.close()
    made.bus = Bus(made.bus.port_name, clock=made.clock, now=now).open()
    axes(made)
    pressed.append(True)
    with pytest.raises(KeyboardInterrupt):
        made.bus.block(1)
    made.bus.stop_all()
    made.clock.sleep(3.0)
    assert all(sim.shaft_counts(made.clock.now()) < 2048 + 1024 - 50 for sim in made.sims.values())


@pytest.mark.parametrize("ahead", [1, 2])
def test_stop_all_insists_after_a_lost_answer(lines: Lines, ahead: int) -> None:
    """Of the question where the axis is, or of the order to hold there."""
    made = lines()
    axes(made)
    replies = {k: sum(p.id == k for _, p in made.line.log) for k in made.sims}
    made.line.inject(Fault("drop", servo_id=2, at_reply=replies[2] + ahead))
    made.bus.stop_all()
    assert made.bus.timeouts == 1
    made.clock.sleep(3.0)
    assert all(sim.shaft_counts(made.clock.now()) < 2048 + 1024 - 50 for sim in made.sims.values())


# -- the port


def test_protocol_1_is_refused() -> None:
    clock = VirtualClock()
    with pytest.raises(ConfigurationError, match=r"Protocol 1\.0 is not supported"):
        Bus("sim://any", clock=clock, now=clock.now, protocol=1.0)


def test_a_port_that_is_not_there() -> None:
    clock = VirtualClock()
    with pytest.raises(DeviceError, match=r"Port /dev/no-such-adapter does not exist; plug the adapter in"):
        Bus("/dev/no-such-adapter", clock=clock).open()
    with pytest.raises(DeviceError, match="no such kind of port"):
        Bus("telepathy://servo", clock=clock).open()
    with pytest.raises(DeviceError, match="does not offer 12345 baud"):
        Bus("sim://nothing", clock=clock, baud=12345).open()


def test_a_closed_port_says_so(lines: Lines) -> None:
    made = lines()
    made.bus.close()
    with pytest.raises(DeviceError, match="is closed; open the bus first"):
        made.bus.ping(1)


def test_a_line_that_vanishes_is_a_device_error(lines: Lines) -> None:
    made = lines()
    port.detach("bus-0")
    with pytest.raises(DeviceError, match="Port sim://bus-0 failed"):
        made.bus.ping(1)


def test_a_wrong_baud_rate_is_silence(lines: Lines) -> None:
    made = lines()
    made.bus.close()
    made.bus = Bus(made.bus.port_name, clock=made.clock, now=made.clock.now, baud=57_600).open()
    with pytest.raises(DeviceTimeoutError, match="57600 baud"):
        made.bus.ping(1)


def test_a_clock_that_stands_still_does_not_hang(lines: Lines) -> None:
    made = lines([Fault("silent", servo_id=1, at_instruction=1)])
    bus = Bus("sim://bus-0", clock=made.clock, now=lambda: 7.0)
    made.bus.close()
    bus.open()
    with pytest.raises(DeviceError, match="stands still"):
        bus.ping(1)
    bus.close()


class Babble:
    """A device that answers any instruction with endless garbage."""

    def feed(self, data: bytes, t: float) -> list[tuple[float, bytes]]:
        return [(0.0, b"\xff\xff\xfe" * 10_000)]

    def idle(self) -> None:
        return


def test_a_babbling_line_ends_in_an_error() -> None:
    clock = VirtualClock()
    url = port.attach("babble", Babble(), clock)
    with Bus(url, clock=clock, now=clock.now) as bus, pytest.raises(ProtocolError, match="no end to the answer"):
        bus.ping(1)
    port.detach("babble")
