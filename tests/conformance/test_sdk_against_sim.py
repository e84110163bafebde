"""The vendor's SDK, as it comes, talks to the simulated servos: on a pseudo-terminal, over TCP and on a virtual clock.

The SDK's protocol code is unmodified in all. On the pseudo-terminal and over TCP only its module constant for the USB
latency is raised, as its users do, so that a busy machine is no missing servo; for TCP a port subclass opens the URL,
which the SDK's own cannot. On ``sim://`` a port subclass opens the URL and takes its time from the virtual clock.
"""

from __future__ import annotations

import functools
import inspect
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import dynamixel_sdk as sdk
import pytest
import serial
from dynamixel_sdk import port_handler

from sim.clock import ScaledClock, VirtualClock
from sim.dynamixel import DynamixelBus, Servo
from sim.links import PtyLink, Pump, TcpLink
from sim.port import attach, detach

OK, TIMEOUT = sdk.COMM_SUCCESS, sdk.COMM_RX_TIMEOUT


class VirtualPort(sdk.PortHandler):  # type: ignore[misc]
    """The SDK's port on a simulation's URL and clock."""

    def __init__(self, url: str, clock: VirtualClock) -> None:
        super().__init__(url)
        self.clock = clock

    def setupPort(self, cflag_baud: int) -> bool:
        self.ser = serial.serial_for_url(self.port_name, baudrate=self.baudrate, timeout=0)
        self.is_open = True
        self.tx_time_per_byte = 10_000.0 / self.baudrate
        return True

    def getCurrentTime(self) -> float:
        return self.clock.now() * 1e3

    def setPacketTimeout(self, packet_length: int) -> None:
        self.setPacketTimeoutMillis(self.tx_time_per_byte * packet_length + 34.0)


@dataclass
class Line:
    """The SDK's two objects, the bus behind them, and a way to let rig time pass."""

    port: Any
    packets: Any
    bus: DynamixelBus
    wait: Callable[[float], None]


def _bus() -> DynamixelBus:
    return DynamixelBus([Servo(id, initial_counts=1000.0 * id, seed=1) for id in (1, 2, 3)])


def _virtual() -> Iterator[Line]:
    clock, bus = VirtualClock(), _bus()
    port = VirtualPort(attach("conformance", bus, clock), clock)
    assert port.openPort()
    yield Line(port, sdk.PacketHandler(2.0), bus, clock.sleep)
    port.closePort()
    detach("conformance")


class TcpPort(sdk.PortHandler):  # type: ignore[misc]
    """The SDK's port on a URL."""

    def setupPort(self, cflag_baud: int) -> bool:
        self.ser = serial.serial_for_url(self.port_name, baudrate=self.baudrate, timeout=0)
        self.is_open = True
        self.tx_time_per_byte = 10_000.0 / self.baudrate
        return True


def _served(monkeypatch: pytest.MonkeyPatch, kind: str) -> Iterator[Line]:
    if kind == "terminal" and sys.platform == "win32":
        pytest.skip("no pseudo-terminals")
    monkeypatch.setattr(port_handler, "LATENCY_TIMER", 500.0)
    clock, bus = ScaledClock(40.0), _bus()
    link = PtyLink(bus, clock) if kind == "terminal" else TcpLink(bus, clock)
    pump, stop = Pump(link), threading.Event()
    thread = threading.Thread(target=pump.run, args=(stop.is_set, 0.01))
    thread.start()
    port = TcpPort("socket://{}:{}".format(*link.address)) if isinstance(link, TcpLink) else sdk.PortHandler(link.path)
    try:
        assert port.openPort()
        yield Line(port, sdk.PacketHandler(2.0), bus, clock.sleep)
        port.closePort()
    finally:
        stop.set()
        thread.join()
        pump.close()


@pytest.fixture(params=["virtual", "terminal", "tcp"])
def line(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Line]:
    yield from _virtual() if request.param == "virtual" else _served(monkeypatch, request.param)


def word(value: int, size: int = 4) -> list[int]:
    return list(value.to_bytes(size, "little"))


API = (type(sdk.PacketHandler(2.0)), sdk.GroupSyncRead, sdk.GroupSyncWrite, sdk.GroupBulkRead, sdk.GroupBulkWrite)


@pytest.fixture
def uncalled(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Names of all methods of the SDK's classes; each leaves the set when it is called."""
    names = set()
    for owner in API:
        for name, method in inspect.getmembers(owner, inspect.isfunction):
            full = f"{owner.__name__}.{name}"
            names.add(full)

            def counted(*args: Any, _method: Any = method, _full: str = full, **kwargs: Any) -> Any:
                names.discard(_full)
                return _method(*args, **kwargs)

            monkeypatch.setattr(owner, name, functools.wraps(method)(counted))
    return names


def test_the_whole_api(uncalled: set[str], line: Line) -> None:
    """Rationale: every call that the SDK offers, with the value or the effect that the manual promises."""
    packets, port = line.packets, line.port
    packets.__init__()
    assert packets.getProtocolVersion() == 2.0
    assert packets.getTxRxResult(OK) and packets.getRxPacketError(sdk.ERRNUM_ACCESS)
    assert packets.ping(port, 1) == (1020, OK, 0)
    assert packets.broadcastPing(port) == ({id: [1020, 46] for id in (1, 2, 3)}, OK)

    def fetch_status() -> None:
        """Of a write for which the SDK does not wait."""
        port.setPacketTimeout(11)
        assert packets.rxPacket(port, False)[1] == OK

    # one servo, all widths, whole or in two halves
    assert packets.writeTxRx(port, 1, 112, 4, word(7)) == (OK, 0)
    assert packets.readTxRx(port, 1, 112, 4) == (word(7), OK, 0)
    assert packets.readTx(port, 1, 112, 4) == OK and packets.readRx(port, 1, 4) == (word(7), OK, 0)
    for size, address, value in ((1, 65, 1), (2, 84, 850), (4, 108, 9)):
        assert getattr(packets, f"write{size}ByteTxRx")(port, 1, address, value) == (OK, 0)
        assert getattr(packets, f"read{size}ByteTxRx")(port, 1, address) == (value, OK, 0)
        assert getattr(packets, f"write{size}ByteTxOnly")(port, 1, address, value - 1) == OK
        fetch_status()
        assert getattr(packets, f"read{size}ByteTx")(port, 1, address) == OK
        assert getattr(packets, f"read{size}ByteRx")(port, 1) == (value - 1, OK, 0)
    assert packets.writeTxOnly(port, 1, 65, 1, [1]) == OK
    fetch_status()
    assert packets.regWriteTxOnly(port, 1, 65, 1, [0]) == OK
    fetch_status()
    assert packets.regWriteTxRx(port, 1, 65, 1, [0]) == (OK, 0)
    assert packets.action(port, 1) == OK
    fetch_status()  # the SDK does not wait for that one either
    assert packets.read1ByteTxRx(port, 1, 65) == (0, OK, 0)
    assert packets.clearMultiTurn(port, 1) == (OK, 0)
    # many at once
    write = sdk.GroupSyncWrite(port, packets, 112, 4)
    assert write.addParam(1, word(1)) and write.addParam(2, word(2)) and write.addParam(3, word(3))
    assert write.changeParam(2, word(22))
    write.removeParam(3)
    assert write.txPacket() == OK
    write.clearParam()
    many = sdk.GroupBulkWrite(port, packets)
    assert many.addParam(1, 84, 2, word(700, 2)) and many.addParam(2, 65, 1, [1]) and many.addParam(3, 65, 1, [1])
    assert many.changeParam(3, 112, 4, word(33))
    assert many.txPacket() == OK
    many.removeParam(1)
    many.clearParam()
    read = sdk.GroupSyncRead(port, packets, 112, 4)
    assert all(read.addParam(id) for id in (1, 2, 3))
    for ask in (read.txRxPacket, read.fastSyncRead):
        assert ask() == OK
        assert [read.getData(id, 112, 4) for id in (1, 2, 3) if read.isAvailable(id, 112, 4)] == [1, 22, 33]
    assert (read.txPacket(), read.rxPacket(), read.fastSyncReadTxPacket(), read.fastSyncReadRxPacket()) == (OK,) * 4
    read.removeParam(1)
    read.clearParam()
    bulk = sdk.GroupBulkRead(port, packets)
    assert bulk.addParam(1, 84, 2) and bulk.addParam(2, 65, 1)
    for ask in (bulk.txRxPacket, bulk.fastBulkRead):
        assert ask() == OK
        assert bulk.isAvailable(1, 84, 2) and (bulk.getData(1, 84, 2), bulk.getData(2, 65, 1)) == (700, 1)
    assert (bulk.txPacket(), bulk.rxPacket(), bulk.fastBulkReadTxPacket(), bulk.fastBulkReadRxPacket()) == (OK,) * 4
    bulk.removeParam(1)
    bulk.clearParam()
    # the end
    assert packets.reboot(port, 1) == (OK, 0)
    assert packets.read4ByteTxRx(port, 1, 112) == (0, OK, 0)
    assert packets.factoryReset(port, 1, 2) == (OK, 0)
    assert uncalled == set()


def test_the_vendors_high_level_sdk_finds_and_moves_the_servos(monkeypatch: pytest.MonkeyPatch) -> None:
    """The part of the SDK for end users: motors found by their model, their tables from the vendor's files."""
    from dynamixel_easy_sdk import Connector, OperatingMode

    for line in _served(monkeypatch, "terminal"):
        line.port.closePort()
        connector = Connector(line.port.port_name, 1_000_000)
        motors = [connector.createMotor(id) for id in (1, 2, 3)]
        assert [motor.getPresentPosition() for motor in motors] == [1000, 2000, 3000]
        motor = motors[0]
        motor.setOperatingMode(OperatingMode.EXTENDED_POSITION)
        motor.setPositionPGain(900)
        motor.enableTorque()
        motor.setGoalPosition(5000)
        line.wait(10.0)
        assert motor.getPresentPosition() == pytest.approx(5000, abs=3)
        assert (motor.isTorqueOn(), motor.getMaxPositionLimit()) == (1, 4095)
        connector.closePort()


def test_ping_read_and_write_of_every_width(line: Line) -> None:
    packets, port = line.packets, line.port
    assert packets.ping(port, 2) == (1020, OK, 0)
    assert packets.read4ByteTxRx(port, 2, 132) == (2000, OK, 0)
    assert packets.write1ByteTxRx(port, 1, 9, 0) == (OK, 0)
    assert packets.read1ByteTxRx(port, 1, 9) == (0, OK, 0)
    assert packets.write2ByteTxRx(port, 1, 84, 900) == (OK, 0)
    assert packets.read2ByteTxRx(port, 1, 84) == (900, OK, 0)
    assert packets.write4ByteTxRx(port, 1, 112, 123) == (OK, 0)
    assert packets.read4ByteTxRx(port, 1, 112) == (123, OK, 0)
    data, result, error = packets.readTxRx(port, 3, 122, 25)
    assert (len(data), result, error) == (25, OK, 0)


def test_error_numbers_arrive(line: Line) -> None:
    packets, port = line.packets, line.port
    assert packets.write4ByteTxRx(port, 1, 116, 4096) == (OK, sdk.ERRNUM_DATA_LIMIT)
    assert packets.write1ByteTxRx(port, 1, 64, 7) == (OK, sdk.ERRNUM_DATA_RANGE)
    assert packets.write2ByteTxRx(port, 1, 116, 7) == (OK, sdk.ERRNUM_DATA_LENGTH)
    assert packets.write4ByteTxRx(port, 1, 132, 7) == (OK, sdk.ERRNUM_ACCESS)
    assert packets.readTxRx(port, 1, 14, 2)[1:] == (OK, sdk.ERRNUM_ACCESS)


def test_a_move_with_sync_write_and_sync_read(line: Line) -> None:
    packets, port = line.packets, line.port
    for id in (1, 2, 3):
        assert packets.write4ByteTxRx(port, id, 112, 200) == (OK, 0)
        assert packets.write4ByteTxRx(port, id, 108, 100) == (OK, 0)
        assert packets.write1ByteTxRx(port, id, 64, 1) == (OK, 0)
    write = sdk.GroupSyncWrite(port, packets, 116, 4)
    goals = {1: 1500, 2: 2600, 3: 2400}
    for id, goal in goals.items():
        assert write.addParam(id, list(goal.to_bytes(4, "little")))
    assert write.txPacket() == OK
    read = sdk.GroupSyncRead(port, packets, 122, 14)
    assert all(read.addParam(id) for id in goals)
    for _ in range(1000):
        line.wait(0.02)
        assert read.txRxPacket() == OK
        if not any(read.getData(id, 122, 1) for id in goals):
            break
    line.wait(0.1)
    assert read.txRxPacket() == OK
    for id, goal in goals.items():
        assert read.isAvailable(id, 132, 4)
        assert read.getData(id, 132, 4) == pytest.approx(goal, abs=3)
        assert read.getData(id, 123, 1) & 1
        assert packets.read4ByteTxRx(port, id, 116) == (goal, OK, 0)


def test_fast_sync_bulk_and_fast_bulk_reads(line: Line) -> None:
    packets, port = line.packets, line.port
    read = sdk.GroupSyncRead(port, packets, 132, 4)
    assert all(read.addParam(id) for id in (3, 1, 2))
    assert read.fastSyncRead() == OK
    assert [read.getData(id, 132, 4) for id in (1, 2, 3)] == [1000, 2000, 3000]
    for ask in ("txRxPacket", "fastBulkRead"):
        bulk = sdk.GroupBulkRead(port, packets)
        assert bulk.addParam(2, 132, 4)
        assert bulk.addParam(1, 0, 2)
        assert getattr(bulk, ask)() == OK
        assert (bulk.getData(2, 132, 4), bulk.getData(1, 0, 2)) == (2000, 1020)


def test_registered_writes_reboot_and_clear(line: Line) -> None:
    packets, port = line.packets, line.port
    assert packets.write1ByteTxRx(port, 1, 64, 1) == (OK, 0)
    assert packets.regWriteTxRx(port, 1, 116, 4, list((1200).to_bytes(4, "little"))) == (OK, 0)
    assert packets.read1ByteTxRx(port, 1, 69) == (1, OK, 0)
    assert packets.action(port, 1) == OK
    line.wait(5.0)
    assert packets.read4ByteTxRx(port, 1, 132)[0] == pytest.approx(1200, abs=3)
    assert packets.clearMultiTurn(port, 1) == (OK, 0)
    assert packets.reboot(port, 1) == (OK, 0)
    assert packets.read1ByteTxRx(port, 1, 64) == (0, OK, 0)


def test_an_absent_servo_is_a_timeout_and_nothing_hangs(line: Line) -> None:
    packets, port = line.packets, line.port
    assert packets.ping(port, 77)[1] == TIMEOUT
    assert packets.ping(port, 1) == (1020, OK, 0)


def test_what_the_sdk_fails_to_stuff_is_lost_and_nothing_else() -> None:
    """dynamixel-sdk 4.1.0 sends FF FF FD raw: the write is dropped, the next instruction is heard.

    If this fails after an update of the SDK, its transmitter stuffs at last.
    """
    for line in _virtual():
        line.packets.write1ByteTxRx(line.port, 1, 11, 4)
        assert line.packets.write4ByteTxRx(line.port, 1, 116, 0xFFFDFFFF)[0] == TIMEOUT
        assert line.packets.read4ByteTxRx(line.port, 1, 116) == (1000, OK, 0)


def test_what_the_servo_stuffs_the_sdk_reads() -> None:
    """Negative positions; the bytes of -131073 begin like a header, so the servo's answer is stuffed."""
    for line in _virtual():
        servo = line.bus.servo(1)
        line.packets.write1ByteTxRx(line.port, 1, 11, 4)
        line.packets.write4ByteTxRx(line.port, 1, 20, (-1003) & 0xFFFFFFFF)
        assert servo.shaft_counts(0.0) == 1000.0
        data, result, error = line.packets.readTxRx(line.port, 1, 132, 4)
        assert (bytes(data), result, error) == (b"\xfd\xff\xff\xff", OK, 0)
        line.packets.write4ByteTxRx(line.port, 1, 20, (-131_073 - 1000) & 0xFFFFFFFF)
        data, result, error = line.packets.readTxRx(line.port, 1, 132, 4)
        assert (bytes(data), result, error) == (b"\xff\xff\xfd\xff", OK, 0)


def test_two_runs_on_the_virtual_clock_are_the_same() -> None:
    """Times and positions of polls during a move, to the last nanosecond and count."""

    def run() -> list[tuple[int, int]]:
        seen = []
        for line in _virtual():
            line.packets.write4ByteTxRx(line.port, 1, 112, 50)
            line.packets.write1ByteTxRx(line.port, 1, 64, 1)
            line.packets.write4ByteTxRx(line.port, 1, 116, 3000)
            for _ in range(50):
                line.wait(0.05)
                seen.append((line.port.clock.now_ns, line.packets.read4ByteTxRx(line.port, 1, 132)[0]))
        return seen

    assert run() == run()
