"""Listening sockets, and what their clients send: for whatever of the simulator is served over TCP.

Nothing here blocks. Listeners have the shape of `sim.links.Link`; who comes, they hand over to what their kind does with it.
"""

from __future__ import annotations

import socket
from collections.abc import Sequence
from typing import TYPE_CHECKING

from gonio.errors import DeviceError

if TYPE_CHECKING:
    from sim.links import Link


class Listener:
    """A listening socket; satisfies `sim.links.Link`.

    Parameters
    ----------
    host : str, optional
    port : int, optional
        0 for any free one.

    Attributes
    ----------
    address : tuple of (str, int)
        Host and port.

    Raises
    ------
    DeviceError
        If the port is taken.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 0) -> None:
        self.closed = False
        try:
            self._listener = socket.create_server((host, port))
        except OSError as error:
            raise DeviceError(f"Cannot listen on {host}:{port} ({error.strerror}); choose another port.") from error
        self._listener.setblocking(False)
        name = self._listener.getsockname()
        self.address: tuple[str, int] = (name[0], name[1])

    def welcome(self, client: socket.socket) -> Link:
        """Take a client that has connected; returns the link that serves it."""
        raise NotImplementedError

    def fileno(self) -> int:
        """Of the listening socket."""
        return self._listener.fileno()

    def on_readable(self) -> Sequence[Link]:
        """Accept a client."""
        try:
            client, _ = self._listener.accept()
        except OSError:
            return ()
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return (self.welcome(client),)

    def due(self) -> float | None:
        """Never: what is due belongs to the connections."""
        return None

    def on_due(self) -> None:
        """Nothing is."""
        return

    def close(self) -> None:
        """Listen no longer."""
        self.closed = True
        self._listener.close()


def received(client: socket.socket) -> bytes | None:
    """What a client has sent; None if nothing is there, empty if it is gone."""
    try:
        return client.recv(65_536)
    except BlockingIOError:
        return None
    except OSError:
        return b""
