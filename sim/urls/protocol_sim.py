"""``serial.serial_for_url("sim://NAME")`` opens a `sim.port.SimulatedPort`."""

from __future__ import annotations

from sim.port import SimulatedPort as Serial

__all__ = ["Serial"]
