"""OpticStudio (Zemax) tabular ``.bsdf``: scatter around the specular direction.

A header of keywords with counts and angles in degrees, then ``DataBegin``, one block for each sample rotation and angle
of incidence (``TIS`` and a row for each scatter azimuth with a column for each radial angle), and ``DataEnd``. Keywords are
matched without case, as programs differ. `gonio.formats.specular` says how the angles run.

An exact 0 stands for directions below the horizon and for directions that were never measured; both are left out of the
samples and counted, and are written back as 0. All azimuths of radial 0 are one direction and give one sample. Transmission
is refused. The file has no uncertainties: u_f_r is NaN.

References
----------
.. [1] Ansys OpticStudio knowledge base, "BSDF Data Interchange File Format Specification" (Radiant Imaging, 2008).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from gonio import files
from gonio.channels import SINGLE, XYZ, ChannelSamples
from gonio.errors import DatasetError
from gonio.formats import rows, specular
from gonio.formats.material import INCIDENCES_DEG, Material
from gonio.formats.specular import SpecularTable

LISTS = {"samplerotation": 720, "angleofincidence": 1000, "scatterazimuth": 3600, "scatterradial": 3600}
WORDS = ("source", "symmetry", "spectralcontent", "scattertype")
SYMMETRIES = ("planesymmetrical", "asymmetrical", "asymmetrical4d")
COLOURS = ("tristimulusx", "tristimulusy", "tristimulusz")
Words = tuple[int, list[str]]


def sniff(head: bytes) -> bool:
    """A keyword of the header, and the angle of incidence as a list (LightTools writes it block by block)."""
    words = {line.split()[0].lower() for line in head.decode("utf-8-sig", "replace").splitlines() if line.split()}
    return "angleofincidence" in words and bool(words & {"symmetry", "spectralcontent", "scattertype", "scatterradial"})


def read(path: Path) -> ChannelSamples:
    """Samples at the measured directions above the horizon."""
    table = read_table(path)
    try:
        return table.samples()
    except DatasetError as error:
        raise DatasetError(f"{path}: {error}") from None


def read_table(path: Path) -> SpecularTable:
    """The file's own grid.

    Raises
    ------
    DatasetError
        With the line, if the file is damaged, too large, or holds transmission.
    """
    lines = files.read_lines(path)
    words = _words(lines)
    header, lists, block = _header(path, words)
    angles = {name: np.array(values) for name, values in lists.items()}
    _check_angles(path, lists, header["symmetry"])
    shape = tuple(len(lists[name]) for name in ("samplerotation", "angleofincidence", "scatterazimuth", "scatterradial"))
    colours = COLOURS if block in COLOURS else (block,)
    cells = int(np.prod(shape)) * len(colours)
    if 2 * cells > files.size_of(path):
        raise DatasetError(f"{path}: the header announces {cells} values, more than its bytes can hold; it is cut")
    data, tis = [], []
    for k, colour in enumerate(colours):
        if k:
            _expect(path, words, colour)
            _expect(path, words, "databegin")
        found, scatter = _blocks(path, words, shape[0] * shape[1], shape[2], shape[3])
        data.append(found.reshape(shape))
        tis.append(np.array(scatter).reshape(shape[:2]))
    attributes = {
        "quantity": "brdf",
        "source_quantity": "brdf",
        "source_format": "opticstudio",
        "symmetry": header["symmetry"],
        "spectral_content": header["spectralcontent"],
    }
    comments = tuple(itertools.takewhile(lambda line: line.startswith("#") or not line.strip(), lines[:500]))
    name = _sample_name(comments)
    if name:
        attributes["material"] = name
    return SpecularTable(
        angles["samplerotation"], angles["angleofincidence"], angles["scatterazimuth"], angles["scatterradial"],
        np.stack(data), np.stack(tis), header["symmetry"] == "planesymmetrical", XYZ if len(colours) == 3 else SINGLE,
        comments, attributes,
    )  # fmt: skip


def write(path: Path, material: Material, attributes: Mapping[str, str] | None = None) -> None:
    """Write a material at nine incidences; linear RGB as X, Y, Z, of a spectrum the channel nearest to 555 nm."""
    table = specular.tabulate(material, np.array(INCIDENCES_DEG))
    told = {**material.attributes, **(attributes or {})}
    name = material.channels.names[material.channels.main] if material.channels.kind == "spectral" else ""
    comments = ["# BRDF f_r [1/sr]; angles [deg] relative to the specular direction, azimuth 0 towards the normal"]
    comments += [f"# channel: {name}"] if name else []
    comments += [f"# {rows.one_line(k)}: {rows.one_line(v)}" for k, v in sorted(told.items()) if k != "material"]
    if "material" in told:
        comments.append(f"# Sample: {rows.one_line(told['material'], 200)}")
    write_table(path, table, tuple(comments))


def write_table(path: Path, table: SpecularTable, comments: tuple[str, ...] | None = None) -> None:
    """Write a table; what `read_table` gave comes back number for number."""
    kind = "PlaneSymmetrical" if table.symmetric else "Asymmetrical4D" if len(table.rotation_deg) > 1 else "Asymmetrical"
    out = [rows.one_line(line) for line in (table.comments if comments is None else comments)]
    out += [
        "Source\tMeasured",
        f"Symmetry\t{kind}",
        f"SpectralContent\t{'XYZ' if len(table.channels) == 3 else 'Monochrome'}",
    ]
    out.append("ScatterType\tBRDF")
    lists = (table.rotation_deg, table.incidence_deg, table.azimuth_deg, table.radial_deg)
    for name, values in zip(("SampleRotation", "AngleOfIncidence", "ScatterAzimuth", "ScatterRadial"), lists, strict=True):
        out += [f"{name}\t{len(values)}", "\t".join(f"{v:.15g}" for v in values)]
    for k in range(len(table.channels)):
        out += ["", ("TristimulusX", "TristimulusY", "TristimulusZ")[k] if len(table.channels) == 3 else "Monochrome"]
        out.append("DataBegin")
        for rotation in range(len(table.rotation_deg)):
            for incidence in range(len(table.incidence_deg)):
                out.append(f"TIS\t{float(table.tis[k, rotation, incidence])!r}")
                out += ["\t".join(map(repr, row)) for row in table.value[k, rotation, incidence].tolist()]
        out.append("DataEnd")
    rows.put(path, "\n".join(out) + "\n")


def _words(lines: list[str]) -> Iterator[Words]:
    for count, line in enumerate(lines, 1):
        words = line.partition("#")[0].split()
        if words:
            yield count, words


def _header(path: Path, words: Iterator[Words]) -> tuple[dict[str, str], dict[str, list[float]], str]:
    """Everything up to the first ``DataBegin``: words, lists, and the name of the first block."""
    header = {"symmetry": "", "spectralcontent": "monochrome", "scattertype": "brdf", "source": ""}
    lists: dict[str, list[float]] = {}
    block = "monochrome"
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
            if block in COLOURS[1:]:
                raise DatasetError(f"{where}: the colour blocks begin with {files.shown(block)}; TristimulusX comes first")
            return header, lists, block
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
        elif keyword in ("monochrome", *COLOURS):
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


def _expect(path: Path, words: Iterator[Words], keyword: str) -> None:
    line, found = _next(path, words, keyword)
    if found[0].lower() != keyword:
        raise DatasetError(
            f"{path}, line {line}: {files.shown(found[0])} where {keyword} is expected; a colour block is missing"
        )


def _check_angles(path: Path, lists: dict[str, list[float]], symmetry: str) -> None:
    azimuth = lists["scatterazimuth"]
    for name, values, low, high in (
        ("SampleRotation", lists["samplerotation"], -360.0, 360.0),
        ("AngleOfIncidence", lists["angleofincidence"], 0.0, 90.0),
        ("ScatterAzimuth", azimuth, 0.0, 360.0),
        ("ScatterRadial", lists["scatterradial"], 0.0, 180.0),
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


def _sample_name(comments: tuple[str, ...]) -> str:
    """What the comments call the sample."""
    for line in comments:
        name, colon, text = line.lstrip("# \t").partition(":")
        if colon and name.strip().lower() == "sample":
            return "".join(c for c in text.strip() if c.isprintable())[:200]
    return ""
