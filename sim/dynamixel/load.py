"""What loads a servo: the weight of the joint, and the heat of the current that holds it. Closed forms, no ticks.

A joint is a mass on a lever about a horizontal axis; inertia and friction in its bearings are no part of this. Heat is
one time constant from the winding to the air.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

COUNTS_PER_TURN = 4096
_RADIANS = 2.0 * math.pi / COUNTS_PER_TURN


@dataclass(frozen=True)
class Load:
    """The weight of a joint.

    Attributes
    ----------
    torque_nm : float
        About the axis when the lever lies horizontally [N m].
    hanging_counts : float
        Where the lever hangs straight down [counts].
    """

    torque_nm: float = 0.0
    hanging_counts: float = 0.0

    def torque(self, position: float) -> float:
        """Torque of the weight [N m], positive towards higher counts."""
        return -self.torque_nm * math.sin((position - self.hanging_counts) * _RADIANS)

    def hanging(self, position: float) -> float:
        """The nearest place where the lever hangs straight down [counts]."""
        turns = round((position - self.hanging_counts) / COUNTS_PER_TURN)
        return self.hanging_counts + turns * COUNTS_PER_TURN

    def rest(self, goal: float, stiffness: float, strongest: float) -> float:
        """Where a proportional loop holds the lever that was sent to `goal` [counts].

        Parameters
        ----------
        goal : float
            [counts]
        stiffness : float
            Torque of the loop per count of deviation [N m]; infinite with an integral gain.
        strongest : float
            Largest torque that the loop may give [N m].

        Notes
        -----
        stiffness (goal - q) + torque(q) = 0, by fixed-point iteration; where the weight is stronger than the motor, the
        place between here and where it hangs at which the two are equal.
        """
        if self.torque_nm == 0.0:
            return goal
        if abs(self.torque(goal)) > strongest or stiffness <= self.torque_nm * _RADIANS:
            low = self.hanging(goal)
            held = math.asin(min(strongest / self.torque_nm, 1.0)) / _RADIANS
            return low + math.copysign(held, goal - low)
        if math.isinf(stiffness):
            return goal
        place = goal
        for _ in range(50):
            place = goal + self.torque(place) / stiffness
        return place


class Heat:
    """Temperature of the motor [C].

    Parameters
    ----------
    idle : float, optional
        In the air of the room, with the electronics on [C].
    per_square_ampere : float, optional
        Rise that one ampere causes in the end [K].
    time_constant : float, optional
        [s]
    """

    def __init__(self, idle: float = 31.0, per_square_ampere: float = 45.0, time_constant: float = 600.0) -> None:
        self._idle = idle
        self._gain = per_square_ampere
        self._tau = time_constant
        self._since, self._from, self._towards = 0.0, idle, idle

    def at(self, t: float) -> float:
        """Temperature at `t` [s]."""
        decay = math.exp(-max(t - self._since, 0.0) / self._tau)
        return self._towards + (self._from - self._towards) * decay

    def carry(self, t: float, current: float) -> None:
        """From `t` [s] on the motor carries `current` [A]."""
        if t >= self._since:
            self._from, self._since = self.at(t), t
            self._towards = self._idle + self._gain * current**2

    def reaches(self, limit: float) -> float:
        """When it goes beyond `limit` [C] if nothing changes [s]; infinite for never."""
        if self._from > limit:
            return self._since
        if self._towards <= limit:
            return math.inf
        return self._since - self._tau * math.log((self._towards - limit) / (self._towards - self._from))
