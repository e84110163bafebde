"""The simulated camera: renders the true scene, exposes it on a noisy sensor, and hands frames over.

`SimulatedCamera` works in this process on any clock; `SocketCamera` asks one in another process over a local socket.
Both satisfy `gonio.interfaces.Camera`, and both can change the specimen, which a person does on a real rig.

The noise of a frame depends on the seed and on the frame's label and on nothing else: the frame of a pose is the same
whether the scan was interrupted before it or not. The specimen is seen where it is in the middle of the exposure; motion
blur is not modelled. What the sensor does is in `sim.chip`; a camera behind ``cv2.VideoCapture``, with its stale frames
and its automatic exposure, is `sim.capture`. What was true is logged with every frame.
"""

from __future__ import annotations

import json
import math
import socket
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gonio.errors import ConfigurationError, DeviceError, DeviceTimeoutError, ProtocolError
from gonio.interfaces import Clock, Frame
from sim.chip import Chip
from sim.render import radiance
from sim.world import World, generator

EXPOSURES_S = (1e-6, 60.0)
MAX_HEADER = 1 << 20
MAX_PAYLOAD = 1 << 28


class SimulatedCamera:
    """A camera on the simulated bench.

    Parameters
    ----------
    world : World
    clock : Clock
        An exposure takes its time on this clock.
    before_exposure : callable, optional
        Called with the label when a frame is asked for; a scenario's faults strike here.

    Attributes
    ----------
    frames : int
        How many were taken.
    unplugged : bool
        The camera does not answer any more.
    spoil : str or None
        ``"torn"`` or ``"repeated"``: what is wrong with the next frame.
    log : deque of dict
        What was true at the middle of each exposure, with its label; the latest 100 000.
    record : callable or None
        Gets each entry of the log as well.
    """

    def __init__(self, world: World, clock: Clock, before_exposure: Callable[[str], None] | None = None) -> None:
        self.world = world
        self.frames = 0
        self.unplugged = False
        self.spoil: str | None = None
        self.log: deque[dict[str, Any]] = deque(maxlen=100_000)
        self.record: Callable[[dict[str, Any]], None] | None = None
        self._clock = clock
        self._before_exposure = before_exposure
        self.chip = Chip(world.settings.sensor, world.settings.seed)
        self._rendered: tuple[object, NDArray[np.float64]] | None = None
        self._previous: NDArray[np.uint16] | None = None

    @property
    def name(self) -> str:
        """For messages."""
        return "simulated camera"

    def mount(self, specimen: str) -> None:
        """Put ``"sample"``, ``"white"``, ``"board"`` or ``"trap"`` on the stage."""
        self.world.mount(specimen, self._clock.now())

    def truth(self) -> dict[str, Any]:
        """What the measurement has to find out; no real camera tells."""
        return self.world.truth.as_dict()

    def describe(self) -> Mapping[str, object]:
        """Model and settings."""
        sensor = self.world.settings.sensor
        return {
            "name": self.name,
            "width": sensor.width,
            "height": sensor.height,
            "pixel_mm": sensor.pixel_mm,
            "distance_mm": sensor.distance_mm,
            "bit_depth": sensor.bit_depth,
            "saturation_dn": sensor.saturation_dn,
            "linear": sensor.response == "linear",
            "gain_dn_per_e": sensor.gain_dn_per_e,
            "read_noise_e": sensor.read_noise_e,
            "offset_dn": sensor.offset_dn,
        }

    def capture(self, exposure_s: float, *, label: str) -> Frame:
        """Expose a frame; the clock has moved on by `exposure_s` when it returns.

        Raises
        ------
        DeviceError
            If the exposure time is outside 1 us to 60 s, or the camera is unplugged.
        """
        exposure_s = self.begin(exposure_s, label)
        self._clock.sleep(0.5 * exposure_s)
        data = self.expose(self._clock.now(), exposure_s, label)
        self._clock.sleep(0.5 * exposure_s)
        return self.finish(data, exposure_s, label)

    def begin(self, exposure_s: float, label: str) -> float:
        """Check a request; return the exposure time that the camera sets, in whole microseconds [s]."""
        if self._before_exposure is not None:
            self._before_exposure(label)
        if self.unplugged:
            raise DeviceError(f"The {self.name} is gone: no frame for {label!r}; check its cable, then resume.")
        low, high = EXPOSURES_S
        if not low <= exposure_s <= high:
            raise DeviceError(f"The {self.name} cannot expose for {exposure_s:g} s; choose {low:g} s to {high:g} s.")
        return round(exposure_s * 1e6) * 1e-6

    def rate(self, t: float) -> NDArray[np.float64]:
        """Electrons per second of each pixel at `t` [s], without dark current; shape (height, width).

        While nothing has moved, the last image serves again, as bright as the lamp is.
        """
        scene = self.world.scene(t)
        key = (self.world.specimen_at(t), scene.frame.tobytes(), scene.lamp.tobytes(), scene.intensity > 0.0)
        if self._rendered is None or self._rendered[0] != key:
            unit = replace(scene, intensity=float(scene.intensity > 0.0))
            image = radiance(unit, self.chip.eye, self.chip.rays, self.world.settings.sensor.lens_radius_mm)
            self._rendered = (key, image)
        return self.chip.electrons(self._rendered[1] * scene.intensity, self.world.colour(t))

    def expose(self, t: float, exposure_s: float, label: str, gain: float = 1.0) -> NDArray[np.uint16]:
        """Counts of a frame whose exposure has its middle at `t` [s], shape (height, width) [DN]."""
        noise = generator(self.world.settings.seed, "frame", label)
        image = self.chip.expose(self.rate(t), exposure_s, noise, gain)
        self.frames += 1
        entry = {"label": label, "exposure_s": exposure_s, **self.world.state(t)}
        self.log.append(entry)
        if self.record is not None:
            self.record(entry)
        before, self._previous = self._previous, image
        spoil, self.spoil = self.spoil, None
        if spoil is not None and before is not None:
            fresh = 0 if spoil == "repeated" else len(image) // 2
            image = np.concatenate((image[:fresh], before[fresh:]))
        return image

    def finish(self, data: NDArray[np.uint16], exposure_s: float, label: str) -> Frame:
        """The frame, at the end of its exposure."""
        sensor = self.world.settings.sensor
        return Frame(
            data=data,
            exposure_s=exposure_s,
            gain=1.0,
            timestamp_s=self._clock.now(),
            bit_depth=sensor.bit_depth,
            linear=sensor.response == "linear",
            saturation_dn=sensor.saturation_dn,
            label=label,
            metadata={"camera": self.name},
        )

    def close(self) -> None:
        """Nothing to give back."""


# ---- over a socket -------------------------------------------------------------------------------------------------
# A message is the length of its header (4 bytes, big endian), the header (JSON), and header["bytes"] bytes of payload.


def encode_message(header: Mapping[str, Any], payload: bytes = b"") -> bytes:
    """Bytes of one message."""
    text = json.dumps({**header, "bytes": len(payload)}, allow_nan=False).encode()
    return len(text).to_bytes(4, "big") + text + payload


class MessageParser:
    """Bytes in, messages out; knows no socket."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def receive(self, data: bytes) -> list[tuple[dict[str, Any], bytes]]:
        """Take bytes; return the messages that are complete now, each a header and a payload.

        Raises
        ------
        ProtocolError
            If the bytes are no message; the connection is then of no more use.
        """
        self._buffer += data
        found = []
        while (message := self._next()) is not None:
            found.append(message)
        return found

    def _next(self) -> tuple[dict[str, Any], bytes] | None:
        if len(self._buffer) < 4:
            return None
        size = int.from_bytes(self._buffer[:4], "big")
        if not 2 <= size <= MAX_HEADER:
            raise ProtocolError(f"The camera's line brought a header of {size} bytes; 2 to {MAX_HEADER} were expected.")
        if len(self._buffer) < 4 + size:
            return None
        try:
            header = json.loads(self._buffer[4 : 4 + size])
            length = header["bytes"]
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise ProtocolError(f"The camera's line brought a header that is none ({error}).") from error
        if isinstance(length, bool) or not isinstance(length, int) or not 0 <= length <= MAX_PAYLOAD:
            raise ProtocolError(f"The camera's line announced {length!r} bytes; 0 to {MAX_PAYLOAD} were expected.")
        if len(self._buffer) < 4 + size + length:
            return None
        payload = bytes(self._buffer[4 + size : 4 + size + length])
        del self._buffer[: 4 + size + length]
        return header, payload


def encode_frame(frame: Frame) -> bytes:
    """The message that carries a frame."""
    height, width = frame.data.shape
    header = {
        "ok": True,
        "shape": [height, width],
        "exposure_s": frame.exposure_s,
        "gain": frame.gain,
        "timestamp_s": frame.timestamp_s,
        "bit_depth": frame.bit_depth,
        "linear": frame.linear,
        "saturation_dn": frame.saturation_dn,
        "label": frame.label,
        "metadata": dict(frame.metadata),
    }
    return encode_message(header, frame.data.astype("<u2").tobytes())


def decode_frame(header: Mapping[str, Any], payload: bytes) -> Frame:
    """The frame of a message.

    Raises
    ------
    ProtocolError
        If something is missing, or the payload does not fit the shape.
    """
    try:
        height, width = (int(n) for n in header["shape"])
        if min(height, width) < 1 or 2 * height * width != len(payload):
            raise ProtocolError(f"A frame of {height} x {width} pixels came with {len(payload)} bytes; resume the scan.")
        frame = Frame(
            data=np.frombuffer(payload, "<u2").reshape(height, width).astype(np.uint16),
            exposure_s=float(header["exposure_s"]),
            gain=float(header["gain"]),
            timestamp_s=float(header["timestamp_s"]),
            bit_depth=int(header["bit_depth"]),
            linear=bool(header["linear"]),
            saturation_dn=int(header["saturation_dn"]),
            label=str(header["label"]),
            metadata=dict(header["metadata"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ProtocolError(f"A frame came with a header that cannot be used ({error!r}); resume the scan.") from error
    return frame


class SocketCamera:
    """A simulated camera in another process.

    Parameters
    ----------
    address : str
        ``"host:port"``.
    timeout_s : float, optional
        Wall time to wait for an answer, beyond the exposure [s].

    Raises
    ------
    DeviceError
        If nobody listens at that address.
    """

    def __init__(self, address: str, timeout_s: float = 10.0) -> None:
        host, _, port = address.rpartition(":")
        if not host or not port.isdigit() or not 0 < int(port) < 65536:
            raise ConfigurationError(f"A camera's address is host:port, and not {address!r}.")
        if not (math.isfinite(timeout_s) and timeout_s > 0.0):
            raise ConfigurationError(f"The camera's timeout is {timeout_s:g} s; it must be above 0 s.")
        self._host, self._port, self._timeout_s = host, int(port), timeout_s
        self._socket: socket.socket | None = None
        self._parser = MessageParser()
        self._description: dict[str, Any] = self._ask({"do": "describe"})[0]["description"]
        self._speed = float(self._description.get("speed", 1.0))

    @property
    def name(self) -> str:
        """For messages."""
        return f"simulated camera at {self._host}:{self._port}"

    def describe(self) -> Mapping[str, object]:
        """Model and settings."""
        return dict(self._description)

    def mount(self, specimen: str) -> None:
        """Put ``"sample"``, ``"white"`` or ``"trap"`` on the stage."""
        self._ask({"do": "mount", "specimen": specimen})

    def truth(self) -> dict[str, Any]:
        """What the measurement has to find out; no real camera tells."""
        told: dict[str, Any] = self._ask({"do": "truth"})[0]["truth"]
        return told

    def capture(self, exposure_s: float, *, label: str) -> Frame:
        """Expose a frame.

        Raises
        ------
        DeviceError
            If the camera refuses, does not answer in time, or is gone.
        """
        if not math.isfinite(exposure_s):
            raise DeviceError(f"The {self.name} cannot expose for {exposure_s} s; give a number.")
        request = {"do": "capture", "exposure_s": float(exposure_s), "label": label}
        frame = decode_frame(*self._ask(request, exposure_s / self._speed))
        if frame.label != label:
            raise ProtocolError(f"The {self.name} sent the frame {frame.label!r} instead of {label!r}; resume the scan.")
        return frame

    def close(self) -> None:
        """Close the connection."""
        if self._socket is not None:
            self._socket.close()
        self._socket = None
        self._parser = MessageParser()

    def _ask(self, request: Mapping[str, Any], longer_s: float = 0.0) -> tuple[dict[str, Any], bytes]:
        """One request, one answer; a connection on which something went wrong is not used again."""
        wait = self._timeout_s + max(longer_s, 0.0)
        try:
            if self._socket is None:
                self._socket = socket.create_connection((self._host, self._port), self._timeout_s)
                self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._socket.settimeout(wait)
            self._socket.sendall(encode_message(request))
            messages: list[tuple[dict[str, Any], bytes]] = []
            while not messages:
                data = self._socket.recv(1 << 20)
                if not data:
                    raise ConnectionResetError("the connection was closed")
                messages = self._parser.receive(data)
        except TimeoutError as error:
            self.close()
            raise DeviceTimeoutError(
                f"The {self.name} gave no answer within {wait:g} s; see whether the simulator runs, then resume."
            ) from error
        except OSError as error:
            self.close()
            raise DeviceError(f"The {self.name} is gone ({error}); start the simulator again, then resume.") from error
        except ProtocolError:
            self.close()
            raise
        header, payload = messages[0]
        if not header.get("ok"):
            refused = ConfigurationError if header.get("kind") == "configuration" else DeviceError
            raise refused(str(header.get("error", f"The {self.name} refused without a reason.")))
        return header, payload
