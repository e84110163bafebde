"""HDF5 files from outside, opened by a child process with limits of memory and time; arrays come back, never objects."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gonio import files
from gonio.errors import DatasetError

SIGNATURE = b"\x89HDF\r\n\x1a\n"
SECONDS = 20
CHILD = Path(__file__).with_name("hdf5_child.py")


@dataclass(frozen=True)
class Contents:
    """What a file holds at its root.

    Attributes
    ----------
    arrays : mapping of str to ndarray
    texts : mapping of str to list of str
    others : mapping of str to str
        Type of the variables that are neither.
    attributes : mapping of str to mapping
        Texts of each variable; those of the file under ``""``.
    """

    arrays: Mapping[str, np.ndarray]
    texts: Mapping[str, list[str]]
    others: Mapping[str, str]
    attributes: Mapping[str, Mapping[str, str]]


def read(path: Path) -> Contents:
    """All root variables of the file, or a `DatasetError`.

    Declared sizes may not exceed the file's by more than 64 MiB, so that no compressed file unfolds into the memory.
    """
    size = files.size_of(path)
    if files.head(path, 8) != SIGNATURE:
        raise DatasetError(f"{path} is no NetCDF-4 file: the HDF5 signature is missing")
    limit = size + 64 * 2**20
    memory = 2**29 + 4 * limit
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(CHILD), str(path.resolve()), str(limit), str(memory), str(SECONDS)]
    try:
        done = subprocess.run(command, capture_output=True, timeout=2 * SECONDS, env=environment, check=False)
    except subprocess.TimeoutExpired:
        raise DatasetError(f"{path} keeps the HDF5 library busy for more than {2 * SECONDS} s; it is damaged") from None
    except OSError as error:
        raise DatasetError(f"{path}: no process can be started to open it ({error.strerror}); free some memory") from error
    header, data = _header(path, done.stdout)
    if "refused" in header:
        raise DatasetError(f"{path}: {files.shown(header['refused'], 200)[1:-1]}")
    if "damaged" in header:
        raise DatasetError(f"{path} is a damaged NetCDF-4 file ({files.shown(header['damaged'], 220)}); make it again")
    arrays, texts, others, attributes = {}, {}, {}, {"": header["attributes"]}
    at = 0
    for name, variable in header["variables"].items():
        attributes[name] = variable["attributes"]
        if "texts" in variable:
            texts[name] = variable["texts"]
        elif "kind" in variable:
            others[name] = variable["kind"]
        else:
            dtype, count = np.dtype(variable["dtype"]), math.prod(variable["shape"])
            arrays[name] = np.frombuffer(data, dtype, count, at).reshape(variable["shape"]).copy()
            at += count * dtype.itemsize
    return Contents(arrays, texts, others, attributes)


def _header(path: Path, out: bytes) -> tuple[dict[str, Any], memoryview]:
    size = int.from_bytes(out[:8], "little")
    if len(out) < 8 or len(out) < 8 + size:
        raise DatasetError(f"{path} makes the HDF5 library crash or take too much memory; it is damaged: make it again")
    return json.loads(out[8 : 8 + size]), memoryview(out)[8 + size :]
