"""NetCDF: bit for bit there and back, legible for plain xarray and h5py, and no trust in foreign files."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray

import gonio
from gonio import formats
from gonio.brdf import grained
from gonio.brdf.tables import Tables
from gonio.brdf.tabulated import TabulatedBRDF, from_brdf
from gonio.channels import spectral
from gonio.errors import DatasetError
from gonio.formats import netcdf
from gonio.samples import BRDFSamples, SharedError
from tests import materials

ARRAYS = ("theta_i", "phi_i", "theta_r", "phi_r", "f_r", "u_f_r", "pose", "d_omega_i", "d_omega_r", "d_ln_f")


def samples(n: int = 50) -> BRDFSamples:
    rng = np.random.default_rng(1)
    u = rng.uniform(0, 1, n)
    u[3] = np.nan
    return BRDFSamples(
        rng.uniform(0, 1.5, n), rng.uniform(0, 6, n), rng.uniform(0, 1.5, n), rng.uniform(0, 6, n),
        rng.standard_normal(n), u, np.arange(n, dtype=np.int64),
        (SharedError("scale", 0.01), SharedError("arm", 2e-3, 4e-4, "rad")),
        rng.standard_normal((n, 3, 2)), rng.standard_normal((n, 3, 2)), rng.standard_normal((n, 2)),
        {"material": "grün 'paint'", "quantity": "brdf"},
    )  # fmt: skip


@pytest.fixture
def table() -> TabulatedBRDF:
    brdf = gonio.brdf.make("lambertian", albedo=0.4) + gonio.brdf.make("ggx", k_s=1.0, alpha=0.3, f_0=0.04)
    return from_brdf(brdf, (8, 7, 6))


def test_samples_come_back_bit_for_bit(tmp_path: Path) -> None:
    before = samples()
    formats.export("netcdf", tmp_path / "a.nc", samples=before)
    after = formats.read(tmp_path / "a.nc")
    assert isinstance(after, BRDFSamples)
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    assert after.shared == before.shared
    assert dict(after.attributes) == dict(before.attributes)


def test_table_comes_back_bit_for_bit(tmp_path: Path, table: TabulatedBRDF) -> None:
    table.save(tmp_path / "table.nc")
    after = TabulatedBRDF.load(tmp_path / "table.nc")
    for name in ("value", "u", "coverage"):
        np.testing.assert_array_equal(getattr(after, name), getattr(table, name))
    assert dict(after.attributes) == dict(table.attributes)
    assert isinstance(formats.read(tmp_path / "table.nc"), Tables)
    assert netcdf.contents(tmp_path / "table.nc") == {"table"}


@pytest.mark.parametrize("grain", [False, True])
def test_tables_of_channels_come_back_bit_for_bit(tmp_path: Path, grain: bool) -> None:
    """Of a spectrum, with and without a grain; xarray sees the same numbers on named axes."""
    spectrum = spectral([450.0, 555.5])
    brdfs = [
        gonio.brdf.make("lambertian", albedo=a) + gonio.brdf.make("ggx", k_s=1.0, alpha=0.3, f_0=0.04) for a in (0.2, 0.6)
    ]
    make = grained.from_brdf if grain else from_brdf
    shape = (6, 8, 7, 5) if grain else (8, 7, 5)
    before = Tables(tuple(make(brdf, shape) for brdf in brdfs), spectrum)  # type: ignore[operator]
    before.save(tmp_path / "a.nc")
    after = Tables.load(tmp_path / "a.nc")
    assert after.channels == spectrum and after.grained == grain and dict(after.attributes) == dict(before.attributes)
    for old, new in zip(before.tables, after.tables, strict=True):
        assert type(old) is type(new) and old.scale == new.scale
        for name in ("value", "u", "coverage"):
            np.testing.assert_array_equal(getattr(new, name), getattr(old, name))
    axes = ("phi_h",) * grain + ("theta_h", "theta_d", "phi_d")
    with xarray.open_dataset(tmp_path / "a.nc", engine="h5netcdf") as data:
        assert data["brdf_table"].dims == ("channel", *axes)
        np.testing.assert_array_equal(data["brdf_table"].values[1], before.tables[1].value)
        np.testing.assert_array_equal(data["wavelength"].values, [450.0, 555.5])
        for axis, nodes in zip(axes, before.main.nodes(), strict=True):
            np.testing.assert_array_equal(data[axis].values, nodes)
    with pytest.raises(DatasetError, match="grain or several channels"):
        TabulatedBRDF.load(tmp_path / "a.nc")
    # samples of the same channels may stand beside them, of others not
    rows = materials.rgb().rows()
    with pytest.raises(DatasetError, match="different channels"):
        formats.export("netcdf", tmp_path / "b.nc", samples=rows, table=before)
    assert not (tmp_path / "b.nc").exists()


def test_both_in_one_file(tmp_path: Path, table: TabulatedBRDF) -> None:
    attributes = {"history": "scanned", "lab": "B"}
    formats.export("netcdf", tmp_path / "a.nc", samples=samples(), table=table, attributes=attributes)
    assert netcdf.contents(tmp_path / "a.nc") == {"samples", "table"}
    assert len(formats.read_samples(tmp_path / "a.nc")) == 50
    assert TabulatedBRDF.load(tmp_path / "a.nc").shape == (8, 7, 6)


def test_plain_xarray_understands_it(tmp_path: Path, table: TabulatedBRDF) -> None:
    before = samples()
    formats.export("netcdf", tmp_path / "a.nc", samples=before, table=table, attributes={"history": "scanned"})
    with xarray.open_dataset(tmp_path / "a.nc", engine="h5netcdf") as data:
        assert data.attrs["Conventions"] == "CF-1.11 gonio-1"
        assert data.attrs["quantity"] == "brdf"
        assert data.attrs["history"] == f"scanned; written by gonio {gonio.__version__}"
        assert data["brdf"].attrs["units"] == "sr-1"
        assert data["brdf"].dims == ("sample",)
        assert data["brdf"].attrs["ancillary_variables"] == "brdf_standard_error"
        assert set(data["brdf"].coords) == {"theta_i", "phi_i", "theta_r", "phi_r"}
        assert data["theta_i"].attrs["units"] == "rad"
        np.testing.assert_array_equal(data["brdf"].values, before.f_r)
        assert data["shared_error_name"].values.tolist() == ["scale", "arm"]
        flags = data["brdf_table_coverage"].attrs
        meanings = dict(zip(flags["flag_values"].tolist(), flags["flag_meanings"].split(), strict=True))
        assert meanings[2] == "interpolated" and meanings[0] == "below_horizon"
        top = data["brdf_table"].sel(theta_h=0.0, theta_d=0.0, phi_d=0.0)
        assert float(top) == table.value[0, 0, 0]


def test_plain_h5py_understands_it(tmp_path: Path) -> None:
    formats.export("netcdf", tmp_path / "a.nc", samples=samples())
    with h5py.File(tmp_path / "a.nc", "r") as file:
        assert file["brdf"].shape == (50,) and file["brdf"].dtype == np.float64
        assert file["brdf"].attrs["long_name"] == "bidirectional reflectance distribution function"


def change(path: Path, edit: object) -> None:
    with h5py.File(path, "r+") as file:
        edit(file)  # type: ignore[operator]


def test_files_that_cannot_be_trusted(tmp_path: Path, table: TabulatedBRDF) -> None:
    path = tmp_path / "a.nc"

    def fresh() -> None:
        formats.export("netcdf", path, samples=samples(), table=table)

    fresh()
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(DatasetError, match="damaged NetCDF-4 file"):
        formats.read(path)
    path.write_bytes(b"CDF\x01" + bytes(100))
    with pytest.raises(DatasetError, match="NetCDF-3"):
        formats.read(path)

    def huge(file: h5py.File) -> None:
        del file["brdf"]
        file.create_dataset("brdf", shape=(10**12,), dtype="f8", chunks=(1000,))  # nothing is stored

    def link(file: h5py.File) -> None:
        del file["theta_i"]
        file["theta_i"] = h5py.ExternalLink("/etc/passwd", "theta_i")

    def external(file: h5py.File) -> None:
        del file["theta_i"]
        file.create_dataset("theta_i", shape=(50,), dtype="f8", external=[(str(tmp_path / "raw"), 0, 400)])

    def shorter(file: h5py.File) -> None:
        del file["theta_i"]
        file["theta_i"] = np.zeros(49)

    def words(file: h5py.File) -> None:
        del file["theta_i"]
        file["theta_i"] = np.array([b"a"] * 50)

    def nodes(file: h5py.File) -> None:
        file["theta_h"][0] = 0.1

    def negative(file: h5py.File) -> None:
        file["brdf_table"][0, 0, 0] = -1.0

    def not_json(file: h5py.File) -> None:
        file["brdf"].attrs["gonio_attributes"] = "{"

    def infinite(file: h5py.File) -> None:
        file["brdf"][0] = np.inf

    for edit, kind, message in (
        (huge, "samples", "declares 8000000000000 bytes"),
        (link, "samples", "link to another file"),
        (external, "samples", "not stored in this file"),
        (shorter, "samples", "theta_i has shape"),
        (words, "samples", "which gonio does not write"),
        (nodes, "table", "nodes of theta_h"),
        (negative, "table", "negative or not finite"),
        (not_json, "samples", "not JSON"),
        (infinite, "samples", "not finite"),
    ):
        fresh()
        change(path, edit)
        with pytest.raises(DatasetError, match=message):
            _ = netcdf.read_samples(path) if kind == "samples" else netcdf.read_tables(path)


def test_tables_that_cannot_be_trusted(tmp_path: Path) -> None:
    path = tmp_path / "a.nc"
    brdf = gonio.brdf.make("lambertian", albedo=0.4)
    before = Tables((grained.from_brdf(brdf, (6, 8, 7, 5)),) * 2, spectral([450.0, 555.5]))

    def without(name: str) -> object:
        return lambda file: file.__delitem__(name)

    def set_to(name: str, value: object) -> object:
        def edit(file: h5py.File) -> None:
            del file[name]
            file[name] = value

        return edit

    for edit, message in (
        (set_to("brdf_table_coverage", np.full((2, 6, 8, 7, 5), 300, dtype="i4")), "outside 0 to 255"),
        (set_to("wavelength", np.array([450.0])), "1 channels are named, brdf_table has 2"),
        (set_to("wavelength", np.array([450.0, 450.0])), "stands twice"),
        (without("phi_h"), "5 dimensions, a table over 3 angles"),
        (set_to("phi_h", np.zeros(6)), "the nodes of phi_h are not those of a gonio table"),
        (set_to("brdf_table_coverage", np.zeros((2, 6, 8, 7, 4), dtype="u1")), "have different shapes"),
        (set_to("brdf_table_coverage", np.full((2, 6, 8, 7, 5), 9, dtype="u1")), "coverage 9 is unknown"),
        (set_to("brdf_table_standard_error", np.full((2, 6, 8, 7, 5), -1.0)), "an uncertainty is negative"),
        (set_to("brdf_table", np.zeros((2, 5, 8, 7, 5))), "have different shapes"),
        (lambda file: file["brdf_table"].attrs.__setitem__("theta_h_scale", "1e9"), "have the scale 1e[+]09"),
        (lambda file: file["brdf_table"].attrs.__delitem__("theta_h_scale"), "have the scale nan"),
    ):
        before.save(path)
        change(path, edit)
        with pytest.raises(DatasetError, match=message) as caught:
            netcdf.read_tables(path)
        assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def test_what_is_not_there(tmp_path: Path, table: TabulatedBRDF) -> None:
    with pytest.raises(DatasetError, match="neither a table nor a set of samples"):
        formats.export("netcdf", tmp_path / "a.nc")
    table.save(tmp_path / "t.nc")
    with pytest.raises(DatasetError, match="holds no samples"):
        netcdf.read_samples(tmp_path / "t.nc")
    with h5py.File(tmp_path / "other.nc", "w") as file:
        file["temperature"] = np.zeros(3)
    with pytest.raises(DatasetError, match="holds no samples"):
        formats.read(tmp_path / "other.nc")
