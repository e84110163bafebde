"""ASTM E1392 text, in the flavour that open programs read (``.astm``): a header, then comma-separated rows.

Header lines are ``KEYWORD values``; among them is ``NUM_POINTS n``, and the last is ``VARS
theta_i,phi_i,theta_s,phi_s,`` followed by the channels: ``R,G,B``, ``X,Y,Z``, wavelengths such as ``400nm``, or one name.
Angles are in radians, values are f_r [1/sr]; the mirror direction is at phi_s = phi_i + pi. There are no uncertainties.
The texts of E1392 and E2387 themselves were not seen; whether they fix a file record is not known here.

References
----------
.. [1] belcour/alta, sources/plugins/data_io/astm.cpp; KimuraRyo/libbsdf, src/Reader/AstmReader.cpp (the flavour).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from gonio import files
from gonio.channels import ChannelSamples, from_names
from gonio.errors import DatasetError
from gonio.formats import rows

ANGLES = ("theta_i", "phi_i", "theta_s", "phi_s")
LETTERS = {"rgb": ("R", "G", "B"), "xyz": ("X", "Y", "Z"), "single": ("BRDF",)}


def sniff(head: bytes) -> bool:
    """A line VARS that begins with the incident polar angle."""
    lines = (line.split(None, 1) for line in head.decode("utf-8-sig", "replace").splitlines())
    return any(len(w) == 2 and w[0].upper() == "VARS" and w[1].strip().lower().startswith("theta_i") for w in lines)


def read(path: Path) -> ChannelSamples:
    """Samples of all channels; `DatasetError` with the line if the file is damaged."""
    lines = list(enumerate(files.read_lines(path), 1))
    announced, start = 0, 0
    names: tuple[str, ...] = ()
    attributes = {"source_quantity": "brdf", "source_format": "astm"}
    for count, line in lines:
        keyword, _, rest = line.strip().partition(" ")
        where = f"{path}, line {count}"
        if keyword.upper() == "NUM_POINTS":
            announced = files.whole(rest.strip(), where, 10_000_000)
        elif keyword.upper() == "VARS":
            given = tuple(name.strip() for name in rest.split(","))
            if tuple(name.lower() for name in given[:4]) != ANGLES or len(given) < 5:
                raise DatasetError(f"{where}: VARS must be {','.join(ANGLES)} and the channels, got {files.shown(rest)}")
            names, start = given[4:], count
            break
        elif keyword.upper() in ("SAMPLE_NAME", "MATERIAL"):
            attributes["material"] = rows.one_line(rest.strip(), 200)
    if not start:
        raise DatasetError(f"{path} has no line VARS, after which the data begin; the file is cut or is no ASTM text")
    if not announced:
        raise DatasetError(f"{path} does not say NUM_POINTS; add how many rows there are")
    channels = from_names(names, f"{path}, line {start}")
    body = [(count, line.split(",")) for count, line in lines[start:] if line.strip()]
    if len(body) != announced:
        raise DatasetError(f"{path}: NUM_POINTS announces {announced} rows, {len(body)} are there; the file is cut")
    table, at = rows.parse(path, ((count, [w.strip() for w in words]) for count, words in body), 4 + len(channels))
    return rows.samples(path, table[:, :4], table[:, 4:], channels, attributes, at)


def write(path: Path, found: ChannelSamples, attributes: Mapping[str, str] | None = None) -> None:
    """Write samples; numbers come back bit for bit."""
    rows.complete(path, found, "an ASTM text")
    kind = found.channels.kind
    names = found.channels.names if kind == "spectral" else LETTERS[kind]
    out = ["COMMENT BRDF f_r [1/sr], angles [rad], mirror direction at phi_s = phi_i + pi"]
    told = {**found.attributes, **(attributes or {})}
    out += [f"COMMENT {rows.one_line(k)}: {rows.one_line(v)}" for k, v in sorted(told.items()) if k != "material"]
    if "material" in told:
        out.append(f"SAMPLE_NAME {rows.one_line(told['material'], 200)}")
    out += [f"NUM_POINTS {len(found)}", f"VARS {','.join((*ANGLES, *names))}", ""]
    rows.put(path, "\n".join(out) + rows.text(found, ","))
