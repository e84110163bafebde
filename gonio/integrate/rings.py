r"""Maps of an isotropic BRDF under any radiance field, seen along the view axis: R(theta_n, phi_n) as one smooth table.

`ring_kernel` gives, for one slope, R as a Fourier series in phi_n. A few gradients are summed from it. For a map the
slopes are tabulated (`ring_table`), piecewise by Chebyshev polynomials of tau = tan(theta_n / 2), which is algebraic in the
gradient and regular to 90 degrees, and read by `ring_patches`: the cost of a gradient does not depend on BRDF and field.

The error of a piece is that of the table at slopes and azimuths between its nodes, against sums with more digits and more
waves, times a safety factor; plus what waves left out may add, the error of the field's own series, and rounding. No value
is below 0 where the field is not: where the error allows one, it is raised to 0.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gonio.brdf.base import Term
from gonio.fields import EnvironmentMap, Field, FunctionField
from gonio.integrate import threads
from gonio.integrate.frames import Elements
from gonio.integrate.grid import Gradients
from gonio.integrate.quadrature import Effort
from gonio.integrate.ring_scene import FIRST_WAVES, MOST_DIGITS, NONE, Scene, first_digits, floor_of, on_azimuths, tail_of
from gonio.integrate.spectrum import spectrum

Array = NDArray[np.float64]
_STEP = 1.5  # digits from one sum to the next
_STEADY, _SLOW = 2.0, 5.0  # of the difference of two sums, which should be thirty times what is left in the finer one
_DOUBT = 1.0  # of the digits asked for: two sums may agree by chance, or take as many nodes
FEW = 96  # distinct slopes up to which each is summed by itself


def scene_of(term: Term, field: Field, rtol: float, effort: Effort, cores: int | None) -> Scene:
    """One isotropic, compiled term and one field, with the field's waves to rounding, or a millionth of the tolerance."""
    to = 1e-6 if isinstance(field, FunctionField) else 1e-8  # which of the values far below the largest are good to rtol
    columns = field.samples.shape[1] if isinstance(field, EnvironmentMap) else 0
    return Scene(
        term,
        spectrum(field, max(to * rtol, 1e-14)),
        isinstance(field, EnvironmentMap),
        term.lobe_width() or NONE,
        cores or threads.available(),
        effort,
        # of a map beyond the first copy of its spectrum, as what its kinks add starts there
        max(FIRST_WAVES, min(400, 3 * columns // 2)),
        isinstance(field, EnvironmentMap) and field.interpolation == "smooth",
    )


def slopes_are_few(gradients: Gradients) -> bool:
    """Whether each slope is better summed by itself."""
    if gradients.size <= FEW:
        return True
    start = gradients.elements(0, min(gradients.size, 4 * FEW))  # which tells for nearly all lists
    return len(np.unique(start.cos_theta)) <= FEW and len(np.unique(gradients.elements().cos_theta)) <= FEW


def integrate_rings(
    scene: Scene, elements: Elements, *, rtol: float, atol: float | Array, most_waves: int = 1 << 20
) -> tuple[Array, Array]:
    """Reflected radiance of each element, slope by slope.

    Parameters
    ----------
    scene : Scene
    elements : Elements, length n
        Seen along the view axis.
    rtol : float
    atol : float or ndarray, shape (n,)
        Tolerance per element. An element that does not reach it keeps its honest error.
    most_waves : int, optional
        Up to which the sums may go, where something else is faster then.

    Returns
    -------
    value, error : ndarray, shape (n,)
        [W m^-2 sr^-1].
    """
    tau = elements.sin_theta / (1.0 + elements.cos_theta)
    phi = np.arctan2(elements.sin_phi, elements.cos_phi)
    slopes, where = np.unique(tau, return_inverse=True)
    absolute = np.broadcast_to(np.asarray(atol, dtype=float), tau.shape)
    value, error = _directly(scene, slopes, where, phi, rtol, absolute, min(scene.rings.waves, most_waves))
    return np.maximum(value, scene.least), np.maximum(error, scene.least - value)


def _series(sums: Array, phi: Array) -> Array:
    """Values at azimuths: sums (n, 3, waves), phi (n,)."""
    m = np.arange(1, sums.shape[2])
    turn = np.exp(1j * phi)[:, None] ** m
    values: Array = sums[:, 0, 0] + np.einsum("nm,nm->n", sums[:, 0, 1:], turn.real)
    values += np.einsum("nm,nm->n", sums[:, 1, 1:], turn.imag)
    return values


def _directly(
    scene: Scene, slopes: Array, where: NDArray[np.intp], phi: Array, rtol: float, atol: Array, most: int
) -> tuple[Array, Array]:
    """Each slope by itself, with more digits and more waves until the tolerance is met."""
    value, error = np.zeros(len(phi)), np.full(len(phi), np.inf)
    digits = max(first_digits(rtol), min(MOST_DIGITS - 2.0 * _STEP, 0.5 - _STEP - math.log10(rtol)))
    waves = min(most, scene.first_waves)
    pending = np.arange(len(slopes))
    rough, before = scene.sums(slopes, digits, waves), np.full(len(slopes), np.inf)
    while True:
        fine = scene.sums(slopes[pending], digits + _STEP, waves)
        tail, columns = tail_of(fine, scene.rings), 4 * waves
        largest = np.abs(on_azimuths(fine, columns)).max(axis=1)
        step = np.abs(on_azimuths(fine - rough, columns)).max(axis=1)
        slow = (step > 0.2 * before) | (step > 10.0**-digits * largest)  # sums keep less than they promise
        missed = np.where(slow, _SLOW, _STEADY) * step + _DOUBT * 10.0 ** -(digits + _STEP) * largest
        again = np.zeros(len(pending), dtype=np.bool_)
        for j, k in enumerate(pending):
            here = np.flatnonzero(where == k)
            value[here] = _series(np.broadcast_to(fine[j], (len(here), *fine[j].shape)), phi[here])
            floor = floor_of(scene, fine[j])
            error[here] = missed[j] + tail[j] + float(fine[j, 2, 2]) + floor
            tolerance = np.maximum(rtol * np.abs(value[here]), atol[here])
            lasting = floor + tail[j] if waves == most else floor  # no digits lower it
            again[j] = np.any((error[here] > tolerance) & (lasting <= tolerance))
        if not np.any(again):
            return value, error
        pending, few_waves = pending[again], np.any(tail[again] > 0.4 * missed[again]) and waves < most
        if few_waves:
            waves = min(most, 2 * waves)
            rough, before = scene.sums(slopes[pending], digits, waves), np.full(len(pending), np.inf)
        elif digits < MOST_DIGITS - _STEP:
            digits, rough, before = digits + _STEP, fine[again], step[again]
        else:
            return value, error
