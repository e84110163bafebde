"""Samples as CSV: six columns, angles in degrees, an exact round trip.

::

    # gonio samples 1
    # quantity: brdf
    theta_i_deg,phi_i_deg,theta_r_deg,phi_r_deg,f_r,u_f_r
    30,0,45,180,0.25,0.0025

An empty ``u_f_r`` means unknown; the column may be absent. Mirror direction at phi_r = phi_i + 180 degrees. Angles are
written with as many digits as bring back the same radians bit for bit: up to 17 where a float of degrees does, more (18 to
21, which are converted in higher precision) where none exists. Shared errors and poses do not fit
into six columns and stay in NetCDF; the header says so. A column that is not known is refused: rows of several
wavelengths must not be mixed unseen.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from decimal import Decimal, localcontext
from pathlib import Path

import numpy as np

from gonio import files
from gonio.errors import DatasetError
from gonio.formats import quantity
from gonio.samples import BRDFSamples

COLUMNS = ("theta_i_deg", "phi_i_deg", "theta_r_deg", "phi_r_deg", "f_r", "u_f_r")
PI = Decimal("3.14159265358979323846264338327950288419716939937511")
RADIANS = PI / 180


def sniff(head: bytes) -> bool:
    """The first line that is no comment names the columns."""
    for line in head.decode("utf-8-sig", "replace").splitlines():
        if line.strip() and not line.lstrip().startswith("#"):
            return "theta_i_deg" in line and "," in line
    return False


def read(path: Path, quantity_given: str | None = None) -> BRDFSamples:
    """Samples of a CSV file.

    Parameters
    ----------
    path : Path
    quantity_given : str, optional
        What the column ``f_r`` holds: a key of `gonio.formats.quantity.QUANTITIES`. By default what the header says, else
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
    rows: list[tuple[float, ...]] = []
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
            position = _columns(cells, where)
            continue
        if len(cells) != len(position):
            raise DatasetError(f"{where}: {len(cells)} cells, the header names {len(position)} columns; correct the line")
        angles = [_radians(cells[position[name]], where, cache) for name in COLUMNS[:4]]
        value = files.number(cells[position["f_r"]], where)
        u = cells[position["u_f_r"]] if "u_f_r" in position else ""
        u_value = float("nan") if u.lower() in ("", "nan") else files.number(u, where)
        if u_value < 0:
            raise DatasetError(f"{where}: u_f_r = {u_value:g} is negative; leave the cell empty if it is unknown")
        if angles[0] < 0 or angles[2] < 0 or angles[0] > np.pi or angles[2] > np.pi:
            raise DatasetError(f"{where}: a polar angle is outside 0 to 180 degrees; use phi for the side")
        if max(angles[0], angles[2]) >= np.pi / 2:
            below += 1
            continue
        rows.append((*angles, value, u_value))
    if not position:
        raise DatasetError(f"{path} names no columns; the first line must be: {','.join(COLUMNS)}")
    if not rows:
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
    table = np.array(rows)
    factor = quantity.factor_to_brdf(which, table[:, 2])
    attributes |= {
        "quantity": "brdf",
        "source_quantity": which if quantity_given or stated else f"{which} (assumed: neither header nor option says)",
        "source_format": "csv",
        "n_below_horizon": str(below),
    }
    theta_i, phi_i, theta_r, phi_r, f_r, u_f_r = table.T
    return BRDFSamples.plain(theta_i, phi_i, theta_r, phi_r, f_r * factor, u_f_r * factor, attributes)


def write(path: Path, samples: BRDFSamples, attributes: Mapping[str, str] | None = None) -> None:
    """Write samples as BRDF [1/sr]; the same samples always give the same bytes."""
    out = ["# gonio samples 1", f"# quantity: brdf [1/sr], {quantity.QUANTITIES['brdf']}"]
    out.append("# angles in degrees from the normal; mirror direction at phi_r = phi_i + 180")
    out.append("# u_f_r: standard uncertainty (k = 1) of random errors [1/sr], empty if unknown")
    if samples.shared:
        listed = ", ".join(f"{e.name} u={e.u!r} [{e.unit}]" for e in samples.shared)
        out.append(_one_line(f"# not in u_f_r, shared by all samples: {listed}; their derivatives are kept in NetCDF only"))
    for name, text in sorted(({**samples.attributes, **(attributes or {})}).items()):
        if name not in ("quantity", "source_quantity", "source_format", "n_below_horizon"):
            out.append(_one_line(f"# attribute {name.replace(':', ' ')}: {text}"))
    out.append(",".join(COLUMNS))
    cache: dict[float, str] = {}
    columns = (samples.theta_i, samples.phi_i, samples.theta_r, samples.phi_r)
    angles = [[_degrees(value, cache) for value in column.tolist()] for column in columns]
    for a, b, c, d, f, u in zip(*angles, samples.f_r.tolist(), samples.u_f_r.tolist(), strict=True):
        out.append(f"{a},{b},{c},{d},{f!r},{'' if u != u else repr(u)}")
    text = "\n".join(out) + "\n"

    def put(temporary: Path) -> None:
        temporary.write_bytes(text.encode())

    files.replace_atomically(path, put)


def _columns(cells: list[str], where: str) -> dict[str, int]:
    for cell in cells:
        if cell not in COLUMNS:
            raise DatasetError(f"{where}: unknown column {files.shown(cell)}; a samples CSV has {','.join(COLUMNS)}")
    missing = [name for name in COLUMNS[:5] if name not in cells]
    if missing or len(set(cells)) != len(cells):
        problem = f"column {missing[0]} is missing" if missing else "a column is named twice"
        raise DatasetError(f"{where}: {problem}; a samples CSV has {','.join(COLUMNS)}")
    return {name: index for index, name in enumerate(cells)}


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


def _one_line(text: str) -> str:
    return "".join(c if c.isprintable() else " " for c in text)
