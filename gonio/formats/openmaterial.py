"""ASAM OpenMATERIAL 3D BRDF look-up table (``.xompt``), JSON; read only.

``brdf.lookupTable`` has rows wavelength [m], theta_i, theta_r, phi_r - phi_i [rad], f_r [1/sr]; a null value is missing.
Isotropic. The standard states f_r; files with values of 1e-5 exist whose quantity is doubtful, so state another with
``--quantity`` if you know it.

References
----------
.. [1] ASAM OpenMATERIAL 3D, schemas/material_brdf_schema.json.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gonio.channels import ChannelSamples, spectral
from gonio.errors import DatasetError
from gonio.formats import json_text, rows


def sniff(head: bytes) -> bool:
    """A JSON object with a look-up table, or the metadata that announce one."""
    start = head.lstrip(b"\xef\xbb\xbf \t\r\n")
    return start[:1] == b"{" and (b'"lookupTable"' in head or b'"materialVersion"' in head)


def read(path: Path) -> ChannelSamples:
    """Samples of all wavelengths; `DatasetError` if the file is damaged."""
    document = json_text.read(path)
    table = json_text.member(path, json_text.member(path, document, "brdf", dict), "lookupTable", list)
    missing, good = 0, []
    for k, row in enumerate(table):
        if not isinstance(row, list) or len(row) != 5:
            raise DatasetError(f"{path}: row {k} of lookupTable must be 5 numbers; the file is damaged")
        if row[4] is None:
            missing += 1
        else:
            good += row
    if not good:
        raise DatasetError(f"{path}: lookupTable holds no value; the file is empty")
    data = json_text.numbers(path, good, "lookupTable").reshape(-1, 5)
    if np.any(data[:, 4] < 0):
        raise DatasetError(f"{path}: a value of {data[:, 4].min():g} in lookupTable is negative; a BRDF has none")
    outside = (np.abs(data[:, 1:3]) > np.pi).any(axis=1) | (np.abs(data[:, 3]) > 4 * np.pi)
    if np.any(outside):
        raise DatasetError(
            f"{path}: row {int(np.argmax(outside))} of lookupTable has an angle beyond half a turn; give radians"
        )
    waves, key = np.unique(data[:, 0], return_inverse=True)
    if len(waves) > 2000:
        raise DatasetError(f"{path}: {len(waves)} different wavelengths, at most 2000 are read; thin the file")
    with np.errstate(over="ignore"):  # an absurd one becomes infinite, which is refused
        channels = spectral(np.round(waves * 1e9, 6), str(path))
    flip = data[:, 2] < 0  # a negative polar angle is on the other side
    data[:, 3] = np.where(flip, data[:, 3] + np.pi, data[:, 3])
    data[:, 1:3] = np.abs(data[:, 1:3])
    keep = np.all(data[:, 1:3] < np.pi / 2, axis=1)
    if not np.any(keep):
        raise DatasetError(f"{path} holds no sample above the horizon")
    pairs, index = np.unique(data[keep, 1:4], axis=0, return_inverse=True)
    rows.check_size(path, len(pairs), len(waves))
    value = np.full((len(pairs), len(waves)), np.nan)
    value[index.ravel(), key.ravel()[keep]] = data[keep, 4]
    attributes = {
        "quantity": "brdf",
        "source_quantity": "brdf (the standard says so)",
        "source_format": "openmaterial",
        "n_missing": str(missing),
        "n_below_horizon": str(int(np.count_nonzero(~keep))),
    }
    metadata = document.get("metadata")
    if isinstance(metadata, dict) and isinstance(metadata.get("name"), str):
        attributes["material"] = rows.one_line(metadata["name"], 200)
    return ChannelSamples.make(pairs[:, 0], 0.0, pairs[:, 1], pairs[:, 2], value, channels, attributes=attributes)
