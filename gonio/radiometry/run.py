"""Reduce a run from its journal. It reads; the caller writes the samples back.

The run is asked through the few methods it needs, so that this room knows no database.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Protocol

from gonio.config import RigConfig
from gonio.errors import MeasurementError
from gonio.interfaces import Frame
from gonio.kinematics import AXES, Joints
from gonio.radiometry.reduction import Bracket, Progress, Setup, reduce
from gonio.samples import BRDFSamples


class RunFrames(Protocol):
    """What is needed of a run; `gonio.scan.store.Run` has it."""

    def poses(self) -> Sequence[Any]:
        """Records of the committed poses: index, measured (by axis name) [rad], time_s."""
        ...

    def blocks(self, kind: str) -> Sequence[Any]:
        """Records of the ``"dark"`` or ``"white"`` blocks: number, measured, time_s, exposures_s."""
        ...

    def frames(self, pose: int) -> Sequence[Frame]:
        """Frames of a pose."""
        ...

    def block_frames(self, kind: str, number: int) -> Sequence[Frame]:
        """Frames of a block: repeat by repeat, in each all exposures."""
        ...


def reduce_run(run: RunFrames, rig: RigConfig, progress: Progress | None = None) -> BRDFSamples:
    """BRDF samples of a scanned run.

    Parameters
    ----------
    run : RunFrames
    rig : RigConfig
        Of the run's own rig.toml.
    progress : callable, optional
        Called with ("reduce", done, total).

    Returns
    -------
    BRDFSamples
        See `reduce`. Angles are the measured ones, never the goals.

    Raises
    ------
    MeasurementError
        If darks, white blocks or poses are missing, or the measurement cannot be trusted.
    DatasetError
        If the run is damaged.
    """
    records = run.poses()
    if not records:
        raise MeasurementError("the run holds no completed pose: scan first, or resume the scan")
    return reduce(
        [frame for block in run.blocks("dark") for frame in run.block_frames("dark", block.number)],
        [_white(block, run.block_frames("white", block.number)) for block in run.blocks("white")],
        _poses(run, records),
        Setup.of(rig),
        total=len(records),
        progress=progress,
    )


def _poses(run: RunFrames, records: Sequence[Any]) -> Iterator[Bracket]:
    for record in records:
        yield Bracket(run.frames(record.index), _joints(record), record.index, record.time_s)


def _white(record: Any, frames: Sequence[Frame]) -> list[Bracket]:
    size = len(record.exposures_s)
    if size == 0 or len(frames) % size:
        raise MeasurementError(
            f"white block {record.number} holds {len(frames)} frames, which are no whole brackets of {size} exposures; "
            "check the run with `gonio verify`"
        )
    joints = _joints(record)
    return [Bracket(frames[k : k + size], joints, time_s=record.time_s) for k in range(0, len(frames), size)]


def _joints(record: Any) -> Joints:
    return Joints(*(float(record.measured[name]) for name in AXES))
