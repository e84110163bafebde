"""The drivers on a real pseudo-terminal and a real TCP socket, with the simulator behind them in a thread.

Here the operating system is in between: locks of the port, real time-outs, bytes that arrive in pieces. Rig time runs 40
times as fast as the wall's.
"""

from __future__ import annotations

import math
import os
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.dynamixel import Bus, Servo
from drivers.dynamixel import registers as reg
from drivers.scpi_lamp import ScpiLamp
from drivers.serial_port import open_port
from gonio.errors import DeviceError, DeviceTimeoutError
from sim.clock import ScaledClock
from sim.dynamixel.bus import DynamixelBus
from sim.dynamixel.faults import Fault
from sim.dynamixel.servo import Servo as SimServo
from sim.lamp import ScpiLamp as SimLamp
from sim.links import PtyLink, Pump, TcpLink

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals need a Unix")

DEG = math.pi / 180.0


class Bench:
    """Two servos and a lamp, served by a thread."""

    def __init__(self, folder: Path) -> None:
        self.clock = ScaledClock(40.0)
        self.servos = {1: SimServo(1), 2: SimServo(2)}
        self.line = DynamixelBus(list(self.servos.values()))
        self.lamp = SimLamp()
        self._pty = PtyLink(self.line, self.clock, folder / "bus")
        self._tcp = TcpLink(self.line, self.clock)
        self._lamp = PtyLink(self.lamp, self.clock)
        self.path, self.lamp_path = self._pty.path, self._lamp.path
        self.url = "socket://{}:{}".format(*self._tcp.address)
        self._pump = Pump(self._pty, self._tcp, self._lamp)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._pump.run, args=(self._stop.is_set,), daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._pump.close()

    def axes(self, bus: Bus) -> list[Servo]:
        made = []
        for k, name in ((1, "arm"), (2, "pan")):
            servo = Servo(bus, name, k, lower=-100 * DEG, upper=100 * DEG, velocity=60 * DEG, acceleration=300 * DEG)
            servo.connect()
            made.append(servo)
        return made

    def settle(self, servos: list[Servo]) -> None:
        end = self.clock.now() + 400.0  # ten seconds of the wall's
        standing = [False]
        while not all(standing):
            assert self.clock.now() < end
            self.clock.sleep(0.02)
            standing = [servo.settled() for servo in servos]


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    bench = Bench(tmp_path)
    yield bench
    bench.close()


@pytest.mark.parametrize("way", ["pty", "tcp"])
def test_two_axes_move_and_are_measured(bench: Bench, way: str) -> None:
    with Bus(bench.path if way == "pty" else bench.url, clock=bench.clock, timeout_s=2.0) as bus:
        servos = bench.axes(bus)
        for target in (30.0, 12.0):
            for servo in servos:
                servo.move_to(target * DEG)
            bench.settle(servos)
            for k, servo in enumerate(servos, start=1):
                reading = servo.read()
                assert reading.position_counts == round(bench.servos[k].shaft_counts(bench.clock.now()))
                assert reading.angle == pytest.approx(target * DEG, abs=0.5 * DEG)


def test_a_port_is_opened_once(bench: Bench) -> None:
    with Bus(bench.path, clock=bench.clock) as bus:
        with pytest.raises(DeviceError, match=rf"is in use by process {os.getpid()} on .* since .*; end that one first"):
            Bus(bench.path, clock=bench.clock).open()
        assert bus.ping(1)[0] == 1020
    with Bus(bench.path, clock=bench.clock, timeout_s=2.0) as bus:  # and free again afterwards
        assert bus.ping(2)[0] == 1020


def test_silence_ends_in_one_sentence_and_the_other_axis_holds(bench: Bench) -> None:
    with Bus(bench.path, clock=bench.clock, timeout_s=0.25, drain_s=0.05, attempts=2) as bus:
        servos = bench.axes(bus)
        for servo in servos:
            servo.move_to(90 * DEG)
        bench.line.inject(Fault("silent", servo_id=2, at_time_s=bench.clock.now()))
        with pytest.raises(DeviceTimeoutError, match=r"Axis pan \(id 2 on .*\) gives no answer") as caught:
            bench.settle(servos)
        assert str(caught.value).count(". ") == 0
        with pytest.raises(DeviceTimeoutError, match="cannot be reached to be stopped"):
            bus.stop_all()
        assert bench.servos[1].torque
        bench.settle(servos[:1])


def test_the_lamp_on_a_pseudo_terminal(bench: Bench) -> None:
    lamp = ScpiLamp(bench.lamp_path, timeout_s=2.0)
    lamp.set_output(True)
    lamp.set_level(0.5)
    assert bench.lamp.on
    assert bench.lamp.level == 0.5
    lamp.close()


def test_errors_of_opening_name_port_and_remedy(tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match=r"nothing listens there; start the server or the simulator first"):
        open_port("socket://127.0.0.1:9", baud=1_000_000)
    plain = tmp_path / "file"
    plain.write_text("not a port")
    with pytest.raises(DeviceError, match=f"Port {plain} cannot be opened"):
        open_port(str(plain), baud=1_000_000)


class Unplugged:
    """A bus on a pseudo-terminal that can be pulled out and comes back under another name."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.clock, self.number = folder, ScaledClock(1.0), 0
        self.servo = SimServo(1, initial_counts=2000.0)
        self.line = DynamixelBus([self.servo, SimServo(2)])
        self._stop, self._thread, self._pump = threading.Event(), threading.Thread(), Pump()
        self.plug()

    def plug(self) -> None:
        self.number += 1
        self.path = self.folder / f"adapter{self.number}"
        self._pump = Pump(PtyLink(self.line, self.clock, self.path))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._pump.run, args=(self._stop.is_set, 0.01), daemon=True)
        self._thread.start()

    def pull(self) -> None:
        self._stop.set()
        self._thread.join()
        self._pump.close()
        self.path.unlink(missing_ok=True)


def test_an_adapter_returns_under_another_name(tmp_path: Path) -> None:
    adapter = Unplugged(tmp_path)
    with Bus(f"{tmp_path}/adapter*", clock=adapter.clock, timeout_s=1.0, drain_s=0.05, return_s=30.0) as bus:
        assert bus.agreed_block(1).position == 2000
        adapter.pull()
        threading.Timer(0.3, adapter.plug).start()
        assert bus.agreed_block(1).position == 2000
        assert adapter.number == 2
        adapter.pull()
    with pytest.raises(DeviceError, match=r"The pattern .*adapter\* means no port; plug the adapter in"):
        open_port(f"{tmp_path}/adapter*", baud=57600)
    (tmp_path / "adapter8").touch()
    (tmp_path / "adapter9").touch()
    with pytest.raises(DeviceError, match=r"means several ports: .*adapter8, .*adapter9; make it narrower"):
        open_port(f"{tmp_path}/adapter*", baud=57600)


def test_an_adapter_returns_between_a_sync_write_and_a_sync_read(tmp_path: Path) -> None:
    adapter = Unplugged(tmp_path)
    with Bus(f"{tmp_path}/adapter*", clock=adapter.clock, timeout_s=1.0, drain_s=0.05, return_s=30.0) as bus:
        assert bus.blocks([1, 2])[1].position == 2000
        adapter.pull()
        threading.Timer(0.3, adapter.plug).start()
        bus.sync_write(reg.GOAL_POSITION, {1: 2100, 2: 2200})
        assert adapter.number == 2
        assert [bus.blocks([1, 2])[k].goal for k in (1, 2)] == [2100, 2200]
        adapter.pull()
        threading.Timer(0.3, adapter.plug).start()
        assert [block.goal for block in bus.blocks([1, 2]).values()] == [2100, 2200]
        assert adapter.number == 3
        adapter.pull()


def test_an_adapter_that_stays_away(tmp_path: Path) -> None:
    adapter = Unplugged(tmp_path)
    with Bus(str(adapter.path), clock=adapter.clock, timeout_s=1.0, return_s=0.2) as bus:
        assert bus.ping(1)[0] == 1020
        adapter.pull()
        with pytest.raises(DeviceError, match=r"Port .*adapter1 does not exist; plug the adapter in"):
            bus.ping(1)
