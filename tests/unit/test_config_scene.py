"""scene.toml through real files: every source and parameter is what it says, and what is wrong is one sentence."""

from __future__ import annotations

import inspect
import math
import re
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gonio
from gonio import config, source
from gonio.cli.main import main
from gonio.config.sources import SOURCES
from gonio.errors import ConfigurationError, DatasetError, GonioError

BRDF = '[brdf]\nmodel = "lambertian"\nalbedo = 0.5\n'
DIRECTIONS = np.random.default_rng(3).normal(size=(50, 3))
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)


def scene(text: str, folder: Path) -> config.SceneConfig:
    (folder / "scene.toml").write_text(text, encoding="utf-8")
    return config.load_scene(folder / "scene.toml")


def built(keys: str, folder: Path) -> source.Source:
    (one,) = scene(f"{BRDF}[[source]]\n{keys}", folder).sources
    return one.build()


def towards(theta_deg: float, phi_deg: float) -> np.ndarray:
    t, f = math.radians(theta_deg), math.radians(phi_deg)
    return np.array([math.sin(t) * math.cos(f), math.sin(t) * math.sin(f), math.cos(t)])


def test_the_reader_knows_what_every_source_takes() -> None:
    own = {"environment_map": {"file": "radiance"}}
    python = {**source._KINDS, "point": source.point}
    assert set(SOURCES) == set(python) - {"function"}
    for kind, keys in SOURCES.items():
        bare = {own.get(kind, {}).get(k, k) for k in (key.rstrip("?").removesuffix("_deg") for key in keys)} - {"scale"}
        assert bare == set(inspect.signature(python[kind]).parameters)
        optional = {key.rstrip("?").removesuffix("_deg") for key in keys if key.endswith("?")} - {"scale"}
        default = {n for n, p in inspect.signature(python[kind]).parameters.items() if p.default is not p.empty}
        assert optional == default


@pytest.mark.parametrize(
    ("keys", "radiance"),
    [
        ('kind = "uniform"\nradiance = 2', lambda w: np.full(len(w), 2.0)),
        ('kind = "hemispherical"\naxis = [0, 5e-209, 0]', lambda w: np.where(w[:, 1] > 0, 1.0, 0.0)),
        (
            'kind = "overcast"\nzenith_radiance = 3\naxis = [1, 0, 0]',
            lambda w: np.where(w[:, 0] > 0, 1.0 + 2.0 * w[:, 0], 0.0),
        ),
        (
            'kind = "disk"\ntheta_deg = 90\nphi_deg = 270\nhalf_angle_deg = 60\nirradiance = 3',
            lambda w: np.where(-w[:, 1] > 0.5, 3.0 / (math.pi * 0.75), 0.0),
        ),
        (
            'kind = "lobes"\namplitude = [1, 2]\nkappa = [3, 0.5]\ntheta_deg = [30, 120]\nphi_deg = 45',
            lambda w: np.exp(3 * (w @ towards(30, 45) - 1)) + 2 * np.exp(0.5 * (w @ towards(120, 45) - 1)),
        ),
        (
            'kind = "spherical_harmonics"\ncoefficients = [1, 0.1, 0, 0.2]',
            lambda w: 0.5 / math.sqrt(math.pi) + math.sqrt(0.75 / math.pi) * (0.1 * w[:, 1] + 0.2 * w[:, 0]),
        ),
    ],
)
def test_a_source_shines_as_written(keys: str, radiance: object, tmp_path: Path) -> None:
    np.testing.assert_allclose(built(keys, tmp_path).radiance(DIRECTIONS), radiance(DIRECTIONS), rtol=1e-12)  # type: ignore[operator]


def test_beams_come_from_where_they_are_said_to(tmp_path: Path) -> None:
    (beam,) = built('kind = "collimated"\ntheta_deg = 40\nphi_deg = -30\nirradiance = 2', tmp_path).parts
    assert beam.direction == pytest.approx(towards(40, -30)) and beam.irradiance == 2.0  # type: ignore[union-attr]
    (lamp,) = built('kind = "point"\nposition = [0, 3, 4]\nintensity = 50', tmp_path).parts
    assert lamp.direction == pytest.approx((0, 0.6, 0.8)) and lamp.irradiance == pytest.approx(2.0)  # type: ignore[union-attr]


@pytest.mark.parametrize("name", ["sky.npy", "sky.tiff", "sky.hdr", "sky.exr"])
def test_an_environment_map_lies_beside_its_scene(name: str, tmp_path: Path) -> None:
    samples = np.arange(1.0, 33.0).reshape(4, 8)
    colour = np.stack((samples, 0.5 * samples, 2.0 * samples), axis=-1).astype(np.float32)  # red, green, blue
    folder = tmp_path / "skies"
    folder.mkdir()
    if name.endswith(".npy"):
        np.save(folder / name, colour)
    elif name.endswith(".exr"):
        openexr = pytest.importorskip("OpenEXR")
        header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
        openexr.File(header, {"RGB": colour}).write(str(folder / name))
    else:
        cv2.imwrite(str(folder / name), colour[..., ::-1])
    got = built(f'kind = "environment_map"\nfile = "skies/{name}"\nchannel = "blue"\nscale = 0.5', tmp_path)
    theta, phi = np.meshgrid((np.arange(4) + 0.5) * np.pi / 4, (np.arange(8) + 0.5) * np.pi / 4, indexing="ij")
    at = np.stack((np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)), axis=-1)
    rtol = 1 / 128 if name.endswith(".hdr") else 1e-6  # RGBE has 8 bits
    np.testing.assert_allclose(got.radiance(at), samples, rtol=rtol)
    grey = built(f'kind = "environment_map"\nfile = "skies/{name}"\ninterpolation = "smooth"', tmp_path)
    np.testing.assert_allclose(grey.radiance(at), (0.2126 + 0.5 * 0.7152 + 2 * 0.0722) * samples, rtol=rtol)


def test_openexr_without_its_package_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "sky.exr").write_bytes(b"v/1\x01")
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(DatasetError, match=r"\[\[source\]\] 1: .*sky\.exr: .*pip install OpenEXR"):
        built('kind = "environment_map"\nfile = "sky.exr"', tmp_path)


def test_a_damaged_openexr_is_a_sentence(tmp_path: Path) -> None:
    pytest.importorskip("OpenEXR")
    for content in (b"", b"v/1\x01", b"\x76\x2f\x31\x01" + bytes(300)):
        (tmp_path / "sky.exr").write_bytes(content)
        with pytest.raises(DatasetError, match="no OpenEXR image that can be read"):
            built('kind = "environment_map"\nfile = "sky.exr"', tmp_path)


def test_angles_of_a_model_are_in_degrees_and_forms_are_texts(tmp_path: Path) -> None:
    made = scene(
        '[brdf]\nmodel = "oren_nayar + ggx"\nsigma_deg = 20\noren_nayar.albedo = 0.8\nvariant = "qualitative"\n'
        'ggx.k_s = 1\nalpha = 0.2\nf_0 = 0.04\n[[source]]\nkind = "uniform"\n', tmp_path,
    ).brdf.build()  # fmt: skip
    sigma2 = math.radians(20) ** 2
    flat = 0.8 / math.pi * (1 - 0.5 * sigma2 / (sigma2 + 0.33))  # the paper's A, at normal incidence
    assert float(gonio.BRDF(made.terms[:1]).f_r(0.0, 0.0, 0.5, 0.0)) == pytest.approx(flat, rel=1e-12)
    assert made.parameters()["oren_nayar.sigma"] == pytest.approx(math.radians(20))
    assert scene(
        '[brdf]\nmodel = "oren_nayar"\nalbedo = 1\nsigma_deg = 90\n[[source]]\nkind = "uniform"', tmp_path
    ).brdf.build()


def test_viewer_grain_axes_and_files(tmp_path: Path) -> None:
    got = scene(
        BRDF + '[[source]]\nkind = "uniform"\n[viewer]\ntheta_deg = 30\nphi_deg = 45\n[surface]\nrotation_deg = 90\n'
        '[grid]\nn = [3, 5]\np = [0, 1]\natol = 1e-3\n[output]\nmap = "out/a.nc"\nplot = "b.png"\n', tmp_path,
    )  # fmt: skip
    assert got.viewer == pytest.approx((math.pi / 6, math.pi / 4)) and got.tangent == pytest.approx(math.pi / 2)
    assert (got.n, got.p, got.q, got.atol) == ((3, 5), (0.0, 1.0), (-3.0, 3.0), 1e-3)
    assert (got.map, got.plot) == (tmp_path / "out" / "a.nc", tmp_path / "b.png")


SUN = '[[source]]\nkind = "disk"\ntheta_deg = 1\nphi_deg = 2\nhalf_angle_deg = 3\nradiance = 1\n'


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (BRDF + '[[source]]\nkind = "dsk"', "line 5: [source.1] kind = 'dsk' is not known (did you mean 'disk'?)"),
        (BRDF + '[[source]]\nkind = "function"', "exists in Python only"),
        (BRDF + SUN.replace("theta_deg", "theta"), "line 6: [source.1] theta has no unit; write theta_deg in degrees"),
        (BRDF + SUN.replace("half_angle_deg = 3", "half_angle_deg = 0"), "must be greater than 0 degrees"),
        (BRDF + SUN + "irradiance = 2", "exactly one of the two"),
        (BRDF + SUN.replace("radiance = 1", "radiance = -1"), "radiance = -1 is outside [0, inf]"),
        (BRDF + SUN.replace("theta_deg = 1", "theta_deg = 181"), "theta_deg = 181 is outside [0, 180] degrees"),
        (BRDF + SUN + "radience = 1", "radience is not known here (did you mean 'radiance'?)"),
        (BRDF + SUN + '[[source]]\nkind = "lobes"\namplitude = [1, "a"]\nkappa = 1\ntheta_deg = 1\nphi_deg = 1', "source.2"),
        (BRDF + SUN + "[viewr]\ntheta_deg = 1", "viewr is not known here (did you mean 'viewer'?)"),
        (BRDF + SUN + "[viewer]\ntheta = 1", "theta is not known here (did you mean 'theta_deg'?)"),
        (BRDF + SUN + "[surface]\nrotation = 1", "did you mean 'rotation_deg'?"),
        (BRDF + SUN + "[grid]\nn = [3, 1]", "2 whole numbers in [2, 20000]"),
        (BRDF + SUN + "[grid]\np = [1, -1]", "must ascend"),
        (BRDF + SUN + '[output]\nplot = "a.jpg"', "ends in .png"),
        ("a" + ".a" * 5000 + " = 1", "nested too deeply"),
    ],
)
def test_what_is_wrong_in_a_scene_is_named(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError) as caught:
        scene(text, tmp_path)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("brdf", "words"),
    [
        ('model = "gxx"', "did you mean 'ggx'?"),
        ('model = "oren_nayar"\nalbedo = 1\nsigma = 0.3', "oren_nayar: sigma has no unit; write sigma_deg, in degrees"),
        ('model = "oren_nayar"\nalbedo = 1\nsigma_deg = 91', "sigma_deg = 91 is outside [0, 90] degrees"),
        ('model = "oren_nayar"\nalbedo = 1\nsigma_dge = 9', "did you mean 'sigma_deg'?"),
        ('model = "oren_nayar"\nalbedo = 1', "needs sigma_deg as well; its parameters are: albedo, sigma_deg"),
        ('model = "oren_nayar"\nalbedo = 1\nsigma_deg = 9\nvariant = "qualitativ"', "did you mean 'qualitative'?"),
        ('model = "oren_nayar"\nalbedo = 1\nsigma_deg = 9\nvarient = "qualitative"', "did you mean 'variant'?"),
        ('model = "lambertian"\nalbedo = "0.5"', "albedo is '0.5'; it must be a number without quotes"),
        ('model = "lambertian"\nalbedo = 1.5', "albedo = 1.5 is outside [0, 1]"),
        ('model = "lambertian+ggx"\nlambertain.albedo = 1', "did you mean 'lambertian'?"),
        ('model = "lambertian+lambertian"\nalbedo = 1', "fits 2 terms"),
        ('model = "ggx[shape=round]"\nalpha = 1', "shape"),
    ],
)
def test_what_is_wrong_with_a_surface_is_named(brdf: str, words: str, tmp_path: Path) -> None:
    text = f'[brdf]\n{brdf}\n[[source]]\nkind = "uniform"\n'
    with pytest.raises(ConfigurationError) as caught:
        scene(text, tmp_path).brdf.build()
    assert words in str(caught.value) and "scene.toml: [brdf]" in str(caught.value)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ('kind = "environment_map"\nfile = "none.hdr"', r"\[\[source\]\] 1: .*none.hdr: there is no such file"),
        ('kind = "environment_map"\nfile = "scene.toml"', "toml is not known"),
        ('kind = "environment_map"\nfile = "dark.npy"', r"dark.npy: environment_map: radiance\[0, 1\] = -1 is negative"),
        ('kind = "lobes"\namplitude = [1, 2]\nkappa = [1, 2, 3]\ntheta_deg = 1\nphi_deg = 1', "2 amplitude, 3 kappa"),
        ('kind = "spherical_harmonics"\ncoefficients = [1, 2]', "2 coefficients"),
        ('kind = "spherical_harmonics"\ncoefficients = [1, 0, 9, 0]', "raise the first coefficient by"),
    ],
)
def test_what_a_source_cannot_be_is_named_with_its_place(keys: str, words: str, tmp_path: Path) -> None:
    np.save(tmp_path / "dark.npy", np.array([[0.0, -1.0]]))
    with pytest.raises((ConfigurationError, DatasetError), match=words):
        built(keys, tmp_path)


_wild = st.recursive(
    st.one_of(
        st.integers(-3, 400), st.floats(), st.integers(-(10**400), 10**400), st.booleans(), st.text(max_size=4),
        st.sampled_from(["smooth", "table", "x.npy", "."]),
    ),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.sampled_from("ab"), inner, max_size=2)),
    max_leaves=6,
)  # fmt: skip
_few = st.floats(0.0, 1.0)
_deg = st.floats(0.0, 90.0)
_right: dict[str, st.SearchStrategy[object]] = {
    "axis": st.lists(st.floats(-1, 1), min_size=3, max_size=3), "coefficients": st.lists(_few, min_size=1, max_size=4),
    "position": st.lists(st.floats(-1, 1), min_size=3, max_size=3), "file": st.sampled_from(["x.npy", "y.hdr", "", "/"]),
    "interpolation": st.sampled_from(["bilinear", "smooth"]), "channel": st.sampled_from(["luminance", "red"]),
    "amplitude": st.one_of(_few, st.lists(_few, min_size=1, max_size=3)), "n": st.integers(2, 9),
    "p": st.just([-1, 1]), "rtol": st.just(1e-3), "map": st.just("a.nc"), "plot": st.just("a.png"),
    "variant": st.sampled_from(["qualitative", "full", "none"]), "exponent": st.floats(1, 100),
}  # fmt: skip
_models = {
    "lambertian": ["albedo"],
    "oren_nayar": ["albedo", "sigma_deg", "variant"],
    "lambertian+ggx": ["albedo", "ggx.k_s", "alpha", "f_0"],
    "lambertian+oren_nayar": ["lambertian.albedo", "oren_nayar.albedo", "sigma_deg"],
    "phong": ["k_s", "n"],
    "ggx+ggx": ["ggx.k_s", "ggx.alpha", "ggx.f_0", "ggx2.k_s", "ggx2.alpha", "ggx2.f_0"],
    "nothing": [],
}
_TABLES = {
    "grid": ["n", "p", "rtol"],
    "viewer": ["theta_deg", "phi_deg"],
    "surface": ["rotation_deg"],
    "output": ["map", "plot"],
}


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k} = {_toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, str):
        return '"' + "".join(f"\\u{ord(c):04x}" for c in value if ord(c) < 0xD800) + '"'
    return repr(value)


def _lines(table: dict[str, object]) -> str:
    return "".join(f"{key} = {_toml(value)}\n" for key, value in table.items())


@st.composite
def _scenes(draw: st.DrawFn) -> str:
    """A right scene, in which now and then a key is missing, a value is anything, or a key is wrong."""
    wrong = draw(st.integers(0, 3))  # how many things

    def table(keys: list[str]) -> dict[str, object]:
        nonlocal wrong
        made = {key: draw(_right.get(key, _deg if key.endswith("_deg") else _few)) for key in keys}
        if wrong and keys and draw(st.booleans()):
            wrong -= 1
            key = draw(st.sampled_from(keys))
            what = draw(st.sampled_from(["value", "value", "value", "missing", "name"]))
            old = made.pop(key)
            if what == "value":
                made[key] = draw(_wild)
            elif what == "name":
                made[key.removesuffix("_deg") if key.endswith("_deg") else key[:-1] + "x"] = old
        return made

    model = draw(st.sampled_from(sorted(_models)))
    text = f'[brdf]\nmodel = "{model}"\n' + _lines(table(_models[model]))
    for _ in range(draw(st.integers(1, 2))):
        kind = draw(st.sampled_from(sorted(SOURCES)))
        left_out = (
            ["radiance?"] if kind == "disk" else [key for key in SOURCES[kind] if key.endswith("?") and draw(st.booleans())]
        )
        keys = [key.rstrip("?") for key in SOURCES[kind] if key not in left_out]
        text += f'[[source]]\nkind = "{kind}"\n' + _lines(table(keys))
    for name in draw(st.lists(st.sampled_from([*_TABLES, "source.x"]), max_size=2, unique=True)):
        text += f"[{name}]\n" + _lines(table(_TABLES.get(name, ["n"])))
    return text


def test_any_scene_is_read_and_built_or_refused_in_words(tmp_path: Path) -> None:
    np.save(tmp_path / "x.npy", np.ones((4, 8)))
    done = dict.fromkeys(("refused", "built"), 0)

    @settings(max_examples=400, deadline=None)
    @given(_scenes())
    def attempt(text: str) -> None:
        try:
            got = config.parse_scene(text, folder=tmp_path)
            got.brdf.build()
            for one in got.sources:
                one.build()
            done["built"] += 1
        except GonioError as exc:
            assert str(exc)
            done["refused"] += 1

    attempt()
    assert min(done.values()) > 40  # both ends are tried


@pytest.mark.parametrize("text", ["", "[brdf]", "[brdf]\nmodel = 3", "\xff", BRDF, BRDF + '[[source]]\nkind = "disk"'])
def test_the_command_ends_in_one_sentence(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "scene.toml").write_bytes(text.encode("latin-1"))
    assert main(["map", str(tmp_path / "scene.toml"), "--out", str(tmp_path / "map.nc")]) == 2
    told = capsys.readouterr()
    assert told.err.startswith("error: ") and "defect" not in told.err and not (tmp_path / "map.nc").exists()


def test_what_is_commented_in_the_file_of_gonio_init_is_right_too(tmp_path: Path) -> None:
    text = config.default_documents()["scene.toml"]
    text = text.replace('# run = "runs/first"', "").replace('# use = "fit"', "")
    lines = [line[2:] if re.match(r"# (\[|\w+ = )", line) else line for line in text.splitlines()]
    got = scene("\n".join(lines), tmp_path)
    assert [one.kind for one in got.sources] == ["collimated", "hemispherical", "disk", "environment_map"]
    assert got.viewer is not None and got.map == tmp_path / "map.nc" and got.plot == tmp_path / "map.png"
    assert got.brdf.build().name == "lambertian+ggx"
