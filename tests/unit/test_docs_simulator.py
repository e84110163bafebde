"""docs/simulator.md names all that the simulator can be told."""

from __future__ import annotations

from pathlib import Path

from click.testing import CliRunner

from gonio.cli.sim import serve
from sim.scenario import _AXIS_KINDS, _BENCH_KINDS, _CABLE_OPTIONS, _OPTIONS, Scenario
from sim.truth import _KEYS

PAGE = Path(__file__).parents[2] / "docs" / "simulator.md"


def test_the_page_names_every_key_fault_and_option():
    text = PAGE.read_text(encoding="utf-8")
    names = {*_KEYS, *_AXIS_KINDS, *_BENCH_KINDS, *_OPTIONS, *_CABLE_OPTIONS}
    assert [name for name in sorted(names) if f"`{name}`" not in text] == []
    help_text = CliRunner().invoke(serve, ["--help"]).output
    options = [word for word in help_text.split() if word.startswith("--") and word != "--help"]
    assert options and [option for option in options if option not in text] == []


def test_the_pages_scenario_is_read(tmp_path):
    text = PAGE.read_text(encoding="utf-8")
    block = text[text.index("    [[fault]]") : text.index("A client, with")]
    (tmp_path / "faults.toml").write_text("\n".join(line.removeprefix("    ") for line in block.splitlines()))
    first, second = Scenario.load(tmp_path / "faults.toml").faults
    assert (first.kind, first.axis, second.kind, second.options["flips"]) == ("obstacle", "pan", "corrupt", 3)
