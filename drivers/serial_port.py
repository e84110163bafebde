"""Opening a serial port: any pyserial URL or path, for this process alone, with errors that say what to do.

It knows no protocol and keeps no state. It does not guess ports and never opens one twice. Times are monotonic; the
reads of the port that comes back wait at most one short slice, so that the caller's own clock decides about timeouts.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import logging
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gonio.errors import DeviceError
from gonio.lock import FileLock, HeldError

logger = logging.getLogger(__name__)

READ_SLICE_S = 0.010
"""How long one read of a port waits for bytes [s]: long enough not to spin, short beside every timeout."""

_PSEUDO_TERMINALS = ("/dev/pts/", "/dev/ttys")  # Linux, macOS
_PLAIN_BAUD = 115200


def resolve(url: str) -> str:
    """The path or URL that `url` means: a pattern of file names (``/dev/serial/by-id/*FTDI*``) means its only match.

    Raises
    ------
    DeviceError
        If a pattern has no match, or several.
    """
    if "://" in url or not any(c in url for c in "*?["):
        return url
    found = sorted(str(path) for path in Path(url).parent.glob(Path(url).name))
    if len(found) != 1:
        what = f"several ports: {', '.join(found)}; make it narrower" if found else "no port; plug the adapter in"
        raise DeviceError(f"The pattern {url} means {what}.")
    return found[0]


def open_port(url: str, *, baud: int, slice_s: float = READ_SLICE_S, write_timeout_s: float = 1.0) -> Any:
    """Open a serial port exclusively.

    Parameters
    ----------
    url : str
        A path (``/dev/ttyUSB0``, ``COM3``), a pattern of one, or a pyserial URL (``socket://host:port``, ``rfc2217://...``).
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
    A lock file names the process that holds a path, for the message that another one gets. pyserial's ``exclusive`` is an
    advisory lock that other polite programs see; TIOCEXCL makes the kernel refuse further opens too (root excepted). It is
    set on real ports only: the flag lives as long as the terminal, and a simulator keeps its pseudo-terminal open after us.
    """
    import serial

    url = resolve(url)
    plain = "://" not in url
    options: dict[str, Any] = {"timeout": slice_s, "write_timeout": write_timeout_s}
    try:
        if plain:
            port = _exclusive(url, baud, options)
        else:
            port = serial.serial_for_url(url, baudrate=baud, **options)
        port.reset_input_buffer()
    except (OSError, ValueError) as error:
        raise DeviceError(_explain(url, baud, error)) from error
    return port


def lock_path(url: str) -> Path:
    """File that names the process which holds a port, whatever name the port was given."""
    name = str(Path(url).resolve()).strip("/\\").replace("/", "-").replace("\\", "-").replace(":", "")
    return Path(tempfile.gettempdir()) / "gonio-ports" / f"{name}.lock"


def holder(url: str) -> int | None:
    """Process on this machine that holds a port, None if none does or it cannot be told."""
    if "://" in url or not (path := lock_path(resolve(url))).exists():
        return None
    try:
        FileLock(path).acquire().release()
    except HeldError as held:
        return held.pid
    except OSError:
        pass
    return None


def _exclusive(path: str, baud: int, options: dict[str, Any]) -> Any:
    """A port by its path, opened by nobody else; closing it gives back its lock."""
    lock = FileLock(lock_path(path))
    with contextlib.suppress(FileExistsError):
        lock_path(path).parent.mkdir()
        lock_path(path).parent.chmod(0o1777)  # for all users, each for his own files
    try:
        lock.acquire()
    except HeldError as holder:
        raise DeviceError(f"Port {path} is in use by {holder}; end that one first.") from None
    except OSError as error:  # the kernel's own locks below still hold
        logger.warning("port %s: no lock file (%s)", path, error)
    try:
        try:
            port = _owned()(path, baud, exclusive=True, **options)
        except OSError as error:
            # macOS: a pseudo-terminal has no line rate and refuses the uncommon ones (serial.SerialException is an
            # OSError, but only the raw ioctl error has this number).
            if error.errno != errno.ENOTTY or baud == _PLAIN_BAUD:
                raise
            port = _owned()(path, _PLAIN_BAUD, exclusive=True, **options)
    except BaseException:
        lock.release()
        raise
    port.lock = lock
    _lock_terminal(path, port)
    return port


@functools.cache
def _owned() -> Any:
    """pyserial's port for paths, which gives back its lock when it is closed."""
    import serial

    class OwnedPort(serial.Serial):  # type: ignore[misc]
        lock: FileLock | None = None

        def close(self) -> None:
            super().close()
            if self.lock is not None:
                self.lock.release()

    return OwnedPort


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


class PortLostError(DeviceError):
    """A port that was open is gone."""


@contextmanager
def port_errors(thing: str) -> Iterator[None]:
    """Turn a failure of the port (unplugged, closed by the other end) into a `PortLostError` that names `thing`."""
    try:
        yield
    except Exception as error:
        # serial.SerialException is an OSError; flushing a vanished terminal raises termios.error, which is not
        if not isinstance(error, OSError) and type(error).__module__ != "termios":
            raise
        raise PortLostError(f"{thing} failed ({error}); plug it in again, check its power, and resume.") from error
