"""Opening a serial port: any pyserial URL or path, for this process alone, with errors that say what to do.

It knows no protocol and keeps no state. It does not guess ports and never opens one twice. Times are monotonic; the
reads of the port that comes back wait at most one short slice, so that the caller's own clock decides about timeouts.
"""

from __future__ import annotations

import errno
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gonio.errors import DeviceError

logger = logging.getLogger(__name__)

READ_SLICE_S = 0.002
"""How long one read of a port waits for bytes [s]: long enough not to spin, short beside every timeout."""

_PSEUDO_TERMINALS = ("/dev/pts/", "/dev/ttys")  # Linux, macOS
_PLAIN_BAUD = 115200


def open_port(url: str, *, baud: int, slice_s: float = READ_SLICE_S, write_timeout_s: float = 1.0) -> Any:
    """Open a serial port exclusively.

    Parameters
    ----------
    url : str
        A path (``/dev/ttyUSB0``, ``COM3``) or a pyserial URL (``socket://host:port``, ``rfc2217://...``).
    baud : int
        Line rate [bit/s].
    slice_s : float, optional
        Longest wait of one ``read`` [s].
    write_timeout_s : float, optional
        Longest wait of one ``write`` [s].

    Returns
    -------
    serial.SerialBase
        Open, its input buffer empty.

    Raises
    ------
    DeviceError
        If it cannot be opened; the message names the port and the remedy.

    Notes
    -----
    pyserial's ``exclusive`` is an advisory lock that only other polite programs see; TIOCEXCL makes the kernel refuse
    further opens too (root excepted). It is set on real ports only: the flag lives as long as the terminal, and a
    simulator keeps its pseudo-terminal open after us.
    """
    import serial

    plain = "://" not in url
    options: dict[str, Any] = {"timeout": slice_s, "write_timeout": write_timeout_s}
    if plain:
        options["exclusive"] = True
    try:
        try:
            port = serial.serial_for_url(url, baudrate=baud, **options)
        except OSError as error:
            # macOS: a pseudo-terminal has no line rate and refuses the uncommon ones (serial.SerialException is an
            # OSError, but only the raw ioctl error has this number).
            if not plain or error.errno != errno.ENOTTY or baud == _PLAIN_BAUD:
                raise
            port = serial.serial_for_url(url, baudrate=_PLAIN_BAUD, **options)
        port.reset_input_buffer()
    except (OSError, ValueError) as error:
        raise DeviceError(_explain(url, baud, error)) from error
    if plain:
        _lock_terminal(url, port)
    return port


def _lock_terminal(url: str, port: Any) -> None:
    """Ask the kernel to refuse further opens; best effort."""
    if str(Path(url).resolve()).startswith(_PSEUDO_TERMINALS):
        return
    try:
        import fcntl
        import termios
    except ImportError:  # Windows opens serial ports exclusively anyway
        return
    try:
        fcntl.ioctl(port.fileno(), termios.TIOCEXCL)
    except OSError as error:
        logger.info("port %s: no TIOCEXCL (%s)", url, error)


def _explain(url: str, baud: int, error: Exception) -> str:
    """One sentence with the remedy."""
    number = getattr(error, "errno", None)
    text = str(error)
    if isinstance(error, ValueError) and "not known" in text:
        return f"Port {url}: no such kind of port; use a device path, socket://HOST:PORT or rfc2217://HOST:PORT."
    if isinstance(error, ValueError):
        return f"Port {url} does not take {baud} baud ({text}); set [bus] baud to the rate of the servos."
    if number == errno.ENOENT or "FileNotFoundError" in text:
        return f"Port {url} does not exist; plug the adapter in (`python -m serial.tools.list_ports` lists the ports)."
    if number == errno.EACCES or "PermissionError" in text or "Access is denied" in text:
        return (
            f"Port {url} may not be opened by this user, or another program holds it; "
            "join the group that owns it (often dialout: `sudo usermod -aG dialout $USER`, then log in again)."
        )
    if number in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in text:
        return f"Port {url} is in use by another program; close that one first (on Linux `fuser {url}` names it)."
    if number == errno.ECONNREFUSED or "refused" in text:
        return f"Port {url}: nothing listens there; start the server or the simulator first."
    return f"Port {url} cannot be opened ({text}); check cable, power and the name in rig.toml."


@contextmanager
def port_errors(thing: str) -> Iterator[None]:
    """Turn a failure of the port (unplugged, closed by the other end) into a `DeviceError` that names `thing`."""
    try:
        yield
    except Exception as error:
        # serial.SerialException is an OSError; flushing a vanished terminal raises termios.error, which is not
        if not isinstance(error, OSError) and type(error).__module__ != "termios":
            raise
        raise DeviceError(f"{thing} failed ({error}); plug it in again, check its power, and resume.") from error
