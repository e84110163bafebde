"""What can be made to go wrong on a simulated bus.

A fault is a value: what happens, to whom, and when. It is counted in instructions, goal writes or replies, or dated in
rig time; it never depends on chance, so a failing test fails again.
"""

from __future__ import annotations

import random
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal, get_args

from gonio.errors import ConfigurationError
from sim.dynamixel.packet import crc16

Kind = Literal[
    "silent", "hardware", "stuck", "obstacle", "reboot",
    "error", "drop", "truncate", "corrupt", "duplicate", "delay", "wrong_id",
]  # fmt: skip
OF_THE_SERVO = ("hardware", "stuck", "obstacle", "reboot")  # the servo keeps their time itself
OF_REPLIES = ("drop", "truncate", "corrupt", "duplicate", "delay", "wrong_id")

OVERLOAD = 0x20  # bit 5 of Hardware Error Status
OVERHEATING = 0x04  # bit 2
INPUT_VOLTAGE = 0x01  # bit 0

_TRIGGERS: Mapping[str, tuple[str, ...]] = {
    "silent": ("at_instruction", "at_goal_write", "at_time_s"),
    "error": ("at_instruction", "at_time_s"),
    **dict.fromkeys(OF_THE_SERVO, ("at_goal_write", "at_time_s")),
    **dict.fromkeys(OF_REPLIES, ("at_reply", "at_time_s")),
}


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes
    ----------
    kind : str
        ``"silent"``: the servo neither hears nor answers from then on, as if unplugged.
        ``"hardware"``: `bits` of Hardware Error Status come on; if Shutdown has one of them, torque goes off.
        ``"stuck"``: the shaft stands still from then on; its profile runs as if nothing were wrong, and the overload
        protection does not notice.
        ``"obstacle"``: `ahead_counts` ahead of the shaft, in the direction in which it moves, it can go no further; the
        motor pushes until the overload protection cuts in.
        ``"reboot"``: the servo restarts, as after a brown-out.
        ``"error"``: the servo answers with error `number` and does not do what it was told.
        ``"drop"``, ``"truncate"``, ``"corrupt"``, ``"duplicate"``, ``"delay"``, ``"wrong_id"``: a reply is lost, ends
        `lost_bytes` early, has `flips` wrong bits, comes twice, comes `delay_s` late, or bears the next servo's ID (with
        a right checksum).
    servo_id : int, optional
        Whom; None for every servo.
    at_instruction, at_goal_write, at_reply : int, optional
        When: at the n-th instruction that reaches the servo, the n-th time its Goal Position is written, its n-th
        reply; from 1.
    at_time_s : float, optional
        When, in rig time [s]; for ``"error"`` and the faults of replies, at the first of them from then on.
    after_s : float, optional
        That much later than `at_goal_write` [s]; a fault in the middle of a move.
    every : int, optional
        For ``"error"`` and the faults of replies: again each `every` instructions or replies; 0 for once.
    until_instruction : int, optional
        For ``"silent"``: the servo is back at this instruction.
    bits : int, optional
        For ``"hardware"``: overload by default.
    number : int, optional
        For ``"error"``: 1 to 7.
    delay_s : float, optional
        For ``"delay"`` [s].
    flips : int, optional
        For ``"corrupt"``: how many bits; one is the lowest of the last data byte, several are anywhere.
    burst : bool, optional
        For ``"corrupt"``: the bits stand side by side.
    lost_bytes : int, optional
        For ``"truncate"``.
    ahead_counts : float, optional
        For ``"obstacle"`` [counts].
    """

    kind: Kind
    servo_id: int | None = None
    at_instruction: int | None = None
    at_goal_write: int | None = None
    at_reply: int | None = None
    at_time_s: float | None = None
    after_s: float = 0.0
    every: int = 0
    until_instruction: int | None = None
    bits: int = OVERLOAD
    number: int = 1
    delay_s: float = 0.0
    flips: int = 1
    burst: bool = False
    lost_bytes: int = 2
    ahead_counts: float = 50.0

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise ConfigurationError(f"A fault of kind {self.kind!r} is not known; one of {', '.join(get_args(Kind))}.")
        given = [n for n in ("at_instruction", "at_goal_write", "at_reply", "at_time_s") if getattr(self, n) is not None]
        if len(given) != 1 or given[0] not in _TRIGGERS[self.kind]:
            wanted = " or ".join(_TRIGGERS[self.kind])
            raise ConfigurationError(f"A fault of kind {self.kind!r} needs {wanted}, and has {given or 'neither'}.")
        if self.flips < 1 or self.lost_bytes < 1 or not self.ahead_counts > 0.0:
            raise ConfigurationError(f"A fault of kind {self.kind!r} needs flips, lost_bytes and ahead_counts above 0.")

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> Fault:
        """Read a fault from a table of a scenario file.

        Raises
        ------
        ConfigurationError
            If a key is unknown, or no kind is given.
        """
        names = [f.name for f in fields(cls)]
        unknown = sorted(set(values) - set(names))
        if unknown or "kind" not in values:
            what = f"has unknown {', '.join(unknown)}" if unknown else "has no kind"
            raise ConfigurationError(f"A fault {what}; its keys are {', '.join(names)}.")
        return cls(**values)

    def concerns(self, servo_id: int) -> bool:
        """Whether it is about this servo."""
        return self.servo_id is None or self.servo_id == servo_id

    def spoil(self, reply: bytes, count: int) -> list[bytes]:
        """What arrives of the `count`-th reply, for the kinds that change its bytes."""
        if self.kind == "drop":
            return []
        if self.kind == "duplicate":
            return [reply, reply]
        if self.kind == "truncate":
            return [reply[: max(len(reply) - self.lost_bytes, 0)]]
        if self.kind == "wrong_id":
            head = reply[:4] + bytes(((reply[4] + 1) % 253,)) + reply[5:-2]
            return [head + crc16(head).to_bytes(2, "little")]
        if self.kind == "corrupt":
            return [self._flip(reply, count)]
        return [reply]

    def _flip(self, reply: bytes, count: int) -> bytes:
        if self.flips == 1:
            places = [8 * (len(reply) - 3)]
        else:
            rng = random.Random(f"{self.servo_id}:{count}")
            bits = 8 * len(reply)
            flips = min(self.flips, bits)
            start = rng.randrange(bits - flips + 1)
            places = list(range(start, start + flips)) if self.burst else rng.sample(range(bits), flips)
        spoilt = bytearray(reply)
        for place in places:
            spoilt[place // 8] ^= 1 << place % 8
        return bytes(spoilt)

    def due_at(self, trigger: int | None, count: int) -> bool:
        """Whether the `count`-th event is one that the fault strikes."""
        if trigger is None or count < trigger:
            return False
        return count == trigger or (self.every > 0 and (count - trigger) % self.every == 0)
