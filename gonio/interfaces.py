"""What a scan needs of the hardware: the shapes that ``drivers`` and ``sim`` satisfy without sharing code.

Angles are joint angles in radians. Nothing here opens a port. The methods of an `Axis` return at once; the engine
polls. Time comes from a `Clock`, so that the same engine runs on the wall's clock, on a simulated rig's faster one, and
on a virtual one.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray


@runtime_checkable
class Clock(Protocol):
    """Rig time. A simulated rig's second may be shorter than the wall's."""

    def now(self) -> float:
        """Seconds since an arbitrary start; never goes back."""
        ...

    def sleep(self, seconds: float) -> None:
        """Wait that many rig seconds."""
        ...


@dataclass(frozen=True)
class AxisLimits:
    """Host-side limits of one axis.

    Attributes
    ----------
    lower, upper : float
        Joint angle range [rad].
    velocity : float
        Largest speed [rad/s].
    """

    lower: float
    upper: float
    velocity: float


@dataclass(frozen=True)
class AxisReading:
    """One consistent reading of an axis.

    Attributes
    ----------
    angle : float
        Measured joint angle [rad], from the encoder and never from the goal.
    position_counts, goal_counts : int
        Raw registers: measured and commanded position.
    velocity : float
        Measured speed [rad/s].
    moving : bool
        The servo says that it moves or that a motion profile is running.
    temperature_c, voltage_v, current_a : float
        Health; NaN where the device has no such sensor.
    """

    angle: float
    position_counts: int
    goal_counts: int
    velocity: float
    moving: bool
    temperature_c: float = float("nan")
    voltage_v: float = float("nan")
    current_a: float = float("nan")


@runtime_checkable
class Axis(Protocol):
    """One motor with its joint."""

    @property
    def name(self) -> str: ...

    @property
    def limits(self) -> AxisLimits: ...

    def check(self, angle: float) -> None:
        """Raise `LimitError` if `move_to` would; nothing is sent."""
        ...

    def move_to(self, angle: float) -> None:
        """Start moving to `angle` [rad]; returns at once. Raises `LimitError` before a byte is sent."""
        ...

    def settled(self) -> bool:
        """Poll: True once the axis stands at its goal by every sign it can give. Drives a two-leg approach.

        Raises `DeviceError` if it cannot get there (stall, overload, no answer, timeout).
        """
        ...

    def read(self) -> AxisReading:
        """Measure now."""
        ...

    def stop(self) -> None:
        """Stop now and hold: goal := present, torque stays on."""
        ...

    def describe(self) -> Mapping[str, object]:
        """Identity and settings for the run's metadata (JSON-compatible)."""
        ...


@runtime_checkable
class AxisGroup(Protocol):
    """The axes of a rig, asked and started together."""

    def move_to(self, goals: Mapping[str, float]) -> None:
        """Start moving axes, each to its angle [rad], at the same instant; returns at once.

        Raises `LimitError` before a byte is sent.
        """
        ...

    def settled(self, names: Collection[str]) -> Mapping[str, bool]:
        """Poll these axes, each as `Axis.settled`."""
        ...

    def read(self) -> Mapping[str, AxisReading]:
        """Measure all axes now."""
        ...


@dataclass(frozen=True)
class Frame:
    """One exposure.

    Attributes
    ----------
    data : ndarray of uint16, shape (height, width)
        Raw counts [DN].
    exposure_s : float
        Exposure time [s], as read back from the camera.
    gain : float
        Camera gain setting, 1 = base.
    timestamp_s : float
        Rig time at the end of the exposure [s].
    bit_depth : int
        Significant bits of `data`.
    linear : bool
        Counts are proportional to light (no gamma).
    saturation_dn : int
        Counts at and above which a pixel is saturated.
    label : str
        What was asked for, e.g. ``"pose 17 exposure 2"``.
    metadata : mapping
        Anything else the camera tells (JSON-compatible).
    """

    data: NDArray[np.uint16]
    exposure_s: float
    gain: float
    timestamp_s: float
    bit_depth: int
    linear: bool
    saturation_dn: int
    label: str = ""
    metadata: Mapping[str, object] = field(default_factory=dict)


@runtime_checkable
class Camera(Protocol):
    """A camera with manual exposure."""

    @property
    def name(self) -> str: ...

    def capture(self, exposure_s: float, *, label: str) -> Frame:
        """Expose a fresh frame that began after this call.

        `label` names the frame in the journal; a simulated camera keys its noise with it, so that a resumed scan sees
        the noise it would have seen.
        """
        ...

    def describe(self) -> Mapping[str, object]: ...

    def close(self) -> None: ...


@runtime_checkable
class StreamingCamera(Camera, Protocol):
    """A camera whose frames may show the past, and which can find out by how many."""

    def measure_late(self, light: Callable[[bool], object], exposure_s: float) -> int:
        """Switch the light with `light`, count the frames that show it as it was, and throw that many away from now on."""
        ...


@runtime_checkable
class Lamp(Protocol):
    """A lamp that can be switched."""

    @property
    def name(self) -> str: ...

    def set_output(self, on: bool) -> None:
        """Switch, and return when the lamp has confirmed."""
        ...

    def set_level(self, fraction: float) -> None:
        """Set the drive level, 0 to 1."""
        ...

    def describe(self) -> Mapping[str, object]: ...

    def close(self) -> None: ...
