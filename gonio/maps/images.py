"""Height maps from files and rendered images to files: NPY and floating-point TIFF.

Row j, column i of a file are row j, column i of the array; what y that is, the spacing says (`gonio.maps.surface`).
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gonio.errors import DatasetError
from gonio.files import LARGEST_BINARY, replace_atomically, size_of

Array = NDArray[np.float64]
_TIFF = (".tif", ".tiff")


def read_heights(path: str | os.PathLike[str]) -> Array:
    """Heights of an ``.npy`` or ``.tif`` file.

    Returns
    -------
    ndarray, shape (m, n)
        In the unit of the file; integers as they are; NaN where there is no surface.

    Raises
    ------
    DatasetError
        If the file is missing, of another kind or damaged, or holds no array of two dimensions.
    """
    file = Path(path)
    size_of(file, LARGEST_BINARY)
    if file.suffix.lower() == ".npy":
        try:
            image = np.load(file, allow_pickle=False)
        except (OSError, ValueError, EOFError) as exc:
            raise DatasetError(f"{file} is no NPY file of numbers ({exc}); write it with numpy.save") from exc
    elif file.suffix.lower() in _TIFF:
        import cv2

        data = np.fromfile(file, dtype=np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
        if image is None:
            raise DatasetError(f"{file} is no TIFF file that can be read; save it as one plane of 32-bit floats")
    else:
        raise DatasetError(f"{file}: {file.suffix or 'no suffix'} is not known; give heights as .npy, .tif or .tiff")
    if image.ndim != 2 or image.dtype.kind not in "iuf":
        raise DatasetError(f"{file} holds {image.dtype} of shape {image.shape}; heights are one plane of numbers")
    return np.asarray(image, dtype=float)


def write_image(path: str | os.PathLike[str], value: Array) -> Path:
    """Write radiances, shape (m, n), as 64-bit NPY or 32-bit TIFF; the file appears whole or not at all.

    Raises
    ------
    DatasetError
        If the suffix is another one, or the file cannot be written.
    """
    file = Path(path)
    if file.suffix.lower() == ".npy":

        def write(temporary: Path) -> None:
            with temporary.open("wb") as stream:
                np.save(stream, value, allow_pickle=False)

    elif file.suffix.lower() in _TIFF:
        import cv2

        done, data = cv2.imencode(".tiff", value.astype(np.float32))
        if not done:
            raise DatasetError(f"{file}: an image of shape {value.shape} cannot be written as TIFF; write .npy")

        def write(temporary: Path) -> None:
            temporary.write_bytes(data.tobytes())

    else:
        raise DatasetError(f"{file}: {file.suffix or 'no suffix'} is not known; write .npy, .tif or .tiff")
    replace_atomically(file, write)
    return file
