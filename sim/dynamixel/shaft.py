"""The mechanics behind the registers: a shaft that friction stops, and a link that it drives with play.

The shaft follows its profile and comes to rest a little short of the goal, as a proportional loop with friction does.
How short depends on the seed, the goal and the two goals before, as a shaft that comes along another way sticks elsewhere;
so a resumed scan soon meets the angles that it would have met. A goal nearer than the friction does not move the shaft.
The link moves only when the shaft reaches a flank of the play between them, so after a small reversal it has not moved.
An obstacle keeps the shaft on one side of it. Moves that are over are remembered for a while: a camera's old frame shows
where things were.

No ringing and no elasticity; weight and heat are in `sim.dynamixel.load`.
"""

from __future__ import annotations

import hashlib
import math
from collections import deque
from dataclasses import dataclass

from sim.dynamixel import motion
from sim.dynamixel.motion import ACCELERATION_UNIT, COUNTS_PER_TURN, Motion

ACCELERATION = 4_000.0 * ACCELERATION_UNIT  # what the bare motor can do without a profile [counts/s^2]
_REMEMBERED = 64  # moves


@dataclass(frozen=True)
class _Move:
    """A motion from `start` [s] on, the link's place then, and what keeps the shaft within [counts]."""

    start: float
    motion: Motion
    link: float
    lowest: float
    highest: float

    def at(self, t: float) -> tuple[float, float]:
        position, velocity = self.motion.at(t)
        if self.lowest <= position <= self.highest:
            return position, velocity
        return min(max(position, self.lowest), self.highest), 0.0


class Shaft:
    """A shaft with its link.

    Parameters
    ----------
    position : float
        At time 0 [counts].
    fastest : float
        Largest speed [counts/s].
    backlash : float
        Play between shaft and link, from flank to flank [counts].
    friction : tuple of float
        Smallest and largest distance from the goal at which the shaft stops [counts].
    seed : str
        Of the friction.

    Attributes
    ----------
    stuck : bool
        It does not move any more.
    """

    def __init__(
        self, position: float, *, fastest: float, backlash: float, friction: tuple[float, float], seed: str
    ) -> None:
        self.stuck = False
        self._fastest = fastest
        self._half_play = 0.5 * backlash
        self._friction = friction
        self._seed = seed
        self._goals: tuple[int, ...] = ()  # the latest three
        self._within = (-math.inf, math.inf)
        self._moves = deque([_Move(-math.inf, motion.rest(0.0, position), position, *self._within)], _REMEMBERED)

    def at(self, t: float) -> tuple[float, float]:
        """Position [counts] and speed [counts/s] at `t` [s]."""
        return self._move(t).at(t)

    def done(self, t: float) -> bool:
        """Whether it is at rest."""
        move = self._move(t)
        return (move.motion.done(t) and move.motion.final_velocity == 0.0) or self.blocked(t)

    def blocked(self, t: float) -> bool:
        """Whether an obstacle keeps it from where it was sent."""
        move = self._move(t)
        return not move.lowest <= move.motion.at(t)[0] <= move.highest

    def blocked_since(self) -> float:
        """When the present move runs into an obstacle [s]; infinite for never."""
        move = self._moves[-1]
        early, late = max(move.start, move.motion.start), move.motion.end
        if move.motion.final_velocity != 0.0:
            late += 1e6
        if not self.blocked(late):
            return math.inf
        while late - early > 1e-6 and not self.blocked(early):
            middle = 0.5 * (early + late)
            early, late = (early, middle) if self.blocked(middle) else (middle, late)
        return late

    def ends(self) -> float:
        """When the present move comes to rest [s]; infinite for never."""
        last = self._moves[-1].motion
        return math.inf if last.final_velocity != 0.0 else max(last.end, self._moves[-1].start)

    def link(self, t: float) -> float:
        """Where the link is at `t` [counts]."""
        move = self._move(t)
        link = move.link
        # Between turning points the shaft moves one way, so its last position says what it dragged along.
        for moment in (*(turn for turn in move.motion.turning_times() if move.start < turn < t), t):
            position = move.at(moment)[0]
            link = min(max(link, position - self._half_play), position + self._half_play)
        return link

    def hold(self, t: float) -> None:
        """Stand still here, at once."""
        self._begin(t, motion.rest(t, self.at(t)[0]))

    def seize(self, t: float) -> None:
        """Never move again."""
        self.hold(t)
        self.stuck = True

    def obstruct(self, t: float, ahead: float) -> None:
        """Put an obstacle `ahead` [counts] of where it is; negative for the side of lower counts."""
        place = self.at(t)[0] + ahead
        low, high = self._within
        self._within = (low, place) if ahead > 0.0 else (place, high)
        self._begin(t, self._moves[-1].motion)

    def go(self, t: float, goal: int, speed: float, acceleration: float, *, rest: float | None = None) -> None:
        """Move towards `goal` [counts] with a profile whose values may be infinite [counts/s, counts/s^2].

        With neither, the bare motor sets the pace; with a speed alone, the shaft follows the rectangle. `rest` is where
        the load lets it come, if not to the goal.
        """
        if self.stuck:
            return
        position, velocity = self.at(t)
        if math.isinf(speed) or not math.isinf(acceleration):
            acceleration = min(acceleration, ACCELERATION)
        stop = motion.stopping_point(position, velocity, acceleration)
        self._goals = (*self._goals[-2:], goal)
        short = self._short()
        wanted = float(goal) if rest is None else rest
        target = stop if abs(wanted - stop) <= short else wanted - math.copysign(short, wanted - stop)
        self._begin(t, motion.plan(t, position, velocity, target, min(speed, self._fastest), acceleration))

    def spin(self, t: float, wanted: float, acceleration: float) -> None:
        """Take up the speed `wanted` [counts/s], and keep it."""
        if not self.stuck:
            wanted = min(max(wanted, -self._fastest), self._fastest)
            self._begin(t, motion.spin(t, *self.at(t), wanted, min(acceleration, ACCELERATION)))

    def fall(self, t: float, place: float) -> None:
        """Move to `place` [counts] without a motor."""
        if not self.stuck:
            self._begin(t, motion.plan(t, *self.at(t), place, self._fastest, 0.2 * ACCELERATION))

    def _short(self) -> float:
        """Distance from the goal at which friction stops the shaft [counts]."""
        key = ":".join([self._seed, *(str(goal % COUNTS_PER_TURN) for goal in self._goals)]).encode()
        fraction = int.from_bytes(hashlib.blake2b(key, digest_size=8).digest(), "big") / 2.0**64
        low, high = self._friction
        return low + fraction * (high - low)

    def _move(self, t: float) -> _Move:
        """The move that was under way at `t`."""
        for move in reversed(self._moves):
            if move.start <= t:
                return move
        return self._moves[0]

    def _begin(self, t: float, new: Motion) -> None:
        self._moves.append(_Move(t, new, self.link(t), *self._within))
