"""All axes at once: what goes over the line in a cycle, and that a bad answer of one axis harms no other.

Against the simulator on a virtual clock. The truths are the simulator's shafts and the bytes on its line.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import pytest

from drivers.dynamixel import Bus, Servo, ServoGroup
from drivers.dynamixel import registers as reg
from gonio.errors import DeviceError, DeviceTimeoutError, HardwareStatusError, LimitError
from gonio.interfaces import AxisGroup
from sim import port
from sim.clock import VirtualClock
from sim.dynamixel.bus import DynamixelBus, Reply
from sim.dynamixel.faults import Fault
from sim.dynamixel.packet import Instruction, Packet, Parser
from sim.dynamixel.servo import Servo as SimServo

DEG = math.pi / 180.0
NAMES = {"arm": 1, "pan": 2, "tilt": 3}
STARTS = {1: 1800.0, 2: 2000.0, 3: 2200.0}
READ, WRITE, SYNC_READ, SYNC_WRITE = (
    Instruction.READ, Instruction.WRITE, Instruction.SYNC_READ, Instruction.SYNC_WRITE,
)  # fmt: skip


@dataclass
class Tapped:
    """A line, and all packets on it, both ways."""

    line: DynamixelBus
    packets: list[tuple[float, Packet]] = field(default_factory=list)
    lose: int | None = None  # the next instruction of this kind never arrives

    def feed(self, data: bytes, now: float) -> list[Reply]:
        if data[7] == self.lose:
            self.lose = None
            return []
        replies = self.line.feed(data, now)
        for sent in (data, *(reply for _, reply in replies)):
            self.packets += [(now, p) for p in Parser().receive(sent) if isinstance(p, Packet)]
        return replies

    def idle(self) -> None:
        self.line.idle()

    def seen(self) -> list[tuple[int, int]]:
        """Id and instruction of each packet; forgets them."""
        seen = [(p.id, p.instruction) for _, p in self.packets]
        self.packets.clear()
        return seen


@dataclass
class Rig:
    """Three simulated servos, and the driver that drives them."""

    clock: VirtualClock
    tap: Tapped
    bus: Bus
    group: ServoGroup

    def shaft(self, servo_id: int) -> float:
        return self.tap.line.servo(servo_id).shaft_counts(self.clock.now())

    def turn(self, servo_id: int, goal: int) -> None:
        """By the simulator's own hand."""
        self.tap.line.servo(servo_id).write(116, goal.to_bytes(4, "little"), self.clock.now())

    def replies(self, servo_id: int) -> int:
        """How many answers it has given so far."""
        return self.tap.line._counts[self.tap.line.servo(servo_id)].replies

    def finish(self) -> None:
        waiting = list(NAMES)
        for _ in range(2000):
            self.clock.sleep(0.02)
            waiting = [name for name, settled in self.group.settled(waiting).items() if not settled]
            if not waiting:
                return
        raise AssertionError(f"{waiting} never settled")


class Bench:
    def __init__(self) -> None:
        self.buses: list[Bus] = []

    def __call__(self, faults: Sequence[Fault] = (), *, watchdog_s: float | None = None) -> Rig:
        clock = VirtualClock()
        tap = Tapped(DynamixelBus([SimServo(k, initial_counts=start) for k, start in STARTS.items()], faults))
        bus = Bus(port.attach(f"group-{len(self.buses)}", tap, clock), clock=clock, now=clock.now).open()
        self.buses.append(bus)
        servos = {
            name: Servo(
                bus, name, k, lower=-100 * DEG, upper=100 * DEG, velocity=60 * DEG, acceleration=300 * DEG,
                watchdog_s=watchdog_s,
            )
            for name, k in NAMES.items()
        }  # fmt: skip
        for servo in servos.values():
            servo.connect()
        tap.packets.clear()
        return Rig(clock, tap, bus, ServoGroup(bus, servos))


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    yield bench
    for k, bus in enumerate(bench.buses):
        bus.close()
        port.detach(f"group-{k}")


def test_satisfies_the_protocol(bench: Bench) -> None:
    assert isinstance(bench().group, AxisGroup)


def test_a_cycle_is_one_sync_write_one_sync_read_and_an_answer_of_each(bench: Bench) -> None:
    rig = bench()
    rig.bus.sync_write(reg.GOAL_POSITION, {k: int(start) for k, start in STARTS.items()})
    blocks = rig.bus.blocks([1, 2, 3])
    assert {k: block.position for k, block in blocks.items()} == {1: 1800, 2: 2000, 3: 2200}
    assert rig.tap.seen() == [(254, SYNC_WRITE), (254, SYNC_READ), (1, 0x55), (2, 0x55), (3, 0x55)]
    assert rig.bus.blocks([3, 1]).keys() == {3, 1}
    assert rig.tap.seen() == [(254, SYNC_READ), (3, 0x55), (1, 0x55)]


def test_a_poll_and_a_measurement_of_all_axes(bench: Bench) -> None:
    rig = bench()
    answers = [(k, 0x55) for k in NAMES.values()]
    rig.group.settled(list(NAMES))
    assert rig.tap.seen() == [(254, SYNC_READ), *answers]
    readings = rig.group.read()
    assert rig.tap.seen() == 2 * [(254, SYNC_READ), *answers]
    assert {name: r.position_counts for name, r in readings.items()} == {"arm": 1800, "pan": 2000, "tilt": 2200}


def test_axes_start_in_the_same_packet_and_arrive(bench: Bench) -> None:
    rig = bench()
    rig.group.move_to({"arm": 30 * DEG, "pan": -40 * DEG, "tilt": 20 * DEG})
    assert rig.tap.seen() == [(254, SYNC_READ), (1, 0x55), (2, 0x55), (3, 0x55), (254, SYNC_WRITE)]
    rig.finish()
    for name, angle in (("arm", 30.0), ("pan", -40.0), ("tilt", 20.0)):
        reading = rig.group.read()[name]
        assert reading.angle == pytest.approx(angle * DEG, abs=0.5 * DEG)
        assert reading.position_counts == round(rig.shaft(NAMES[name]))


def test_a_limit_of_one_axis_keeps_all_from_moving(bench: Bench) -> None:
    rig = bench()
    with pytest.raises(LimitError, match=r"Axis tilt was asked for 120\.000 deg"):
        rig.group.move_to({"arm": 30 * DEG, "pan": 10 * DEG, "tilt": 120 * DEG})
    assert rig.tap.seen() == []


def test_a_sync_write_that_is_lost_is_found_out_by_each_axis(bench: Bench) -> None:
    rig = bench()
    rig.tap.lose = SYNC_WRITE
    rig.group.move_to({"arm": 30 * DEG, "tilt": -10 * DEG})
    assert rig.tap.lose is None
    rig.tap.packets.clear()
    rig.finish()
    goals = [(p.id, int.from_bytes(p.params[2:], "little")) for _, p in rig.tap.packets if p.instruction == WRITE]
    assert goals[:2] == [(1, 2048 + 341), (3, 2048 - 114 - 23)]  # the second by way of its approach from below
    assert rig.shaft(1) == pytest.approx(2048 + 341, abs=6)
    assert rig.shaft(3) == pytest.approx(2048 - 114, abs=6)


# -- one bad answer among the others


def test_a_lost_middle_answer_is_asked_for_again(bench: Bench) -> None:
    rig = bench()
    rig.tap.line.inject(Fault("drop", servo_id=2, at_reply=rig.replies(2) + 1))
    blocks = rig.bus.blocks([1, 2, 3])
    assert {k: block.position for k, block in blocks.items()} == {1: 1800, 2: 2000, 3: 2200}
    assert rig.bus.timeouts == 1
    single = [(k, i) for k, i in rig.tap.seen() if i == READ]
    assert single == [(2, READ), (1, READ), (3, READ), (2, READ), (3, READ)]  # all three are fenced, two asked again
    rig.bus.blocks([1, 2, 3])
    assert rig.tap.seen() == [(254, SYNC_READ), (1, 0x55), (2, 0x55), (3, 0x55)]


def test_no_watchdog_trips_while_a_bad_answer_is_dealt_with(bench: Bench) -> None:
    rig = bench(watchdog_s=1.0)
    rig.group.move_to({"arm": 80 * DEG, "pan": 70 * DEG, "tilt": 60 * DEG})
    rig.clock.sleep(0.1)
    rig.tap.line.inject(Fault("delay", servo_id=3, at_reply=rig.replies(3) + 1, delay_s=0.7))
    rig.finish()
    assert rig.bus.timeouts == 1
    assert rig.shaft(2) == pytest.approx(2048 + 4096 * 70 / 360, abs=6)


def test_a_stop_reaches_axes_whose_watchdog_has_tripped(bench: Bench) -> None:
    rig = bench(watchdog_s=1.0)
    rig.group.move_to({"arm": 90 * DEG, "pan": 90 * DEG})
    rig.clock.sleep(1.5)  # the computer is busy with something else
    assert [rig.bus.read(k, reg.BUS_WATCHDOG) for k in (1, 2, 3)] == [-1, -1, 0]
    rig.bus.stop_all()
    assert [rig.bus.read(k, reg.BUS_WATCHDOG) for k in (1, 2, 3)] == [0, 0, 0]
    for k in (1, 2):
        assert rig.bus.read(k, reg.GOAL_POSITION) == pytest.approx(rig.shaft(k), abs=2)
        assert rig.bus.read(k, reg.PROFILE_VELOCITY) == 43  # the next move is no jerk


def test_a_goal_that_a_tripped_watchdog_refuses_says_why(bench: Bench) -> None:
    rig = bench(watchdog_s=1.0)
    rig.group.move_to({"arm": -30 * DEG})  # from above: by way of a place below the goal
    while rig.bus.block(1).in_motion:
        rig.clock.sleep(0.02)
    rig.clock.sleep(1.5)
    with pytest.raises(DeviceError, match=r"Axis arm .* was stopped by its own watchdog at -3\d\.\d\d deg"):
        for _ in range(10):
            rig.clock.sleep(0.02)
            rig.group.settled(["arm"])


def test_a_silent_middle_axis_is_named(bench: Bench) -> None:
    rig = bench()
    rig.tap.line.inject(Fault("silent", servo_id=2, at_time_s=rig.clock.now()))
    with pytest.raises(DeviceTimeoutError, match=r"Axis pan \(id 2 on .* gives no answer"):
        rig.group.settled(list(NAMES))


def test_an_answer_under_another_axis_name_is_not_believed(bench: Bench) -> None:
    """The arm's answer, with a right checksum, says that it is the pan axis's; each time for a while."""
    rig = bench()
    first = rig.replies(1) + 1
    for k in range(3):
        rig.tap.line.inject(Fault("wrong_id", servo_id=1, at_reply=first + k))
    positions = {k: block.position for k, block in rig.bus.agreed_blocks([1, 2, 3]).items()}
    assert positions == {1: 1800, 2: 2000, 3: 2200}


@pytest.mark.parametrize("kind", ["corrupt", "truncate", "duplicate", "drop"])
@pytest.mark.parametrize("servo_id", [1, 2, 3])
def test_a_spoilt_answer_spoils_no_angle(bench: Bench, kind: str, servo_id: int) -> None:
    rig = bench()
    for k in STARTS:
        rig.turn(k, 2600)
    rig.tap.line.inject(Fault(kind, servo_id=servo_id, at_reply=rig.replies(servo_id) + 1, every=3))  # type: ignore[arg-type]
    for _ in range(6):
        for k, block in rig.bus.agreed_blocks([1, 2, 3]).items():
            line = rig.tap.line.servo(k)
            seen = [line.shaft_counts(t) for t in (block.sent_s, block.received_s)]
            assert min(seen) - 1 <= block.position <= max(seen) + 1


@pytest.mark.parametrize("delay_s", [0.3, 0.499, 0.51, 0.6, 0.751, 0.9, 1.4])
def test_a_late_middle_answer_is_never_a_later_ones(bench: Bench, delay_s: float) -> None:
    rig = bench()
    rig.turn(2, 2600)
    rig.tap.line.inject(Fault("delay", servo_id=2, at_reply=rig.replies(2) + 1, delay_s=delay_s))
    for _ in range(8):
        block = rig.bus.agreed_blocks([1, 2, 3])[2]
        seen = [rig.tap.line.servo(2).shaft_counts(t) for t in (block.sent_s, block.received_s)]
        assert min(seen) - 1.5 <= block.position <= max(seen) + 1.5


def test_a_refused_read_names_the_axis(bench: Bench) -> None:
    """The SDK's own sync read hides the error byte, and gives 0 for the value."""
    rig = bench()
    rig.tap.line.inject(Fault("error", servo_id=2, at_time_s=rig.clock.now(), number=7))
    with pytest.raises(DeviceError, match=r"Axis pan \(id 2 .* refused reading its state: access error"):
        rig.group.settled(list(NAMES))


def test_a_hardware_error_of_one_axis_is_raised(bench: Bench) -> None:
    rig = bench()
    rig.tap.line.inject(Fault("hardware", servo_id=3, at_time_s=rig.clock.now(), bits=0x20))
    rig.clock.sleep(0.1)
    with pytest.raises(HardwareStatusError, match=r"Axis tilt .* reports overload"):
        rig.group.settled(list(NAMES))
    with pytest.raises(HardwareStatusError, match=r"Axis tilt .* reports overload"):
        rig.group.read()
    with pytest.raises(HardwareStatusError, match=r"Axis tilt .* reports overload"):
        rig.group.move_to({"arm": 0.0, "tilt": 0.0})
    assert rig.bus.block(1).goal == 1800


def test_a_restarted_servo_is_noticed(bench: Bench) -> None:
    """Its clock begins anew: its states are of another time until two of them say the same."""
    rig = bench()
    rig.clock.sleep(5.0)
    rig.group.read()
    rig.tap.line.inject(Fault("reboot", servo_id=2, at_time_s=rig.clock.now()))
    rig.clock.sleep(0.1)
    assert rig.bus.blocks([1, 2, 3])[2].position == 2000
    with pytest.raises(DeviceError, match=r"Axis pan .* has lost its torque"):
        for _ in range(3):
            rig.turn(2, 2100)
            rig.group.settled(list(NAMES))
