"""``gonio map`` and ``gonio models``: what they print is what was done, in the user's units."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

import gonio
from gonio.brdf import families
from gonio.cli.main import main
from gonio.cli.units import fit_options
from gonio.errors import ConfigurationError
from gonio.maps import ReflectanceMap

SURFACE = '[brdf]\nmodel = "lambertian+ggx"\nalbedo = 0.5\nk_s = 1\nalpha = 0.3\nf_0 = 0.04\n'
LIGHT = """
[[source]]
kind = "collimated"
theta_deg = 60
phi_deg = 0
[[source]]
kind = "collimated"
theta_deg = 10
phi_deg = 0
irradiance = 0
[[source]]
kind = "disk"
theta_deg = 45
phi_deg = 90
half_angle_deg = 5
radiance = 2
[[source]]
kind = "hemispherical"
[[source]]
kind = "lobes"
amplitude = [1, 2]
kappa = [4, 8]
theta_deg = [10, 70]
phi_deg = [0, 120]
"""
GRID = "[grid]\nn = 41\np = [-4, 4]\nq = [-4, 4]\nrtol = 1e-4\n"


def explained(
    text: str, folder: Path, capsys: pytest.CaptureFixture[str], *options: str
) -> tuple[str, dict[str, list[str]]]:
    """What is printed, and the cells of its table by first column."""
    (folder / "scene.toml").write_text(text, encoding="utf-8")
    assert main(["map", str(folder / "scene.toml"), "--out", str(folder / "map.nc"), "--explain", *options]) == 0
    told = capsys.readouterr().out
    rows = [re.split(r" {3,}", line.strip()) for line in told.splitlines() if " ms" in line[-6:]]
    return told, {row[0]: row[1:] for row in rows}


def test_every_pair_has_a_row_that_says_what_was_skipped(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told, rows = explained(SURFACE + LIGHT + GRID, tmp_path, capsys)
    lights = ["collimated", "collimated 2", "disk", "hemispherical", "lobes"]
    assert list(rows) == [f"{term} x {light}" for term in ("lambertian", "ggx") for light in lights] + ["sum"]
    assert rows["ggx x collimated"][0] == "closed form 14a"
    assert rows["lambertian x hemispherical"][0] == "closed form of a diffuse surface"
    assert rows["ggx x hemispherical"][0] == "one-dimensional in theta_n"
    assert rows["lambertian x collimated 2"][:3] == ["skipped", "everything", "0"]
    p, q = np.meshgrid(np.linspace(-4, 4, 41), np.linspace(-4, 4, 41))
    # sin 60 (-p) + cos 60 <= 0: the beam is at or below the surface's horizon
    behind = np.mean(-p * math.sin(math.pi / 3) + 0.5 <= 0)
    assert rows["ggx x collimated"][1] == f"{100 * behind:.0f} % back-facing"
    height = np.degrees(np.arcsin(np.sqrt(0.5) * (1 - q) / np.sqrt(1 + p * p + q * q)))  # of the disk's centre
    gone, cut = np.mean(height <= -5), np.mean(np.abs(height) < 5)
    assert rows["ggx x disk"][1] == f"{100 * gone:.0f} % back-facing, {100 * cut:.0f} % cut by horizon"
    made = ReflectanceMap.load(tmp_path / "map.nc")
    assert float(rows["sum"][1]) == pytest.approx(np.max(made.error / made.value), rel=0.06)
    assert all(float(row[-2]) <= float(rows["sum"][1]) for row in rows.values())
    assert "closed form 14a: a beam" in told and "1.0e-04 was asked for" in told and "kernels" in told


def test_what_faces_away_from_the_viewer_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = SURFACE + '[[source]]\nkind = "uniform"\n[viewer]\ntheta_deg = 90\nphi_deg = 0\n' + GRID.replace("41", "40")
    told, _ = explained(text, tmp_path, capsys)
    assert "50 % of the gradients face away from the viewer" in told and "No light reaches" not in told
    made = ReflectanceMap.load(tmp_path / "map.nc")
    assert np.all((made.value > 0) == (made.p[None, :] < 0))


def test_a_narrow_terminal_cuts_nothing_off(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    told, _ = explained(SURFACE + LIGHT + GRID, tmp_path, capsys)
    assert "lambertian x hemispherical" in told and "one-dimensional in theta_n" in told and "…" not in told


def test_files_of_the_scene_and_of_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = SURFACE + '[[source]]\nkind = "uniform"\n[grid]\nn = 9\n'
    file = tmp_path / "scene.toml"
    file.write_text(text)
    assert main(["map", str(file)]) == 2 and "give --out MAP.nc" in capsys.readouterr().err
    file.write_text(text + '[output]\nmap = "new/map.nc"\nplot = "new/map.png"\n')
    assert main(["map", str(file), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert Path(told["map"]) == tmp_path / "new" / "map.nc" and Path(told["plot"]).read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert main(["map", str(file), "--plot", str(tmp_path / "map.gif")]) == 2
    assert ".png" in capsys.readouterr().err
    assert main(["map", str(file), "--out", str(file / "map.nc")]) == 6
    assert "cannot be written" in capsys.readouterr().err


def test_a_grain_is_turned_with_the_surface_and_kept_in_the_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """f_r = (1 + x_i^2) / pi, brighter for light along the grain, whoever looks: one line gives a flat surface's R."""

    def brushed(omega_i: np.ndarray, omega_r: np.ndarray) -> np.ndarray:
        return np.where((omega_i[:, 2] > 0) & (omega_r[:, 2] > 0), (1 + omega_i[:, 0] ** 2) / np.pi, 0.0)

    (term,) = gonio.brdf.from_function(brushed, name="brushed", isotropic=False).terms
    monkeypatch.setitem(families.FAMILIES, "brushed", families.Family("brushed", lambda: term.model))
    file = tmp_path / "scene.toml"
    text = '[brdf]\nmodel = "brushed"\n[[source]]\nkind = "collimated"\ntheta_deg = 60\nphi_deg = 100\n[grid]\nn = 3\n'
    file.write_text(text)
    assert main(["map", str(file), "--out", str(tmp_path / "map.nc")]) == 2
    assert "rotation_deg = 0 under [surface]" in capsys.readouterr().err
    for viewer in ("", "[viewer]\ntheta_deg = 40\nphi_deg = 10\n"):
        file.write_text(text + "[surface]\nrotation_deg = 70\n" + viewer)
        assert main(["map", str(file), "--out", str(tmp_path / "map.nc")]) == 0
        made = ReflectanceMap.load(tmp_path / "map.nc")
        # cos 60 (1 + sin^2 60 cos^2(100 - 70)) / pi
        assert made.value[1, 1] == pytest.approx(0.5 * (1 + 0.75 * 0.75) / math.pi, rel=1e-12)
        assert made.tangent == pytest.approx(math.radians(70)) and (made.viewer is None) == (not viewer)
        whole = dataclasses.replace(
            made, brdf=gonio.BRDF([term]), source=gonio.source.make("collimated", theta=math.pi / 3, phi=math.radians(100))
        )
        np.testing.assert_allclose(whole.evaluate(made.p[None, :], made.q[:, None]).value, made.value, rtol=1e-12)


def test_angles_of_a_fit_are_written_in_degrees() -> None:
    angles = {"oren_nayar.sigma", "shared.arm"}
    options = fit_options(
        {
            "free": ("ggx.k_s", "oren_nayar.sigma_deg"), "fix": {"shared.arm_deg": 90.0, "ggx.alpha": 0.2}, "max_steps": 5,
            "priors": {"oren_nayar.sigma_deg": ("uniform", 0.0, 180.0), "ggx.f_0": ("uniform", 0.0, 1.0)},
        }, angles,
    )  # fmt: skip
    assert options["free"] == ("ggx.k_s", "oren_nayar.sigma") and options["max_steps"] == 5
    assert options["fix"] == pytest.approx({"shared.arm": math.pi / 2, "ggx.alpha": 0.2})
    assert options["priors"]["oren_nayar.sigma"] == pytest.approx(("uniform", 0.0, math.pi))
    assert options["priors"]["ggx.f_0"] == ("uniform", 0.0, 1.0)
    # ln of an angle in radians is that of the angle in degrees, moved
    (_, mean, sd) = fit_options({"priors": {"shared.arm_deg": ("log_normal", math.log(90), 0.3)}}, angles)["priors"][
        "shared.arm"
    ]
    assert (mean, sd) == pytest.approx((math.log(math.pi / 2), 0.3))
    for key, value in (("fix", {"shared.arm": 1.0}), ("priors", {"shared.arm": ("uniform", 0.0, 1.0)})):
        with pytest.raises(ConfigurationError, match=r"shared\.arm has no unit; write shared\.arm_deg, in degrees"):
            fit_options({key: value}, angles)


def test_models_are_listed_as_a_scene_has_them(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["models", "oren_nayar"]) == 0
    told = capsys.readouterr().out
    assert re.search(r"sigma_deg +0 to 90 deg", told) and "qualitative" in told
    assert main(["models"]) == 0
    assert "albedo, sigma_deg" in capsys.readouterr().out
