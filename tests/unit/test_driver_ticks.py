"""A servo's clock tells how old a state is: drift, the tick's turn, answers queued behind others, restarts."""

from __future__ import annotations

from dataclasses import replace

import pytest

from drivers.dynamixel.registers import BLOCK_SIZE, Block, decode_block
from drivers.dynamixel.ticks import TickClock

AT_REST = decode_block(bytes(BLOCK_SIZE), alert=False, sent_s=0.0, received_s=0.0)


def state(
    sent_s: float, *, of_s: float | None = None, rate: float = 1.0, took_s: float = 0.001, began_s: float = -5.0
) -> Block:
    """A state asked for at `sent_s` [s] by a servo that began at `began_s`, in truth of the time `of_s`."""
    true_s = sent_s + 0.5 * took_s if of_s is None else of_s
    return replace(AT_REST, tick=int(1000.0 * rate * (true_s - began_s)) % 32768, sent_s=sent_s, received_s=sent_s + took_s)


@pytest.mark.parametrize("rate", [0.985, 1.0, 1.015])
@pytest.mark.parametrize("step_s", [0.003, 0.7, 20.0])
def test_its_own_states_are_accepted_for_ever(rate: float, step_s: float) -> None:
    clock = TickClock(state(0.0, rate=rate))
    assert all(clock.accepts(state(step_s * k, rate=rate)) for k in range(1, 300))


@pytest.mark.parametrize("age_s", [0.004, 0.05, 1.0, 16.0, 30.0])
def test_an_older_state_is_not(age_s: float) -> None:
    clock = TickClock(state(0.0))
    assert all(clock.accepts(state(0.003 * k)) for k in range(1, 50))
    assert not clock.accepts(state(0.15, of_s=0.15 - age_s))
    assert clock.accepts(state(0.153))


def test_an_answer_queued_behind_another_is_not() -> None:
    """The answer before comes twice, 0.3 s apart; each next question then gets the answer of the one before it."""
    clock = TickClock(state(0.0))
    assert clock.accepts(state(0.001, of_s=0.0015, took_s=0.3))
    assert not clock.accepts(state(0.302, of_s=0.0025, took_s=0.0005))


def test_a_restart_is_told_from_an_old_answer() -> None:
    clock = TickClock(state(0.0))
    first, second = state(3.0, began_s=1.0), state(3.3, began_s=1.0)
    assert not clock.accepts(first)
    assert clock.restarted(first, second)
    assert not clock.restarted(state(3.0, of_s=2.5), state(3.3, of_s=2.8))  # of one age, but the clock did not begin anew
