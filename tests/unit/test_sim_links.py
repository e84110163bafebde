"""The ways to a simulated device: virtual time at an in-process port, pseudo-terminal, TCP."""

from __future__ import annotations

import itertools
import os
import socket
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial

from gonio.errors import DeviceError, ParameterError
from gonio.interfaces import Clock
from sim.clock import ScaledClock, VirtualClock
from sim.dynamixel import DynamixelBus, Fault, Servo
from sim.dynamixel.packet import Instruction, encode
from sim.lamp import ScpiLamp
from sim.links import PtyLink, Pump, TcpLink
from sim.port import attach, detach

PING = encode(1, Instruction.PING)
needs_pty = pytest.mark.skipif(sys.platform == "win32", reason="no pseudo-terminals")


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


@pytest.fixture
def port(clock: VirtualClock) -> Iterator[serial.SerialBase]:
    bus = DynamixelBus([Servo(1)], [Fault("delay", at_reply=3, delay_s=2.0)])
    with serial.serial_for_url(attach("bus", bus, clock), baudrate=1_000_000, timeout=0.5) as port:
        yield port
    detach("bus")


class Served:
    """A pump in a thread."""

    def __init__(self, *links: PtyLink | TcpLink) -> None:
        self._pump = Pump(*links)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._pump.run, args=(self._stop.is_set, 0.01))

    def __enter__(self) -> Served:
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stop.set()
        self._thread.join()
        self._pump.close()


def test_virtual_time_moves_only_by_waiting() -> None:
    clock = VirtualClock(5.0)
    assert isinstance(clock, Clock)
    assert clock.now() == clock.now() == 5.0
    clock.sleep(0.1)
    clock.sleep(-3.0)
    assert clock.now_ns == 5_100_000_000
    clock.advance_to(5.0)
    assert clock.now_ns == 5_100_000_000
    clock.advance_to(7.0)
    assert clock.now() == 7.0


def test_scaled_time_runs_faster_than_the_walls() -> None:
    slow, fast = ScaledClock(1.0), ScaledClock(1e6)
    assert isinstance(fast, Clock)
    fast.sleep(100.0)  # 0.1 ms
    assert fast.now() >= 100.0
    assert slow.now() < fast.now()
    with pytest.raises(ParameterError, match="above 0"):
        ScaledClock(0.0)


def test_bytes_take_their_time_on_the_wire(port: serial.SerialBase, clock: VirtualClock) -> None:
    """10 bits a byte at 1 Mbit/s: 100 us out, 500 us of return delay, 140 us back."""
    port.write(PING)
    assert clock.now_ns == 100_000
    assert len(port.read(14)) == 14
    assert clock.now_ns == 740_000


def test_a_read_without_answer_ends_at_its_timeout(port: serial.SerialBase, clock: VirtualClock) -> None:
    port.write(encode(9, Instruction.PING))
    before = clock.now()
    assert port.read(1) == b""
    assert clock.now() == pytest.approx(before + 0.5)
    port.timeout = 0
    assert port.read(1) == b""
    assert before + 0.5 < clock.now() < before + 0.51
    assert port.in_waiting == 0
    port.timeout = None
    with pytest.raises(serial.SerialException, match="nothing will ever arrive"):
        port.read(1)


def test_a_late_reply_survives_clearing_the_buffer(port: serial.SerialBase, clock: VirtualClock) -> None:
    """What is still on the wire arrives later: the trap that a driver has to fence."""
    for _ in range(2):
        port.write(PING)
        assert len(port.read(14)) == 14
    port.write(PING)
    assert port.read(14) == b""  # 0.5 s, and the reply comes after 2 s
    port.reset_input_buffer()
    clock.sleep(3.0)
    assert port.in_waiting == 14


def test_a_device_is_open_once_and_can_be_gone(clock: VirtualClock) -> None:
    url = attach("lamp", ScpiLamp(), clock)
    port = serial.serial_for_url(url, timeout=0.1)
    with pytest.raises(serial.SerialException, match="open already"):
        serial.serial_for_url(url)
    port.write(b"*IDN?\n")
    assert port.readline() == b"gonio,simulated lamp,0,1.0\n"
    detach("lamp")
    with pytest.raises(serial.SerialException):
        port.write(b"*IDN?\n")
    port.close()
    with pytest.raises(serial.SerialException, match="no simulated device"):
        serial.serial_for_url(url)


def test_the_port_sets_the_speed_of_the_line(clock: VirtualClock) -> None:
    bus = DynamixelBus([Servo(1, baud_code=1)])
    with serial.serial_for_url(attach("bus", bus, clock), baudrate=1_000_000, timeout=0.1) as port:
        port.write(PING)
        assert port.read(14) == b""
        port.baudrate = 57_600
        port.write(PING)
        assert len(port.read(14)) == 14
    detach("bus")


@needs_pty
def test_pseudo_terminals_carry_every_byte_and_leave_nothing_behind(tmp_path: Path) -> None:
    name = tmp_path / "lamp"
    name.symlink_to(tmp_path / "left over")
    link = PtyLink(ScpiLamp(), ScaledClock(40.0), name)
    bus_link = PtyLink(DynamixelBus([Servo(1)]), ScaledClock(40.0))
    with Served(link, bus_link):
        assert link.path == str(name)
        for _ in range(2):  # a client may go and come back
            with serial.Serial(link.path, timeout=5.0, exclusive=True) as port:
                port.write(b"*IDN?\n")
                assert port.readline() == b"gonio,simulated lamp,0,1.0\n"
        with serial.Serial(bus_link.path, 1_000_000, timeout=5.0) as port:
            # Bytes that a terminal would take for itself: interrupt, end, carriage return, newline, flow control, ...
            data = bytes((0x03, 0x04, 0x0A, 0x0D, 0x11, 0x13, 0x1A, 0x7F))
            for value in data:
                port.write(encode(1, Instruction.WRITE, b"\x0c\x00" + bytes((value,))) + encode(1, 2, b"\x0c\x00\x01\x00"))
                assert port.read(11 + 12)[-3] == value
    assert not name.is_symlink()


@needs_pty
def test_a_file_in_the_way_of_the_symlink_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "bus").write_text("mine")
    with pytest.raises(DeviceError, match="is no link"):
        PtyLink(ScpiLamp(), ScaledClock(), tmp_path / "bus")
    assert (tmp_path / "bus").read_text() == "mine"


@needs_pty
def test_replies_wait_for_their_delay_in_scaled_time() -> None:
    """A reply delayed by 2 rig seconds comes after 20 ms of wall at speed 100, and the next one after it."""
    bus = DynamixelBus([Servo(1)], [Fault("delay", at_reply=1, delay_s=2.0)])
    link = PtyLink(bus, ScaledClock(100.0))
    client = os.open(link.path, os.O_RDWR | os.O_NOCTTY)
    try:
        os.write(client, PING)
        link.on_readable()
        due = link.due()
        assert due is not None
        os.write(client, encode(1, Instruction.READ, b"\x84\x00\x04\x00"))
        link.on_readable()
        assert link.due() == due
        pump = Pump(link)
        got = b""
        while len(got) < 14 + 15:
            pump.step(0.05)
            if link.due() is None:
                got += os.read(client, 100)
        assert (got[5], got[14 + 5]) == (7, 8)
        pump.close()
    finally:
        os.close(client)


def test_bytes_are_paced_at_the_lines_speed() -> None:
    """Expected at 57.6 kbit/s: 10 bytes out, 0.5 ms of return delay, 14 bytes back: 4.67 rig ms."""
    link = TcpLink(DynamixelBus([Servo(1)]), ScaledClock(1e-5), baud=57_600)  # a rig millisecond is 100 s of wall
    with socket.create_connection(link.address) as client:
        (connection,) = (one for _ in range(100) for one in link.on_readable())
        client.sendall(PING)
        while connection.due() is None:
            connection.on_readable()
        sent = time.monotonic()
        first = connection.due()
        assert first is not None
        # 240 bits at 57.6 kbit/s and the return delay; the connection heard it no later than now
        wait = 1e5 * (240 / 57_600 + 500e-6)
        assert first - wait <= sent <= first
    link.close()


SYNC_READ = encode(0xFE, Instruction.SYNC_READ, b"\x84\x00\x04\x00\x01\x02\x03")
_ANSWER_S = 500e-6 + 15 * 10 / 57_600  # return delay and 15 bytes, each answer after the one before it


def test_the_answers_of_a_sync_read_follow_each_other_on_the_wire(clock: VirtualClock) -> None:
    bus = DynamixelBus([Servo(k, baud_code=1) for k in (1, 2, 3)])
    with serial.serial_for_url(attach("bus", bus, clock), baudrate=57_600, timeout=0.5) as port:
        port.write(SYNC_READ)
        for k in (1, 2, 3):
            assert len(port.read(15)) == 15
            assert clock.now() == pytest.approx(17 * 10 / 57_600 + k * _ANSWER_S, abs=1e-8)
    detach("bus")


def test_a_paced_link_has_them_due_at_the_same_times() -> None:
    slow = 1e5  # wall seconds in a rig second
    link = TcpLink(DynamixelBus([Servo(k) for k in (1, 2, 3)]), ScaledClock(1.0 / slow), baud=57_600)
    with socket.create_connection(link.address) as client:
        (connection,) = (one for _ in range(100) for one in link.on_readable())
        client.sendall(encode(0xFE, Instruction.SYNC_WRITE, b"\x74\x00\x04\x00\x01\x00\x08\x00\x00") + SYNC_READ)
        while connection.due() is None:
            connection.on_readable()
        dues = [due for due, _ in connection._queue]  # type: ignore[attr-defined]
        assert dues[0] - time.monotonic() <= slow * ((19 + 17) * 10 / 57_600 + _ANSWER_S)
        assert [b - a for a, b in itertools.pairwise(dues)] == pytest.approx([slow * _ANSWER_S] * 2, rel=1e-9)
    link.close()


@needs_pty
def test_a_terminal_is_paced_at_the_speed_that_its_client_sets() -> None:
    link = PtyLink(DynamixelBus([Servo(1, baud_code=1)]), ScaledClock(1e-5), baud=1_000_000)
    with serial.Serial(link.path, 57_600) as client:
        client.write(PING)
        while link.due() is None:
            link.on_readable()
        due = link.due()
        assert due is not None and due - time.monotonic() > 1e5 * 230 / 57_600
    link.close()


def test_silence_ends_an_unfinished_packet(port: serial.SerialBase, clock: VirtualClock) -> None:
    """1.5 ms, the manual says; a shorter pause does not."""
    port.write(PING[:6])
    clock.sleep(1e-3)
    port.write(PING[6:])
    assert len(port.read(14)) == 14
    port.write(PING[:6])
    clock.sleep(2e-3)
    port.write(PING[6:])
    assert port.read(14) == b""


def test_tcp_serves_one_client_and_the_next_replaces_it() -> None:
    link = TcpLink(DynamixelBus([Servo(1)]), ScaledClock(40.0))
    host, number = link.address
    with Served(link):
        with socket.create_connection((host, number), timeout=5.0) as first:
            first.sendall(PING)
            assert first.recv(100).endswith(b"\x2e" + encode(1, 0x55, b"\0\xfc\x03\x2e")[-2:])
            with serial.serial_for_url(f"socket://{host}:{number}", timeout=5.0) as second:
                second.write(PING)
                assert len(second.read(14)) == 14
            assert first.recv(100) == b""
        with socket.create_connection((host, number), timeout=5.0) as third:
            third.sendall(PING)
            assert len(third.recv(100)) == 14


def test_a_port_in_use_is_refused_with_its_name() -> None:
    link = TcpLink(ScpiLamp(), ScaledClock())
    host, number = link.address
    with pytest.raises(DeviceError, match=f"Cannot listen on {host}:{number}"):
        TcpLink(ScpiLamp(), ScaledClock(), host, number)
    link.close()
