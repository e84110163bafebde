"""docs/rig.md shows every verb of `gonio rig`, and `gonio doctor`."""

from __future__ import annotations

from pathlib import Path

from gonio.cli.rig import rig

PAGE = (Path(__file__).parents[2] / "docs" / "rig.md").read_text(encoding="utf-8")


def test_every_verb_is_shown() -> None:
    assert {"setup", "check", "home", "move", "jog", "park", "stop", "watch", "dump"} == set(rig.commands)
    for verb in rig.commands:
        assert f"gonio rig {verb} lab/rig.toml" in PAGE
    assert "$ gonio doctor lab/rig.toml" in PAGE
