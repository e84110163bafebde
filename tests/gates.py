"""Long proofs leave their figures in docs/gates.md, one row each, with date, command and seed."""

from __future__ import annotations

import datetime
from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "gates.md"
HEAD = """# Gates

Proofs that take too long for every change. `make gates` runs them and writes their figures here; CI runs a short slice of
each.

| gate | figure | demanded | seeds | date | command |
|---|---|---|---|---|---|
"""


def record(gate: str, figure: str, demanded: str, seeds: str, command: str) -> None:
    """Replace the gate's row, or add it."""
    text = PAGE.read_text(encoding="utf-8") if PAGE.exists() else HEAD
    rows = [line for line in text.splitlines() if line.startswith("| ") and not line.startswith("| gate |")]
    today = datetime.datetime.now(datetime.UTC).date().isoformat()
    fresh = f"| {gate} | {figure} | {demanded} | {seeds} | {today} | `{command}` |"
    rows = [row for row in rows if not row.startswith(f"| {gate} |")] + [fresh]
    PAGE.write_text(HEAD + "\n".join(sorted(rows)) + "\n", encoding="utf-8")
    print(f"\n{fresh}")
