"""A pyserial port with a simulated device at its other end, inside this process.

`attach` makes a device reachable under a pyserial URL ``sim://NAME``, on any clock, above all a virtual one. The port
counts the time that bytes need on the wire, and every wait moves the clock on; a read that finds nothing moves it on
too, so that a program that polls meets its timeout. Its timeouts are rig seconds. It is for one thread.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import serial
from serial.serialutil import PortNotOpenError, SerialBase, SerialException

from gonio.interfaces import Clock
from sim.links import Device

POLL_S = 1e-5  # rig time that an empty read without timeout takes
GAP_S = 1.5e-3  # silence after which a device forgets an unfinished packet


class _Line:
    """A device under a name, and the port that has it open."""

    def __init__(self, device: Device, clock: Clock, since: float) -> None:
        self.device = device
        self.clock = clock
        self.since = since  # when it is plugged in [s]
        self.heard = since  # when its last byte came [s]
        self.port: SimulatedPort | None = None


_lines: dict[str, _Line] = {}


def attach(name: str, device: Device, clock: Clock, since: float = 0.0) -> str:
    """Make a device reachable as ``sim://NAME`` in this process, from rig time `since` [s] on; return that URL.

    A device that was there under this name is replaced.
    """
    if "sim.urls" not in serial.protocol_handler_packages:
        serial.protocol_handler_packages.append("sim.urls")
    _lines[name] = _Line(device, clock, since)
    return f"sim://{name}"


def detach(name: str) -> None:
    """Take a device off; a port that has it open finds it gone."""
    line = _lines.pop(name, None)
    if line is not None and line.port is not None:
        line.port.close()


class SimulatedPort(SerialBase):  # type: ignore[misc]  # pyserial has no types
    """A pyserial port with a simulated device at its other end.

    Bytes take ``10 / baudrate`` seconds each, both ways, and a reply arrives as a whole with its last byte. Timeouts
    are measured on the device's clock. A device can be open once.
    """

    BAUDRATES = (*SerialBase.BAUDRATES, 4_500_000)

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.is_open = False
        self._line: _Line | None = None
        self._arriving: deque[tuple[float, bytes]] = deque()  # (arrival, bytes), in order
        self._received = bytearray()
        super().__init__(*args, **kwargs)

    def open(self) -> None:
        """Open it.

        Raises
        ------
        SerialException
            If nothing is attached under the name, or it is open already.
        """
        if self.is_open:
            raise SerialException("Port is already open.")
        name = str(self._port).split("://", 1)[-1].strip("/")
        line = _lines.get(name)
        if line is None or line.clock.now() < line.since:
            raise SerialException(f"could not open port {self._port}: no simulated device of that name")
        if line.port is not None:
            raise SerialException(f"could not open port {self._port}: it is open already")
        self._line, line.port = line, self
        self.is_open = True
        self._reconfigure_port()
        self.reset_input_buffer()

    def close(self) -> None:
        """Close it; a second time does nothing."""
        if self._line is not None:
            self._line.port = None
            self._line = None
        self.is_open = False

    def _reconfigure_port(self) -> None:
        if self._line is not None and hasattr(self._line.device, "baudrate"):
            self._line.device.baudrate = self._baudrate

    def _open_line(self) -> _Line:
        if self._line is None:
            raise PortNotOpenError()
        return self._line

    def write(self, data: Any, /) -> int:
        """Send; returns when the last byte is out, and the device has it."""
        line = self._open_line()
        sent = bytes(data)
        byte_s = 10.0 / self._baudrate
        if line.clock.now() - line.heard > GAP_S:
            line.device.idle()
        line.clock.sleep(len(sent) * byte_s)
        now = free = line.heard = line.clock.now()
        if self._arriving:  # the line carries one reply after the other
            free = max(free, self._arriving[-1][0])
        for delay, reply in line.device.feed(sent, now):
            free += delay + len(reply) * byte_s
            self._arriving.append((free, reply))
        return len(sent)

    def read(self, size: int = 1, /) -> bytes:
        """Wait until `size` bytes are there or the timeout is over; return what is there."""
        clock = self._open_line().clock
        self._collect()
        if self._timeout == 0:
            if not self._received:
                clock.sleep(POLL_S)
                self._collect()
        else:
            deadline = None if self._timeout is None else clock.now() + self._timeout
            while len(self._received) < size:
                if self._arriving and (deadline is None or self._arriving[0][0] <= deadline):
                    clock.sleep(self._arriving[0][0] - clock.now())
                    self._take()
                elif deadline is None:
                    raise SerialException("read without a timeout, and nothing will ever arrive")
                else:
                    clock.sleep(deadline - clock.now())
                    break
        data = bytes(self._received[:size])
        del self._received[:size]
        return data

    @property
    def in_waiting(self) -> int:
        """Bytes that can be read at once; asking in vain takes a little time."""
        clock = self._open_line().clock
        self._collect()
        if not self._received:
            clock.sleep(POLL_S)
            self._collect()
        return len(self._received)

    @property
    def out_waiting(self) -> int:
        """Always 0: `write` waits."""
        self._open_line()
        return 0

    def flush(self) -> None:
        """Nothing to wait for."""
        self._open_line()

    def reset_input_buffer(self) -> None:
        """Forget what has arrived; what is still on the wire arrives later."""
        self._collect()
        self._received.clear()

    def reset_output_buffer(self) -> None:
        """Nothing is waiting."""
        self._open_line()

    def _collect(self) -> None:
        """Move what has arrived by now into the buffer."""
        now = self._open_line().clock.now()
        while self._arriving and self._arriving[0][0] <= now + 1e-9:
            self._take()

    def _take(self) -> None:
        self._received += self._arriving.popleft()[1]

    def _update_rts_state(self) -> None:
        return

    def _update_dtr_state(self) -> None:
        return

    def _update_break_state(self) -> None:
        return
