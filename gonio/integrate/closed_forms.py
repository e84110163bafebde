r"""The memo's special cases: one evaluation each, no quadrature.

=====================  ===============================================================================
14a, collimated        :math:`E_0\,f_r(\omega_0,\omega_r)\,\max(0,\cos\theta_i)`
14b, Lambert, uniform  :math:`\rho L_0`
14c, Lambert, sky      :math:`\rho\tfrac{L_0}{2}(1 + n\cdot u)`; for a sky around the viewer's axis
                       :math:`\rho\tfrac{L_0}{2}(1 + 1/\sqrt{1+p^2+q^2})` (the memo prints E_0 for L_0)
15a, mirror, beam      :math:`\rho\tfrac{E_0}{4}(1+p_1^2+q_1^2)^2\,\delta(p-p_1)\,\delta(q-q_1)`
15b, 15c, mirror, cap  :math:`\rho L_i(2\theta_n, \phi_n)`
=====================  ===============================================================================

Each returns the value and a bound of its rounding error. Lambert's are in `gonio.integrate.diffuse`.

References
----------
.. [1] B. K. P. Horn, R. W. Sjoberg, MIT AI Memo 498, 1978, sections 14 and 15. docs/memo.md lists its misprints.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gonio.brdf.base import Term
from gonio.brdf.kernels import accumulate
from gonio.fields import Field
from gonio.integrate.frames import Elements
from gonio.source import Cap, Collimated

Array = NDArray[np.float64]
EPS = float(np.finfo(float).eps)


def collimated(term: Term, beam: Collimated, elements: Elements) -> tuple[Array, Array]:
    """14a for any BRDF without a delta function; arrays of shape (n,)."""
    omega_i = elements.local(beam.direction)
    out = np.zeros(len(elements))
    accumulate(term.model)(
        np.ascontiguousarray(omega_i), np.ascontiguousarray(elements.viewer()), term.values, term.weight, out
    )
    value = beam.irradiance * out * np.maximum(0.0, omega_i[:, 2])
    # cos theta_i is a sum of terms of order 1, good to a few eps; a lobe of width w turns 1 eps of direction into eps/w
    width = term.lobe_width() or 1.0
    relative = EPS * (16.0 + 16.0 / width + 4.0 / np.maximum(np.abs(omega_i[:, 2]), EPS))
    return value, np.abs(value) * relative


def diffuse_albedo(term: Term) -> float:
    """pi f_r of a diffuse term, times its weight; one number, for which nothing is compiled."""
    assert term.model.function is not None
    function = getattr(term.model.function, "py_func", term.model.function)
    return term.weight * math.pi * float(function(0.0, 0.0, 1.0, 0.0, 0.0, 1.0, term.values))


def mirror_cap(term: Term, cap: Cap | Field, elements: Elements) -> tuple[Array, Array]:
    """15b, 15c: a mirror under a cap. On the rim itself the value is undefined; 0 is returned there."""
    value = term.weight * term.values[0] * cap.at(elements.mirror())
    return value, 8.0 * EPS * np.abs(value)


def mirror_beam(term: Term, beam: Collimated) -> list[tuple[float, float, float]]:
    """15a: the impulse (p1, q1, weight) of a mirror in a beam; empty if no visible normal reflects the beam to the viewer.

    The normal halves the angle between beam and viewer, n ~ s + v, so p1 = -s_x / (1 + s_z), q1 = -s_y / (1 + s_z).
    """
    x, y, z = beam.direction
    along = 1.0 + z if z > -0.5 else (x * x + y * y) / (1.0 - z)  # 1 + cos theta_0 without cancellation
    strength = term.weight * term.values[0] * beam.irradiance
    if along <= EPS * EPS or strength == 0.0:  # a beam from straight behind grazes every surface
        return []
    p, q = -x / along + 0.0, -y / along + 0.0
    return [(p, q, 0.25 * strength * (1.0 + p * p + q * q) ** 2)]
