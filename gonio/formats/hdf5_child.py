"""A process of its own that opens an HDF5 file under limits and hands its arrays out; run by `gonio.formats.hdf5`.

The HDF5 library parses foreign bytes in C: a damaged file may make it loop, take memory without end or crash. Here that
ends one child, not the user's session. It imports nothing of gonio. Standard output: eight bytes length, a JSON header,
then the arrays. Refused are links to other files, virtual and external storage, and more bytes than the caller allows.
"""

from __future__ import annotations

import json
import math
import sys
from typing import Any

MOST_VARIABLES = 200
MOST_TEXTS = 1000


class Refused(Exception):
    """What is wrong, as the end of a sentence."""


def main(path: str, limit: int, memory: int, seconds: int) -> None:
    """Write the root variables of the file to standard output, or an error in the header."""
    try:
        import resource

        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    except ImportError:  # not on this system: the caller's time limit stays
        pass
    header: dict[str, Any] = {}
    blobs: list[bytes] = []
    try:
        header, blobs = _read(path, limit)
    except Refused as error:
        header = {"refused": str(error)}
    except Exception as error:  # noqa: BLE001  whatever the library raises on a damaged file
        header = {"damaged": f"{type(error).__name__}: {error}"}
    text = json.dumps(header).encode()
    out = sys.stdout.buffer
    out.write(len(text).to_bytes(8, "little") + text)
    for blob in blobs:
        out.write(blob)
    out.flush()


def _read(path: str, limit: int) -> tuple[dict[str, Any], list[bytes]]:
    import h5py
    import numpy as np

    variables, blobs, left = {}, [], limit
    with h5py.File(path, "r") as file:
        if len(file) > MOST_VARIABLES:
            raise Refused(f"{len(file)} variables, at most {MOST_VARIABLES} are read")
        for name in file:
            if not isinstance(file.get(name, getlink=True), h5py.HardLink):
                raise Refused(f"{name} is a link to another file, which is refused; copy the data into one file")
            data = file[name]
            if not isinstance(data, h5py.Dataset):
                continue
            if data.is_virtual or data.external:
                raise Refused(f"{name} is not stored in this file; copy the data into one file")
            kind = data.dtype.kind
            declared = math.prod(int(n) for n in data.shape) * max(data.dtype.itemsize, 1)
            if kind == "O" and h5py.check_string_dtype(data.dtype) is not None:
                if data.ndim != 1 or data.shape[0] > MOST_TEXTS:
                    raise Refused(f"{name} is no list of names")
                texts = [t.decode("utf-8", "replace") if isinstance(t, bytes) else str(t) for t in data[()]]
                variables[name] = {"texts": texts, "attributes": _attributes(data)}
                continue
            if kind not in "fiu":
                variables[name] = {"kind": str(data.dtype), "attributes": {}}
                continue
            left -= declared
            if left < 0:
                raise Refused(f"{name} declares {declared} bytes, which the file of that size does not hold")
            array = np.ascontiguousarray(data[()])
            array = array.astype(array.dtype.newbyteorder("<"))
            blobs.append(array.tobytes())
            variables[name] = {"dtype": array.dtype.str, "shape": list(array.shape), "attributes": _attributes(data)}
        root = _attributes(file)
    return {"variables": variables, "attributes": root}, blobs


def _attributes(item: Any) -> dict[str, str]:
    """The texts among the attributes."""
    found = {}
    for name in item.attrs:
        try:
            value = item.attrs[name]
        except (OSError, TypeError):  # references that only the library understands
            continue
        if isinstance(value, str | bytes):
            found[str(name)] = value.decode("utf-8", "replace") if isinstance(value, bytes) else value
    return found


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))
