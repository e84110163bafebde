"""The servos of a rig as one: their goals go out in one sync write, their states come in by one sync read.

So the axes of a move start at the same instant, and a poll costs one exchange on the line, not one for each axis. What a
state means for an axis, the axis says itself (`drivers.dynamixel.servo`). A sync write is not acknowledged: each axis
compares the goal that its servo holds with the one that was sent, and sends it again by itself.

References: ROBOTIS e-manual, DYNAMIXEL Protocol 2.0, Sync Read and Sync Write (emanual.robotis.com/docs/en/dxl/protocol2).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

from drivers.dynamixel.bus import Bus
from drivers.dynamixel.registers import GOAL_POSITION, Block
from drivers.dynamixel.servo import Servo
from gonio.interfaces import AxisReading


class ServoGroup:
    """Axes on one line; satisfies `gonio.interfaces.AxisGroup`.

    Parameters
    ----------
    bus : Bus
    servos : mapping of str to Servo
        By the name of the axis, connected.
    """

    def __init__(self, bus: Bus, servos: Mapping[str, Servo]) -> None:
        self._bus = bus
        self._servos = dict(servos)

    def move_to(self, goals: Mapping[str, float]) -> None:
        """Start moving axes at the same instant, each to its angle [rad]; returns at once.

        Raises
        ------
        LimitError
            If one of the goals is outside its axis's limits; nothing was sent.
        """
        starting = [name for name in goals if self._servos[name].departs(goals[name])]
        if not starting:
            return
        blocks = self._blocks(starting)
        for name in starting:
            self._servos[name].arm(blocks[name])
        sent = {self._servos[name].id: self._servos[name].depart(goals[name], blocks[name]) for name in starting}
        self._bus.sync_write(GOAL_POSITION, sent)

    def settled(self, names: Collection[str]) -> dict[str, bool]:
        """Poll axes at once: True for each that stands at its goal by every sign it can give.

        Raises
        ------
        DeviceError
            Of the first axis that cannot get there.
        """
        blocks = self._blocks(names)
        return {name: self._servos[name].judge(block) for name, block in blocks.items()}

    def read(self) -> dict[str, AxisReading]:
        """Measure all axes now: two consecutive consistent states of each."""
        agreed = self._bus.agreed_blocks([servo.id for servo in self._servos.values()])
        return {name: servo.reading(agreed[servo.id]) for name, servo in self._servos.items()}

    def _blocks(self, names: Collection[str]) -> dict[str, Block]:
        blocks = self._bus.blocks([self._servos[name].id for name in names])
        return {name: blocks[self._servos[name].id] for name in names}
