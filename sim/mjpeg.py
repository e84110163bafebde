"""The simulated camera as a web camera: motion JPEG over HTTP, for real clients with their stale frames.

One frame every `Sensor.frame_interval_s` of rig time, as ``multipart/x-mixed-replace``; what a client has not read waits in
the sockets' buffers, and a frame that does not fit is dropped. Eight bits, compressed: nothing for radiometry.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Sequence

from gonio.errors import GonioError
from sim.camera import SimulatedCamera
from sim.clock import ScaledClock
from sim.links import Link
from sim.sockets import Listener, received

_BOUNDARY = "frame"
_HEAD = f"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary={_BOUNDARY}\r\n\r\n"
_LONGEST_REQUEST = 16_384


class MjpegLink(Listener):
    """A listening socket on 127.0.0.1 for viewers.

    Parameters
    ----------
    camera : SimulatedCamera
    clock : ScaledClock
    exposure_s : float, optional
        Of every frame [s].
    port : int, optional
        0 for any free one.

    Attributes
    ----------
    url : str
    frames : int
        How many were handed to clients.
    """

    def __init__(self, camera: SimulatedCamera, clock: ScaledClock, exposure_s: float = 0.016, port: int = 0) -> None:
        super().__init__(port=port)
        self.camera = camera
        self.clock = clock
        self.exposure_s = exposure_s
        self.frames = 0
        self.url = f"http://127.0.0.1:{self.address[1]}/"

    def welcome(self, client: socket.socket) -> Link:
        """One more viewer."""
        return _Viewer(self, client)

    def picture(self) -> bytes:
        """A frame of now, as one part of the stream."""
        import cv2

        label = f"mjpeg {self.frames}"
        counts = self.camera.expose(self.clock.now(), self.exposure_s, label)
        shift = max(self.camera.world.settings.sensor.bit_depth - 8, 0)
        jpeg = cv2.imencode(".jpg", (counts >> shift).astype("uint8"))[1].tobytes()
        self.frames += 1
        head = f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
        return head.encode() + jpeg + b"\r\n"


class _Viewer:
    """One client."""

    def __init__(self, link: MjpegLink, client: socket.socket) -> None:
        self._link = link
        self._socket = client
        self._request = b""
        self._unsent = memoryview(b"")
        self._next: float | None = None  # when the next frame leaves; None until it was asked for
        self.closed = False

    def fileno(self) -> int:
        return self._socket.fileno()

    def on_readable(self) -> Sequence[Link]:
        data = received(self._socket)
        if data is None:
            return ()
        self._request += data
        if not data or len(self._request) > _LONGEST_REQUEST:
            self.closed = True
        elif self._next is None and b"\r\n\r\n" in self._request:
            self._unsent = memoryview(_HEAD.encode())
            self._next = time.monotonic()
        return ()

    def due(self) -> float | None:
        return self._next

    def on_due(self) -> None:
        interval = self._link.camera.world.settings.sensor.frame_interval_s / self._link.clock.speed
        self._next = max((self._next or 0.0) + interval, time.monotonic())
        self._flush()
        if not len(self._unsent) and not self.closed:  # else this frame is dropped
            try:
                self._unsent = memoryview(self._link.picture())
            except GonioError:  # there is no picture of this bench; the camera's own socket tells why
                self.closed = True
            self._flush()

    def close(self) -> None:
        self.closed = True
        self._socket.close()

    def _flush(self) -> None:
        try:
            while len(self._unsent):
                self._unsent = self._unsent[self._socket.send(self._unsent) :]
        except BlockingIOError:
            return
        except OSError:
            self.closed = True
