"""The composition root: the only room that knows `drivers` and `sim`, behind which all devices look alike.

`open_rig` opens everything a measurement needs, `open_axes` the servos alone. `gonio.rig.service` looks after a rig: find
servos, put settings into them, read all their registers, stop them; `gonio.rig.doctor` says what is wrong and what mends it.
"""

from gonio.rig.opening import Ask, OpenAxes, Rig, WallClock, open_axes, open_rig, serve_simulator

__all__ = ["Ask", "OpenAxes", "Rig", "WallClock", "open_axes", "open_rig", "serve_simulator"]
