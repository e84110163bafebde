"""LightTools tabular ``.bsdf``: absolute angles, one block for each incidence; read only.

The header has ``Symmetry``, ``SpectralContent``, and the lists ``ScatterAzimuth`` and ``ScatterRadial`` [deg] with their
counts; after ``DataBegin`` each block gives ``AOI``, ``POI``, ``Side``, ``Wavelength``, ``ScatterType``, perhaps
``TristimulusValue``, then ``TIS`` and azimuths times radials values. Radial is the polar angle from the normal, azimuth is
absolute, and the light of an isotropic file comes from azimuth 90 degrees whatever its POI. How azimuths run where POI takes
several values was not seen in any reader, so such a file is refused. Blocks of the front
side's reflection are read, others counted and left out. Values are f_r [1/sr]; zeros are data.

References
----------
.. [1] KimuraRyo/libbsdf, src/Reader/LightToolsBsdfReader.cpp.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gonio import files
from gonio.channels import SINGLE, XYZ, ChannelSamples
from gonio.errors import DatasetError

Words = Iterator[tuple[int, str]]
COLOURS = {"trisx": 0, "trisy": 1, "trisz": 2}
MOST_BLOCKS = 20_000
LIGHT_AZIMUTH_DEG = 90.0


def sniff(head: bytes) -> bool:
    """Lists of scatter angles, and no list of angles of incidence."""
    words = {line.split()[0].lower() for line in head.decode("utf-8-sig", "replace").splitlines() if line.split()}
    return {"scatterradial", "scatterazimuth"} <= words and "angleofincidence" not in words


def read(path: Path) -> ChannelSamples:
    """Samples of the front side; `DatasetError` with the line if the file is damaged."""
    words = _words(files.read_lines(path))
    azimuth, radial, colour = _header(path, words)
    channels = XYZ if colour else SINGLE
    cells = len(azimuth) * len(radial)
    if 2 * cells > files.size_of(path):
        raise DatasetError(f"{path}: a block of {cells} values is more than its bytes can hold; it is cut")
    blocks: dict[tuple[float, float], np.ndarray] = {}
    skipped = 0
    for number in range(MOST_BLOCKS + 1):
        found = _block(path, words, cells)
        if found is None:
            break
        if number == MOST_BLOCKS:
            raise DatasetError(f"{path} has more than {MOST_BLOCKS} blocks; split the file")
        aoi, poi, front, k, value = found
        if not front:
            skipped += 1
            continue
        channel = k if colour else 0
        data = blocks.setdefault((aoi, poi), np.full((len(channels), cells), np.nan))
        if not np.all(np.isnan(data[channel])):
            raise DatasetError(f"{path}: two blocks for incidence {aoi:g}, azimuth {poi:g} degrees; the file is damaged")
        data[channel] = value
    if not blocks:
        raise DatasetError(f"{path} holds no block of front-side reflection (BRDF)")
    if len({poi for _, poi in blocks}) > 1:
        raise DatasetError(f"{path} has several POI: which way its azimuths run is not known, so gonio reads one POI only")
    phi_r, theta_r = (a.ravel() for a in np.meshgrid(np.radians(azimuth), np.radians(radial), indexing="ij"))
    up = theta_r < np.pi / 2 - 1e-12
    theta_i = np.repeat(np.radians([key[0] for key in blocks]), np.count_nonzero(up))
    table = np.concatenate([data.T[up] for data in blocks.values()])
    attributes = {
        "quantity": "brdf",
        "source_quantity": "brdf",
        "source_format": "lighttools",
        "n_blocks_left_out": str(skipped),
        "directions": "absolute in the file; light at azimuth 90 degrees",
    }
    n = len(blocks)
    light = np.radians(LIGHT_AZIMUTH_DEG)
    return ChannelSamples.make(
        theta_i, light, np.tile(theta_r[up], n), np.tile(phi_r[up], n), table, channels, None, attributes
    )


def _words(lines: list[str]) -> Words:
    for count, line in enumerate(lines, 1):
        for word in line.partition("#")[0].split():
            yield count, word


def _next(path: Path, words: Words, wanted: str) -> tuple[int, str]:
    found = next(words, None)
    if found is None:
        raise DatasetError(f"{path} ends before {wanted}; the file is cut")
    return found


def _header(path: Path, words: Words) -> tuple[list[float], list[float], bool]:
    lists: dict[str, list[float]] = {}
    colour = False
    for count, word in words:
        keyword, where = word.lower(), f"{path}, line {count}"
        if keyword == "databegin":
            break
        if keyword in ("scatterazimuth", "scatterradial"):
            n = files.whole(_next(path, words, keyword)[1], where, 3600)
            values = [files.number(_next(path, words, keyword)[1], where) for _ in range(n)]
            if any(b <= a for a, b in itertools.pairwise(values)) or values[0] < 0 or values[-1] > 360:
                raise DatasetError(f"{where}: {word} must rise within 0 to 360 degrees; the list is damaged")
            lists[keyword] = values
        elif keyword in ("symmetry", "spectralcontent", "source"):
            value = _next(path, words, keyword)[1].lower()
            if keyword == "spectralcontent":
                if value not in ("monochrome", "xyz"):
                    raise DatasetError(f"{where}: SpectralContent {files.shown(value)}; read are Monochrome and XYZ")
                colour = value == "xyz"
        else:
            raise DatasetError(f"{where}: unknown keyword {files.shown(word)}; a LightTools BSDF header is expected")
    else:
        raise DatasetError(f"{path} ends before DataBegin; the file is cut or is no LightTools BSDF")
    for name in ("scatterazimuth", "scatterradial"):
        if name not in lists:
            raise DatasetError(f"{path}: the data begin, and the list {name} is missing; the file is damaged")
    if lists["scatterradial"][-1] > 180:
        raise DatasetError(f"{path}: ScatterRadial goes to {lists['scatterradial'][-1]:g} degrees; it may reach 180")
    return lists["scatterazimuth"], lists["scatterradial"], colour


def _block(path: Path, words: Words, cells: int) -> tuple[float, float, bool, int, list[float]] | None:
    """Incidence and its azimuth [deg], whether it is front-side reflection, colour, values; None at the end."""
    aoi, poi, side, scatter, colour = -1.0, LIGHT_AZIMUTH_DEG, "front", "brdf", 1
    while True:
        count, word = _next(path, words, "DataEnd")
        keyword, where = word.lower(), f"{path}, line {count}"
        if keyword == "dataend":
            return None
        value = _next(path, words, f"the value of {word}")[1]
        if keyword == "aoi":
            aoi = files.number(value, where)
        elif keyword == "poi":
            poi = files.number(value, where)
        elif keyword == "side":
            side = value.lower()
        elif keyword == "scattertype":
            scatter = value.lower()
        elif keyword == "tristimulusvalue":
            if value.lower() not in COLOURS:
                raise DatasetError(f"{where}: TristimulusValue {files.shown(value)} must be TrisX, TrisY or TrisZ")
            colour = COLOURS[value.lower()]
        elif keyword == "tis":
            files.number(value, where)
            break
        elif keyword != "wavelength":
            raise DatasetError(f"{where}: unknown keyword {files.shown(word)}; a LightTools block is expected")
    if not 0 <= aoi < 90 or abs(poi) > 360:
        raise DatasetError(f"{where}: AOI {aoi:g}, POI {poi:g} degrees; a block needs 0 <= AOI < 90 and POI within a turn")
    values = []
    for _ in range(cells):
        count, word = _next(path, words, f"the {cells} values of a block")
        values.append(files.number(word, f"{path}, line {count}"))
        if values[-1] < 0:
            raise DatasetError(f"{path}, line {count}: a value of {values[-1]:g} is negative; a BRDF has none")
    return aoi, poi, side == "front" and scatter == "brdf", colour, values
