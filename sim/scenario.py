"""What goes wrong on the simulated rig, and when: a TOML list of faults.

::

    [[fault]]
    kind = "silent"        # silent, overload, overheat, voltage, stuck, obstacle, reboot, error_status,
    axis = "pan"           # drop, truncate, corrupt, duplicate, delay, wrong_id
    at_pose = 17

    [[fault]]
    kind = "lamp_out"      # lamp_out, lamp_silent, camera_unplugged, frame_torn, frame_repeated, disconnect
    after_frames = 200

Each fault has one trigger. ``at_pose`` strikes when the first frame of that pose is asked for, ``after_frames`` when
that many frames were taken and another is asked for, ``at_s`` at a rig time [s] (in this process the lamp, the camera and
the cables notice it at the next frame). Faults of an axis may instead have a trigger of `sim.dynamixel.faults.Fault`:
``at_goal_write``, ``at_instruction`` or ``at_reply``, and take its options ``after_s``, ``every``, ``until_instruction``,
``number``, ``delay_s``, ``flips``, ``burst``, ``lost_bytes``, ``ahead_counts``. Faults of answers strike every answer from
their trigger on, unless ``every`` says otherwise; counted ones once.

``disconnect`` pulls the bus's cable; with ``for_s`` it is back after that many rig seconds, under the name ``return_as``
if there is one, as a USB adapter comes back as another ttyUSB.

Nothing is left to chance, so a scan that failed fails again.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gonio.errors import ConfigurationError
from sim.dynamixel.faults import INPUT_VOLTAGE, OF_REPLIES, OF_THE_SERVO, OVERHEATING, OVERLOAD, Fault
from sim.settings import AXES, Table, read_file

_HARDWARE = {"overload": OVERLOAD, "overheat": OVERHEATING, "voltage": INPUT_VOLTAGE}
_AXIS_KINDS = ("silent", *_HARDWARE, "stuck", "obstacle", "reboot", "error_status", *OF_REPLIES)
_BENCH_KINDS = ("lamp_out", "lamp_silent", "camera_unplugged", "frame_torn", "frame_repeated", "disconnect")
_FRAME_TRIGGERS = ("at_pose", "after_frames")
_BUS_TRIGGERS = ("at_goal_write", "at_instruction", "at_reply")
_WHOLE = ("every", "until_instruction", "number", "flips", "lost_bytes")
_OPTIONS = ("after_s", "delay_s", "ahead_counts", "burst", *_WHOLE)
_CABLE_OPTIONS = ("for_s", "return_as")
_POSE = re.compile(r"pose (\d+)\b")


@dataclass(frozen=True)
class BenchFault:
    """One entry of a scenario.

    Attributes
    ----------
    kind : str
    axis : str or None
        None for the lamp and the camera.
    trigger : str
    value : float
        Of the trigger.
    options : mapping
        Of the servos' faults, and of a disconnection.
    """

    kind: str
    axis: str | None
    trigger: str
    value: float
    options: Mapping[str, Any]

    @classmethod
    def read(cls, entry: Table) -> BenchFault:
        """Check one table.

        Raises
        ------
        ConfigurationError
        """
        kind = entry.text("kind", "")
        if kind not in (*_AXIS_KINDS, *_BENCH_KINDS):
            known = ", ".join((*_AXIS_KINDS, *_BENCH_KINDS))
            raise ConfigurationError(f"[{entry.place}] kind = {kind!r} is not known; choose one of {known}.")
        on_axis = kind in _AXIS_KINDS
        triggers = (*_FRAME_TRIGGERS, "at_s", *(_BUS_TRIGGERS if on_axis else ()))
        extra = ("axis", *_OPTIONS) if on_axis else _CABLE_OPTIONS if kind == "disconnect" else ()
        entry.only(("kind", *triggers, *extra))
        given = [name for name in triggers if name in entry.values]
        if len(given) != 1:
            has = " and ".join(given) or "none"
            raise ConfigurationError(f"[{entry.place}] needs one trigger of {', '.join(triggers)}, and has {has}.")
        axis = entry.text("axis", "") if on_axis else None
        if on_axis and axis not in AXES:
            raise ConfigurationError(f"[{entry.place}] axis = {axis!r} is no axis; choose one of {', '.join(AXES)}.")
        trigger = given[0]
        if trigger == "at_s":
            value = entry.number(trigger, 0.0, 0.0, 1e9)
        else:
            value = float(entry.integer(trigger, 0, 0, 10**9))
        options: dict[str, Any] = {}
        for name in (*_OPTIONS, *_CABLE_OPTIONS):
            if name in entry.values:
                options[name] = _option(entry, name)
        fault = cls(kind, axis, trigger, value, options)
        if on_axis:
            fault.for_servo(1)  # refuses impossible combinations now, not in the middle of a scan
        return fault

    def for_servo(self, servo_id: int, now: float | None = None) -> Fault:
        """The same as a fault of a servo; one with a frame trigger strikes at once, at `now` [s]."""
        kind: Any = self.kind
        options = dict(self.options)
        if self.kind in _HARDWARE:
            kind, options["bits"] = "hardware", _HARDWARE[self.kind]
        elif self.kind == "error_status":
            kind = "error"
        if self.trigger in _BUS_TRIGGERS:
            options[self.trigger] = int(self.value)
        else:
            options["at_time_s"] = self.value if self.trigger == "at_s" else now or 0.0
            if kind not in ("silent", *OF_THE_SERVO):
                options.setdefault("every", 1)
        return Fault(kind, servo_id, **options)


def _option(entry: Table, name: str) -> Any:
    """An option with its type."""
    if name == "return_as":
        return entry.text(name, "")
    if name == "burst":
        value = entry.values[name]
        if not isinstance(value, bool):
            raise ConfigurationError(f"[{entry.place}] burst must be true or false, and is {value!r}.")
        return value
    return entry.integer(name, 0, 0, 10**9) if name in _WHOLE else entry.number(name, 0.0, 0.0, 1e9)


class Scenario:
    """All that is to go wrong.

    Parameters
    ----------
    faults : sequence of BenchFault, optional
    """

    def __init__(self, faults: Sequence[BenchFault] = ()) -> None:
        self.faults = tuple(faults)
        self._waiting = [fault for fault in faults if fault.axis is None or fault.trigger in _FRAME_TRIGGERS]

    @classmethod
    def from_mapping(cls, document: Mapping[str, Any], name: str = "scenario") -> Scenario:
        """Read ``{"fault": [...]}``.

        Raises
        ------
        ConfigurationError
            If a key, a kind or a trigger is not known.
        """
        Table(document, name).only(("fault",))
        entries = document.get("fault", [])
        if not isinstance(entries, list) or not all(isinstance(entry, Mapping) for entry in entries):
            raise ConfigurationError(f"{name}: fault must be a list of tables; write [[fault]].")
        return cls([BenchFault.read(Table(entry, f"{name}: fault {k}")) for k, entry in enumerate(entries, start=1)])

    @classmethod
    def load(cls, path: Path) -> Scenario:
        """Read a scenario file."""
        return cls.from_mapping(read_file(path), str(path))

    def known_to_servos(self, ids: Mapping[str, int]) -> list[Fault]:
        """Faults that servos and bus can count or time by themselves; `ids` by axis."""
        return [
            fault.for_servo(ids[fault.axis])
            for fault in self.faults
            if fault.axis is not None and fault.trigger not in _FRAME_TRIGGERS
        ]

    def due(self, label: str, frames: int, now: float) -> list[BenchFault]:
        """Faults that strike now, each once.

        Parameters
        ----------
        label : str
            Of the frame that is asked for.
        frames : int
            Taken so far.
        now : float
            Rig time [s].
        """
        pose = _POSE.match(label)
        number = float(pose.group(1)) if pose else None
        reached = {"after_frames": float(frames), "at_s": now}
        struck = [
            fault
            for fault in self._waiting
            if (number == fault.value if fault.trigger == "at_pose" else reached[fault.trigger] >= fault.value)
        ]
        self._waiting = [fault for fault in self._waiting if fault not in struck]
        return struck
