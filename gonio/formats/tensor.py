"""The tensor file: named arrays in one binary container, as Mitsuba and RGL keep measured BRDFs.

Little-endian: ``"tensor_file\\0"``, bytes 1 and 0, ``uint32`` count; for each field ``uint16`` length and name, ``uint16``
dimensions, ``uint8`` type, ``uint64`` offset, ``uint64`` sizes; then the data, C order, aligned to 8.

References
----------
.. [1] mitsuba-renderer/mitsuba3, src/core/tensor.cpp.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gonio import files
from gonio.errors import DatasetError

MAGIC = b"tensor_file\0"
TYPES = {1: "u1", 2: "i1", 3: "<u2", 4: "<i2", 5: "<u4", 6: "<i4", 7: "<u8", 8: "<i8", 9: "<f2", 10: "<f4", 11: "<f8"}
MOST_FIELDS = 64
MOST_DIMENSIONS = 8
Fields = dict[str, NDArray[np.generic]]


def read(path: Path) -> Fields:
    """All fields; sizes and offsets are checked against the file before memory is taken."""
    data = files.read_bytes(path)
    if data[:12] != MAGIC:
        raise DatasetError(f"{path} does not begin as a tensor file does; it is of another kind")
    if data[12:14] != b"\1\0":
        raise DatasetError(f"{path} is a tensor file of version {list(data[12:14])}, gonio reads 1.0")
    at = 14
    fields: Fields = {}

    def take(form: str) -> tuple[int, ...]:
        nonlocal at
        size = struct.calcsize(form)
        if at + size > len(data):
            raise DatasetError(f"{path} ends within its table of fields; the file is cut")
        found = struct.unpack_from(form, data, at)
        at += size
        return found

    (count,) = take("<I")
    if not 1 <= count <= MOST_FIELDS:
        raise DatasetError(f"{path} announces {count} fields, a measured BRDF has 1 to {MOST_FIELDS}; the file is damaged")
    for _ in range(count):
        (length,) = take("<H")
        if length > 256 or at + length > len(data):
            raise DatasetError(f"{path}: a field's name of {length} bytes; the file is damaged")
        name = data[at : at + length].decode("utf-8", "replace")
        at += length
        dimensions, kind = take("<HB")
        shown = files.shown(name)
        if kind not in TYPES or dimensions > MOST_DIMENSIONS:
            raise DatasetError(f"{path}: field {shown} has type {kind} and {dimensions} dimensions; the file is damaged")
        (offset,) = take("<Q")
        shape = take(f"<{dimensions}Q")
        dtype = np.dtype(TYPES[kind])
        n = math.prod(shape)
        if offset + n * dtype.itemsize > len(data):
            raise DatasetError(f"{path}: field {shown} of {n} values at {offset} is beyond the file's {len(data)} bytes")
        if name in fields:
            raise DatasetError(f"{path}: field {shown} stands twice; the file is damaged")
        # an empty field may announce any other sizes, more than numpy can hold
        fields[name] = np.frombuffer(data, dtype=dtype, count=n, offset=offset).reshape(shape if n else (0,))
    return fields


def pack(fields: Mapping[str, NDArray[np.generic]]) -> bytes:
    """The bytes of a tensor file."""
    kinds = {np.dtype(name): kind for kind, name in TYPES.items()}
    head = MAGIC + b"\1\0" + struct.pack("<I", len(fields))
    size = len(head) + sum(2 + len(n.encode()) + 2 + 1 + 8 + 8 * a.ndim for n, a in fields.items())
    body = b""
    table = b""
    for name, array in fields.items():
        body += b"\0" * (-(size + len(body)) % 8)
        label = name.encode()
        table += (
            struct.pack("<H", len(label)) + label + struct.pack("<HBQ", array.ndim, kinds[array.dtype], size + len(body))
        )
        table += struct.pack(f"<{array.ndim}Q", *array.shape)
        body += np.ascontiguousarray(array).tobytes()
    return head + table + body
