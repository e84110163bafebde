"""Every register of a servo, by the control tables that the vendor's SDK brings with it.

For a full listing only: what gonio writes stands in `drivers.dynamixel.registers`. The SDK's tables have addresses, sizes
and names; signs are known of the registers that gonio knows, and of those that the tables give a signed unit.

References: dynamixel_easy_sdk/control_table/*.model in dynamixel-sdk.
"""

from __future__ import annotations

import importlib.resources
import re

from drivers.dynamixel import registers as reg
from drivers.dynamixel.bus import Bus
from gonio.errors import DeviceError, DeviceTimeoutError, ProtocolError

_KNOWN = {value.address: value for value in vars(reg).values() if isinstance(value, reg.Register)}


def registers_of(model: str) -> list[reg.Register]:
    """All registers of a model, as on its label, by address.

    Raises
    ------
    DeviceError
        If the installed SDK has no table of that model.
    """
    name = model.lower().replace("-", "_") + ".model"
    try:
        text = (importlib.resources.files("dynamixel_easy_sdk") / "control_table" / name).read_text(encoding="utf-8")
    except (ModuleNotFoundError, FileNotFoundError):
        raise DeviceError(
            f"the installed dynamixel-sdk has no control table of {model} ({name}); install dynamixel-sdk 4.1.0 or newer"
        ) from None
    sections = dict(re.findall(r"^\[(.+?)\]\n(.*?)(?=^\[|\Z)", text, re.MULTILINE | re.DOTALL))
    rows = [line.split("\t") for line in sections.get("unit info", "").splitlines()]
    signed = {row[0] for row in rows if len(row) >= 4 and row[3].strip() == "signed"}
    found = {register.address: register for register in _KNOWN.values()}
    for line in sections["control table"].splitlines()[1:]:
        cells = [cell.strip() for cell in line.split("\t")]
        if len(cells) >= 3 and cells[0].isdigit() and int(cells[0]) not in found:
            address, size, title = int(cells[0]), int(cells[1]), cells[2]
            found[address] = reg.Register(title, address, size, signed=title in signed)
    return [found[address] for address in sorted(found)]


def dump(bus: Bus, servo_id: int, model: str) -> dict[str, int | str]:
    """Value of every register of a servo by name; of one that it does not have, ``refused``."""
    values: dict[str, int | str] = {}
    for register in registers_of(model):
        try:
            values[register.name] = bus.read(servo_id, register)
        except (DeviceTimeoutError, ProtocolError):
            raise
        except DeviceError:
            values[register.name] = "refused"
    return values
