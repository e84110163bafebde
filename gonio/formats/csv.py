"""Samples as CSV: angles in degrees, an exact round trip.

::

    # gonio samples 1
    # quantity: brdf
    theta_i_deg,phi_i_deg,theta_r_deg,phi_r_deg,f_r,u_f_r
    30,0,45,180,0.25,0.0025

An empty ``u_f_r`` means unknown; the column may be absent. Several channels are columns ``f_r_red``, ``u_f_r_red``, ... or
``f_r_550nm``, ``u_f_r_550nm``, ...; an empty ``f_r_...`` was not measured. Mirror direction at phi_r = phi_i + 180 degrees.
Angles are written with as many digits as bring back the same radians bit for bit: up to 17 where a float of degrees does,
more (18 to 21, which are converted in higher precision) where none exists. Shared errors and poses do not fit into these
columns and stay in NetCDF; the header says so. A column that is not known is refused: rows of several wavelengths must not
be mixed unseen.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from decimal import Decimal, localcontext
from pathlib import Path

import numpy as np

from gonio import files
from gonio.channels import SINGLE, Channels, ChannelSamples, from_names
from gonio.errors import DatasetError
from gonio.formats import quantity, rows
from gonio.samples import BRDFSamples

ANGLES = ("theta_i_deg", "phi_i_deg", "theta_r_deg", "phi_r_deg")
COLUMNS = (*ANGLES, "f_r", "u_f_r")
PI = Decimal("3.14159265358979323846264338327950288419716939937511")
RADIANS = PI / 180


def sniff(head: bytes) -> bool:
    """The first line that is no comment names the columns."""
    for line in head.decode("utf-8-sig", "replace").splitlines():
        if line.strip() and not line.lstrip().startswith("#"):
            return "theta_i_deg" in line and "," in line
    return False


def read(path: Path, quantity_given: str | None = None) -> ChannelSamples:
    """Samples of a CSV file.

    Parameters
    ----------
    path : Path
    quantity_given : str, optional
        What the columns ``f_r`` hold: a key of `gonio.formats.quantity.QUANTITIES`. By default what the header says, else
        ``"brdf"``.

    Raises
    ------
    DatasetError
        With the line, if anything in the file cannot be used.
    """
    lines = files.read_lines(path)
    stated: str | None = None
    attributes: dict[str, str] = {}
    position: dict[str, int] = {}
    channels, value_at, u_at = SINGLE, [0], [0]
    found: list[tuple[float, ...]] = []
    below = 0
    cache: dict[str, float] = {}
    for count, line in enumerate(lines, 1):
        where = f"{path}, line {count}"
        if line.lstrip().startswith("#"):
            if not position:
                name, _, text = line.lstrip()[1:].partition(":")
                if name.strip() == "quantity":
                    stated = text.strip().split(" ")[0]
                elif name.strip().startswith("attribute "):
                    attributes[name.strip()[len("attribute ") :]] = text.strip()
            continue
        if not line.strip():
            continue
        cells = [cell.strip().strip('"') for cell in line.split(",")]
        if not position:
            position, channels = _columns(cells, where)
            names = [""] if channels is SINGLE else [f"_{name}" for name in channels.names]
            value_at, u_at = ([position.get(f"{kind}{name}", -1) for name in names] for kind in ("f_r", "u_f_r"))
            continue
        if len(cells) != len(position):
            raise DatasetError(f"{where}: {len(cells)} cells, the header names {len(position)} columns; correct the line")
        angles = [_radians(cells[position[name]], where, cache) for name in ANGLES]
        missing = len(channels) > 1
        values = [math.nan if missing and not cells[k] else files.number(cells[k], where) for k in value_at]
        u_values = [math.nan if k < 0 or cells[k].lower() in ("", "nan") else files.number(cells[k], where) for k in u_at]
        if any(u < 0 for u in u_values):
            raise DatasetError(f"{where}: u_f_r = {min(u_values):g} is negative; leave the cell empty if it is unknown")
        if angles[0] < 0 or angles[2] < 0 or angles[0] > np.pi or angles[2] > np.pi:
            raise DatasetError(f"{where}: a polar angle is outside 0 to 180 degrees; use phi for the side")
        if max(angles[0], angles[2]) >= np.pi / 2:
            below += 1
            continue
        found.append((*angles, *values, *u_values))
    if not position:
        raise DatasetError(f"{path} names no columns; the first line must be: {','.join(COLUMNS)}")
    if not found:
        raise DatasetError(f"{path} holds no sample above the horizon")
    if stated is not None and stated not in quantity.QUANTITIES:
        raise DatasetError(
            f"{path}: the header states the quantity {files.shown(stated)}; known are: {', '.join(quantity.QUANTITIES)}"
        )
    if quantity_given is not None and stated is not None and quantity.check(quantity_given) != stated:
        raise DatasetError(
            f"{path} states its quantity as {stated}, and {quantity_given} was asked for; correct the header or the option"
        )
    which = quantity_given or stated or "brdf"
    table = np.array(found)
    factor = quantity.factor_to_brdf(which, table[:, 2])[:, None]
    attributes |= {
        "quantity": "brdf",
        "source_quantity": which if quantity_given or stated else f"{which} (assumed: neither header nor option says)",
        "source_format": "csv",
        "n_below_horizon": str(below),
    }
    value, u = table[:, 4 : 4 + len(channels)] * factor, table[:, 4 + len(channels) :] * factor
    theta_i, phi_i, theta_r, phi_r = np.ascontiguousarray(table[:, :4].T)
    return ChannelSamples(theta_i, phi_i, theta_r, phi_r, value, u, channels, attributes)


def write(path: Path, samples: BRDFSamples | ChannelSamples, attributes: Mapping[str, str] | None = None) -> None:
    """Write samples as BRDF [1/sr]; the same samples always give the same bytes."""
    out = ["# gonio samples 1", f"# quantity: brdf [1/sr], {quantity.QUANTITIES['brdf']}"]
    out.append("# angles in degrees from the normal; mirror direction at phi_r = phi_i + 180")
    out.append("# u_f_r: standard uncertainty (k = 1) of random errors [1/sr], empty if unknown")
    if isinstance(samples, BRDFSamples) and samples.shared:
        listed = ", ".join(f"{e.name} u={e.u!r} [{e.unit}]" for e in samples.shared)
        out.append(
            rows.one_line(f"# not in u_f_r, shared by all samples: {listed}; their derivatives are kept in NetCDF only")
        )
    for name, text in sorted(({**samples.attributes, **(attributes or {})}).items()):
        if name not in ("quantity", "source_quantity", "source_format", "n_below_horizon"):
            out.append(rows.one_line(f"# attribute {name.replace(':', ' ')}: {text}", 2000))
    single = isinstance(samples, BRDFSamples) or len(samples.channels) == 1
    names = [""] if single else [f"_{name}" for name in samples.channels.names]  # type: ignore[union-attr]
    out.append(",".join((*ANGLES, *(f"{kind}{name}" for name in names for kind in ("f_r", "u_f_r")))))
    cache: dict[float, str] = {}
    columns = (samples.theta_i, samples.phi_i, samples.theta_r, samples.phi_r)
    angles = [[_degrees(value, cache) for value in column.tolist()] for column in columns]
    n = len(samples)
    # value and uncertainty of each channel side by side, (n, 2 c)
    numbers = np.stack((samples.f_r.reshape(n, -1), samples.u_f_r.reshape(n, -1)), axis=-1).reshape(n, -1)
    for a, b, c, d, row in zip(*angles, numbers.tolist(), strict=True):
        out.append(f"{a},{b},{c},{d}," + ",".join("" if x != x else repr(x) for x in row))
    rows.put(path, "\n".join(out) + "\n")


def _columns(cells: list[str], where: str) -> tuple[dict[str, int], Channels]:
    """Position of each column, and the channels they name."""
    given = [cell[len("f_r_") :] for cell in cells if cell.startswith("f_r_")]
    known = [*COLUMNS] if not given else [*ANGLES, *(f"{kind}_{name}" for name in given for kind in ("f_r", "u_f_r"))]
    shown = ",".join(COLUMNS)
    for cell in cells:
        if cell not in known:
            raise DatasetError(f"{where}: unknown column {files.shown(cell)}; a samples CSV has {shown}")
    missing = [name for name in known if name not in cells and not name.startswith("u_f_r")]
    if missing or len(set(cells)) != len(cells):
        problem = f"column {missing[0]} is missing" if missing else "a column is named twice"
        raise DatasetError(f"{where}: {problem}; a samples CSV has {shown}")
    return {name: index for index, name in enumerate(cells)}, from_names(tuple(given), where) if given else SINGLE


def _radians(text: str, where: str, cache: dict[str, float]) -> float:
    """Radians of decimal degrees, the inverse of `_degrees`."""
    if text not in cache:
        value = files.number(text, where)
        if abs(value) > 1e6:
            raise DatasetError(f"{where}: an angle of {value:g} degrees; angles must be in degrees within one turn")
        cache[text] = _long(text) if len(text.strip("-+").replace(".", "").lstrip("0")) > 17 else math.radians(value)
    return cache[text]


def _long(text: str) -> float:
    """Correctly rounded radians."""
    with localcontext(prec=50):
        return float(Decimal(text) * RADIANS)


def _degrees(radians: float, cache: dict[float, str]) -> str:
    """The shortest of a few decimal degrees that gives these radians back."""
    if radians not in cache:
        near = math.degrees(radians)
        neighbours = (math.nextafter(near, 1e9), math.nextafter(near, -1e9))
        for degrees in (float(f"{near:.6g}"), float(f"{near:.12g}"), near, *neighbours):
            if math.radians(degrees) == radians:
                plain = format(Decimal(repr(degrees)), "f")  # no exponents
                cache[radians] = plain.rstrip("0").rstrip(".") if "." in plain else plain
                return cache[radians]
        with localcontext(prec=50):  # no float of degrees has these radians
            exact = Decimal(radians) / RADIANS
        for digits in (18, 19, 20, 21):
            text = format(exact, f".{digits}g")
            if _long(text) == radians:
                break
        cache[radians] = format(Decimal(text), "f")
    return cache[radians]
