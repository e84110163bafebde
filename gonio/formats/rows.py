"""Rows of numbers as text, there and back: what the row formats (ASTM, ALTA, Cornell) have in common."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gonio import files
from gonio.channels import Channels, ChannelSamples
from gonio.errors import DatasetError

Array = NDArray[np.float64]
MOST = 20_000_000  # values of a table of directions and channels


def parse(path: Path, lines: Iterable[tuple[int, Sequence[str]]], columns: int) -> tuple[Array, list[int]]:
    """Rows (n, columns) of words, each with the number of its line; `DatasetError` with the line of a bad one."""
    rows: list[list[float]] = []
    at: list[int] = []
    for count, words in lines:
        if len(words) != columns:
            raise DatasetError(
                f"{path}, line {count}: {len(words)} numbers, a row of this file has {columns}; correct the line"
            )
        rows.append(files.numbers(words, f"{path}, line {count}"))
        at.append(count)
    if not rows:
        raise DatasetError(f"{path} holds no row of data; the file is cut")
    return np.array(rows), at


def samples(
    path: Path, angles: Array, value: Array, channels: Channels, attributes: dict[str, str], at: Sequence[int]
) -> ChannelSamples:
    """Samples of rows theta_i, phi_i, theta_r, phi_r [rad] (n, 4), without and counting those below the horizon."""
    polar = angles[:, [0, 2]]
    outside = np.any((polar < 0) | (polar > np.pi), axis=1) | np.any(np.abs(angles[:, [1, 3]]) > 4 * np.pi, axis=1)
    if np.any(outside):
        line = at[int(np.flatnonzero(outside)[0])]
        raise DatasetError(f"{path}, line {line}: an angle is beyond half a turn; angles must be in radians")
    keep = np.all(polar < np.pi / 2, axis=1)
    if not np.any(keep):
        raise DatasetError(f"{path} holds no sample above the horizon")
    attributes = {**attributes, "quantity": "brdf", "n_below_horizon": str(int(np.count_nonzero(~keep)))}
    theta_i, phi_i, theta_r, phi_r = angles[keep].T
    return ChannelSamples.make(theta_i, phi_i, theta_r, phi_r, value[keep], channels, attributes=attributes)


def complete(path: Path, found: ChannelSamples, kind: str) -> None:
    """Refuse samples with a missing value in one channel, which rows of plain numbers cannot say."""
    holes = int(np.count_nonzero(~np.isfinite(found.f_r).all(axis=1)))
    if holes:
        raise DatasetError(f"{path}: {holes} directions miss a channel, and {kind} has no mark for that; export one channel")


def text(found: ChannelSamples, separator: str) -> str:
    """Lines theta_i, phi_i, theta_r, phi_r [rad] and the values, digits enough to come back bit for bit."""
    table = np.concatenate((np.stack((found.theta_i, found.phi_i, found.theta_r, found.phi_r), axis=-1), found.f_r), axis=1)
    return "".join(separator.join(map(repr, row)) + "\n" for row in table.tolist())


def check_size(path: Path, pairs: int, channels: int) -> None:
    """Refuse rows whose directions differ from wavelength to wavelength so much that a table of both fills the memory."""
    if pairs * channels > MOST:
        raise DatasetError(
            f"{path}: {pairs} directions times {channels} wavelengths are more than {MOST} values, as most directions have "
            "few wavelengths; split the file by wavelength"
        )


def one_line(text: object, most: int = 500) -> str:
    """Foreign text for a header: one line, printable."""
    return "".join(c if c.isprintable() else " " for c in str(text))[:most]


def put(path: Path, content: str | bytes) -> None:
    """Write a whole file or nothing."""
    data = content.encode() if isinstance(content, str) else content
    files.replace_atomically(path, lambda temporary: temporary.write_bytes(data))
