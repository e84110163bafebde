"""Scanning: the plan, the check beforehand, the engine, and the run on disk."""

from __future__ import annotations

from gonio.scan.records import BlockRecord, PoseRecord
from gonio.scan.store import Run

__all__ = ["BlockRecord", "PoseRecord", "Run"]
