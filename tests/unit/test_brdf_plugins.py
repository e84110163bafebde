"""Models of other packages, by entry points; and docs/howto-add-a-model.md, every line of it."""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import gonio
from gonio import jit
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


@jit.model
def _undefined(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float, p: list[float]) -> float:
    return nowhere(p[0])  # type: ignore[name-defined, no-any-return]  # noqa: F821


@jit.model
def _logarithm(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float, p: list[float]) -> float:
    return math.log(p[0])


@jit.model
def _of_six(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float) -> float:
    return 0.1


def _share(**given: Any) -> Parameter:
    return Parameter(**{"name": "a", "lower": 0.0, "upper": 1.0, "doc": "", "prior": ("uniform", 0.0, 1.0), **given})


def _declared(function: Any, *parameters: Parameter) -> Model:
    return Model(name="mine", parameters=parameters or (_share(),), function=function, doc="", reference="")


@pytest.mark.parametrize(
    ("mistake", "words"),
    [
        (lambda: _share(lower=1.0), "range 1 to 1 is none"),
        (lambda: _share(prior=("normal", 0.0, 1.0)), "its prior .* is not known; write"),
        (lambda: _share(name="a b"), "used as a keyword"),
        (lambda: _share(default=3.0), r"a = 3 is outside \[0, 1\]; choose"),
        (lambda: _declared(_of_six), "takes seven arguments"),
        (lambda: _declared(_logarithm, _share(), _share()), "two parameters of one name"),
        (lambda: gonio.brdf.make(_declared(_logarithm), a=0.5), r"mine: f_r = -0.69\d+ 1/sr at omega_i"),
        (lambda: gonio.brdf.make(_declared(_logarithm), a=0.0), "mine: f_r = -inf 1/sr"),
        (lambda: gonio.brdf.make(_declared(_undefined), a=0.5), "not compile, NameError: name 'nowhere' is not defined"),
        (lambda: gonio.brdf.make(3), "named by its name"),
        (lambda: gonio.brdf.make("tabulated"), "is read from a file"),
    ],
)
def test_mistakes_of_a_first_model_are_one_sentence(mistake: Callable[[], object], words: str) -> None:
    with pytest.raises(ParameterError, match=words) as told:
        mistake()
    assert "\n" not in str(told.value)


def test_errors_over_models_that_are_not_gonios_own_are_estimates() -> None:
    matt = _declared(_constant)
    albedo = gonio.directional_albedo(gonio.brdf.make(matt, a=0.5), 0.3)
    assert float(albedo.value) == pytest.approx(0.5, rel=1e-6) and not albedo.error_is_bound
    own = gonio.brdf.make(gonio.brdf.parse("oren_nayar[variant=full]")[0], albedo=0.5, sigma=0.2)
    assert not own.terms[0].model.own


@jit.model
def _constant(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float, p: list[float]) -> float:
    return p[0] / math.pi if (zi > 0.0) & (zr > 0.0) else 0.0
