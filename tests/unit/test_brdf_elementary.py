"""exp, log, power, sine and cosine of the models' loops against 40 digits, and at the ends of their ranges."""

from __future__ import annotations

import math
from collections.abc import Callable

import mpmath
import numpy as np
import pytest

from gonio.brdf.elementary import exp, log, log1p, power, sine_and_cosine

EPS = 2.0**-52
_RNG = np.random.default_rng(8)


def _signed(count: int, least: float, most: float) -> list[float]:
    return (_RNG.choice([-1.0, 1.0], count) * 10.0 ** _RNG.uniform(least, most, count)).tolist()


def _positive(count: int, least: float, most: float) -> list[float]:
    return (10.0 ** _RNG.uniform(least, most, count)).tolist()


_CASES = {
    "exp": (exp, mpmath.exp, [*_RNG.uniform(-707, 709, 500), *_RNG.uniform(-1, 1, 500), *_signed(300, -20, 0)], 1.0),
    "log": (log, mpmath.log, [*_positive(500, -307, 308), *_RNG.uniform(0.4, 2.5, 500), 1 - EPS / 2, 1 + EPS], 1.0),
    "log1p": (log1p, mpmath.log1p, [*_positive(500, -300, 300), *_RNG.uniform(-0.99, 2, 500), *_signed(300, -18, -1)], 2.0),
}


@pytest.mark.parametrize("name", _CASES)
def test_relative_error(name: str) -> None:
    function, true, numbers, bound = _CASES[name]
    worst = _worst(function, true, [float(x) for x in numbers])
    print(f"{name}: {worst:.2f} eps")
    assert worst <= bound


def _worst(function: Callable[[float], float], true: Callable[[mpmath.mpf], mpmath.mpf], numbers: list[float]) -> float:
    with mpmath.workdps(40):
        return max(float(abs(mpmath.mpf(function(x)) / true(mpmath.mpf(x)) - 1)) for x in numbers) / EPS


def test_power() -> None:
    with mpmath.workdps(40):
        for x, y in zip(_positive(500, -3, 3), _RNG.uniform(-80, 80, 500).tolist(), strict=True):
            error = float(abs(mpmath.mpf(power(x, y)) / mpmath.mpf(x) ** mpmath.mpf(y) - 1))
            assert error <= EPS * (2 + abs(y * math.log(x)))


def test_ends() -> None:
    assert [exp(x) for x in (0.0, -707.8, -1e300, -math.inf, 709.79, math.inf)] == [1.0, 0.0, 0.0, 0.0, math.inf, math.inf]
    assert exp(709.78) == pytest.approx(math.exp(709.78), rel=1e-15)
    assert exp(-707.6) == pytest.approx(math.exp(-707.6), rel=1e-15)
    assert [log(x) for x in (0.0, 1.0, math.inf)] == [-math.inf, 0.0, math.inf]
    assert [log1p(x) for x in (-1.0, 0.0, 5e-324)] == [-math.inf, 0.0, 5e-324]
    assert math.isnan(exp(math.nan))
    assert [power(0.0, 0.0), power(0.0, 1e-300), power(0.0, 4.0), power(2.0, 0.0)] == [1.0, 0.0, 0.0, 1.0]


def test_sine_and_cosine() -> None:
    numbers = [*_RNG.uniform(-math.pi, math.pi, 1500), *_signed(300, -300, 0), 0.0, math.pi, -math.pi / 2, math.pi / 4]
    with mpmath.workdps(40):
        for x in map(float, numbers):
            sine, cosine = sine_and_cosine(x)
            true = mpmath.sin(x), mpmath.cos(x)
            assert abs(sine - true[0]) <= EPS * min(1, 2 * abs(x)) and abs(cosine - true[1]) <= EPS
