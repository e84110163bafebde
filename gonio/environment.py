"""Environment maps from image files: Radiance HDR, floating-point TIFF, NPY, and OpenEXR where its package is installed.

Row 0 is next to the viewer's axis (theta = 0), column 0 next to phi = 0. Images for display (8 or 16 bit integers) are
refused, as their values are no radiance; so are pickled arrays, and EXR files of several parts.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gonio.errors import DatasetError, ParameterError
from gonio.fields import MAX_PIXELS

Array = NDArray[np.float64]
MAX_BYTES = 1 << 31
CHANNELS = ("luminance", "red", "green", "blue")
_LUMINANCE = (0.2126, 0.7152, 0.0722)  # ITU-R BT.709-6, item 3.2


def read(path: str | os.PathLike[str], channel: str = "luminance") -> Array:
    """Radiance of an image file.

    Parameters
    ----------
    path : path
        ``.hdr``, ``.pic``, ``.tif``, ``.tiff``, ``.npy`` or, with the extra ``exr``, ``.exr``.
    channel : {"luminance", "red", "green", "blue"}
        What a colour image gives: 0.2126 R + 0.7152 G + 0.0722 B, or one colour.

    Returns
    -------
    ndarray, shape (n_theta, n_phi)
        In the unit of the file.

    Raises
    ------
    DatasetError
        If the file is missing, of another kind, too large or damaged.
    """
    if channel not in CHANNELS:
        raise ParameterError(f"environment_map: channel = {channel!r}; choose one of: {', '.join(CHANNELS)}")
    file = Path(path)
    if not file.is_file():
        raise DatasetError(f"{file}: there is no such file; give the path of an HDR, floating-point TIFF or NPY file")
    size = file.stat().st_size
    if size > MAX_BYTES:
        raise DatasetError(f"{file} has {size} bytes; environment maps of at most {MAX_BYTES} bytes are read: scale it down")
    suffix = file.suffix.lower()
    if suffix == ".npy":
        image = _npy(file)
    elif suffix in (".hdr", ".pic", ".tif", ".tiff"):
        image = _image(file)
    elif suffix == ".exr":
        image = _exr(file)
    else:
        raise DatasetError(f"{file}: {suffix or 'no suffix'} is not known; give .hdr, .tif, .tiff, .npy or .exr")
    _check_shape(file, image.shape)
    if image.ndim == 3 and image.shape[2] >= 3:
        colours = image[..., :3].astype(float)
        return np.ascontiguousarray(colours @ np.array(_LUMINANCE) if channel == "luminance" else
                                    colours[..., CHANNELS.index(channel) - 1])  # fmt: skip
    return np.ascontiguousarray(image.reshape(image.shape[:2]), dtype=float)


def _check_shape(file: Path, shape: tuple[int, ...]) -> None:
    flat = len(shape) == 2 or (len(shape) == 3 and shape[2] in (1, 3, 4))
    if not flat or 0 in shape or shape[0] * shape[1] > MAX_PIXELS:
        raise DatasetError(
            f"{file} has shape {shape}; an environment map is (n_theta, n_phi), or with 1, 3 or 4 channels, and has at most "
            f"{MAX_PIXELS} pixels"
        )


def _npy(file: Path) -> NDArray[np.generic]:
    try:
        mapped = np.load(file, mmap_mode="r", allow_pickle=False)  # the header only, so that sizes are known before bytes
    except (OSError, ValueError, EOFError) as exc:
        raise DatasetError(f"{file} is no readable NPY file ({exc}); write it with numpy.save, without objects") from exc
    if not isinstance(mapped, np.ndarray) or mapped.dtype.kind not in "fiu":
        raise DatasetError(f"{file} does not hold real numbers; write a float array with numpy.save")
    _check_shape(file, mapped.shape)
    return np.array(mapped)


def _image(file: Path) -> NDArray[np.generic]:
    import cv2

    try:
        image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    except cv2.error as exc:
        raise DatasetError(f"{file} is damaged or too large to be read ({exc.err})") from exc
    if image is None:
        raise DatasetError(f"{file} is no image that can be read; save it as Radiance HDR or floating-point TIFF")
    if image.dtype.kind != "f":
        raise DatasetError(
            f"{file} holds {image.dtype} numbers, made for a display; radiance needs floating point: save as HDR"
        )
    if image.ndim == 3 and image.shape[2] >= 3:
        image = image[..., 2::-1]  # OpenCV's order is blue, green, red
    return np.asarray(image)


def _exr(file: Path) -> NDArray[np.generic]:
    """R, G, B, or the luminance Y, or the only channel there is."""
    try:
        import OpenEXR
    except ImportError:
        raise DatasetError(
            f"{file}: reading OpenEXR needs the package OpenEXR (gonio's extra exr): pip install OpenEXR, or save the image "
            "as Radiance HDR, floating-point TIFF or NPY"
        ) from None
    try:
        window = OpenEXR.File(str(file), header_only=True).header()["dataWindow"]  # sizes are known before pixels
        width, height = (int(b) - int(a) + 1 for a, b in zip(*window, strict=True))
        _check_shape(file, (height, width))
        channels = OpenEXR.File(str(file), separate_channels=True).channels()
        planes = {str(name): np.asarray(channel.pixels) for name, channel in channels.items()}
    except DatasetError:
        raise
    except Exception as exc:
        raise DatasetError(f"{file} is no OpenEXR image that can be read ({str(exc)[:150]}); save it again") from exc
    if {"R", "G", "B"} <= planes.keys():
        chosen = [planes[name] for name in "RGB"]
    elif "Y" in planes or len(planes) == 1:
        chosen = [planes["Y"] if "Y" in planes else next(iter(planes.values()))]
    else:
        raise DatasetError(
            f"{file} has the channels {', '.join(planes) or 'none'}; radiance is R, G, B, or Y, or one channel"
        )
    if any(plane.shape != (height, width) or plane.dtype.kind != "f" for plane in chosen):
        raise DatasetError(f"{file} has subsampled channels or integers; save it with floating-point R, G, B in full size")
    return np.stack(chosen, axis=-1)
