"""The integrator against closed forms, mpmath, limits, and itself in other coordinates (memo, sections 13 to 15)."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gonio
from gonio.errors import GeometryError, IntegrationError, ParameterError
from gonio.geometry import normal_from_gradient
from gonio.integrate import MapValues, directional_albedo, scene_radiance
from gonio.integrate.plan import Method, plan
from gonio.source import Cap, Source

make_source, make_brdf = gonio.source.make, gonio.brdf.make
WHITE = make_brdf("lambertian", albedo=1.0)
slopes = st.floats(-50, 50)


def satin(alpha: float) -> gonio.BRDF:
    return make_brdf("lambertian", albedo=0.4) + make_brdf("ggx", k_s=1.0, alpha=alpha, f_0=0.04)


# --- 14b, 14c: quadrature against the closed form -------------------------------------------------------------------


@settings(max_examples=60, deadline=None, derandomize=True)
@given(p=slopes, q=slopes, form=st.sampled_from(["local", "viewer"]))
def test_14b_and_14c_by_quadrature(p: float, q: float, form: str) -> None:
    theta_n, phi_n = normal_from_gradient(p, q)
    sky = scene_radiance(WHITE, make_source("hemispherical", radiance=2.0), theta_n, phi_n, form=form, rtol=1e-13)
    assert float(sky.value) == pytest.approx(1.0 + 1.0 / math.sqrt(1.0 + p * p + q * q), rel=1e-12)
    full = scene_radiance(WHITE, make_source("uniform", radiance=2.0), theta_n, phi_n, form=form, rtol=1e-12)
    assert float(full.value) == pytest.approx(2.0, rel=1e-12)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(p=st.floats(-1e8, 1e8), q=st.floats(-1e8, 1e8))
def test_white_furnace_at_every_tilt(p: float, q: float) -> None:
    """Albedo 1 in a uniform sphere of light returns the light: by closed form, and by quadrature in the local form."""
    source = make_source("uniform", radiance=1.0)
    assert float(gonio.reflectance_map(WHITE, source, p, q, rtol=1e-12).value) == pytest.approx(1.0, abs=1e-12)
    by_nodes = scene_radiance(WHITE, source, *normal_from_gradient(p, q), rtol=1e-12)
    assert float(by_nodes.value) == pytest.approx(1.0, abs=1e-12)


# --- delta functions: 14a, 15a, 15b, 15c ------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(6))
def test_14a_against_mpmath(seed: int) -> None:
    rng = np.random.default_rng(seed)
    p, q = rng.normal(size=2) * 2
    theta_0, phi_0 = rng.uniform(0, 1.3), rng.uniform(0, 2 * np.pi)
    with mpmath.workdps(40):
        pm, qm, t0, f0 = (mpmath.mpf(float(a)) for a in (p, q, theta_0, phi_0))
        length = mpmath.sqrt(1 + pm**2 + qm**2)
        n = mpmath.matrix([-pm / length, -qm / length, 1 / length])
        s = mpmath.matrix([mpmath.sin(t0) * mpmath.cos(f0), mpmath.sin(t0) * mpmath.sin(f0), mpmath.cos(t0)])
        cos_i = (n.T * s)[0]
        # Lambert: the memo's 14a with its sign mended
        ps, qs = -mpmath.tan(t0) * mpmath.cos(f0), -mpmath.tan(t0) * mpmath.sin(f0)
        lambert = 3 * (1 + ps * pm + qs * qm) / (mpmath.sqrt(1 + ps**2 + qs**2) * length) / mpmath.pi
        assert mpmath.almosteq(lambert, 3 * cos_i / mpmath.pi, 1e-35)
        # GGX, from a normalised half vector in viewer coordinates
        a, h = mpmath.mpf("0.2"), s + mpmath.matrix([0, 0, 1])
        h /= mpmath.norm(h)
        nh, hv, nv = (n.T * h)[0], h[2], n[2]
        d = a**2 / (mpmath.pi * (nh**2 * (a**2 - 1) + 1) ** 2)
        smith = [(mpmath.sqrt(1 + a**2 * (1 - c**2) / c**2) - 1) / 2 for c in (cos_i, nv)]
        fresnel = mpmath.mpf("0.04") + mpmath.mpf("0.96") * (1 - hv) ** 5
        glossy = 3 * fresnel * d / (1 + sum(smith)) / (4 * nv)
        truth = [float(max(0, lambert)), float(glossy) if cos_i > 0 else 0.0]
    beam = make_source("collimated", theta=theta_0, phi=phi_0, irradiance=3.0)
    got = [
        float(gonio.reflectance_map(brdf, beam, p, q, rtol=1e-9).value)
        for brdf in (WHITE, make_brdf("ggx", k_s=1.0, alpha=0.2, f_0=0.04))
    ]
    assert got == pytest.approx(truth, rel=1e-13)


def test_15a_impulse_carries_the_beam_s_irradiance() -> None:
    r"""A mirror shows the beam as rho E_0 delta(direction): integrated over gradients with the Jacobian that mpmath
    differentiates from the mirror direction, the impulse must give rho E_0 back."""
    theta_0, phi_0 = 0.9, 2.3
    beam = make_source("collimated", theta=theta_0, phi=phi_0, irradiance=5.0)
    ((p1, q1, weight),) = gonio.reflectance_map(make_brdf("specular", rho=0.6), beam, [0.0], [0.0]).impulses

    def mirror(p: mpmath.mpf, q: mpmath.mpf) -> tuple[mpmath.mpf, mpmath.mpf]:
        """(cos theta_s, phi_s) of the direction seen in a mirror of gradient p, q; d omega = d cos theta_s d phi_s."""
        z = 2 / (1 + p**2 + q**2) - 1
        return z, mpmath.atan2(-q, -p)

    with mpmath.workdps(30):
        at = (mpmath.mpf(p1), mpmath.mpf(q1))
        z, phi = mirror(*at)
        assert float(z) == pytest.approx(math.cos(theta_0), rel=1e-14)
        assert float(phi) == pytest.approx(phi_0, rel=1e-14)
        j = [[mpmath.diff(lambda p, q, k=k: mirror(p, q)[k], at, order) for order in ((1, 0), (0, 1))] for k in (0, 1)]
        jacobian = abs(j[0][0] * j[1][1] - j[0][1] * j[1][0])
    assert weight == pytest.approx(0.6 * 5.0 / float(jacobian), rel=1e-12)
    # overhead, where the memo's own formula is 0/0; and from straight behind, where no surface reflects
    overhead = make_source("collimated", theta=0.0, phi=0.0, irradiance=4.0)
    assert gonio.reflectance_map(make_brdf("specular", rho=1.0), overhead, [0.0], [0.0]).impulses == [(0.0, 0.0, 1.0)]
    behind = make_source("collimated", theta=math.pi, phi=0.0, irradiance=4.0)
    assert gonio.reflectance_map(make_brdf("specular", rho=1.0), behind, [0.0], [0.0]).impulses == []


def test_15b_and_15c_as_limits_of_a_polished_metal() -> None:
    """GGX with f_0 = 1 and shrinking alpha tends to a mirror: 1 under a uniform sphere; 1 or 0 under a hemisphere."""
    p, inside, outside = np.array([0.0, 0.3, 0.6]), slice(0, 3), np.array([1.6, 3.0])
    for source, gradients in (
        (make_source("uniform", radiance=1.0), p),
        (make_source("hemispherical", radiance=1.0), p[inside]),
    ):
        missing = [
            1.0 - gonio.reflectance_map(make_brdf("ggx", k_s=1.0, alpha=a, f_0=1.0), source, gradients, 0.0, rtol=1e-8).value
            for a in (0.04, 0.02, 0.01)
        ]
        # what a rough metal loses to shadowing falls at least linearly with alpha
        assert np.all(np.abs(missing[1]) < 0.6 * np.abs(missing[0])) and np.all(
            np.abs(missing[2]) < 0.6 * np.abs(missing[1])
        )
        assert np.all(np.abs(missing[2]) < 2e-3)
        mirror = gonio.reflectance_map(make_brdf("specular", rho=1.0), source, gradients, 0.0)
        assert np.all(mirror.value == 1.0)
    sky = make_source("hemispherical", radiance=1.0)
    dark = [
        gonio.reflectance_map(make_brdf("ggx", k_s=1.0, alpha=a, f_0=1.0), sky, outside, 0.0, rtol=1e-8).value
        for a in (0.04, 0.02, 0.01)
    ]
    assert np.all(dark[1] < 0.6 * dark[0]) and np.all(dark[2] < 0.6 * dark[1]) and np.all(dark[2] < 2e-3)
    assert np.all(gonio.reflectance_map(make_brdf("specular", rho=1.0), sky, outside, 0.0).value == 0.0)


@pytest.mark.parametrize("brdf", [WHITE, satin(0.3)], ids=["white", "satin"])
def test_a_shrinking_disk_tends_to_the_beam_at_second_order(brdf: gonio.BRDF) -> None:
    p, q = np.array([0.2, -1.0, -0.3]), np.array([-0.4, -0.3, -0.8])
    beam = gonio.reflectance_map(brdf, make_source("collimated", theta=0.6, phi=1.0, irradiance=1.0), p, q).value
    error = []
    for half_angle in np.radians([2.0, 1.0, 0.5]):
        disk = make_source("disk", theta=0.6, phi=1.0, half_angle=half_angle, irradiance=1.0)
        error.append(np.abs(gonio.reflectance_map(brdf, disk, p, q, rtol=1e-11).value - beam))
    if brdf is WHITE:  # the disk is the beam exactly, cos theta_i being linear in the direction
        assert np.max(error) < 1e-15
    else:
        assert np.all(np.abs(np.log2(np.divide(error[:-1], error[1:])) - 2.0) < 0.02)


# --- a product rule -----------------------------------------------------------------------------------------------------

SOURCES = {
    "uniform": make_source("uniform", radiance=1.0),
    "sky": make_source("hemispherical", radiance=1.0),
    "tilted sky": make_source("hemispherical", radiance=1.0, axis=(0.4, -0.3, 0.8)),
    "overcast": make_source("overcast", zenith_radiance=1.0),
    "disk": make_source("disk", theta=0.7, phi=1.0, half_angle=math.radians(5.0), radiance=1.0),
}


@pytest.mark.parametrize("name", SOURCES)
def test_map_against_a_plain_product_rule(name: str) -> None:
    """The rule that a user would write, in viewer coordinates over the whole sphere: Gauss in cos theta, trapezoid in phi.

    It is only as good as the jumps at the horizons let it be, hence 1e-3; it shares no code with the integrator.
    """
    x, w = np.polynomial.legendre.leggauss(900)
    if name == "disk":
        edge = math.cos(math.radians(5.0))
        z, wz = 0.5 * (1 + edge) + 0.5 * (1 - edge) * x, 0.5 * (1 - edge) * w
    else:
        z, wz = x, w
    phi = 2 * np.pi * (np.arange(900) + 0.5) / 900
    s = np.sqrt(1 - z**2)
    directions = np.stack(np.broadcast_arrays(s[:, None] * np.cos(phi), s[:, None] * np.sin(phi), z[:, None]), axis=-1)
    if name == "disk":  # about the disk's own axis
        t, f = 0.7, 1.0
        turn = np.array([[math.cos(t), 0, math.sin(t)], [0, 1, 0], [-math.sin(t), 0, math.cos(t)]])
        turn = np.array([[math.cos(f), -math.sin(f), 0], [math.sin(f), math.cos(f), 0], [0, 0, 1]]) @ turn
        directions = directions @ turn.T
    directions = directions.reshape(-1, 3)
    weight = np.repeat(wz, 900) * (2 * np.pi / 900)
    radiance = SOURCES[name].radiance(directions)
    brdf = satin(0.3)
    for p, q in ((0.0, 0.0), (0.5, -0.2), (-1.0, 1.5), (4.0, 3.0)):
        n = np.array([-p, -q, 1.0]) / math.sqrt(1 + p * p + q * q)
        tangent = np.cross([0.0, 1.0, 0.0], n)
        tangent /= np.linalg.norm(tangent)
        frame = np.stack((tangent, np.cross(n, tangent), n))
        local, view = directions @ frame.T, frame @ np.array([0.0, 0.0, 1.0])
        f_r = brdf.evaluate(local, np.broadcast_to(view, local.shape))
        truth = float(np.sum(weight * f_r * radiance * np.maximum(0.0, local[:, 2])))
        got = gonio.reflectance_map(brdf, SOURCES[name], p, q, rtol=1e-8)
        assert float(got.value) == pytest.approx(truth, rel=1e-3)


# --- maps, errors, plans ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["uniform", "sky", "overcast"])
@pytest.mark.parametrize("rtol", [1e-3, 1e-6, 1e-9])
def test_the_table_in_theta_n_keeps_its_promise(name: str, rtol: float) -> None:
    """A grid goes through the table, single gradients through quadrature at 1e-12; they agree to error and rtol."""
    axis = np.linspace(-3, 3, 41)
    grid = gonio.reflectance_map(satin(0.05), SOURCES[name], axis[None, :], axis[:, None], rtol=rtol)
    assert any(step.method is Method.RADIAL for step in grid.plan)
    rows, columns = np.random.default_rng(6).integers(0, 41, (2, 25))
    truth = scene_radiance(satin(0.05), SOURCES[name], *normal_from_gradient(axis[columns], axis[rows]), rtol=1e-12)
    off = np.abs(grid.value[rows, columns] - truth.value)
    assert np.all(off <= grid.error[rows, columns])
    assert np.all(off <= rtol * truth.value)


def test_albedo_of_a_rough_metal() -> None:
    for rtol in (1e-6, 1e-12):
        metal = make_brdf("ggx", k_s=1.0, alpha=1.0, f_0=1.0)
        assert float(directional_albedo(metal, 0.0, rtol=rtol).value) == pytest.approx(1 - math.log(2), rel=rtol)
    theta = np.array([0.0, 0.5, 1.0, 1.4, 1.55])
    for alpha in (1.0, 0.3, 0.03):
        rho = directional_albedo(make_brdf("ggx", k_s=1.0, alpha=alpha, f_0=1.0), theta)
        assert np.all((rho.value > 0.3) & (rho.value <= 1.0 + rho.error))


def test_narrow_lobes_and_small_sources_are_never_a_silent_zero() -> None:
    """A lobe of 1e-3 and a disk of 1e-3 degrees: the mirror direction on the disk's centre gives its radiance times f_0."""
    source = make_source("disk", theta=0.8, phi=0.0, half_angle=math.radians(5.0), radiance=1.0)
    p = -math.tan(0.4)
    for alpha in (1e-2, 1e-3, 1e-4):
        mirror = gonio.reflectance_map(make_brdf("ggx", k_s=1.0, alpha=alpha, f_0=1.0), source, p, 0.0, rtol=1e-6)
        assert float(mirror.value) == pytest.approx(1.0, abs=0.1 if alpha == 1e-2 else 2e-3)
    tiny = make_source("disk", theta=0.8, phi=0.0, half_angle=math.radians(1e-3), irradiance=1.0)
    beam = make_source("collimated", theta=0.8, phi=0.0, irradiance=1.0)
    rough = make_brdf("ggx", k_s=1.0, alpha=0.1, f_0=1.0)
    disk_value, beam_value = (float(gonio.reflectance_map(rough, s, p, 0.0).value) for s in (tiny, beam))
    assert disk_value == pytest.approx(beam_value, rel=1e-6)


def test_plan_skips_what_a_scene_does_not_need() -> None:
    scene = make_source("collimated", theta=0.1, phi=0.0, irradiance=0.0) + SOURCES["sky"] + SOURCES["disk"]
    methods = [step.method for step in plan(satin(0.1) + make_brdf("specular", rho=0.5), scene)]
    assert methods == [
        Method.ZERO, Method.LAMBERT, Method.LAMBERT,
        Method.ZERO, Method.RADIAL, Method.GENERAL,
        Method.ZERO, Method.MIRROR, Method.MIRROR,
    ]  # fmt: skip
    below = make_source("disk", theta=math.pi, phi=0.0, half_angle=0.01, radiance=1.0)
    got = gonio.reflectance_map(satin(0.1), below, 0.0, 0.0)
    assert float(got.value) == 0.0 and sum(step.effort.evaluations for step in got.plan) == 0


def test_extreme_gradients_are_finite() -> None:
    p = np.array([0.0, 1e-300, -1e-300, 1e8, -1e8, 1e150, math.inf])
    for source in (*SOURCES.values(), make_source("collimated", theta=0.5, phi=0.3, irradiance=1.0)):
        for q in (0.0, 1.0):
            got = gonio.reflectance_map(satin(0.1), source, p, q, rtol=1e-4)
            assert np.all(np.isfinite(got.value)) and np.all(got.value >= 0) and np.all(np.isfinite(got.error))


def test_bad_input_is_told() -> None:
    with pytest.raises(GeometryError):
        gonio.reflectance_map(WHITE, SOURCES["sky"], math.nan, 0.0)
    with pytest.raises(GeometryError):
        gonio.reflectance_map(WHITE, SOURCES["sky"], math.inf, math.inf)
    with pytest.raises(ParameterError, match="rtol"):
        gonio.reflectance_map(WHITE, SOURCES["sky"], 0.0, 0.0, rtol=0.0)
    with pytest.raises(ParameterError, match="hemispherical"):
        make_source("hemisferical", radiance=1.0)
    with pytest.raises(ParameterError, match="radiance"):
        make_source("uniform", radiance=-1.0)
    with pytest.raises(ParameterError, match="either"):
        make_source("disk", theta=0.1, phi=0.0, half_angle=0.1)


def test_a_tolerance_out_of_reach_says_what_was_reached() -> None:
    """A sky in steps defeats a smooth rule; the error says so, and covers the truth, which is a sum of hemispheres' caps.

    Cells find the steps, but are tried for a few gradients only.
    """
    steps = Source([Cap("steps", (0.6, 0.0, 0.8), math.pi / 2, 1.0, lambda u: np.floor(7.3 * u))])
    truth = sum(1.0 - (k / 7.3) ** 2 for k in range(1, 8))  # cos theta_i integrated where u > k / 7.3
    found = gonio.reflectance_map(WHITE, steps, -0.75, 0.0, rtol=1e-10)
    assert abs(float(found.value) - truth) <= float(found.error) <= 1e-10 * truth
    with pytest.raises(IntegrationError, match="asked for") as caught:
        gonio.reflectance_map(WHITE, steps, np.full(257, -0.75), 0.0, rtol=1e-10)
    best = caught.value.best
    assert isinstance(best, MapValues)
    assert np.all(np.abs(best.value - truth) <= best.error) and np.all(best.error < 0.1)
