"""The simulated control tables against those that the vendor ships with dynamixel-sdk 4.1.0."""

from __future__ import annotations

from importlib.resources import files

import pytest

from sim.dynamixel.control_table import MODELS, Model

# In the manual's tables, and not in the vendor's files.
ONLY_IN_THE_MANUAL = {"Startup Configuration", "Backup Ready"}
# The XL330's table before firmware 52 has the indirect data of another series in the vendor's file, not in the manual.
VENDOR_FILES = {"XM430-W350": "xm430_w350", "XL430-W250": "xl430_w250", "XL330-M288": "xl330_m288_fw52"}


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


def test_numbers_of_the_manual() -> None:
    """Model numbers, defaults and the second block of indirect addresses, from the manual's tables."""
    assert [model.number for model in MODELS.values()] == [1020, 1060, 1200]
    xm430 = MODELS["XM430-W350"]
    defaults = {"Return Delay Time": 250, "Shutdown": 52, "Position P Gain": 800, "Velocity Limit": 200}
    assert {name: xm430.by_name[name].default for name in defaults} == defaults
    assert (xm430.by_name["Indirect Address 56"].address, xm430.by_name["Indirect Address 56"].default) == (632, 661)
    assert xm430.by_name["Indirect Data 56"].address == 661
