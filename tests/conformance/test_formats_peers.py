"""Files that gonio writes, as other people's programs read them. `tests.format_figures` holds the comparisons.

The short slice here takes one synthetic material and skips what is not installed; the gate prints every figure of
docs/formats.md, of a measured table too.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gonio import formats
from gonio.formats import check, klems, peers, rgl
from gonio.geometry import unit_vector
from tests import format_figures, format_readers, gates, materials
from tests.format_figures import Figure


def needs(name: str) -> pytest.MarkDecorator:
    return pytest.mark.skipif(
        not peers.installed()[name], reason=f"{name} is not installed: make test installs it where it can"
    )


def told(found: list[Figure]) -> None:
    for figure in found:
        print(figure.row())
    assert all(figure.met for figure in found), [figure.row() for figure in found if not figure.met]


@needs("mitsuba")
def test_mitsuba_reads_rgl(tmp_path: Path) -> None:
    told(format_figures.rgl_figures(tmp_path, "paint", materials.single(0.3), n=1500))


@needs("mitsuba")
def test_mitsuba_renders_the_reflectance_map(tmp_path: Path) -> None:
    told([format_figures.sphere_figure(tmp_path, "paint", materials.single(0.3), size=32, spp=36)])


@needs("mitsuba")
def test_mitsuba_reads_a_grain_with_its_azimuth(tmp_path: Path) -> None:
    """A mirror-symmetric grain turned by 30 degrees is not its own mirror image, so a flipped azimuth would show."""
    turned = materials.turned(math.radians(30), 0.3, 0.6)
    formats.export("rgl", tmp_path / "a.bsdf", material=turned)
    bsdf = peers.mitsuba_bsdf(tmp_path / "a.bsdf")
    wi, wr = format_readers.random_pairs(300, 4, 60.0)
    found = peers.mitsuba_f_cos(bsdf, wi, wr)[:, 0] / wr[:, 2]
    mirrored = turned.evaluate(wi * [1, -1, 1], wr * [1, -1, 1])[0]
    relative, wrong = np.abs(found / turned.evaluate(wi, wr)[0] - 1), np.abs(mirrored / turned.evaluate(wi, wr)[0] - 1)
    assert np.quantile(relative, 0.95) < 0.03 and np.median(wrong) > 0.05


@needs("mitsuba")
def test_mitsuba_reads_a_spectrum(tmp_path: Path) -> None:
    material = materials.spectrum(0.4)
    formats.export("rgl", tmp_path / "a.bsdf", material=material)
    bsdf = peers.mitsuba_bsdf(tmp_path / "a.bsdf", spectral=True)
    wi, wr = format_readers.random_pairs(200, 2, 60.0)
    found = peers.mitsuba_f_cos(bsdf, wi, wr, material.channels.wavelengths_nm)
    np.testing.assert_allclose(found / wr[:, 2:], material.evaluate(wi, wr).T, rtol=0.015)


@needs("mitsuba")
def test_our_tensor_reader_and_mitsubas_agree(tmp_path: Path) -> None:
    import mitsuba

    mitsuba.set_variant("scalar_rgb")
    array = {"a": np.arange(6, dtype="<f4").reshape(2, 3), "text": np.frombuffer(b"x y", dtype="u1")}
    (tmp_path / "a").write_bytes(rgl.tensor.pack(array))
    theirs = mitsuba.tensor_io.read(str(tmp_path / "a"))
    for name, value in array.items():
        np.testing.assert_array_equal(theirs[name], value)
    mitsuba.tensor_io.write(str(tmp_path / "b"), **array)
    ours = rgl.tensor.read(tmp_path / "b")
    np.testing.assert_array_equal(ours["a"], array["a"])


@needs("pyradiance")
@needs("pywincalc")
def test_radiance_and_pywincalc_read_klems(tmp_path: Path) -> None:
    told(format_figures.klems_figures(tmp_path, "paint", materials.single(0.4), probes=16))


@needs("pyradiance")
@needs("pywincalc")
def test_klems_azimuths_and_direction_of_the_matrix(tmp_path: Path) -> None:
    """A matrix of arbitrary numbers, with no symmetry but reciprocity: Radiance must find each where gonio says that it is.

    Radiance follows rays from the viewer and takes reciprocity for granted: swapping the directions of a pair of patches
    turns both by half a turn, as incident patches are mirrored.
    """
    rng = np.random.default_rng(3)
    matrix = rng.uniform(0.05, 0.2, (1, 145, 145))
    half_turn = np.argmax((klems.FULL.centres() * [-1, -1, 1]) @ klems.FULL.centres().T, axis=1)
    matrix = 0.5 * (matrix + np.swapaxes(matrix[:, half_turn][:, :, half_turn], 1, 2))
    klems.write_matrices(tmp_path / "a.xml", klems.FULL, matrix, {})
    np.testing.assert_allclose(peers.pywincalc_matrices(tmp_path / "a.xml")["back"], matrix[0], rtol=1e-12)
    centre = klems.FULL.centres()
    i, r = np.array([20, 60, 100]).repeat(6), rng.integers(0, 130, 18)
    seen = peers.radiance_f_r(tmp_path / "a.xml", centre[i] * klems.MIRRORED, centre[r])[:, 1]
    np.testing.assert_allclose(seen, matrix[0][r, i], rtol=2e-3)
    found = formats.read_channels(tmp_path / "a.xml")
    np.testing.assert_allclose(
        unit_vector(found.theta_i, found.phi_i)[145 * 7 + 20], centre[20] * klems.MIRRORED, atol=1e-12
    )
    assert found.f_r[145 * 7 + 20, 0] == matrix[0, 7, 20]


@needs("jsonschema")
@pytest.mark.parametrize("make", [materials.single, materials.rgb, materials.spectrum])
def test_bird_files_are_valid(tmp_path: Path, make: Callable[[], formats.Material]) -> None:
    formats.export("bird", tmp_path / "a.json", material=make())
    assert peers.bird_errors(tmp_path / "a.json") == []
    (tmp_path / "b.json").write_text((tmp_path / "a.json").read_text().replace('"sr^-1"', '"1/m"'))
    assert peers.bird_errors(tmp_path / "b.json") != []


@needs("jsonschema")
def test_text_formats_hold_the_brdf(tmp_path: Path) -> None:
    told(format_figures.text_figures(tmp_path, "paint", materials.single(0.3)))
    told(format_figures.opticstudio_figures(tmp_path, "paint", materials.single(0.3)))


def test_grid_formats_between_their_nodes(tmp_path: Path) -> None:
    formats.export("ssdd", tmp_path / "a.ssdd", material=materials.single(0.3))
    read = format_readers.ssdd_reader(tmp_path / "a.ssdd")
    told(format_figures.compare("ssdd", "linear", "paint", read, materials.single(0.3), 5e-3, 2000, 1))
    told(format_figures.netcdf_figures(tmp_path, "paint", materials.paint(0.3, 0.3), 2000))


@needs("jsonschema")
@needs("pywincalc")
def test_check_file_says_what_others_read(tmp_path: Path) -> None:
    formats.export("bird", tmp_path / "a", material=materials.single())
    results = check.check(tmp_path / "a")
    assert [r.ok for r in results] == [None, True] and results[1].text == "valid"
    text = (tmp_path / "a").read_text().replace('"method": "simulation"', '"method": "guess"')
    (tmp_path / "b").write_text(text)
    assert [r.ok for r in check.check(tmp_path / "b")] == [None, False]
    formats.export("cornell", tmp_path / "c", material=materials.single())
    assert check.check(tmp_path / "c")[1].text.startswith("no independent program")


@pytest.mark.gate
def test_every_figure_of_the_page(tmp_path: Path) -> None:
    found = format_figures.figures(tmp_path)
    for figure in found:
        print(figure.row())
    missed = [figure for figure in found if not figure.met]
    shown = "; ".join(f"{m.format}, {m.of}: {m.what} {m.value:.1e}" for m in missed) or "none missed"
    gates.record(
        "formats as other programs read them",
        f"{len(found) - len(missed)} of {len(found)} figures met ({shown})",
        "docs/formats.md",
        "1 to 7",
        "pytest -m gate tests/conformance/test_formats_peers.py -s",
    )
    assert not missed


@pytest.mark.gate
@needs("pyradiance")
def test_radiance_interpolates_pab_files(tmp_path: Path) -> None:
    """Its interpolant smooths, so this is a check of conventions: the matrix follows gonio's, median within 30 %."""
    material = materials.single(0.4)
    formats.export("pab", tmp_path / "pab", material=material)
    (tmp_path / "a.xml").write_bytes(peers.radiance_klems_of_pab(sorted((tmp_path / "pab").iterdir())))
    theirs = klems.read_matrices(tmp_path / "a.xml")[1][0]
    ratio = np.abs(theirs / klems.averages(material)[0] - 1)
    gates.record(
        "PAB-Opto files through Radiance's pabopto2bsdf and bsdf2klems",
        f"median difference of the cells {np.median(ratio):.2f}",
        "0.3 at most: its interpolant smooths",
        "-",
        "pytest -m gate tests/conformance/test_formats_peers.py -s",
    )
    assert np.median(ratio) < 0.3
