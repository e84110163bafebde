"""A lamp that speaks SCPI lines, and the light it gives.

Bytes in, replies out; it knows no port. It understands long and short forms in any case, a leading colon, compound lines
with semicolons, and queues errors as SCPI-1999 asks for. It has one channel. Its light warms up and drifts, which the
host cannot see on the line; `relative_output` says it to the simulated world.

Commands: ``*IDN?  *RST  *CLS  *OPC?  OUTPut[:STATe] ON|OFF|1|0  OUTPut[:STATe]?  SOURce:LEVel 0..1  SOURce:LEVel?
SYSTem:ERRor[:NEXT]?  SYSTem:VERSion?``

References
----------
SCPI-1999, volumes 1 (syntax) and 2 (SYSTem:ERRor, error numbers); IEEE 488.2-1992 (common commands).
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable

_QUEUE = 16  # errors kept
_LINE = 256  # longest line taken [bytes]

_ERRORS = {
    0: "No error",
    -101: "Invalid character",
    -104: "Data type error",
    -108: "Parameter not allowed",
    -109: "Missing parameter",
    -113: "Undefined header",
    -222: "Data out of range",
    -224: "Illegal parameter value",
    -350: "Queue overflow",
    -363: "Input buffer overrun",
}


class Rejected(Exception):
    """Not an error of ours: the lamp queues an error number."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


class ScpiLamp:
    """The lamp.

    Parameters
    ----------
    drift_per_hour : float, optional
        Relative change of the light per hour that it has been on.
    warm_up : float, optional
        Fraction of the light that is missing right after switching on.
    warm_up_s : float, optional
        Time constant of its return [s].
    identity : str, optional
        Answer to ``*IDN?``: manufacturer, model, serial number, firmware.

    Attributes
    ----------
    silent : bool
        Set it to make the lamp neither listen nor answer.
    burnt_out : bool
        Set it to make the lamp dark whatever its output state says.
    """

    def __init__(
        self,
        *,
        drift_per_hour: float = 0.0,
        warm_up: float = 0.0,
        warm_up_s: float = 20.0,
        identity: str = "gonio,simulated lamp,0,1.0",
    ) -> None:
        self.drift_per_hour = drift_per_hour
        self.warm_up = warm_up
        self.warm_up_s = warm_up_s
        self.identity = identity
        self.silent = False
        self.burnt_out = False
        self._line = bytearray()
        self._overrun = False
        self._errors: deque[int] = deque()
        self._on_since: float | None = None
        self._level = 1.0

    @property
    def on(self) -> bool:
        """Whether the output is on."""
        return self._on_since is not None

    @property
    def level(self) -> float:
        """Drive level, 0 to 1."""
        return self._level

    def relative_output(self, t: float) -> float:
        """Light at `t` [s], relative to that of a warm lamp at full level without drift [1].

        With h the time since it was switched on: level (1 + drift h) (1 - warm_up exp(-h / warm_up_s)).
        """
        if self._on_since is None or self.burnt_out:
            return 0.0
        age = max(t - self._on_since, 0.0)
        warm = 1.0 - self.warm_up * math.exp(-age / self.warm_up_s)
        return self._level * (1.0 + self.drift_per_hour * age / 3600.0) * warm

    def feed(self, data: bytes, t: float) -> list[tuple[float, bytes]]:
        """Take bytes that arrived at `t` [s]; return replies with their delays [s], as a bus does."""
        if self.silent:
            return []
        replies = []
        for byte in data:
            if byte == 0x0A:
                if self._overrun:
                    self._fail(-363)
                else:
                    answer = self._execute(self._line.decode("ascii", "replace"), t)
                    if answer:
                        replies.append((0.0, answer.encode("ascii") + b"\n"))
                self._line.clear()
                self._overrun = False
            elif len(self._line) < _LINE:
                self._line.append(byte)
            else:
                self._overrun = True
        return replies

    def idle(self) -> None:
        """The line was silent for a while; SCPI has no time limit within a line."""

    # ---- the language ------------------------------------------------------------------------------------------

    def _execute(self, line: str, t: float) -> str:
        """One line; the answers of its queries, joined by semicolons."""
        answers = []
        branch = ""  # where in the tree a header without a leading colon continues
        for unit in line.strip().split(";"):
            text = unit.strip()
            if not text:
                continue
            try:
                if not text.isascii() or not text.isprintable():
                    raise Rejected(-101)
                header, _, rest = text.partition(" ")
                if not header.startswith(("*", ":")):
                    header = branch + header
                header = header.removeprefix(":")
                answer = self._command(header, rest.strip(), t)
                if not header.startswith("*"):
                    branch = header[: header.rfind(":") + 1]
                if answer is not None:
                    answers.append(answer)
            except Rejected as rejected:
                self._fail(rejected.number)
                break
        return ";".join(answers)

    def _command(self, header: str, parameter: str, t: float) -> str | None:
        for pattern, action in self._tree().items():
            if re.fullmatch(pattern, header, re.IGNORECASE):
                return action(parameter, t)
        raise Rejected(-113)

    def _tree(self) -> dict[str, Callable[[str, float], str | None]]:
        return {
            r"\*IDN\?": lambda p, t: self._query(p, self.identity),
            r"\*OPC\?": lambda p, t: self._query(p, "1"),
            r"\*RST": self._reset,
            r"\*CLS": self._clear,
            r"OUTP(UT)?(:STAT(E)?)?": self._set_output,
            r"OUTP(UT)?(:STAT(E)?)?\?": lambda p, t: self._query(p, str(int(self.on))),
            r"SOUR(CE)?:LEV(EL)?": self._set_level,
            r"SOUR(CE)?:LEV(EL)?\?": lambda p, t: self._query(p, f"{self._level:.6g}"),
            r"SYST(EM)?:ERR(OR)?(:NEXT)?\?": lambda p, t: self._query(p, self._next_error() if not p else ""),
            r"SYST(EM)?:VERS(ION)?\?": lambda p, t: self._query(p, "1999.0"),
        }

    @staticmethod
    def _query(parameter: str, answer: str) -> str:
        if parameter:
            raise Rejected(-108)
        return answer

    def _reset(self, parameter: str, t: float) -> None:
        self._query(parameter, "")
        self._on_since = None
        self._level = 1.0

    def _clear(self, parameter: str, t: float) -> None:
        self._query(parameter, "")
        self._errors.clear()

    def _set_output(self, parameter: str, t: float) -> None:
        if not parameter:
            raise Rejected(-109)
        word = parameter.upper()
        if word in ("ON", "1"):
            self._on_since = t if self._on_since is None else self._on_since
        elif word in ("OFF", "0"):
            self._on_since = None
        else:
            raise Rejected(-224 if word.isalpha() or word.isdigit() else -104)

    def _set_level(self, parameter: str, t: float) -> None:
        if not parameter:
            raise Rejected(-109)
        word = parameter.upper()
        if word in ("MIN", "MINIMUM", "MAX", "MAXIMUM"):
            self._level = float(word.startswith("MAX"))
            return
        # A decimal number of IEEE 488.2; not "nan", not "1_0", which Python's float would take.
        if not re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)(E[+-]?\d+)?", word):
            raise Rejected(-108 if "," in word else -104)
        value = float(word)
        if not 0.0 <= value <= 1.0:
            raise Rejected(-222)
        self._level = value

    def _fail(self, number: int) -> None:
        """Queue an error; a full queue's last entry becomes the overflow."""
        if len(self._errors) < _QUEUE:
            self._errors.append(number)
        else:
            self._errors[-1] = -350

    def _next_error(self) -> str:
        number = self._errors.popleft() if self._errors else 0
        return f'{number},"{_ERRORS[number]}"'
