"""The posterior and its file."""

from __future__ import annotations

import h5netcdf
import numpy as np
import pytest
import xarray

from gonio.errors import DatasetError, ParameterError
from gonio.posterior import Posterior

NAMES = ("lambertian.albedo", "ggx.alpha", "ggx.f_0", "shared.scale")


def posterior(chains=4, steps=500, **changes):
    rng = np.random.default_rng(1)
    values = np.stack(
        (
            rng.uniform(0.2, 0.4, (chains, steps)),
            rng.uniform(0.1, 0.3, (chains, steps)),
            rng.uniform(0.0, 0.1, (chains, steps)),
            rng.normal(0.0, 0.01, (chains, steps)),
        ),
        axis=2,
    )
    given = {
        "model": "lambertian+ggx", "names": NAMES, "draws": values, "log_probability": rng.normal(size=(chains, steps)),
        "fixed": {"ggx.k_s": 1.0},
        "diagnostics": {"converged": True, "tau": {"ggx.alpha": np.float64(12.5)}, "upper": np.inf, "advice": ["<b>"],
                        "units": {"ggx.alpha": "1", "shared.scale": "1"}},
    }  # fmt: skip
    return Posterior(**(given | changes))


def test_summary_of_a_known_distribution():
    s = posterior().summary()["lambertian.albedo"]  # uniform on [0.2, 0.4]
    assert s["mean"] == pytest.approx(0.3, abs=0.005)
    assert s["sd"] == pytest.approx(0.2 / np.sqrt(12), rel=0.05)
    assert [s[k] for k in ("q025", "q16", "median", "q84", "q975")] == pytest.approx(
        [0.205, 0.232, 0.3, 0.368, 0.395], abs=0.01
    )


def test_summary_of_one_draw_is_defined():
    assert posterior(1, 1).summary()["ggx.alpha"]["sd"] == 0.0


def test_brdf_of_the_median_of_a_draw_and_of_named_values():
    p = posterior()
    median = np.median(p.flat(), axis=0)
    assert p.brdf().parameters() == pytest.approx(
        {"lambertian.albedo": median[0], "ggx.k_s": 1.0, "ggx.alpha": median[1], "ggx.f_0": median[2]}
    )
    draw = p.thin(1, np.random.default_rng(0))[0]
    assert p.brdf(draw).parameters()["ggx.alpha"] == draw[1]
    named = p.brdf({"ggx.alpha": 0.5}).parameters()
    assert (named["ggx.alpha"], named["ggx.f_0"]) == (0.5, pytest.approx(median[2]))
    with pytest.raises(ParameterError, match="4 numbers"):
        p.brdf([0.1, 0.2])
    with pytest.raises(ParameterError, match=r"'ggx\.beta' is no free parameter"):
        p.brdf({"ggx.beta": 0.5})
    with pytest.raises(DatasetError, match=r"ggx\.k_s of lambertian\+ggx is neither free nor fixed"):
        posterior(fixed={}).brdf()


def test_thin_takes_each_draw_once_while_they_last():
    p = posterior(2, 50)
    rows = p.thin(100, np.random.default_rng(0))
    assert sorted(map(tuple, rows)) == sorted(map(tuple, p.flat()))
    assert len(p.thin(300, np.random.default_rng(0))) == 300


def test_file_there_and_back(tmp_path):
    p, path = posterior(), tmp_path / "posterior.nc"
    p.save(path)
    q = Posterior.load(path)
    assert (q.model, q.names, q.fixed, q.diagnostics) == (p.model, p.names, p.fixed, p.diagnostics)
    assert q.diagnostics["upper"] is None
    assert np.array_equal(q.draws, p.draws)
    assert np.array_equal(q.log_probability, p.log_probability)
    assert [f.name for f in tmp_path.iterdir()] == ["posterior.nc"]


def test_other_programs_read_the_arviz_layout(tmp_path):
    p, path = posterior(), tmp_path / "posterior.nc"
    p.save(path)
    with xarray.open_dataset(path, group="posterior", engine="h5netcdf") as data:
        assert data["ggx.alpha"].dims == ("chain", "draw")
        assert data["ggx.alpha"].attrs["units"] == "1"
        assert np.array_equal(data["ggx.alpha"].values, p.draws[:, :, 1])
        assert data["chain"].values.tolist() == [0, 1, 2, 3]
    with xarray.open_dataset(path, group="sample_stats", engine="h5netcdf") as data:
        assert np.array_equal(data["lp"].values, p.log_probability)


def test_a_failed_save_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "posterior.nc"
    posterior().save(path)
    before = path.read_bytes()
    broken = posterior(diagnostics={"units": {"ggx.alpha": "1"}})
    object.__setattr__(broken, "diagnostics", {"x": {1, 2}})  # not JSON: fails halfway through
    with pytest.raises(TypeError):
        broken.save(path)
    assert path.read_bytes() == before
    assert [f.name for f in tmp_path.iterdir()] == ["posterior.nc"]
    with pytest.raises(DatasetError, match="cannot be written"):
        posterior().save(tmp_path / "nowhere" / "posterior.nc")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"draws": np.zeros((4, 500, 3))}, "shape"),
        ({"draws": np.zeros((4, 0, 4)), "log_probability": np.zeros((4, 0))}, "no draws"),
        ({"log_probability": np.zeros((4, 3))}, "log_probability"),
        ({"log_probability": np.full((4, 500), np.nan)}, "not finite"),
        ({"fixed": {"ggx.k_s": np.nan}}, "not finite"),
        ({"names": ("a", "a", "b", "c")}, "twice"),
    ],
)
def test_a_posterior_that_does_not_fit_together_is_refused(changes, said):
    with pytest.raises(DatasetError, match=said):
        posterior(**changes)


def change(path, edit):
    with h5netcdf.File(path, "a") as file:
        edit(file)


def not_finite(file):
    file["posterior"]["ggx.alpha"][0, 0] = np.nan


def wrong_format(file):
    file.attrs["format"] = "something else"


def wrong_names(file):
    file.attrs["names"] = '["ggx.alpha", "ggx.gamma"]'


def names_no_list(file):
    file.attrs["names"] = "3"


def no_json(file):
    file.attrs["diagnostics"] = "{"


def text_for_number(file):
    file.attrs["fixed"] = '{"ggx.k_s": "one"}'


@pytest.mark.parametrize("edit", [not_finite, wrong_format, wrong_names, names_no_list, no_json, text_for_number])
def test_a_damaged_file_is_refused_with_its_name(tmp_path, edit):
    path = tmp_path / "posterior.nc"
    posterior().save(path)
    change(path, edit)
    with pytest.raises(DatasetError) as caught:
        Posterior.load(path)
    assert "posterior" in str(caught.value)


def test_other_files_are_refused(tmp_path):
    with pytest.raises(DatasetError, match="no such file"):
        Posterior.load(tmp_path / "posterior.nc")
    text = tmp_path / "text.nc"
    text.write_text("no NetCDF at all")
    with pytest.raises(DatasetError, match="no posterior of gonio"):
        Posterior.load(text)
    posterior().save(tmp_path / "cut.nc")
    whole = (tmp_path / "cut.nc").read_bytes()
    for size in (0, 100, len(whole) // 2):
        (tmp_path / "cut.nc").write_bytes(whole[:size])
        with pytest.raises(DatasetError):
            Posterior.load(tmp_path / "cut.nc")
