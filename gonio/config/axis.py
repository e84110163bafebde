"""One axis of a rig: its servo, its range and its way of moving; ``[axes.NAME]`` in rig.toml."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from gonio.config.reader import Table

COUNTS_PER_TURN = 4096
MODELS = ("XM430-W350", "XL430-W250", "XL330-M288")


@dataclass(frozen=True)
class AxisConfig:
    """One axis.

    Attributes
    ----------
    name, model : str
    id, zero_counts, direction : int
        Joint angle = direction * (counts - zero_counts) * 2 pi / 4096.
    lower, upper, velocity, acceleration : float
        [rad], [rad/s], [rad/s^2].
    approach : str
        ``"up"``: the final approach is always with increasing joint angle; ``"down"``; ``"any"``.
    overshoot : float
        How far the first leg of a two-leg approach goes beyond the goal [rad].
    tolerance_counts : int
        How far from its goal the servo may come to rest; the measured angle is used, never the goal.
    u_zero : float
        Standard uncertainty of the axis' zero [rad].
    current_limit_a : float or None
        More current than this during a move stops it [A]; None for no such limit.
    pwm_limit : float or None
        Share of the supply that the servo may use; None leaves the servo's own setting.
    """

    name: str
    id: int
    model: str
    zero_counts: int
    direction: int
    lower: float
    upper: float
    velocity: float
    acceleration: float
    approach: Literal["up", "down", "any"]
    overshoot: float
    tolerance_counts: int
    u_zero: float
    current_limit_a: float | None = None
    pwm_limit: float | None = None

    def angle(self, counts: float) -> float:
        """Joint angle [rad] at a position of the servo."""
        return self.direction * (counts - self.zero_counts) * 2 * math.pi / COUNTS_PER_TURN


def read_axis(table: Table, name: str) -> AxisConfig:
    """The axis that ``[axes.NAME]`` describes; problems go to the document of the table."""
    config = AxisConfig(
        name=name,
        id=table.integer("id", lower=0, upper=252),
        model=table.text("model", "XM430-W350", choices=MODELS),
        zero_counts=table.integer("zero_counts", 2048, lower=0, upper=COUNTS_PER_TURN - 1, unit="counts"),
        direction=table.integer("direction", 1, lower=-1, upper=1),
        lower=table.angle("lower_deg", lower=-180.0, upper=180.0),
        upper=table.angle("upper_deg", lower=-180.0, upper=180.0),
        velocity=math.radians(table.number("velocity_deg_s", 60.0, above=0.0, upper=1000.0, unit="degrees/s")),
        acceleration=math.radians(table.number("acceleration_deg_s2", 300.0, above=0.0, upper=1e5, unit="degrees/s^2")),
        approach=table.text("approach", "up", choices=("up", "down", "any")),  # type: ignore[arg-type]
        overshoot=table.angle("overshoot_deg", 2.0, lower=1.0, upper=20.0),
        tolerance_counts=table.integer("tolerance_counts", 12, lower=1, upper=200, unit="counts"),
        u_zero=table.angle("u_zero_deg", 0.1, lower=0.0, upper=10.0),
        current_limit_a=(
            table.number("current_limit_a", above=0.0, upper=6.0, unit="A") if "current_limit_a" in table else None
        ),
        pwm_limit=table.number("pwm_limit", lower=0.01, upper=1.0) if "pwm_limit" in table else None,
    )
    table.finish()
    if config.direction == 0:
        table.report("direction", "= 0 turns nowhere; write 1 or -1")
        return config
    if not config.lower < config.upper:
        table.report(
            "lower_deg", f"= {math.degrees(config.lower):g} must be below upper_deg = {math.degrees(config.upper):g}"
        )
    overshoot_counts = config.overshoot * COUNTS_PER_TURN / (2 * math.pi)
    if config.approach != "any" and not overshoot_counts > config.tolerance_counts:
        table.report(
            "overshoot_deg",
            f"= {math.degrees(config.overshoot):g} is {overshoot_counts:.0f} counts; it must exceed tolerance_counts = "
            f"{config.tolerance_counts}, or the last approach would not come from one side",
        )
    ends = sorted(
        config.zero_counts + config.direction * a * COUNTS_PER_TURN / (2 * math.pi) for a in (config.lower, config.upper)
    )
    if ends[0] < 0 or ends[1] > COUNTS_PER_TURN - 1:
        table.report(
            "zero_counts",
            f"= {config.zero_counts} puts the limits at {ends[0]:.0f} and {ends[1]:.0f} counts; the servo has 0 to "
            f"{COUNTS_PER_TURN - 1}, so narrow the limits or mount the horn elsewhere",
        )
    return config
