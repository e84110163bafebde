"""ALTA text: rows of parameters and values under a header of ``#`` lines.

Between ``#ALTA_BEGIN_HEADER`` and ``#ALTA_END_HEADER`` (older files have neither line) stand ``#DIM nx ny``, ``#PARAM_IN``
(what the first nx columns are), ``#PARAM_OUT`` (what the next ny are) and ``#VS`` (columns of confidence, which are
skipped: 1 or 2 for each value). A comment ``# channels: 450nm, 550nm`` names values that are no colour. Angles are in
radians. ``INV_STERADIAN`` and the colours are f_r [1/sr]; ``INV_STERADIAN_COSINE_FACTOR`` is f_r cos(theta_r) and is
converted. Written is ``SPHERICAL_TL_PL_TV_PV``.

Read are the parametrisations whose directions are unique: spherical, isotropic, half and difference angles, Cartesian. The
others are refused by name. ALTA measures azimuths as gonio does.

References
----------
.. [1] belcour/alta, sources/core/params.cpp, sources/core/vertical_segment.cpp.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gonio import files
from gonio.channels import RGB, SINGLE, XYZ, ChannelSamples, from_names
from gonio.errors import DatasetError
from gonio.formats import rows
from gonio.geometry import angles
from gonio.halfdiff import directions

Array = NDArray[np.float64]
INPUTS = {
    "SPHERICAL_TL_PL_TV_PV": 4,
    "ISOTROPIC_TV_TL_DPHI": 3,
    "RUSIN_TH_TD_PD": 3,
    "RUSIN_TH_PH_TD_PD": 4,
    "RUSIN_TH_TD": 2,
    "COS_TH_TD": 2,
    "COS_TH": 1,
    "CARTESIAN": 6,
}
OUTPUTS = ("INV_STERADIAN", "INV_STERADIAN_COSINE_FACTOR", "RGB_COLOR", "XYZ_COLOR")


def sniff(head: bytes) -> bool:
    """A comment line that names the dimensions or the input."""
    lines = head.decode("utf-8-sig", "replace").splitlines()
    return any(line.upper().startswith(("#ALTA_BEGIN_HEADER", "#PARAM_IN ", "#DIM ")) for line in lines)


def read(path: Path) -> ChannelSamples:
    """Samples; `DatasetError` with the line if the file is damaged or in a parametrisation that is not read."""
    header: dict[str, list[str]] = {}
    names: tuple[str, ...] = ()
    body: list[tuple[int, list[str]]] = []
    for count, line in enumerate(files.read_lines(path), 1):
        if line.startswith("#"):
            words = line[1:].split()
            if words and not body:
                header[words[0].upper()] = words[1:]
            if words[:1] == ["channels:"]:
                names = tuple(name.strip(",") for name in words[1:])
        elif line.strip():
            body.append((count, line.split()))
    dim = header.get("DIM", [])
    if len(dim) != 2:
        raise DatasetError(f"{path}: the header lacks #DIM with two numbers; it is no ALTA text or is cut")
    nx, ny = files.whole(dim[0], f"{path}, #DIM", 6), files.whole(dim[1], f"{path}, #DIM", 2000)
    given, out = ((header.get(name) or ["UNKNOWN_INPUT"])[0].upper() for name in ("PARAM_IN", "PARAM_OUT"))
    if INPUTS.get(given) != nx:
        raise DatasetError(
            f"{path}: {nx} columns of {files.shown(given)} are no parametrisation that gonio reads "
            f"({', '.join(INPUTS)}); convert them first"
        )
    if out not in OUTPUTS:
        raise DatasetError(f"{path}: PARAM_OUT {files.shown(out)} says no quantity that gonio knows ({', '.join(OUTPUTS)})")
    extra = ny * _confidence(path, header.get("VS", ["0"]))
    table, at = rows.parse(path, body, nx + ny + extra)
    x, value = table[:, :nx], table[:, nx : nx + ny]
    if np.abs(x).max() > 4 * np.pi:
        row = at[int(np.argmax(np.abs(x).max(axis=1)))]
        raise DatasetError(f"{path}, line {row}: a coordinate of {np.abs(x).max():g}; angles must be in radians")
    four = _angles(given, x)
    if out == "INV_STERADIAN_COSINE_FACTOR":
        up = four[:, 2] < np.pi / 2
        value = np.where(up[:, None], value, 0.0) / np.where(up, np.cos(four[:, 2]), 1.0)[:, None]
    channels = {"RGB_COLOR": RGB, "XYZ_COLOR": XYZ}.get(out) if ny == 3 else None
    if channels is None and ny > 1 and len(names) != ny:
        raise DatasetError(f"{path} has {ny} values in a row and does not say of what; add a line '# channels: 450nm, ...'")
    if channels is None:
        channels = from_names(names, str(path)) if len(names) == ny else SINGLE
    source = "brdf_cos" if out == "INV_STERADIAN_COSINE_FACTOR" else "brdf"
    attributes = {"source_quantity": f"{source} ({out})", "source_format": "alta", "parametrisation": given}
    return rows.samples(path, four, value, channels, attributes, at)


def write(path: Path, found: ChannelSamples, attributes: Mapping[str, str] | None = None) -> None:
    """Write samples; numbers come back bit for bit."""
    rows.complete(path, found, "an ALTA text")
    kind, n = found.channels.kind, len(found.channels)
    out = ["#ALTA_BEGIN_HEADER", f"#DIM 4 {n}", "#PARAM_IN SPHERICAL_TL_PL_TV_PV"]
    out += [f"#PARAM_OUT {'RGB_COLOR' if kind == 'rgb' else 'XYZ_COLOR' if kind == 'xyz' else 'INV_STERADIAN'}", "#VS 0"]
    out.append("#ALTA_END_HEADER")
    out.append("# BRDF f_r [1/sr]; theta_i phi_i theta_r phi_r [rad]; mirror direction at phi_r = phi_i + pi")
    out.append(f"# channels: {', '.join(found.channels.names)}")
    out += [
        f"# {rows.one_line(k)}: {rows.one_line(v)}" for k, v in sorted({**found.attributes, **(attributes or {})}.items())
    ]
    rows.put(path, "\n".join(out) + "\n" + rows.text(found, " "))


def _confidence(path: Path, words: list[str]) -> int:
    """How many columns of confidence each value has."""
    if not words or any(w not in ("0", "1", "2") for w in words) or len(set(words)) != 1:
        raise DatasetError(f"{path}: #VS {files.shown(' '.join(words))} must be 0, 1 or 2, the same for every value")
    return int(words[0])


def _angles(given: str, x: Array) -> Array:
    """theta_i, phi_i, theta_r, phi_r [rad] of the parameters (n, k), shape (n, 4)."""
    zero = np.zeros(len(x))
    if given == "SPHERICAL_TL_PL_TV_PV":
        return x
    if given == "ISOTROPIC_TV_TL_DPHI":
        return np.stack((x[:, 1], zero, x[:, 0], x[:, 2]), axis=-1)
    if given == "CARTESIAN":  # view, then light
        norm = np.linalg.norm(x.reshape(-1, 2, 3), axis=-1, keepdims=True)
        wr, wi = np.moveaxis(x.reshape(-1, 2, 3) / np.where(norm > 0, norm, 1.0), 1, 0)
    else:
        half = {
            "RUSIN_TH_TD_PD": (0, None, 1, 2),
            "RUSIN_TH_PH_TD_PD": (0, 1, 2, 3),
            "RUSIN_TH_TD": (0, None, 1, None),
            "COS_TH_TD": (0, None, 1, None),
            "COS_TH": (0, None, None, None),
        }[given]
        columns = [zero if k is None else x[:, k] for k in half]
        if given.startswith("COS"):
            columns = [np.arccos(np.clip(c, -1, 1)) if k is not None else zero for k, c in zip(half, columns, strict=True)]
        if given == "RUSIN_TH_TD":
            columns[3] = np.full(len(x), np.pi / 2)  # ALTA's own choice
        wi, wr = directions(*columns)
    return np.stack((*angles(wi), *angles(wr)), axis=-1)
