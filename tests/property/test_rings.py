"""Maps under radiance fields: against the general quadrature, a product rule written here, each other, and rotations."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from numpy.typing import NDArray

import gonio
from gonio.brdf.tabulated import from_brdf
from gonio.fields import Field
from gonio.geometry import gradient_from_normal, unit_vector
from gonio.integrate import scene_radiance
from gonio.integrate.plan import Method
from gonio.integrate.quadrature import Effort
from gonio.integrate.rings import scene_of
from gonio.integrate.spectrum import spectrum
from tests.independent import reflected_radiance

make_source, make_brdf = gonio.source.make, gonio.brdf.make
Array = NDArray[np.float64]
LOBES = {"amplitude": [1.0, 2.0, 0.5, 3.0], "kappa": [100.0, 30.0, 8.0, 60.0],
         "theta": [0.3, 1.0, 2.0, 0.8], "phi": [0.0, 2.0, 4.0, 5.5]}  # fmt: skip
SKY = make_source("uniform", radiance=0.2) + make_source("lobes", **LOBES)
CENTRES = (np.arange(32) + 0.5) * np.pi / 32
GRID = SKY.radiance(unit_vector(CENTRES[:, None], (np.arange(64) + 0.5)[None, :] * np.pi / 32))
SOURCES = {
    "lobes": SKY,
    "function": gonio.source.Source.from_callable(SKY.radiance),
    "smooth": make_source("environment_map", radiance=GRID, interpolation="smooth"),
    "bilinear": make_source("environment_map", radiance=GRID),
    "harmonics": make_source("spherical_harmonics", coefficients=[3.0, 0.5, 0.6, 0.2, 0.1, 0.0, 0.3, 0.2, 0.1]),
}
AXIS = np.linspace(-3.0, 3.0, 33)


def brdf(alpha: float) -> gonio.BRDF:
    return make_brdf("lambertian", albedo=0.5) + make_brdf("ggx", k_s=1.0, alpha=alpha, f_0=0.04)


def product_rule(material: gonio.BRDF, source: gonio.source.Source, p: float, q: float, n: int = 300) -> float:
    """What a user would write, about the normal: Gauss in cos theta_i, trapezoid in azimuth."""
    x, w = np.polynomial.legendre.leggauss(n)
    z, phi = 0.5 * (x + 1.0), 2.0 * np.pi * (np.arange(2 * n) + 0.5) / (2 * n)
    s = np.sqrt(1.0 - z**2)
    local = np.stack(np.broadcast_arrays(s[:, None] * np.cos(phi), s[:, None] * np.sin(phi), z[:, None]), axis=-1)
    local = local.reshape(-1, 3)
    normal = np.array([-p, -q, 1.0]) / math.sqrt(1.0 + p * p + q * q)
    tangent = np.cross([0.0, 1.0, 0.0], normal)
    tangent /= np.linalg.norm(tangent)
    frame = np.stack((tangent, np.cross(normal, tangent), normal))
    f_r = material.evaluate(local, np.broadcast_to(frame[:, 2], local.shape))
    return float(np.sum(np.repeat(0.5 * w * z, 2 * n) * (np.pi / n) * f_r * source.radiance(local @ frame)))


@pytest.mark.parametrize("name", SOURCES)
@pytest.mark.parametrize("alpha", [0.3, 0.05])
def test_maps_keep_their_promise(name: str, alpha: float) -> None:
    """A grid goes through the table, a few gradients through single sums with 1000 times the accuracy."""
    grid = gonio.reflectance_map(brdf(alpha), SOURCES[name], AXIS[None, :], AXIS[:, None], rtol=1e-6)
    assert any(step.method is Method.RINGS for step in grid.plan)
    rows, columns = np.random.default_rng(1).integers(0, 33, (2, 12))
    truth = gonio.reflectance_map(brdf(alpha), SOURCES[name], AXIS[columns], AXIS[rows], rtol=1e-9)
    off = np.abs(grid.value[rows, columns] - truth.value)
    assert np.all(off <= grid.error[rows, columns] + truth.error)
    assert np.all(off <= 1e-6 * truth.value)


@pytest.mark.parametrize("name", SOURCES)
def test_against_the_general_quadrature(name: str) -> None:
    """The general rule shares neither nodes nor the waves of the field with the rings."""
    theta_n, phi_n = np.array([0.0, 0.6, 1.2]), np.array([0.0, 2.0, 5.0])
    rtol = 1e-5 if name == "bilinear" else 1e-7
    rings = gonio.reflectance_map(brdf(0.2), SOURCES[name], *gradient_from_normal(theta_n, phi_n), rtol=rtol)
    nodes = scene_radiance(brdf(0.2), SOURCES[name], theta_n, phi_n, rtol=rtol)
    assert np.all(np.abs(rings.value - nodes.value) <= rings.error + nodes.error)
    assert np.all(np.abs(rings.value - nodes.value) <= 2.0 * rtol * nodes.value)


@pytest.mark.parametrize("name", ["lobes", "smooth", "harmonics"])
def test_against_a_plain_product_rule(name: str) -> None:
    for p, q in ((0.4, -0.2), (-1.5, 0.8)):
        truth = product_rule(brdf(0.3), SOURCES[name], p, q)
        got = gonio.reflectance_map(brdf(0.3), SOURCES[name], p, q, rtol=1e-8)
        assert float(got.value) == pytest.approx(truth, rel=2e-6 if name == "smooth" else 1e-8)


def test_turning_the_field_turns_the_map() -> None:
    turn = 0.7
    turned = make_source("lobes", **(LOBES | {"phi": [phi + turn for phi in LOBES["phi"]]}))
    theta_n, phi_n = np.random.default_rng(2).uniform(0.0, 1.3, 200), np.linspace(0.0, 6.0, 200)
    first = gonio.reflectance_map(brdf(0.1), make_source("lobes", **LOBES), *gradient_from_normal(theta_n, phi_n), rtol=1e-7)
    second = gonio.reflectance_map(brdf(0.1), turned, *gradient_from_normal(theta_n, phi_n + turn), rtol=1e-7)
    assert np.all(np.abs(first.value - second.value) <= first.error + second.error)
    assert np.all(np.abs(first.value - second.value) <= 2e-7 * first.value)


@pytest.mark.parametrize("interpolation", ["bilinear", "smooth"])
def test_a_constant_map_is_a_uniform_source(interpolation: str) -> None:
    constant = make_source("environment_map", radiance=np.full((8, 16), 2.0), interpolation=interpolation)
    p, q = np.array([0.0, 0.5, -2.0, 10.0]), np.array([0.0, -0.3, 1.0, 4.0])
    white = make_brdf("lambertian", albedo=1.0)
    got = gonio.reflectance_map(white, constant, p, q, rtol=1e-10)
    assert np.max(np.abs(got.value - 2.0)) <= 1e-10
    satin = brdf(0.3)
    uniform = gonio.reflectance_map(satin, make_source("uniform", radiance=2.0), p, q, rtol=1e-10)
    got = gonio.reflectance_map(satin, constant, p, q, rtol=1e-9)
    assert np.all(np.abs(got.value - uniform.value) <= got.error + uniform.error)


def test_a_narrow_lobe_is_a_beam() -> None:
    """kappa = 1e5: half a degree wide; as a beam of its irradiance, 2 pi a / kappa, up to the square of its width."""
    lobe = make_source("lobes", amplitude=1.0, kappa=1e5, theta=0.6, phi=1.0)
    beam = make_source("collimated", theta=0.6, phi=1.0, irradiance=2.0 * np.pi / 1e5)
    p, q = np.array([0.2, -1.0, -0.3]), np.array([-0.4, -0.3, -0.8])
    rough = make_brdf("ggx", k_s=1.0, alpha=0.3, f_0=0.5)
    wide, narrow = (gonio.reflectance_map(rough, s, p, q, rtol=1e-6).value for s in (lobe, beam))
    assert np.all(wide > 0.0) and np.allclose(wide, narrow, rtol=1e-3)


def test_the_series_of_the_narrowest_lobe_stops_at_rounding() -> None:
    """Panels halved for digits that its values do not have would take gigabytes."""
    lobe = make_source("lobes", amplitude=1.0, kappa=1e5, theta=1.9797, phi=4.13).parts[0]
    assert isinstance(lobe, Field)
    assert spectrum(lobe, 1e-14).series.nbytes < 1 << 27


@pytest.mark.parametrize(("theta_n", "waves"), [(0.1, 300), (1.0, 1025)])
def test_every_wave_has_its_digits(theta_n: float, waves: int) -> None:
    """K_m of a diffuse surface has a closed form, and a_m and b_m of a bilinear map are hats on rings and linear between.

    The last waves oscillate 100 times along a ring and across: sums with too few nodes show there.
    """
    part = SOURCES["bilinear"].parts[0]
    assert isinstance(part, Field)
    scene = scene_of(make_brdf("lambertian", albedo=1.0).terms[0], part, 1e-6, Effort(), 1)
    sums = scene.sums(np.array([math.tan(theta_n / 2)]), 13.0, waves)[0, :2]
    # Gauss's rule from row to row and between tangent rings, t = a + (b - a) (1 - cos s) / 2, which has no square roots
    x, w = np.polynomial.legendre.leggauss(600)
    s, w = 0.5 * math.pi * (x + 1.0), 0.5 * math.pi * w
    rows = np.concatenate(([0.0], CENTRES, [math.pi]))
    edges = np.unique(np.concatenate((rows, [math.pi / 2 - theta_n, math.pi / 2 + theta_n])))
    m = np.arange(waves)
    transform = np.fft.fft(GRID, axis=1)[:, m % 64] / 64 * np.exp(-1j * math.pi * m / 64) * np.sinc(m / 64) ** 2
    transform = np.concatenate((transform[:1], transform, transform[-1:])) * np.where(m == 0, 1.0, 2.0)
    truth = np.zeros((2, waves))
    for a, b in itertools.pairwise(edges[edges <= math.pi / 2 + theta_n]):
        t, dt = a + 0.5 * (b - a) * (1.0 - np.cos(s)), 0.5 * (b - a) * np.sin(s) * w
        row = np.searchsorted(rows, 0.5 * (a + b)) - 1
        share = (t - rows[row]) / (rows[row + 1] - rows[row])
        even, odd = np.cos(t) * math.cos(theta_n), np.sin(t) * math.sin(theta_n)  # cos theta_i = even + odd cos D
        reach = np.arccos(np.clip(-even / odd, -1.0, 1.0))[:, None]
        # 2 / pi times the integral of (even + odd cos D) cos mD from 0 to reach; sin(m reach) / m by sinc
        k_m = even[:, None] * np.sinc(m * reach / math.pi)
        k_m += 0.5 * odd[:, None] * (np.sinc((m - 1) * reach / math.pi) + np.sinc((m + 1) * reach / math.pi))
        total = (2.0 / math.pi * reach * k_m) * (np.sin(t) * dt)[:, None]
        for one, part_of_it in ((transform[row], 1.0 - share), (transform[row + 1], share)):
            wave = (part_of_it @ total) * one
            truth += np.stack((wave.real, -wave.imag))
    assert np.max(np.abs(sums - truth)) < 1e-13 * truth[0, 0]


def test_the_result_does_not_depend_on_threads() -> None:
    one, two = (
        gonio.reflectance_map(brdf(0.1), SKY, AXIS[None, :], AXIS[:, None], rtol=1e-5, threads=n).value for n in (1, 2)
    )
    assert np.array_equal(one, two)


@pytest.mark.parametrize("n", [0.5, 1.5, 1000.0])
def test_broken_powers_and_sharp_lobes_against_independent_values(n: float) -> None:
    """A lobe that begins at its cut as a broken power, where rules for polynomials agree with each other on what is wrong.

    And one sharp enough that two low orders agree by chance.
    """
    term = {"model": "phong", "k_s": 0.5, "n": n}
    part = {"kind": "spherical_harmonics", "coefficients": [3.0, 0.4, 0.9, -0.5, 0.3, -0.2, 0.35, 0.15, -0.25]}
    p = np.concatenate(([0.3, -1.2, -0.35], np.linspace(-2.0, 2.0, 9)))  # as many as rings take
    q = np.concatenate(([-0.5, 0.8, -0.1], np.linspace(0.1, 1.9, 9)))
    scenes = [{"brdf": [term], "source": [part], "p": p[k], "q": q[k]} for k in range(3)]
    truth = np.array([reflected_radiance(scene, "normal", 1e-11) for scene in scenes])
    light = make_source("spherical_harmonics", coefficients=part["coefficients"])
    for rtol in (1e-3, 1e-6, 1e-9):
        got = gonio.reflectance_map(make_brdf("phong", k_s=0.5, n=n), light, p, q, rtol=rtol)
        assert all(step.method is Method.RINGS for step in got.plan)
        off = np.abs(got.value[:3] - truth) - 2e-11 * truth
        assert np.all(off <= got.error[:3]) and np.all(off <= rtol * truth)


def test_a_sharp_lobe_on_paper_against_independent_values() -> None:
    """Errors of tables are differences of sums, which see nothing that these have in common: too few rings for the lobe."""
    part = {"kind": "lobes", "amplitude": 2.0, "kappa": 1e4, "theta": 0.7, "phi": 1.0}
    grid_p, grid_q = np.meshgrid(np.linspace(-0.6, 0.4, 11), np.linspace(-0.55, 0.3, 11))
    p, q = np.append(grid_p, [0.3, -0.35]), np.append(grid_q, [-0.5, -0.1])
    scenes = [
        {"brdf": [{"model": "lambertian", "albedo": 0.3}], "source": [part], "p": p[k], "q": q[k]} for k in (-2, -1)
    ]
    truth = np.array([reflected_radiance(scene, "normal", 1e-11) for scene in scenes])
    for rtol in (1e-3, 1e-6):
        got = gonio.reflectance_map(make_brdf("lambertian", albedo=0.3), make_source(**part), p, q, rtol=rtol)
        off = np.abs(got.value[-2:] - truth) - 2e-11 * truth
        assert np.all(off <= got.error[-2:]) and np.all(off <= rtol * truth)


@pytest.mark.parametrize(
    ("term", "steepest"), [({"model": "lambertian", "albedo": 0.3}, 9.0), ({"model": "phong", "k_s": 0.5, "n": 50.0}, 1.5)]
)
def test_pixels_far_darker_than_the_brightest_against_independent_values(term: dict[str, object], steepest: float) -> None:
    """Waves cancel where the lobe of light has set, or its mirror image is far: no digit of such a sum would be left."""
    part = {"kind": "lobes", "amplitude": 2.0, "kappa": 100.0, "theta": 0.7, "phi": 1.0}
    p, q = (a.ravel() for a in np.meshgrid(*[np.linspace(-0.6 * steepest, steepest, 12)] * 2))
    material = make_brdf(**{"name": term["model"]} | {k: v for k, v in term.items() if k != "model"})
    got = gonio.reflectance_map(material, make_source(**part), p, q, rtol=1e-6, atol=1e-30)
    rows = np.argsort(np.where(got.value > 1e-24, got.value, np.inf))[[0, 5, 15, 25]]
    scenes = [{"brdf": [term], "source": [part], "p": p[k], "q": q[k]} for k in rows]
    truth = np.array([reflected_radiance(scene, "normal", 1e-10) for scene in scenes])
    assert 0.0 < truth[0] < 1e-9 * got.value.max()
    off = np.abs(got.value[rows] - truth) - 2e-10 * truth
    assert np.all(off <= got.error[rows]) and np.all(off <= 1e-6 * truth)
    assert np.all(got.error <= 1.0001e-6 * got.value + 1e-30)


def test_a_table_under_a_field() -> None:
    """A table has borders at which no derivative but the first is continuous: sums converge slowly there."""
    table = from_brdf(brdf(0.2)).brdf()
    grid = gonio.reflectance_map(table, SOURCES["harmonics"], AXIS[None, 8:25], AXIS[8:25, None], rtol=1e-5)
    cells = scene_radiance(table, SOURCES["harmonics"], np.arctan(AXIS[20]), np.array([0.0, np.pi]), rtol=3e-5)
    off = np.abs(grid.value[8, [4, 12]] - cells.value)  # q = 0, p = -0.75 and 0.75
    assert np.all(off <= grid.error[8, [4, 12]] + cells.error)
    assert np.all(off <= 4e-5 * cells.value)


@pytest.mark.parametrize(("kappa", "rtol"), [(1e4, 1e-3), (3.0, 1e-6)])
def test_a_table_costs_no_more_than_what_it_is_for(kappa: float, rtol: float) -> None:
    """Seen in a light as narrow as 1e4, a table takes a thousand slopes; of 100 gradients each is summed by itself then."""
    clay = make_brdf("oren_nayar", albedo=0.8, sigma=0.35)
    lamp = make_source("lobes", amplitude=1.0, kappa=kappa, theta=0.7, phi=1.0)
    p, q = np.random.default_rng(5).uniform(-2.0, 2.0, size=(2, 110))
    few, more = (gonio.reflectance_map(clay, lamp, p[:n], q[:n], rtol=rtol).plan[0].effort.evaluations for n in (96, 110))
    assert more < 2.0 * few
