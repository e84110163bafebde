"""Reflectance maps as things to use, against Lambert's cosine, its conics, and functions whose values are known."""

from __future__ import annotations

import dataclasses
import doctest
import json
import math
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import gonio
from gonio.cli.map import map_
from gonio.errors import DatasetError, GeometryError, ParameterError
from gonio.maps import ReflectanceMap, compute, gradients_of_heights, gradients_of_normals
from gonio.maps.images import read_heights, write_image
from gonio.maps.interpolation import Interpolant

ALBEDO, THETA, PHI = 0.8, math.radians(35.0), math.radians(40.0)
P_S, Q_S = -math.tan(THETA) * math.cos(PHI), -math.tan(THETA) * math.sin(PHI)  # the gradient that faces the source
AXIS = np.linspace(-3.0, 3.0, 97)


def cosine(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Lambert's law in gradient space (memo, 14a) for an irradiance of pi: R = albedo cos theta_i."""
    top = 1 + P_S * p + Q_S * q
    return ALBEDO * np.maximum(0.0, top / np.sqrt((1 + p * p + q * q) * (1 + P_S**2 + Q_S**2)))


@pytest.fixture(scope="module")
def lit() -> ReflectanceMap:
    lamp = gonio.source.make("collimated", theta=THETA, phi=PHI, irradiance=math.pi)
    return compute(gonio.brdf.make("lambertian", albedo=ALBEDO), lamp, AXIS, AXIS)[0]


@pytest.fixture(scope="module")
def from_file(lit: ReflectanceMap, tmp_path_factory: pytest.TempPathFactory) -> ReflectanceMap:
    return ReflectanceMap.load(lit.save(tmp_path_factory.mktemp("maps") / "map.nc"))


def somewhere(n: int = 4000, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    p, q = np.random.default_rng(seed).uniform(-3.0, 3.0, (2, n))
    return p, q


# --- between the points of the grid -------------------------------------------------------------------------------------


def test_cubics_are_interpolated_exactly_on_uneven_axes() -> None:
    rng = np.random.default_rng(3)
    p, q = np.sort(rng.uniform(-2, 2, 15)), np.sort(rng.uniform(0, 5, 9))
    c = rng.normal(size=(4, 4))
    at_p, at_q = rng.uniform(p[0], p[-1], 500), rng.uniform(q[0], q[-1], 500)
    of = np.polynomial.polynomial
    value, slope, error = Interpolant(p, q, of.polygrid2d(q, p, c)[None], np.zeros((1, 9, 15)))(at_p, at_q)
    scale = np.abs(of.polygrid2d(q, p, c)).max()
    assert value[:, 0] == pytest.approx(of.polyval2d(at_q, at_p, c), abs=1e-12 * scale)
    assert slope[:, 0, 0] == pytest.approx(of.polyval2d(at_q, at_p, of.polyder(c, axis=1)), abs=1e-10 * scale)
    assert slope[:, 0, 1] == pytest.approx(of.polyval2d(at_q, at_p, of.polyder(c, axis=0)), abs=1e-10 * scale)
    assert np.all(error < 1e-9 * scale)


@pytest.mark.parametrize("points", [5, 6, 9, 33, 257])
def test_the_error_of_interpolation_covers_smooth_functions_kinks_and_jumps(points: int) -> None:
    axis = np.linspace(-3.0, 3.0, points)
    p, q = somewhere()
    for seed in range(12):
        a, b, c = np.random.default_rng(seed).normal(size=3)

        def smooth(x: np.ndarray, y: np.ndarray, a: float = a, b: float = b, c: float = c) -> np.ndarray:
            return np.cos(0.7 * a * x + 0.6 * b * y + c) / np.sqrt(1 + 0.2 * x * x + 0.2 * y * y)

        def kink(x: np.ndarray, y: np.ndarray, a: float = a, b: float = b, c: float = c) -> np.ndarray:
            return np.maximum(0.0, a * x + b * y + c) * (1 + 0.05 * x)

        def jump(x: np.ndarray, y: np.ndarray, a: float = a, b: float = b, c: float = c) -> np.ndarray:
            return np.where(a * x + b * y > c, 1.0, 0.0)

        for function in (smooth, kink, jump):
            grid = function(axis[None, :], axis[:, None])
            value, _, error = Interpolant(axis, axis, grid[None], np.zeros_like(grid[None]))(p, q)
            off = np.abs(value[:, 0] - function(p, q))
            # a kink or jump that passes between border points can leave the differences blind; there it is one in thousands
            assert np.mean(off <= error[:, 0] + 1e-13) > (0.995 if function is not smooth else 0.9999)


def test_evaluate_is_exact_with_a_scene_and_honest_without(lit: ReflectanceMap, from_file: ReflectanceMap) -> None:
    p, q = somewhere()
    exact = lit.evaluate(p, q)
    assert exact.value == pytest.approx(cosine(p, q), rel=1e-12) and exact.error_is_bound
    assert float(lit.evaluate(40.0, -90.0).value) == pytest.approx(float(cosine(np.array(40.0), np.array(-90.0))), rel=1e-12)
    for got in (from_file.evaluate(p, q), lit.evaluate(p, q, method="interpolate")):
        off = np.abs(got.value - cosine(p, q))
        assert np.all(off <= got.error) and not got.error_is_bound
        assert np.median(off) < 1e-6 and np.median(got.error) < 1e-4
    on_grid = from_file.evaluate(AXIS[None, :], AXIS[:, None])
    assert on_grid.value == pytest.approx(from_file.value, abs=1e-15) and on_grid.value.shape == (97, 97)
    again = dataclasses.replace(from_file, brdf=lit.brdf, source=lit.source)
    assert float(again.evaluate(0.1, 0.2).value) == float(lit.evaluate(0.1, 0.2).value)


def test_what_evaluate_refuses(lit: ReflectanceMap, from_file: ReflectanceMap) -> None:
    with pytest.raises(GeometryError, match=r"p = 3\.5 is outside.*-3 to 3"):
        from_file.evaluate([0.0, 3.5], 0.0)
    for one in (lit, from_file):
        with pytest.raises(GeometryError, match="NaN"):
            one.evaluate(0.0, math.nan)
    with pytest.raises(ParameterError, match="brdf and source"):
        from_file.evaluate(0.0, 0.0, method="integrate")
    with pytest.raises(ParameterError, match="method"):
        lit.evaluate(0.0, 0.0, method="guess")  # type: ignore[arg-type]
    falling = dataclasses.replace(from_file, p=AXIS[::-1])
    with pytest.raises(DatasetError, match="increasing"):
        falling.evaluate(0.0, 0.0)


def test_a_file_keeps_everything_but_the_scene(lit: ReflectanceMap, tmp_path: Path) -> None:
    full = dataclasses.replace(
        lit, band=np.stack((0.9 * lit.value, 1.1 * lit.value)), impulses=((0.1, 0.2, 3.0),), attributes={"a": "b"},
        band_error=1e-3 * lit.value, band_whole=np.stack((0.8 * lit.value, 1.2 * lit.value)),
    )  # fmt: skip
    got = ReflectanceMap.load(full.save(tmp_path / "m.nc"))
    for name in ("p", "q", "value", "error", "band", "band_error", "band_whole"):
        assert np.array_equal(getattr(got, name), getattr(full, name))
    assert (got.impulses, got.sources, got.attributes) == (full.impulses, full.sources, full.attributes)
    assert lit.sources[0] == pytest.approx((P_S, Q_S)) and lit.has_scene and not got.has_scene
    (tmp_path / "broken.nc").write_bytes(b"not a map")
    for name in ("broken.nc", "missing.nc"):
        with pytest.raises(DatasetError, match=name):
            ReflectanceMap.load(tmp_path / name)


# --- contours -----------------------------------------------------------------------------------------------------------


def off_conic(line: np.ndarray, level: float) -> np.ndarray:
    """14a: (1 + p_s p + q_s q)^2 = k^2 (1 + p^2 + q^2), a conic; k = level / albedo sqrt(1 + p_s^2 + q_s^2)."""
    p, q = line.T
    k = level / ALBEDO * math.sqrt(1 + P_S**2 + Q_S**2)
    return (1 + P_S * p + Q_S * q) / np.sqrt(1 + p * p + q * q) - k


def test_contours_of_lambert_s_cosine_are_conics(lit: ReflectanceMap, from_file: ReflectanceMap) -> None:
    wanted = [0.1, 0.4, 0.6, 0.75, 0.799]
    for one, accuracy in ((lit, 1e-12), (from_file, 2e-5)):
        lines = one.contours(wanted)
        assert list(lines) == wanted
        for level, pieces in lines.items():
            assert pieces and all(np.abs(off_conic(piece, level)).max() < accuracy for piece in pieces)
    # theta_i = const is a cone around the source: an ellipse if it stays in front of the image plane
    ellipse = lit.contours([0.75])[0.75]
    assert len(ellipse) == 1 and np.array_equal(ellipse[0][0], ellipse[0][-1])
    around = ellipse[0] - (P_S, Q_S)
    assert abs(np.sum(np.diff(np.unwrap(np.arctan2(around[:, 1], around[:, 0]))))) == pytest.approx(2 * math.pi)


def test_vertices_on_a_sharp_contour_move_onto_it() -> None:
    """On 17 x 17 points marching squares misses the conic by 1e-2; the vertices end on it."""
    lamp = gonio.source.make("collimated", theta=THETA, phi=PHI, irradiance=math.pi)
    axis = np.linspace(-3, 3, 17)
    coarse, _ = compute(gonio.brdf.make("lambertian", albedo=ALBEDO), lamp, axis, axis)
    on_grid = dataclasses.replace(coarse, brdf=None, source=None)
    exact, rough = (
        np.abs(np.concatenate([off_conic(x, 0.7) for x in m.contours([0.7])[0.7]])).max() for m in (coarse, on_grid)
    )
    assert exact < 1e-11 and 1e-6 < rough < 2e-2


def test_contours_where_there_are_few(lit: ReflectanceMap) -> None:
    assert lit.contours([5.0]) == {5.0: []}
    evenly = list(lit.contours(3))
    assert evenly == pytest.approx(np.linspace(0, lit.value.max(), 5)[1:-1])
    flat = ReflectanceMap(AXIS, AXIS, np.full((97, 97), 0.5), np.zeros((97, 97)))
    assert flat.contours() == {}
    assert dataclasses.replace(flat, value=np.full((97, 97), np.nan)).contours() == {}
    mirror, _ = compute(gonio.brdf.make("specular", rho=1.0), gonio.source.make("hemispherical", radiance=1.0), AXIS, AXIS)
    (circle,) = mirror.contours([0.5])[0.5]
    assert np.hypot(*circle.T) == pytest.approx(np.ones(len(circle)), abs=AXIS[1] - AXIS[0])  # 15c: p^2 + q^2 = 1
    holes = dataclasses.replace(lit, value=np.where(AXIS[None, :] > 0, np.nan, lit.value), brdf=None, source=None)
    assert all(np.all(piece[:, 0] <= 1e-9) for piece in holes.contours([0.4])[0.4])
    for levels in (0, 1001, [math.nan], np.linspace(0, 1, 1001)):
        with pytest.raises(ParameterError, match="levels"):
            lit.contours(levels)


# --- images -------------------------------------------------------------------------------------------------------------


def hemisphere(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Heights and gradients of a ball of radius 1 on the square |x|, |y| <= 0.6."""
    x = np.linspace(-0.6, 0.6, n)[None, :]
    z = np.sqrt(1 - x * x - x.T * x.T)
    return x, z, -x / z, -x.T / z


def test_image_of_a_ball(lit: ReflectanceMap, from_file: ReflectanceMap) -> None:
    """Normals give R on the analytic gradient; heights give it to the second order of their differences."""
    x, z, p, q = hemisphere(41)
    normals = 7.0 * np.stack(np.broadcast_arrays(x, x.T, z), axis=-1)
    assert lit.render_normals(normals).value == pytest.approx(cosine(p, q), abs=1e-13)
    got = from_file.render_normals(normals)
    off = np.abs(got.value - cosine(p, q))
    assert np.all(off <= got.error) and off.max() < 1e-3
    worst = []
    for n in (41, 81):
        x, z, p, q = hemisphere(n)
        got = lit.render_heights(z, 1.2 / (n - 1))
        assert np.all(got.error < 1e-12)
        worst.append(np.abs(got.value - cosine(p, q)).max())
    assert worst[0] < 1e-2 and 3.0 < worst[0] / worst[1] < 5.0


def test_a_paraboloid_has_exact_differences_in_either_order_of_rows(lit: ReflectanceMap) -> None:
    x, y = np.linspace(-1, 1, 9)[None, :], np.linspace(0, 3, 13)[:, None]
    z = 0.3 * x * x - 0.2 * y * y + 0.1 * x * y + 0.5 * y
    p, q = np.broadcast_arrays(0.6 * x + 0.1 * y, -0.4 * y + 0.1 * x + 0.5)
    assert lit.render_heights(z, (0.25, 0.25)).value == pytest.approx(cosine(p, q), abs=1e-13)
    assert lit.render_heights(z[::-1], (0.25, -0.25)).value == pytest.approx(cosine(p, q)[::-1], abs=1e-13)
    assert np.array(gradients_of_heights(1000 * z, 250.0)) == pytest.approx(np.array([p, q]), abs=1e-12)


def test_what_is_not_seen_is_nan(lit: ReflectanceMap, from_file: ReflectanceMap) -> None:
    normals = np.array([[0, 0, 1.0], [1.0, 0, 0], [0, 0, -1.0], [np.nan, 0, 1], [0, np.inf, 1], [0, 0, 0], [-8.0, 0, 2.0]])
    got = lit.render_normals(normals)
    assert np.isnan(got.value).tolist() == [False, True, True, True, True, True, False]
    assert got.value[[0, 6]] == pytest.approx(cosine(np.array([0.0, 4.0]), np.zeros(2)))
    assert np.isnan(from_file.render_normals(normals).value).tolist() == [False] + 6 * [True]  # p = 4 is off the map
    z = np.zeros((7, 7))
    z[3, 3] = np.nan
    assert np.isnan(lit.render_heights(z, 1.0).value).sum() == 5
    assert lit.render_normals(np.zeros((0, 3))).value.shape == (0,)


def test_what_surfaces_must_be() -> None:
    for z in (np.zeros((2, 5)), np.zeros(9), np.zeros((3, 3, 3))):
        with pytest.raises(GeometryError, match="3 rows"):
            gradients_of_heights(z, 1.0)
    for spacing in (0.0, math.nan, (1.0, 0.0), (1.0, 2.0, 3.0)):
        with pytest.raises(GeometryError, match="spacing"):
            gradients_of_heights(np.zeros((4, 4)), spacing)
    with pytest.raises(GeometryError, match="infinite"):
        gradients_of_heights(np.full((4, 4), np.inf), 1.0)
    with pytest.raises(GeometryError, match="three components"):
        gradients_of_normals(np.zeros((3, 2)))


@pytest.mark.parametrize(("suffix", "accuracy"), [(".npy", 0.0), (".tiff", 1e-7)])
def test_heights_and_images_in_files(tmp_path: Path, suffix: str, accuracy: float) -> None:
    z = hemisphere(11)[1]
    z[0, 0] = np.nan
    assert read_heights(write_image(tmp_path / f"z{suffix}", z)) == pytest.approx(z, abs=accuracy, nan_ok=True)
    (tmp_path / f"bad{suffix}").write_bytes(b"neither")
    (tmp_path / f"empty{suffix}").write_bytes(b"")
    for name in ("bad", "empty", "missing"):
        with pytest.raises(DatasetError, match=name):
            read_heights(tmp_path / f"{name}{suffix}")
    write_image(tmp_path / "line.npy", z[0])
    with pytest.raises(DatasetError, match="one plane"):
        read_heights(tmp_path / "line.npy")
    with pytest.raises(DatasetError, match="png"):
        write_image(tmp_path / "z.png", z)


def test_gonio_map_renders_heights(lit: ReflectanceMap, tmp_path: Path) -> None:
    scene = f"""[brdf]
model = "lambertian"
lambertian.albedo = {ALBEDO}
[[source]]
kind = "collimated"
theta_deg = {math.degrees(THETA)}
phi_deg = {math.degrees(PHI)}
irradiance = {math.pi}
[grid]
n = 9
"""
    (tmp_path / "scene.toml").write_text(scene)
    z = hemisphere(21)[1]
    for suffix, accuracy in ((".npy", 1e-12), (".tiff", 2e-5)):  # 32-bit heights have differences of 24 bits less a few
        write_image(tmp_path / f"z{suffix}", z)
        command = [
            str(tmp_path / "scene.toml"),
            "--out",
            str(tmp_path / "ball.nc"),
            "--render",
            str(tmp_path / f"z{suffix}"),
        ]
        told = CliRunner().invoke(map_, [*command, "--spacing", "0.06,-0.06", "--json"])
        assert told.exit_code == 0 and json.loads(told.stdout)["pixels_without_surface"] == 0
        image = read_heights(tmp_path / f"ball_image{suffix}")
        assert image == pytest.approx(lit.render_heights(z, (0.06, -0.06)).value, abs=accuracy)
        for spacing in ([], ["--spacing", "wide"], ["--spacing", "1,2,3"]):
            refused = CliRunner().invoke(map_, [*command, *spacing]).exception
            assert isinstance(refused, ParameterError) and "--spacing" in str(refused)


def test_the_page_on_photometric_stereo_prints_what_it_says() -> None:
    page = Path(__file__).parents[2] / "docs" / "photometric-stereo.md"
    failed, tried = doctest.testfile(str(page), module_relative=False, verbose=False)
    assert failed == 0 and tried > 15


# --- computing ----------------------------------------------------------------------------------------------------------


def test_band_is_the_quantiles_of_the_draws(lit: ReflectanceMap) -> None:
    assert lit.brdf is not None and lit.source is not None
    albedos = np.random.default_rng(5).normal(0.5, 0.02, 400)
    draws = [gonio.brdf.make("lambertian", albedo=a) for a in albedos]
    done: list[int] = []
    made, _ = compute(lit.brdf, lit.source, AXIS[::12], AXIS[::16], draws=draws, progress=done.append)
    assert made.band is not None and made.band_error is not None
    assert done == sorted(done) and done[-1] == 400
    low, high = np.quantile(albedos, (0.16, 0.84)) / ALBEDO
    assert made.band[0] == pytest.approx(low * made.value, rel=1e-9, abs=1e-15)
    assert made.band[1] == pytest.approx(high * made.value, rel=1e-9, abs=1e-15)
    assert np.all(made.band_error <= 1e-4 * made.value)
    with pytest.raises(ParameterError, match="two axes"):
        compute(lit.brdf, lit.source, AXIS[:1], AXIS)
