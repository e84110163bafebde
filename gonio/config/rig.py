"""rig.toml: the bus, the axes, the camera, the lamp, the white reference, and the simulator's settings.

It knows names, ranges and units; it opens nothing. Angles are in degrees in the file and in radians in the dataclasses.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Literal

from gonio.config.axis import AxisConfig, read_axis
from gonio.config.reader import Document, Table, read_document

AXES = ("arm", "pan", "tilt")
SIMULATED = "sim"
BACKENDS = ("v4l2", "dshow", "msmf", "avfoundation", "ffmpeg", "images")
CAMERA_PLUGINS = "gonio.cameras"


@dataclass(frozen=True)
class BusConfig:
    """The servos' line.

    Attributes
    ----------
    port : str
        A path, a pyserial URL or ``"sim"``.
    baud : int
        [bit/s].
    timeout_s : float
        Of a packet, in wall time [s].
    watchdog_s : float
        A real servo stops by itself if it hears nothing for so long during a move [s]; 0 for never.
    return_s : float
        How long an adapter that was unplugged may take to come back [s].
    """

    port: str
    baud: int
    timeout_s: float
    watchdog_s: float
    return_s: float


@dataclass(frozen=True)
class CameraConfig:
    """The camera and its noise model.

    Attributes
    ----------
    kind : str
        ``"sim"``, ``"opencv"``, ``"none"``, or the name of a plug-in (entry point of the group `CAMERA_PLUGINS`).
    options : mapping
        ``[camera.options]``, which a plug-in gets as they are.
    exposures_s : tuple of float
        Exposure bracket [s], ascending.
    roi : tuple of int
        Region averaged into one sample: x0, y0, width, height [pixel].
    distance_mm : float
        From the camera to the sample's centre.
    width, height, bit_depth, saturation_dn : int
    gain_dn_per_e, read_noise_e, offset_dn : float
        EMVA 1288 noise model: counts per electron, read noise [e], black level [DN].
    device, backend, fourcc, gain, linear, channel, stale_frames, fixed
        For ``"opencv"``: device number or path, backend by name, pixel format and gain to ask for, whether counts are
        proportional to light, the channel to keep, frames thrown away before each that counts, and whether the exposure
        cannot be set (then `exposures_s` has one entry, which says what it is).
    """

    kind: str
    exposures_s: tuple[float, ...]
    roi: tuple[int, int, int, int]
    distance_mm: float
    width: int
    height: int
    bit_depth: int
    saturation_dn: int
    gain_dn_per_e: float
    read_noise_e: float
    offset_dn: float
    device: int | str
    backend: str
    fourcc: str | None
    gain: float | None
    linear: bool
    channel: int | None
    stale_frames: int | None
    fixed: bool
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class LampConfig:
    """The lamp: kind (``"scpi"`` or ``"manual"``), port, baud, timeout [s], level 0 to 1, warm-up [s], distance [mm]."""

    kind: Literal["scpi", "manual"]
    port: str
    baud: int
    timeout_s: float
    level: float
    warm_up_s: float
    distance_mm: float


@dataclass(frozen=True)
class WhiteConfig:
    """The white reference.

    Attributes
    ----------
    beta, u_beta : float
        Radiance factor at the reference geometry, and its standard uncertainty [1].
    arm, pan, tilt : float
        Joint angles of the reference geometry [rad].
    repeats : int
        Brackets in one block.
    """

    beta: float
    u_beta: float
    arm: float
    pan: float
    tilt: float
    repeats: int


@dataclass(frozen=True)
class SimConfig:
    """The simulator: rig seconds per wall second, seed, own process or in this one, truth and scenario as they are."""

    speed: float
    seed: int
    process: bool
    scenario: str | None
    truth: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class ZoneConfig:
    """Joint angles at which parts would collide: the ranges of axis angles [rad] that are forbidden together."""

    name: str
    ranges: Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class RigConfig:
    """A rig.

    Attributes
    ----------
    name : str
    g_min : float
        Smallest angle between light arm and camera at which the arm does not stand in the camera's view [rad].
    settle_s : float
        Rest after the axes have settled, for the arm to stop ringing [s].
    moved : float
        Largest change of a joint angle during an exposure [rad]; beyond it the pose is exposed again.
    park : mapping of axis name to float
        Where the axes rest [rad].
    zones : tuple of ZoneConfig
        Where parts would collide.
    text : str
        The document itself.
    """

    name: str
    g_min: float
    settle_s: float
    moved: float
    bus: BusConfig
    axes: Mapping[str, AxisConfig]
    camera: CameraConfig
    lamp: LampConfig
    white: WhiteConfig
    sim: SimConfig | None
    park: Mapping[str, float] = field(default_factory=dict)
    zones: tuple[ZoneConfig, ...] = ()
    text: str = field(default="", repr=False, compare=False)

    @property
    def simulated(self) -> bool:
        """Whether the rig is the simulator's; it is so in all its parts or in none."""
        return self.bus.port == SIMULATED


def load_rig(path: str | Path) -> RigConfig:
    """Read a rig file; see `parse_rig`. A scenario is looked for in the file's folder."""
    return parse_rig(read_document(path), str(path), folder=Path(path).absolute().parent)


def parse_rig(text: str, name: str = "rig.toml", *, folder: Path | None = None) -> RigConfig:
    """The rig that a text describes.

    Parameters
    ----------
    text : str
    name : str, optional
        What messages call it.
    folder : Path, optional
        To which ``[sim] scenario`` is relative; by default the one in which the process runs.

    Raises
    ------
    ConfigurationError
        With every problem of the document at once.
    """
    document = Document(text, name)
    root = document.root
    rig = root.table("rig")
    bus = root.table("bus")
    axes = root.table("axes")
    sim = _sim(root.table("sim", required=False), folder) if "sim" in root else None
    camera = _camera(root.table("camera"), sim)
    lamp = _lamp(root.table("lamp"))
    white = _white(root.table("white"))
    config = RigConfig(
        name=rig.text("name"),
        g_min=rig.angle("g_min_deg", 8.0, lower=0.0, upper=90.0),
        settle_s=rig.number("settle_s", 0.05, lower=0.0, upper=60.0, unit="s"),
        moved=rig.angle("moved_deg", 0.2, lower=0.0, upper=5.0),
        bus=BusConfig(
            port=bus.text("port"),
            baud=bus.integer("baud", 1_000_000, lower=9600, upper=4_500_000, unit="bit/s"),
            timeout_s=bus.number("timeout_s", 0.5, lower=0.005, upper=30.0, unit="s"),
            watchdog_s=bus.number("watchdog_s", 1.0, lower=0.0, upper=2.54, unit="s"),
            return_s=bus.number("return_s", 10.0, lower=0.0, upper=3600.0, unit="s"),
        ),
        axes={axis: read_axis(axes.table(axis), axis) for axis in AXES},
        camera=camera,
        lamp=lamp,
        white=white,
        sim=sim,
        park=_park(root.table("park", required=False), white),
        zones=tuple(_zone(table) for table in root.tables("zone")),
        text=text,
    )
    for table in (rig, bus, axes, root):
        table.finish()
    if not document.problems:
        _cross_checks(config, root)
    document.finish()
    return config


def _camera(table: Table, sim: SimConfig | None) -> CameraConfig:
    plugins = tuple(dict.fromkeys(point.name for point in entry_points(group=CAMERA_PLUGINS)))
    kind = table.text("kind", choices=("sim", "opencv", "none", *plugins))
    if kind == "sim":
        # the simulated sensor has its size from [sim.truth], where the simulator checks it
        size = {"width": 160, "height": 120} | (dict(sim.truth) if sim else {})
        width, height = (size[k] if isinstance(size[k], int) else 20000 for k in ("width", "height"))
    else:
        width = table.integer("width", 640, lower=1, upper=20000, unit="pixel")
        height = table.integer("height", 480, lower=1, upper=20000, unit="pixel")
    roi = table.integers("roi", count=4, lower=0, upper=20000)
    bit_depth = table.integer("bit_depth", 12, lower=8, upper=16, unit="bit")
    device: int | str = 0
    if table.holds_text("device"):
        device = table.text("device")
    else:
        device = table.integer("device", 0, lower=0, upper=99)
    config = CameraConfig(
        kind=kind,
        exposures_s=table.numbers("exposures_s", above=0.0, upper=3600.0, unit="s"),
        roi=roi,  # type: ignore[arg-type]
        distance_mm=table.number("distance_mm", above=0.0, upper=1e5, unit="mm"),
        width=width,
        height=height,
        bit_depth=bit_depth,
        saturation_dn=table.integer("saturation_dn", 2**bit_depth - 1, lower=1, upper=2**bit_depth - 1, unit="DN"),
        gain_dn_per_e=table.number("gain_dn_per_e", above=0.0, upper=1e5, unit="DN/e"),
        read_noise_e=table.number("read_noise_e", lower=0.0, upper=1e5, unit="e"),
        offset_dn=table.number("offset_dn", 0.0, lower=0.0, upper=2.0**bit_depth - 1, unit="DN"),
        device=device,
        backend=table.text("backend", choices=BACKENDS) if kind == "opencv" else table.text("backend", ""),
        fourcc=table.text("fourcc") if "fourcc" in table else None,
        gain=table.number("gain", lower=0.0) if "gain" in table else None,
        linear=table.flag("linear", kind == "sim"),
        channel=table.integer("channel", lower=0, upper=3) if "channel" in table else None,
        stale_frames=table.integer("stale_frames", lower=0, upper=100, unit="frames") if "stale_frames" in table else None,
        fixed=table.flag("fixed", False),
        options=table.table("options", required=False).free(),
    )
    table.finish()
    if config.options and kind not in plugins and table.get("kind") == kind:
        table.report("options", f'goes with the kind of a plug-in only, not with "{kind}"')
    exposures = config.exposures_s
    if any(b <= a for a, b in itertools.pairwise(exposures)):
        table.report("exposures_s", f"is {list(exposures)}; write each exposure once, the shortest first")
    if config.fixed and len(exposures) != 1:
        table.report("exposures_s", f"has {len(exposures)} entries; a camera whose exposure is fixed has one")
    x0, y0, w, h = roi
    if w < 1 or h < 1 or x0 + w > width or y0 + h > height:
        table.report("roi", f"= {list(roi)} (x0, y0, width, height) must lie within the image of {width} x {height} pixels")
    return config


def _lamp(table: Table) -> LampConfig:
    kind = table.text("kind", choices=("scpi", "manual"))
    config = LampConfig(
        kind=kind,  # type: ignore[arg-type]
        port=table.text("port") if kind == "scpi" else table.text("port", ""),
        baud=table.integer("baud", 9600, lower=300, upper=4_500_000, unit="bit/s"),
        timeout_s=table.number("timeout_s", 2.0, lower=0.005, upper=60.0, unit="s"),
        level=table.number("level", 1.0, lower=0.0, upper=1.0),
        warm_up_s=table.number("warm_up_s", 0.0, lower=0.0, upper=7200.0, unit="s"),
        distance_mm=table.number("distance_mm", above=0.0, upper=1e5, unit="mm"),
    )
    table.finish()
    return config


def _white(table: Table) -> WhiteConfig:
    config = WhiteConfig(
        beta=table.number("beta", above=0.0, upper=2.0),
        u_beta=table.number("u_beta", lower=0.0, upper=1.0),
        arm=table.angle("arm_deg", 30.0, lower=-180.0, upper=180.0),
        pan=table.angle("pan_deg", 15.0, lower=-180.0, upper=180.0),
        tilt=table.angle("tilt_deg", 0.0, lower=-180.0, upper=180.0),
        repeats=table.integer("repeats", 4, lower=1, upper=1000),
    )
    table.finish()
    return config


def _park(table: Table, white: WhiteConfig) -> dict[str, float]:
    """Joint angles at rest; by default those of the white reference's geometry."""
    angles = {
        axis: table.angle(f"{axis}_deg", math.degrees(getattr(white, axis)), lower=-180.0, upper=180.0) for axis in AXES
    }
    table.finish()
    return angles


def _zone(table: Table) -> ZoneConfig:
    ranges = {}
    for axis in AXES:
        if f"{axis}_deg" in table:
            low, high = (*table.angles(f"{axis}_deg", count=2, lower=-180.0, upper=180.0), 0.0, 0.0)[:2]
            ranges[axis] = (low, high)
            if low > high:
                table.report(f"{axis}_deg", f"= {[math.degrees(low), math.degrees(high)]} must go from low to high")
    config = ZoneConfig(table.text("name"), ranges)
    if not ranges:
        table.report("", f"names no axis; give one or more of {', '.join(f'{axis}_deg' for axis in AXES)} = [low, high]")
    table.finish()
    return config


def _sim(table: Table, folder: Path | None) -> SimConfig:
    scenario = table.text("scenario", "")
    config = SimConfig(
        speed=table.number("speed", 1.0, above=0.0, upper=1e4, unit="rig seconds per wall second"),
        seed=table.integer("seed", 1, lower=0, upper=2**53),
        process=table.flag("process", True),
        scenario=str(((folder or Path()) / scenario).absolute()) if scenario else None,
        truth=table.table("truth", required=False).free(),
    )
    table.finish()
    return config


def _cross_checks(config: RigConfig, root: Table) -> None:
    ids: dict[int, str] = {}
    for name, axis in config.axes.items():
        if axis.id in ids:
            root.document.report(
                f"axes.{name}", "id", f"= {axis.id} is also that of {ids[axis.id]}; give each servo its own"
            )
        ids[axis.id] = name
        angle = getattr(config.white, name)
        if not axis.lower <= angle <= axis.upper:
            root.document.report(
                "white", f"{name}_deg",
                f"= {math.degrees(angle):g} is outside the axis' limits [{math.degrees(axis.lower):g}, "
                f"{math.degrees(axis.upper):g}] degrees; move the reference geometry",
            )  # fmt: skip
        elif not axis.lower <= config.park[name] <= axis.upper:
            root.document.report(
                "park", f"{name}_deg",
                f"= {math.degrees(config.park[name]):g} is outside the axis' limits [{math.degrees(axis.lower):g}, "
                f"{math.degrees(axis.upper):g}] degrees",
            )  # fmt: skip
    if abs(config.white.arm) < config.g_min:
        root.document.report(
            "white", "arm_deg",
            f"= {math.degrees(config.white.arm):g} puts the light arm before the camera; it needs at least "
            f"{math.degrees(config.g_min):g} degrees (g_min_deg)",
        )  # fmt: skip
    for section, key, value in (("camera", "kind", config.camera.kind), ("lamp", "port", config.lamp.port)):
        if (value == SIMULATED) != config.simulated:
            root.document.report(
                section,
                key,
                f'= "{value}" does not go with [bus] port = "{config.bus.port}"; all three are "sim", or none is',
            )
