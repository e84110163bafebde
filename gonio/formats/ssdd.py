"""SSDD, surface scattering distribution data (``.ssdd``): the open grid format of libbsdf.

A header of ``NAME value`` lines from ``VERSION`` on, then blocks from ``DATA_TYPE`` to ``DATA ascii|binary``, each with its
parameter lists in degrees and one colour per grid point, PARAM0 fastest. Written is one block in half and difference
angles, as text: nodes of theta_h dense where the lobe is narrow. `REDUCTION_TYPE` says that phi_d covers 0 to 90 degrees
(isotropic and reciprocal) or 0 to 360 (anisotropic). Nodes beyond the horizon repeat the value at one degree above it, so
that what interpolates stays right up to the horizon; reading leaves them out.

Read are blocks of ``brdf`` in spherical, specular or half/difference coordinates without offsets (PARAM4); other blocks are
counted and left out. RGB has no colour space by the format's definition; gonio takes it for linear.

References
----------
.. [1] KimuraRyo/libbsdf, doc/SsddFileFormatSpecification.md, version 0.2, 2023-08-14.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gonio import files
from gonio.channels import RGB, SINGLE, XYZ, Channels, ChannelSamples, spectral
from gonio.errors import DatasetError
from gonio.formats import rows
from gonio.formats.material import Material, around_mirror
from gonio.geometry import angles, unit_vector
from gonio.halfdiff import directions

Array = NDArray[np.float64]
COLOURS = {"monochrome": SINGLE, "rgb": RGB, "xyz": XYZ}
TYPES = ("spherical_coordinate_system", "specular_coordinate_system", "half_difference_coordinate_system")
KNOWN = (
    "DATA_TYPE", "COLOR_MODEL", "WAVELENGTH_LIST", "PARAM_TYPE", "REDUCTION_TYPE", "PARAM0_LIST", "PARAM1_LIST",
    "PARAM2_LIST", "PARAM3_LIST", "PARAM4_LIST", "NAME", "SOURCE_TYPE", "DEVICE", "CREATION_DATE", "MEASUREMENT_DATE",
    "VERSION", "SOFTWARE", "API", "DATE", "DATA",
)  # fmt: skip
LIMIT_DEG = {
    TYPES[0]: (90.0, 360.0, 90.0, 360.0),
    TYPES[1]: (90.0, 360.0, 180.0, 360.0),
    TYPES[2]: (90.0, 360.0, 90.0, 360.0),
}


@dataclass(frozen=True)
class Grid:
    """A block: parameters [deg], values (c, n0, n1, n2, n3), what they are."""

    kind: str
    params: tuple[Array, Array, Array, Array]
    value: Array
    channels: Channels
    reductions: tuple[str, ...]
    name: str = ""

    def directions(self) -> tuple[Array, Array]:
        """Unit vectors omega_i, omega_r of the grid points, shape (n0, n1, n2, n3, 3)."""
        a, b, c, d = np.meshgrid(*(np.radians(p) for p in self.params), indexing="ij")
        if self.kind == TYPES[2]:
            return directions(a, b, c, d)
        wi = unit_vector(a, b)
        if self.kind == TYPES[0]:
            return wi, unit_vector(c, b + d)
        wr = around_mirror(a, d, c)
        cos, sin = np.cos(b), np.sin(b)
        return wi, np.stack((cos * wr[..., 0] - sin * wr[..., 1], sin * wr[..., 0] + cos * wr[..., 1], wr[..., 2]), axis=-1)


def sniff(head: bytes) -> bool:
    """VERSION opens the file and a type of data follows."""
    lines = [line.split() for line in head.decode("utf-8-sig", "replace").splitlines()]
    words = [w for w in lines if w and not w[0].startswith("#")]
    return bool(words) and words[0][0].upper() == "VERSION" and any(w[0].upper() == "DATA_TYPE" for w in words)


def read(path: Path) -> ChannelSamples:
    """Samples at the grid points above the horizon, each direction pair once."""
    grid = read_grid(path)
    wi, wr = grid.directions()
    up = (wi[..., 2] > 1e-9) & (wr[..., 2] > 1e-9)
    polar_i, polar_r = grid.params[0] == 0.0, grid.params[2] == 0.0
    if grid.kind == TYPES[0]:
        up[polar_i, 1:] = False
        up[:, :, polar_r, 1:] = False
    elif grid.kind == TYPES[1]:
        up[:, :, polar_r, 1:] = False
    else:
        up[polar_i, 1:] = False
        up[:, :, polar_r, 1:] = False
    if not np.any(up):
        raise DatasetError(f"{path} holds no value above the horizon")
    theta_i, phi_i = angles(wi[up])
    theta_r, phi_r = angles(wr[up])
    attributes = {
        "quantity": "brdf",
        "source_quantity": "brdf",
        "source_format": "ssdd",
        "parametrisation": grid.kind,
        "reduction": " ".join(grid.reductions) or "none",
    }
    if grid.name:
        attributes["material"] = grid.name
    value = np.moveaxis(grid.value, 0, -1)[up]
    return ChannelSamples.make(theta_i, phi_i, theta_r, phi_r, value, grid.channels, attributes=attributes)


def read_grid(path: Path) -> Grid:
    """The first block of a BRDF; `DatasetError` if there is none or the file is damaged."""
    data = files.read_bytes(path, files.LARGEST_TEXT)
    at = 0
    meta: dict[str, str] = {}
    while at < len(data):
        end = data.find(b"\n", at)
        end = len(data) if end < 0 else end
        where = f"{path}, line {data.count(10, 0, at) + 1}"
        try:
            line = data[at:end].decode("utf-8-sig").partition("#")[0].strip()
        except UnicodeDecodeError as error:
            raise DatasetError(f"{where}: not UTF-8 text; the file is damaged") from error
        at = end + 1
        if not line:
            continue
        keyword, _, rest = line.partition(" ")
        if keyword.upper() not in KNOWN:
            raise DatasetError(f"{where}: unknown entry {files.shown(keyword)}; an SSDD header is expected")
        if keyword.upper() == "DATA_TYPE":
            meta = {}
        meta[keyword.upper()] = rest.strip()
        if keyword.upper() == "DATA":
            grid, at = _block(path, where, meta, data, at)
            if grid is not None:
                return grid
    raise DatasetError(f"{path} holds no block of data type brdf; gonio reads reflection only")


def _block(path: Path, where: str, meta: dict[str, str], data: bytes, at: int) -> tuple[Grid | None, int]:
    colour = meta.get("COLOR_MODEL", "").lower()
    if colour == "spectrum":
        channels = spectral(files.numbers(meta.get("WAVELENGTH_LIST", "").split(), where) or [0.0], where)
    elif colour in COLOURS:
        channels = COLOURS[colour]
    else:
        raise DatasetError(
            f"{where}: COLOR_MODEL {files.shown(colour)} is unknown; known are {', '.join(COLOURS)}, spectrum"
        )
    specular = meta.get("DATA_TYPE", "").lower().startswith("specular")
    kind = meta.get("PARAM_TYPE", "").lower()
    if kind not in TYPES and not specular:
        raise DatasetError(f"{where}: PARAM_TYPE {files.shown(kind)} is unknown; known are {', '.join(TYPES)}")
    params = []
    for k in range(4):
        values = files.numbers(meta.get(f"PARAM{k}_LIST", "0").split(), where) or [0.0]
        limit = 360.0 if specular else LIMIT_DEG[kind][k]
        if any(b <= a for a, b in itertools.pairwise(values)) or values[0] < 0 or values[-1] > limit + 1e-9:
            raise DatasetError(f"{where}: PARAM{k}_LIST must rise within 0 to {limit:g} degrees; the file is damaged")
        params.append(np.array(values))
    if specular:
        params = [*params[:2], np.zeros(1), np.zeros(1)]
    cells = math.prod(len(p) for p in params) * len(channels)
    value, at = _values(path, where, meta.get("DATA", "").lower(), data, at, cells, len(channels))
    if meta.get("DATA_TYPE", "").lower() != "brdf":
        return None, at
    if "PARAM4_LIST" in meta:
        raise DatasetError(f"{where}: PARAM4_LIST (offsets from the specular direction) is not read; resample without it")
    shape = (*(len(p) for p in reversed(params)), len(channels))  # param0 fastest, colours together
    ordered = np.transpose(value.reshape(shape), (4, 3, 2, 1, 0))
    if np.any(ordered < 0):
        raise DatasetError(f"{path}: a value of {ordered.min():g} is negative; a BRDF has none")
    reductions = tuple(meta.get("REDUCTION_TYPE", "").lower().split())
    a, b, c, d = params
    return Grid(
        kind, (a, b, c, d), np.ascontiguousarray(ordered), channels, reductions, rows.one_line(meta.get("NAME", ""), 200)
    ), at


def _values(path: Path, where: str, mode: str, data: bytes, at: int, cells: int, columns: int) -> tuple[Array, int]:
    if mode == "binary":
        if len(data) - at < 4 * cells:
            raise DatasetError(f"{where}: the lists announce {4 * cells} bytes, {len(data) - at} are left; the file is cut")
        value = np.frombuffer(data, dtype="<f4", count=cells, offset=at).astype(float)
        if not np.all(np.isfinite(value)):
            raise DatasetError(f"{path}: value {int(np.argmin(np.isfinite(value)))} is not finite; the file is damaged")
        return value, at + 4 * cells
    if mode != "ascii":
        raise DatasetError(f"{where}: DATA {files.shown(mode)} must be ascii or binary")
    if len(data) - at < 2 * cells - 1:
        raise DatasetError(f"{where}: the lists announce {cells} values, more than the bytes left can hold; the file is cut")
    found: list[float] = []
    line_number = data.count(10, 0, at)
    while len(found) < cells and at < len(data):
        end = data.find(b"\n", at)
        end = len(data) if end < 0 else end
        line_number += 1
        words = data[at:end].decode("ascii", "replace").partition("#")[0].split()
        at = end + 1
        if words and len(words) != columns:
            raise DatasetError(f"{path}, line {line_number}: {len(words)} numbers, a colour of this file has {columns}")
        found += files.numbers(words, f"{path}, line {line_number}")
    if len(found) != cells:
        raise DatasetError(f"{path} ends after {len(found)} of {cells} values; the file is cut")
    return np.array(found), at


def grid_of(material: Material) -> Grid:
    """A grid in half and difference angles that resolves the material's lobe."""
    width = material.lobe_width()
    # even steps of ln(1 + (theta_h / s)^2): dense within the lobe, some per cent of the angle beyond it
    s = float(np.clip(0.5 * width, 1e-4, 0.5))
    step = np.linspace(0.0, np.log1p((np.pi / 2 / s) ** 2), 128 if width > 0.02 else 192)
    theta_h = np.degrees(s * np.sqrt(np.expm1(step)))
    theta_h[-1] = 90.0
    fold = material.isotropic and material.reciprocal
    # finer towards grazing, where Fresnel and shadowing bend
    theta_d = np.degrees(np.arccos(np.linspace(1.0, 0.0, 91)))
    theta_d = np.unique(np.concatenate((np.linspace(0.0, 60.0, 46)[:-1], theta_d[theta_d >= 60.0 - 1e-9])))
    phi_d = np.linspace(0.0, 90.0, 31) if fold else np.linspace(0.0, 360.0, 37)
    phi_h = np.zeros(1) if material.isotropic else np.linspace(0.0, 360.0, 37)
    if not material.isotropic:
        theta_h, theta_d = theta_h[::2], theta_d[::3]
        theta_h[-1], theta_d[-1] = 90.0, 90.0
    reductions = ("bilateral_symmetry", "reciprocity") if fold else ()
    empty = np.zeros((1, 1, 1, 1, 1))
    grid = Grid(TYPES[2], (theta_h, phi_h, theta_d, phi_d), empty, material.channels, reductions)
    wi, wr = grid.directions()
    return Grid(TYPES[2], grid.params, material.evaluate(*_raised(grid, wi, wr)), material.channels, reductions)


def _raised(grid: Grid, wi: Array, wr: Array) -> tuple[Array, Array]:
    """The directions, those beyond the horizon moved along theta_h = theta_d to one degree above it."""
    lowest = math.sin(math.radians(1.0))
    below = np.minimum(wi[..., 2], wr[..., 2]) < 1e-9
    h, p, d, q = (a[below] for a in np.meshgrid(*(np.radians(x) for x in grid.params), indexing="ij"))
    low, high = np.zeros_like(h), np.ones_like(h)
    for _ in range(40):
        t = 0.5 * (low + high)
        up = np.cos(t * h) * np.cos(t * d) - np.sin(t * h) * np.sin(t * d) * np.abs(np.cos(q)) >= lowest
        low, high = np.where(up, t, low), np.where(up, high, t)
    wi, wr = wi.copy(), wr.copy()
    wi[below], wr[below] = directions(low * h, p, low * d, q)
    return wi, wr


def write(path: Path, material: Material, attributes: Mapping[str, str] | None = None) -> None:
    """Write a material; numbers come back bit for bit."""
    write_grid(path, grid_of(material), {**material.attributes, **(attributes or {})})


def write_grid(path: Path, grid: Grid, attributes: Mapping[str, str]) -> None:
    """Write one block as text."""
    from gonio import __version__

    kind = grid.channels.kind
    out = ["VERSION 0.2", f"SOFTWARE gonio-{__version__}", ""]
    out += ["# BRDF f_r [1/sr]; angles in degrees; theta_h, phi_h, theta_d, phi_d after Rusinkiewicz"]
    out += [f"# {rows.one_line(k)}: {rows.one_line(v)}" for k, v in sorted(attributes.items()) if k != "material"]
    out += [
        "DATA_TYPE brdf",
        f"COLOR_MODEL {'spectrum' if kind == 'spectral' else 'monochrome' if kind == 'single' else kind}",
    ]
    if grid.channels.wavelengths_nm is not None:
        out.append("WAVELENGTH_LIST " + " ".join(map(repr, grid.channels.wavelengths_nm)))
    out.append(f"PARAM_TYPE {grid.kind}")
    if grid.reductions:
        out.append("REDUCTION_TYPE " + " ".join(grid.reductions))
    for k, values in enumerate(grid.params):
        if k != 1 or len(values) > 1:
            out.append(f"PARAM{k}_LIST " + " ".join(map(repr, values.tolist())))
    if attributes.get("material"):
        out.append(f"NAME {rows.one_line(attributes['material'], 200)}")
    out += [f"SOURCE_TYPE {'generated' if attributes.get('origin', '') == 'model' else 'measured'}", "DATA ascii"]
    body = np.transpose(grid.value, (4, 3, 2, 1, 0)).reshape(-1, len(grid.channels))
    rows.put(path, "\n".join(out) + "\n" + "".join(" ".join(map(repr, row)) + "\n" for row in body.tolist()))
