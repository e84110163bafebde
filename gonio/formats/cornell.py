"""Cornell ``.brdf`` text, as pbrt-v2 reads it: rows of four angles and a value for each wavelength.

``#`` begins a comment. The numbers are: how many wavelengths, the wavelengths [nm], then rows theta_i, phi_i, theta_r,
phi_r [rad] and the BRDF [1/sr] at each wavelength, in free format. The mirror direction is at phi_r = phi_i + pi. Rows at
or below the horizon are left out and counted; values are data even where they are 0. There are no uncertainties: u_f_r is
NaN. Channels without a wavelength are written at nominal ones, which a comment says.

References
----------
.. [1] M. Pharr, G. Humphreys, pbrt-v2, src/materials/measured.cpp (irregular isotropic BRDF data).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from gonio import files
from gonio.channels import PHOTOPIC_PEAK_NM, ChannelSamples, spectral
from gonio.errors import DatasetError
from gonio.formats import rows

MOST_WAVELENGTHS = 2000
NOMINAL_NM = {"single": (PHOTOPIC_PEAK_NM,), "rgb": (610.0, 550.0, 465.0), "xyz": (600.0, 555.0, 445.0)}


def sniff(head: bytes) -> bool:
    """All words are numbers and the first is a count of at least one."""
    words = [w for line in head.decode("utf-8-sig", "replace").splitlines()[:-1] for w in line.partition("#")[0].split()]
    if not words or not words[0].isdigit() or len(words) < 6:
        return False
    try:
        [float(word) for word in words[:1000]]
    except ValueError:
        return False
    return True


def read(path: Path) -> ChannelSamples:
    """Samples at every wavelength of the file."""
    values: list[float] = []
    counts: list[int] = []  # line of each number
    first = ""
    for count, line in enumerate(files.read_lines(path), 1):
        words = line.partition("#")[0].split()
        if words and not first:
            first = words[0]
        values += files.numbers(words, f"{path}, line {count}")
        counts += [count] * len(words)
    n = files.whole(first, f"{path}, line {counts[0] if counts else 1}", MOST_WAVELENGTHS)
    body = len(values) - 1 - n
    if body <= 0 or body % (4 + n):
        raise DatasetError(
            f"{path}: {len(values)} numbers do not make rows of 4 angles and {n} values; the file is cut or of another kind"
        )
    channels = spectral(values[1 : 1 + n], f"{path}, line {counts[1]}")
    table = np.array(values[1 + n :]).reshape(-1, 4 + n)
    attributes = {"source_quantity": "brdf", "source_format": "cornell"}
    return rows.samples(path, table[:, :4], table[:, 4:], channels, attributes, counts[1 + n :: 4 + n])


def write(path: Path, found: ChannelSamples, attributes: Mapping[str, str] | None = None) -> None:
    """Write samples; numbers come back bit for bit."""
    rows.complete(path, found, "a Cornell file")
    wavelengths = found.channels.wavelengths_nm or NOMINAL_NM[found.channels.kind]
    out = ["# BRDF f_r [1/sr]; theta_i phi_i theta_r phi_r [rad]; mirror direction at phi_r = phi_i + pi"]
    if found.channels.wavelengths_nm is None:
        out.append(f"# channels {', '.join(found.channels.names)} at nominal wavelengths: they are not spectral")
    out += [
        f"# {rows.one_line(k)}: {rows.one_line(v)}" for k, v in sorted({**found.attributes, **(attributes or {})}.items())
    ]
    out += [str(len(wavelengths)), " ".join(map(repr, wavelengths)), ""]
    rows.put(path, "\n".join(out) + rows.text(found, " "))
