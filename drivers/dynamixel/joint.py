"""A servo's joint: angles to counts and back, limits, and the legs of a move that ends from one side.

Pure arithmetic; it reads and sends nothing.

Angles [rad] and counts: ``counts = zero_counts + direction * angle * 4096 / (2 pi)``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from drivers.dynamixel.registers import COUNTS_PER_TURN
from gonio.errors import ConfigurationError, LimitError

COUNTS_PER_RAD = COUNTS_PER_TURN / (2.0 * math.pi)

_ANGLE_SLACK = 1e-9  # rad; an angle computed from the limit in degrees is not beyond it


@dataclass(frozen=True)
class Joint:
    """A joint.

    Attributes
    ----------
    name : str
        Of the axis, for messages.
    zero_counts : int
        Position at angle 0.
    direction : {1, -1}
        Sign of counts against angle.
    lower, upper : float
        Limits [rad]; within the servo's turn, counts 0 to 4095.
    approach : {"up", "down", "any"}
        Side of the final approach: with increasing angle, decreasing, or as it comes.
    overshoot : float
        How far before the goal the final approach begins [rad].
    tolerance_counts : int
        Friction lets a servo stop this far from its goal.

    Raises
    ------
    ConfigurationError
        If an attribute is outside its range.
    """

    name: str
    zero_counts: int
    direction: int
    lower: float
    upper: float
    approach: Literal["up", "down", "any"]
    overshoot: float
    tolerance_counts: int

    def __post_init__(self) -> None:
        def refuse(text: str) -> ConfigurationError:
            return ConfigurationError(f"Axis {self.name}: {text}.")

        if self.direction not in (1, -1):
            raise refuse(f"direction {self.direction} must be 1 or -1")
        if self.approach not in ("up", "down", "any"):
            raise refuse(f"approach {self.approach!r} must be up, down or any")
        if not self.lower < self.upper:
            raise refuse(
                f"lower limit {math.degrees(self.lower):g} deg is not below upper limit {math.degrees(self.upper):g} deg"
            )
        if self.low_counts < 0 or self.high_counts > COUNTS_PER_TURN - 1:
            raise refuse(
                f"limits {self.limits_text} are counts {self.low_counts} to {self.high_counts}, the servo has 0 to "
                f"{COUNTS_PER_TURN - 1}; narrow the limits or mount the horn so that zero_counts is near 2048"
            )
        if self.tolerance_counts < 0:
            raise refuse(f"tolerance_counts {self.tolerance_counts} must be 0 or more")
        if self.approach != "any" and not (
            self.overshoot >= math.radians(1.0) - _ANGLE_SLACK and self.overshoot_counts > self.tolerance_counts
        ):
            raise refuse(
                f"overshoot {math.degrees(self.overshoot):g} deg ({self.overshoot_counts} counts) must be at least 1 deg "
                f"and more than the tolerance of {self.tolerance_counts} counts, or the approach would not be one-sided"
            )

    # -- conversions

    def counts(self, angle: float) -> int:
        """Nearest position to an angle [rad]."""
        return self.zero_counts + self.direction * round(angle * COUNTS_PER_RAD)

    def angle(self, counts: int) -> float:
        """Angle of a position [rad]."""
        return self.direction * (counts - self.zero_counts) / COUNTS_PER_RAD

    def degrees(self, counts: int) -> float:
        """Angle of a position [deg], for messages."""
        return math.degrees(self.angle(counts))

    # -- limits

    @property
    def low_counts(self) -> int:
        """Smaller of the limits' positions."""
        return min(self.counts(self.lower), self.counts(self.upper))

    @property
    def high_counts(self) -> int:
        """Larger of the limits' positions."""
        return max(self.counts(self.lower), self.counts(self.upper))

    @property
    def limits_text(self) -> str:
        """The limits, for messages."""
        return f"{math.degrees(self.lower):g} to {math.degrees(self.upper):g} deg"

    def clip(self, counts: int) -> int:
        """Nearest position within the limits."""
        return min(max(counts, self.low_counts), self.high_counts)

    def goal(self, angle: float) -> int:
        """Position to command for an angle [rad]; `LimitError` outside the limits."""
        if not self.lower - _ANGLE_SLACK <= angle <= self.upper + _ANGLE_SLACK:
            raise LimitError(
                f"Axis {self.name} was asked for {math.degrees(angle):.3f} deg, its limits are {self.limits_text}; "
                "nothing was sent: change the plan or the limits in rig.toml."
            )
        return self.counts(angle)

    # -- approach

    @property
    def overshoot_counts(self) -> int:
        """How far before the goal the final approach begins."""
        return round(self.overshoot * COUNTS_PER_RAD)

    def legs(self, present: int, goal: int, *, engaged: bool) -> tuple[list[int], bool]:
        """Goals of a move, and whether it ends from the approach side.

        Parameters
        ----------
        present, goal : int
            Where the axis stands and where it shall stand [counts].
        engaged : bool
            The last move ended from the approach side, so the play of the gears is taken up already.

        Returns
        -------
        list of int
            One goal, or two if the direct way comes from the wrong side or is too short to take up the play.
        bool
            False if a limit is so near that there is no room to come from one side.
        """
        if self.approach == "any":
            return [goal], True
        side = self.direction if self.approach == "up" else -self.direction  # sign of the final approach [counts]
        travel = side * (goal - present)
        if travel >= self.overshoot_counts or (travel >= 0 and engaged):
            return [goal], True
        before = self.clip(goal - side * self.overshoot_counts)
        one_sided = side * (goal - before) > self.tolerance_counts
        return ([before, goal] if before != goal else [goal]), one_sided
