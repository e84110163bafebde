"""The bytes of a control table: values by name, writes split into registers, indirect addresses, the backup area.

It knows what may be accessed and nothing of what a value does.
"""

from __future__ import annotations

from sim.dynamixel.control_table import Model, Register
from sim.dynamixel.packet import ErrorNumber

_BACKED_UP = (
    "Velocity I Gain", "Velocity P Gain", "Position D Gain", "Position I Gain", "Position P Gain", "Feedforward 2nd Gain",
    "Feedforward 1st Gain", "Profile Acceleration", "Profile Velocity",
)  # fmt: skip


class Refused(Exception):
    """Not an error of ours: the servo answers with an error number."""

    def __init__(self, number: ErrorNumber) -> None:
        super().__init__(number.name)
        self.number = number


class Memory:
    """A control table with its values.

    Parameters
    ----------
    model : Model
    firmware : int
        Registers of later firmware do not exist.
    """

    def __init__(self, model: Model, firmware: int) -> None:
        self._model = model
        self._covering = {a: r for a, r in model.covering.items() if r.since <= firmware}
        self._values = {register.name: register.default for register in model.registers}
        self._layouts: dict[tuple[int, int], list[Register] | None] = {}
        self._backup: dict[Register, int] = {}
        self["Firmware Version"] = firmware

    def __getitem__(self, name: str) -> int:
        return self._values[name]

    def __setitem__(self, name: str, value: int) -> None:
        self._values[name] = value

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def read(self, address: int, length: int) -> bytes:
        """Bytes from `address` on; bits of a value that do not fit its register are cut off.

        Raises
        ------
        Refused
            Access, if a byte is not defined; Data Length, if none is asked for.
        """
        if length < 1:
            raise Refused(ErrorNumber.DATA_LENGTH)
        key = (address, length)
        if key not in self._layouts:
            self._layouts[key] = self._layout(address, length)
        whole = self._layouts[key]
        if whole is not None:
            return b"".join(
                (self._values[r.name] & ((1 << 8 * r.size) - 1)).to_bytes(r.size, "little") for r in whole
            )
        where = [self._resolve(a) for a in range(address, address + length)]
        if any(a not in self._covering for a in where):
            raise Refused(ErrorNumber.ACCESS)
        found = bytearray()
        for a in where:
            register = self._covering[a]
            found.append(self._values[register.name] >> 8 * (a - register.address) & 0xFF)
        return bytes(found)

    def _layout(self, address: int, length: int) -> list[Register] | None:
        """The registers that fill these bytes exactly, if there are such and none stands for another."""
        found, at = [], address
        while at < address + length:
            register = self._model.at.get(at)
            if register is None or at not in self._covering or register.name.startswith("Indirect Data"):
                return None
            found.append(register)
            at += register.size
        return found if at == address + length else None

    def items(self, address: int, data: bytes, *, eeprom: bool) -> list[tuple[Register, int]]:
        """Split a write into registers and values.

        Raises
        ------
        Refused
            Access, for what is not defined, read-only, or in the EEPROM where `eeprom` is locked; Data Length, for a
            part of a register or none.
        """
        if not data:
            raise Refused(ErrorNumber.DATA_LENGTH)
        where = [self._resolve(a) for a in range(address, address + len(data))]
        items = []
        k = 0
        while k < len(data):
            register = self._covering.get(where[k])
            if register is None or not register.writable or (register.eeprom and not eeprom):
                raise Refused(ErrorNumber.ACCESS)
            wanted = list(range(register.address, register.address + register.size))
            if where[k : k + register.size] != wanted:
                raise Refused(ErrorNumber.DATA_LENGTH)
            items.append((register, int.from_bytes(data[k : k + register.size], "little", signed=register.signed)))
            k += register.size
        return items

    def back_up(self) -> None:
        """Keep the EEPROM and those RAM values that the manual names."""
        self._backup = {
            r: self._values[r.name]
            for r in self._model.registers
            if r.writable and (r.eeprom or r.name in _BACKED_UP or r.name.startswith("Indirect Address"))
        }

    @property
    def backed_up(self) -> bool:
        """Whether there is a backup."""
        return bool(self._backup)

    def restore(self, *, eeprom: bool) -> None:
        """Bring back what was kept of the EEPROM, or of the RAM."""
        for register, value in self._backup.items():
            if register.eeprom is eeprom:
                self._values[register.name] = value

    def _resolve(self, address: int) -> int:
        """Follow an indirect address to the byte that it stands for."""
        for block in self._model.indirect:
            if block.data <= address < block.data + block.count:
                slot = block.address + 2 * (address - block.data)
                return self._values[self._model.at[slot].name]
        return address
