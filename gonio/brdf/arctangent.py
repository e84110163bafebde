r"""The arctangent without a branch or a call, for models that need an angle: loops over it vectorise.

The larger of the two lengths divides the smaller; above :math:`\tan(\pi/8)` the angle is counted from :math:`\pi/4`. What is
left, at most 0.4143, goes to a polynomial.

References
----------
.. [1] FreeBSD msun, s_atan.c (Sun Microsystems, 1993): the polynomial, for up to 7/16.
"""

from __future__ import annotations

import math

from gonio import jit

_TAN_EIGHTH = math.tan(math.pi / 8)
_QUARTER, _HALF = 0.25 * math.pi, 0.5 * math.pi


@jit.model
def arctan(y: float, x: float) -> float:
    """Angle of the point (x, y) from the x axis [rad], to 2 eps, relative; x and y >= 0 and not both 0."""
    steep = y > x
    small = x if steep else y
    large = y if steep else x
    middle = small > _TAN_EIGHTH * large
    t = (small - large if middle else small) / (small + large if middle else large)
    z = t * t
    w = z * z
    odd = z * (3.33333333333329318027e-01 + w * (1.42857142725034663711e-01 + w * (
        9.09088713343650656196e-02 + w * (6.66107313738753120669e-02 + w * (
            4.97687799461593236017e-02 + w * 1.62858201153657823623e-02)))))  # fmt: skip
    even = w * (-1.99999999998764832476e-01 + w * (-1.11111104054623557880e-01 + w * (
        -7.69187620504482999495e-02 + w * (-5.83357013379057348645e-02 + w * -3.65315727442169155270e-02))))  # fmt: skip
    angle = (_QUARTER if middle else 0.0) + (t - t * (odd + even))
    return _HALF - angle if steep else angle
