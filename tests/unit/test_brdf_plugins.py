"""Models of other packages, by entry points; and docs/howto-add-a-model.md, every line of it."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import gonio
from gonio.brdf import Model, Parameter
from gonio.brdf.plugins import GROUP
from gonio.errors import ParameterError

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "howto-add-a-model.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE, flags=re.DOTALL)


def install(folder: Path, project: str, *, name: str | None = None) -> None:
    """What pip leaves behind of a package with these entry points."""
    table = tomllib.loads(project)["project"]
    package = name or table["name"]
    info = folder / f"{package}-{table['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: {table['version']}\n")
    lines = [f"[{GROUP}]", *(f"{key} = {value}" for key, value in table["entry-points"][GROUP].items())]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")


def run(folder: Path, *arguments: str, code: int = 0) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join((str(folder), str(ROOT)))}
    done = subprocess.run([sys.executable, *arguments], env=environment, capture_output=True, text=True, cwd=folder)
    assert done.returncode == code, done.stdout[-2000:] + done.stderr[-2000:]
    return done


@pytest.fixture(scope="module")
def chalk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("chalk")
    (folder / "chalk.py").write_text(blocks("python")[0], encoding="utf-8")
    return folder


def test_the_page_runs_as_it_stands(chalk: Path, tmp_path: Path) -> None:
    (tmp_path / "page.md").write_text(PAGE, encoding="utf-8")
    script = (
        "import doctest, sys; failed, run = doctest.testfile(sys.argv[1], module_relative=False); "
        "sys.exit(failed or run < 12)"
    )
    run(chalk, "-c", script, str(tmp_path / "page.md"))


def test_an_installed_model_has_its_name_everywhere(chalk: Path, tmp_path: Path) -> None:
    install(tmp_path, blocks("toml")[0])
    (tmp_path / "chalk.py").write_text((chalk / "chalk.py").read_text())
    script = """
import sys, gonio, math
assert "chalk" not in sys.modules
gonio.brdf.make("lambertian", albedo=0.5)
assert "chalk" not in sys.modules  # not imported before it is asked for
brdf = gonio.brdf.make("chalk", albedo=0.8, b=0.5) + gonio.brdf.make("ggx", k_s=1, alpha=0.3, f_0=0.04)
assert gonio.brdf.parse("chalk+ggx")[0] is brdf.terms[0].model and brdf.terms[0].model.own
assert "chalk" in gonio.brdf.models() and list(brdf.parameters())[:2] == ["chalk.albedo", "chalk.b"]
estimate = gonio.directional_albedo(brdf, 0.2, rtol=1e-5)
assert estimate.error_is_bound is False
print(float(gonio.brdf.make("chalk", albedo=0.8, b=0.0).f_r(0.1, 0, 0.2, 0)) * math.pi)
"""
    assert float(run(tmp_path, "-c", script).stdout) == pytest.approx(0.8, rel=1e-15)
    told = json.loads(run(tmp_path, "-m", "gonio.cli.main", "models", "chalk", "--json").stdout)
    assert list(told["models"]["chalk"]["parameters"]) == ["albedo", "b"]


_BROKEN = """
[project]
name = "broken"
version = "2.0"
[project.entry-points."gonio.brdf_models"]
torn = "torn:MODEL"
plain = "plain:f"
other = "plain:MODEL"
ggx = "plain:MODEL"
twice = "plain:MODEL"
"""


def test_broken_models_of_others_are_told_and_do_no_harm(tmp_path: Path) -> None:
    install(tmp_path, _BROKEN)
    install(tmp_path, _BROKEN.replace("plain:MODEL", "plain:SECOND"), name="second")
    (tmp_path / "torn.py").write_text("raise RuntimeError('no licence')\n")
    (tmp_path / "plain.py").write_text(
        "import gonio\ndef f(): pass\nMODEL = SECOND = gonio.brdf.models()['lambertian']\n"
    )
    script = """
import gonio
for name in ("torn", "plain", "other", "twice", "plane"):
    try:
        gonio.brdf.make(name, x=1.0)
    except gonio.errors.ParameterError as exc:
        print(exc)
print(sorted(gonio.brdf.models()) == sorted(gonio.brdf.families.FAMILIES), gonio.brdf.make("ggx", k_s=1, alpha=1, f_0=1))
"""
    torn, plain, other, twice, plane, harmless = run(tmp_path, "-c", script).stdout.splitlines()
    assert torn.startswith("package broken 2.0") and "RuntimeError: no licence; repair" in torn
    assert "loads a function; let it load" in plain
    assert "there are several BRDF models 'other', by package" in other and "there are several" in twice
    assert "did you mean 'plain'" in plane and harmless.startswith("True ggx")
    listed = run(tmp_path, "-m", "gonio.cli.main", "models")
    assert "lambertian" in listed.stdout and listed.stderr.count("warning: package") >= 2


def test_a_function_that_is_not_compiled_is_told() -> None:
    with pytest.raises(ParameterError, match="mine: its function is not compiled; decorate it with"):
        Model("mine", (Parameter("a", 0.0, 1.0, "", ("uniform", 0.0, 1.0)),), lambda *a: 0.0, "", "")


def test_a_model_needs_no_name_to_be_made() -> None:
    own = gonio.brdf.models()["lambertian"]
    assert gonio.brdf.make(own, albedo=0.3).parameters() == {"lambertian.albedo": 0.3}
