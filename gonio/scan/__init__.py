"""Scanning: the plan, the check beforehand, the engine, and the run on disk."""

from __future__ import annotations

from gonio.scan.engine import ScanResult, scan
from gonio.scan.interrupt import Interrupted
from gonio.scan.plan import Plan, Pose, make_plan
from gonio.scan.preflight import Preflight, check
from gonio.scan.preparation import create_run, is_complete, plan_of, remaining, rig_of
from gonio.scan.records import BlockRecord, PoseRecord
from gonio.scan.store import Run

__all__ = [
    "BlockRecord",
    "Interrupted",
    "Plan",
    "Pose",
    "PoseRecord",
    "Preflight",
    "Run",
    "ScanResult",
    "check",
    "create_run",
    "is_complete",
    "make_plan",
    "plan_of",
    "remaining",
    "rig_of",
    "scan",
]
