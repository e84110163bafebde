"""Data files of other programs, and ours: what is it, read it, write it.

A file is recognised by its content, never by its suffix: ``.bsdf`` and ``.brdf`` name at least three formats each. What is
read becomes samples in 1/sr whose attributes say what was converted and left out.

Examples
--------
>>> sorted(name for name, form in FORMATS.items() if form.writes)
['alta', 'astm', 'bird', 'cornell', 'csv', 'klems', 'merl', 'netcdf', 'opticstudio', 'pab', 'rgl', 'ssdd']
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from gonio import files
from gonio.channels import ChannelSamples
from gonio.errors import ConfigurationError, DatasetError
from gonio.formats import (
    alta,
    astm,
    bird,
    cornell,
    csv,
    klems,
    lighttools,
    merl,
    netcdf,
    openmaterial,
    opticstudio,
    pab,
    rgl,
    ssdd,
    utia,
)  # fmt: skip
from gonio.formats import quantity as quantities
from gonio.formats.material import Material
from gonio.samples import BRDFSamples

if TYPE_CHECKING:
    from gonio.brdf.base import BRDF
    from gonio.brdf.tables import Table, Tables

__all__ = [
    "FORMATS",
    "Format",
    "Material",
    "export",
    "material_of",
    "one_channel",
    "read",
    "read_channels",
    "read_samples",
    "sniff",
]

Samples = BRDFSamples | ChannelSamples


@dataclass(frozen=True)
class Format:
    """One file format.

    Attributes
    ----------
    name, doc, suffix : str
    sniff : callable
        Of the first 64 KiB: is it this format?
    read : callable, optional
        Of the path: its samples in 1/sr.
    writes : str
        ``"samples"``: rows as they are; ``"grid"``: a BRDF that can be asked anywhere; ``"both"``; empty if not written.
    quantity : str or None
        What the numbers in the file are; None where the file or the user says. The samples read are f_r in any case.
    """

    name: str
    doc: str
    suffix: str
    sniff: Callable[[bytes], bool]
    read: Callable[[Path], ChannelSamples] | None
    writes: str
    quantity: str | None = "brdf"


def _never(_head: bytes) -> bool:
    return False


FORMATS: dict[str, Format] = {
    f.name: f
    for f in (
        Format(
            "netcdf", "self-describing NetCDF-4: samples, table, uncertainty, coverage", ".nc", netcdf.sniff, None, "both"
        ),
        Format(
            "rgl",
            "RGL/Mitsuba measured BRDF (tensor file), RGB or spectral",
            ".bsdf",
            rgl.sniff,
            rgl.read,
            "grid",
            "brdf_cos",
        ),
        Format(
            "merl", "MERL binary: 90 x 90 x 180 half and difference angles, RGB", ".binary", merl.sniff, merl.read, "grid"
        ),
        Format("klems", "Klems matrix in WINDOW XML: patch averages", ".xml", klems.sniff, klems.read, "grid"),
        Format("bird", "BiRD universal BRDF data format, JSON with uBRDF", ".json", bird.sniff, bird.read, "samples"),
        Format(
            "openmaterial", "ASAM OpenMATERIAL 3D look-up table, JSON", ".xompt", openmaterial.sniff, openmaterial.read, ""
        ),
        Format("ssdd", "SSDD: grid of half and difference angles", ".ssdd", ssdd.sniff, ssdd.read, "grid"),
        Format("opticstudio", "OpticStudio (Zemax) tabular BSDF", ".bsdf", opticstudio.sniff, opticstudio.read, "grid"),
        Format("lighttools", "LightTools tabular BSDF", ".bsdf", lighttools.sniff, lighttools.read, ""),
        Format("alta", "ALTA text", ".alta", alta.sniff, alta.read, "samples", None),
        Format("astm", "ASTM E1392 text, the flavour of open programs", ".astm", astm.sniff, astm.read, "samples"),
        Format("csv", "samples as comma-separated text", ".csv", csv.sniff, csv.read, "samples", None),
        Format("cornell", "Cornell BRDF text, as pbrt-v2 reads it", ".brdf", cornell.sniff, cornell.read, "samples"),
        Format("utia", "UTIA binary, anisotropic RGB", ".bin", _never, utia.read, ""),
        Format("pab", "PAB-Opto text, a folder with one file per incidence", "", _never, None, "samples"),
    )
}
READ = (
    "gonio reads MERL, RGL/Mitsuba tensor, Klems XML, OpticStudio, LightTools, ASTM, Cornell, SSDD, ALTA, BiRD, "
    "OpenMATERIAL, UTIA, CSV and its own NetCDF"
)
_GRIDS: dict[str, Callable[[Path, Material, Mapping[str, str] | None], None]] = {
    "rgl": rgl.write,
    "klems": klems.write,
    "ssdd": ssdd.write,
    "opticstudio": opticstudio.write,
    "merl": lambda path, material, _attributes: merl.write(path, material),
}
_ROWS: dict[str, Callable[[Path, ChannelSamples, Mapping[str, str] | None], object]] = {
    "bird": bird.write,
    "alta": alta.write,
    "astm": astm.write,
    "cornell": cornell.write,
    "pab": pab.write,
}


def sniff(path: str | Path) -> str:
    """Name of the format a file is in, from its content.

    Raises
    ------
    DatasetError
        If it is none that gonio reads; known others are named.
    """
    path = Path(path)
    head = files.head(path)
    if not head.strip():
        raise DatasetError(f"{path} is empty; {READ}")
    if utia.sniff(head, files.size_of(path)):
        return "utia"
    for name, form in FORMATS.items():
        if form.sniff(head):
            return name
    known = {
        b"CDF": "a NetCDF-3 file",
        b"<": "XML of another kind than WINDOW's BSDF",
        b"{": "JSON of another kind than BiRD and OpenMATERIAL",
        b"OPTIS": "a Speos BRDF",
        b"NVIDIA ARC MBSDF": "an MDL measured BSDF",
        b"type bsdf_data": "a FRED BSDF",
        b"SCATFUN": "a Fourier BSDF",
    }
    start = head.lstrip(b"\xef\xbb\xbf \t\r\n")
    for mark, what in known.items():
        if start.startswith(mark):
            raise DatasetError(f"{path} is {what}, which gonio cannot read; {READ}")
    raise DatasetError(f"{path} is in no format that gonio knows; {READ}")


def read(path: str | Path, quantity: str | None = None) -> Samples | Tables:
    """Read a file of any known format.

    Parameters
    ----------
    path : str or Path
    quantity : str, optional
        What the values are: ``"brdf"``, ``"brf"`` or ``"brdf_cos"``. By default what the file or its format says.

    Returns
    -------
    BRDFSamples, ChannelSamples or Tables
        Tables only from a NetCDF file that holds no samples; samples of one channel with poses and shared
        errors only from NetCDF.

    Raises
    ------
    DatasetError
        If the file cannot be read or trusted.
    ConfigurationError
        If the quantity is unknown.
    """
    path = Path(path)
    name = sniff(path)
    if name == "netcdf":
        if quantity is not None and quantities.check(quantity) != "brdf":
            raise DatasetError(f"{path}: a gonio {name} file states its quantity (brdf); leave --quantity {quantity} away")
        return netcdf.read(path)
    return _channels(path, name, quantity)


def read_channels(path: str | Path, quantity: str | None = None) -> ChannelSamples:
    """As `read`, in all channels; a table becomes samples at its measured and interpolated nodes."""
    found = read(path, quantity)
    if isinstance(found, ChannelSamples):
        return found
    return ChannelSamples.of(found) if isinstance(found, BRDFSamples) else found.samples()


def read_samples(path: str | Path, quantity: str | None = None, channel: str | None = None) -> BRDFSamples:
    """As `read`, one channel; a table becomes samples at its measured and interpolated nodes.

    Parameters
    ----------
    path, quantity
        As for `read`.
    channel : str, optional
        Name of a channel, such as ``"red"`` or ``"550nm"``; by default the luminance of RGB, Y of XYZ, and of a spectrum the
        wavelength nearest to 555 nm.
    """
    return one_channel(path, read(path, quantity), channel)


def one_channel(path: str | Path, found: Samples | Tables, channel: str | None = None) -> BRDFSamples:
    """One channel of what `read` found in a file."""
    if not isinstance(found, BRDFSamples):
        return (found if isinstance(found, ChannelSamples) else found.samples()).channel(channel)
    if channel is not None:
        raise ConfigurationError(f"{path} has one channel; leave --channel {channel} away")
    return found


def material_of(
    table: Table | Tables | None = None, brdf: BRDF | None = None, attributes: Mapping[str, str] | None = None
) -> Material | None:
    """What grid formats are written from: the tables, else the fitted BRDF; None if there is neither."""
    if table is not None:
        from gonio.brdf.tables import Tables

        of = Tables.of(table)
        counts = ", ".join(f"{n} {k}" for k, n in of.counts().items())
        origin = "table with a grain" if of.grained else "table"
        told = {**of.attributes, "origin": origin, "coverage": counts, **(attributes or {})}
        u = tuple(t.u_brdf() for t in of.tables)
        return Material(tuple(t.brdf() for t in of.tables), of.channels, u, told)
    if brdf is not None:
        return Material((brdf,), attributes={"origin": "model", "model": repr(brdf), **(attributes or {})})
    return None


def export(
    name: str,
    path: str | Path,
    *,
    samples: Samples | None = None,
    table: Table | Tables | None = None,
    brdf: BRDF | None = None,
    material: Material | None = None,
    attributes: Mapping[str, str] | None = None,
) -> None:
    """Write what there is of a run in one format.

    Parameters
    ----------
    name : str
        A key of `FORMATS` that writes. Grid formats take the material, else the table, else `brdf`; row formats the samples,
        else rows on a grid of directions; ``"netcdf"`` samples and table.
    path : str or Path
        Replaced if it exists; never half written. Of ``"pab"``: a new folder.
    samples, table, brdf, material : optional
    attributes : mapping of str to str, optional
        More for the header, where the format has one.

    Raises
    ------
    ConfigurationError
        If the format is unknown or cannot be written.
    DatasetError
        If what the format holds is not there, or the file cannot be written.
    """
    path = Path(path)
    form = FORMATS.get(name)
    if form is None or not form.writes:
        known = ", ".join(n for n, f in FORMATS.items() if f.writes)
        raise ConfigurationError(f"gonio cannot write the format {name!r}; choose one of: {known}")
    material = material or material_of(table, brdf)
    if name in _GRIDS:
        if material is None:
            raise DatasetError(f"{path}: {form.doc} needs a table or a fitted BRDF; run `gonio table` or `gonio fit` first")
        _GRIDS[name](path, material, attributes)
    elif name == "netcdf":
        if samples is None and table is None and material is not None:
            samples = material.rows()
        netcdf.write(path, samples=samples, table=table, attributes=attributes)
    else:
        if samples is None and material is None:
            raise DatasetError(f"{path}: {form.doc} needs samples; run `gonio reduce` or `gonio import` first")
        found = samples if samples is not None or material is None else material.rows()
        assert found is not None
        if name == "csv":
            csv.write(path, found, attributes)
        else:
            _ROWS[name](path, ChannelSamples.of(found) if isinstance(found, BRDFSamples) else found, attributes)


def _channels(path: Path, name: str, given: str | None) -> ChannelSamples:
    if name == "csv":
        return _signed(csv.read(path, given), path)
    reader = FORMATS[name].read
    assert reader is not None
    found = reader(path)
    if given is not None and quantities.check(given) != "brdf":
        # the format says BRDF, the user knows that this file's author wrote something else
        factor = quantities.factor_to_brdf(given, found.theta_r)[:, None]
        attributes = {**found.attributes, "source_quantity": f"{given}, as the user said; the format itself says brdf"}
        found = replace(found, f_r=found.f_r * factor, u_f_r=found.u_f_r * factor, attributes=attributes)
    return _signed(found, path)


def _signed(samples: ChannelSamples, path: Path) -> ChannelSamples:
    name = "".join(c for c in path.name if c.isprintable())
    return replace(samples, attributes={**samples.attributes, "source_file": name})
