r"""exp, log, power, sine and cosine without a branch or a call: loops over them vectorise, as those over math.exp do not.

Each splits off a power of two by the bits of its argument and leaves the rest to a polynomial:

.. math:: e^x = 2^k\,e^r,\ |r|\le\tfrac12\ln 2, \qquad
          \ln x = k\ln 2 + 2\,\mathrm{artanh}\,\frac{f}{2+f},\ 1+f = 2^{-k}x \in [\sqrt{1/2}, \sqrt 2) .

Numbers below the smallest normal one, 2.2e-308, count as 0, as arguments and as results. Only x >= 0 has a logarithm here.

References
----------
.. [1] P.-T. P. Tang, "Table-driven implementation of the exponential function in IEEE floating-point arithmetic", ACM Trans.
   Math. Softw. 15(2), 1989; "... of the logarithm function ...", 16(4), 1990, on the reduction in two parts.
.. [2] FreeBSD msun, e_log.c (Sun Microsystems, 1993): the form of the logarithm and its polynomial of error 2^-58.
.. [3] The same, k_sin.c and k_cos.c: the polynomials for up to pi / 4.
.. [4] T. Ogita, S. M. Rump, S. Oishi, "Accurate sum and dot product", SIAM J. Sci. Comput. 26(6), 2005 (Dekker's product).
"""

from __future__ import annotations

import math

import numpy as np

from gonio import jit

_TO_INTEGER = 1.5 * 2.0**52  # added and subtracted, it rounds; its low bits hold the integer
_TO_INTEGER_BITS = int(np.float64(_TO_INTEGER).view(np.int64))
_LOG2_E = 1.0 / math.log(2.0)
_LN2_HIGH, _LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10  # the first has 21 zero bits at its end
_ROOT_HALF_BITS = int(np.float64(math.sqrt(0.5)).view(np.int64))
_SMALLEST = 2.0**-1022
_SPLITTER = 2.0**27 + 1.0
_QUARTER_PI, _HALF_PI, _HALF_PI_LOW = 0.25 * math.pi, 0.5 * math.pi, 6.12323399573676603587e-17


@jit.model
def exp(x: float) -> float:
    """e^x to 1 eps, relative; 0 below x = -707.7, infinity above 709.78."""
    inside = x if x < 710.0 else 710.0
    inside = inside if inside > -708.0 else -708.0
    shifted = inside * _LOG2_E + _TO_INTEGER
    k = shifted - _TO_INTEGER
    r = (inside - k * _LN2_HIGH) - k * _LN2_LOW
    # (e^r - 1 - r) / r^2, of relative error 6e-18 in e^r
    p = 2.7632655759332030799e-7 + r * 2.5110049895858716253e-8
    p = 2.7557242336680357124e-6 + r * p
    p = 2.4801487326012336596e-5 + r * p
    p = 1.984126988659099934e-4 + r * p
    p = 1.3888888947820891418e-3 + r * p
    p = 8.3333333333222072959e-3 + r * p
    p = 4.166666666652199074e-2 + r * p
    p = 1.666666666666667453e-1 + r * p
    p = 5.0000000000000102245e-1 + r * p
    mantissa = 2.0 * (1.0 + (r + r * r * p))
    half = np.int64((np.float64(shifted).view(np.int64) - _TO_INTEGER_BITS + 1022) << 52).view(np.float64)  # 2^(k - 1)
    value = mantissa * float(half)
    value = value if x > -707.7 else 0.0
    return value if x <= 709.78271289338397 else x * math.inf  # NaN stays NaN


@jit.model
def log_near(u: float, f: float) -> float:
    """ln u to 2 eps, relative, for u >= 0 whose distance from 1, f = u - 1, is known better than u tells."""
    bits = np.float64(u).view(np.int64)
    steps = (bits - _ROOT_HALF_BITS) >> 52
    k = float(np.int64(steps + _TO_INTEGER_BITS).view(np.float64)) - _TO_INTEGER
    mantissa = np.int64(bits - (steps << 52)).view(np.float64)
    f = f if steps == 0 else float(mantissa) - 1.0
    s = f / (2.0 + f)
    z = s * s
    w = z * z
    odd = z * (6.666666666666735130e-01 + w * (2.857142874366239149e-01 + w * (
        1.818357216161805012e-01 + w * 1.479819860511658591e-01)))  # fmt: skip
    even = w * (3.999999999940941908e-01 + w * (2.222219843214978396e-01 + w * 1.531383769920937332e-01))
    half = 0.5 * f * f
    value = k * _LN2_HIGH - ((half - (s * (half + (odd + even)) + k * _LN2_LOW)) - f)
    value = value if u >= _SMALLEST else -math.inf
    return value if u < math.inf else u


@jit.model
def log(x: float) -> float:
    """ln x to 1 eps, relative, for x >= 0; minus infinity at 0."""
    value: float = log_near(x, x - 1.0)
    return value


@jit.model
def log1p(x: float) -> float:
    """ln(1 + x) to 2 eps, relative, for x >= -1, minus infinity at -1."""
    value: float = log_near(1.0 + x, x)
    return value


@jit.model
def power(x: float, y: float) -> float:
    """x^y for x >= 0 to (2 + abs(y ln x)) eps, relative; 0^0 = 1."""
    logarithm = log(x)
    value: float = exp(y * (logarithm if logarithm > -math.inf else -1e308))  # 0^0 = 1
    return value


@jit.model
def sine_and_cosine(x: float) -> tuple[float, float]:
    """sin x and cos x to 1 eps, absolute, for abs(x) <= pi."""
    size = x if x > 0.0 else -x
    first, second = size > _QUARTER_PI, size > 3.0 * _QUARTER_PI
    quarters = (1.0 if first else 0.0) + (1.0 if second else 0.0)
    y = (size - quarters * _HALF_PI) - quarters * _HALF_PI_LOW
    z = y * y
    s = y + y * z * (-1.66666666666666324348e-01 + z * (8.33333333332248946124e-03 + z * (
        -1.98412698298579493134e-04 + z * (2.75573137070700676789e-06 + z * (
            -2.50507602534068634195e-08 + z * 1.58969099521155010221e-10)))))  # fmt: skip
    r = z * (4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03 + z * (2.48015872894767294178e-05 + z * (
        -2.75573143513906633035e-07 + z * (2.08757232129817482790e-09 + z * -1.13596475577881948265e-11)))))  # fmt: skip
    half = 0.5 * z
    w = 1.0 - half
    c = w + (((1.0 - w) - half) + z * r)
    middle = first & (not second)
    sine = c if middle else (-s if second else s)
    cosine = -s if middle else (-c if second else c)
    return (sine if x > 0.0 else -sine), cosine


@jit.model
def two_products(a: float, b: float, c: float, d: float) -> float:
    """a b + c d to 1 eps where the two cancel to no less than 1e-15 of each: with the products' rounding errors [4]_."""
    ab, cd = a * b, c * d
    t = _SPLITTER * a
    a_high = t - (t - a)
    t = _SPLITTER * b
    b_high = t - (t - b)
    t = _SPLITTER * c
    c_high = t - (t - c)
    t = _SPLITTER * d
    d_high = t - (t - d)
    a_low, b_low, c_low, d_low = a - a_high, b - b_high, c - c_high, d - d_high
    rest_ab = a_low * b_low - (((ab - a_high * b_high) - a_low * b_high) - a_high * b_low)
    rest_cd = c_low * d_low - (((cd - c_high * d_high) - c_low * d_high) - c_high * d_low)
    total = ab + cd
    t = total - ab
    return total + (((ab - (total - t)) + (cd - t)) + (rest_ab + rest_cd))
