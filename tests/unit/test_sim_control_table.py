"""The simulated control tables against those that the vendor ships with dynamixel-sdk 4.1.0."""

from __future__ import annotations

import math
from importlib.resources import files

import pytest

from sim.dynamixel.control_table import MODELS, Model

# In the manual's tables, and not in the vendor's files.
ONLY_IN_THE_MANUAL = {"Startup Configuration", "Backup Ready"}
# The XL330's table before firmware 52 has the indirect data of another series in the vendor's file, not in the manual.
VENDOR_FILES = {"XM430-W350": "xm430_w350", "XL430-W250": "xl430_w250", "XL330-M288": "xl330_m288_fw52"}

MANUAL = {
    "XM430-W350": {
        "Temperature Limit": (80, 0, 100), "Max Voltage Limit": (160, 95, 160), "Min Voltage Limit": (95, 95, 160),
        "Current Limit": (1193, 0, 1193), "Velocity Limit": (200, 0, 1023), "Velocity I Gain": (1920, 0, 16_383),
        "Velocity P Gain": (100, 0, 16_383), "Position D Gain": (0, 0, 16_383), "Position P Gain": (800, 0, 16_383),
        "Shutdown": (52, 0, 255), "Baud Rate": (1, 0, 7), "Profile Velocity": (0, 0, 32_767), "Bus Watchdog": (0, 0, 127),
        "Goal Position": (0, -1_048_575, 1_048_575), "Homing Offset": (0, -1_044_479, 1_044_479), "ID": (1, 0, 252),
        "Return Delay Time": (250, 0, 254), "Moving Threshold": (10, 0, 1023), "PWM Limit": (885, 0, 885),
    },
    "XL430-W250": {
        "Temperature Limit": (72, 0, 100), "Max Voltage Limit": (140, 60, 140), "Min Voltage Limit": (60, 60, 140),
        "Velocity Limit": (265, 0, 1023), "Velocity I Gain": (1000, 0, 16_383), "Position D Gain": (4000, 0, 16_383),
        "Position P Gain": (640, 0, 16_383), "Shutdown": (52, 0, 255), "Baud Rate": (1, 0, 7),
    },
    "XL330-M288": {
        "Temperature Limit": (70, 0, 100), "Max Voltage Limit": (70, 31, 70), "Min Voltage Limit": (35, 31, 70),
        "Current Limit": (1750, 0, 1750), "Velocity Limit": (445, 0, 2047), "Velocity I Gain": (1600, 0, 16_383),
        "Velocity P Gain": (180, 0, 16_383), "Position P Gain": (400, 0, 16_383), "Shutdown": (53, 0, 255),
        "Baud Rate": (1, 0, 6), "PWM Slope": (140, 0, 255), "Indirect Address 1": (208, 64, 227),
    },
}  # fmt: skip


def _vendor_table(name: str) -> dict[str, tuple[int, int]]:
    text = files("dynamixel_easy_sdk").joinpath("control_table", f"{name}.model").read_text()
    rows = [line.split("\t") for line in text.split("[control table]")[1].splitlines()[2:] if line.strip()]
    table = {row[2].strip(): (int(row[0]), int(row[1])) for row in rows}
    return {name: place for name, place in table.items() if not name.endswith((" Write", " Read"))}


@pytest.mark.parametrize("model", MODELS.values(), ids=list(MODELS))
def test_addresses_and_sizes_are_the_vendors(model: Model) -> None:
    vendor = _vendor_table(VENDOR_FILES[model.name])
    ours = {r.name: (r.address, r.size) for r in model.registers if not r.name.startswith("Indirect")}
    ours |= {name: (model.by_name[name].address, model.by_name[name].size) for name in vendor if name.startswith("Indirect")}
    assert set(ours) - set(vendor) == ONLY_IN_THE_MANUAL
    assert {name: ours[name] for name in vendor} == vendor


@pytest.mark.parametrize("model", MODELS.values(), ids=list(MODELS))
def test_registers_do_not_overlap_and_defaults_are_allowed(model: Model) -> None:
    assert sum(register.size for register in model.registers) == len(model.covering)
    for register in model.registers:
        if register.writable:
            assert register.lower <= register.default <= register.upper, register.name


@pytest.mark.parametrize("model", MODELS.values(), ids=list(MODELS))
def test_units_and_signs_are_the_vendors(model: Model) -> None:
    """The vendor's files give the scale of velocities and currents; theirs is 0.2289 rev/min where the manual says 0.229."""
    text = files("dynamixel_easy_sdk").joinpath("control_table", f"{VENDOR_FILES[model.name]}.model").read_text()
    rows = text.split("[unit info]")[1].split("[control table]")[0].splitlines()[2:]
    seen = 0
    for name, value, unit, sign in (row.split("\t") for row in rows if row.strip()):
        register = model.by_name[name]
        assert register.signed == (sign == "signed"), name
        if unit == "rad/s":
            assert register.unit[0] * 2 * math.pi / 60 == pytest.approx(float(value), rel=1e-3), name
            seen += 1
    assert seen >= 2


def test_every_quantity_has_its_unit() -> None:
    """Numbers with a unit in the manual's tables; codes, bits and gains have none."""
    wanted = {"Return Delay Time": "us", "Goal Position": "deg", "Present Input Voltage": "V", "Profile Velocity": "rev/min"}
    for model in MODELS.values():
        assert {name: model.by_name[name].unit[1] for name in wanted} == wanted
        assert model.by_name["Operating Mode"].unit == (1.0, "")
        for name in ("Goal Position", "Present Position", "Position Trajectory", "Homing Offset"):
            assert model.by_name[name].unit[0] * 4096 == 360.0


@pytest.mark.parametrize(("name", "rows"), MANUAL.items(), ids=list(MANUAL))
def test_defaults_and_ranges_of_the_manual(name: str, rows: dict[str, tuple[int, int, int]]) -> None:
    """Initial value and range of each register in which the models differ, from the tables of the three pages."""
    registers = MODELS[name].by_name
    assert {key: (registers[key].default, registers[key].lower, registers[key].upper) for key in rows} == rows


def test_access_of_the_manual() -> None:
    read_only = {
        "Model Number", "Model Information", "Firmware Version", "Registered Instruction", "Hardware Error Status",
        "Realtime Tick", "Moving", "Moving Status", "Present PWM", "Present Current", "Present Load", "Present Velocity",
        "Present Position", "Velocity Trajectory", "Position Trajectory", "Present Input Voltage", "Present Temperature",
        "Backup Ready",
    }  # fmt: skip
    for model in MODELS.values():
        assert {r.name for r in model.registers if not r.writable} == read_only & set(model.by_name)


def test_numbers_of_the_manual() -> None:
    """Model numbers, defaults and the second block of indirect addresses, from the manual's tables."""
    assert [model.number for model in MODELS.values()] == [1020, 1060, 1200]
    xm430 = MODELS["XM430-W350"]
    defaults = {"Return Delay Time": 250, "Shutdown": 52, "Position P Gain": 800, "Velocity Limit": 200}
    assert {name: xm430.by_name[name].default for name in defaults} == defaults
    assert (xm430.by_name["Indirect Address 56"].address, xm430.by_name["Indirect Address 56"].default) == (632, 661)
    assert xm430.by_name["Indirect Data 56"].address == 661
