"""A servo's bus watchdog: it stops the axis by itself when the computer falls silent during a move.

Armed at the start of a move and disarmed at its end, so that a computer that thinks for a while beside a resting arm trips
nothing. It does not poll; whoever moves must ask often enough.

References: ROBOTIS e-manual, XM430-W350, Bus Watchdog (98) (emanual.robotis.com/docs/en/dxl/x/xm430-w350).
"""

from __future__ import annotations

import logging

from drivers.dynamixel import registers as reg
from drivers.dynamixel.bus import Bus
from drivers.dynamixel.settings import Settings
from gonio.errors import ConfigurationError

logger = logging.getLogger(__name__)


class Watchdog:
    """The watchdog of one servo.

    Parameters
    ----------
    bus : Bus
    servo_id : int
    settings : Settings
        Of the servo; its profile is given back after a trip.
    seconds : float or None
        Silence after which the servo stops [s], at most 2.54; None for never: then nothing here sends a byte.

    Raises
    ------
    ConfigurationError
        If it is outside its range.
    """

    def __init__(self, bus: Bus, servo_id: int, settings: Settings, seconds: float | None) -> None:
        if seconds is not None and not 0.0 < seconds <= 127 * reg.WATCHDOG_UNIT_S:
            raise ConfigurationError(f"{bus.label(servo_id)}: watchdog {seconds:g} s is outside 0 to 2.54 s.")
        self._bus = bus
        self._id = servo_id
        self._settings = settings
        self._value = 0 if seconds is None else max(1, round(seconds / reg.WATCHDOG_UNIT_S))

    @property
    def seconds(self) -> float:
        """Silence after which the servo stops, as the servo counts it [s]; 0 for never."""
        return self._value * reg.WATCHDOG_UNIT_S

    def arm(self) -> None:
        """On, for a move that begins."""
        if self._value:
            self.disarm()
            self._bus.command(self._id, reg.BUS_WATCHDOG, self._value)

    def tripped(self) -> bool:
        """Whether it has stopped the servo."""
        return bool(self._value) and self._bus.read(self._id, reg.BUS_WATCHDOG) < 0

    def disarm(self) -> None:
        """Off. One that has tripped takes the profile with it: without it the next move would be a jerk."""
        if not self._value:
            return
        tripped = self.tripped()
        self._bus.command(self._id, reg.BUS_WATCHDOG, 0)
        if tripped:
            logger.warning("%s: its watchdog had tripped", self._bus.label(self._id))
            self._bus.command(self._id, reg.PROFILE_ACCELERATION, self._settings.profile_acceleration)
            self._bus.command(self._id, reg.PROFILE_VELOCITY, self._settings.profile_velocity)
