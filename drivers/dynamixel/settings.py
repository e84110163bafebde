"""What a servo is to hold of an axis, in the servo's own units.

Pure arithmetic; it reads and sends nothing. `drivers.dynamixel.commissioning` writes it.

References: ROBOTIS e-manual, XM430-W350, PWM Limit (36), Current Limit (38), Velocity Limit (44)
(emanual.robotis.com/docs/en/dxl/x/xm430-w350): Velocity Limit bounds Profile Velocity; PWM Limit the output, and so the
torque, in all modes; Current Limit only modes that control the current, which gonio does not use.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from drivers.dynamixel import registers as reg
from drivers.dynamixel.joint import Joint
from gonio.errors import ConfigurationError


@dataclass(frozen=True)
class Settings:
    """What a servo is to hold.

    Attributes
    ----------
    model : ServoModel
        That it must be.
    low, high : int
        Position limits [counts].
    profile_velocity, profile_acceleration : int
        Registers 112 and 108; 0 would mean unlimited. The velocity is also the servo's own limit, register 44.
    current_limit : int or None
        Register 38 [the model's unit of current]; None leaves it as it is.
    pwm_limit : int or None
        Registers 36 and 100 [0.113 % of the supply]; None leaves them as they are.
    """

    model: reg.ServoModel
    low: int
    high: int
    profile_velocity: int
    profile_acceleration: int
    current_limit: int | None
    pwm_limit: int | None

    @property
    def current_limit_a(self) -> float | None:
        """Current limit as the servo counts it [A]."""
        unit = self.model.current_unit_a
        return None if self.current_limit is None or unit is None else self.current_limit * unit

    @property
    def pwm_share(self) -> float | None:
        """PWM limit as the servo counts it, 0 to 1."""
        return None if self.pwm_limit is None else self.pwm_limit / reg.FULL_PWM


def settings_of(
    joint: Joint, model: str, *, velocity: float, acceleration: float, current_limit: float | None,
    pwm_limit: float | None,
) -> Settings:  # fmt: skip
    """Settings of an axis, each the servo's next lower step.

    Parameters
    ----------
    joint : Joint
    model : str
        As on the label.
    velocity, acceleration : float
        [rad/s, rad/s^2]
    current_limit : float or None
        [A]
    pwm_limit : float or None
        Share of the supply, 0 to 1.

    Raises
    ------
    ConfigurationError
        If one is outside its range.
    """

    def refuse(text: str) -> ConfigurationError:
        return ConfigurationError(f"Axis {joint.name}: {text}.")

    if model not in reg.MODELS:
        raise refuse(f"model {model!r} is not known; one of {', '.join(reg.MODELS)}")
    if not velocity > 0.0 or not acceleration > 0.0:
        raise refuse(
            f"velocity {math.degrees(velocity):g} deg/s and acceleration {math.degrees(acceleration):g} deg/s^2 must be "
            "above 0 (0 would mean unlimited to the servo)"
        )
    known = reg.MODELS[model]
    current_counts = None
    if current_limit is not None:
        if known.current_unit_a is None:
            raise refuse(f"{model} has no current sensor, so no current limit; use pwm_limit")
        highest = known.current_unit_a * known.highest_current
        if not known.current_unit_a <= current_limit <= highest:
            raise refuse(f"current limit {current_limit:g} A is outside 0 to {highest:.2f} A of {model}")
        current_counts = int(current_limit / known.current_unit_a)
    if pwm_limit is not None and not 1.0 / reg.FULL_PWM <= pwm_limit <= 1.0:
        raise refuse(f"PWM limit {pwm_limit:g} is outside 0 to 1")
    return Settings(
        known,
        joint.low_counts,
        joint.high_counts,
        max(1, int(velocity / reg.VELOCITY_UNIT)),
        max(1, int(acceleration / reg.ACCELERATION_UNIT)),
        current_counts,
        None if pwm_limit is None else int(reg.FULL_PWM * pwm_limit),
    )
