"""``gonio models``: every model in one line, one model in full, its lobe as characters and as a picture."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path

import numpy as np
import pytest

import gonio
from gonio.brdf import families
from gonio.cli.main import main
from gonio.report import lobe


def test_the_list_has_one_line_for_each_model(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["models"]) == 0
    lines = capsys.readouterr().out.splitlines()
    for name, family in families.FAMILIES.items():
        (line,) = (l for l in lines if l.split()[:1] == [name])
        model = family.model()
        assert line.split()[1:3] == ["R" if model.reciprocal else "-", "E" if model.energy_bounded else "-"]
        assert all(p.name in line for p in model.parameters) and all(key in line for key in family.choices)


def test_one_model_in_full(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["models", "oren_nayar[variant=full]", "--plot", str(tmp_path / "new" / "lobe.png")]) == 0
    told = capsys.readouterr().out
    for words in ("sigma_deg    0 to 90 deg", "uniform 0 to 51.57 deg", "full (this one)", "Source: Oren & Nayar"):
        assert words in told, words
    assert "directional albedo can exceed 1" in told and "theta_i [deg]: a 10, b 45, c 75" in told
    assert max(map(len, told.splitlines())) < 160
    head = (tmp_path / "new" / "lobe.png").read_bytes()[:24]
    width, height = struct.unpack(">II", head[16:])
    assert head[:8] == b"\x89PNG\r\n\x1a\n" and width > 900 and height > 400
    assert main(["models", "ggx", "--json"]) == 0
    alpha = json.loads(capsys.readouterr().out)["models"]["ggx"]["parameters"]["alpha"]
    assert (alpha["lower"], alpha["upper"], alpha["prior"][0]) == (1e-4, 1.0, "log_normal")


@pytest.mark.parametrize("name", families.FAMILIES)
def test_every_model_can_be_explained(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["models", name]) == 0
    told = capsys.readouterr()
    assert "Source: " in told.out and told.err == "" and "\\" not in told.out and told.out.isascii()
    page = told.out.partition("\n\n")[2]
    assert all(page.count(a) == page.count(b) for a, b in ("()", "{}"))
    assert ("Radius: log f_r" in told.out) == (not families.find(name).model().delta)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["specular", "--plot", "x.png"], "delta function"),
        (["--plot", "x.png"], "name it"),
        (["ggx", "--plot", "x.pdf"], "no .png file"),
        (["ggx[variant=x]"], "variant"),
        (["ggx+phong"], "one model at a time: gonio models ggx"),
    ],
)
def test_what_cannot_be_drawn_is_told(arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["models", *arguments]) == 2
    assert words in capsys.readouterr().err


def test_the_picture_in_characters_is_to_scale() -> None:
    """Lambert's surface is a half circle; a mirror-like lobe points where the law of reflection says, the lamp opposite."""
    matt = lobe.text(gonio.brdf.make("lambertian", albedo=0.3 * math.pi), [math.radians(30)]).splitlines()
    rows = 19
    found = [(x / 38 - 1, 1 - y / rows) for y, line in enumerate(matt[:rows]) for x, c in enumerate(line) if c == "a"]
    radius = math.log10(0.3) + 1  # between 1e-1 at the centre and 1e0 at the rim
    assert found and np.hypot(*np.transpose(found)) == pytest.approx(np.full(len(found), radius), abs=0.04)

    gloss = lobe.text(gonio.brdf.make("phong", k_s=1.0, n=2000.0), [math.radians(30)]).splitlines()
    lit = [(x / 38 - 1, 1 - y / rows) for y, line in enumerate(gloss[:rows]) for x, c in enumerate(line) if c == "a"]
    far = max(lit, key=lambda at: math.hypot(*at))
    assert math.degrees(math.atan2(*far)) == pytest.approx(30, abs=4)
    (lamp,) = [(x / 38 - 1, 1 - y / rows) for y, line in enumerate(gloss[:rows]) for x, c in enumerate(line) if c == "A"]
    assert math.degrees(math.atan2(*lamp)) == pytest.approx(-30, abs=4)


def test_the_plane_of_incidence_has_its_mirror_side_positive() -> None:
    brdf = gonio.brdf.make("ggx", k_s=1.0, alpha=0.1, f_0=0.5)
    got = lobe.in_plane(brdf, 0.6, np.array([-0.6, 0.6]))
    assert got == pytest.approx([float(brdf.f_r(0.6, 0.0, 0.6, 0.0)), float(brdf.f_r(0.6, 0.0, 0.6, math.pi))], rel=1e-14)
    assert lobe.decades(np.array([0.0, np.inf, 3e-9, 2.0])) == (-5, 1) and lobe.decades(np.zeros(3)) == (-1, 0)
