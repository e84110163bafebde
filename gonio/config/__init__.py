"""Configuration: TOML files into frozen dataclasses by one strict reader, all problems of a file at once.

An unknown key is an error that names the nearest right one. It loads no numerical package.
"""

from __future__ import annotations

from pathlib import Path

from gonio.config.axis import AxisConfig
from gonio.config.documents import (
    FitConfig,
    GridConfig,
    PlanConfig,
    load_fit,
    load_plan,
    parse_fit,
    parse_plan,
)
from gonio.config.reader import read_document
from gonio.config.rig import (
    BusConfig,
    CameraConfig,
    LampConfig,
    RigConfig,
    SimConfig,
    WhiteConfig,
    ZoneConfig,
    load_rig,
    parse_rig,
)
from gonio.config.scene import BRDFConfig, SceneConfig, load_scene, parse_scene
from gonio.config.sources import SourceConfig

__all__ = [
    "AxisConfig",
    "BRDFConfig",
    "BusConfig",
    "CameraConfig",
    "FitConfig",
    "GridConfig",
    "LampConfig",
    "PlanConfig",
    "RigConfig",
    "SceneConfig",
    "SimConfig",
    "SourceConfig",
    "WhiteConfig",
    "ZoneConfig",
    "default_documents",
    "load_fit",
    "load_plan",
    "load_rig",
    "load_scene",
    "parse_fit",
    "parse_plan",
    "parse_rig",
    "parse_scene",
    "read_document",
]


def default_documents() -> dict[str, str]:
    """Texts of the commented files that ``gonio init`` writes, by file name."""
    folder = Path(__file__).parent / "defaults"
    names = ("rig.toml", "plan.toml", "scene.toml", "fit.toml")
    return {name: (folder / name).read_text(encoding="utf-8") for name in names}


def small_plan() -> str:
    """Text of a plan of some 40 poses over the same range, for a quick look at a new sample and for tests."""
    return (Path(__file__).parent / "defaults" / "small_plan.toml").read_text(encoding="utf-8")
