"""The simulated rig: a scan's motion on the virtual clock, through the drivers and the bus, and a frame of 640 x 480.

Processor times, so that what else the machine does counts little.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from gonio.config import default_documents, parse_rig
from gonio.rig import open_rig
from sim.simulation import Simulation

POSES, SHORT = 2000, 100
SCAN_LIMIT_S, FRAME_LIMIT_MS = 20.0, 15.0


@dataclass(frozen=True)
class Rig:
    """Figures of the section.

    Attributes
    ----------
    poses : int
    scan_s : float
        Processor time of the scan [s].
    virtual_s : float
        Rig time of the scan [s].
    first_ms, again_ms : float
        Processor time of a frame after a move, and of one more of the same pose [ms]; best of several.
    """

    poses: int
    scan_s: float
    virtual_s: float
    first_ms: float
    again_ms: float


def measure(*, quick: bool) -> Rig:
    """All figures."""
    poses = SHORT if quick else POSES
    scan_s, virtual_s = _scan(poses)
    return Rig(poses, scan_s, virtual_s, *_frame())


def _scan(poses: int) -> tuple[float, float]:
    """(processor, rig) time in which three axes settle at the poses of a snake of 20 x 20 x 5, polled every 20 ms [s]."""
    text = default_documents()["rig.toml"].replace("process = true", "process = false")
    arm, pan, tilt = (np.linspace(-0.9, 0.9, n) for n in (20, 20, 5))
    snake = [(a, b if i % 2 == 0 else -b, c) for c in tilt for i, a in enumerate(arm) for b in pan]
    with open_rig(parse_rig(text)) as rig:
        low, high = (np.array([getattr(axis.limits, end) for axis in rig.axes.values()]) for end in ("lower", "upper"))
        began, start = time.process_time(), rig.clock.now()
        for place in snake[:poses]:
            angles = 0.5 * (low + high) + 0.5 * (high - low) * place
            rig.group.move_to(dict(zip(rig.axes, angles.tolist(), strict=True)))
            waiting = list(rig.axes)
            while waiting:
                rig.clock.sleep(0.02)
                waiting = [name for name, settled in rig.group.settled(waiting).items() if not settled]
        return time.process_time() - began, rig.clock.now() - start


def _frame() -> tuple[float, float]:
    """Processor time of a frame of 640 x 480 of the default sample after a move, and of the next one [ms]."""
    simulation = Simulation({"sim": {"truth": {"width": 640, "height": 480, "pixel_mm": 0.0625}}})
    simulation.lamp.feed(b"OUTP ON\n", 0.0)
    simulation.warm_up()
    arm = simulation.servos["arm"]
    arm.write(64, b"\x01", 0.0)
    first, again = [], []
    for k in range(30):
        arm.write(116, (2100 + 10 * k).to_bytes(4, "little"), simulation.clock.now())
        simulation.clock.sleep(1.0)
        for times, label in ((first, f"{k} a"), (again, f"{k} b")):
            began = time.process_time()
            simulation.camera.capture(0.016, label=label)
            times.append(time.process_time() - began)
    return 1e3 * min(first), 1e3 * min(again)


def report(found: Rig) -> str:
    """As a table."""
    rows = [
        (
            f"{found.poses} poses of a snake over three axes, {found.virtual_s:.0f} s of rig time, no frames",
            f"< {SCAN_LIMIT_S * found.poses / POSES:.3g} s",
            f"{found.scan_s:.1f} s",
            found.scan_s < SCAN_LIMIT_S * found.poses / POSES,
        ),
        ("a frame of 640 x 480 after a move", f"<= {FRAME_LIMIT_MS:g} ms", f"{found.first_ms:.1f} ms",
         found.first_ms <= FRAME_LIMIT_MS),
        ("one more frame of the same pose", f"<= {FRAME_LIMIT_MS:g} ms", f"{found.again_ms:.1f} ms",
         found.again_ms <= FRAME_LIMIT_MS),
    ]  # fmt: skip
    head = "| simulated rig | limit | processor time |  |\n| --- | --- | --- | --- |\n"
    return head + "".join(f"| {what} | {limit} | {got} | {'pass' if ok else 'MISS'} |\n" for what, limit, got, ok in rows)
