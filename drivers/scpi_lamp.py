"""A lamp behind SCPI lines on a serial port, and a lamp switched by hand.

Every command is followed by ``SYST:ERR?``, and what can be read back is read back: `set_output` and `set_level` return
when the lamp has confirmed. After a timeout the line is drained and fenced with ``*IDN?``, so that a late answer is not
taken for another's. Nothing here knows how bright the lamp is, or waits for it to warm up.

References: SCPI-99, volume 2 (OUTPut, SOURce, SYSTem:ERRor), and IEEE 488.2 for the common commands.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from typing import Any

from drivers.serial_port import open_port, port_errors
from gonio.errors import ConfigurationError, DeviceError, DeviceTimeoutError, ProtocolError

logger = logging.getLogger(__name__)

_LEVEL_STEP = 2e-3  # a lamp may round the level it is given to so much
_ERROR_QUEUE = 32  # more errors than any queue holds
_LINE_BYTES = 4096
_ATTEMPTS = 3
_IDLE_READS = 20_000


class ScpiLamp:
    """A lamp that speaks SCPI; satisfies `gonio.interfaces.Lamp`.

    Parameters
    ----------
    port : str
        Path or pyserial URL.
    name : str, optional
        As messages call it.
    baud : int, optional
        Line rate [bit/s].
    timeout_s : float, optional
        Longest wait for one answer [s], on `now`.
    now : callable, optional
        Seconds of the port's own time, never going back; a virtual clock's for an in-process simulator.
    drain_s : float, optional
        After a timeout, how long the line must be silent [s].

    Raises
    ------
    DeviceError
        If the port cannot be opened, or what answers is no SCPI device.
    """

    def __init__(
        self,
        port: str,
        *,
        name: str = "lamp",
        baud: int = 115_200,
        timeout_s: float = 0.5,
        now: Callable[[], float] = time.monotonic,
        drain_s: float = 0.25,
    ) -> None:
        if not timeout_s > 0.0 or not drain_s > 0.0:
            raise ConfigurationError(
                f"{name.capitalize()} on {port}: timeout_s = {timeout_s} and drain_s = {drain_s} must be above 0."
            )
        self._name = name
        self._url = port
        self._timeout_s = timeout_s
        self._drain_s = drain_s
        self._now = now
        self._rest = b""  # of a line that has begun to arrive
        self._identity = ""
        self._on: bool | None = None
        self._level: float | None = None
        self._port: Any = open_port(port, baud=baud)
        try:
            self._connect()
        except BaseException:
            self.close()
            raise

    def _connect(self) -> None:
        identity = self._query("*IDN?")
        if not identity or "," not in identity:
            raise ProtocolError(
                f"{self._label} answers *IDN? with {identity!r}, an SCPI device names maker,model,serial,version; "
                "check that the port is the lamp's."
            )
        self._identity = identity
        self._command("*CLS")  # errors of somebody before us

    @property
    def name(self) -> str:
        """As messages call it."""
        return self._name

    def set_output(self, on: bool) -> None:
        """Switch, and return when the lamp has confirmed.

        Raises
        ------
        DeviceError
            If it answers with an error, or says it is in the other state.
        """
        self._command(f"OUTP {'ON' if on else 'OFF'}")
        answer = self._query("OUTP?").upper()
        if answer not in ("0", "1", "OFF", "ON"):
            raise ProtocolError(f"{self._label} answers OUTP? with {answer!r}, it should be 0 or 1; check its manual.")
        if (answer in ("1", "ON")) != on:
            raise DeviceError(
                f"{self._label} was switched {'on' if on else 'off'} and says it is {'off' if on else 'on'}; "
                "look for an interlock or a front-panel lock."
            )
        self._on = on

    def set_level(self, fraction: float) -> None:
        """Set the drive level, 0 to 1, and return when the lamp has confirmed.

        Raises
        ------
        ConfigurationError
            Outside 0 to 1; nothing was sent.
        DeviceError
            If it answers with an error, or keeps another level.
        """
        _check_fraction(self._name, fraction)
        self._command(f"SOUR:LEV {fraction:.6g}")
        answer = self._query("SOUR:LEV?")
        try:
            found = float(answer)
        except ValueError:
            found = math.nan
        if not abs(found - fraction) <= _LEVEL_STEP:
            raise DeviceError(
                f"{self._label} keeps level {answer}, {fraction:.6g} was set; look for a current limit on its front panel."
            )
        self._level = found

    def describe(self) -> dict[str, object]:
        """Identity and state for the run's metadata (JSON-compatible); a lamp that was not switched yet is asked."""
        if self._on is None:
            self._on = self._query("OUTP?").upper() in ("1", "ON")
        return {
            "name": self._name, "kind": "scpi", "port": self._url, "identity": self._identity,
            "output": self._on, "level": self._level,
        }  # fmt: skip

    def close(self) -> None:
        """Close the port. The lamp stays as it is."""
        self._port.close()

    def __enter__(self) -> ScpiLamp:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    # -- the dialogue

    @property
    def _label(self) -> str:
        return f"{self._name.capitalize()} on {self._url}"

    def _command(self, text: str) -> None:
        """Send a command that has no answer, and see that it went well."""
        self._send(text)
        errors = []
        for _ in range(_ERROR_QUEUE):
            answer = self._query("SYST:ERR?")
            number, _, message = answer.partition(",")
            try:
                code = int(number)
            except ValueError:
                raise ProtocolError(
                    f"{self._label} answers SYST:ERR? with {answer!r}, it should be a number and a text; check its manual."
                ) from None
            if code == 0:
                break
            errors.append(f"{code} {message.strip().strip(chr(34))}")
        if errors:
            raise DeviceError(f"{self._label} refuses {text!r}: {'; '.join(errors)}; check the lamp's manual and range.")

    def _query(self, text: str) -> str:
        """Ask, again after a timeout: a question changes nothing."""
        for attempt in range(1, _ATTEMPTS + 1):
            self._send(text)
            answer = self._line()
            if answer is not None:
                return answer
            logger.info("%s: no answer to %s, try %d", self._label, text, attempt)
            self._drain()
            if attempt < _ATTEMPTS and not self._fence():
                break
        raise DeviceTimeoutError(
            f"{self._label} does not answer {text} within {self._timeout_s:g} s; check its power, cable and baud rate."
        )

    def _fence(self) -> bool:
        """After a timeout: True once the lamp gives its name, and nothing comes after it."""
        if not self._identity:
            return True  # the question that failed was *IDN? itself
        self._send("*IDN?")
        while (answer := self._line()) is not None:
            if answer == self._identity:
                self._drain()
                return True
        self._drain()
        return False

    def _send(self, text: str) -> None:
        with port_errors(self._label):
            self._port.reset_input_buffer()
            self._rest = b""
            self._port.write(text.encode("ascii") + b"\n")

    def _line(self) -> str | None:
        """Next line without its end; None after `timeout_s`."""
        deadline = self._now() + self._timeout_s
        empty = 0
        while b"\n" not in self._rest:
            with port_errors(self._label):
                data = bytes(self._port.read(1))
                waiting = self._port.in_waiting
                data += bytes(self._port.read(waiting)) if waiting else b""
            self._rest += data
            empty = 0 if data else empty + 1
            if len(self._rest) > _LINE_BYTES:
                raise ProtocolError(f"{self._label} sends {len(self._rest)} bytes without a line end; check its baud rate.")
            if self._now() >= deadline and b"\n" not in self._rest:
                return None
            if empty > _IDLE_READS:
                raise DeviceError(f"{self._label}: the clock of its timeouts stands still; give it the clock of its port.")
        line, _, self._rest = self._rest.partition(b"\n")
        return line.decode("ascii", errors="replace").strip()

    def _drain(self) -> None:
        """Read and discard until the line has been idle for `drain_s`."""
        start = quiet_since = self._now()
        self._rest = b""
        while self._now() - quiet_since < self._drain_s:
            with port_errors(self._label):
                data = self._port.read(256)
            if data:
                quiet_since = self._now()
            if self._now() - start > 20.0 * self._drain_s:
                raise ProtocolError(f"{self._label} does not fall silent; check its baud rate.")


class ManualLamp:
    """A lamp that a person switches; satisfies `gonio.interfaces.Lamp`.

    Parameters
    ----------
    ask : callable
        Shows a text and returns when the person has done it.
    name : str, optional
        As messages call it.
    """

    def __init__(self, ask: Callable[[str], None], *, name: str = "lamp") -> None:
        self._ask = ask
        self._name = name
        self._on: bool | None = None
        self._level: float | None = None

    @property
    def name(self) -> str:
        """As messages call it."""
        return self._name

    def set_output(self, on: bool) -> None:
        """Ask for the switch; not at all if the lamp is known to be so already."""
        if self._on is not on:
            self._ask(f"Switch the {self._name} {'on' if on else 'off'}.")
            self._on = on

    def set_level(self, fraction: float) -> None:
        """Ask for a drive level, 0 to 1."""
        _check_fraction(self._name, fraction)
        if self._level != fraction:
            self._ask(f"Set the {self._name} to {100.0 * fraction:g} % of its full output.")
            self._level = fraction

    def describe(self) -> dict[str, object]:
        """State for the run's metadata (JSON-compatible)."""
        return {"name": self._name, "kind": "manual", "output": self._on, "level": self._level}

    def close(self) -> None:
        """Nothing to close."""


def _check_fraction(name: str, fraction: float) -> None:
    if not 0.0 <= fraction <= 1.0:
        raise ConfigurationError(f"{name.capitalize()} level {fraction:g} is outside 0 to 1; give a fraction of it.")
