"""Our writers to our readers: every format in one channel, RGB and spectral, with a grain where the format has room for one.

What comes back is compared with the BRDF itself, so a convention that writer and reader share by mistake shows up in the
conformance tests, which use other people's readers.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gonio import formats
from gonio.channels import RGB_TO_XYZ, ChannelSamples
from gonio.errors import DatasetError
from gonio.formats import Material, klems, opticstudio, rgl, ssdd
from tests import materials

BLACKS = Path(__file__).parents[1] / "data" / "optics-blacks"
BIRD = Path(__file__).parents[1] / "data" / "bird" / "example.brdf"
ROWS = ("alta", "astm", "bird", "cornell", "csv", "netcdf")
ARRAYS = ("theta_i", "phi_i", "theta_r", "phi_r", "f_r")


def there_and_back(tmp_path: Path, name: str, material: Material) -> ChannelSamples:
    path = tmp_path / "file"  # no suffix
    formats.export(name, path, material=material)
    assert formats.sniff(path) == name
    return formats.read_channels(path)


@pytest.mark.parametrize("make", [materials.single, materials.rgb, materials.spectrum, materials.brushed])
@pytest.mark.parametrize("name", ROWS)
def test_rows_come_back_bit_for_bit(tmp_path: Path, name: str, make: type) -> None:
    before = make().rows()
    formats.export(name, tmp_path / "file", samples=before)
    after = formats.read_channels(tmp_path / "file")
    order = np.arange(len(before))
    if name == "bird":  # which is read in the order of its directions
        order = np.lexsort(np.stack([getattr(before, k) for k in ("phi_r", "theta_r", "phi_i", "theta_i")]))
    for array in ARRAYS:
        np.testing.assert_array_equal(getattr(after, array), getattr(before, array)[order])
    if name != "cornell" or before.channels.wavelengths_nm is not None:
        assert after.channels == before.channels


@pytest.mark.parametrize("make", [materials.single, materials.rgb, materials.spectrum, materials.brushed])
def test_rgl_holds_f_cos_to_float32(tmp_path: Path, make: type) -> None:
    material = make()
    found = there_and_back(tmp_path, "rgl", material)
    assert found.channels == material.channels
    np.testing.assert_allclose(found.f_r, materials.truth(material, found), rtol=1e-4)


@pytest.mark.parametrize("make", [materials.single, materials.spectrum])
def test_ssdd_holds_f_at_its_nodes(tmp_path: Path, make: type) -> None:
    material = make()
    found = there_and_back(tmp_path, "ssdd", material)
    assert found.channels == material.channels
    np.testing.assert_allclose(found.f_r, materials.truth(material, found), rtol=1e-10)


@pytest.mark.parametrize("make", [materials.single, materials.rgb, materials.spectrum, materials.brushed])
def test_opticstudio_holds_f_around_the_mirror(tmp_path: Path, make: type) -> None:
    material = make()
    found = there_and_back(tmp_path, "opticstudio", material)
    expected = materials.truth(material, found)
    expected = expected @ RGB_TO_XYZ.T if material.channels.kind == "rgb" else expected[:, [material.channels.main]]
    np.testing.assert_allclose(found.f_r, expected, rtol=1e-10)


def test_klems_matrix_comes_back_bit_for_bit_and_is_reciprocal(tmp_path: Path) -> None:
    material = materials.single()
    formats.export("klems", tmp_path / "file.xml", material=material)
    basis, matrix, _ = klems.read_matrices(tmp_path / "file.xml")
    np.testing.assert_array_equal(matrix, klems.averages(material))
    assert len(basis) == 145
    assert basis.projected_solid_angle().sum() == pytest.approx(np.pi, rel=1e-14)
    # patches are mirrored, so a reciprocal BRDF has a matrix that a half turn of all patches transposes; isotropic: itself
    np.testing.assert_allclose(matrix[0], matrix[0].T, rtol=1e-12)
    white = Material((materials.gonio.brdf.make("lambertian", albedo=1.0),))
    np.testing.assert_allclose(klems.averages(white), 1 / np.pi, rtol=1e-12)


def test_klems_sample_of_a_flat_patch_is_the_brdf_at_its_centre(tmp_path: Path) -> None:
    """For a BRDF that hardly varies within a patch the mean is the value at the centre, if the azimuths are right."""
    material = Material((materials.paint(0.3, 1.0),))
    found = there_and_back(tmp_path, "klems", material)
    low = (found.theta_i < 1.0) & (found.theta_r < 1.0)
    np.testing.assert_allclose(found.f_r[low], materials.truth(material, found)[low], rtol=0.03)


@pytest.mark.parametrize("name", ["AnoBlackEC1onAlum", "AnoBlackEC2onAlum", "AnoBlackNiTEonINVAR", "AnoBlackNiTEonSteel"])
def test_measured_opticstudio_files_are_written_again_with_the_same_numbers(tmp_path: Path, name: str) -> None:
    before = opticstudio.read_table(BLACKS / f"{name}.bsdf")
    assert before.value.shape == (1, 1, 4, 19, 12)
    opticstudio.write_table(tmp_path / "again.bsdf", before)

    def words(path: Path) -> list[str | float]:
        found: list[str | float] = []
        for line in path.read_text(encoding="utf-8").splitlines():
            for word in [] if line.startswith("#") else line.split():
                try:
                    found.append(float(word))
                except ValueError:
                    found.append(word)
        return found

    assert words(tmp_path / "again.bsdf") == words(BLACKS / f"{name}.bsdf")
    comments = [line for line in (BLACKS / f"{name}.bsdf").read_text().splitlines() if line.startswith("#")]
    assert [line.strip() for line in comments] == [
        line.strip() for line in (tmp_path / "again.bsdf").read_text().splitlines() if line.startswith("#")
    ]


def test_bird_example_of_its_authors() -> None:
    found = formats.read_channels(BIRD)
    assert found.channels.names == ("550nm", "650nm", "750nm", "850nm") and len(found) == 1
    np.testing.assert_allclose(found.f_r[0], [0.2585, 0.27, 0.288, 0.2985], rtol=1e-14)  # means of two polarisations


def test_bird_keeps_uncertainties(tmp_path: Path) -> None:
    rows = materials.spectrum().rows()
    rows = ChannelSamples(rows.theta_i, rows.phi_i, rows.theta_r, rows.phi_r, rows.f_r, 0.01 * rows.f_r, rows.channels)
    formats.export("bird", tmp_path / "file", samples=rows)
    after = formats.read_channels(tmp_path / "file")
    np.testing.assert_array_equal(after.u_f_r, 0.01 * after.f_r)


def test_rgl_with_a_warp_of_its_own(tmp_path: Path) -> None:
    """A file whose vndf is not flat: values must stand at the half vectors that the density's inverse gives.

    The density 2 x on the unit square, tabulated bilinearly, has the inverse x = sqrt(s); values are cos(theta_h), a
    function of the half vector only, so they can be checked where they are read.
    """
    material = materials.single()
    formats.export("rgl", tmp_path / "a.bsdf", material=material)
    fields = dict(rgl.tensor.read(tmp_path / "a.bsdf"))
    t, n = len(fields["theta_i"]), 9
    vndf = np.broadcast_to(np.array([[0.0, 2.0], [0.0, 2.0]], dtype="<f4"), (1, t, 2, 2))
    u_x = np.sqrt(np.linspace(0.0, 1.0, n))
    value = np.broadcast_to(np.cos(u_x**2 * np.pi / 2), (1, t, 3, n, n)).astype("<f4")
    fields |= {"vndf": vndf, "rgb": value}
    (tmp_path / "b.bsdf").write_bytes(rgl.tensor.pack(fields))
    found = formats.read_channels(tmp_path / "b.bsdf")
    from gonio.geometry import unit_vector

    s = unit_vector(found.theta_i, found.phi_i) + unit_vector(found.theta_r, found.phi_r)
    cos_h = s[:, 2] / np.linalg.norm(s, axis=1)
    np.testing.assert_allclose(found.f_r[:, 0] * np.cos(found.theta_r), cos_h, atol=2e-6)


def test_ssdd_of_other_parametrisations(tmp_path: Path) -> None:
    """Spherical and specular coordinates, binary data: directions by hand."""
    grid = ssdd.Grid(
        ssdd.TYPES[1], (np.array([0.0, 40.0]), np.zeros(1), np.array([0.0, 30.0]), np.array([0.0, 90.0])),
        np.arange(8.0).reshape(1, 2, 1, 2, 2), formats.material_of(brdf=materials.paint()).channels, (),  # type: ignore[union-attr]
    )  # fmt: skip
    ssdd.write_grid(tmp_path / "a.ssdd", grid, {})
    found = formats.read_channels(tmp_path / "a.ssdd")
    by_value = {
        float(f[0]): (a, b, c) for f, a, b, c in zip(found.f_r, found.theta_i, found.theta_r, found.phi_r, strict=True)
    }
    # specular of 40 degrees is at 40 degrees, azimuth 180; 30 degrees from it towards the normal is 10 degrees
    assert by_value[4.0] == pytest.approx((np.radians(40), np.radians(40), np.pi))
    assert by_value[6.0] == pytest.approx((np.radians(40), np.radians(10), np.pi))
    text = (tmp_path / "a.ssdd").read_bytes()
    head = text[: text.index(b"DATA ascii")]
    values = np.transpose(grid.value, (4, 3, 2, 1, 0)).astype("<f4").tobytes()
    (tmp_path / "b.ssdd").write_bytes(head + b"DATA binary\n" + values)
    again = formats.read_channels(tmp_path / "b.ssdd")
    np.testing.assert_array_equal(again.f_r, found.f_r)


def test_lighttools_absolute_angles(tmp_path: Path) -> None:
    text = (
        "Symmetry Asymmetric\nSpectralContent Monochrome\nScatterAzimuth 2\n0 270\nScatterRadial 2\n10 40\nDataBegin\n"
        "AOI 40\nPOI 90\nSide Front\nWavelength 550\nScatterType BRDF\nTIS 0.1\n1 2\n3 4\n"
        "AOI 40\nPOI 90\nSide Back\nWavelength 550\nScatterType BRDF\nTIS 0.1\n9 9\n9 9\nDataEnd\n"
    )
    (tmp_path / "a.bsdf").write_text(text)
    assert formats.sniff(tmp_path / "a.bsdf") == "lighttools"
    found = formats.read_samples(tmp_path / "a.bsdf")
    assert found.attributes["n_blocks_left_out"] == "1"
    np.testing.assert_array_equal(found.f_r, [1, 2, 3, 4])
    # light at azimuth 90 degrees, so its mirror direction is at 270, polar angle 40
    mirror = np.cos(found.phi_r - found.phi_i)[3]
    assert mirror == pytest.approx(-1.0) and found.theta_r[3] == found.theta_i[3]


def test_openmaterial_rows_and_nulls(tmp_path: Path) -> None:
    rows = "[[5.5e-7, 0.5, 0.2, 3.0, 0.1], [5.5e-7, 0.5, -0.2, 3.0, 0.2], [6.5e-7, 0.5, 0.2, 3.0, null]]"
    (tmp_path / "a").write_text('{"metadata": {"name": "asphalt"}, "brdf": {"lookupTable": ' + rows + "}}")
    assert formats.sniff(tmp_path / "a") == "openmaterial"
    found = formats.read_channels(tmp_path / "a")
    assert found.channels.names == ("550nm",) and found.attributes["n_missing"] == "1"
    one = formats.read_samples(tmp_path / "a")
    np.testing.assert_array_equal(np.sort(one.f_r), [0.1, 0.2])
    assert one.phi_r[one.f_r == 0.2] == pytest.approx(3.0 + np.pi)


def test_utia_values_are_decoded(tmp_path: Path) -> None:
    """IEC 61966-2-1: 0.5 decodes to 0.21404114; times 100."""
    data = np.full((3, 288, 288), 0.5, dtype="<f8")
    data[0, 49, 50] = 0.04  # the linear part: 0.04 / 12.92
    (tmp_path / "a").write_bytes(data.tobytes())
    assert formats.sniff(tmp_path / "a") == "utia"
    found = formats.read_channels(tmp_path / "a")
    assert found.f_r[0, 1] == pytest.approx(21.404114, rel=1e-7)
    row = 49 * 288 + 50
    assert found.f_r[row, 0] == pytest.approx(100 * 0.04 / 12.92, rel=1e-12)
    assert np.degrees([found.theta_i[row], found.phi_i[row], found.theta_r[row], found.phi_r[row]]) == pytest.approx(
        [15, 7.5, 15, 15]
    )


def test_alta_cosine_and_parametrisations(tmp_path: Path) -> None:
    head = "#DIM {} 1\n#PARAM_IN {}\n#PARAM_OUT {}\n#VS {}\n"
    (tmp_path / "a").write_text(
        head.format(3, "ISOTROPIC_TV_TL_DPHI", "INV_STERADIAN_COSINE_FACTOR", 0) + "1.0 0.5 3.0 0.2\n"
    )
    found = formats.read_samples(tmp_path / "a")
    assert (found.theta_r[0], found.theta_i[0], found.phi_r[0]) == (1.0, 0.5, 3.0)
    assert found.f_r[0] == pytest.approx(0.2 / np.cos(1.0), rel=1e-14)
    assert found.attributes["source_quantity"].startswith("brdf_cos")
    (tmp_path / "b").write_text(head.format(1, "COS_TH", "INV_STERADIAN", 2) + f"{float(np.cos(0.3))!r} 0.7 0.6 0.8\n")
    found = formats.read_samples(tmp_path / "b")  # half vector at 0.3 rad, light and view both there
    assert found.theta_i[0] == pytest.approx(0.3) and found.theta_r[0] == pytest.approx(0.3) and found.f_r[0] == 0.7


def test_what_a_format_has_no_room_for(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="isotropic BRDFs only"):
        formats.export("merl", tmp_path / "x", material=materials.brushed())
    with pytest.raises(DatasetError, match="convert them to RGB first"):
        formats.export("rgl", tmp_path / "x", material=materials.rgb().tristimulus())
    rows = materials.rgb().rows()
    rows.f_r[0, 1] = np.nan
    with pytest.raises(DatasetError, match="1 directions miss a channel"):
        formats.export("astm", tmp_path / "x", samples=rows)
    few = materials.single().rows().select(np.arange(5))
    with pytest.raises(DatasetError, match="at least 2 incidences"):
        formats.export("pab", tmp_path / "x", samples=few)
    assert not list(tmp_path.iterdir())
