"""A host at a simulated bus, by bytes and with time in its hand; shared by the tests of the simulated servos."""

from __future__ import annotations

from sim.dynamixel import DynamixelBus, Fault, Servo
from sim.dynamixel.packet import Instruction, Packet, Parser, encode

ID, RETURN_DELAY, MODE, SHADOW_ID, HOMING_OFFSET, MAX_POSITION, MIN_POSITION = 7, 9, 11, 12, 20, 48, 52
TORQUE, LED, RETURN_LEVEL, REGISTERED, HARDWARE_ERROR, WATCHDOG = 64, 65, 68, 69, 70, 98
PROFILE_ACCELERATION, PROFILE_VELOCITY, GOAL, MOVING, MOVING_STATUS, VELOCITY, POSITION = 108, 112, 116, 122, 123, 128, 132
SIZES = dict.fromkeys((HOMING_OFFSET, 44, MAX_POSITION, MIN_POSITION, 104, PROFILE_ACCELERATION, PROFILE_VELOCITY, GOAL), 4)
SIZES |= dict.fromkeys((32, 34, 36, 38, 80, 82, 84, 100, 102), 2)
RESULT_FAIL, INSTRUCTION, CRC, DATA_RANGE, DATA_LENGTH, DATA_LIMIT, ACCESS = range(1, 8)


class Host:
    """A host at a bus, with time in its hand."""

    def __init__(self, *servos: Servo, faults: tuple[Fault, ...] = ()) -> None:
        self.bus = DynamixelBus(servos or (Servo(1),), faults)
        self.t = 0.0

    def send(self, id: int, instruction: int, params: bytes = b"") -> list[Packet]:
        frames = self.bus.feed(encode(id, instruction, params), self.t)
        found = Parser().receive(b"".join(data for _, data in frames))
        assert all(isinstance(packet, Packet) for packet in found)
        return [packet for packet in found if isinstance(packet, Packet)]

    def write(self, address: int, value: int, id: int = 1) -> int | None:
        """The error byte, or None without an answer."""
        data = value.to_bytes(SIZES.get(address, 1), "little", signed=value < 0)
        answers = self.send(id, Instruction.WRITE, address.to_bytes(2, "little") + data)
        return answers[0].params[0] if answers else None

    def read(self, address: int, length: int, id: int = 1, signed: bool = False) -> int:
        answers = self.send(id, Instruction.READ, address.to_bytes(2, "little") + length.to_bytes(2, "little"))
        assert answers[0].params[0] & 0x7F == 0
        return int.from_bytes(answers[0].params[1:], "little", signed=signed)

    def position(self, id: int = 1) -> int:
        return self.read(POSITION, 4, id, signed=True)

    def move(self, goal: int, seconds: float = 10.0, id: int = 1) -> None:
        assert self.write(GOAL, goal, id) == 0
        self.t += seconds
