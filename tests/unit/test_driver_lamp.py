"""The lamp driver: the dialogue with the simulated SCPI lamp, and with lamps that misbehave."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from drivers.scpi_lamp import ManualLamp, ScpiLamp
from gonio.errors import ConfigurationError, DeviceError, DeviceTimeoutError, ProtocolError
from gonio.interfaces import Lamp
from sim import port
from sim.clock import VirtualClock
from sim.lamp import ScpiLamp as SimLamp

Answer = Callable[[str], list[tuple[float, str]]]


class Scripted:
    """The far end of a lamp's line, answering each line as a function says: (delay [s], text) or nothing."""

    def __init__(self, answer: Answer) -> None:
        self.answer = answer
        self.heard: list[str] = []

    def feed(self, data: bytes, t: float) -> list[tuple[float, bytes]]:
        replies = []
        for line in data.decode().splitlines():
            self.heard.append(line)
            replies += [(delay, text.encode() + b"\n") for delay, text in self.answer(line)]
        return replies

    def idle(self) -> None:
        return


@pytest.fixture
def clock() -> Iterator[VirtualClock]:
    yield VirtualClock()
    port.detach("lamp")


def simulated(clock: VirtualClock) -> tuple[SimLamp, ScpiLamp]:
    sim = SimLamp()
    return sim, ScpiLamp(port.attach("lamp", sim, clock), now=clock.now)


def scripted(clock: VirtualClock, answer: Answer) -> tuple[Scripted, ScpiLamp]:
    far = Scripted(answer)
    return far, ScpiLamp(port.attach("lamp", far, clock), now=clock.now)


def ordinary(line: str) -> list[tuple[float, str]]:
    return {"*IDN?": [(0.0, "Acme,L1,7,2.0")], "SYST:ERR?": [(0.0, '0,"No error"')]}.get(line, [])


def test_switches_and_dims(clock: VirtualClock) -> None:
    sim, lamp = simulated(clock)
    assert isinstance(lamp, Lamp)
    lamp.set_output(True)
    lamp.set_level(0.25)
    assert sim.on
    assert sim.level == 0.25
    lamp.set_output(False)
    assert not sim.on
    assert lamp.describe() == {
        "name": "lamp", "kind": "scpi", "port": "sim://lamp", "identity": sim.identity, "output": False, "level": 0.25,
    }  # fmt: skip
    lamp.close()


def test_errors_of_a_program_before_us_are_forgotten(clock: VirtualClock) -> None:
    sim = SimLamp()
    sim.feed(b"NONSENSE\nMORE\n", 0.0)
    lamp = ScpiLamp(port.attach("lamp", sim, clock), now=clock.now)
    lamp.set_output(True)
    assert sim.on


@pytest.mark.parametrize("level", [-0.01, 1.01, float("nan")])
def test_a_level_outside_its_range_is_refused_before_a_byte_is_sent(clock: VirtualClock, level: float) -> None:
    far, lamp = scripted(clock, ordinary)
    heard = len(far.heard)
    with pytest.raises(ConfigurationError, match="outside 0 to 1"):
        lamp.set_level(level)
    assert len(far.heard) == heard


def test_every_command_is_followed_by_a_look_at_the_errors(clock: VirtualClock) -> None:
    def answer(line: str) -> list[tuple[float, str]]:
        return {"OUTP?": [(0.0, "1")], "SOUR:LEV?": [(0.0, "+5.000000E-01")]}.get(line, ordinary(line))

    far, lamp = scripted(clock, answer)
    lamp.set_output(True)
    lamp.set_level(0.5)
    assert far.heard == [
        "*IDN?", "*CLS", "SYST:ERR?",
        "OUTP ON", "SYST:ERR?", "OUTP?",
        "SOUR:LEV 0.5", "SYST:ERR?", "SOUR:LEV?",
    ]  # fmt: skip


def test_a_refusal_is_quoted_whole(clock: VirtualClock) -> None:
    errors = ['-222,"Data out of range"', '-300,"Interlock open"', '0,"No error"']

    def answer(line: str) -> list[tuple[float, str]]:
        if line == "SYST:ERR?" and far and "OUTP ON" in far[0].heard:
            return [(0.0, errors.pop(0))]
        return ordinary(line)

    far: list[Scripted] = []
    device, lamp = scripted(clock, answer)
    far.append(device)
    with pytest.raises(DeviceError, match=r"refuses 'OUTP ON': -222 Data out of range; -300 Interlock open"):
        lamp.set_output(True)


def test_a_lamp_that_says_it_is_off(clock: VirtualClock) -> None:
    _, lamp = scripted(clock, lambda line: [(0.0, "0")] if line == "OUTP?" else ordinary(line))
    with pytest.raises(DeviceError, match="was switched on and says it is off"):
        lamp.set_output(True)


def test_a_lamp_that_keeps_its_level(clock: VirtualClock) -> None:
    _, lamp = scripted(clock, lambda line: [(0.0, "0.8")] if line == "SOUR:LEV?" else ordinary(line))
    with pytest.raises(DeviceError, match=r"keeps level 0\.8, 0\.9 was set"):
        lamp.set_level(0.9)


def test_silence(clock: VirtualClock) -> None:
    sim, lamp = simulated(clock)
    sim.silent = True
    with pytest.raises(DeviceTimeoutError, match=r"Lamp on sim://lamp does not answer .* within 0.5 s; check its power"):
        lamp.set_output(True)
    assert clock.now() < 10.0


def test_something_that_is_no_lamp(clock: VirtualClock) -> None:
    with pytest.raises(ProtocolError, match="an SCPI device names maker,model,serial,version"):
        scripted(clock, lambda line: [(0.0, "login:")])


@pytest.mark.parametrize("delay_s", [0.49, 0.51, 0.74, 0.76, 1.2])
def test_a_late_answer_is_not_taken_for_another(clock: VirtualClock, delay_s: float) -> None:
    """The first SYST:ERR? after switching is answered late; its "0" must not be read as the answer to OUTP?."""
    late = [delay_s]

    def answer(line: str) -> list[tuple[float, str]]:
        if line == "OUTP?":
            return [(0.0, "1")]
        if line == "SYST:ERR?" and clock.now() > 1.0 and late:
            return [(late.pop(), '0,"No error"')]
        return ordinary(line)

    _, lamp = scripted(clock, answer)
    clock.sleep(1.0)
    lamp.set_output(True)
    assert lamp.describe()["output"] is True
    assert not late


def test_endless_bytes_without_a_line_end(clock: VirtualClock) -> None:
    class Flood(Scripted):
        def feed(self, data: bytes, t: float) -> list[tuple[float, bytes]]:
            return [(0.0, b"x" * 500)] * 20

    with pytest.raises(ProtocolError, match="without a line end"):
        ScpiLamp(port.attach("lamp", Flood(ordinary), clock), now=clock.now)


def test_a_lamp_that_is_unplugged(clock: VirtualClock) -> None:
    _, lamp = simulated(clock)
    port.detach("lamp")
    with pytest.raises(DeviceError, match="Lamp on sim://lamp failed"):
        lamp.set_output(True)


def test_a_person_is_asked_once_for_each_change() -> None:
    asked: list[str] = []
    lamp = ManualLamp(asked.append)
    assert isinstance(lamp, Lamp)
    lamp.set_output(True)
    lamp.set_output(True)
    lamp.set_level(0.5)
    lamp.set_output(False)
    assert asked == ["Switch the lamp on.", "Set the lamp to 50 % of its full output.", "Switch the lamp off."]
    assert lamp.describe() == {"name": "lamp", "kind": "manual", "output": False, "level": 0.5}
    with pytest.raises(ConfigurationError):
        lamp.set_level(2.0)
