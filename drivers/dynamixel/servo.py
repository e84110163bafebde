"""One X-series servo as an axis: joint angles in, measured joint angles out.

It puts the servo in position mode with the axis's limits in its own EEPROM, approaches every goal from one side so that
the gears' play falls the same way each time, and calls a move finished only when the servo stands still at its goal by
every sign it gives. The goal is never reported as an angle. It never waits: `settled` is polled, and drives the second
leg of an approach. It does not know the rig's geometry, nor where the axis's true zero is, and it never takes torque off
a loaded arm, except at `connect`, once, when a setting in EEPROM has to change.

References: ROBOTIS e-manual, XM430-W350 (emanual.robotis.com/docs/en/dxl/x/xm430-w350).
"""

from __future__ import annotations

import logging
import math
from typing import Literal

from drivers.dynamixel import registers as reg
from drivers.dynamixel.bus import Bus, RefusedError
from drivers.dynamixel.commissioning import commission, torque_on
from drivers.dynamixel.joint import Joint
from drivers.dynamixel.leg import Leg, Outcome
from drivers.dynamixel.settings import Settings, settings_of
from drivers.dynamixel.watchdog import Watchdog
from gonio.errors import ConfigurationError, DeviceError, ProtocolError
from gonio.interfaces import AxisLimits, AxisReading

logger = logging.getLogger(__name__)

_RESENDS = 2


class Servo:
    """An axis driven by an X-series servo; satisfies `gonio.interfaces.Axis`.

    Parameters
    ----------
    bus : Bus
        Open line.
    name : str
        Of the axis, as messages call it.
    servo_id : int
        On the line, 0 to 252.
    model : str, optional
        As on the label.
    zero_counts : int, optional
        Present Position at angle 0.
    direction : {1, -1}, optional
        Sign of counts against angle.
    lower, upper : float
        Joint limits [rad]; they must lie within the servo's turn, counts 0 to 4095.
    velocity, acceleration : float
        Of the motion profile [rad/s, rad/s^2]; the servo gets the next lower step (0.024, 0.37).
    approach : {"up", "down", "any"}, optional
        Side of the final approach: with increasing angle, decreasing, or as it comes.
    overshoot : float, optional
        How far before the goal the final approach begins [rad]; at least 1 degree and more than the tolerance.
    tolerance_counts : int, optional
        Friction lets a servo stop this far from its goal; farther is a stall.
    settle_s : float, optional
        Two equal readings this far apart in rig time mean that the axis stands [s].
    stall_s : float, optional
        Without progress for so long in rig time, the move has failed [s].
    watchdog_s : float, optional
        The servo stops by itself if it hears nothing for so long during a move [s], at most 2.54; None for never.
    current_limit : float, optional
        A move with more current than this for 0.2 s has failed [A]; also the servo's own limit, which position mode does
        not obey. None for none, and on models without a current sensor.
    pwm_limit : float, optional
        Share of the supply that the servo may use, 0 to 1, which bounds its torque; None leaves it as it is.

    Raises
    ------
    ConfigurationError
        If a parameter is outside its range.
    """

    def __init__(
        self,
        bus: Bus,
        name: str,
        servo_id: int,
        *,
        model: str = "XM430-W350",
        zero_counts: int = 2048,
        direction: int = 1,
        lower: float,
        upper: float,
        velocity: float,
        acceleration: float,
        approach: Literal["up", "down", "any"] = "up",
        overshoot: float = math.radians(2.0),
        tolerance_counts: int = 12,
        settle_s: float = 0.05,
        stall_s: float = 2.0,
        watchdog_s: float | None = None,
        current_limit: float | None = None,
        pwm_limit: float | None = None,
    ) -> None:
        self._bus = bus
        self._id = servo_id
        self._joint = Joint(name, zero_counts, direction, lower, upper, approach, overshoot, tolerance_counts)
        self._limits = AxisLimits(lower, upper, velocity)
        self._settle_s = settle_s
        self._stall_s = stall_s
        if not 0 <= servo_id <= 252:
            raise ConfigurationError(f"Axis {name}: id {servo_id} is outside 0 to 252.")
        if not 0.0 < settle_s < stall_s:
            raise ConfigurationError(
                f"Axis {name}: settle_s = {settle_s:g} must be above 0 and below stall_s = {stall_s:g}."
            )
        self._settings = settings_of(
            self._joint, model, velocity=velocity, acceleration=acceleration, current_limit=current_limit,
            pwm_limit=pwm_limit,
        )  # fmt: skip
        self._watchdog = Watchdog(bus, servo_id, self._settings, watchdog_s)
        self._connected = False
        self._identity: dict[str, object] = {}
        self._goal: int | None = None  # of the move [counts]; None when the axis only holds
        self._legs: list[int] = []  # goals still to come, the current one first [counts]
        self._leg: Leg | None = None  # the current one
        self._arrived = False
        self._one_sided = False  # this move ends from the approach side
        self._engaged = False  # the last move did, so the play lies there
        self._resends = 0
        bus.register(servo_id, self)

    # -- connection

    @property
    def id(self) -> int:
        """On the line."""
        return self._id

    @property
    def settings(self) -> Settings:
        """What the servo is to hold."""
        return self._settings

    def connect(self) -> None:
        """Check that the right, healthy servo answers, put the axis's settings into it, torque on without a jump.

        Raises
        ------
        DeviceError
            With the first thing that is wrong.
        """
        self._identity = commission(self._bus, self._id, self._settings)
        self.halted(torque_on(self._bus, self._id, self._joint))
        self._connected = True
        logger.info("axis %s connected: %s", self.name, self._identity)

    # -- Axis

    @property
    def name(self) -> str:
        """Of the axis."""
        return self._joint.name

    @property
    def limits(self) -> AxisLimits:
        """Host-side limits; the servo holds the same."""
        return self._limits

    def check(self, angle: float) -> None:
        """Raise `LimitError` if an angle [rad] is outside the limits; nothing is sent."""
        self._joint.goal(angle)

    def move_to(self, angle: float) -> None:
        """Start moving to `angle` [rad]; returns at once.

        A goal at which the axis stands already is approached anew from its side: where friction stops it is different
        each time, so that the encoder's rounding errors of two poses are independent.

        Raises
        ------
        LimitError
            Outside the limits; nothing was sent.
        """
        if self.departs(angle):
            block = self._bus.block(self._id)
            self.arm(block)
            self._send_goal(self.depart(angle, block))

    def _begin(self, legs: list[int]) -> None:
        self._legs = legs
        self._goal = legs[-1]
        self._arrived = False
        self._resends = 0
        self._start_leg()

    def _start_leg(self) -> None:
        self._leg = Leg(
            self._legs[0], self._joint.tolerance_counts, self._settle_s, self._stall_s, self._bus.clock.now(),
            self._settings.current_limit,
        )  # fmt: skip

    def settled(self) -> bool:
        """Poll: True once the axis stands at its goal by every sign it can give.

        Signs: the servo holds the goal that was sent, it does not move and runs no profile, it is within the tolerance
        of the goal, and two readings `settle_s` apart are equal.

        Raises
        ------
        DeviceError
            Hardware error, stall, lost torque, no answer.
        """
        self._need_connection()
        return self.judge(self._bus.block(self._id))

    def read(self) -> AxisReading:
        """Measure now: two consecutive consistent blocks.

        Raises
        ------
        HardwareStatusError
            The servo reports an error of its own.
        """
        self._need_connection()
        return self.reading(self._bus.agreed_block(self._id))

    # -- the same in steps, for several servos whose states are asked and whose goals are sent in one packet

    def departs(self, angle: float) -> bool:
        """Whether a goal has to be sent to get to `angle` [rad]: not if it is under way there, nor if it stands there
        and would not be approached anew. `LimitError` outside the limits."""
        goal = self._joint.goal(angle)
        self._need_connection()
        return goal != self._goal or (self._arrived and self._joint.approach != "any")

    def arm(self, block: reg.Block) -> None:
        """Watchdog on, if the servo's state says that it is healthy."""
        self._healthy(block)
        self._watchdog.arm()

    def depart(self, angle: float, block: reg.Block) -> int:
        """Begin a move from the state that was read; returns the first goal, which the caller sends [counts]."""
        goal = self._joint.goal(angle)
        engaged = self._engaged and self._arrived and goal != self._goal
        legs, self._one_sided = self._joint.legs(block.position, goal, engaged=engaged)
        if not self._one_sided:
            logger.warning("axis %s: no room to approach %.2f deg from one side", self.name, self._joint.degrees(goal))
        self._begin(legs)
        return legs[0]

    def judge(self, block: reg.Block) -> bool:
        """What `settled` says of a state that was read now; sends the next goal of an approach."""
        self._healthy(block)
        if block.goal != self._legs[0]:
            self._resend(block)
            return False
        assert self._leg is not None  # connected
        if self._arrived:
            if self._leg.still(block):
                return True
            self._arrived = False  # pushed away
            self._start_leg()
        outcome = self._leg.see(block)
        if outcome in (Outcome.STALLED, Outcome.STRAINED):
            self._give_up(block, outcome)
        return outcome is Outcome.AT_REST and self._finish_leg()

    def _finish_leg(self) -> bool:
        """The current leg has ended: start the next, or arrive."""
        if len(self._legs) > 1:
            del self._legs[0]
            self._start_leg()
            self._send_goal(self._legs[0])
            return False
        self._arrived = True
        self._engaged = self._one_sided
        self._watchdog.disarm()
        return True

    def _resend(self, block: reg.Block) -> None:
        """The servo holds another goal than the one it acknowledged."""
        if not self._read(reg.TORQUE_ENABLE):
            raise DeviceError(
                f"{self._label} has lost its torque, as after a dip of its supply, at "
                f"{self._at(block.position)}; check power and cable, then connect again."
            )
        if self._resends >= _RESENDS:
            raise ProtocolError(
                f"{self._label} holds goal {block.goal} counts where {self._legs[0]} was sent {1 + _RESENDS} times; "
                "check that no other program moves it."
            )
        self._resends += 1
        logger.warning("axis %s: goal %d instead of %d, sent again", self.name, block.goal, self._legs[0])
        self._send_goal(self._legs[0])

    def _give_up(self, block: reg.Block, outcome: Outcome) -> None:
        """No progress, or at too much current: let go of the load, say what was seen."""
        goal = self._legs[0]
        tripped = self._watchdog.tripped()
        current = self._current_a(block)
        try:
            if tripped:  # it takes no goal before
                self._watchdog.disarm()
            self.stop()
        except DeviceError as error:
            logger.warning("axis %s: cannot be stopped after its stall: %s", self.name, error)
        if tripped:
            raise self._barked(block)
        if outcome is Outcome.STRAINED:
            raise DeviceError(
                f"{self._label} draws {abs(current):.2f} A at {self._at(block.position)} on the way to {self._at(goal)}, "
                f"its limit is {self._settings.current_limit_a:.2f} A; it holds there: look for an obstacle or too heavy a "
                "load, or raise current_limit_a."
            )
        load = "" if math.isnan(current) else f" with {current:.2f} A"
        raise DeviceError(
            f"{self._label} makes no progress for {self._stall_s:g} s: it stands at {self._at(block.position)}"
            f"{load}, its goal is {self._at(goal)}; look for an obstacle, too heavy a load or a low supply."
        )

    def reading(self, block: reg.Block) -> AxisReading:
        """The measurement that a state is."""
        self._healthy(block)
        return AxisReading(
            angle=self._joint.angle(block.position),
            position_counts=block.position,
            goal_counts=block.goal,
            velocity=self._joint.direction * block.velocity * reg.VELOCITY_UNIT,
            moving=block.in_motion,
            temperature_c=float(block.temperature),
            voltage_v=block.voltage * reg.VOLTAGE_UNIT_V,
            current_a=self._current_a(block),
        )

    def stop(self) -> None:
        """Stop now and hold: goal := present, torque stays on."""
        self._need_connection()
        goal = self.clip(self._bus.block(self._id).position)
        self.halted(goal)
        self._bus.write(self._id, reg.GOAL_POSITION, goal)

    def describe(self) -> dict[str, object]:
        """Identity and settings for the run's metadata (JSON-compatible)."""
        return {
            "name": self.name,
            **self._identity,
            "zero_counts": self._joint.zero_counts,
            "direction": self._joint.direction,
            "lower_deg": math.degrees(self._limits.lower),
            "upper_deg": math.degrees(self._limits.upper),
            "velocity_deg_s": math.degrees(self._settings.profile_velocity * reg.VELOCITY_UNIT),
            "acceleration_deg_s2": math.degrees(self._settings.profile_acceleration * reg.ACCELERATION_UNIT),
            "current_limit_a": self._settings.current_limit_a,
            "pwm_limit": self._settings.pwm_share,
            "approach": self._joint.approach,
            "overshoot_counts": self._joint.overshoot_counts,
            "tolerance_counts": self._joint.tolerance_counts,
            "settle_s": self._settle_s,
            "watchdog_s": self._watchdog.seconds,
        }

    def close(self) -> None:
        """Let go of the servo; it keeps its torque and holds."""
        if self._connected:
            self._watchdog.disarm()
        self._connected = False

    # -- drivers.dynamixel.bus.Member

    def clip(self, counts: int) -> int:
        """Nearest position within the limits [counts]."""
        return self._joint.clip(counts)

    def disarm(self) -> None:
        """Watchdog off; one that has tripped takes no goal before."""
        self._watchdog.disarm()

    def halted(self, goal: int) -> None:
        """The servo was told to hold `goal` [counts]; the move is off."""
        self._one_sided = self._engaged = False
        self._begin([goal])
        self._goal = None

    # -- access

    @property
    def _label(self) -> str:
        return self._bus.label(self._id)

    def _at(self, counts: int) -> str:
        return f"{self._joint.degrees(counts):.2f} deg"

    def _current_a(self, block: reg.Block) -> float:
        unit = self._settings.model.current_unit_a
        return math.nan if unit is None else block.current * unit

    def _read(self, register: reg.Register) -> int:
        return self._bus.read(self._id, register)

    def _send_goal(self, counts: int) -> None:
        try:
            self._bus.command(self._id, reg.GOAL_POSITION, counts)
        except RefusedError:
            if not self._watchdog.tripped():
                raise
            raise self._barked(self._bus.block(self._id)) from None

    def _barked(self, block: reg.Block) -> DeviceError:
        return DeviceError(
            f"{self._label} was stopped by its own watchdog at {self._at(block.position)}: it heard nothing for too long, "
            "from a busy computer or over a bad line; raise watchdog_s and resume."
        )

    def _healthy(self, block: reg.Block) -> None:
        if block.alert:
            raise self._bus.hardware_fault(self._id)

    def _need_connection(self) -> None:
        if not self._connected:
            raise DeviceError(f"Axis {self.name} is not connected; call connect() first.")
