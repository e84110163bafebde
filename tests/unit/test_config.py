"""The strict reader: what is written is read exactly, and what is wrong is named with its place, all at once."""

from __future__ import annotations

import math
import subprocess
import sys

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gonio import config
from gonio.errors import ConfigurationError

TEXTS = config.default_documents()
PARSERS = {
    "rig.toml": config.parse_rig, "plan.toml": config.parse_plan, "scene.toml": config.parse_scene,
    "fit.toml": config.parse_fit,
}  # fmt: skip


def test_every_default_document_parses() -> None:
    assert set(TEXTS) == set(PARSERS)
    for name, text in TEXTS.items():
        PARSERS[name](text, name)
    config.parse_plan(config.small_plan())


def test_degrees_become_radians() -> None:
    rig = config.parse_rig(TEXTS["rig.toml"])
    assert rig.axes["arm"].upper == pytest.approx(math.radians(100), rel=1e-15)
    assert rig.axes["pan"].u_zero == pytest.approx(math.radians(0.1), rel=1e-15)
    assert rig.axes["tilt"].angle(2048 + 1024) == pytest.approx(math.pi / 2, rel=1e-15)
    assert rig.sim is not None and rig.sim.truth["ggx.alpha"] == 0.2
    assert rig.simulated


def test_unknown_key_names_the_nearest_and_its_line() -> None:
    text = TEXTS["rig.toml"].replace("exposures_s", "exposure_s")
    line = next(n for n, content in enumerate(text.splitlines(), 1) if "exposure_s" in content)
    with pytest.raises(ConfigurationError) as caught:
        config.parse_rig(text)
    message = str(caught.value)
    assert f"line {line}: [camera] exposure_s is not known here (did you mean 'exposures_s'?)" in message
    assert "[camera] exposures_s is missing" in message


def test_all_problems_of_a_file_at_once() -> None:
    text = TEXTS["rig.toml"]
    text = text.replace("beta = 0.99", "beta = nan").replace("u_beta = 0.005", "u_beta = true")
    text = text.replace('model = "XM430-W350"', 'model = "XM430-W351"', 1).replace("seed = 1 ", "seed = -1 ")
    text = text.replace("lower_deg = -80.0", "lower_deg = -800.0").replace("[lamp]", "[lmap]")
    with pytest.raises(ConfigurationError, match="7 problems") as caught:
        config.parse_rig(text)
    message = str(caught.value)
    for part in (
        "beta is nan; it must be a finite number", "u_beta is true; it must be a finite number",
        "did you mean 'XM430-W350'?", "[sim] seed = -1 is outside", "lower_deg = -800 is outside [-180, 180] degrees",
        "needs a table [lamp]", "lmap is not known here (did you mean 'lamp'?)",
    ):  # fmt: skip
        assert part in message


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("id = 3", "id = 2", "is also that of pan"),
        ("lower_deg = -45.0", "lower_deg = 50.0", "must be below upper_deg = 45"),
        ("zero_counts = 2048", "zero_counts = 100", "puts the limits at -1038 and 1238 counts"),
        ("overshoot_deg = 2.0", "overshoot_deg = 1.0", "must exceed tolerance_counts = 12"),
        ("arm_deg = 30.0", "arm_deg = 5.0", "puts the light arm before the camera"),
        ("pan_deg = 15.0", "pan_deg = 85.0", "outside the axis' limits [-80, 80] degrees"),
        ("[0.002, 0.016, 0.128]", "[0.002, 0.128, 0.016]", "the shortest first"),
        ("roi = [76, 56, 8, 8]", "roi = [150, 50, 20, 20]", "must lie within the image of 160 x 120"),
        ('kind = "sim"', 'kind = "none"', "does not go with"),
        ('port = "sim"                  # REAL: "/dev/ttyUSB1"', 'port = "/dev/ttyUSB1"', "or none is"),
        ("direction = 1", "direction = 0", "turns nowhere"),
        ("beta = 0.99", "beta = 1e999", "finite"),
    ],
)
def test_values_that_do_not_go_together(old: str, new: str, message: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        config.parse_rig(TEXTS["rig.toml"].replace(old, new, 1))
    assert message in str(caught.value)


@pytest.mark.parametrize(
    "text",
    ["[" * 5000 + "]" * 5000, "a = " + "[" * 5000 + "]" * 5000, "a = " + "9" * 5000, "a = ", "\x00", "rig = 3", "[[rig]]\n"],
)
def test_hostile_text_is_one_clear_error(text: str) -> None:
    for parse in PARSERS.values():
        with pytest.raises(ConfigurationError):
            parse(text)


def test_size_cap_and_unreadable_files(tmp_path) -> None:
    big = tmp_path / "big.toml"
    big.write_text("#" * 1_000_001)
    with pytest.raises(ConfigurationError, match="1000001 bytes"):
        config.read_document(big)
    with pytest.raises(ConfigurationError, match="more than 1000000 bytes"):
        config.parse_rig("#" * 1_000_001)
    with pytest.raises(ConfigurationError, match="gonio init"):
        config.read_document(tmp_path / "none.toml")
    with pytest.raises(ConfigurationError, match="is a folder"):
        config.read_document(tmp_path)
    (tmp_path / "latin.toml").write_bytes(b"a = '\xe9'")
    with pytest.raises(ConfigurationError, match="UTF-8 at byte 5"):
        config.read_document(tmp_path / "latin.toml")


_key = st.sampled_from(
    ["rig", "bus", "name", "port", "grid", "theta_i_deg", "poses", "source", "kind", "brdf", "model", "n"]
)
_value = st.recursive(
    st.one_of(st.booleans(), st.integers(), st.floats(), st.text(max_size=3)),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(_key, inner, max_size=3)), max_leaves=8,
)  # fmt: skip


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k} = {_toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    if isinstance(value, str):
        return (
            '"'
            + "".join(f"\\u{ord(c):04x}" if ord(c) < 0x10000 and not 0xD800 <= ord(c) < 0xE000 else "" for c in value)
            + '"'
        )
    return repr(value)


@settings(max_examples=150, deadline=None)
@given(st.dictionaries(_key, _value, max_size=5))
def test_any_document_is_read_or_refused(values: dict[str, object]) -> None:
    text = "".join(f"{key} = {_toml(value)}\n" for key, value in values.items())
    for parse in PARSERS.values():
        try:
            parse(text)
        except ConfigurationError:
            continue


def test_plan_grids_and_poses() -> None:
    plan = config.parse_plan(
        "[sample]\nname = 'x'\noperator = 'me'\n[grid]\ntheta_i_deg = [0, 45]\ntheta_r_deg = [30]\nphi_deg = [180]\n"
        "[poses]\nangles_deg = [[45, 0, 180]]\n[exposure]\nbracket_s = [0.1, 0.2]\n[white]\nevery = 20\nrepeats = 3\n"
    )
    assert plan.grids[0].first == (0.0, math.pi / 4) and plan.grids[0].kind == "directions"
    assert plan.poses == ((math.pi / 4, 0.0, math.pi),)
    assert (plan.bracket_s, plan.white_every, plan.white_repeats) == ((0.1, 0.2), 20, 3)
    assert plan.sample == {"name": "x", "operator": "me"}
    with pytest.raises(ConfigurationError, match="row 2"):
        config.parse_plan("[sample]\nname='x'\n[poses]\nangles_deg = [[45, 0, 180], [95, 0, 0]]\n")
    with pytest.raises(ConfigurationError, match=r"write at least one \[\[grid\]\]"):
        config.parse_plan("[sample]\nname='x'\n")
    with pytest.raises(ConfigurationError, match=r"\[grid\.1\] phi is not known here \(did you mean 'phi_deg'\?\)"):
        config.parse_plan(TEXTS["plan.toml"].replace("phi_deg = ", "phi = ", 1))


def test_scene_parameters_and_sources() -> None:
    scene = config.parse_scene(
        '[brdf]\nmodel = "lambertian"\nalbedo = 0.8\n[[source]]\nkind = "collimated"\ntheta_deg = 60\nphi_deg = 90\n'
        '[[source]]\nkind = "hemispherical"\nradiance = 2\n[grid]\np = [-1, 2]\nn = 11\n'
    )
    assert scene.brdf.build().parameters() == {"lambertian.albedo": 0.8}
    assert scene.sources[0].parameters == {"theta": math.pi / 3, "phi": math.pi / 2}
    assert scene.sources[1].parameters == {"radiance": 2.0}
    assert (scene.p, scene.q, scene.n) == ((-1.0, 2.0), (-3.0, 3.0), (11, 11))
    with pytest.raises(ConfigurationError, match="write theta_deg in degrees"):
        config.parse_scene('[brdf]\nrun = "r"\n[[source]]\nkind = "collimated"\ntheta = 1.0\n')
    with pytest.raises(ConfigurationError, match="did you mean 'run'"):
        config.parse_scene('[brdf]\nrn = "r"\n[[source]]\nkind = "uniform"\n')
    for model, key in (("lambertian+lambertian", "albedo"), ("lambertian+ggx", "shine.alpha"), ("lambertian", "ggx.alpha")):
        bad = config.parse_scene(f'[brdf]\nmodel = "{model}"\n"{key}" = 0.5\n[[source]]\nkind = "uniform"\n')
        with pytest.raises(ConfigurationError):
            bad.brdf.build()


def test_fit_priors() -> None:
    fit = config.parse_fit(
        'model = "ggx"\nfree = ["ggx.k_s"]\n[fix]\nggx.f_0 = 0.04\n[priors]\n"ggx.alpha" = ["log_normal", -1.6, 1]\n'
    )
    assert fit.fix == {"ggx.f_0": 0.04}
    assert fit.priors == {"ggx.alpha": ("log_normal", -1.6, 1.0)}
    with pytest.raises(ConfigurationError, match='write \\["uniform"'):
        config.parse_fit('model = "ggx"\n[priors]\n"ggx.alpha" = 3\n')
    with pytest.raises(ConfigurationError, match=r"half_normal"):
        config.parse_fit('model = "ggx"\n[priors]\n"ggx.alpha" = ["half_normal", 1, 2]\n')
    text = 'model = "ggx"\nstudent = 4\n[priors]\n"ggx.f_0" = ["half_normal", 0.1]\n"ggx.alpha" = ["normal", 0.2, 0.1]\n'
    assert config.parse_fit(text).priors == {"ggx.f_0": ("half_normal", 0.1), "ggx.alpha": ("normal", 0.2, 0.1)}
    assert config.parse_fit(text).student == 4.0


def test_the_reader_loads_no_numerical_package() -> None:
    code = (
        "import sys; from gonio import config; t = config.default_documents(); config.parse_rig(t['rig.toml']);"
        "config.parse_scene(t['scene.toml']); config.parse_plan(t['plan.toml']);"
        "print([m for m in ('numpy', 'scipy', 'numba') if m in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"
