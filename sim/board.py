"""The ChArUco board that can lie on the stage, as reflectance over a rectangle."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

DICTIONARY = "DICT_5X5_100"
MARKER = 0.75  # side of a marker over side of a square


def charuco(columns: int, rows: int, square_mm: float = 1.0) -> Any:
    """The board as OpenCV's detectors want it."""
    import cv2

    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARY))
    return cv2.aruco.CharucoBoard((columns, rows), square_mm, MARKER * square_mm, dictionary)


def texture(columns: int, rows: int, dark: float, square_mm: float, pixel_mm: float) -> NDArray[np.float64]:
    """Reflectance relative to the white squares, as pixels of side `pixel_mm` on the board mix it.

    Parameters
    ----------
    columns, rows : int
        Squares.
    dark : float
        Of the ink.
    square_mm, pixel_mm : float
        Sides of a square, and of a camera's pixel seen at the board.

    Returns
    -------
    ndarray, shape (rows, columns) times texels per square
        At least four texels to a pixel.
    """
    import cv2

    texels = min(max(math.ceil(4.0 * square_mm / pixel_mm), 40), 200)
    image = charuco(columns, rows).generateImage((columns * texels, rows * texels), marginSize=0)
    sharp = np.where(np.asarray(image) > 127, 1.0, dark)
    width = 2 * round(0.5 * pixel_mm * texels / square_mm) + 1  # odd, or it would shift
    return np.asarray(cv2.blur(sharp, (width, width), borderType=cv2.BORDER_REPLICATE), dtype=float)
