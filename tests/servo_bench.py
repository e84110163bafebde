"""One simulated servo on a virtual clock and the driver that drives it through the vendor's SDK; for unit tests."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from drivers.dynamixel import Bus, Servo
from sim import port
from sim.clock import VirtualClock
from sim.dynamixel.bus import DynamixelBus
from sim.dynamixel.faults import Fault
from sim.dynamixel.servo import Servo as SimServo

DEG = math.pi / 180.0
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
