"""Ways from another program to a simulated device: a pseudo-terminal or a TCP socket.

A device is anything with ``feed(data, t) -> [(delay, reply), ...]`` and ``idle()``: the servo bus and the lamp. The
links run on a `ScaledClock`, have file descriptors and never block; `Pump` is the loop that drives them, together with
any other object of the same shape (`Link`).

A reply leaves when its delay is over, in scaled time, and all at once; with a baud rate it leaves when its last byte would
have come over a line of that speed, after the bytes that asked for it. Pseudo-terminals need a Unix; nothing else here
does. For a device inside the same process see `sim.port`.
"""

from __future__ import annotations

import os
import selectors
import socket
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Protocol

from gonio.errors import DeviceError
from sim.clock import ScaledClock
from sim.dynamixel.control_table import BAUD_RATES
from sim.sockets import Listener, received

EARLY_S = 2e-4  # how far ahead of a due reply the pump wakes up, to watch the clock: a timer alone is late by as much
IDLE_S = 0.1  # wall time of silence after which servos forget an unfinished packet; they themselves wait 1.5 ms


class Device(Protocol):
    """What stands at the far end of a line."""

    def feed(self, data: bytes, t: float) -> list[tuple[float, bytes]]:
        """Take bytes that arrived at rig time `t` [s]; return replies in order, each with its delay after what was on the
        line before it: these bytes, or the reply ahead of it [s]."""
        ...

    def idle(self) -> None:
        """The line was silent for a while."""
        ...


class Link(Protocol):
    """What a `Pump` drives. All times are the wall's, `time.monotonic`."""

    @property
    def closed(self) -> bool:
        """Whether the pump should forget it."""
        ...

    def fileno(self) -> int: ...

    def on_readable(self) -> Iterable[Link]:
        """Data is there; never blocks. Returns links to be driven from now on, such as an accepted connection."""
        ...

    def due(self) -> float | None:
        """When `on_due` should be called next; None for never."""
        ...

    def on_due(self) -> None: ...

    def close(self) -> None: ...


class Pump:
    """A selectors loop over links.

    Examples
    --------
    ::

        pump = Pump(PtyLink(bus, clock), PtyLink(lamp, clock))
        pump.run(lambda: stop.is_set())
    """

    def __init__(self, *links: Link) -> None:
        # Waits to the microsecond; epoll and poll round up to the millisecond, more than a packet takes at 4 Mbit/s.
        self._selector = selectors.SelectSelector()
        self._links: list[Link] = []
        for link in links:
            self.add(link)

    def add(self, link: Link) -> None:
        """Drive this link too."""
        self._selector.register(link.fileno(), selectors.EVENT_READ, link)
        self._links.append(link)

    def step(self, timeout: float) -> None:
        """Wait for data or a due reply, at most `timeout` wall seconds, and serve it."""
        now = time.monotonic()
        dues = [due for link in self._links if (due := link.due()) is not None]
        wait = max(0.0, min([timeout, *(due - now - EARLY_S for due in dues)]))
        for key, _ in self._selector.select(wait):
            for new in key.data.on_readable():
                self.add(new)
        now = time.monotonic()
        for link in list(self._links):
            due = link.due()
            if due is not None and due <= now:
                link.on_due()
            if link.closed and link in self._links:
                self._forget(link)
                link.close()

    def drop(self, link: Link) -> None:
        """Close a link, and what came of it, and drive it no longer."""
        for one in list(self._links):
            if one is link or getattr(one, "parent", None) is link:
                self._forget(one)
                one.close()

    def run(self, stop: Callable[[], bool], poll_s: float = 0.05) -> None:
        """Step until `stop` says so."""
        while not stop():
            self.step(poll_s)

    def close(self) -> None:
        """Close all links."""
        for link in list(self._links):
            self._forget(link)
            link.close()
        self._selector.close()

    def _forget(self, link: Link) -> None:
        self._links.remove(link)
        for key in list(self._selector.get_map().values()):
            if key.data is link:
                self._selector.unregister(key.fileobj)


class _StreamLink:
    """A device behind a descriptor, with a queue of replies that are not due yet."""

    def __init__(self, device: Device, clock: ScaledClock, baud: int | None = None) -> None:
        self._device = device
        self._clock = clock
        self._baud = baud
        self._arrived = 0.0  # when the client's last byte is there; 10 bits a byte
        self._free = 0.0  # when the last reply is out
        self._queue: deque[tuple[float, bytes]] = deque()
        self._unsent = b""
        self._retry = 0.0  # when to try again what the receiver did not take
        self._heard = 0.0
        self.closed = False

    def due(self) -> float | None:
        if self._unsent:
            return self._retry
        return self._queue[0][0] if self._queue else None

    def on_due(self) -> None:
        now = time.monotonic()
        while self._queue and self._queue[0][0] <= now:
            self._unsent += self._queue.popleft()[1]
        self._flush()

    def _receive(self, data: bytes, now: float) -> None:
        """Take what the client has sent by `now` [s]."""
        if now - self._heard > IDLE_S:
            self._device.idle()
        self._heard = now
        speed = self._clock.speed
        byte_s = 10.0 / self._baud / speed if self._baud else 0.0
        self._arrived = max(self._arrived, now) + len(data) * byte_s
        self._free = max(self._free, self._arrived)
        for delay, reply in self._device.feed(data, self._clock.now() + (self._arrived - now) * speed):
            self._free += delay / speed + len(reply) * byte_s
            self._queue.append((self._free, reply))
        self.on_due()

    def _flush(self) -> None:
        if self._unsent:
            with suppress(BlockingIOError):
                self._unsent = self._unsent[self._write(self._unsent) :]
            self._retry = time.monotonic() + 0.001

    def _write(self, data: bytes) -> int:
        raise NotImplementedError


def _line_rate(terminal: int) -> int | None:
    """Rate that the client has set [bit/s]; None if it set none that servos have, as a program that only writes bytes."""
    import termios

    speed = termios.tcgetattr(terminal)[5]
    return next((rate for rate in BAUD_RATES if getattr(termios, f"B{rate}", rate) == speed), None)


class PtyLink(_StreamLink):
    """A device on a pseudo-terminal.

    Parameters
    ----------
    device : Device
    clock : ScaledClock
    symlink : path, optional
        A stable name for the terminal, made anew if it is a left-over link.
    baud : int, optional
        Pace of the bytes [bit/s], where the client sets none; as fast as they come by default.

    Attributes
    ----------
    path : str
        What a client opens: `symlink`, or the terminal's own name.

    Raises
    ------
    DeviceError
        If this system has no pseudo-terminals, or `symlink` is something that is not a link.
    """

    def __init__(
        self, device: Device, clock: ScaledClock, symlink: str | Path | None = None, baud: int | None = None
    ) -> None:
        super().__init__(device, clock, baud)
        try:
            import pty
            import tty
        except ImportError as error:
            raise DeviceError("This system has no pseudo-terminals; serve the simulator over TCP instead.") from error
        self._master, self._slave = pty.openpty()
        # Raw before the first client, or the line discipline would echo. The slave stays open, or reads of the master
        # would fail whenever no client is connected.
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self._symlink: Path | None = None
        if symlink is not None:
            self._make_symlink(Path(symlink))

    def _make_symlink(self, name: Path) -> None:
        if name.exists() and not name.is_symlink():
            self.close()
            raise DeviceError(f"{name} exists and is no link; choose another name for the pseudo-terminal.")
        fresh = name.with_name(f".{name.name}.{os.getpid()}")
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(self.path)
        fresh.replace(name)
        self._symlink, self.path = name, str(name)

    def fileno(self) -> int:
        return self._master

    def on_readable(self) -> Sequence[Link]:
        now = time.monotonic()
        try:
            data = os.read(self._master, 65_536)
        except BlockingIOError:
            return ()
        except OSError:  # the terminal is gone
            self.closed = True
            return ()
        if data:
            rate = _line_rate(self._slave)
            if hasattr(self._device, "baudrate"):
                self._device.baudrate = rate
            if self._baud and rate:
                self._baud = rate
            self._receive(data, now)
        return ()

    def _write(self, data: bytes) -> int:
        return os.write(self._master, data)

    def close(self) -> None:
        """Close the terminal and take the symlink away."""
        self.closed = True
        if self._symlink is not None and self._symlink.is_symlink():
            with suppress(OSError):
                if self._symlink.readlink() == Path(os.ttyname(self._slave)):
                    self._symlink.unlink()
            self._symlink = None
        for descriptor in (self._master, self._slave):
            with suppress(OSError):
                os.close(descriptor)


class _Connection(_StreamLink):
    """One client of a `TcpLink`."""

    def __init__(self, device: Device, clock: ScaledClock, client: socket.socket, baud: int | None) -> None:
        super().__init__(device, clock, baud)
        self.parent: TcpLink | None = None
        self._socket = client

    def fileno(self) -> int:
        return self._socket.fileno()

    def on_readable(self) -> Sequence[Link]:
        now = time.monotonic()
        data = received(self._socket)
        if data is None:
            return ()
        if data:
            self._receive(data, now)
        else:
            self.closed = True  # the pump closes it: until then no new client can get the same descriptor
        return ()

    def _write(self, data: bytes) -> int:
        try:
            return self._socket.send(data)
        except (BrokenPipeError, ConnectionResetError):
            self.closed = True
            return len(data)

    def close(self) -> None:
        self.closed = True
        self._socket.close()


class TcpLink(Listener):
    """A device on a TCP port, for pyserial's ``socket://HOST:PORT``; a new client replaces the one before.

    Parameters
    ----------
    device : Device
    clock : ScaledClock
    host : str, optional
    port : int, optional
        0 for any free one.
    baud : int, optional
        Pace of the bytes [bit/s]; as fast as they come by default.
    """

    def __init__(
        self, device: Device, clock: ScaledClock, host: str = "127.0.0.1", port: int = 0, baud: int | None = None
    ) -> None:
        super().__init__(host, port)
        self._device = device
        self._clock = clock
        self._baud = baud
        self._client: _Connection | None = None

    def welcome(self, client: socket.socket) -> Link:
        """The only client from now on."""
        if self._client is not None:
            self._client.closed = True
        self._device.idle()
        self._client = _Connection(self._device, self._clock, client, self._baud)
        self._client.parent = self
        return self._client

    def close(self) -> None:
        """Listen no longer, and let go of the client."""
        super().close()
        if self._client is not None:
            self._client.close()
