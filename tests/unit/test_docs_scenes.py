"""The scenes of docs/scenes.md, run as they are printed; their values against formulas of one line."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from gonio.cli.main import main
from gonio.maps import ReflectanceMap

PAGE = (Path(__file__).parents[2] / "docs" / "scenes.md").read_text(encoding="utf-8")
SCENES = re.findall(r"(?ms)^```toml\n(.*?)^```", PAGE)


def run(scene: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> ReflectanceMap:
    rows, columns = np.mgrid[0.5:8, 0.5:16]
    sky = (1.0 + np.cos(np.pi * rows / 8) + 0.1 * np.cos(np.pi * columns / 8)).astype(np.float32)
    cv2.imwrite(str(folder / "sky.hdr"), np.repeat(np.maximum(sky, 0.0)[:, :, None], 3, axis=2))
    (folder / "scene.toml").write_text(scene, encoding="utf-8")
    assert main(["map", str(folder / "scene.toml"), "--out", str(folder / "map.nc"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    made = ReflectanceMap.load(folder / "map.nc")
    assert told["largest"] == made.value.max() > 0
    return made


@pytest.mark.parametrize("number", range(len(SCENES)))
def test_a_printed_scene_runs_and_meets_its_tolerance(
    number: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = run(SCENES[number], tmp_path, capsys)
    rtol = float((re.findall(r"rtol = (\S+)", SCENES[number]) or ["1e-6"])[0])
    assert np.all(made.error <= rtol * made.value + 1e-13 * made.value.max())


def scene_with(text: str) -> str:
    (found,) = [scene for scene in SCENES if text in scene]
    return found


def test_the_page_shows_every_kind_of_source() -> None:
    from gonio.config.sources import SOURCES

    assert {kind for scene in SCENES for kind in re.findall(r'kind = "(\w+)"', scene)} == set(SOURCES)


def test_the_small_lamp_falls_with_the_square_of_its_distance(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = run(scene_with('"point"'), tmp_path, capsys)
    # I / r^2 = 0.25 / 0.25 = 1 from (0.6, 0, 0.8); a flat white surface shows cos theta_i / pi
    assert made.value[16, 16] == pytest.approx(0.8 / np.pi, rel=1e-12)
    assert made.sources[0] == pytest.approx((-0.75, 0.0))


def test_the_viewer_sees_only_what_faces_him(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = run(scene_with("[viewer]"), tmp_path, capsys)
    p, q = np.meshgrid(made.p, made.q)
    length = np.sqrt(1 + p * p + q * q)
    facing = (-q * np.sin(np.radians(50)) + np.cos(np.radians(50))) / length > 0
    # memo, 14c, for a sky about z: (1 + cos theta_n) / 2, whoever looks at a Lambertian surface
    np.testing.assert_allclose(made.value, np.where(facing, 0.5 * (1 + 1 / length), 0.0), rtol=1e-9)
    assert made.viewer == pytest.approx((np.radians(50), np.pi / 2))


def test_the_harmonics_are_those_described(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = run(scene_with("coefficients"), tmp_path, capsys)
    # L = 1 + a z + b x with a = sqrt(3 / 4 pi), b = a / 2; a white surface of normal n shows (1 / pi) of the irradiance:
    # integral of (1 + g.w) (n.w) over the hemisphere of n = pi + (2 pi / 3) g.n
    p, q = np.meshgrid(made.p, made.q)
    a = np.sqrt(3 / (4 * np.pi))
    along = (a - 0.5 * a * p) / np.sqrt(1 + p * p + q * q)
    np.testing.assert_allclose(made.value, 1 + 2 / 3 * along, rtol=2e-6)
