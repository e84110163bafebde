"""UTIA ``.bin``: an anisotropic RGB BRDF on 6 x 48 incident and 6 x 48 reflected directions; read only.

No header: little-endian float64 ``[3][288 incident][288 reflected]``, direction number = 48 (theta / 15 deg) + phi / 7.5 deg
with theta up to 75 and phi up to 352.5 degrees. Values are sRGB-encoded f_r / 100: each is decoded by the sRGB transfer
function and multiplied by 100. The file is known by its size and by its values alone.

References
----------
.. [1] J. Filip, R. Vavra, "Template-Based Sampling of Anisotropic BRDFs", Computer Graphics Forum 33(7), 2014; the decoding
   is that of jdupuy/dj_brdf, dj_brdf.h.
.. [2] IEC 61966-2-1, 1999 (sRGB).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gonio import files
from gonio.channels import RGB, ChannelSamples
from gonio.errors import DatasetError

SIDE = 288
SIZE = 3 * SIDE * SIDE * 8
LARGEST = 1e3  # sRGB-encoded; no reflectance is larger


def sniff(head: bytes, size: int) -> bool:
    """The size fits, and the values are such as f_r / 100 has."""
    if size != SIZE:
        return False
    values = np.frombuffer(head[: len(head) // 8 * 8], dtype="<f8")
    return bool(np.all(np.isfinite(values)) and np.all(np.abs(values) <= LARGEST) and np.any(values > 1e-9))


def read(path: Path) -> ChannelSamples:
    """82 944 samples in RGB; negative values count as missing."""
    size = files.size_of(path)
    if size != SIZE:
        raise DatasetError(f"{path} has {size} bytes, a UTIA file has {SIZE}; it is cut or of another kind")
    data = np.frombuffer(files.read_bytes(path), dtype="<f8").astype(float)
    bad = ~np.isfinite(data) | (np.abs(data) > LARGEST)
    if np.any(bad):
        at = int(np.argmax(bad))
        raise DatasetError(f"{path}: value {at} of {data.size} ({data[at]:g}) is no sRGB-encoded reflectance; it is damaged")
    encoded = data.reshape(3, SIDE * SIDE).T
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((np.maximum(encoded, 0.0) + 0.055) / 1.055) ** 2.4)
    missing = encoded < 0
    value = np.where(missing, np.nan, 100.0 * linear)
    number = np.arange(SIDE)
    theta, phi = np.radians(15.0 * (number // 48)), np.radians(7.5 * (number % 48))
    i, r = np.divmod(np.arange(SIDE * SIDE), SIDE)
    attributes = {
        "quantity": "brdf",
        "source_quantity": "brdf, sRGB-encoded f_r / 100",
        "source_format": "utia",
        "n_missing": str(int(np.count_nonzero(missing))),
        "anisotropic": "yes",
    }
    return ChannelSamples.make(theta[i], phi[i], theta[r], phi[r], value, RGB, attributes=attributes)
