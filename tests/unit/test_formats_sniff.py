"""Recognition by content, the registry, and random bytes: whatever comes in, a DatasetError of one line comes out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

import gonio
from gonio import formats
from gonio.brdf.tabulated import from_brdf
from gonio.errors import ConfigurationError, DatasetError
from gonio.formats import cornell, csv, hdf5, merl, netcdf, opticstudio
from gonio.samples import BRDFSamples

REAL = Path(__file__).parents[1] / "data" / "optics-blacks" / "AnoBlackEC1onAlum.bsdf"
READERS = (csv.read, opticstudio.read, cornell.read, merl.read, netcdf.read_samples, netcdf.read_tables, formats.read)
CSV = b"theta_i_deg,phi_i_deg,theta_r_deg,phi_r_deg,f_r,u_f_r\n30,0,45,180,0.25,\n"
CORNELL = b"# paint\n1\n550\n0.5 0 0.7 3.14159 0.1\n0.6 0 0.7 3.14159 0.2\n"
SEEDS = (CSV, CORNELL, REAL.read_bytes()[1200:], merl.HEADER + bytes(64), hdf5.SIGNATURE[:7] + bytes(200))


@pytest.mark.parametrize(
    ("content", "name"),
    [
        (CSV, "csv"),
        (b"\xef\xbb\xbf# quantity: brf\n" + CSV, "csv"),
        (CORNELL, "cornell"),
        (REAL.read_bytes(), "opticstudio"),
        (REAL.read_bytes().lower(), "opticstudio"),
        (merl.HEADER, "merl"),
        (hdf5.SIGNATURE, "netcdf"),
    ],
)
def test_content_decides_and_never_the_suffix(tmp_path: Path, content: bytes, name: str) -> None:
    for suffix in (".bsdf", ".brdf", ".binary", ".txt", ""):
        path = tmp_path / f"file{suffix}"
        path.write_bytes(content)
        assert formats.sniff(path) == name


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (b"CDF\x01....", "a NetCDF-3 file"),
        (b"<?xml version='1.0'?><svg/>", "XML of another kind"),
        (b'{"name": "x"}', "JSON of another kind"),
        (b"OPTIS - brdf surface file v8.0\n", "a Speos BRDF"),
        (b'NVIDIA ARC MBSDF V1\n', "an MDL measured BSDF"),
        (b"type bsdf_data\n", "a FRED BSDF"),
        (b"hello", "in no format that gonio knows"),
        (b" \n", "is empty"),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path: Path, content: bytes, what: str) -> None:
    path = tmp_path / "file.bsdf"
    path.write_bytes(content)
    with pytest.raises(DatasetError, match=what) as caught:
        formats.read(path)
    assert "gonio reads MERL" in str(caught.value) and "\n" not in str(caught.value)


def test_no_such_file(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="is not a file"):
        formats.read(tmp_path / "nothing.csv")
    with pytest.raises(DatasetError, match="is not a file"):
        formats.read(tmp_path)


def test_text_beyond_the_cap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "long.csv"
    with path.open("wb") as file:
        file.write(CSV)
        file.truncate(65 * 2**20)  # sparse
    with pytest.raises(DatasetError, match="at most 67108864 are read"):
        formats.read(path)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=st.binary(max_size=400))
@example(content=b"")
@example(content=b"1 1e400")
@example(content=b"\xff\xfe1\x00")
def test_random_bytes(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "random"
    path.write_bytes(content)
    for reader in READERS:
        with pytest.raises(DatasetError) as caught:
            reader(path)
        assert "\n" not in str(caught.value)


@settings(max_examples=250, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    seed=st.integers(0, len(SEEDS) - 1),
    edits=st.lists(st.tuples(st.integers(0, 4000), st.binary(max_size=6), st.integers(0, 8)), min_size=1, max_size=4),
)
def test_damaged_files(tmp_path: Path, seed: int, edits: list[tuple[int, bytes, int]]) -> None:
    """A few bytes replaced, inserted or removed: samples or a DatasetError, nothing else."""
    content = bytearray(SEEDS[seed])
    for at, new, removed in edits:
        at %= len(content) + 1
        content[at : at + removed] = new
    path = tmp_path / "damaged"
    path.write_bytes(content)
    try:
        found = formats.read_samples(path)
    except DatasetError as error:
        assert "\n" not in str(error)
    else:
        assert np.all(np.isfinite(found.f_r)) and len(found) > 0


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(words=st.lists(st.sampled_from(
    ["SampleRotation", "AngleOfIncidence", "ScatterAzimuth", "ScatterRadial", "DataBegin", "DataEnd", "TIS", "Symmetry",
     "PlaneSymmetrical", "XYZ", "TristimulusX", "0", "1", "2", "-1", "1e308", "90", "nan", "\n", "\n", "\n", "#", "٣"]
), max_size=60))  # fmt: skip
def test_keywords_in_any_order(tmp_path: Path, words: list[str]) -> None:
    path = tmp_path / "words"
    path.write_text(" ".join(words), encoding="utf-8")
    for reader in (opticstudio.read, cornell.read):
        try:
            reader(path)
        except DatasetError as error:
            assert "\n" not in str(error)


def test_damaged_hdf5(tmp_path: Path) -> None:
    """Bytes of a real NetCDF file overwritten at many places."""
    good = tmp_path / "good.nc"
    from_brdf(gonio.brdf.make("lambertian", albedo=0.5), (5, 4, 4)).save(good)
    data, rng = good.read_bytes(), np.random.default_rng(7)
    path = tmp_path / "bad.nc"
    for _ in range(12):
        content = bytearray(data)
        for at in rng.integers(8, len(data), 8):
            content[at] = int(rng.integers(0, 256))
        path.write_bytes(content)
        try:
            formats.read(path)
        except DatasetError as error:
            assert "\n" not in str(error)


def test_export_refuses_what_it_cannot_do(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="choose one of: netcdf, rgl, merl, klems, bird"):
        formats.export("lighttools", tmp_path / "x")
    with pytest.raises(DatasetError, match="needs a table or a fitted BRDF"):
        formats.export("merl", tmp_path / "x")
    with pytest.raises(DatasetError, match="needs samples"):
        formats.export("csv", tmp_path / "x")
    assert not list(tmp_path.iterdir())


def test_a_table_read_as_samples(tmp_path: Path) -> None:
    table = from_brdf(gonio.brdf.make("lambertian", albedo=0.5), (6, 5, 4))
    measured = type(table)(table.value, table.u, np.minimum(table.coverage, 1), {"quantity": "brdf"})
    measured.save(tmp_path / "t.nc")
    samples = formats.read_samples(tmp_path / "t.nc")
    assert isinstance(samples, BRDFSamples) and len(samples) > 20
    np.testing.assert_allclose(samples.f_r, 0.5 / np.pi)
    with pytest.raises(DatasetError, match="states its quantity"):
        formats.read(tmp_path / "t.nc", "brf")
