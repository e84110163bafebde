"""Cornell ``.brdf`` text, as pbrt-v2 reads it: rows of four angles and a value for each wavelength, read only.

``#`` begins a comment. The numbers are: how many wavelengths, the wavelengths [nm], then rows theta_i, phi_i, theta_r,
phi_r [rad] and the BRDF [1/sr] at each wavelength, in free format. The mirror direction is at phi_r = phi_i + pi. gonio
has one channel: the wavelength nearest to 555 nm is read unless another is asked for. Rows at or below the horizon are
left out and counted; values are data even where they are 0. There are no uncertainties: u_f_r is NaN.

References
----------
.. [1] M. Pharr, G. Humphreys, pbrt-v2, src/materials/measured.cpp (irregular isotropic BRDF data).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gonio import files
from gonio.errors import DatasetError
from gonio.samples import BRDFSamples

MOST_WAVELENGTHS = 2000
PHOTOPIC_PEAK_NM = 555.0


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


def read(path: Path, wavelength_nm: float | None = None) -> BRDFSamples:
    """Samples at one wavelength.

    Parameters
    ----------
    path : Path
    wavelength_nm : float, optional
        The nearest one in the file is taken; 555 nm by default.
    """
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
    wavelengths = np.array(values[1 : 1 + n])
    if np.any(wavelengths <= 0) or np.any(wavelengths > 1e6):
        raise DatasetError(f"{path}, line {counts[1]}: a wavelength is not between 0 and 1e6 nm; the file is damaged")
    rows = np.array(values[1 + n :]).reshape(-1, 4 + n)
    chosen = int(np.argmin(np.abs(wavelengths - (wavelength_nm or PHOTOPIC_PEAK_NM))))
    theta_i, phi_i, theta_r, phi_r = rows[:, :4].T
    outside = np.any((rows[:, [0, 2]] < 0) | (rows[:, [0, 2]] > np.pi), axis=1) | np.any(
        np.abs(rows[:, [1, 3]]) > 4 * np.pi, axis=1
    )
    if np.any(outside):
        at = int(np.flatnonzero(outside)[0])
        line_of_row = counts[1 + n + at * (4 + n)]
        raise DatasetError(f"{path}, line {line_of_row}: an angle is beyond half a turn; angles must be in radians")
    keep = (theta_i < np.pi / 2) & (theta_r < np.pi / 2)
    if not np.any(keep):
        raise DatasetError(f"{path} holds no sample above the horizon")
    attributes = {
        "quantity": "brdf",
        "source_quantity": "brdf",
        "source_format": "cornell",
        "wavelength_nm": f"{wavelengths[chosen]:g}",
        "n_wavelengths": str(n),
        "n_below_horizon": str(int(np.count_nonzero(~keep))),
    }
    return BRDFSamples.plain(
        theta_i[keep], np.mod(phi_i[keep], 2 * np.pi), theta_r[keep], np.mod(phi_r[keep], 2 * np.pi),
        rows[keep, 4 + chosen], attributes=attributes,
    )  # fmt: skip
