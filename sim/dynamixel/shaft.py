"""The mechanics behind the registers: a shaft that friction stops, and a link that it drives with play.

The shaft follows its profile and comes to rest a little short of the goal, as a proportional loop with friction does.
How short depends on the seed, the goal and the two goals before, as a shaft that comes along another way sticks elsewhere;
so a resumed scan soon meets the angles that it would have met. A goal nearer than the friction does not move the shaft.
The link moves only when the shaft reaches a flank of the play between them, so after a small reversal it has not moved.

No ringing, no load, no elasticity, and no gravity: a shaft without torque stays.
"""

from __future__ import annotations

import hashlib
import math

from sim.dynamixel import motion
from sim.dynamixel.motion import ACCELERATION_UNIT, COUNTS_PER_TURN, Motion

ACCELERATION = 4_000.0 * ACCELERATION_UNIT  # what the bare motor can do without a profile [counts/s^2]


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
        self._motion = motion.rest(0.0, position)
        self._link = position  # where the link was when the motion began

    def at(self, t: float) -> tuple[float, float]:
        """Position [counts] and speed [counts/s] at `t` [s]."""
        return self._motion.at(t)

    def done(self, t: float) -> bool:
        """Whether it is at rest."""
        return self._motion.done(t)

    def link(self, t: float) -> float:
        """Where the link is at `t` [counts]."""
        link = self._link
        # Between turning points the shaft moves one way, so its last position says what it dragged along.
        for moment in (*(turn for turn in self._motion.turning_times() if turn < t), t):
            position = self._motion.at(moment)[0]
            link = min(max(link, position - self._half_play), position + self._half_play)
        return link

    def hold(self, t: float) -> None:
        """Stand still here, at once."""
        self._begin(t, motion.rest(t, self._motion.at(t)[0]))

    def seize(self, t: float) -> None:
        """Never move again."""
        self.hold(t)
        self.stuck = True

    def go(self, t: float, goal: int, speed: float, acceleration: float) -> None:
        """Move towards `goal` [counts] with a profile whose values may be infinite [counts/s, counts/s^2].

        With neither, the bare motor sets the pace; with a speed alone, the shaft follows the rectangle.
        """
        if self.stuck:
            return
        position, velocity = self._motion.at(t)
        if math.isinf(speed) or not math.isinf(acceleration):
            acceleration = min(acceleration, ACCELERATION)
        stop = motion.stopping_point(position, velocity, acceleration)
        self._goals = (*self._goals[-2:], goal)
        short = self._short()
        target = stop if abs(goal - stop) <= short else goal - math.copysign(short, goal - stop)
        self._begin(t, motion.plan(t, position, velocity, target, min(speed, self._fastest), acceleration))

    def _short(self) -> float:
        """Distance from the goal at which friction stops the shaft [counts]."""
        key = ":".join([self._seed, *(str(goal % COUNTS_PER_TURN) for goal in self._goals)]).encode()
        fraction = int.from_bytes(hashlib.blake2b(key, digest_size=8).digest(), "big") / 2.0**64
        low, high = self._friction
        return low + fraction * (high - low)

    def _begin(self, t: float, new: Motion) -> None:
        self._link = self.link(t)
        self._motion = new
