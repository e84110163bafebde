"""Light that facets scatter several times: Kulla and Conty's lobe against losses integrated by other means, a white furnace.

The truth integrates f_r cos(theta_i) of facets that reflect all over omega_i, not over the facets' tilts, and subtracts from
1: equal steps of phi and Gauss-Legendre panels of cos(theta_i), with 64-bit mantissas and Smith's Lambda from 30 digits. At
normal incidence the loss is an integral over one angle, here at 30 digits for roughnesses down to 1e-4.
"""

from __future__ import annotations

import functools
import math

import mpmath
import numpy as np
import pytest
from mpmath import mpf, pi
from numpy.typing import NDArray

import gonio
from gonio.brdf import multiple_scattering as again
from gonio.brdf.facets import FACETS
from tests import microfacet_formulas as facets
from tests.brdf_truth import TINY, Geometry
from tests.gates import record

make = gonio.brdf.make
Long = np.longdouble
GAMMAS = {"beckmann": {}, "ggx": {}, "gtr": {"gamma": 3.0}, "std": {"gamma": 2.6}}
LIMIT = 1e-12
UNRESOLVED = 1e-16  # of the truth's losses, differences from 1: smaller ones are left to test_loss_at_normal_incidence


def long(x: mpf) -> np.longdouble:
    return Long(mpmath.nstr(x, 25)) if abs(x) > mpf("1e-4000") else Long(0)


@functools.cache
def panels(breaks: tuple[float, ...], count: int) -> tuple[NDArray[np.longdouble], NDArray[np.longdouble]]:
    """Gauss-Legendre nodes and weights on panels, corrected to 64-bit mantissas by Newton's method."""
    x = np.polynomial.legendre.leggauss(count)[0].astype(Long)
    for _ in range(2):
        before, now = np.ones_like(x), x
        for k in range(2, count + 1):
            before, now = now, ((2 * k - 1) * x * now - (k - 1) * before) / k
        slope = count * (x * now - before) / (x * x - 1)
        x = x - now / slope
    w = 2 / ((1 - x * x) * slope * slope)
    low, high = np.array(breaks[:-1], dtype=Long)[:, None], np.array(breaks[1:], dtype=Long)[:, None]
    half = (high - low) / 2
    return (low + half * (1 + x)).ravel(), (half * w).ravel()


BREAKS = (0.0, 1e-6, 1e-5, 1e-4, 1e-3, 0.01, 0.05, 0.12, 0.25, 0.4, 0.6, 0.8, 0.92, 0.98, 0.998, 0.9998, 0.99999, 1.0)
STEP = 0.1  # whose error for a Gaussian is exp(-pi^2 / (2 STEP))


class Facets:
    """Facets that reflect all, of one distribution and roughness."""

    def __init__(self, distribution: str, shadowing: str, alpha: float, gamma: float | None) -> None:
        self.distribution, self.separable = distribution, shadowing == "smith_separable"
        self.alpha, self.gamma = mpf(alpha), None if gamma is None else mpf(gamma)
        self.mu, self.weights = panels(BREAKS, 28)
        self.hidden = self.smith(self.mu)
        # psi from the mirror's plane, tan(psi / 2) = e^v: sin^2(psi / 2), and dpsi on both sides
        t2 = np.exp(2 * Long(STEP) * np.arange(-60 / STEP, 46 / STEP))
        self.sine2, self.across = t2 / (1 + t2), 4 * Long(STEP) * np.sqrt(t2) / (1 + t2)

    def smith(self, mu: NDArray[np.longdouble]) -> NDArray[np.longdouble]:
        """Lambda."""
        with mpmath.workdps(30):
            thetas = [mpmath.acos(mpf(np.format_float_positional(m, unique=True))) for m in mu]
            return np.array([long(facets.smith_lambda(t, self.distribution, self.alpha, self.gamma, 30)) for t in thetas])

    def density(self, z2: NDArray[np.longdouble], s2: NDArray[np.longdouble]) -> NDArray[np.longdouble]:
        """D of the half vector, from the squares of the normal and the tangential part of omega_i + omega_r."""
        cos2, sin2, a2 = z2 / (z2 + s2), s2 / (z2 + s2), long(self.alpha) ** 2
        if self.distribution == "beckmann":
            return np.exp(-sin2 / (cos2 * a2)) / (Long(np.pi) * a2 * cos2**2)
        if self.distribution == "ggx":
            return a2 / (Long(np.pi) * (a2 * cos2 + sin2) ** 2)
        gamma = long(self.gamma)
        if self.distribution == "std":
            return (1 + sin2 / (cos2 * (gamma - 1) * a2)) ** -gamma / (Long(np.pi) * a2 * cos2**2)
        return long(facets.gtr_c(self.alpha, self.gamma)) / (a2 * cos2 + sin2) ** gamma

    def loss(self, mu_r: NDArray[np.longdouble]) -> NDArray[np.longdouble]:
        """1 - E."""
        return np.array([self._loss(m, h) for m, h in zip(mu_r, self.smith(mu_r), strict=True)])

    def _loss(self, mu_r: np.longdouble, hidden_r: np.longdouble) -> np.longdouble:
        mu, hidden = self.mu[:, None], self.hidden[:, None]
        sines = np.sqrt((1 - mu * mu) * (1 - mu_r * mu_r))
        tangential2 = (mu_r * mu_r - mu * mu) ** 2 / (np.sqrt(1 - mu * mu) + np.sqrt(1 - mu_r * mu_r)) ** 2
        d = self.density((mu + mu_r) ** 2, tangential2 + 4 * sines * self.sine2)
        below = (1 + hidden) * (1 + hidden_r) if self.separable else 1 + hidden + hidden_r
        return 1 - np.sum(self.weights[:, None] * self.across * d / (4 * mu_r * below))

    def mean_loss(self) -> np.longdouble:
        """2 times the integral of (1 - E) mu."""
        mu, w = panels((0.0, 1e-4, 1e-3, 0.01, 0.05, 0.2, 0.5, 0.8, 0.95, 0.99, 0.999, 1.0), 10)
        return np.sum(2 * w * mu * self.loss(mu))


def worst_error(distribution: str, shadowing: str, alpha: float) -> float:
    """Of f_r, beyond the truth's own doubt, over directions from the normal to 89.99 degrees, each paired with each."""
    gamma = GAMMAS[distribution]
    choices = {"distribution": distribution, "shadowing": shadowing, "fresnel": "schlick"}
    numbers = {"k_s": 1.0, "alpha": alpha, "f_0": 0.3, **gamma}
    directions = gonio.geometry.unit_vector(np.array([0.0, 0.3, 1.0, math.radians(89.99)]), np.array([0.0, 0.0, 2.0, 4.0]))
    omega_i, omega_r = np.repeat(directions, 4, axis=0), np.tile(directions, (4, 1))
    got = make("microfacet", multiple_scattering=True, **choices, **numbers).evaluate(omega_i, omega_r)
    surface = Facets(distribution, shadowing, alpha, gamma.get("gamma"))
    losses, mean = surface.loss(directions[:, 2].astype(Long)), surface.mean_loss()
    f = Long(0.3) + Long(0.7) / 21  # Schlick's, averaged
    height = f * f * (1 - mean) / (1 - f * mean) / (Long(np.pi) * mean)
    lobe = (height * losses[:, None] * losses).ravel()
    doubt = (height * UNRESOLVED * (losses[:, None] + losses)).ravel()
    once, given = facets.formula(distribution, "schlick", shadowing), {k: mpf(v) for k, v in numbers.items()}
    with mpmath.workdps(30):
        true = lobe + [long(once(Geometry(a, b), **given)) for a, b in zip(omega_i, omega_r, strict=True)]
    error = float(np.max((np.abs(got - true) - np.abs(doubt)) / np.abs(true)))
    print(f"{distribution}, {shadowing}, alpha = {alpha:g}: {error:.1e}")
    return error


def test_kulla_and_contys_lobe() -> None:
    assert worst_error("ggx", "smith", 0.3) <= LIMIT


@pytest.mark.gate
def test_gate_kulla_and_contys_lobe() -> None:
    cases = [(d, s, a) for d in GAMMAS for s in ("smith", "smith_separable") for a in (1.0, 0.3, 0.1)]
    worst = {case: worst_error(*case) for case in cases}
    name = max(cases, key=lambda case: worst[case])
    record(
        "multiple scattering of microfacets",
        f"{worst[name]:.1e} of f_r ({name}) of {len(cases)} surfaces, 16 pairs of directions",
        f"<= {LIMIT:g}", "-", "pytest -m gate tests/property/test_brdf_multiple_scattering.py",
    )  # fmt: skip
    assert worst[name] <= LIMIT


@pytest.mark.parametrize("distribution", list(GAMMAS))
def test_loss_at_normal_incidence(distribution: str) -> None:
    """Facets at theta send light to 2 theta, where others hide Lambda / (1 + Lambda) of it; beyond 45 degrees all of it."""
    gamma = GAMMAS[distribution].get("gamma")
    for alpha in (1.0, 0.03, 1e-4):
        numbers = {"k_s": 1.0, "alpha": alpha, **GAMMAS[distribution]}
        model = make("microfacet", distribution=distribution, fresnel="none", multiple_scattering=True, **numbers).terms[0]
        lost = again.lost(FACETS[distribution], len(numbers) + FACETS[distribution].count)
        with mpmath.workdps(20):
            a, c = mpf(alpha), None if gamma is None else mpf(gamma)

            def share(u: mpf, a: mpf = a, c: mpf | None = c) -> mpf:  # of facets at theta, u = ln tan theta
                theta = mpmath.atan(mpmath.exp(u))
                d = facets.density(_Tilted(theta), distribution, a, c) * mpmath.sin(2 * theta) * pi
                hidden = facets.smith_lambda(2 * theta, distribution, a, c, 20) if u < 0 else mpmath.inf
                return d * (hidden / (1 + hidden) if u < 0 else 1) * mpmath.sin(2 * theta) / 2  # dtheta

            low = [mpf(-20), *(mpmath.log(a) + k for k in range(-6, 7, 3) if mpmath.log(a) + k < -1)]
            true = mpmath.quad(share, [*low, -1, 0]) + mpmath.quad(share, [0, 1, 3, 8, 20])
        if true > TINY:
            assert float(lost(1.0, 0.0, model.values)) == pytest.approx(float(true), rel=LIMIT)


class _Tilted:
    """A half vector at theta_h."""

    def __init__(self, theta_h: mpf) -> None:
        self.theta_h, self.tan2_h = theta_h, mpmath.tan(theta_h) ** 2


@pytest.mark.parametrize("distribution", list(GAMMAS))
def test_white_furnace(distribution: str) -> None:
    """Facets that reflect all lose nothing once light is followed: the albedo is 1."""
    choices = {"distribution": distribution, "fresnel": "none", "multiple_scattering": True, **GAMMAS[distribution]}
    for theta in (0.0, 1.5):
        found = gonio.directional_albedo(make("microfacet", k_s=1.0, alpha=0.4, **choices), theta, rtol=1e-7)
        assert float(found.value) == pytest.approx(1.0, abs=float(found.error))
