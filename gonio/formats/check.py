"""The same file through gonio and through another program: the largest difference. What `gonio check-file` prints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gonio import formats
from gonio.brdf.tables import Tables
from gonio.channels import ChannelSamples
from gonio.errors import DatasetError
from gonio.formats import klems, peers
from gonio.geometry import unit_vector

POINTS = 2000
CELLS = 48


@dataclass(frozen=True)
class Result:
    """What one program said: `ok` is None if it was not asked."""

    reader: str
    text: str
    ok: bool | None


def check(path: Path) -> list[Result]:
    """All programs that can read the format; `DatasetError` if gonio itself cannot read the file."""
    name = formats.sniff(path)
    found = formats.read(path)
    n = len(found.channels) if isinstance(found, ChannelSamples) else 1
    mine = "a table" if isinstance(found, Tables) else f"{len(found)} directions in {n} channel{'s' * (n > 1)}"
    out = [Result("gonio", f"{formats.FORMATS[name].doc}, {mine}", None)]
    there = peers.installed()
    for program, reader, function in _READERS.get(name, ()):
        if not there[program]:
            out.append(Result(reader, f"not installed (pip install {program})", None))
            continue
        try:
            out.append(function(path, reader))
        except DatasetError as error:
            out.append(Result(reader, str(error), False))
    if len(out) == 1:
        out.append(Result("others", f"no independent program is known here that reads {name}", None))
    return out


def _differences(reader: str, what: str, difference: float, limit: float) -> Result:
    return Result(reader, f"largest difference {difference:.2e} {what} (allowed {limit:.0e})", bool(difference <= limit))


def _mitsuba(path: Path, reader: str) -> Result:
    found = formats.read_channels(path)
    waves = found.channels.wavelengths_nm
    bsdf = peers.mitsuba_bsdf(path, spectral=waves is not None)
    # f_r cos(theta_r) is what the file holds: differences are of that, against its largest value at the incidence
    take = np.random.default_rng(0).permutation(len(found))[:POINTS]
    some = found.select(np.sort(take))
    wi, wr = unit_vector(some.theta_i, some.phi_i), unit_vector(some.theta_r, some.phi_r)
    ours = some.f_r * wr[:, 2:]
    theirs = peers.mitsuba_f_cos(bsdf, wi, wr, None if waves is None else waves[:4])
    ours = ours[:, : theirs.shape[1]] if ours.shape[1] > 1 else np.repeat(ours, theirs.shape[1], axis=1)
    difference = float(np.abs(theirs - ours).max() / np.abs(ours).max())
    return _differences(reader, f"of f_r cos(theta_r), in units of the largest, at {len(some)} nodes", difference, 1e-3)


def _pywincalc(path: Path, reader: str) -> Result:
    _, matrices, side = klems.read_matrices(path)
    if len(matrices) > 1:
        return Result(reader, "not asked: it reads no CIE-X and CIE-Z, which this file of colours has", None)
    theirs = peers.pywincalc_matrices(path)["front" if side.endswith("front") else "back"]
    ours = matrices[len(matrices) // 2]
    if theirs.shape != ours.shape:
        raise DatasetError(f"pywincalc reads a matrix of {theirs.shape}, gonio one of {ours.shape}")
    difference = float(np.abs(theirs - ours).max() / np.abs(ours).max())
    return _differences(reader, f"of {ours.size} cells, in units of the largest", difference, 1e-6)


def _radiance(path: Path, reader: str) -> Result:
    basis, matrices, _ = klems.read_matrices(path)
    rng = np.random.default_rng(0)
    centre = basis.centres()
    i = rng.choice(len(basis), 6).repeat(CELLS // 6)
    r = rng.choice(len(basis), CELLS)
    theirs = peers.radiance_f_r(path, centre[i] * klems.MIRRORED, centre[r]) @ peers.RADIANCE_LUMINANCE
    ours = matrices[len(matrices) // 2][r, i]
    difference = float(np.abs(theirs - ours).max() / np.abs(ours).max())
    low, mean, high = peers.radiance_reciprocity_percent(path)
    what = f"of {CELLS} cells, in units of the largest; checkBSDF: reciprocity error {low:g} to {high:g} %, mean {mean:g} %"
    return _differences(reader, what, difference, 5e-3)


def _jsonschema(path: Path, reader: str) -> Result:
    errors = peers.bird_errors(path)
    return Result(reader, "valid" if not errors else f"{len(errors)} violations, first: {errors[0]}", not errors)


def _xarray(path: Path, reader: str) -> Result:
    import xarray

    found = formats.read(path)
    try:
        with xarray.open_dataset(path, engine="h5netcdf") as data:
            theirs = data["brdf" if "brdf" in data else "brdf_table"].values
    except (OSError, ValueError, KeyError) as error:
        raise DatasetError(f"xarray does not open {path}: {error}") from None
    ours = np.stack([t.value for t in found.tables]).reshape(theirs.shape) if isinstance(found, Tables) else found.f_r
    return _differences(reader, f"of {theirs.size} values", float(np.abs(theirs - ours).max()), 0.0)


_Check = Callable[[Path, str], Result]
_READERS: dict[str, tuple[tuple[str, str, _Check], ...]] = {
    "rgl": (("mitsuba", "mitsuba (measured)", _mitsuba),),
    "klems": (("pywincalc", "pywincalc", _pywincalc), ("pyradiance", "Radiance (rtrace, checkBSDF)", _radiance)),
    "bird": (("jsonschema", "jsonschema (BiRD schemas)", _jsonschema),),
    "netcdf": (("xarray", "xarray", _xarray),),
}
