"""A servo's own clock against the rig's: the age of every state that it sends.

Realtime Tick counts milliseconds and is part of each state. Question and answer enclose the instant of the state, so each
of them bounds the offset between the two clocks; together they know it to about a millisecond. An answer that belongs to
an older question, late, repeated or queued behind another, then shows its age. Pure arithmetic; it reads nothing.

References: ROBOTIS e-manual, XM430-W350, Realtime Tick (120) (emanual.robotis.com/docs/en/dxl/x/xm430-w350).
"""

from __future__ import annotations

from drivers.dynamixel.registers import Block

_TURN_S = 32.768  # the tick begins anew
_RESOLUTION_S = 0.001
_DRIFT = 0.02  # of one clock against the other
_TOO_LONG_S = 0.25 * _TURN_S / _DRIFT  # without an answer, after which the offset is lost


class TickClock:
    """What is known of one servo's clock.

    Parameters
    ----------
    state : Block
        A first state; it is believed.
    """

    def __init__(self, state: Block) -> None:
        self._lower, self._upper = _offsets(state)
        self._seen_s = state.received_s

    def accepts(self, state: Block) -> bool:
        """Whether a state is of the time at which it was asked for; if so, the clock is known better than before."""
        elapsed = state.received_s - self._seen_s
        lower, upper = _offsets(state)
        if elapsed < _TOO_LONG_S:
            slack = 0.2 * _RESOLUTION_S + _DRIFT * elapsed
            middle = 0.5 * (self._lower + self._upper)
            turns = _TURN_S * round((0.5 * (lower + upper) - middle) / _TURN_S)
            lower, upper = lower - turns, upper - turns
            if lower > self._upper + slack or upper < self._lower - slack:
                return False
            lower = min(max(lower, self._lower - slack), upper)
            upper = max(min(upper, self._upper + slack), lower)
            spare = max(0.0, 0.5 * (_RESOLUTION_S - (upper - lower)))  # nothing is known better than the tick
            lower, upper = lower - spare, upper + spare
        self._lower, self._upper = lower, upper
        self._seen_s = state.received_s
        return True

    def restarted(self, first: Block, second: Block) -> bool:
        """Whether two states that are not accepted mean that the servo has restarted since the last one that was.

        Its tick then began at 0; and the two agree with each other.
        """
        since_s = first.received_s - self._seen_s
        return _RESOLUTION_S * first.tick <= since_s and TickClock(first).accepts(second)


def _offsets(state: Block) -> tuple[float, float]:
    """Between which the servo's clock is ahead of the rig's [s], modulo its turn."""
    tick_s = _RESOLUTION_S * state.tick
    return tick_s - state.received_s, tick_s + _RESOLUTION_S - state.sent_s
