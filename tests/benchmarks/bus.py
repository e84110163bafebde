"""The servos' line: goals of three axes out and their states in, against the time that the bytes alone take on the wire.

The far end is the simulator in a process of its own, on a pseudo-terminal, with paced bytes. What lies above the wire time
is the driver's, the operating system's and the simulator's. Both processes ask for real-time priority, so that what else
the machine does counts little; the table says whether they got it. A process of the lowest priority on each processor keeps
it from falling asleep between two bytes: virtual machines take 0.05 to 0.1 ms to wake one, several times in a cycle.
"""

from __future__ import annotations

import contextlib
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from drivers.dynamixel import Bus
from drivers.dynamixel import registers as reg
from gonio.errors import DeviceTimeoutError
from gonio.rig import WallClock

BAUDS, RETURN_DELAYS, IDS = (57_600, 1_000_000, 4_000_000), (0, 250), (1, 2, 3)
CYCLES, SHORT, WAITS = 200, 40, 3
ABSENT = 99
LIMIT_MS, LIMIT_RATIO, LIMIT_WAITING = 0.5, 1.25, 0.05
_SYNC_WRITE_BYTES, _SYNC_READ_BYTES, _STATUS_BYTES = 14 + 5 * len(IDS), 14 + len(IDS), 11 + reg.BLOCK_SIZE


@dataclass(frozen=True)
class Cycle:
    """Of one line rate and return delay.

    Attributes
    ----------
    baud : int
        [bit/s]
    return_delay : int
        Register 9 [2 us].
    wire_s : float
        Of the bytes, 10 bits each, and the return delays [s].
    together_s, apart_s : float
        Medians: one sync write and one sync read; a write and a read of each axis [s].
    busy : float
        Processor time of this process per wall time, during the cycles.
    waiting : float
        The same while it waits for a servo that is not there.
    """

    baud: int
    return_delay: int
    wire_s: float
    together_s: float
    apart_s: float
    busy: float
    waiting: float


@dataclass(frozen=True)
class Line:
    """All figures, and whether they were taken at real-time priority."""

    cycles: list[Cycle]
    hurried: bool


def measure(*, quick: bool) -> Line:
    """All figures."""
    with _awake(), _in_a_hurry() as hurried:
        cycles = [cycle for baud in BAUDS for cycle in _at(baud, SHORT if quick else CYCLES)]
    return Line(cycles, hurried)


@contextlib.contextmanager
def _awake() -> Iterator[None]:
    """Work of the lowest priority for every processor."""
    idle = f"import os\nos.nice(19)\nwhile os.getppid() == {os.getpid()}: pass"
    workers = [subprocess.Popen([sys.executable, "-c", idle]) for _ in range(os.cpu_count() or 1)]
    try:
        yield
    finally:
        for worker in workers:
            worker.kill()
            worker.wait()


@contextlib.contextmanager
def _in_a_hurry() -> Iterator[bool]:
    """Real-time priority for this process and those that it starts, where it may have it."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
    except (AttributeError, PermissionError):
        yield False
        return
    try:
        yield True
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def _at(baud: int, count: int) -> Iterator[Cycle]:
    command = [sys.executable, "-m", "sim.serve", "--pace", "--speed", "1", "--parent"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        port = json.loads(process.stdout.readline().removeprefix("ready "))["bus"]
        with Bus(port, clock=WallClock()) as bus:
            for servo_id in IDS:
                bus.write(servo_id, reg.BAUD_RATE, reg.BAUD_CODES[baud])
        with Bus(port, clock=WallClock(), baud=baud, attempts=1) as bus:
            for delay in RETURN_DELAYS:
                for servo_id in IDS:
                    bus.write(servo_id, reg.TORQUE_ENABLE, 0)
                    bus.write(servo_id, reg.RETURN_DELAY_TIME, delay)
                    bus.write(servo_id, reg.TORQUE_ENABLE, 1)
                yield _cycle(bus, baud, delay, count)
        assert process.stdin is not None
        process.stdin.close()


def _cycle(bus: Bus, baud: int, delay: int, count: int) -> Cycle:
    places = {servo_id: block.position for servo_id, block in bus.blocks(IDS).items()}

    def together(step: int) -> None:
        bus.sync_write(reg.GOAL_POSITION, {k: place + step for k, place in places.items()})
        bus.blocks(IDS)

    def apart(step: int) -> None:
        for k, place in places.items():
            bus.write(k, reg.GOAL_POSITION, place + step)
        for k in places:
            bus.block(k)

    apart_s, _ = _timed(apart, count)
    together_s, busy = _timed(together, count)
    wire_s = 10.0 / baud * (_SYNC_WRITE_BYTES + _SYNC_READ_BYTES + len(IDS) * _STATUS_BYTES) + len(IDS) * 2e-6 * delay
    return Cycle(baud, delay, wire_s, together_s, apart_s, busy, _waiting(bus))


def _timed(cycle: Callable[[int], None], count: int) -> tuple[float, float]:
    """Median duration of a cycle [s], and the share of the processor."""
    durations = []
    busy, began = time.process_time(), time.perf_counter()
    for k in range(count):
        start = time.perf_counter()
        cycle(k % 2)
        durations.append(time.perf_counter() - start)
    share = (time.process_time() - busy) / (time.perf_counter() - began)
    return statistics.median(durations), share


def _waiting(bus: Bus) -> float:
    busy, began = time.process_time(), time.perf_counter()
    for _ in range(WAITS):
        with contextlib.suppress(DeviceTimeoutError):
            bus.ping(ABSENT)
    return (time.process_time() - busy) / (time.perf_counter() - began)


def report(found: Line) -> str:
    """As a table."""
    rows = []
    for c in found.cycles:
        over_ms, ratio = 1e3 * (c.together_s - c.wire_s), c.together_s / c.wire_s
        slow = c.baud == BAUDS[0]
        ok = over_ms <= LIMIT_MS and c.waiting < LIMIT_WAITING and (not slow or ratio <= LIMIT_RATIO)
        times = (c.wire_s, c.together_s, c.together_s - c.wire_s)
        rows.append(
            f"| {c.baud} | {2 * c.return_delay} us | {' | '.join(f'{1e3 * t:.3f}' for t in times)} | {ratio:.3f} "
            f"| {1e3 * c.apart_s:.3f} | {100 * c.busy:.0f} % | {100 * c.waiting:.1f} % | {'pass' if ok else 'MISS'} |\n"
        )
    priority = "at real-time priority" if found.hurried else "at ordinary priority, so what else the machine did counts"
    return (
        f"Goals of three axes out by a sync write, their states in by a sync read: the median of {CYCLES} cycles against "
        f"the bytes' own time. Limits: {LIMIT_MS:g} ms above it; at {BAUDS[0]} bit/s a ratio of {LIMIT_RATIO:g}; "
        f"{100 * LIMIT_WAITING:g} % of a processor while waiting for an answer. Taken {priority}, processors kept awake.\n\n"
        "| rate [bit/s] | return delay | wire [ms] | cycle [ms] | above [ms] | ratio | axis by axis [ms] | processor "
        "| waiting |  |\n"
        f"|{' --- |' * 10}\n" + "".join(rows)
    )
