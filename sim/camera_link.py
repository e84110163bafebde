"""The served camera: a socket on which frames are asked for, one exposure after the other."""

from __future__ import annotations

import socket
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gonio.errors import ConfigurationError, DeviceError, GonioError
from sim.camera import MessageParser, SimulatedCamera, encode_frame, encode_message
from sim.clock import ScaledClock
from sim.links import Link
from sim.sockets import Listener, received


class CameraLink(Listener):
    """The camera's listening socket on 127.0.0.1, on any free port."""

    def __init__(self, camera: SimulatedCamera, clock: ScaledClock) -> None:
        super().__init__()
        self._camera = camera
        self._clock = clock

    def on_readable(self) -> Sequence[Link]:
        """Accept a client, unless the camera was unplugged."""
        if self._camera.unplugged:
            self.close()
            return ()
        return super().on_readable()

    def welcome(self, client: socket.socket) -> Link:
        """One more client."""
        return _CameraConnection(self._camera, self._clock, client)

    def due(self) -> float | None:
        """At once when the camera was unplugged; exposures belong to the connections."""
        return 0.0 if self._camera.unplugged else None

    def on_due(self) -> None:
        """The camera was unplugged."""
        self.close()


class _CameraConnection:
    """One client of the camera: requests in, an exposure that takes its scaled time, a frame out."""

    def __init__(self, camera: SimulatedCamera, clock: ScaledClock, client: socket.socket) -> None:
        self._camera = camera
        self._clock = clock
        self._socket = client
        self._parser = MessageParser()
        self._requests: deque[dict[str, Any]] = deque()
        self._unsent = memoryview(b"")
        self._retry_at = 0.0
        self._then: Callable[[], None] | None = None  # next step of a running exposure
        self._then_due = 0.0
        self._lost = False
        self.closed = False

    def fileno(self) -> int:
        return self._socket.fileno()

    def on_readable(self) -> Sequence[Link]:
        data = received(self._socket)
        if data is None:
            return ()
        try:
            if not data:
                raise ConnectionResetError
            self._requests.extend(header for header, _ in self._parser.receive(data))
        except (OSError, GonioError):  # gone, or talking nonsense
            self._lose()
            return ()
        self._serve()
        return ()

    def due(self) -> float | None:
        if self._lost:
            return 0.0
        if len(self._unsent):
            return self._retry_at
        return None if self._then is None else self._then_due

    def on_due(self) -> None:
        if self._lost:
            self.close()
            return
        self._flush()
        if self._then is not None and time.monotonic() >= self._then_due:
            step, self._then = self._then, None
            self._try(step)
            self._serve()

    def close(self) -> None:
        self.closed = True
        self._socket.close()

    def _lose(self) -> None:
        """Give the connection up; its descriptor stays until `on_due`, so that no new client gets the same number."""
        self._lost = True
        self._then = None
        self._requests.clear()
        self._unsent = memoryview(b"")

    def _serve(self) -> None:
        """Take the next request when none is running."""
        while self._requests and self._then is None and not self._lost:
            request = self._requests.popleft()
            self._try(lambda request=request: self._execute(request))  # type: ignore[misc]

    def _try(self, step: Callable[[], None]) -> None:
        """Do it, or tell the client why not."""
        try:
            step()
        except ConfigurationError as error:
            self._send(encode_message({"ok": False, "kind": "configuration", "error": str(error)}))
        except GonioError as error:
            if self._camera.unplugged:
                self._lose()
            else:
                self._send(encode_message({"ok": False, "kind": "device", "error": str(error)}))

    def _execute(self, request: Mapping[str, Any]) -> None:
        what = request.get("do")
        if what == "describe":
            description = {**self._camera.describe(), "speed": self._clock.speed}
            self._send(encode_message({"ok": True, "description": description}))
        elif what == "truth":
            self._send(encode_message({"ok": True, "truth": self._camera.truth()}))
        elif what == "mount":
            self._camera.mount(str(request.get("specimen")))
            self._send(encode_message({"ok": True}))
        elif what == "capture":
            exposure_s, label = request.get("exposure_s"), request.get("label")
            if isinstance(exposure_s, bool) or not isinstance(exposure_s, int | float) or not isinstance(label, str):
                raise DeviceError("A capture needs exposure_s, a number, and label, a string.")
            exposure = self._camera.begin(float(exposure_s), label)
            self._later(exposure, lambda: self._middle(exposure, label))
        else:
            raise DeviceError(f"The simulated camera does not know how to {what!r}.")

    def _middle(self, exposure_s: float, label: str) -> None:
        data = self._camera.expose(self._clock.now(), exposure_s, label)
        self._later(exposure_s, lambda: self._end(data, exposure_s, label))

    def _end(self, data: NDArray[np.uint16], exposure_s: float, label: str) -> None:
        self._send(encode_frame(self._camera.finish(data, exposure_s, label)))

    def _later(self, exposure_s: float, step: Callable[[], None]) -> None:
        """Do `step` when half of the exposure is over."""
        self._then_due = time.monotonic() + 0.5 * exposure_s / self._clock.speed
        self._then = step

    def _send(self, data: bytes) -> None:
        self._unsent = memoryview(bytes(self._unsent) + data)
        self._flush()

    def _flush(self) -> None:
        if len(self._unsent) and not self._lost:
            try:
                self._unsent = self._unsent[self._socket.send(self._unsent) :]
            except BlockingIOError:
                self._retry_at = time.monotonic() + 0.001
            except OSError:
                self._lose()
