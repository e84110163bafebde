"""More than a hundred malformed files by hand: (format, what is done to a good small file, what the one sentence says)."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gonio import formats
from gonio.formats import merl, tensor
from tests import materials

Edit = Callable[[bytes], bytes]
ANGLES = "theta_i_deg,phi_i_deg,theta_r_deg,phi_r_deg"
CSV = f"# quantity: brdf\n{ANGLES},f_r,u_f_r\n30,0,45,180,0.25,0.01\n40,0,45,180,0.3,\n".encode()
CORNELL = b"# paint\n2\n450 550\n0.5 0 0.7 3.1 0.1 0.2\n0.6 0 0.7 3.1 0.2 0.3\n"
ASTM = b"COMMENT x\nNUM_POINTS 2\nVARS theta_i,phi_i,theta_s,phi_s,R,G,B\n0.5,0,0.7,3.1,1,2,3\n0.6,0,0.7,3.1,4,5,6\n"
ALTA = (
    b"#ALTA_BEGIN_HEADER\n#DIM 3 1\n#PARAM_IN ISOTROPIC_TV_TL_DPHI\n#PARAM_OUT INV_STERADIAN\n#VS 0\n#ALTA_END_HEADER\n"
    b"0.5 0.4 3.0 0.2\n0.6 0.4 3.0 0.3\n"
)
SSDD = (
    b"VERSION 0.2\n\nDATA_TYPE brdf\nCOLOR_MODEL monochrome\nPARAM_TYPE spherical_coordinate_system\nPARAM0_LIST 0 45\n"
    b"PARAM2_LIST 0 30 60\nPARAM3_LIST 0 90\nDATA ascii\n" + b"0.1\n" * 12
)
OPTICSTUDIO = (
    b"Source Measured\nSymmetry PlaneSymmetrical\nSpectralContent Monochrome\nScatterType BRDF\nSampleRotation 1\n0\n"
    b"AngleOfIncidence 2\n0 40\nScatterAzimuth 2\n0 180\nScatterRadial 2\n0 30\nMonochrome\nDataBegin\nTIS 0.1\n1 2\n1 4\n"
    b"TIS 0.2\n8 9\n8 3\nDataEnd\n"
)
LIGHTTOOLS = (
    b"Symmetry Asymmetric\nSpectralContent Monochrome\nScatterAzimuth 2\n0 90\nScatterRadial 2\n10 40\nDataBegin\n"
    b"AOI 40\nPOI 90\nSide Front\nWavelength 550\nScatterType BRDF\nTIS 0.1\n1 2\n3 4\nDataEnd\n"
)
OPENMATERIAL = (
    b'{"metadata": {"name": "x"}, "brdf": {"lookupTable": [[5.5e-7, 0.5, 0.2, 3.0, 0.1], [5.5e-7, 0.6, 0.2, 3.0, 0.2]]}}'
)
SCATTERED = [[(400 + k % 2000) * 1e-9, 1e-4 * k, 0.2, 3.0, 0.1] for k in range(12_000)]  # each wavelength elsewhere


def bird() -> bytes:
    column = {"unit": "rad", "values": [0.1, 0.2]}
    data: dict[str, Any] = {name: dict(column) for name in ("theta_i", "phi_i", "theta_r", "phi_r")}
    data["BRDF"] = {"unit": "sr^-1", "values": [0.3, 0.4]}
    data["uBRDF"] = {"unit": "%", "values": [1, 2]}
    return json.dumps({"metadata": {"schema": "brdf_json_schema_v1.0.json"}, "data": data}).encode()


def xml() -> bytes:
    bounds = "<ThetaBounds><LowerTheta>{}</LowerTheta><UpperTheta>{}</UpperTheta></ThetaBounds>"
    rings = "".join(
        f"<AngleBasisBlock><Theta>{a}</Theta><nPhis>{n}</nPhis>{bounds.format(a, b)}</AngleBasisBlock>"
        for a, b, n in ((0, 30, 1), (30, 90, 2))
    )
    return (
        "<WindowElement><Optical><Layer><DataDefinition><IncidentDataStructure>Columns</IncidentDataStructure><AngleBasis>"
        f"<AngleBasisName>three</AngleBasisName>{rings}</AngleBasis></DataDefinition><WavelengthData><Wavelength>Visible"
        "</Wavelength><WavelengthDataBlock><WavelengthDataDirection>Reflection Front</WavelengthDataDirection>"
        "<ColumnAngleBasis>three</ColumnAngleBasis><RowAngleBasis>three</RowAngleBasis><ScatteringData>1,2,3,4,5,6,7,8,9"
        "</ScatteringData></WavelengthDataBlock></WavelengthData></Layer></Optical></WindowElement>"
    ).encode()


def fields() -> dict[str, np.ndarray]:
    one = np.ones((2, 2), dtype="<f4")
    return {
        "theta_i": np.array([0.0, 0.5], dtype="<f4"),
        "phi_i": np.zeros(1, dtype="<f4"),
        "ndf": one,
        "sigma": one,
        "vndf": np.ones((1, 2, 2, 2), dtype="<f4"),
        "rgb": np.full((1, 2, 3, 4, 4), 0.1, dtype="<f4"),
        "jacobian": np.ones(1, dtype="u1"),
    }


def rgl(**changed: np.ndarray | None) -> bytes:
    return tensor.pack({k: v for k, v in (fields() | changed).items() if v is not None})


def netcdf(folder: Path) -> bytes:
    formats.export("netcdf", folder / "good.nc", samples=materials.rgb().rows().select(np.arange(12)))
    return (folder / "good.nc").read_bytes()


def swap(old: str, new: str) -> Edit:
    def edit(data: bytes) -> bytes:
        assert old.encode() in data, old
        return data.replace(old.encode(), new.encode(), 1)

    return edit


def cut(at: str) -> Edit:
    return lambda data: data[: data.index(at.encode())]


def give(data: bytes) -> Edit:
    return lambda _good: data


def edit_json(change: Callable[[Any], object]) -> Edit:
    def edit(data: bytes) -> bytes:
        document = json.loads(data)
        change(document)
        return json.dumps(document).encode()

    return edit


def put(path: str, value: Any) -> Edit:
    def change(document: Any) -> None:
        *inner, last = path.split(".")
        for key in inner:
            document = document[int(key) if key.isdigit() else key]
        document[int(last) if last.isdigit() else last] = value

    return edit_json(change)


def deep(n: int) -> bytes:
    return b'{"metadata": 1, "BRDF": ' + b"[" * n + b"]" * n + b"}"


def poke(at: int, form: str, *values: int) -> Edit:
    def edit(data: bytes) -> bytes:
        out = bytearray(data)
        struct.pack_into(form, out, at, *values)
        return bytes(out)

    return edit


NAN = np.full((1, 2, 3, 4, 4), np.nan, dtype="<f4")
VNDF_SHAPE = rgl().index(b"vndf") + len("vndf") + 2 + 1 + 8
FIRST_FIELD = 18 + 2 + len("theta_i")  # where its dimensions stand
GOOD: dict[str, Callable[[Path], bytes]] = {
    "csv": lambda _: CSV,
    "cornell": lambda _: CORNELL,
    "astm": lambda _: ASTM,
    "alta": lambda _: ALTA,
    "ssdd": lambda _: SSDD,
    "opticstudio": lambda _: OPTICSTUDIO,
    "lighttools": lambda _: LIGHTTOOLS,
    "openmaterial": lambda _: OPENMATERIAL,
    "bird": lambda _: bird(),
    "klems": lambda _: xml(),
    "rgl": lambda _: rgl(),
    "netcdf": netcdf,
    "merl": lambda _: merl.HEADER + bytes(64),
    "utia": lambda _: np.full(3 * 288 * 288, 0.5).tobytes(),
}
BAD: list[tuple[str, Edit, str]] = [
    ("csv", give(b""), "is empty"),
    ("csv", give(b"hello\n"), "in no format that gonio knows"),
    ("csv", give(b"CDF\x01 old"), "a NetCDF-3 file"),
    ("csv", give(b"OPTIS - brdf surface file v8.0\n"), "a Speos BRDF"),
    ("csv", give(b"<svg></svg>"), "XML of another kind"),
    ("csv", swap("0.25", "nan"), "line 3: 'nan' is not a finite"),
    ("csv", swap("0.25", "1e999"), "line 3: '1e999' is not"),
    ("csv", swap("0.25", "0x10"), "'0x10' is not"),
    ("csv", swap("0.25", "\u0663"), "is not a finite number"),
    ("csv", swap(",0.01", ""), "5 cells, the header names 6"),
    ("csv", swap("0.01", "-1"), "u_f_r = -1 is negative"),
    ("csv", swap("30,0", "-30,0"), "polar angle is outside"),
    ("csv", swap("30,0", "3e7,0"), "an angle of 3e+07 degrees"),
    ("csv", swap(",f_r,", ",f_q,"), "unknown column 'f_q'"),
    ("csv", swap("phi_i_deg", "theta_i_deg"), "column phi_i_deg is missing"),
    ("csv", swap("f_r,u_f_r", "f_r,f_r"), "a column is named twice"),
    ("csv", swap(",f_r,u_f_r", ",f_r_red,f_r_blue"), "channels 'red, blue' are unknown"),
    ("csv", swap(",f_r,u_f_r", ",f_r_-5nm,f_r_6nm"), "a wavelength is not between 0 and 1e6 nm: -5"),
    ("csv", swap("brdf", "lumen"), "states the quantity 'lumen'"),
    ("csv", cut("30,0"), "holds no sample above the horizon"),
    ("csv", lambda d: d + b"\0", "holds zero bytes"),
    ("csv", lambda d: d + b"\xff\xfe", "line 5: not UTF-8"),
    ("cornell", swap("2\n450", "3\n450"), "do not make rows of 4 angles and 3"),
    ("cornell", swap("2\n450", "99999\n450"), "'99999' is not a count"),
    ("cornell", swap("450", "-450"), "between 0 and 1e6 nm: -450"),
    ("cornell", swap("450 550", "550 550"), "a wavelength stands twice"),
    ("cornell", swap("0.5 0 0.7", "50 0 0.7"), "line 4: an angle is beyond half a turn"),
    ("cornell", lambda d: d.replace(b" 0.7 ", b" 1.7 "), "no sample above the horizon"),
    ("astm", cut("VARS"), "no format that gonio knows"),
    ("astm", swap("NUM_POINTS 2\n", ""), "does not say NUM_POINTS"),
    ("astm", swap("NUM_POINTS 2", "NUM_POINTS 3"), "announces 3 rows, 2 are there"),
    ("astm", swap("NUM_POINTS 2", "NUM_POINTS 99999999999"), "'99999999999' is not a count"),
    ("astm", swap("theta_s", "theta_q"), "VARS must be theta_i"),
    ("astm", swap(",R,G,B", ",R,G,Q"), "channels 'R, G, Q' are unknown"),
    ("astm", swap(",1,2,3", ",1,2"), "6 numbers, a row of this file has 7"),
    ("astm", swap("0.5,0", "inf,0"), "line 4: 'inf' is not"),
    ("astm", swap("0.5,0", "50,0"), "line 4: an angle is beyond"),
    ("alta", swap("#DIM 3 1\n", ""), "lacks #DIM"),
    ("alta", swap("#DIM 3 1", "#DIM 4 1"), "4 columns of 'ISOTROPIC_TV_TL_DPHI'"),
    ("alta", swap("#DIM 3 1", "#DIM 9 1"), "'9' is not a count from 1 to 6"),
    (
        "alta",
        lambda d: d.replace(b"#DIM 3 1", b"#DIM 2 2").replace(b"ISOTROPIC_TV_TL_DPHI", b"RUSIN_TH_TD"),
        "has 2 values in a row and does not say",
    ),
    ("alta", swap("ISOTROPIC_TV_TL_DPHI", "STARK_3D"), "3 columns of 'STARK_3D'"),
    ("alta", swap("INV_STERADIAN", "ENERGY"), "PARAM_OUT 'ENERGY'"),
    ("alta", swap("#VS 0", "#VS 7"), "#VS '7' must be"),
    ("alta", swap("#VS 0", "#VS 1"), "4 numbers, a row of this file has 5"),
    ("alta", swap("0.5 0.4", "45 0.4"), "a coordinate of 45"),
    ("alta", swap("0.5 0.4", "-0.5 0.4"), "line 7: an angle is beyond half a turn"),
    ("alta", swap("0.2\n", "0_2\n"), "'0_2' is not a finite"),
    ("alta", cut("0.5 0.4"), "holds no row of data"),
    ("ssdd", swap("COLOR_MODEL monochrome", "COLOR_MODEL cmyk"), "COLOR_MODEL 'cmyk'"),
    ("ssdd", swap("COLOR_MODEL monochrome", "COLOR_MODEL spectrum"), "between 0 and 1e6 nm: 0"),
    ("ssdd", swap("spherical", "polar"), "PARAM_TYPE 'polar_coordinate_system'"),
    ("ssdd", swap("PARAM0_LIST 0 45", "PARAM0_LIST 45 0"), "PARAM0_LIST must rise"),
    ("ssdd", swap("PARAM2_LIST 0 30 60", "PARAM2_LIST 0 30 95"), "PARAM2_LIST must rise within 0 to 90"),
    ("ssdd", swap("DATA ascii", "DATA base64"), "DATA 'base64' must be"),
    ("ssdd", lambda d: d.replace(b"DATA ascii", b"DATA binary")[:-4], "announce 48 bytes, 44 are left"),
    ("ssdd", lambda d: d[:-8], "ends after 10 of 12 values|more than the bytes left"),
    ("ssdd", swap("PARAM0_LIST 0 45", "PARAM0_LIST " + " ".join(str(k / 9) for k in range(800))), "announce 4800 values"),
    ("ssdd", swap("0.1\n", "0.1 0.2\n"), "2 numbers, a colour of this file has 1"),
    ("ssdd", swap("0.1\n", "-0.1\n"), "a value of -0.1 is negative"),
    ("ssdd", swap("0.1\n", "nan\n"), "line 10: 'nan' is not"),
    ("ssdd", swap("DATA_TYPE brdf", "DATA_TYPE btdf"), "no block of data type brdf"),
    ("ssdd", swap("PARAM_TYPE", "PARAMETER"), "unknown entry 'PARAMETER'"),
    ("ssdd", swap("DATA ascii", "PARAM4_LIST 0 1\nDATA ascii"), "PARAM4_LIST (offsets"),
    ("opticstudio", swap("1 4\n", "1\n"), "line 17: 1 values, the header announces 2"),
    ("opticstudio", swap("1 4\n", "1 -4\n"), "a value of -4 is negative"),
    ("opticstudio", swap("1 4\n", "1 inf\n"), "line 17: 'inf' is not"),
    ("opticstudio", swap("AngleOfIncidence 2", "AngleOfIncidence 2000000"), "'2000000' is not a count from 1 to 1000"),
    ("opticstudio", swap("AngleOfIncidence 2\n0 40", "AngleOfIncidence 2\n0 40 50"), "announces 2 angles and lists 3"),
    ("opticstudio", swap("0 40", "40 0"), "AngleOfIncidence must rise"),
    ("opticstudio", swap("0 40", "0 90"), "AngleOfIncidence runs from 0 to 90"),
    ("opticstudio", swap("0 180", "0 270"), "ScatterAzimuth goes to 270"),
    ("opticstudio", swap("ScatterType BRDF", "ScatterType BTDF"), "reflection (BRDF) only"),
    ("opticstudio", swap("PlaneSymmetrical", "Round"), "Symmetry is 'round'"),
    ("opticstudio", swap("ScatterRadial 2\n0 30\n", ""), "list scatterradial is missing"),
    ("opticstudio", cut("TIS 0.2"), "ends before block 2 of 2"),
    ("opticstudio", cut("Monochrome\nDataBegin"), "ends before DataBegin"),
    ("opticstudio", swap("DataEnd", "TIS 3"), "DataEnd is expected"),
    ("opticstudio", swap("TIS 0.1", "SIT 0.1"), "must begin with TIS"),
    ("opticstudio", swap("Monochrome\nDataBegin", "Bichrome\nDataBegin"), "unknown keyword 'Bichrome'"),
    ("opticstudio", swap("Monochrome\nDataBegin", "TristimulusY\nDataBegin"), "TristimulusX comes first"),
    (
        "opticstudio",
        swap("Monochrome\nDataBegin", "TristimulusX\nDataBegin"),
        "the header announces 24 values|ends before tristimulusy",
    ),
    ("opticstudio", lambda d: d.replace(b"1 2\n1 4", b"0 0\n0 0").replace(b"8 9\n8 3", b"0 0\n0 0"), "means never measured"),
    ("lighttools", swap("ScatterAzimuth 2", "ScatterAzimuth 0"), "'0' is not a count"),
    ("lighttools", swap("0 90\n", "90 0\n"), "ScatterAzimuth must rise"),
    ("lighttools", swap("10 40", "10 240"), "ScatterRadial goes to 240"),
    ("lighttools", swap("SpectralContent Monochrome", "SpectralContent RGB"), "SpectralContent 'rgb'"),
    ("lighttools", swap("Symmetry", "Symmetric"), "unknown keyword 'Symmetric'"),
    ("lighttools", swap("AOI 40", "AOI 95"), "AOI 95, POI 90"),
    ("lighttools", swap("3 4\n", "3 -4\n"), "a value of -4 is negative; a BRDF"),
    ("lighttools", cut("3 4"), "ends before the 4 values"),
    ("lighttools", swap("ScatterType BRDF", "ScatterType BTDF"), "no block of front-side"),
    ("lighttools", swap("Wavelength", "Wellenlaenge"), "unknown keyword 'Wellenlaenge'"),
    ("lighttools", swap("DataEnd", "AOI 40 TIS 1 1 2 3 4 DataEnd"), "two blocks for incidence 40"),
    ("lighttools", swap("DataEnd", "AOI 40 POI 0 TIS 1 1 2 3 4 DataEnd"), "has several POI"),
    ("openmaterial", swap("0.2, 3.0, 0.1]", "0.2, 3.0]"), "row 0 of lookupTable must be 5"),
    ("openmaterial", swap("0.1]", "NaN]"), "NaN is no JSON number"),
    ("openmaterial", swap("0.1]", "-0.1]"), "a value of -0.1 in lookupTable"),
    ("openmaterial", swap("0.1]", '"0.1"]'), "value 4 of lookupTable is not a number"),
    ("openmaterial", swap("0.1]", "1e400]"), "value 4 of lookupTable is not finite"),
    ("openmaterial", swap("0.5, 0.2", "45, 0.2"), "row 0 of lookupTable has an angle"),
    ("openmaterial", swap("5.5e-7", "-5.5e-7"), "between 0 and 1e6 nm: -550"),
    ("openmaterial", swap('"brdf"', '"bsdf"'), "'brdf' must be an object, and is missing"),
    ("openmaterial", put("brdf.lookupTable", {}), "'lookupTable' must be a list, and is not"),
    ("openmaterial", put("brdf.lookupTable", []), "lookupTable holds no value"),
    ("openmaterial", put("brdf.lookupTable", SCATTERED), "12000 directions times 2000 wavelengths"),
    ("bird", lambda d: d[:-9], "line 1: not JSON"),
    ("bird", give(deep(100_000)), "nested without end"),
    ("bird", give(b'{"metadata": 1, "metadata": 2, "BRDF": 1}'), "'metadata' stands twice"),
    ("bird", swap("0.3, 0.4", "0.3, Infinity"), "Infinity is no JSON number"),
    ("bird", put("data.BRDF.values", [0.3]), "the columns have different lengths"),
    ("bird", put("data.BRDF.values", [0.3, -0.4]), "a value of BRDF or uBRDF is negative"),
    ("bird", put("data.BRDF.values", [0.3, True]), "value 1 of BRDF is not a number"),
    ("bird", put("data.BRDF.values", "0.3"), "'values' must be a list, and is not"),
    ("bird", put("data.BRDF.unit", "1/m"), "the unit of BRDF is '1/m'"),
    ("bird", put("data.theta_i.unit", ["rad"]), "the unit of theta_i"),
    ("bird", put("data.uBRDF.values", [1]), "uBRDF has 1 values, BRDF 2"),
    ("bird", put("data.theta_r.values", [1.7, 1.8]), "no sample above the horizon"),
    ("bird", put("data.theta_r.values", [30, 40]), "check the units of the angles"),
    ("bird", put("data.wavelength_i", {"unit": "nm", "values": [500]}), "wavelength_i has 1 values"),
    ("bird", put("data.phi_i", 7), "'phi_i' must be an object"),
    ("bird", put("data.polarization_i", {"values": ["s", "p"]}), "polarization_i changes from row to row"),
    ("bird", put("data", []), "'data' must be an object"),
    ("klems", lambda d: b"<!DOCTYPE x [<!ENTITY a 'aa'>]>" + d, "a DOCTYPE is refused"),
    ("klems", lambda d: d[:-5], "not XML"),
    ("klems", lambda d: d.replace(b"<Optical>", b"<Optical>" + b"<a>" * 60), "too deep"),
    ("klems", swap("Columns", "Diagonals"), "IncidentDataStructure 'diagonals'"),
    ("klems", swap("Columns", "TensorTree3"), "is a tensor tree"),
    ("klems", swap("1,2,3,4", "1,2,3"), "has 8 values, three needs 9"),
    ("klems", swap("1,2,3,4", "1,2,3,nan"), "'nan' is not a finite"),
    ("klems", swap("1,2,3,4", "1,2,3,-4"), "a value of -4 in reflection front"),
    ("klems", swap("Reflection Front", "Transmission Front"), "holds no reflection matrix"),
    ("klems", swap("<RowAngleBasis>three", "<RowAngleBasis>four"), "incident and reflected basis differ"),
    ("klems", lambda d: d.replace(b"AngleBasis>three", b"AngleBasis>four"), "the angle basis 'four' is neither"),
    ("klems", swap("<nPhis>2", "<nPhis>9999999"), "'9999999' is not a count"),
    ("klems", swap("<LowerTheta>30", "<LowerTheta>40"), "rings must follow each other"),
    ("klems", lambda d: d.replace(b"ThetaBounds", b"Bounds"), "has no ThetaBounds"),
    ("klems", lambda d: d.replace(b"DataDefinition", b"Definition"), "no WindowElement with a DataDefinition"),
    ("rgl", give(tensor.MAGIC), "a tensor file of version"),
    ("rgl", lambda d: d[:40], "ends within its table of fields"),
    ("rgl", poke(14, "<I", 2**31), "announces 2147483648 fields"),
    ("rgl", poke(18, "<H", 60000), "a field's name of 60000 bytes"),
    ("rgl", poke(FIRST_FIELD, "<H", 999), "type 10 and 999 dimensions"),
    ("rgl", poke(FIRST_FIELD + 2, "<B", 77), "type 77 and 1 dimensions"),
    ("rgl", poke(FIRST_FIELD + 3, "<Q", 2**63), "at 9223372036854775808 is beyond"),
    ("rgl", poke(FIRST_FIELD + 11, "<Q", 2**62), "field 'theta_i' of 4611686018427387904 values"),
    ("rgl", poke(VNDF_SHAPE, "<4Q", 0, 2**62, 2**40, 4), "the field vndf has shape (0,)"),
    ("rgl", give(rgl(vndf=None)), "the field vndf is missing"),
    ("rgl", give(rgl(rgb=None)), "neither a table rgb nor spectra"),
    ("rgl", give(rgl(rgb=NAN)), "a value of rgb is not finite"),
    ("rgl", give(rgl(rgb=np.ones((1, 2, 4, 4, 4), dtype="<f4"))), "rgb has 4 channels"),
    ("rgl", give(rgl(rgb=np.ones((1, 9, 3, 4, 4), dtype="<f4"))), "do not fit"),
    ("rgl", give(rgl(theta_i=np.array([0, 7], dtype="<f4"))), "theta_i or phi_i is outside"),
    ("rgl", give(rgl(vndf=np.zeros((1, 2, 2, 2), dtype="<f4"))), "vndf is negative or 0 everywhere"),
    ("rgl", give(rgl(rgb=None, spectra=np.ones((1, 2, 2, 4, 4), dtype="<f4"))), "wavelengths do not fit the 2 spectra"),
    ("rgl", give(rgl(ndf=np.ones(3, dtype="<f4"))), "the field ndf has shape"),
    ("merl", lambda d: d[:60], "has 60 bytes, a MERL file has"),
    ("merl", lambda d: d + bytes(100), "has 176 bytes, a MERL file has"),
    ("utia", lambda d: d[:-8] + struct.pack("<d", np.inf), "is no sRGB-encoded reflectance"),
    ("utia", lambda d: d[:-8] + struct.pack("<d", -1e9), "value 248831 of 248832 (-1e+09)"),
    ("netcdf", lambda d: d[: len(d) // 2], "damaged NetCDF-4 file"),
    ("netcdf", lambda d: d[:200], "damaged NetCDF-4 file"),
    ("netcdf", lambda d: d[:8] + bytes(len(d) - 8), "is a damaged NetCDF-4 file"),
]
