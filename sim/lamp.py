"""A lamp that speaks SCPI lines, and the light it gives.

Bytes in, replies out; it knows no port. It understands long and short forms in any case, a leading colon, compound lines
with semicolons, and queues errors as SCPI-1999 asks for. A head with several LEDs has a channel each, selected by
``INSTrument`` or by a numeric suffix. Its light warms up and drifts, which the host cannot see on the line;
`relative_output` says it to the simulated world, also for a time that has passed.

Commands: ``*IDN?  *RST  *CLS  *OPC  *OPC?  *WAI  *TST?  *ESE n  *ESE?  *ESR?  *SRE n  *SRE?  *STB?
OUTPut[n][:STATe] ON|OFF|1|0  OUTPut[n][:STATe]?  SOURce[n]:LEVel 0..1|MIN|MAX  SOURce[n]:LEVel?  INSTrument:CATalog?
INSTrument[:SELect] CHn  INSTrument[:SELect]?  INSTrument:NSELect n  INSTrument:NSELect?  SYSTem:ERRor[:NEXT]?
SYSTem:ERRor:COUNt?  SYSTem:VERSion?``

References
----------
SCPI-1999, volumes 1 (syntax) and 2 (INSTrument, SYSTem:ERRor, error numbers); IEEE 488.2-1992 (common commands, status).
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

_QUEUE = 16  # errors kept
_LINE = 256  # longest line taken [bytes]
_REMEMBERED = 256  # switchings

_ERRORS = {
    0: "No error",
    -101: "Invalid character",
    -104: "Data type error",
    -108: "Parameter not allowed",
    -109: "Missing parameter",
    -113: "Undefined header",
    -114: "Header suffix out of range",
    -222: "Data out of range",
    -224: "Illegal parameter value",
    -350: "Queue overflow",
    -363: "Input buffer overrun",
}
_OPERATION_COMPLETE, _DEVICE, _EXECUTION, _COMMAND = 0x01, 0x08, 0x10, 0x20  # bits of the event status register


class Rejected(Exception):
    """Not an error of ours: the lamp queues an error number."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


@dataclass(frozen=True)
class Channel:
    """One LED of the head.

    Attributes
    ----------
    share : float
        Of the lamp's full intensity, at full level.
    colour : tuple of float
        How red, green and blue it is; white is 1, 1, 1.
    """

    share: float = 1.0
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class _State:
    """Of one channel, from `since` [s] on."""

    since: float
    on_since: float | None
    level: float


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
    channels : sequence of Channel, optional
        One white one by default.
    identity : str, optional
        Answer to ``*IDN?``: manufacturer, model, serial number, firmware.

    Attributes
    ----------
    silent : bool
        Set it to make the lamp neither listen nor answer.
    burnt_out_at : float
        From when on it is dark whatever its output state says [s]; infinite for never.
    """

    def __init__(
        self,
        *,
        drift_per_hour: float = 0.0,
        warm_up: float = 0.0,
        warm_up_s: float = 20.0,
        channels: Sequence[Channel] = (Channel(),),
        identity: str = "gonio,simulated lamp,0,1.0",
    ) -> None:
        self.drift_per_hour = drift_per_hour
        self.warm_up = warm_up
        self.warm_up_s = warm_up_s
        self.channels = tuple(channels)
        self.identity = identity
        self.silent = False
        self.burnt_out_at = math.inf
        self._line = bytearray()
        self._overrun = False
        self._errors: deque[int] = deque()
        self._past = [deque([_State(-math.inf, None, 1.0)], _REMEMBERED) for _ in self.channels]
        self._selected = 0
        self._events = self._event_mask = self._service_mask = 0

    @property
    def on(self) -> bool:
        """Whether any output is on."""
        return any(past[-1].on_since is not None for past in self._past)

    @property
    def level(self) -> float:
        """Drive level of the selected channel, 0 to 1."""
        return self._past[self._selected][-1].level

    def relative_output(self, t: float) -> float:
        """Light at `t` [s], relative to that of a warm lamp at full level on all channels without drift [1].

        With h the time since a channel was switched on: share level (1 + drift h) (1 - warm_up exp(-h / warm_up_s)).
        """
        return sum(self._outputs(t))

    def colour(self, t: float) -> tuple[float, float, float]:
        """How red, green and blue the light is at `t` [s]; of a dark lamp, white."""
        parts = self._outputs(t)
        total = sum(parts)
        if total <= 0.0:
            return (1.0, 1.0, 1.0)
        mixed = [sum(p * c.colour[k] for p, c in zip(parts, self.channels, strict=True)) / total for k in range(3)]
        return (mixed[0], mixed[1], mixed[2])

    def _outputs(self, t: float) -> list[float]:
        """Light of each channel at `t`."""
        found = []
        for channel, past in zip(self.channels, self._past, strict=True):
            state = next((s for s in reversed(past) if s.since <= t), past[0])
            if state.on_since is None or t >= self.burnt_out_at:
                found.append(0.0)
                continue
            age = max(t - state.on_since, 0.0)
            warm = 1.0 - self.warm_up * math.exp(-age / self.warm_up_s)
            found.append(channel.share * state.level * (1.0 + self.drift_per_hour * age / 3600.0) * warm)
        return found

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
            if found := re.fullmatch(pattern, header, re.IGNORECASE):
                return action(found.group(1) if found.groups() else "", parameter, t)
        raise Rejected(-113)

    def _tree(self) -> dict[str, Callable[[str, str, float], str | None]]:
        """Actions by header; they get the header's numeric suffix, the parameter and the time."""
        return {
            r"\*IDN\?": lambda n, p, t: self._query(p, self.identity),
            r"\*OPC\?": lambda n, p, t: self._query(p, "1"),
            r"\*TST\?": lambda n, p, t: self._query(p, "0"),
            r"\*OPC": lambda n, p, t: self._note(p, _OPERATION_COMPLETE),
            r"\*WAI": lambda n, p, t: self._note(p, 0),
            r"\*RST": self._reset,
            r"\*CLS": self._clear,
            r"\*ESE": lambda n, p, t: setattr(self, "_event_mask", self._byte(p)),
            r"\*SRE": lambda n, p, t: setattr(self, "_service_mask", self._byte(p)),
            r"\*ESE\?": lambda n, p, t: self._query(p, str(self._event_mask)),
            r"\*SRE\?": lambda n, p, t: self._query(p, str(self._service_mask)),
            r"\*ESR\?": self._event_status,
            r"\*STB\?": lambda n, p, t: self._query(p, str(self._status())),
            r"OUTP(?:UT)?(\d*)(?::STAT(?:E)?)?": self._set_output,
            r"OUTP(?:UT)?(\d*)(?::STAT(?:E)?)?\?": lambda n, p, t: self._query(p, str(int(self._is_on(n)))),
            r"SOUR(?:CE)?(\d*):LEV(?:EL)?": self._set_level,
            r"SOUR(?:CE)?(\d*):LEV(?:EL)?\?": lambda n, p, t: self._query(p, f"{self._state(n).level:.6g}"),
            r"INST(?:RUMENT)?:CAT(?:ALOG)?\?": lambda n, p, t: self._query(p, ",".join(f'"{c}"' for c in self._names)),
            r"INST(?:RUMENT)?(?::SEL(?:ECT)?)?": self._select,
            r"INST(?:RUMENT)?(?::SEL(?:ECT)?)?\?": lambda n, p, t: self._query(p, self._names[self._selected]),
            r"INST(?:RUMENT)?:NSEL(?:ECT)?": lambda n, p, t: self._select(n, f"CH{self._integer(p)}", t),
            r"INST(?:RUMENT)?:NSEL(?:ECT)?\?": lambda n, p, t: self._query(p, str(self._selected + 1)),
            r"SYST(?:EM)?:ERR(?:OR)?(?::NEXT)?\?": lambda n, p, t: self._query(p, self._next_error() if not p else ""),
            r"SYST(?:EM)?:ERR(?:OR)?:COUN(?:T)?\?": lambda n, p, t: self._query(p, str(len(self._errors))),
            r"SYST(?:EM)?:VERS(?:ION)?\?": lambda n, p, t: self._query(p, "1999.0"),
        }

    @property
    def _names(self) -> tuple[str, ...]:
        return tuple(f"CH{k + 1}" for k in range(len(self.channels)))

    def _channel(self, suffix: str) -> int:
        """Index of the channel that a header's suffix names; the selected one without a suffix."""
        number = int(suffix) - 1 if suffix else self._selected
        if not 0 <= number < len(self.channels):
            raise Rejected(-114)
        return number

    def _state(self, suffix: str) -> _State:
        return self._past[self._channel(suffix)][-1]

    def _is_on(self, suffix: str) -> bool:
        return self._state(suffix).on_since is not None

    @staticmethod
    def _query(parameter: str, answer: str) -> str:
        if parameter:
            raise Rejected(-108)
        return answer

    @staticmethod
    def _integer(parameter: str) -> int:
        if not parameter:
            raise Rejected(-109)
        if not re.fullmatch(r"[+-]?\d{1,9}", parameter):
            raise Rejected(-104)
        return int(parameter)

    def _byte(self, parameter: str) -> int:
        value = self._integer(parameter)
        if not 0 <= value <= 255:
            raise Rejected(-222)
        return value

    def _note(self, parameter: str, event: int) -> None:
        self._query(parameter, "")
        self._events |= event

    def _reset(self, suffix: str, parameter: str, t: float) -> None:
        self._query(parameter, "")
        self._selected = 0
        for past in self._past:
            past.append(_State(t, None, 1.0))

    def _clear(self, suffix: str, parameter: str, t: float) -> None:
        self._query(parameter, "")
        self._errors.clear()
        self._events = 0

    def _event_status(self, suffix: str, parameter: str, t: float) -> str:
        """Read, and so cleared."""
        found, self._events = self._query(parameter, str(self._events)), 0
        return found

    def _status(self) -> int:
        """Status byte: error queue not empty (2), event summary (5), request for service (6)."""
        byte = 4 * bool(self._errors) + 32 * bool(self._events & self._event_mask)
        return byte + 64 * bool(byte & self._service_mask)

    def _select(self, suffix: str, parameter: str, t: float) -> None:
        if not parameter:
            raise Rejected(-109)
        name = parameter.strip('"').upper()
        if name not in self._names:
            raise Rejected(-224)
        self._selected = self._names.index(name)

    def _set_output(self, suffix: str, parameter: str, t: float) -> None:
        if not parameter:
            raise Rejected(-109)
        word, before = parameter.upper(), self._state(suffix)
        if word in ("ON", "1"):
            since = t if before.on_since is None else before.on_since
        elif word in ("OFF", "0"):
            since = None
        else:
            raise Rejected(-224 if word.isalpha() or word.isdigit() else -104)
        self._past[self._channel(suffix)].append(_State(t, since, before.level))

    def _set_level(self, suffix: str, parameter: str, t: float) -> None:
        if not parameter:
            raise Rejected(-109)
        word, before = parameter.upper(), self._state(suffix)
        if word in ("MIN", "MINIMUM", "MAX", "MAXIMUM"):
            value = float(word.startswith("MAX"))
        else:
            # A decimal number of IEEE 488.2; not "nan", not "1_0", which Python's float would take.
            if not re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)(E[+-]?\d+)?", word):
                raise Rejected(-108 if "," in word else -104)
            value = float(word)
        if not 0.0 <= value <= 1.0:
            raise Rejected(-222)
        self._past[self._channel(suffix)].append(_State(t, before.on_since, value))

    def _fail(self, number: int) -> None:
        """Queue an error; a full queue's last entry becomes the overflow."""
        self._events |= _COMMAND if number > -200 else _EXECUTION if number > -300 else _DEVICE
        if len(self._errors) < _QUEUE:
            self._errors.append(number)
        else:
            self._errors[-1] = -350

    def _next_error(self) -> str:
        number = self._errors.popleft() if self._errors else 0
        return f'{number},"{_ERRORS[number]}"'
