"""Dynamixel X-series servos on Protocol 2.0."""

from drivers.dynamixel.bus import Bus
from drivers.dynamixel.group import ServoGroup
from drivers.dynamixel.servo import Servo

__all__ = ["Bus", "Servo", "ServoGroup"]
