"""No bytes, in any pieces, make the simulator raise or lose its footing."""

from __future__ import annotations

from itertools import pairwise

from hypothesis import given, settings
from hypothesis import strategies as st

from sim.dynamixel import DynamixelBus, Fault, Servo
from sim.dynamixel.load import Load
from sim.dynamixel.packet import Damaged, Instruction, Packet, Parser, encode
from sim.lamp import ScpiLamp

# Bytes of headers and instructions come up often, so that a good part of the noise is almost a packet.
NASTY = st.lists(
    st.one_of(
        st.sampled_from([b"\xff", b"\xff\xff\xfd", b"\xff\xff\xfd\x00", b"\xfd", b"\x00", b"\x01", b"\xfe", b"\x55"]),
        st.binary(max_size=12),
        st.builds(encode, st.integers(0, 254), st.integers(0, 255), st.binary(max_size=24)),
    ),
    max_size=12,
).map(b"".join)


def _pieces(data: bytes, cuts: list[int]) -> list[bytes]:
    edges = [0, *sorted(cut % (len(data) + 1) for cut in cuts), len(data)]
    return [data[a:b] for a, b in pairwise(edges)]


@settings(derandomize=True, max_examples=300, deadline=None)
@given(NASTY, st.lists(st.integers(0, 400), max_size=6))
def test_any_bytes_are_packets_or_nothing_however_they_are_cut(data: bytes, cuts: list[int]) -> None:
    whole = Parser().receive(data)
    assert all(isinstance(packet, Packet | Damaged) for packet in whole)
    parser = Parser()
    assert [packet for piece in _pieces(data, cuts) for packet in parser.receive(piece)] == whole


@settings(derandomize=True, max_examples=300, deadline=None)
@given(NASTY)
def test_a_bus_answers_a_ping_after_any_bytes(data: bytes) -> None:
    bus = DynamixelBus([Servo(1), Servo(2)])
    for delay, reply in bus.feed(data, 1.0):
        assert delay >= 0.0
        assert reply.startswith(b"\xff\xff\xfd\x00")
    bus.idle()
    ids = [servo.id for servo in bus.servos]  # a well-formed write may have changed them
    answers = bus.feed(encode(ids[0], Instruction.PING), 2.0)
    assert len(answers) == ids.count(ids[0])


@settings(derandomize=True, max_examples=300, deadline=None)
@given(st.integers(0, 255), st.integers(0, 700), st.binary(max_size=30), st.floats(0.0, 1e4))
def test_any_instruction_with_any_parameters_is_answered(instruction: int, address: int, data: bytes, t: float) -> None:
    bus = DynamixelBus([Servo(1)])
    for id in (1, 254):
        bus.feed(encode(id, instruction, address.to_bytes(2, "little") + data), t)
    bus.servos[0].output_counts(t + 1.0)


@settings(derandomize=True, max_examples=200, deadline=None)
@given(st.integers(-(2**20) + 1, 2**20 - 1), st.integers(0, 32_767), st.integers(0, 32_767), st.floats(0.0, 0.5))
def test_a_shaft_reaches_any_goal_under_any_profile(goal: int, velocity: int, acceleration: int, stop: float) -> None:
    """In extended mode, with a second goal before the first is reached; the reading ends within friction's reach."""
    servo = Servo(1, backlash_counts=3.0)
    servo.write(11, b"\x04", 0.0)
    servo.write(108, acceleration.to_bytes(4, "little") + velocity.to_bytes(4, "little"), 0.0)
    servo.write(64, b"\x01", 0.0)
    servo.write(116, (-goal).to_bytes(4, "little", signed=True), 0.0)
    servo.write(116, goal.to_bytes(4, "little", signed=True), stop)
    end = 1e7
    assert abs(servo.shaft_counts(end) - goal) <= 3.0 + 1e-6
    assert abs(servo.output_counts(end) - servo.shaft_counts(end)) <= 1.5 + 1e-6
    present = int.from_bytes(servo.read(132, 4, end), "little", signed=True)
    assert present == round(servo.shaft_counts(end))


@settings(derandomize=True, max_examples=300, deadline=None)
@given(st.one_of(st.binary(max_size=80), st.text("OUTPSRCLEVYIDN:;?*. 01\n", max_size=80).map(str.encode)))
def test_a_lamp_survives_any_bytes(data: bytes) -> None:
    lamp = ScpiLamp()
    lamp.feed(data, 0.0)
    lamp.feed(b"\n*CLS\n", 0.0)
    assert lamp.feed(b"*OPC?\n", 1.0) == [(0.0, b"1\n")]
    assert 0.0 <= lamp.relative_output(2.0) <= 1.0


ORDERS = st.lists(
    st.tuples(
        st.sampled_from([(10, 1), (11, 1), (20, 4), (31, 1), (36, 2), (38, 2), (64, 1), (82, 2), (84, 2), (98, 1), (100, 2),
                         (102, 2), (104, 4), (108, 4), (112, 4), (116, 4)]),
        st.one_of(st.sampled_from([0, 1, 2, 3, 4, 5, 8, 16, 50]), st.integers(-5000, 5000)),
        st.floats(0.0, 20.0),
    ),
    max_size=30,
)  # fmt: skip


@settings(derandomize=True, max_examples=150, deadline=None)
@given(ORDERS, st.floats(0.0, 5.0), st.sampled_from(["obstacle", "stuck", "reboot", "hardware"]), st.floats(0.0, 60.0))
def test_a_loaded_servo_survives_any_orders(orders, torque: float, kind, at: float) -> None:  # type: ignore[no-untyped-def]
    """Weight, an accident, and whatever is written when: its readings stay numbers, and asking twice changes nothing."""
    servo = Servo(1, load=Load(torque, 100.0), backlash_counts=3.0)
    bus = DynamixelBus([servo], [Fault(kind, at_time_s=at)])
    t = 0.0
    for (address, size), value, later in orders:
        t += later
        data = (value & (1 << 8 * size) - 1).to_bytes(size, "little")
        assert len(bus.feed(encode(1, Instruction.WRITE, address.to_bytes(2, "little") + data), t)) == 1
    t += 1.0
    first = bus.feed(encode(1, Instruction.READ, b"\x7a\0\x19\0"), t)
    assert bus.feed(encode(1, Instruction.READ, b"\x7a\0\x19\0"), t) == first
    assert servo.output_counts(t) == servo.output_counts(t)
    assert abs(servo.output_counts(t) - servo.shaft_counts(t)) <= 1.5 + 1e-6
