"""Text formats: CSV exactly there and back, OpticStudio and Cornell with hand-computed geometry, one sentence per defect."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gonio import formats
from gonio.errors import ConfigurationError, DatasetError
from gonio.formats import cornell, csv, opticstudio
from gonio.samples import BRDFSamples, SharedError

REAL = Path(__file__).parents[1] / "data" / "optics-blacks" / "AnoBlackEC1onAlum.bsdf"
HEADER = "theta_i_deg,phi_i_deg,theta_r_deg,phi_r_deg,f_r,u_f_r\n"
BSDF = """# a comment
SOURCE Measured
Symmetry {symmetry}
SpectralContent Monochrome
ScatterType BRDF
SampleRotation 1
0
AngleOfIncidence 2
0 40
ScatterAzimuth 3
0 90 180
ScatterRadial 3
0 30 60
Monochrome
DataBegin
TIS 0.1
1 2 3
1 4 5
1 6 7
TIS 0.2
8 9 10
8 11 12
8 13 0
DataEnd
"""


def put(tmp_path: Path, text: str, name: str = "file.txt") -> Path:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def random_samples(n: int = 400) -> BRDFSamples:
    rng = np.random.default_rng(5)
    u = rng.uniform(0, 0.1, n)
    u[::7] = np.nan
    f = rng.standard_normal(n) * 10.0 ** rng.uniform(-7, 3, n)
    angles = rng.uniform(0, np.pi / 2, n), rng.uniform(0, 2 * np.pi, n), rng.uniform(0, np.pi / 2, n)
    attributes = {"material": "=cmd, 'x'\nline", "quantity": "brdf"}
    return BRDFSamples.plain(*angles, rng.uniform(0, 2 * np.pi, n), f, u, attributes)


# --- CSV


def test_csv_round_trip_is_exact_and_repeatable(tmp_path: Path) -> None:
    samples = random_samples()
    csv.write(tmp_path / "a.csv", samples)
    back = csv.read(tmp_path / "a.csv").channel()
    for name in ("theta_i", "phi_i", "theta_r", "phi_r", "f_r", "u_f_r"):
        np.testing.assert_array_equal(getattr(back, name), getattr(samples, name))
    csv.write(tmp_path / "b.csv", back)
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()
    assert back.attributes["material"] == "=cmd, 'x' line"
    assert not list(tmp_path.glob(".*"))  # no temporary files stay


def test_csv_writes_round_degrees_as_they_are(tmp_path: Path) -> None:
    degrees = np.array([0.0, 30.0, 12.5, 89.999])
    csv.write(tmp_path / "a.csv", BRDFSamples.plain(np.radians(degrees), 0, np.radians(degrees), np.pi, np.ones(4)))
    rows = [line for line in (tmp_path / "a.csv").read_text().splitlines() if line[0] != "#"]
    assert rows[0] + "\n" == HEADER
    assert rows[1:] == ["0,0,0,180,1.0,", "30,0,30,180,1.0,", "12.5,0,12.5,180,1.0,", "89.999,0,89.999,180,1.0,"]


def test_csv_states_quantity_and_shared_errors(tmp_path: Path) -> None:
    plain = random_samples(3)
    shared = BRDFSamples(
        plain.theta_i, plain.phi_i, plain.theta_r, plain.phi_r, plain.f_r, plain.u_f_r, plain.pose,
        (SharedError("scale", 0.01),), np.zeros((3, 3, 1)), np.zeros((3, 3, 1)), np.ones((3, 1)),
    )  # fmt: skip
    csv.write(tmp_path / "a.csv", shared)
    text = (tmp_path / "a.csv").read_text()
    assert "# quantity: brdf [1/sr]" in text
    assert "scale u=0.01 [1]" in text


@pytest.mark.parametrize(
    ("quantity", "value"), [("brdf", 0.5), ("brf", 0.5 / math.pi), ("brdf_cos", 0.5 / math.cos(math.radians(60)))]
)
def test_csv_quantity_is_converted(tmp_path: Path, quantity: str, value: float) -> None:
    path = put(tmp_path, HEADER + "30,0,60,180,0.5,0.05\n")
    samples = formats.read_samples(path, quantity)
    assert samples.f_r[0] == pytest.approx(value, rel=1e-14)
    assert samples.u_f_r[0] == pytest.approx(value / 10, rel=1e-14)
    assert samples.attributes["source_quantity"] == quantity
    assert samples.attributes["quantity"] == "brdf"
    stated = put(tmp_path, f"# quantity: {quantity}\n" + HEADER + "30,0,60,180,0.5,0.05\n")
    assert formats.read_samples(stated).f_r[0] == pytest.approx(value, rel=1e-14)


def test_csv_details_that_programs_differ_in(tmp_path: Path) -> None:
    """Byte-order mark, Windows line ends, quotes, another order of columns, rows below the horizon."""
    text = "﻿\"f_r\",theta_i_deg,phi_i_deg,theta_r_deg,phi_r_deg\r\n-0.5, 30 ,0,60,180\r\n1,95,0,10,0\r\n\r\n"
    samples = formats.read_samples(put(tmp_path, text))
    assert len(samples) == 1 and samples.f_r[0] == -0.5 and np.isnan(samples.u_f_r[0])
    assert samples.attributes["n_below_horizon"] == "1"
    assert samples.theta_i[0] == math.pi / 6 == np.radians(30)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEADER + "1,2,3,4,nan,0\n", "line 2: 'nan' is not a finite number"),
        (HEADER + "1,2,3,4,1e999,0\n", "line 2: '1e999' is not a finite number"),
        (HEADER + "1,2,3,4,0.5\n", "line 2: 5 cells, the header names 6 columns"),
        (HEADER + "1,2,3,4,0.5,-1\n", "u_f_r = -1 is negative"),
        (HEADER + "-1,2,3,4,0.5,\n", "polar angle is outside 0 to 180 degrees"),
        (HEADER, "holds no sample above the horizon"),
        (HEADER.replace("u_f_r", "nm") + "1,2,3,4,0.5,1\n", "unknown column 'nm'"),
        ("theta_i_deg,phi_i_deg,theta_r_deg,f_r\n1,2,3,4\n", "column phi_r_deg is missing"),
        ("# quantity: lumen\n" + HEADER + "1,2,3,4,0.5,\n", "states the quantity 'lumen'"),
    ],
)
def test_csv_defects(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(DatasetError, match=message) as caught:
        formats.read(put(tmp_path, text))
    assert "\n" not in str(caught.value)


def test_csv_quantities_that_disagree(tmp_path: Path) -> None:
    path = put(tmp_path, "# quantity: brf\n" + HEADER + "1,2,3,4,0.5,\n")
    with pytest.raises(DatasetError, match="states its quantity as brf, and brdf_cos was asked for"):
        formats.read(path, "brdf_cos")
    with pytest.raises(ConfigurationError, match="no quantity 'lux'"):
        formats.read(path, "lux")


# --- OpticStudio


def test_opticstudio_real_file() -> None:
    """Counts from the file itself: 4 incidences of 19 azimuths and 12 radial angles, 778 table cells above the horizon.

    18 cells of each block repeat the specular direction, and 59 hold the 0 that means never measured.
    """
    samples = formats.read_samples(REAL)
    assert len(samples) == 778 - 4 * 18 - 59 == 647
    np.testing.assert_allclose(np.unique(np.degrees(samples.theta_i)), [10, 30, 50, 70], rtol=1e-12)
    assert samples.attributes["n_above_horizon"] == "706" and samples.attributes["n_missing"] == "59"
    assert samples.attributes["material"].startswith("Anoplate AnoBlack EC1")
    assert np.all(np.isnan(samples.u_f_r)) and np.all(samples.f_r > 0)
    assert samples.f_r[0] == 3.480e-02  # specular value of the first block
    assert (samples.theta_r[0], samples.phi_r[0]) == pytest.approx((math.radians(10), math.pi), rel=1e-12)


def test_opticstudio_one_geometry_by_hand(tmp_path: Path) -> None:
    """Specular at 40 degrees, radial 30, azimuth 0 (towards the normal): 10 degrees on the specular side.

    Azimuth 180 goes the other way, to 70 degrees. Azimuth 90, radial 60 leaves the plane: z = cos 60 cos 40,
    x = -cos 60 sin 40, y = sin 60.
    """
    samples = formats.read_samples(put(tmp_path, BSDF.format(symmetry="PlaneSymmetrical")))
    by_value = {float(f): (float(a), float(b)) for f, a, b in zip(samples.f_r, samples.theta_r, samples.phi_r, strict=True)}
    assert by_value[9] == pytest.approx((math.radians(10), math.pi))
    assert by_value[10] == pytest.approx((math.radians(20), 0.0), abs=1e-12)  # beyond the normal, on the lamp's side
    assert by_value[13] == pytest.approx((math.radians(70), math.pi))
    x, y, z = -0.5 * math.sin(math.radians(40)), math.sqrt(0.75), 0.5 * math.cos(math.radians(40))
    assert by_value[12] == pytest.approx((math.acos(z), math.atan2(y, x)))
    assert sorted(by_value) == [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13]  # radial 0 once for each incidence


def test_opticstudio_azimuth_0_points_to_the_normal() -> None:
    """The file's own zeros show the convention: nothing was measured below the horizon.

    If azimuth 0 pointed away from the normal, 114 measured cells would lie below it.
    """
    rows = [line.split() for line in REAL.read_text().splitlines() if line and line[0].isdigit()]
    values = np.array([row for row in rows if len(row) == 12][1:], dtype=float).reshape(4, 19, 12)
    a = np.radians([10, 30, 50, 70])[:, None, None]
    az, r = np.radians(np.arange(0, 181, 10))[:, None], np.radians([0, 5, 10, 15, 20, 30, 40, 50, 60, 70, 80, 90])
    towards = np.cos(a) * np.cos(r) + np.sin(a) * np.sin(r) * np.cos(az)
    away = np.cos(a) * np.cos(r) - np.sin(a) * np.sin(r) * np.cos(az)
    assert np.count_nonzero(values[away < -1e-9]) == 114
    assert np.count_nonzero(values[towards < -1e-9]) == 0
    samples = formats.read_samples(REAL)
    assert np.sum(samples.f_r) == pytest.approx(np.sum(values) - 18 * np.sum(values[:, 0, 0]), rel=1e-12)


def test_opticstudio_words_in_any_case_and_4d(tmp_path: Path) -> None:
    text = BSDF.format(symmetry="ASYMMETRICAL4D").replace("SampleRotation 1\n0", "samplerotation 2\n0 90")
    blocks = text[text.index("TIS") : text.index("DataEnd")]
    samples = formats.read_samples(put(tmp_path, text.replace(blocks, blocks + blocks).replace("DataEnd", "dataend")))
    np.testing.assert_allclose(np.unique(samples.phi_i), [0, 1.5 * math.pi])
    first, second = samples.select(samples.phi_i == 0), samples.select(samples.phi_i > 0)
    np.testing.assert_allclose(np.mod(second.phi_r + math.pi / 2 - first.phi_r + 1, 2 * math.pi), 1.0)


def test_opticstudio_colour_reads_y(tmp_path: Path) -> None:
    text = BSDF.format(symmetry="PlaneSymmetrical").replace("SpectralContent Monochrome", "SpectralContent XYZ")
    body = text[text.index("DataBegin") :]
    y = body.replace("TIS 0.1\n1 2 3", "TIS 0.1\n1 2 33")
    text = text.replace("Monochrome\n" + body, f"TristimulusX\n{body}TristimulusY\n{y}TristimulusZ\n{body}")
    found = formats.read_channels(put(tmp_path, text))
    assert found.channels.names == ("X", "Y", "Z") and 33 in formats.read_samples(tmp_path / "file.txt").f_r
    assert 33 not in found.channel("X").f_r


BAD_BSDF: list[tuple[Callable[[str], str], str]] = [
    (lambda t: t.replace("1 4 5", "1 4"), "line 18: 2 values, the header announces 3 radial angles"),
    (lambda t: t.replace("1 4 5", "1 inf 5"), "line 18: 'inf' is not a finite number"),
    (lambda t: t.replace("1 4 5", "1 -4 5"), "-4 is negative"),
    (lambda t: t.replace("AngleOfIncidence 2", "AngleOfIncidence 999999999"), "not a count from 1 to 1000"),
    (lambda t: t.replace("AngleOfIncidence 2\n0 40", "AngleOfIncidence 2\n0 40 50"), "announces 2 angles and lists 3"),
    (lambda t: t.replace("0 40\n", "40 0\n"), "must rise"),
    (lambda t: t.replace("0 40\n", "0 95\n"), "AngleOfIncidence runs from 0 to 95"),
    (lambda t: t.replace("ScatterType BRDF", "ScatterType BTDF"), "reflection"),
    (lambda t: t.replace("PlaneSymmetrical", "Round"), "Symmetry is 'round'"),
    (lambda t: t.replace("ScatterRadial 3\n0 30 60\n", ""), "list scatterradial is missing"),
    (lambda t: t.replace("0 90 180", "0 90 270"), "goes to 270 degrees"),
    (lambda t: t[: t.index("TIS 0.2")], "ends before block 2 of 2"),
    (lambda t: t[: t.index("DataBegin")], "ends before DataBegin"),
    (lambda t: t.replace("DataEnd", "TIS 3"), "DataEnd is expected"),
    (lambda t: t.replace("Monochrome\nDataBegin", "Bichrome\nDataBegin"), "unknown keyword 'Bichrome'"),
    (lambda t: t.replace("ScatterAzimuth 3\n0 90 180", "ScatterAzimuth 300\n" + " ".join(f"{k / 2}" for k in range(300))),
     "more than its bytes can hold|values, the header"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "message"), BAD_BSDF)
def test_opticstudio_defects(tmp_path: Path, change: Callable[[str], str], message: str) -> None:
    text = change(BSDF.format(symmetry="PlaneSymmetrical"))
    assert text != BSDF.format(symmetry="PlaneSymmetrical")
    with pytest.raises(DatasetError, match=message) as caught:
        opticstudio.read(put(tmp_path, text))
    assert "\n" not in str(caught.value) and "file.txt" in str(caught.value)


# --- Cornell

CORNELL = "# paint\n3\n450 550 650\n0.5 0 0.7 3.14159  0.1 0.2 0.3\n0.2 1.0\n0.3 2.0 0.4 0 0.6\n1.6 0 0.1 0 9 9 9\n"


def test_cornell_rows_in_free_format(tmp_path: Path) -> None:
    samples = formats.read_samples(put(tmp_path, CORNELL))
    np.testing.assert_array_equal(samples.f_r, [0.2, 0.0])  # 550 nm; the row at 92 degrees is left out, a 0 is data
    np.testing.assert_array_equal(samples.theta_r, [0.7, 0.3])
    assert samples.attributes["wavelength_nm"] == "550"
    assert samples.attributes["n_below_horizon"] == "1"
    np.testing.assert_array_equal(formats.read_samples(tmp_path / "file.txt", channel="650nm").f_r, [0.3, 0.6])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (CORNELL[:-3], "do not make rows of 4 angles and 3 values"),
        (CORNELL.replace("0.7 ", "70 "), "line 4: an angle is beyond half a turn"),
        (CORNELL.replace("3\n", "2.5\n", 1), "'2.5' is not a count"),
        (CORNELL.replace("450", "-450"), "wavelength is not between"),
        (CORNELL.replace("0.2 1.0", "0.2 nan"), "line 5: 'nan' is not a finite number"),
        ("", "is not a count"),
    ],
)
def test_cornell_defects(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(DatasetError, match=message):
        cornell.read(put(tmp_path, text))


def test_quantity_that_the_user_knows_better(tmp_path: Path) -> None:
    samples = formats.read_samples(put(tmp_path, CORNELL), "brdf_cos")
    assert samples.f_r[0] == pytest.approx(0.2 / math.cos(0.7))
    assert samples.attributes["source_quantity"].startswith("brdf_cos")
