"""The how-to of camera plug-ins, run as it stands, and what goes wrong with one."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

from gonio.config import default_documents, parse_rig
from gonio.errors import ConfigurationError, DeviceError
from gonio.rig import WallClock, opening

PAGE = (Path(__file__).parents[2] / "docs" / "howto-add-a-camera.md").read_text(encoding="utf-8")
CODE = re.findall(r"^```python\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
OPTIONS = re.findall(r"^```toml\n(\[camera\].*?)^```", PAGE, re.MULTILINE | re.DOTALL)[0]
NAME = re.search(r'^(\w+) = "(bench_camera:\w+)"', PAGE, re.MULTILINE)


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The page's package as if it were installed: its module and the metadata of its entry point."""
    assert NAME is not None
    (tmp_path / "bench_camera.py").write_text(CODE[0])
    folder = tmp_path / "bench_camera-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: bench-camera\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text(
        f"[gonio.cameras]\n{NAME[1]} = {NAME[2]}\nbroken = bench_camera:Missing\nnumber = builtins:dict\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    yield
    sys.modules.pop("bench_camera", None)


def rig(camera: str) -> str:
    """The default rig with real ports and another camera."""
    text = default_documents()["rig.toml"].replace('port = "sim"', 'port = "/dev/null"')
    return re.sub(r'^kind = "sim".*$', camera, text, flags=re.MULTILINE)


def test_the_page_runs_as_it_stands(installed: None) -> None:
    exec(CODE[1], {})
    config = parse_rig(rig(OPTIONS.removeprefix("[camera]\n")))
    camera = opening._camera(config.camera, WallClock())
    assert camera is not None and camera.describe()["level_dn_s"] == 30000.0
    assert camera.capture(0.01, label="x").data.mean() == 64 + 300


def test_without_the_package_the_kind_is_unknown() -> None:
    with pytest.raises(ConfigurationError, match=r"kind = 'grey_card' is not known; choose from: sim, opencv, none$"):
        parse_rig(rig(OPTIONS.removeprefix("[camera]\n")))


def test_what_goes_wrong_with_a_plug_in(installed: None) -> None:
    with pytest.raises(DeviceError, match=r"of bench-camera \(bench_camera:Missing\) cannot be opened, AttributeError"):
        opening._camera(parse_rig(rig('kind = "broken"')).camera, WallClock())
    with pytest.raises(DeviceError, match=r"cannot be opened, TypeError.*check \[camera.options\]"):
        opening._camera(parse_rig(rig('kind = "grey_card"\noptions = { exposure = 1 }')).camera, WallClock())
    with pytest.raises(ConfigurationError, match="bench-camera: builtins:dict makes a dict, which is no gonio camera"):
        opening._camera(parse_rig(rig('kind = "number"')).camera, WallClock())
    with pytest.raises(ConfigurationError, match="goes with the kind of a plug-in only"):
        parse_rig(rig('kind = "none"\noptions = { a = 1 }'))
