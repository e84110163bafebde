"""Motor, gear and what hangs on them: the trajectory that the firmware wants, and where the shaft goes instead.

Torque, current, heat and overload follow from the weight of the joint, from obstacles and from friction. Everything is
evaluated for the time that is asked for. Not modelled: weight in the velocity, current and PWM modes, in which it would
make the speed change with the angle; inertia of the load; ringing.

References
----------
ROBOTIS e-Manual, XM430-W350: "Specifications", "Performance Graph", "Shutdown(63)".
"""

from __future__ import annotations

import math

from sim.dynamixel import motion
from sim.dynamixel.control_table import Motor
from sim.dynamixel.load import Heat, Load
from sim.dynamixel.motion import COUNTS_PER_TURN
from sim.dynamixel.shaft import ACCELERATION, Shaft

OVERLOAD_S = 2.0  # of a load beyond 80 % of what the motor can: "persistent", the manual says, and not how long
_PERSISTENT = 0.8
_GEAR_FRICTION = 0.05  # of the stall torque
_SUPPLY_OHM = 0.2


class Drive:
    """A motor with its gear and its load.

    Parameters
    ----------
    motor : Motor
    position : float
        Of the shaft at time 0 [counts].
    backlash : float
        Play between shaft and link, from flank to flank [counts].
    friction : tuple of float
        Smallest and largest distance from the goal at which the shaft stops [counts].
    load : Load
    supply_v : float
        Voltage of the supply [V].
    seed : str
        Of the friction.

    Attributes
    ----------
    shaft : Shaft
    heat : Heat
    trajectory : Motion
        What the firmware wants.
    on : bool
        The motor is driven.
    supply_v : float
        [V]
    fastest : float
        Speed at the full voltage of the supply [counts/s].
    """

    def __init__(
        self, motor: Motor, position: float, *, backlash: float, friction: tuple[float, float], load: Load,
        supply_v: float, seed: str,
    ) -> None:  # fmt: skip
        self._motor = motor
        self._load = load
        self.supply_v = supply_v
        self.fastest = motor.no_load_speed / 60.0 * COUNTS_PER_TURN * supply_v / motor.voltage_v
        self.shaft = Shaft(position, fastest=self.fastest, backlash=backlash, friction=friction, seed=seed)
        self.heat = Heat()
        self.trajectory = motion.rest(0.0, position)
        self.on = False
        self._strongest = 0.0  # torque that the firmware allows [N m]
        self._stalled_since = math.inf  # a load beyond `_strongest`, from this time on [s]
        self._rests_at: float | None = None  # when the present move ends and its heat is not booked yet [s]

    # ---- what the firmware orders ------------------------------------------------------------------------------

    def go(
        self, t: float, goal: int, speed: float, acceleration: float, *, stiffness: float, effort: float, current: float
    ) -> None:
        """Start a profile to `goal` [counts].

        Parameters
        ----------
        t : float
            [s]
        goal : int
        speed, acceleration : float
            Of the profile [counts/s, counts/s^2]; may be infinite.
        stiffness : float
            Share of the full voltage per count of deviation; infinite with an integral gain.
        effort : float
            Largest share of the full voltage, 0 to 1.
        current : float
            Largest current [A]; infinite for no limit.
        """
        self.on = True
        self._strongest = self._torque_limit(effort, current)
        wanted, wanted_velocity = self.trajectory.at(t)
        self.trajectory = motion.plan(t, wanted, wanted_velocity, goal, speed, acceleration)
        rest = self._load.rest(goal, stiffness * self._motor.stall_torque_nm, self._strongest)
        self.shaft.go(t, goal, speed, acceleration, rest=rest)
        self._stalled_since = self.shaft.blocked_since()
        if abs(self._load.torque(goal)) > self._strongest:
            self._stalled_since = min(self._stalled_since, self.shaft.ends())
        self._book(t)

    def spin(self, t: float, wanted: float, acceleration: float, *, effort: float, current: float) -> None:
        """Take up the speed `wanted` [counts/s] and keep it."""
        self.on = True
        self._strongest = self._torque_limit(effort, current)
        at, velocity = self.trajectory.at(t)
        self.trajectory = motion.spin(t, at, velocity, wanted, acceleration)
        if self._strongest < _GEAR_FRICTION * self._motor.stall_torque_nm:
            wanted = 0.0  # friction is stronger
        self.shaft.spin(t, wanted, min(acceleration, ACCELERATION * self._strongest / self._motor.stall_torque_nm))
        self._stalled_since = self.shaft.blocked_since()
        self._book(t)

    def hold(self, t: float) -> None:
        """Stand still here, at once."""
        self.shaft.hold(t)
        self.trajectory = motion.rest(t, self.shaft.at(t)[0])
        self._stalled_since = math.inf
        self._book(t)

    def release(self, t: float) -> None:
        """No current any more: a weight that is stronger than the gear's friction falls."""
        self.hold(t)
        self.on = False
        here = self.shaft.at(t)[0]
        if abs(self._load.torque(here)) > _GEAR_FRICTION * self._motor.stall_torque_nm:
            self.shaft.fall(t, self._load.hanging(here))
        self._book(t)

    def obstruct(self, t: float, ahead: float) -> None:
        """Put an obstacle in the way, `ahead` [counts] of the shaft in the direction in which it moves."""
        velocity = self.shaft.at(t)[1]
        self.shaft.obstruct(t, math.copysign(ahead, velocity if velocity != 0.0 else 1.0))
        self._stalled_since = self.shaft.blocked_since()
        self._book(t)

    # ---- what it feels -----------------------------------------------------------------------------------------

    def rests_at(self) -> float:
        """When the present move ends and `settle` has to be called [s]; infinite for never."""
        return math.inf if self._rests_at is None else self._rests_at

    def settle(self, t: float) -> None:
        """The move ended at `t` [s]: from now on the current is that of holding."""
        self._rests_at = None
        self.heat.carry(t, self.current(t))

    def overloaded_at(self) -> float:
        """When the protection cuts in if nothing changes [s]; infinite for never."""
        heavy = self._strongest >= _PERSISTENT * self._motor.stall_torque_nm
        return self._stalled_since + OVERLOAD_S if self.on and heavy else math.inf

    def torque(self, t: float) -> float:
        """Torque of the motor at `t` [N m], positive towards higher counts."""
        if not self.on:
            return 0.0
        position, velocity = self.shaft.at(t)
        wanted, wanted_velocity = self.trajectory.at(t)
        if self.shaft.stuck or t >= self._stalled_since:
            return math.copysign(self._strongest, (wanted - position) or wanted_velocity)
        friction = math.copysign(_GEAR_FRICTION * self._motor.stall_torque_nm, velocity) if velocity else 0.0
        return friction - self._load.torque(position)

    def current(self, t: float) -> float:
        """Current of the motor at `t` [A], with the sign of its torque."""
        return self.torque(t) / self._torque_constant

    def feel(self, t: float) -> tuple[float, float, float, float]:
        """At `t`: torque [N m], current [A], share of the full voltage (-1 to 1), and voltage at the connector [V]."""
        torque = self.torque(t)
        current = torque / self._torque_constant
        # the motor needs a share of the voltage for its speed, and one for its torque
        share = self.shaft.at(t)[1] / self.fastest + torque / self._motor.stall_torque_nm
        return torque, current, max(-1.0, min(1.0, share)) if self.on else 0.0, self.supply_v - _SUPPLY_OHM * abs(current)

    @property
    def _torque_constant(self) -> float:
        """[N m / A]"""
        return self._motor.stall_torque_nm / self._motor.stall_current_a

    def _torque_limit(self, effort: float, current: float) -> float:
        return min(effort * self._motor.stall_torque_nm, current * self._torque_constant)

    def _book(self, t: float) -> None:
        """A move began: its heat now, that of holding when it is over."""
        moving = 0.0 if self.shaft.done(t) else _GEAR_FRICTION * self._motor.stall_current_a
        self.heat.carry(t, max(moving, abs(self.current(t))) if self.on else 0.0)
        self._rests_at = min(self.shaft.ends(), self._stalled_since) if self.on else None


