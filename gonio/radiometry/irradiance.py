"""Radiance of a surface to irradiance of its image: why the counts of a pixel measure radiance.

The factor is the same for every pose of a fixed camera, so it cancels against the white reference; it is here for the
absolute scale and as a check of orders of magnitude.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gonio.errors import GeometryError, ParameterError


def image_irradiance(radiance: ArrayLike, diameter: float, distance: float, alpha: ArrayLike = 0.0) -> NDArray[np.float64]:
    r"""Irradiance of the image of a surface of given radiance.

    Parameters
    ----------
    radiance : array_like, shapes broadcast to (...)
        Radiance of the surface towards the lens [W m^-2 sr^-1].
    diameter : float
        Diameter d of the entrance pupil.
    distance : float
        Distance f_p from the lens to the image plane, in the unit of `diameter`; the focal length for a far object.
    alpha : array_like
        Angle off the optical axis [rad], ``0 <= alpha < pi/2``.

    Returns
    -------
    ndarray, shape (...)
        E_p [W m^-2].

    Raises
    ------
    ParameterError
        If a length is not positive.
    GeometryError
        If alpha is outside its range.

    Notes
    -----
    .. math:: E_p = L_r\,\frac{\pi}{4}\Bigl(\frac{d}{f_p}\Bigr)^2\cos^4\alpha

    for a lens that is small against the distances, without vignetting or loss [1]_, section 9.

    References
    ----------
    .. [1] B. K. P. Horn, R. W. Sjoberg, "Calculating the Reflectance Map", MIT AI Memo 498, 1978.

    Examples
    --------
    >>> round(float(image_irradiance(1.0, 1.0, 8.0)), 6) == round(np.pi / 256, 6)
    True
    """
    if not (diameter > 0.0 and distance > 0.0):
        raise ParameterError(f"a lens of diameter {diameter:g} at the distance {distance:g} makes no image: give both > 0")
    angle = np.asarray(alpha, dtype=float)
    if np.any(~((angle >= 0.0) & (angle < np.pi / 2))):
        raise GeometryError(f"alpha = {np.degrees(np.max(angle)):g} degrees: give 0 <= alpha < 90 degrees")
    return np.asarray(np.asarray(radiance, dtype=float) * (np.pi / 4) * (diameter / distance) ** 2 * np.cos(angle) ** 4)
