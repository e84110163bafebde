"""The sensor behind the lens: from radiance to counts, with everything that a camera adds.

Order: fall-off (cos^4 and vignetting), point spread, veiling glare, colour filters and pixel gains (PRNU), then exposure
with dark current, shot and read noise, gain and black level, and last the converter, linear or with a gamma curve.
Frames whose mean is above 30 electrons have normal shot noise, fainter pixels Poisson's. Not modelled: blooming, defective
pixels, non-linearity short of saturation, temperature.

References
----------
EMVA Standard 1288, release 4.0, section 2: linear camera model (photon noise, read noise, gain, quantisation, PRNU).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from sim.settings import Sensor
from sim.truth import generator

Array = NDArray[np.float64]
_FEW = 30.0  # electrons: above, a normal shot noise lacks less than a fifth in its skew
_MOST = 1e9
COLOURS = "RGB"


class Chip:
    """A sensor with its fixed patterns.

    Parameters
    ----------
    sensor : Sensor
    seed : int
        Of its pixel gains.

    Attributes
    ----------
    rays : ndarray, shape (height * width, 3)
        Unit vectors into which the pixels look from `eye` [mm].
    shape : tuple of int
        (height, width).
    gamma : float
        Of the converter's curve; 0 for a linear one.
    """

    def __init__(self, sensor: Sensor, seed: int) -> None:
        self.sensor = sensor
        self.gamma = sensor.gamma if sensor.response == "gamma" else 0.0
        # Pixel (row, column) looks at this place in the plane z = 0: x to the right, y up.
        x = (np.arange(sensor.width) - 0.5 * (sensor.width - 1)) * sensor.pixel_mm
        y = (0.5 * (sensor.height - 1) - np.arange(sensor.height)) * sensor.pixel_mm
        rays = np.empty((sensor.height, sensor.width, 3))
        rays[..., 0], rays[..., 1], rays[..., 2] = x, y[:, None], -sensor.distance_mm
        length = np.sqrt(np.einsum("ijk,ijk->ij", rays, rays))
        self.rays: Array = (rays / length[..., None]).reshape(-1, 3)
        self.eye = np.array([0.0, 0.0, sensor.distance_mm])
        # Image irradiance falls off with cos^4 of the field angle (Horn and Sjoberg, 1979, section 9).
        fall_off = (sensor.distance_mm / length) ** 4
        corner = float(np.hypot(x[0], y[0]))
        fall_off *= 1.0 - sensor.vignetting * (np.hypot(x, y[:, None]) / corner) ** 2
        self._fall_off = sensor.responsivity * fall_off
        self.shape = shape = (sensor.height, sensor.width)
        self._gains = np.ones(shape)
        if sensor.prnu > 0.0:
            self._gains += sensor.prnu * generator(seed, "prnu").standard_normal(shape)
        self._mean = np.empty(shape)
        self._normal = np.empty(sensor.height * sensor.width, np.float32)

    def electrons(self, radiance: Array, colour: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Array:
        """Electrons per second of each pixel, without dark current; shape (height, width).

        Parameters
        ----------
        radiance : ndarray, shape (height * width,)
            Along `rays` [W m^-2 sr^-1].
        colour : tuple of float, optional
            How red, green and blue the light is; a monochrome sensor sees the mean.
        """
        sensor = self.sensor
        rate: Array = radiance.reshape(self._fall_off.shape) * self._fall_off
        if sensor.psf_sigma_px > 0.0:
            import cv2

            rate = np.asarray(cv2.GaussianBlur(rate, (0, 0), sensor.psf_sigma_px, borderType=cv2.BORDER_REPLICATE), float)
        if sensor.veiling_glare > 0.0:
            rate = (1.0 - sensor.veiling_glare) * rate + sensor.veiling_glare * float(np.mean(rate))
        if sensor.cfa:
            for k, letter in enumerate(sensor.cfa):
                number = COLOURS.index(letter)
                rate[k // 2 :: 2, k % 2 :: 2] *= sensor.cfa_response[number] * colour[number]
        elif colour != (1.0, 1.0, 1.0):
            rate *= sum(colour) / 3.0
        if sensor.prnu > 0.0:
            rate *= self._gains
        return rate

    def expose(self, rate: Array, exposure_s: float, noise: np.random.Generator, gain: float = 1.0) -> NDArray[np.uint16]:
        """Counts of one exposure, shape (height, width) [DN].

        Parameters
        ----------
        rate : ndarray, shape (height, width)
            Of `electrons` [1/s].
        exposure_s : float
        noise : Generator
        gain : float, optional
            Setting of the camera's amplifier, 1 = base.
        """
        sensor = self.sensor
        mean = np.add(rate, sensor.dark_current_e_s, out=self._mean)
        mean *= exposure_s
        flat = mean.ravel()
        few = np.flatnonzero(flat < _FEW)
        drawn = noise.poisson(np.maximum(flat[few], 0.0)).astype(np.float64)
        noise.standard_normal(out=self._normal, dtype=np.float32)
        out = np.empty(flat.shape, np.uint16)
        curve = 1.0 / self.gamma if self.gamma > 0.0 else 0.0
        _read_out(flat, few, drawn, self._normal, sensor.read_noise_e, gain * sensor.gain_dn_per_e, sensor.offset_dn,
                  float(sensor.saturation_dn), curve, out)  # fmt: skip
        return out.reshape(mean.shape)


def _read_all(mean, few, drawn, normal, read_noise, gain, offset, top, curve, out):  # type: ignore[no-untyped-def]
    """DN = K (Poisson(mean) + N(0, sigma_d)) + offset, or its curve, rounded and cut to the converter's range."""
    k = 0
    for i in range(len(mean)):
        if k < len(few) and few[k] == i:
            electrons = drawn[k] + read_noise * normal[i]
            k += 1
        else:
            electrons = min(mean[i], _MOST)
            electrons += np.sqrt(electrons + read_noise * read_noise) * normal[i]
        counts = gain * electrons + offset
        if curve > 0.0:
            counts = top * (max(counts - offset, 0.0) / (top - offset)) ** curve
        out[i] = int(min(max(counts + 0.5, 0.0), top))


_read_out: Any = jit.kernel(_read_all)
