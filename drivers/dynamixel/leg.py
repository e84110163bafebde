"""One leg of a move, as its readings tell it: under way, at rest at its goal, stuck, or with too much current.

Pure bookkeeping over state blocks; it reads and sends nothing and knows no angle.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

from drivers.dynamixel.registers import Block

_PROGRESS_COUNTS = 2
_STALL_POLLS = 3  # a busy computer that polls late has seen no stall
_STRAIN_S = 0.2  # the current of a start is over by then


class Outcome(enum.Enum):
    """What the last reading means."""

    UNDER_WAY = enum.auto()
    AT_REST = enum.auto()
    STALLED = enum.auto()
    STRAINED = enum.auto()


@dataclass
class Leg:
    """A leg.

    Parameters
    ----------
    goal : int
        Where it ends [counts].
    tolerance : int
        Distance from the goal that counts as there [counts].
    settle_s, stall_s : float
        Two equal readings so far apart are rest; so long without progress is a stall [s, rig time].
    start_s : float
        Rig time now [s].
    current_limit : int or None
        More current than this, on and on, is too much [the model's unit].
    """

    goal: int
    tolerance: int
    settle_s: float
    stall_s: float
    start_s: float
    current_limit: int | None = None

    def __post_init__(self) -> None:
        self._rest: Block | None = None  # first of the equal readings
        self._reached = False
        self._best = math.inf  # smallest distance so far [counts]
        self._best_s = self.start_s
        self._polls = 0
        self._strained: Block | None = None  # first of the readings with too much current
        self._strained_polls = 0

    def still(self, block: Block) -> bool:
        """Within the tolerance, the shaft stands, no profile runs. One reading alone proves no rest."""
        # The in-position bit is not asked: the manual does not say how near that is.
        return not block.in_motion and abs(block.position - self.goal) <= self.tolerance

    def see(self, block: Block) -> Outcome:
        """Take one reading."""
        if self._strains(block):
            return Outcome.STRAINED
        still = self.still(block)
        if not still or self._rest is None or block.position != self._rest.position:
            self._rest = block if still else None
        elif block.sent_s - self._rest.received_s >= self.settle_s:
            return Outcome.AT_REST
        distance = abs(block.position - self.goal)
        if distance <= self._best - _PROGRESS_COUNTS or (still and not self._reached):
            self._best, self._best_s, self._polls = distance, block.received_s, 0
        self._reached = self._reached or still
        self._polls += 1
        if self._polls > _STALL_POLLS and block.received_s - self._best_s > self.stall_s:
            return Outcome.STALLED
        return Outcome.UNDER_WAY

    def _strains(self, block: Block) -> bool:
        if self.current_limit is None or abs(block.current) <= self.current_limit:
            self._strained, self._strained_polls = None, 0
            return False
        self._strained = self._strained or block
        self._strained_polls += 1
        return self._strained_polls > _STALL_POLLS and block.sent_s - self._strained.received_s >= _STRAIN_S
