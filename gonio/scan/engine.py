"""The scan: dark frames, white reference, and pose by pose move, settle, expose, verify, commit.

One loop, one thread. A pose is in the journal the moment it is complete; a scan that was interrupted, or whose process
died, goes on with the poses that are missing. On any error the axes are stopped and hold, the lamp goes off, and what has
been measured is kept. The engine knows the devices by what they can do, and never which they are; it reduces nothing.
"""

from __future__ import annotations

import json
import logging
import platform
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import gonio
from gonio.errors import ConfigurationError, DatasetError, DeviceError, MeasurementError
from gonio.interfaces import AxisGroup, Camera, Clock, Frame, Lamp, StreamingCamera
from gonio.scan import preflight
from gonio.scan.exposure import Exposer
from gonio.scan.interrupt import Interrupts, interrupts
from gonio.scan.motion import ATTEMPTS, Motion, counts, health, mean_angles
from gonio.scan.plan import AXES, Pose
from gonio.scan.preparation import is_complete, now, plan_of, rig_of
from gonio.scan.records import BlockRecord, PoseRecord
from gonio.scan.store import Run

logger = logging.getLogger(__name__)

_SPARE_BYTES = 50_000_000

Progress = Callable[[str, int, int], None]
"""Called with a stage (``"home"``, ``"dark"``, ``"white"``, ``"poses"``), how much of it is done, and how much there is."""


class ScanRig(Protocol):
    """What the engine needs of a rig (see `gonio.rig.Rig`)."""

    @property
    def group(self) -> AxisGroup: ...

    @property
    def camera(self) -> Camera | None: ...

    @property
    def lamp(self) -> Lamp: ...

    @property
    def clock(self) -> Clock: ...

    def mount(self, specimen: str) -> None:
        """Have ``"sample"`` or ``"white"`` on the stage when it returns."""
        ...

    def stop(self) -> None:
        """Axes stop now and hold, lamp off if no person is needed for that."""
        ...

    def describe(self) -> Mapping[str, object]: ...

    def truth(self) -> Mapping[str, Any] | None:
        """What a simulated rig hides; None of a real one."""
        ...


@dataclass(frozen=True)
class ScanResult:
    """What a scan did.

    Attributes
    ----------
    poses, done : int
        In the plan; taken by this session.
    saturated : tuple of int
        Poses of the run without a single exposure free of saturation.
    repeated : int
        Exposures of this session that were taken again, because an axis moved or a frame was an old one.
    seconds : float
        Rig time of this session [s].
    """

    poses: int
    done: int
    saturated: tuple[int, ...]
    repeated: int
    seconds: float


def scan(run: Run, rig: ScanRig, *, progress: Progress | None = None) -> ScanResult:
    """Take the poses that a run still lacks: all of them, or after an interruption the rest.

    Parameters
    ----------
    run : Run
        Of `create_run`, or an earlier one.
    rig : ScanRig
        Of the configuration `rig_of(run)`.
    progress : callable, optional

    Raises
    ------
    Interrupted
        On Ctrl-C, SIGTERM or SIGHUP. The axes hold, and what was completed is kept.
    DeviceError
        If a device fails; likewise.
    MeasurementError
        If an axis does not stay still, or the white reference is saturated or dark.
    DatasetError
        If another process scans into this run, or the disk is full or damaged.
    """
    with run.lock(), interrupts() as stop:
        return _Scan(run, rig, progress or (lambda stage, done, total: None), stop).run()


class _Scan:
    """One session."""

    def __init__(self, run: Run, rig: ScanRig, progress: Progress, stop: Interrupts) -> None:
        self._run = run
        self._rig = rig
        self._progress = progress
        self._config = rig_of(run)
        self._plan_config, self._plan = plan_of(run)
        self._checked = preflight.check(self._plan, self._plan_config, self._config)
        self._advice = advice = f"`gonio resume {run.path}` goes on"

        def check_stop() -> None:
            stop.check(f"all completed poses are kept; {advice}")

        if rig.camera is None:
            raise ConfigurationError('[camera] kind = "none": a scan needs a camera; choose one in rig.toml')
        self._exposer = Exposer(rig.camera, self._checked.exposures_s, self._config.camera.roi, check_stop)
        self._motion = Motion(rig.group, rig.clock, self._config, check_stop, advice)
        past = [p.time_s for p in run.poses()] + [b.time_s for kind in ("dark", "white") for b in run.blocks(kind)]
        self._start_s = rig.clock.now()
        self._offset_s = max(past, default=0.0) - self._start_s
        self._session = 0
        self._repeated = 0
        self._done = 0

    def run(self) -> ScanResult:
        done = self._run.complete_poses()
        todo = [pose for pose in self._plan.poses if pose.index not in done]
        if is_complete(self._run):
            return self._result()
        self._check_space(len(todo))
        try:
            self._begin(resumed=bool(done))
            self._home()
            self._find_late_frames()
            self._darks()
            self._rig.lamp.set_level(self._config.lamp.level)
            self._rig.lamp.set_output(True)
            self._motion.wait(self._config.lamp.warm_up_s)
            self._white()
            self._progress("poses", len(done), len(self._plan.poses))
            every = self._plan_config.white_every
            for number, pose in enumerate(todo):
                if every and number and number % every == 0:
                    self._white()
                self._pose(pose)
                self._done += 1
                self._progress("poses", len(done) + self._done, len(self._plan.poses))
            if todo:
                self._white()
            self._rig.lamp.set_output(False)
            self._run.set_attribute("completed", now())
        except BaseException as error:
            logger.info("scan ends early: %r", error)
            self._make_safe()
            raise
        return self._result()

    def _begin(self, *, resumed: bool) -> None:
        truth = self._rig.truth()
        if truth is not None and "truth" not in self._run.attributes:
            self._run.set_attribute("truth", json.dumps(dict(truth), sort_keys=True))
        self._session = self._run.begin_session(
            {
                "started": now(),
                "host": platform.node(),
                "gonio_version": gonio.__version__,
                "resumed": resumed,
                "time_s": self._time(),
                "rig": dict(self._rig.describe()),
            }
        )

    def _home(self) -> None:
        """All axes to the reference geometry: each is seen to move and to arrive before anything is measured.

        The encoders are absolute, so no switch is searched for.
        """
        self._progress("home", 0, 1)
        self._motion.move(self._reference())
        self._progress("home", 1, 1)

    def _find_late_frames(self) -> None:
        """With the lamp, how many frames of a streaming camera show the past; what it assumes stays if light makes no
        difference."""
        camera, lamp = self._rig.camera, self._rig.lamp
        if self._config.lamp.kind == "manual" or not isinstance(camera, StreamingCamera):
            return
        lamp.set_level(self._config.lamp.level)
        try:
            late = camera.measure_late(lamp.set_output, self._exposer.exposures_s[-1])
            logger.info("%d frames are thrown away before each that counts", late)
        except MeasurementError as error:
            logger.warning("late frames: %s", error)
        finally:
            lamp.set_output(False)

    def _reference(self) -> dict[str, float]:
        """Joint angles of the white reference's geometry [rad]."""
        return {axis: float(getattr(self._config.white, axis)) for axis in AXES}

    def _darks(self) -> None:
        """Frames with the lamp off, for each exposure that has none yet."""
        taken = {block.number for block in self._run.blocks("dark")}
        missing = [e for e in range(len(self._exposer.exposures_s)) if e not in taken]
        if not missing:
            return
        repeats = self._plan_config.darks
        self._rig.lamp.set_output(False)
        for done, e in enumerate(missing):
            start_s = self._time()
            frames = []
            for k in range(repeats):
                self._progress("dark", done * repeats + k, len(missing) * repeats)
                frames.append(self._exposer.capture(e, f"dark {e} {k}"))
            record = BlockRecord(
                kind="dark",
                number=e,
                measured={},
                time_s=0.5 * (start_s + self._time()),
                session=self._session,
                exposures_s=(self._exposer.exposures_s[e],),
                repeats=repeats,
                lamp_on=False,
                wall_time=now(),
            )
            self._run.commit_block(record, frames)
        self._progress("dark", len(missing) * repeats, len(missing) * repeats)

    def _white(self) -> None:
        """One block of the white reference; the sample is back on the stage after it."""
        number = len(self._run.blocks("white"))
        repeats = self._plan_config.white_repeats or self._config.white.repeats
        self._rig.mount("white")
        for _ in range(ATTEMPTS):
            before = self._motion.move(self._reference())
            brackets: list[list[Frame]] = []
            times_s: list[float] = []
            for repeat in range(repeats):
                self._progress("white", repeat, repeats)
                start_s = self._time()
                brackets.append(self._exposer.bracket(f"white {number} {repeat}"))
                times_s.append(0.5 * (start_s + self._time()))
            after = self._motion.read()
            if not self._motion.has_moved(before, after):
                break
            self._repeated += 1
        else:
            raise self._motion.unsteady(f"white block {number}", before, after)
        flag, error = self._judge_white(number, brackets[-1])
        record = BlockRecord(
            kind="white",
            number=number,
            measured=mean_angles(before, after),
            time_s=0.5 * (times_s[0] + times_s[-1]),
            session=self._session,
            exposures_s=self._exposer.exposures_s,
            repeats=repeats,
            lamp_on=True,
            flags=flag,
            counts=counts(after),
            times_s=tuple(times_s),
            wall_time=now(),
        )
        self._run.commit_block(record, [frame for bracket in brackets for frame in bracket])
        self._progress("white", repeats, repeats)
        if error is not None:
            raise error
        self._rig.mount("sample")

    def _judge_white(self, number: int, bracket: list[Frame]) -> tuple[tuple[str, ...], MeasurementError | None]:
        """Flags of a white block, and the error to raise once it is stored."""
        clear = self._exposer.longest_clear(bracket)
        if clear is None:
            return ("saturated",), MeasurementError(
                f"white block {number}: every exposure down to {self._exposer.exposures_s[0]:g} s is saturated; add a "
                "shorter one to exposures_s, or lower [lamp] level, and scan anew"
            )
        if self._exposer.is_dark(bracket[clear], self._run.block_frames("dark", clear)):
            return ("dark",), MeasurementError(
                f"white block {number} is as dark as the dark frames; see whether the lamp burns and the white reference is "
                f"on the stage, then {self._advice}"
            )
        return (), None

    def _pose(self, pose: Pose) -> None:
        """Move, settle, expose, verify, commit."""
        for attempt in range(1, ATTEMPTS + 1):
            before = self._motion.move(pose.joints)
            start_s = self._time()
            frames = self._exposer.bracket(f"pose {pose.index}")
            end_s = self._time()
            after = self._motion.read()
            if not self._motion.has_moved(before, after):
                break
            self._repeated += 1
            logger.warning("pose %d: an axis moved during the exposures, attempt %d", pose.index, attempt)
        else:
            raise self._motion.unsteady(f"pose {pose.index}", before, after)
        record = PoseRecord(
            index=pose.index,
            theta_i=pose.theta_i,
            theta_r=pose.theta_r,
            phi=pose.phi,
            commanded=dict(pose.joints),
            measured=mean_angles(before, after),
            counts=counts(after),
            time_s=0.5 * (start_s + end_s),
            session=self._session,
            attempts=attempt,
            flags=("saturated",) if self._exposer.saturated(frames) else (),
            health=health(after),
            wall_time=now(),
        )
        self._run.commit_pose(record, frames)

    def _time(self) -> float:
        """Rig seconds since the run's start."""
        return self._offset_s + self._rig.clock.now()

    def _check_space(self, poses: int) -> None:
        share = (poses + 1) / (len(self._plan.poses) + 1)
        needed = int(self._checked.bytes * share) + _SPARE_BYTES
        free = shutil.disk_usage(self._run.path).free
        if free < needed:
            raise DatasetError(
                f"{self._run.path}: the disk has {free / 1e6:.0f} MB free, the scan needs {needed / 1e6:.0f} MB; "
                "free some space"
            )

    def _make_safe(self) -> None:
        try:
            self._rig.stop()
        except DeviceError as error:
            logger.error("the rig could not be made safe: %s", error)

    def _result(self) -> ScanResult:
        return ScanResult(
            poses=len(self._plan.poses),
            done=self._done,
            saturated=tuple(p.index for p in self._run.poses() if "saturated" in p.flags),
            repeated=self._repeated + self._exposer.retaken,
            seconds=self._rig.clock.now() - self._start_s,
        )
