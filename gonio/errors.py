"""One tree of errors; the command line turns each into one sentence and an exit code.

::

    GonioError
    ├── ConfigurationError  2   what the user wrote: a file, an option, a parameter
    │   ├── GeometryError       an angle, a direction or a gradient outside its range
    │   └── ParameterError      a model or source parameter outside its range
    ├── DeviceError         3   a servo, a camera, a lamp, a port
    │   ├── DeviceTimeoutError  no answer
    │   ├── ProtocolError       an answer that is not one
    │   ├── HardwareStatusError the device reports a fault of its own
    │   └── LimitError          a move refused before a byte was sent
    ├── MeasurementError    4   the devices work, the measurement does not
    ├── ConvergenceError    5   carries ``best``, what was reached
    │   └── IntegrationError
    └── DatasetError        6   a file or a data set that cannot be read or trusted

A message has the thing, both numbers with their units, and what to do next.
"""

from __future__ import annotations

EXIT_INTERRUPTED = 130


class GonioError(Exception):
    """Root of all errors that gonio raises on purpose."""

    exit_code = 1


class ConfigurationError(GonioError):
    """What the user wrote cannot be used."""

    exit_code = 2


class GeometryError(ConfigurationError, ValueError):
    """An angle, a direction or a gradient is outside its range."""


class ParameterError(ConfigurationError, ValueError):
    """A parameter of a model or a source is outside its range, unknown or missing."""


class DeviceError(GonioError):
    """A device does not do what it was told."""

    exit_code = 3


class DeviceTimeoutError(DeviceError):
    """A device does not answer."""


class ProtocolError(DeviceError):
    """Bytes arrived that are no valid answer."""


class HardwareStatusError(DeviceError):
    """A device answers with an error of its own (overload, overheating, voltage, ...)."""


class LimitError(DeviceError):
    """A move beyond a limit was asked for; nothing was sent."""


class MeasurementError(GonioError):
    """Devices answer, but the measurement cannot be trusted (saturation, drift, no reference, ...)."""

    exit_code = 4


class ConvergenceError(GonioError):
    """An iteration ended before its tolerance.

    Attributes
    ----------
    best : object
        The best result reached, with its error.
    """

    exit_code = 5

    def __init__(self, message: str, best: object = None) -> None:
        super().__init__(message)
        self.best = best


class IntegrationError(ConvergenceError):
    """A quadrature did not reach the tolerance asked for."""


class DatasetError(GonioError):
    """A file or data set is damaged, of the wrong kind, or does not hold what is needed."""

    exit_code = 6
