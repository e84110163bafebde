"""Signals: the first asks, the second ends, and afterwards everything is as it was."""

from __future__ import annotations

import signal
import threading

import pytest

from gonio.scan.interrupt import Interrupted, interrupts


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_the_first_signal_only_asks(name: str) -> None:
    number = getattr(signal, name, None)
    if number is None:
        pytest.skip(f"no {name} here")
    before = signal.getsignal(number)
    with interrupts() as stop:
        stop.check("go on")
        signal.raise_signal(number)
        with pytest.raises(Interrupted, match=f"stopped by {'Ctrl-C' if name == 'SIGINT' else name}.*then resume"):
            stop.check("then resume")
    assert signal.getsignal(number) is before


def test_the_second_one_ends_at_once() -> None:
    with pytest.raises(KeyboardInterrupt) as caught, interrupts():
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
    assert not isinstance(caught.value, Interrupted)


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no SIGHUP here")
def test_an_ignored_signal_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with interrupts() as stop:
            signal.raise_signal(signal.SIGHUP)
            stop.check("")
    finally:
        signal.signal(signal.SIGHUP, before)


def test_outside_the_main_thread_no_handler_is_touched() -> None:
    before = signal.getsignal(signal.SIGINT)
    seen = []

    def work() -> None:
        with interrupts() as stop:
            seen.append(signal.getsignal(signal.SIGINT))
            stop.event.set()
            with pytest.raises(Interrupted, match="a request"):
                stop.check("")

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [before]
