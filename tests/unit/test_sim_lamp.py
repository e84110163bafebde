"""The simulated lamp: its SCPI dialogue (SCPI-1999 vol. 1 and 2) and its light."""

from __future__ import annotations

import math

import pytest

from sim.lamp import Channel, ScpiLamp


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
    lamp.burnt_out_at = 250.0
    assert lamp.relative_output(200.0) > 0.0
    assert lamp.relative_output(300.0) == 0.0


def test_a_silent_lamp_says_nothing() -> None:
    lamp = ScpiLamp()
    lamp.silent = True
    assert _say(lamp, "*IDN?\n") == ""


def test_a_head_with_several_leds() -> None:
    """Rationale: heads with several LEDs have one output each; a suffix or the selected instrument says which."""
    lamp = ScpiLamp(channels=(Channel(0.5, (3.0, 0.0, 0.0)), Channel(0.25, (0.0, 3.0, 0.0)), Channel(0.25, (0.0, 0.0, 3.0))))
    assert _say(lamp, "INST:CAT?\n") == '"CH1","CH2","CH3"\n'
    assert _say(lamp, "INST?;:INST:NSEL?\n") == "CH1;1\n"
    _say(lamp, "OUTP ON;:OUTP3 ON;:SOUR3:LEV 0.5\n")
    assert _say(lamp, "OUTP1?;:OUTP2?;:OUTP3:STAT?;:SOUR3:LEV?\n") == "1;0;1;0.5\n"
    assert lamp.relative_output(1.0) == pytest.approx(0.5 + 0.125)
    assert lamp.colour(1.0) == pytest.approx((3 * 0.8, 0.0, 3 * 0.2))
    _say(lamp, "INST CH2\nOUTP 1\n")
    assert _say(lamp, "INST:SEL?;:OUTP2?\n") == "CH2;1\n"
    _say(lamp, "INSTrument:NSELect 3;:OUTPut:STATe OFF\n")
    assert lamp.relative_output(1.0) == pytest.approx(0.75)
    for text, error in (("OUTP4 ON", -114), ("INST CH9", -224), ("INST:NSEL x", -104), ("INST:NSEL", -109)):
        _say(lamp, f"{text}\n")
        assert _say(lamp, "SYST:ERR?\n").startswith(f"{error},")


def test_status_of_ieee_488() -> None:
    """Event status: operation complete 1, device 8, execution 16, command error 32; reading it clears it."""
    lamp = ScpiLamp()
    assert _say(lamp, "*OPC;*ESR?\n*ESR?\n*TST?\n*WAI\n") == "1\n0\n0\n"
    _say(lamp, "*ESE 48;*SRE 36\nNOPE\nSOUR:LEV 3\n")
    assert _say(lamp, "*ESE?;*SRE?;*STB?\n") == "48;36;100\n"
    assert _say(lamp, "SYST:ERR:COUN?;*ESR?;*STB?\n") == "2;48;68\n"
    _say(lamp, "*CLS\n")
    assert _say(lamp, "*STB?;*ESR?\n") == "0;0\n"
    _say(lamp, "*ESE 256\n")
    assert _say(lamp, "SYST:ERR?\n").startswith("-222,")


def test_past_light_is_remembered() -> None:
    lamp = ScpiLamp()
    _say(lamp, "OUTP ON\n", t=1.0)
    _say(lamp, "SOUR:LEV 0.5\n", t=2.0)
    _say(lamp, "OUTP OFF\n", t=3.0)
    assert [lamp.relative_output(t) for t in (0.5, 1.5, 2.5, 3.5)] == [0.0, 1.0, 0.5, 0.0]
