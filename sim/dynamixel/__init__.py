"""Dynamixel X-series servos at the level of bytes on the line.

`packet` is the codec, `control_table` the registers, `motion` the profiles, `servo` one servo with its firmware,
`faults` what can be made to go wrong, and `bus` several servos on one line.
"""

from __future__ import annotations

from sim.dynamixel.bus import DynamixelBus
from sim.dynamixel.faults import Fault
from sim.dynamixel.servo import Servo

__all__ = ["DynamixelBus", "Fault", "Servo"]
