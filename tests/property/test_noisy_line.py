"""A bad line: damaged, lost, late, repeated and foreign packets. No wrong angle is ever believed.

What stands between the driver and the simulated servos is a wire that damages bytes, both ways, as cables, connectors and
adapters do. The servos turn all the time, so that an old angle is a wrong one. The truth is the shaft of the simulator.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest

from drivers.dynamixel import Bus
from drivers.dynamixel import registers as reg
from drivers.dynamixel.registers import Block
from gonio.errors import DeviceError
from sim import port
from sim.clock import VirtualClock
from sim.dynamixel.bus import DynamixelBus, Reply
from sim.dynamixel.servo import Servo as SimServo
from tests.gates import record

SEED = 5
TIMEOUT_S = 0.03  # the rig's clock is virtual: no computer is busy
SLACK_COUNTS = 1.5  # rounding of the encoder, and what the shaft turns in the 3 ms that a servo's clock tells apart
Rng = np.random.Generator
Reading = tuple[int, int, float, float]  # servo id, position [counts], rig time before and after [s]


# --- damage --------------------------------------------------------------------------------------------------------------


def flipped(data: bytes, rng: Rng) -> bytes:
    """One to eight wrong bits."""
    bits = rng.choice(8 * len(data), min(8 * len(data), int(rng.integers(1, 9))), replace=False)
    out = bytearray(data)
    for bit in bits:
        out[bit // 8] ^= 1 << (bit % 8)
    return bytes(out)


def burst(data: bytes, rng: Rng) -> bytes:
    """Two to eight bytes in a row are noise."""
    start, length = int(rng.integers(len(data))), int(rng.integers(2, 9))
    noise = rng.bytes(len(data[start : start + length]))
    return data[:start] + noise + data[start + length :]


def dropped(data: bytes, rng: Rng) -> bytes:
    """One to four bytes are lost, or all of them."""
    if rng.random() < 0.1:
        return b""
    start, length = int(rng.integers(len(data))), int(rng.integers(1, 5))
    return data[:start] + data[start + length :]


def doubled(data: bytes, rng: Rng) -> bytes:
    """Some bytes come twice."""
    start, length = int(rng.integers(len(data))), int(rng.integers(1, 5))
    return data[: start + length] + data[start:]


def inserted(data: bytes, rng: Rng) -> bytes:
    """One to four bytes of noise in between."""
    start = int(rng.integers(len(data) + 1))
    return data[:start] + rng.bytes(int(rng.integers(1, 5))) + data[start:]


DAMAGE: dict[str, Callable[[bytes, Rng], bytes]] = {
    f.__name__: f for f in (flipped, burst, dropped, doubled, inserted)
}


@dataclass
class Wire:
    """A device for `sim.port`: the servos behind a bad line.

    Attributes
    ----------
    line : DynamixelBus
    rng : Generator
    damage : float
        Share of the packets, both ways, that are damaged.
    stray : float
        Share of the answers that come late, come twice, or are preceded by one that belongs to an earlier question.
    """

    line: DynamixelBus
    rng: Rng
    damage: float = 0.0
    stray: float = 0.0
    seen: Counter[str] = field(default_factory=Counter)
    _earlier: list[bytes] = field(default_factory=list)

    def feed(self, data: bytes, now: float) -> list[Reply]:
        replies = self.line.feed(self._through(data), now)
        if not replies:
            self.line.idle()  # an unfinished packet is forgotten in the silence that follows
        carried: list[Reply] = []
        for delay, answer in replies:
            carried += self._strayed(delay, self._through(answer))
            self._earlier = [*self._earlier[-20:], answer]
        return [(delay, answer) for delay, answer in carried if answer]

    def idle(self) -> None:
        self.line.idle()

    def _through(self, data: bytes) -> bytes:
        if self.rng.random() >= self.damage:
            return data
        name = str(self.rng.choice(list(DAMAGE)))
        damaged = DAMAGE[name](data, self.rng)
        self.seen[name] += damaged != data
        return damaged

    def _strayed(self, delay: float, answer: bytes) -> list[Reply]:
        if self.rng.random() >= self.stray:
            return [(delay, answer)]
        kind = str(self.rng.choice(["late", "twice", "foreign", "before"]))
        self.seen[kind] += 1
        if kind == "late":
            return [(float(self.rng.uniform(0.8, 3.0)) * TIMEOUT_S, answer)]
        if kind == "twice":
            return [(delay, answer), (delay + float(self.rng.choice([0.0, 0.6, 1.4])) * TIMEOUT_S, answer)]
        other = self._earlier[int(self.rng.integers(len(self._earlier)))] if self._earlier else answer
        return [(delay, other), (delay, answer)] if kind == "foreign" else [(delay, other)]


# --- the experiment ------------------------------------------------------------------------------------------------------


@dataclass
class Outcome:
    """How many angles were read, how many of them wrong, and how many readings failed."""

    angles: int = 0
    wrong: int = 0
    failed: int = 0
    faults: Counter[str] = field(default_factory=Counter)

    @property
    def hit(self) -> int:
        return sum(self.faults.values())

    @property
    def recovered(self) -> float:
        """Share of the faults that did not end in an error."""
        return 1.0 - self.failed / max(1, self.hit)


Reader = Callable[[Bus, Rng], list[Reading]]
SERVOS = (1, 2, 3)


def reading(servo_id: int, block: Block) -> Reading:
    return servo_id, block.position, block.sent_s, block.received_s


def believed(bus: Bus, rng: Rng) -> list[Reading]:
    """Angles as the driver reads them: of one axis, or of all by sync reads."""
    if rng.random() < 0.5:
        k = int(rng.choice(SERVOS))
        return [reading(k, bus.agreed_block(k))]
    order = [int(k) for k in rng.permutation(SERVOS)]
    return [reading(k, block) for k, block in bus.agreed_blocks(order).items()]


def run(faults: int, *, damage: float = 0.0, stray: float = 0.0, reader: Reader = believed) -> Outcome:
    """Read angles of three turning servos until so many faults have struck."""
    clock, rng = VirtualClock(), np.random.default_rng(SEED)
    servos = {k: SimServo(k, initial_counts=1000.0 * k) for k in SERVOS}
    wire = Wire(DynamixelBus(list(servos.values())), rng)
    url = port.attach("noisy", wire, clock)
    with Bus(url, clock=clock, now=clock.now, timeout_s=TIMEOUT_S, drain_s=0.5 * TIMEOUT_S, attempts=5) as bus:
        for k in servos:
            bus.write(k, reg.PROFILE_VELOCITY, 20)
            bus.write(k, reg.TORQUE_ENABLE, 1)
        wire.damage, wire.stray = damage, stray
        outcome = Outcome(faults=wire.seen)
        due_s = 0.0
        while outcome.hit < faults:
            if clock.now() >= due_s:  # the simulator's own hand, so that the turning does not depend on the wire
                for servo in servos.values():
                    goal = int(rng.integers(200, 3900)).to_bytes(4, "little")
                    servo.write(reg.GOAL_POSITION.address, goal, clock.now())
                due_s = clock.now() + 2.0
            try:
                readings = reader(bus, rng)
            except DeviceError:
                outcome.failed += 1
                continue
            outcome.angles += len(readings)
            for k, position, sent_s, received_s in readings:
                shaft = [servos[k].shaft_counts(t) for t in np.linspace(sent_s, received_s, 5)]
                outcome.wrong += not min(shaft) - SLACK_COUNTS <= position <= max(shaft) + SLACK_COUNTS
    port.detach("noisy")
    return outcome


LANES = {"damaged": {"damage": 0.15}, "late, repeated or foreign": {"stray": 0.2}}


@pytest.mark.parametrize("lane", LANES)
def test_no_wrong_angle(lane: str) -> None:
    outcome = run(1500, **LANES[lane])
    assert outcome.angles > 1000
    assert outcome.wrong == 0
    assert outcome.recovered >= 0.99


def test_the_experiment_can_find_wrong_angles() -> None:
    """A reader that believes a single register is deceived on the same wire."""

    def credulous(bus: Bus, rng: Rng) -> list[Reading]:
        k, sent_s = int(rng.choice(SERVOS)), bus.clock.now()
        return [(k, bus.read(k, reg.PRESENT_POSITION), sent_s, bus.clock.now())]

    assert run(1000, **LANES["late, repeated or foreign"], reader=credulous).wrong > 50


@pytest.mark.gate
@pytest.mark.parametrize(("lane", "faults"), [("damaged", 1_000_000), ("late, repeated or foreign", 100_000)])
def test_no_wrong_angle_in_many(lane: str, faults: int) -> None:
    outcome = run(faults, **LANES[lane])
    kinds = ", ".join(f"{name} {count}" for name, count in sorted(outcome.faults.items()))
    record(
        f"angles over a bad line, {lane}",
        f"{outcome.wrong} wrong of {outcome.angles} accepted; {outcome.hit} faults ({kinds}), "
        f"{100 * outcome.recovered:.3f} % without an error",
        "0 wrong, >= 99 % recovered",
        str(SEED),
        "pytest -m gate tests/property/test_noisy_line.py",
    )
    assert outcome.wrong == 0
    assert outcome.recovered >= 0.99
