"""EON: nothing lost at albedo 1, Lambert's surface at roughness 0; and the arctangent that it shares."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest

import gonio
from gonio import jit
from gonio.brdf.arctangent import arctan

make = gonio.brdf.make


@pytest.mark.parametrize("roughness", [0.0, 1e-12, 1e-8, 0.3, 1.0])
def test_nothing_is_lost_at_albedo_one(roughness: float) -> None:
    for theta in (0.0, 0.5, 1.2, math.radians(89.9)):
        got = gonio.directional_albedo(make("eon", albedo=1.0, roughness=roughness), theta, rtol=1e-10)
        assert abs(float(got.value) - 1.0) <= float(got.error) <= 1e-10


def test_lambert_at_roughness_zero() -> None:
    at = (np.array([0.2, 1.0, 1.5]), 0.4, 0.9, np.array([0.1, 2.0, 3.5]))
    assert make("eon", albedo=0.6, roughness=0.0).f_r(*at) == pytest.approx(0.6 / math.pi, rel=1e-15)


def test_arctangent() -> None:
    def angles(y, x, out):  # type: ignore[no-untyped-def]
        for k in range(out.size):
            out[k] = arctan(y[k], x[k])

    rng = np.random.default_rng(4)
    y, x = 10.0 ** rng.uniform(-8, 0, 4000), 10.0 ** rng.uniform(-8, 0, 4000)
    y, x = np.concatenate((y, rng.random(4000), [0.0, 1.0, 1.0])), np.concatenate((x, rng.random(4000), [1.0, 0.0, 1.0]))
    out = np.empty_like(x)
    jit.kernel(angles)(y, x, out)
    for got, b, a in zip(out, y, x, strict=True):
        assert abs(got - mpmath.atan2(b, a)) <= 4.5e-16 * got
