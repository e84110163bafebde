"""Frames on disk: one lossless ``.npy`` stack of uint16 counts for each pose or block, complete or not there at all.

Written to a temporary name, fsynced, renamed, and the folder fsynced, all before the journal's row commits; so a row
never points to a file that a power cut could take back. Any program that reads ``.npy`` reads them. Nothing is pickled.
"""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gonio.errors import DatasetError

TEMPORARY = ".part"


def write_stack(path: Path, images: Sequence[NDArray[np.uint16]]) -> str:
    """Write images of one shape as a stack of shape (n, height, width); returns the file's SHA-256.

    Raises
    ------
    DatasetError
        If the images differ in shape or are not uint16, or the disk refuses.
    """
    shapes = {image.shape for image in images}
    if len(shapes) != 1 or any(image.dtype != np.uint16 or image.ndim != 2 for image in images):
        raise DatasetError(f"{path.name}: frames must be uint16 images of one shape, these are {sorted(shapes)}")
    buffer = io.BytesIO()
    np.save(buffer, np.stack(images), allow_pickle=False)
    content = buffer.getvalue()
    write_durably(path, content)
    return hashlib.sha256(content).hexdigest()


def read_stack(path: Path, sha256: str) -> NDArray[np.uint16]:
    """Read a stack back, shape (n, height, width), after checking it against its hash.

    Raises
    ------
    DatasetError
        If the file is missing or is not the one that was written.
    """
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise DatasetError(f"{path} is missing; the run's journal needs it, restore it from a copy") from None
    except OSError as error:
        raise DatasetError(f"{path} cannot be read: {error.strerror}; check the disk") from error
    found = hashlib.sha256(content).hexdigest()
    if found != sha256:
        raise DatasetError(
            f"{path} was changed: its SHA-256 begins {found[:12]}, the journal has {sha256[:12]}; restore it from a copy"
        )
    stack: NDArray[np.uint16] = np.load(io.BytesIO(content), allow_pickle=False)
    return stack


def write_durably(path: Path, content: bytes) -> None:
    """Write a file so that it is there in full after a power cut, or not at all.

    Raises
    ------
    DatasetError
        If the disk refuses.
    """
    temporary = path.with_name(path.name + TEMPORARY)
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
        sync_folder(path.parent)
    except OSError as error:
        raise DatasetError(f"{path} cannot be written: {error.strerror or error}; free space or check the disk") from error


def sync_folder(folder: Path) -> None:
    """Make a rename in a folder durable, where the system can (POSIX)."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
