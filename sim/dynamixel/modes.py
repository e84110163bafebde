"""Operating and drive modes: each one's goal and the way there, what a register may hold, and what the readings say.

Functions of a control table and a drive; when they apply is the business of `sim.dynamixel.servo`.

References
----------
ROBOTIS e-Manual, XM430-W350, "Drive Mode(10)", "Operating Mode(11)", "Moving Status(123)" and the goals' descriptions.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from sim.dynamixel import motion
from sim.dynamixel.control_table import Model, Register
from sim.dynamixel.drive import Drive
from sim.dynamixel.memory import Memory, Refused
from sim.dynamixel.motion import ACCELERATION_UNIT, COUNTS_PER_TURN, VELOCITY_UNIT
from sim.dynamixel.packet import ErrorNumber

CURRENT, VELOCITY, POSITION, EXTENDED, CURRENT_POSITION, PWM = 0, 1, 3, 4, 5, 16  # operating modes
GOAL_OF_MODE = {CURRENT: 102, VELOCITY: 104, POSITION: 116, EXTENDED: 116, CURRENT_POSITION: 116, PWM: 100}
REVERSE, TIME_BASED, TORQUE_BY_GOAL = 1, 4, 8  # bits of Drive Mode
FULL_PWM = 885

IN_POSITION_COUNTS = 16  # "smaller than a predefined value", the manual says; it does not say which
FOLLOWING_ERROR_COUNTS = 64  # as little known
_TIME_BASED_FIRMWARE = 42
_SHAPE_BITS = {"step": 0, "rectangle": 1, "triangle": 2, "trapezoid": 3}
_LIMITS = {100: "PWM Limit", 102: "Current Limit", 104: "Velocity Limit"}


def sign(memory: Memory) -> int:
    """-1 in reverse mode, else 1: direction of the readings against the shaft's."""
    return -1 if memory["Drive Mode"] & REVERSE else 1


def homing_offset(memory: Memory) -> int:
    """Homing Offset, which position mode ignores beyond a quarter turn, and reverse mode does not turn."""
    offset = memory["Homing Offset"]
    beyond = memory["Operating Mode"] == POSITION and abs(offset) > COUNTS_PER_TURN // 4
    return 0 if beyond else offset


def initial_goals(memory: Memory) -> None:
    """What a mode begins with: no goal of its own kind, and no bound of effort or current but the user's limits."""
    mode = memory["Operating Mode"]
    memory["Goal PWM"] = memory["PWM Limit"] if mode != PWM else 0
    if "Goal Current" in memory:
        memory["Goal Current"] = memory["Current Limit"] if mode != CURRENT else 0


def check(memory: Memory, model: Model, firmware: int, register: Register, value: int) -> None:
    """Refuse a value that the register may not have, as things are.

    Raises
    ------
    Refused
        Data Range, Data Limit, or Result Fail for torque after a shutdown.
    """
    address = register.address
    one_turn = address == 116 and memory["Operating Mode"] == POSITION
    if not register.lower <= value <= register.upper:
        # What lies outside the limits that the user set, and inside those of the table, is a Data Limit error.
        raise Refused(ErrorNumber.DATA_LIMIT if one_turn else ErrorNumber.DATA_RANGE)
    if address in GOAL_OF_MODE.values() and memory["Bus Watchdog"] < 0:
        raise Refused(ErrorNumber.DATA_RANGE)
    if address == 11 and value not in model.operating_modes:
        raise Refused(ErrorNumber.DATA_RANGE)
    if address == 10:
        known = REVERSE | (TIME_BASED if firmware >= _TIME_BASED_FIRMWARE else 0)
        known |= TORQUE_BY_GOAL if firmware >= model.newer_firmware else 0
        if value & ~known:
            raise Refused(ErrorNumber.DATA_RANGE)
    if address == 64 and value == 1 and memory["Hardware Error Status"] & memory["Shutdown"]:
        raise Refused(ErrorNumber.RESULT_FAIL)  # shut down; only a reboot restores torque
    lower, upper = register.lower, register.upper
    if one_turn:
        lower, upper = memory["Min Position Limit"], memory["Max Position Limit"]
    elif address in _LIMITS:
        upper = memory[_LIMITS[address]]
        lower = -upper
    if not lower <= value <= upper:
        raise Refused(ErrorNumber.DATA_LIMIT)


def start(memory: Memory, drive: Drive, model: Model, fold: int, t: float) -> None:
    """Start towards the goal of the operating mode.

    Parameters
    ----------
    memory : Memory
    drive : Drive
    model : Model
    fold : int
        Counts of whole turns that the registers leave out.
    t : float
        [s]
    """
    mode = memory["Operating Mode"]
    unit = model.motor.current_unit_a or 0.0
    effort = 1.0 if mode == PWM else abs(memory["Goal PWM"]) / FULL_PWM
    current = abs(memory["Goal Current"]) * unit if mode in (CURRENT, CURRENT_POSITION) else math.inf
    acceleration = memory["Profile Acceleration"] * ACCELERATION_UNIT or math.inf
    if mode == VELOCITY:
        goal_velocity = sign(memory) * memory["Goal Velocity"] * VELOCITY_UNIT
        drive.spin(t, goal_velocity, acceleration, effort=effort, current=current)
    elif mode == PWM:
        share = sign(memory) * memory["Goal PWM"] / FULL_PWM
        drive.spin(t, share * drive.fastest, math.inf, effort=abs(share), current=current)
    elif mode == CURRENT:
        direction = sign(memory) * (memory["Goal Current"] > 0) - sign(memory) * (memory["Goal Current"] < 0)
        drive.spin(t, direction * effort * drive.fastest, math.inf, effort=effort, current=current)
    else:
        goal = sign(memory) * (memory["Goal Position"] - homing_offset(memory) + fold)
        velocity = memory["Profile Velocity"] * VELOCITY_UNIT or math.inf
        if memory["Drive Mode"] & TIME_BASED:
            distance = goal - drive.trajectory.at(t)[0]
            velocity, acceleration = motion.limits_of_times(
                distance, 1e-3 * memory["Profile Velocity"], 1e-3 * memory["Profile Acceleration"]
            )
        stiffness = math.inf if memory["Position I Gain"] else memory["Position P Gain"] / 128.0 / FULL_PWM
        drive.go(t, goal, velocity, acceleration, stiffness=stiffness, effort=effort, current=current)


def refresh(memory: Memory, drive: Drive, model: Model, reading: Callable[[float], int], t: float) -> None:
    """Bring the registers that change by themselves up to date.

    Parameters
    ----------
    memory : Memory
    drive : Drive
    model : Model
    reading : callable
        Counts of the shaft as the registers have them.
    t : float
        [s]
    """
    torque_on, mode, direction = memory["Torque Enable"] != 0, memory["Operating Mode"], sign(memory)
    position, velocity = drive.shaft.at(t)
    present, goal = reading(position), memory["Goal Position"]
    wanted, wanted_velocity = drive.trajectory.at(t)
    ongoing, following, status = False, present, 0
    if GOAL_OF_MODE[mode] == 116:
        ongoing = not drive.trajectory.done(t)
        following = reading(wanted)
        status = int(torque_on and not ongoing and abs(goal - present) <= IN_POSITION_COUNTS)
        status |= int(ongoing) << 1
        status |= int(torque_on and abs(following - present) > FOLLOWING_ERROR_COUNTS) << 3
    if mode in (CURRENT, PWM):
        wanted_velocity = 0.0
    else:
        status |= _SHAPE_BITS[drive.trajectory.shape] << 4
    speed = direction * round(velocity / VELOCITY_UNIT)
    torque, current, effort, voltage = drive.feel(t)
    if model.motor.current_unit_a is None:
        memory["Present Load"] = direction * round(1000.0 * torque / model.motor.stall_torque_nm)
    else:
        memory["Present Current"] = direction * round(current / model.motor.current_unit_a)
    memory["Realtime Tick"] = int(t * 1000.0) & 0x7FFF
    memory["Moving"] = int(ongoing or abs(speed) > memory["Moving Threshold"])
    memory["Moving Status"] = status
    memory["Present PWM"] = direction * round(FULL_PWM * effort)
    memory["Present Velocity"] = speed
    memory["Present Position"] = present
    memory["Velocity Trajectory"] = direction * round(wanted_velocity / VELOCITY_UNIT)
    memory["Position Trajectory"] = following
    memory["Present Input Voltage"] = round(10.0 * voltage)
    memory["Present Temperature"] = min(round(drive.heat.at(t)), 255)
    memory["Backup Ready"] = int(memory.backed_up)
