"""The simulated lamp: its SCPI dialogue (SCPI-1999 vol. 1 and 2) and its light."""

from __future__ import annotations

import math

import pytest

from sim.lamp import ScpiLamp


def _say(lamp: ScpiLamp, text: str, t: float = 0.0) -> str:
    return b"".join(reply for _, reply in lamp.feed(text.encode("utf-8"), t)).decode("ascii")


def test_dialogue() -> None:
    lamp = ScpiLamp()
    assert _say(lamp, "*IDN?\n") == "gonio,simulated lamp,0,1.0\n"
    assert _say(lamp, "OUTP?\r\n") == "0\n"
    assert _say(lamp, "OUTP ON\nOUTP?\n") == "1\n"
    assert _say(lamp, "SOUR:LEV 0.25\nSOUR:LEV?\n") == "0.25\n"
    assert _say(lamp, "SYST:ERR?\n") == '0,"No error"\n'
    assert _say(lamp, "*RST;*OPC?\n") == "1\n"
    assert _say(lamp, "OUTP?;SOUR:LEV?\n") == "0;1\n"


@pytest.mark.parametrize("form", ["OUTP 1", "outp on", "OUTPut:STATe ON", ":Output:Stat 1", "  outp   on  "])
def test_long_and_short_forms_in_any_case(form: str) -> None:
    lamp = ScpiLamp()
    assert _say(lamp, form + "\nsyst:err?\n") == '0,"No error"\n'
    assert lamp.on


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("OUTPU ON", '-113,"Undefined header"'),
        ("VOLT 3", '-113,"Undefined header"'),
        ("OUTP", '-109,"Missing parameter"'),
        ("OUTP MAYBE", '-224,"Illegal parameter value"'),
        ("SOUR:LEV 1.01", '-222,"Data out of range"'),
        ("SOUR:LEV -0.01", '-222,"Data out of range"'),
        ("SOUR:LEV bright", '-104,"Data type error"'),
        ("SOUR:LEV nan", '-104,"Data type error"'),
        ("SOUR:LEV 0.1,0.2", '-108,"Parameter not allowed"'),
        ("*IDN? 7", '-108,"Parameter not allowed"'),
        ("OUTP \N{BULLET}", '-101,"Invalid character"'),
        ("x" * 300, '-363,"Input buffer overrun"'),
    ],
)
def test_errors_are_queued_and_change_nothing(text: str, error: str) -> None:
    lamp = ScpiLamp()
    assert _say(lamp, text + "\n") == ""
    assert (lamp.on, lamp.level) == (False, 1.0)
    assert _say(lamp, "SYST:ERR?\nSYSTem:ERRor:NEXT?\n") == f'{error}\n0,"No error"\n'


def test_the_queue_is_first_in_first_out_and_says_when_it_overflows() -> None:
    lamp = ScpiLamp()
    _say(lamp, "OUTP\n" + "NOPE\n" * 40)
    answers = [_say(lamp, "SYST:ERR?\n").strip() for _ in range(17)]
    assert answers[0] == '-109,"Missing parameter"'
    assert answers[15:] == ['-350,"Queue overflow"', '0,"No error"']
    _say(lamp, "NOPE\n*CLS\n")
    assert _say(lamp, "SYST:ERR?\n") == '0,"No error"\n'


def test_bytes_may_come_one_by_one_and_compound_headers_continue_their_branch() -> None:
    lamp = ScpiLamp()
    assert [reply for byte in b"*IDN?\n" for reply in lamp.feed(bytes((byte,)), 0.0)] == [
        (0.0, b"gonio,simulated lamp,0,1.0\n")
    ]
    assert _say(lamp, "SOUR:LEV 0.5;LEV?\n") == "0.5\n"


def test_light_warms_up_and_drifts() -> None:
    lamp = ScpiLamp(drift_per_hour=-0.02, warm_up=0.1, warm_up_s=30.0)
    assert lamp.relative_output(100.0) == 0.0
    _say(lamp, "OUTP ON;SOUR:LEV 0.5\n", t=100.0)
    assert lamp.relative_output(100.0) == pytest.approx(0.5 * 0.9)
    assert lamp.relative_output(130.0) == pytest.approx(0.5 * (1 - 0.02 * 30 / 3600) * (1 - 0.1 / math.e))
    assert lamp.relative_output(100.0 + 3600.0) == pytest.approx(0.5 * 0.98)
    _say(lamp, "OUTP ON\n", t=200.0)  # already on: no second warm-up
    assert lamp.relative_output(100.0 + 3600.0) == pytest.approx(0.5 * 0.98)
    lamp.burnt_out = True
    assert lamp.relative_output(300.0) == 0.0


def test_a_silent_lamp_says_nothing() -> None:
    lamp = ScpiLamp()
    lamp.silent = True
    assert _say(lamp, "*IDN?\n") == ""
