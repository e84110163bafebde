"""gonio info, convert, check-file, export, bundle on small files."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from gonio import formats
from gonio.brdf.tables import Tables
from gonio.cli.main import main
from gonio.formats import netcdf, opticstudio
from gonio.geometry import unit_vector
from gonio.scan import Run
from tests import materials

BLACK = Path(__file__).parents[1] / "data" / "optics-blacks" / "AnoBlackEC1onAlum.bsdf"


def answer(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, object]:
    code = main([str(a) for a in (*arguments, "--json")])
    out = capsys.readouterr().out
    assert code == 0, out
    found: dict[str, object] = json.loads(out)
    return found


def test_info_says_what_the_file_holds(capsys: pytest.CaptureFixture[str]) -> None:
    found = answer(capsys, "info", BLACK)
    assert found["format"] == "opticstudio" and found["samples"] == 647
    assert found["incidences_deg"] == [10, 30, 50, 70] and found["with_uncertainty"] == 0
    assert "f_r" in str(found["quantity_in_file"]) and "1/sr" in str(found["quantity_in_file"])
    assert found["energy"] == "conserved" and len(found["albedo"]) == 3  # type: ignore[arg-type]
    # specular pairs apart, the file has 10 swapped pairs, whose values differ by some per cent as measured ones do
    assert found["reciprocal_pairs"] == 10 and 0.01 < float(found["reciprocity_rms"]) < 0.3  # type: ignore[arg-type]


def test_info_in_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    formats.export("alta", tmp_path / "a", samples=materials.rgb().rows())
    assert main(["info", str(BLACK)]) == 0 and main(["info", str(tmp_path / "a")]) == 0
    said = capsys.readouterr().out
    for words in (
        "samples       647 in one channel (value); f_r 0.005674 to 1.868 1/sr",
        "uncertainty   none in the file",
        "4 incidences (10, 30, 50, 70 degrees) at 1 azimuth; theta_r 0 to 80 degrees",
        "10 pairs of swapped directions differ by",
        "energy        conserved; directional albedo",
        "in 3 channels (red, green, blue)",
    ):
        assert words in said


def test_info_of_a_file_that_makes_light(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    material = materials.Material((3.0 * materials.paint(0.9, 0.5),))
    formats.export("csv", tmp_path / "a.csv", material=material)
    assert "NOT conserved" in str(answer(capsys, "info", tmp_path / "a.csv")["energy"])


def test_convert_of_opticstudio_keeps_every_number(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = answer(capsys, "convert", BLACK, tmp_path / "again.bsdf", "--format", "opticstudio")
    assert found["content"] == "the same grid, number for number"
    np.testing.assert_array_equal(opticstudio.read_table(tmp_path / "again.bsdf").value, opticstudio.read_table(BLACK).value)


def test_convert_rows_as_they_are_and_one_channel(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = materials.rgb().rows()
    formats.export("astm", tmp_path / "a.astm", samples=rows)
    answer(capsys, "convert", tmp_path / "a.astm", tmp_path / "b.csv", "--format", "csv")
    np.testing.assert_array_equal(formats.read_channels(tmp_path / "b.csv").f_r, rows.f_r)
    answer(capsys, "convert", tmp_path / "a.astm", tmp_path / "c.csv", "--format", "csv", "--channel", "blue")
    np.testing.assert_array_equal(formats.read_samples(tmp_path / "c.csv").f_r, rows.f_r[:, 2])
    assert main(["convert", str(tmp_path / "a.astm"), str(tmp_path / "d"), "--format", "csv", "--channel", "uv"]) == 2
    assert "choose one of: red, green, blue" in capsys.readouterr().err


def test_sparse_data_go_through_a_table_or_a_model_and_say_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = materials.single(0.4).rows()
    one = rows.select(np.isclose(rows.theta_i, np.radians(30)))  # one incidence
    formats.export("csv", tmp_path / "a.csv", samples=one)
    code = main(["convert", str(tmp_path / "a.csv"), str(tmp_path / "a.ssdd"), "--format", "ssdd"])
    said = capsys.readouterr()
    assert code == 0 and "1 incidence: all other directions come from a table that extrapolates" in said.err
    assert "f_r = dL_r / dE_i [1/sr]" in said.out


@pytest.mark.gate
def test_a_grain_is_kept_or_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    material = materials.turned(0.3, 0.3, 0.8)
    rows = material.rows()
    formats.export("csv", tmp_path / "a.csv", samples=rows.select(np.arange(0, len(rows), 8)))
    assert main(["convert", str(tmp_path / "a.csv"), str(tmp_path / "a.bsdf"), "--format", "opticstudio"]) == 0
    assert "the table keeps the grain" in capsys.readouterr().err
    found = formats.read_channels(tmp_path / "a.bsdf")
    low = (found.theta_i < 1.1) & (found.theta_r < 1.1)
    assert np.median(np.abs(found.f_r / materials.truth(material, found) - 1)[low]) < 0.1
    assert main(["convert", str(tmp_path / "a.csv"), str(tmp_path / "a.binary"), "--format", "merl"]) == 6
    assert "holds isotropic BRDFs only" in capsys.readouterr().err
    assert not (tmp_path / "a.binary").exists()


def test_check_file_of_a_wrong_file_fails(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("jsonschema")
    formats.export("bird", tmp_path / "a.json", material=materials.single())
    assert answer(capsys, "check-file", tmp_path / "a.json")["results"][1]["ok"] is True  # type: ignore[index]
    (tmp_path / "b.json").write_text((tmp_path / "a.json").read_text().replace('"urn:uuid', '7, "x": "'))
    assert main(["check-file", str(tmp_path / "b.json")]) == 6
    assert "violations" in capsys.readouterr().err


@pytest.fixture
def run(tmp_path: Path) -> Path:
    with Run.create(tmp_path / "run", kind="import", documents={}, attributes={"source_file": "x"}) as made:
        made.write_samples(materials.single().rows().channel())
    return tmp_path / "run"


def test_export_of_a_run_needs_a_table_or_a_fit(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(run), "--format", "rgl", "--out", str(tmp_path / "a.bsdf")]) == 6
    assert "run `gonio table` or `gonio fit` first" in capsys.readouterr().err
    assert main(["export", str(run), "--format", "png", "--out", str(tmp_path / "a")]) == 2
    capsys.readouterr()
    assert answer(capsys, "export", run, "--format", "bird", "--out", tmp_path / "a.json")["quantity"] == "brdf"
    assert formats.sniff(tmp_path / "a.json") == "bird"


def test_table_of_all_channels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From someone's spectral file to tables of every wavelength, and on to formats that hold them."""
    material, run = materials.spectrum(0.4), tmp_path / "run"
    rows = material.rows()
    formats.export("astm", tmp_path / "a.astm", samples=rows)
    answer(capsys, "import", tmp_path / "a.astm", "--out", run)
    found = answer(capsys, "table", run)
    assert found["channels"] == ["450nm", "520nm", "580.5nm", "640nm"] and found["grain"] is False
    tables = Tables.load(run / "table.nc")
    wi, wr = (
        unit_vector(np.radians(a), np.radians(b)) for a, b in (([20.0, 45.0], [0.0, 10.0]), ([25.0, 30.0], [180.0, 200.0]))
    )
    for table, brdf in zip(tables.tables, material.brdfs, strict=True):
        np.testing.assert_allclose(table.brdf().evaluate(wi, wr), brdf.evaluate(wi, wr), rtol=0.02)
    answer(capsys, "export", run, "--format", "bird", "--out", tmp_path / "a.json")
    np.testing.assert_allclose(np.sort(formats.read_channels(tmp_path / "a.json").f_r, axis=0), np.sort(rows.f_r, axis=0))
    answer(capsys, "export", run, "--format", "rgl", "--out", tmp_path / "a.bsdf")
    assert formats.read_channels(tmp_path / "a.bsdf").channels == material.channels
    answer(capsys, "export", run, "--format", "netcdf", "--out", tmp_path / "a.nc")
    assert netcdf.contents(tmp_path / "a.nc") == {"samples", "table"}
    # one channel on request; a fit, which knows one, fills no more
    assert answer(capsys, "table", run, "--channel", "640nm")["channels"] == ["value"]
    assert main(["table", str(run), "--channel", "700nm"]) == 2
    assert "choose one of: 450nm, 520nm, 580.5nm, 640nm" in capsys.readouterr().err


def test_table_keeps_a_grain(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    material, run = materials.turned(0.3, 0.3, 0.8), tmp_path / "run"
    rows = material.rows()
    formats.export("csv", tmp_path / "a.csv", samples=rows.select(np.arange(0, len(rows), 24)))
    answer(capsys, "import", tmp_path / "a.csv", "--out", run)
    assert answer(capsys, "table", run)["grain"] is True
    low = np.maximum(rows.theta_i, rows.theta_r) < 1.1
    some = rows.select(np.flatnonzero(low)[::7])
    found = Tables.load(run / "table.nc").brdf().f_r(some.theta_i, some.phi_i, some.theta_r, some.phi_r)
    assert np.median(np.abs(found / some.f_r[:, 0] - 1)) < 0.05
    found = answer(capsys, "info", run / "table.nc")
    assert found["table_nodes"] == [36, 24, 12, 12]
    # by a Monte Carlo of the albedo at normal incidence: E[f_r pi] over directions weighted with the cosine
    u, phi = np.random.default_rng(1).random((2, 200_000))
    one = material.evaluate(
        np.broadcast_to([0.0, 0.0, 1.0], (len(u), 3)), unit_vector(np.arcsin(np.sqrt(u)), 2 * np.pi * phi)
    )
    assert found["albedo"][0] == pytest.approx(np.pi * one.mean(), rel=0.05)  # type: ignore[index]


def test_bundle_is_whole_and_its_sums_are_right(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "bundle"
    arguments = ["bundle", str(run), "--out", str(out), "--title", 'Paint: "satin"', "--author", "Horn, Berthold", "--json"]
    assert main(arguments) == 0
    names = set(json.loads(capsys.readouterr().out)["files"])
    wanted = {"data.nc", "samples.csv", "samples.bird.json", "report.html", "provenance.json", "LICENSE", "CITATION.cff"}
    assert wanted | {"README.md", "SHA256SUMS"} <= names == {p.name for p in out.iterdir()}
    for line in (out / "SHA256SUMS").read_text().splitlines():
        digest, name = line.split("  ")
        assert hashlib.sha256((out / name).read_bytes()).hexdigest() == digest
    citation = (out / "CITATION.cff").read_text()
    assert 'title: "Paint: \\"satin\\""' in citation and 'family-names: "Horn"' in citation
    assert main(arguments) == 6  # never over another folder
    assert not [p for p in tmp_path.iterdir() if p.name.endswith(".part")]
