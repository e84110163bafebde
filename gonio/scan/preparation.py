"""Before a scan and between its sessions: what a run was begun with, and what it still lacks.

A run keeps the documents it was planned from and its poses as they were planned then; nothing is planned twice. No device
is opened here.
"""

from __future__ import annotations

import datetime
import platform
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

import gonio
from gonio.config import PlanConfig, RigConfig, parse_plan, parse_rig
from gonio.errors import ConfigurationError, DatasetError
from gonio.scan import preflight
from gonio.scan.plan import Plan, make_plan
from gonio.scan.store import Run

POSES = "poses.json"


def create_run(
    path: str | Path,
    rig_text: str,
    plan_text: str,
    *,
    attributes: Mapping[str, str] | None = None,
    rig_folder: Path | None = None,
) -> tuple[Run, preflight.Preflight]:
    """Plan a scan, check it, and make its run; nothing moves.

    Parameters
    ----------
    path : path
        Of the run.
    rig_text, plan_text : str
        The documents, kept with the run.
    attributes : mapping of str to str, optional
        Further attributes of the run.
    rig_folder : Path, optional
        Where the rig file lies, to which its scenario is relative.

    Raises
    ------
    ConfigurationError
        If a document is wrong or no pose can be reached.
    DatasetError
        If there is a run already.
    """
    rig, config = parse_rig(rig_text, folder=rig_folder), parse_plan(plan_text)
    if rig.camera.kind == "none":
        raise ConfigurationError('[camera] kind = "none": a scan needs a camera; choose one in rig.toml')
    plan = make_plan(config, rig)
    checked = preflight.check(plan, config, rig)
    known = {
        "gonio_version": gonio.__version__,
        "python_version": platform.python_version(),
        "numpy_version": np.__version__,
        "platform": platform.platform(),
        "created": now(),
        "rig": rig.name,
        **{f"sample.{key}": value for key, value in config.sample.items()},
        **({"seed": str(rig.sim.seed)} if rig.sim and rig.simulated else {}),
        **({"scenario": rig.sim.scenario} if rig.sim and rig.sim.scenario else {}),
        **(attributes or {}),
    }
    documents = {"rig.toml": rig_text, "plan.toml": plan_text, POSES: plan.to_json()}
    return Run.create(path, kind="scan", documents=documents, attributes=known), checked


def rig_of(run: Run) -> RigConfig:
    """The rig with which a run was begun, from its own documents."""
    if run.kind != "scan":
        raise DatasetError(f"{run.path} was imported, it has no rig and no plan; nothing to scan or resume")
    rig = parse_rig(run.document("rig.toml"), f"{run.path}/rig.toml")
    scenario = run.attributes.get("scenario")  # the file itself may have been relative to another folder
    return replace(rig, sim=replace(rig.sim, scenario=scenario)) if rig.sim and scenario else rig


def plan_of(run: Run) -> tuple[PlanConfig, Plan]:
    """The plan with which a run was begun, and its poses as they were planned then."""
    return parse_plan(run.document("plan.toml"), f"{run.path}/plan.toml"), Plan.from_json(run.document(POSES))


def remaining(run: Run) -> int:
    """Poses of a run that are not taken yet."""
    return len(plan_of(run)[1].poses) - len(run.complete_poses())


def is_complete(run: Run) -> bool:
    """Whether all poses and the last white reference were taken."""
    return "completed" in run.attributes


def now() -> str:
    """The calendar's time in UTC, for people."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
