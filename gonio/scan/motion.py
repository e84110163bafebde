"""Moving all axes of a rig at once, and knowing where they are: before, during and after the exposures.

Angles are always the measured ones. It polls, and between two polls it listens whether to stop.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from gonio.config import RigConfig
from gonio.errors import DeviceTimeoutError, MeasurementError
from gonio.interfaces import AxisGroup, AxisReading, Clock
from gonio.scan import zones
from gonio.scan.plan import AXES, move_seconds

ATTEMPTS = 3
"""How often a pose is exposed before an axis that does not stay still is an error."""
_POLL_S = 0.02
_SLICE_S = 0.1
_PATIENCE = 3.0
_GRACE_S = 10.0
_LEAST_POLLS = 250  # a busy computer that asks rarely, on a clock that is faster than the wall's, has seen no failure


class Motion:
    """The axes of a rig.

    Parameters
    ----------
    axes : AxisGroup
    clock : Clock
    config : RigConfig
    check_stop : callable
        Raises if the scan is to stop.
    advice : str
        What messages say to do next.
    """

    def __init__(
        self, axes: AxisGroup, clock: Clock, config: RigConfig, check_stop: Callable[[], None], advice: str
    ) -> None:
        self._axes = axes
        self._clock = clock
        self._config = config
        self._check_stop = check_stop
        self._advice = advice

    def move(self, goal: Mapping[str, float]) -> dict[str, AxisReading]:
        """Move axes, wait until they stand and the arm has stopped ringing; returns where all are.

        Parameters
        ----------
        goal : mapping of axis name to float
            [rad]; an axis that is not in it stays.

        Raises
        ------
        LimitError
            If the way leads through a zone; nothing was sent.
        DeviceError
            If an axis cannot get there, or not in time.
        """
        here = {axis: reading.angle for axis, reading in self.read().items()}
        for part in zones.stages(here, {**here, **goal}, self._config):
            wanted = {axis: angle for axis, angle in part.items() if axis in goal}
            self._together(here, wanted)
            here |= wanted
        self.wait(self._config.settle_s)
        return self.read()

    def _together(self, here: Mapping[str, float], goal: Mapping[str, float]) -> None:
        """Move the axes of `goal` at the same time, from `here` [rad]."""
        start, end = ([angles[axis] for axis in AXES] for angles in (here, {**here, **goal}))
        expected_s = float(move_seconds(start, end, self._config.axes))
        limit_s = _PATIENCE * expected_s + _GRACE_S
        self._check_stop()
        self._axes.move_to(goal)
        deadline_s = self._clock.now() + limit_s
        pending, polls = list(goal), 0
        while pending := [axis for axis, settled in self._axes.settled(pending).items() if not settled]:
            polls += 1
            if self._clock.now() > deadline_s and polls > _LEAST_POLLS:
                standing = self.read()
                listed = ", ".join(
                    f"{axis} at {np.degrees(standing[axis].angle):.2f} of {np.degrees(goal[axis]):.2f} degrees"
                    for axis in pending
                )
                raise DeviceTimeoutError(
                    f"a move of {expected_s:.1f} s is not over after {limit_s:.1f} s: {listed}; look for an obstacle, then "
                    f"{self._advice}"
                )
            self._check_stop()
            self._clock.sleep(_POLL_S)

    def read(self) -> dict[str, AxisReading]:
        """Measure all axes."""
        return dict(self._axes.read())

    def has_moved(self, before: Mapping[str, AxisReading], after: Mapping[str, AxisReading]) -> bool:
        """Whether an axis moved between two readings, by more than the rig allows, or still does."""
        return any(after[a].moving or abs(after[a].angle - before[a].angle) > self._config.moved for a in AXES)

    def unsteady(self, what: str, before: Mapping[str, AxisReading], after: Mapping[str, AxisReading]) -> MeasurementError:
        """The error to raise when `has_moved` stays true."""
        axis = max(AXES, key=lambda a: abs(after[a].angle - before[a].angle))
        moved = abs(after[axis].angle - before[axis].angle)
        return MeasurementError(
            f"{what}: axis {axis} moved by {np.degrees(moved):.3f} degrees during the exposures, {ATTEMPTS} times; "
            f"moved_deg allows {np.degrees(self._config.moved):.3f}: lessen the load or raise settle_s, then {self._advice}"
        )

    def wait(self, seconds: float) -> None:
        """Wait in rig time, in slices, so that a stop is heard."""
        end_s = self._clock.now() + seconds
        while (left := end_s - self._clock.now()) > 1e-9:
            self._check_stop()
            self._clock.sleep(min(left, _SLICE_S))


def mean_angles(before: Mapping[str, AxisReading], after: Mapping[str, AxisReading]) -> dict[str, float]:
    """Means of two readings [rad]."""
    return {axis: 0.5 * (before[axis].angle + after[axis].angle) for axis in AXES}


def counts(readings: Mapping[str, AxisReading]) -> dict[str, int]:
    """Positions as the encoders give them."""
    return {axis: reading.position_counts for axis, reading in readings.items()}


def health(readings: Mapping[str, AxisReading]) -> dict[str, dict[str, float]]:
    """What the axes tell of themselves."""
    return {
        axis: {
            "temperature_c": reading.temperature_c,
            "voltage_v": reading.voltage_v,
            "current_a": reading.current_a,
            "goal_counts": float(reading.goal_counts),
        }
        for axis, reading in readings.items()
    }
