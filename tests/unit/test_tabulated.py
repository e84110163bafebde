"""Tables: coordinates, interpolation, regression from scattered samples. Truths are analytic models at other points."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import gonio
from gonio import formats
from gonio.brdf import scattered, tabulated
from gonio.brdf.tabulated import SHAPE, TabulatedBRDF, from_brdf, node_directions, tabulate
from gonio.errors import DatasetError
from gonio.halfdiff import half_difference
from gonio.samples import BRDFSamples

REAL = Path(__file__).parents[1] / "data" / "optics-blacks" / "AnoBlackEC1onAlum.bsdf"


def material(alpha: float = 0.2) -> gonio.BRDF:
    return gonio.brdf.make("lambertian", albedo=0.3) + gonio.brdf.make("ggx", k_s=1.0, alpha=alpha, f_0=0.05)


def directions(n: int, seed: int, reach_deg: float = 75.0, lobe: float = 0.5) -> tuple[np.ndarray, ...]:
    """Angles a rig can reach: half of them around the mirror direction, none nearer than 8 degrees to the lamp."""
    rng = np.random.default_rng(seed)
    limit, found = math.radians(reach_deg), []
    while len(found) < n:
        theta_i, theta_r, delta = rng.uniform(0, limit), rng.uniform(0, limit), rng.uniform(0, 2 * np.pi)
        if rng.random() < lobe:
            theta_r = min(abs(theta_i + math.radians(20) * rng.standard_normal()), limit)
            delta = np.pi + 0.3 * rng.standard_normal()
        cosine = math.cos(theta_i) * math.cos(theta_r) + math.sin(theta_i) * math.sin(theta_r) * math.cos(delta)
        if cosine < math.cos(math.radians(8)):
            found.append((theta_i, theta_r, delta))
    return tuple(np.array(found).T)


def measured(truth: gonio.BRDF, n: int, seed: int, noise: float = 0.01) -> BRDFSamples:
    theta_i, theta_r, delta = directions(n, seed)
    f = truth.f_r(theta_i, 0.0, theta_r, delta)
    u = noise * f + 1e-4
    rng = np.random.default_rng(seed + 1000)
    return BRDFSamples.plain(theta_i, 0.0, theta_r, np.mod(delta, 2 * np.pi), f + u * rng.standard_normal(n), u)


@pytest.fixture(scope="module")
def scan_table() -> TabulatedBRDF:
    return tabulate(measured(material(), 330, seed=1))


def test_grid_position_of_the_nodes_is_their_number() -> None:
    """Angles of the nodes, turned into directions by another module, come back as even steps."""
    omega_i, omega_r, below = node_directions(SHAPE)
    inside = ~below
    inside[0], inside[:, 0] = False, False  # there phi_d has no meaning
    position = scattered.grid_position(omega_i[inside], omega_r[inside], SHAPE, tabulated.SCALE)
    np.testing.assert_allclose(position, np.argwhere(inside), atol=1e-6)


def test_coordinates_against_half_difference_angles() -> None:
    rng = np.random.default_rng(4)
    theta_i, theta_r = np.arccos(rng.uniform(0.05, 1, (2, 500)))
    wi = gonio.geometry.unit_vector(theta_i, 0.0)
    wr = gonio.geometry.unit_vector(theta_r, rng.uniform(0, 2 * np.pi, 500))
    theta_h, _, theta_d, phi_d = half_difference(wi, wr)
    position = scattered.grid_position(wi, wr, (2, 2, 2), 0.05)
    folded = np.abs(np.mod(phi_d + np.pi / 2, np.pi) - np.pi / 2)
    np.testing.assert_allclose(0.05 * np.sinh(position[:, 0] * np.arcsinh(20.0)), np.tan(theta_h / 2), rtol=1e-12)
    np.testing.assert_allclose(position[:, 1], np.tan(theta_d / 2), rtol=1e-12)
    np.testing.assert_allclose(position[:, 2], np.tan(folded / 2), atol=1e-9)


@pytest.mark.parametrize(("alpha", "most"), [(0.4, 1e-3), (0.2, 1e-3), (0.05, 5e-3)])
def test_interpolation_between_the_nodes(alpha: float, most: float) -> None:
    """A table of a model, looked up between its nodes, up to 80 degrees."""
    truth = material(alpha)
    rng = np.random.default_rng(3)
    theta_i, theta_r = np.arccos(rng.uniform(math.cos(math.radians(80)), 1, (2, 4000)))
    phi_r = rng.uniform(0, 2 * np.pi, 4000)
    found = from_brdf(truth).brdf().f_r(theta_i, 0.0, theta_r, phi_r)
    assert np.abs(found / truth.f_r(theta_i, 0.0, theta_r, phi_r) - 1).max() < most


def test_nodes_are_reproduced() -> None:
    table = from_brdf(material())
    omega_i, omega_r, below = node_directions(table.shape, table.scale)
    found = table.brdf().evaluate(omega_i[~below], omega_r[~below])
    np.testing.assert_allclose(found, table.value[~below], rtol=1e-9)


def test_reciprocal_mirror_symmetric_isotropic_and_zero_below(scan_table: TabulatedBRDF) -> None:
    brdf = scan_table.brdf()
    rng = np.random.default_rng(8)
    theta_i, theta_r = np.arccos(rng.uniform(0, 1, (2, 300)))
    phi_r, turn = rng.uniform(0, 2 * np.pi, (2, 300))
    f = brdf.f_r(theta_i, 0.0, theta_r, phi_r)
    assert np.all(np.isfinite(f)) and np.all(f >= 0)
    np.testing.assert_allclose(brdf.f_r(theta_r, phi_r, theta_i, 0.0), f, rtol=1e-9)
    np.testing.assert_allclose(brdf.f_r(theta_i, 0.0, theta_r, -phi_r), f, rtol=1e-9)
    np.testing.assert_allclose(brdf.f_r(theta_i, turn, theta_r, phi_r + turn), f, rtol=1e-7)
    assert float(brdf.f_r(1.7, 0.0, 0.3, 0.0)) == 0.0
    assert float(brdf.f_r(0.3, 0.0, np.pi / 2 + 1e-12, 0.0)) == 0.0


def test_finite_at_the_ends_of_the_coordinates(scan_table: TabulatedBRDF) -> None:
    """theta_h = 0, theta_d = 0, both at once, and both directions grazing from opposite sides."""
    brdf, near = scan_table.brdf(), np.pi / 2 - 1e-9
    for theta_i, theta_r, phi_r in ((0, 0, 0), (0.7, 0.7, np.pi), (0.7, 0.7, 0), (near, near, np.pi), (near, near, 0)):
        assert math.isfinite(float(brdf.f_r(theta_i, 0.0, theta_r, phi_r)))


def test_table_from_a_scan_predicts_what_was_held_out(scan_table: TabulatedBRDF) -> None:
    """330 samples with 1 % noise; the table is asked at 1500 other directions within the scan's reach."""
    theta_i, theta_r, delta = directions(1500, seed=99)
    truth = material().f_r(theta_i, 0.0, theta_r, delta)
    found = scan_table.brdf().f_r(theta_i, 0.0, theta_r, delta)
    u = scan_table.u_brdf().f_r(theta_i, 0.0, theta_r, delta)
    relative, pull = np.abs(found / truth - 1), np.abs(found - truth) / u
    assert np.median(relative) < 0.01
    assert np.quantile(relative, 0.95) < 0.04
    assert 0.5 < np.quantile(pull, 0.683) < 1.3  # uncertainties neither shy nor bold
    assert np.quantile(pull, 0.95) < 2.5


def test_extrapolated_nodes_are_flagged_and_know_little(scan_table: TabulatedBRDF) -> None:
    omega_i, omega_r, _ = node_directions(scan_table.shape, scan_table.scale)
    theta_i, theta_r = np.arccos(omega_i[..., 2]), np.arccos(omega_r[..., 2])
    far = (np.minimum(theta_i, theta_r) > math.radians(84)) & (scan_table.coverage != tabulated.BELOW_HORIZON)
    assert np.all(scan_table.coverage[far] == tabulated.EXTRAPOLATED)
    assert np.median((scan_table.u / scan_table.value)[far]) > 0.5
    outer = scan_table.coverage == tabulated.EXTRAPOLATED
    truth = material().evaluate(omega_i, omega_r)
    pull = np.abs(scan_table.value - truth)[outer] / scan_table.u[outer]
    assert np.quantile(pull, 0.683) < 1.0


def test_measured_nodes_have_a_sample_in_their_cell(scan_table: TabulatedBRDF) -> None:
    counts = scan_table.counts()
    assert 200 < counts["measured"] <= 330 + sum(SHAPE)
    assert sum(counts.values()) == math.prod(SHAPE)
    assert counts["model"] == 0


def test_holes_come_from_the_model_that_fills() -> None:
    truth = material()
    table = tabulate(measured(truth, 150, seed=5), fill=truth)
    holes = table.coverage == tabulated.MODEL
    assert np.any(holes) and not np.any(table.coverage == tabulated.EXTRAPOLATED)
    omega_i, omega_r, _ = node_directions(table.shape, table.scale)
    np.testing.assert_array_equal(table.value[holes], truth.evaluate(omega_i[holes], omega_r[holes]))
    assert np.all(table.u[holes] > 0)


def test_noise_around_zero_and_five_decades() -> None:
    """A black mirror: the lobe reaches 10^2, the rest drowns in additive noise and is partly negative."""
    truth = gonio.brdf.make("lambertian", albedo=3e-4) + gonio.brdf.make("ggx", k_s=1.0, alpha=0.05, f_0=0.8)
    theta_i, theta_r, delta = directions(600, seed=21)
    f = truth.f_r(theta_i, 0.0, theta_r, delta)
    u = 0.01 * f + 5e-3
    noisy = f + u * np.random.default_rng(22).standard_normal(len(f))
    assert np.count_nonzero(noisy < 0) > 20 and f.max() / f.min() > 1e4
    table = tabulate(BRDFSamples.plain(theta_i, 0.0, theta_r, np.mod(delta, 2 * np.pi), noisy, u))
    assert np.all(np.isfinite(table.value)) and np.all(table.value >= 0)
    theta_i, theta_r, delta = directions(1000, seed=23)
    f, found = truth.f_r(theta_i, 0.0, theta_r, delta), table.brdf().f_r(theta_i, 0.0, theta_r, delta)
    dark, bright = f < 3e-3, f > 0.1
    assert np.median(np.abs(found - f)[dark]) < 2e-3  # below the noise of one sample
    assert abs(np.mean(found[dark]) - np.mean(f[dark])) < 2e-3  # and no bias upwards
    assert np.median(np.abs(found / f - 1)[bright]) < 0.05


def test_unknown_uncertainty_is_taken_from_the_scatter() -> None:
    truth = material()
    errors = []
    for noise in (0.003, 0.05):
        samples = measured(truth, 400, seed=31, noise=noise)
        plain = BRDFSamples.plain(samples.theta_i, 0.0, samples.theta_r, samples.phi_r, samples.f_r)
        table = tabulate(plain)
        inner = table.coverage == tabulated.INTERPOLATED
        errors.append(float(np.median((table.u / table.value)[inner])))
    assert errors[1] > 3 * errors[0]
    assert 0.01 < errors[1] < 0.15


def test_real_measurement_predicts_what_was_held_out() -> None:
    """Anodised black, four incidences, no uncertainties in the file."""
    samples = formats.read_samples(REAL)
    out = np.random.default_rng(6).random(len(samples)) < 0.1
    table = tabulate(samples.select(~out))
    rest = samples.select(out)
    found = table.brdf().evaluate(rest.omega_i(), rest.omega_r())
    u = table.u_brdf().evaluate(rest.omega_i(), rest.omega_r())
    assert np.median(np.abs(found / rest.f_r - 1)) < 0.06
    assert np.quantile(np.abs(found - rest.f_r) / u, 0.683) < 1.3


def test_many_samples_are_binned() -> None:
    truth = material()
    rng = np.random.default_rng(12)
    theta_i, theta_r = np.arccos(rng.uniform(0.1, 1, (2, 60_000)))
    phi_r = rng.uniform(0, 2 * np.pi, 60_000)
    f = truth.f_r(theta_i, 0.0, theta_r, phi_r)
    samples = BRDFSamples.plain(theta_i, 0.0, theta_r, phi_r, f * (1 + 0.1 * rng.standard_normal(60_000)), 0.1 * f)
    table = tabulate(samples)
    rough = truth.f_r(theta_i[:1000], 0.0, theta_r[:1000], phi_r[:1000])
    found = table.brdf().f_r(theta_i[:1000], 0.0, theta_r[:1000], phi_r[:1000])
    assert np.median(np.abs(found / rough - 1)) < 0.03  # from samples of 10 % each


def test_progress_reaches_its_end() -> None:
    seen: list[tuple[int, int]] = []
    tabulate(measured(material(), 40, seed=2), shape=(12, 10, 6), progress=lambda done, total: seen.append((done, total)))
    assert seen[0][0] == 0 and seen[-1][0] == seen[-1][1]
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)


def test_what_cannot_become_a_table() -> None:
    few = measured(material(), 11, seed=1)
    with pytest.raises(DatasetError, match="at least 12 samples, there are 11"):
        tabulate(few)
    dark = measured(material(), 40, seed=1)
    dark = BRDFSamples.plain(dark.theta_i, 0.0, dark.theta_r, dark.phi_r, -dark.f_r)
    with pytest.raises(DatasetError, match="none of the 40 samples is positive"):
        tabulate(dark)
    with pytest.raises(DatasetError, match="at least 4 nodes"):
        tabulate(few, shape=(3, 10, 10))


def test_few_samples_still_give_a_table() -> None:
    table = tabulate(measured(material(), 12, seed=1))
    assert np.all(np.isfinite(table.value))


def test_lobe_width_follows_the_roughness() -> None:
    widths = [from_brdf(material(alpha)).brdf().terms[0].lobe_width() for alpha in (0.05, 0.1, 0.2)]
    assert all(w is not None for w in widths)
    # half of GGX's peak is at tan(theta_h) = alpha sqrt(sqrt(2) - 1) = 0.64 alpha; a node further at most
    for width, alpha in zip(widths, (0.05, 0.1, 0.2), strict=True):
        assert width is not None and 0.5 * alpha < width < 1.0 * alpha
    assert from_brdf(gonio.brdf.make("lambertian", albedo=0.5)).brdf().terms[0].lobe_width() == 1.0


def test_tables_add_and_scale_as_brdfs_do() -> None:
    table = from_brdf(material()).brdf()
    both = 0.5 * table + gonio.brdf.make("lambertian", albedo=0.2)
    expected = 0.5 * float(table.f_r(0.5, 0, 0.3, 2.0)) + 0.2 / math.pi
    assert float(both.f_r(0.5, 0, 0.3, 2.0)) == pytest.approx(expected, rel=1e-12)


def test_node_angles_are_dense_where_the_lobe_is() -> None:
    """Eight nodes at least within the half width of any lobe, from a broad one to a tenth of a degree."""
    for alpha in (0.3, 0.1, 0.01, 0.002):
        table = from_brdf(material(alpha))
        theta_h, theta_d, phi_d = table.nodes()
        half_width = math.atan(alpha * math.sqrt(math.sqrt(2.0) - 1.0))
        assert np.count_nonzero(theta_h < half_width) >= 4
        assert theta_h[0] == 0 and theta_h[-1] == pytest.approx(np.pi / 2)
        assert theta_d[-1] == pytest.approx(np.pi / 2) and phi_d[-1] == pytest.approx(np.pi / 2)


@pytest.mark.parametrize("alpha", [0.05, 0.01, 0.002])
def test_lobe_of_a_tenth_of_a_degree_between_the_nodes(alpha: float) -> None:
    truth = material(alpha)
    rng = np.random.default_rng(5)
    theta_i = rng.uniform(0, math.radians(75), 3000)
    theta_r = np.clip(theta_i + alpha * rng.standard_normal(3000), 0, math.radians(80))
    phi_r = np.pi + alpha * rng.standard_normal(3000)
    found, expected = from_brdf(truth).brdf().f_r(theta_i, 0, theta_r, phi_r), truth.f_r(theta_i, 0, theta_r, phi_r)
    assert expected.max() / expected.min() > 100
    assert np.abs(found / expected - 1).max() < 6e-3


def test_once_differentiable_across_the_cells() -> None:
    """Along a line through many cells a kink would be a jump of the first difference; here they shrink with the step."""
    brdf = from_brdf(material(0.05), (24, 16, 8)).brdf()
    x = np.linspace(0.05, 1.3, 20_001)
    f = np.log(brdf.f_r(0.6, 0.0, x, np.pi + 0.1 + 0.2 * x))
    slope = np.diff(f) / np.diff(x)
    jump, finer = np.abs(np.diff(slope)).max(), np.abs(np.diff(slope[::4])).max()
    assert finer / jump > 3.0  # a kink's jump would not depend on the step


def test_coverage_at_any_direction(scan_table: TabulatedBRDF) -> None:
    omega_i, omega_r, below = node_directions(scan_table.shape, scan_table.scale)
    inside = ~below
    inside[0], inside[:, 0] = False, False  # there phi_d has no meaning
    found = scan_table.coverage_at(omega_i[inside], omega_r[inside])
    np.testing.assert_array_equal(found, scan_table.coverage[inside])
    up, down = np.array([0.0, 0.0, 1.0]), np.array([0.6, 0.0, -0.8])
    assert int(scan_table.coverage_at(up, down)) == tabulated.BELOW_HORIZON
    near = np.array([math.sin(1.56), 0.0, math.cos(1.56)])
    assert int(scan_table.coverage_at(near, near * [-1, 1, 1])) == tabulated.EXTRAPOLATED


def test_samples_of_a_table_leave_out_what_was_not_measured(scan_table: TabulatedBRDF) -> None:
    samples = scan_table.samples()
    counts = scan_table.counts()
    assert 0 < len(samples) <= counts["measured"] + counts["interpolated"]
    found = scan_table.brdf().evaluate(samples.omega_i(), samples.omega_r())
    np.testing.assert_allclose(found, samples.f_r, rtol=1e-8)
