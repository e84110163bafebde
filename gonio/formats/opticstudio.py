"""OpticStudio (Zemax) tabular ``.bsdf``: scatter around the specular direction, read only.

A header of keywords with counts and angles in degrees, then ``DataBegin``, one block for each sample rotation and angle
of incidence (``TIS`` and a row for each scatter azimuth with a column for each radial angle), and ``DataEnd``. Keywords are
matched without case, as programs differ. Angles are relative to the specular direction: radial 0 is specular, azimuth 0
runs from specular towards the normal, counter-clockwise seen against the specular ray. Sample rotation turns the sample
under a fixed light, so azimuths on the sample fall as it grows.

An exact 0 stands for directions below the horizon and for directions that were never measured; both are left out and
counted. All azimuths of radial 0 are one direction and give one sample. Transmission is refused, and of the three
tristimulus blocks only Y is read. The file has no uncertainties: u_f_r is NaN.

References
----------
.. [1] Ansys OpticStudio knowledge base, "BSDF Data Interchange File Format Specification" (Radiant Imaging, 2008).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gonio import files
from gonio.errors import DatasetError
from gonio.geometry import angles
from gonio.samples import BRDFSamples

LISTS = {"samplerotation": 720, "angleofincidence": 1000, "scatterazimuth": 3600, "scatterradial": 3600}
WORDS = ("source", "symmetry", "spectralcontent", "scattertype")
SYMMETRIES = ("planesymmetrical", "asymmetrical", "asymmetrical4d")
Words = tuple[int, list[str]]


def sniff(head: bytes) -> bool:
    """A keyword of the header, and the angle of incidence as a list (LightTools writes it block by block)."""
    words = {line.split()[0].lower() for line in head.decode("utf-8-sig", "replace").splitlines() if line.split()}
    return "angleofincidence" in words and bool(words & {"symmetry", "spectralcontent", "scattertype", "scatterradial"})


def read(path: Path) -> BRDFSamples:
    """Samples at the measured directions above the horizon.

    Raises
    ------
    DatasetError
        With the line, if the file is damaged, too large, or holds transmission.
    """
    words = _words(files.read_lines(path))
    header, lists = _header(path, words)
    rotation, incidence = lists["samplerotation"], lists["angleofincidence"]
    azimuth, radial = lists["scatterazimuth"], lists["scatterradial"]
    _check_angles(path, incidence, azimuth, radial, header["symmetry"])
    cells = len(rotation) * len(incidence) * len(azimuth) * len(radial)
    if 2 * cells > files.size_of(path):
        raise DatasetError(f"{path}: the header announces {cells} values, more than its bytes can hold; it is cut")
    blocks = _blocks(path, words, len(rotation) * len(incidence), len(azimuth), len(radial))
    data, tis = blocks

    # specular direction s, e_1 from s towards the normal, e_2 = s x e_1; light at azimuth 0, mirror side at 180 degrees
    a = np.radians(np.array(incidence))[:, None, None]
    az, r = np.radians(np.array(azimuth))[:, None], np.radians(np.array(radial))
    along = np.cos(az) * np.sin(r)
    x = -np.sin(a) * np.cos(r) + np.cos(a) * along
    y = np.broadcast_to(np.sin(az) * np.sin(r), x.shape)
    z = np.cos(a) * np.cos(r) + np.sin(a) * along
    theta_r, phi_r = angles(np.stack((x, y, z), axis=-1))  # (incidence, azimuth, radial)
    turn = -np.radians(np.array(rotation))[:, None, None, None]  # the sample turns under fixed light
    shape = (len(rotation), *x.shape)
    values = data.reshape(shape)
    one = np.ones(x.shape, dtype=bool)
    one[:, 1:, np.array(radial) == 0.0] = False  # the specular direction, once
    above = np.broadcast_to((z > 1e-9) & one, shape)
    measured = above & (values != 0.0)
    if not np.any(measured):
        raise DatasetError(f"{path}: all values above the horizon are 0, which means never measured; the file is empty")

    def picked(array: np.ndarray) -> np.ndarray:
        return np.asarray(np.broadcast_to(array, shape)[measured])

    attributes = {
        "quantity": "brdf",
        "source_quantity": "brdf",
        "source_format": "opticstudio",
        "symmetry": header["symmetry"],
        "spectral_content": header["spectralcontent"],
        "directions": "specular-relative in the file, converted to polar angle and azimuth from the normal",
        "n_above_horizon": str(int(np.count_nonzero(above))),
        "n_missing": str(int(np.count_nonzero(above & ~measured))),
        "missing": "an exact 0 marks a direction that was never measured",
        "total_integrated_scatter": ", ".join(f"{t:g}" for t in tis[:100]),
    }
    comment = _sample_name(files.read_lines(path))
    if comment:
        attributes["material"] = comment
    return BRDFSamples.plain(
        picked(a), np.mod(picked(turn), 2 * np.pi), picked(theta_r), np.mod(picked(phi_r + turn), 2 * np.pi),
        values[measured], attributes=attributes,
    )  # fmt: skip


def _words(lines: list[str]) -> Iterator[Words]:
    for count, line in enumerate(lines, 1):
        words = line.partition("#")[0].split()
        if words:
            yield count, words


def _header(path: Path, words: Iterator[Words]) -> tuple[dict[str, str], dict[str, list[float]]]:
    """Everything up to ``DataBegin``."""
    header = {"symmetry": "", "spectralcontent": "monochrome", "scattertype": "brdf", "source": ""}
    lists: dict[str, list[float]] = {}
    block = ""
    for count, line in words:
        where, keyword = f"{path}, line {count}", line[0].lower()
        if keyword == "databegin":
            missing = [name for name in LISTS if name not in lists and name != "samplerotation"]
            if missing:
                raise DatasetError(f"{where}: the data begin, and the list {missing[0]} is missing; the file is damaged")
            lists.setdefault("samplerotation", [0.0])
            if header["symmetry"] not in SYMMETRIES:
                raise DatasetError(
                    f"{path}: Symmetry is {files.shown(header['symmetry'])}; read are PlaneSymmetrical and Asymmetrical"
                )
            if header["scattertype"] != "brdf":
                raise DatasetError(
                    f"{path}: ScatterType is {files.shown(header['scattertype'])}; gonio reads reflection (BRDF) only"
                )
            if block in ("tristimulusx", "tristimulusz"):
                _skip_to(path, words, "tristimulusy")
                _skip_to(path, words, "databegin")
            return header, lists
        if keyword in LISTS:
            if len(line) != 2 or keyword in lists:
                raise DatasetError(f"{where}: {line[0]} must stand once, with the number of its angles; correct the line")
            n = files.whole(line[1], where, LISTS[keyword])
            values: list[float] = []
            while len(values) < n:
                count, line = _next(path, words, f"the {n} angles of {keyword}")
                values += files.numbers(line, f"{path}, line {count}")
            if len(values) != n:
                raise DatasetError(f"{path}, line {count}: {keyword} announces {n} angles and lists {len(values)}")
            lists[keyword] = values
        elif keyword in WORDS:
            header[keyword] = line[1].lower() if len(line) > 1 else ""
        elif keyword == "monochrome" or keyword.startswith("tristimulus"):
            block = keyword
        else:
            raise DatasetError(f"{where}: unknown keyword {files.shown(line[0])}; an OpticStudio BSDF header is expected")
    raise DatasetError(f"{path} ends before DataBegin; the file is cut or is no OpticStudio BSDF")


def _blocks(path: Path, words: Iterator[Words], count: int, rows: int, columns: int) -> tuple[np.ndarray, list[float]]:
    """Values, shape (count, rows, columns), and TIS of the blocks."""
    data = np.empty((count, rows, columns))
    tis: list[float] = []
    for block in range(count):
        line, found = _next(path, words, f"block {block + 1} of {count}")
        if found[0].lower() != "tis" or len(found) != 2:
            raise DatasetError(f"{path}, line {line}: block {block + 1} of {count} must begin with TIS and its value")
        tis.append(files.number(found[1], f"{path}, line {line}"))
        for row in range(rows):
            line, found = _next(path, words, f"row {row + 1} of {rows} in block {block + 1}")
            if len(found) != columns:
                raise DatasetError(f"{path}, line {line}: {len(found)} values, the header announces {columns} radial angles")
            data[block, row] = files.numbers(found, f"{path}, line {line}")
    line, found = _next(path, words, "DataEnd")
    if found[0].lower() != "dataend":
        raise DatasetError(f"{path}, line {line}: more data than the header announces; DataEnd is expected here")
    if np.any(data < 0):
        raise DatasetError(f"{path}: a value of {data.min():g} is negative; an OpticStudio BSDF has none")
    return data, tis


def _next(path: Path, words: Iterator[Words], wanted: str) -> Words:
    found = next(words, None)
    if found is None:
        raise DatasetError(f"{path} ends before {wanted}; the file is cut")
    return found


def _skip_to(path: Path, words: Iterator[Words], keyword: str) -> None:
    while _next(path, words, keyword)[1][0].lower() != keyword:
        pass


def _check_angles(path: Path, incidence: list[float], azimuth: list[float], radial: list[float], symmetry: str) -> None:
    for name, values, low, high in (
        ("AngleOfIncidence", incidence, 0.0, 90.0),
        ("ScatterAzimuth", azimuth, 0.0, 360.0),
        ("ScatterRadial", radial, 0.0, 180.0),
    ):
        if min(values) < low or max(values) > high or (name == "AngleOfIncidence" and max(values) >= high):
            raise DatasetError(
                f"{path}: {name} runs from {min(values):g} to {max(values):g} degrees, allowed is {low:g}..{high:g}"
            )
        if any(b <= a for a, b in itertools.pairwise(values)):
            raise DatasetError(f"{path}: {name} must rise from value to value; the list is damaged")
    if symmetry == "planesymmetrical" and max(azimuth) > 180.0:
        raise DatasetError(
            f"{path}: PlaneSymmetrical, and ScatterAzimuth goes to {max(azimuth):g} degrees; it may reach 180"
        )


def _sample_name(lines: list[str]) -> str:
    """What the comments call the sample."""
    for line in lines[:200]:
        name, colon, text = line.lstrip("# \t").partition(":")
        if line.startswith("#") and colon and name.strip().lower() == "sample":
            return "".join(c for c in text.strip() if c.isprintable())[:200]
    return ""
