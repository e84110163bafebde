"""Data files of other programs, and ours: what is it, read it, write it.

A file is recognised by its content, never by its suffix: ``.bsdf`` and ``.brdf`` name at least three formats each. What is
read becomes `BRDFSamples` in 1/sr whose attributes say what was converted and left out.

Examples
--------
>>> sorted(name for name, form in FORMATS.items() if form.write)
['csv', 'merl', 'netcdf']
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from gonio import files
from gonio.errors import ConfigurationError, DatasetError
from gonio.formats import cornell, csv, merl, netcdf, opticstudio, quantity
from gonio.samples import BRDFSamples

if TYPE_CHECKING:
    from gonio.brdf.base import BRDF
    from gonio.brdf.tabulated import TabulatedBRDF

__all__ = ["FORMATS", "Format", "export", "read", "read_samples", "sniff"]


@dataclass(frozen=True)
class Format:
    """One file format.

    Attributes
    ----------
    name, doc, suffix : str
    sniff : callable
        Of the first 64 KiB: is it this format?
    write : bool
        `export` can write it.
    quantity : str or None
        What the format holds by its definition; None where the file or the user says.
    """

    name: str
    doc: str
    suffix: str
    sniff: Callable[[bytes], bool]
    write: bool
    quantity: str | None = "brdf"


FORMATS: dict[str, Format] = {
    f.name: f
    for f in (
        Format("netcdf", "self-describing NetCDF-4: samples, table, uncertainty, coverage", ".nc", netcdf.sniff, True),
        Format("merl", "MERL binary: 90 x 90 x 180 half and difference angles", ".binary", merl.sniff, True),
        Format("csv", "samples as comma-separated text", ".csv", csv.sniff, True, None),
        Format("opticstudio", "OpticStudio (Zemax) tabular BSDF", ".bsdf", opticstudio.sniff, False),
        Format("cornell", "Cornell BRDF text, as pbrt-v2 reads it", ".brdf", cornell.sniff, False),
    )
}
READ = "gonio reads MERL binary, OpticStudio tabular .bsdf, Cornell/pbrt .brdf, samples CSV and its own NetCDF"


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
    for name, form in FORMATS.items():
        if form.sniff(head):
            return name
    known = {
        b"tensor_file\0": "an RGL tensor file",
        b"CDF": "a NetCDF-3 file",
        b"<": "XML, as Klems and tensor-tree BSDFs are",
        b"{": "JSON, as BiRD and OpenMATERIAL files are",
        b"OPTIS": "a Speos BRDF",
        b"NVIDIA ARC MBSDF": "an MDL measured BSDF",
        b"#ALTA": "an ALTA text file",
    }
    start = head.lstrip(b"\xef\xbb\xbf \t\r\n")
    for mark, what in known.items():
        if start.startswith(mark):
            raise DatasetError(f"{path} is {what}, which gonio cannot read; {READ}")
    lower = head.lower()
    if b"scatterradial" in lower and b"aoi" in lower:
        raise DatasetError(f"{path} is a LightTools BSDF, which gonio cannot read; {READ}")
    raise DatasetError(f"{path} is in no format that gonio knows; {READ}")


def read(path: str | Path, quantity: str | None = None) -> BRDFSamples | TabulatedBRDF:
    """Read a file of any known format.

    Parameters
    ----------
    path : str or Path
    quantity : str, optional
        What the values are: ``"brdf"``, ``"brf"`` or ``"brdf_cos"``. By default what the file or its format says.

    Returns
    -------
    BRDFSamples or TabulatedBRDF
        A table only from a NetCDF file that holds a table and no samples.

    Raises
    ------
    DatasetError
        If the file cannot be read or trusted.
    ConfigurationError
        If the quantity is unknown.
    """
    path = Path(path)
    name = sniff(path)
    if name == "netcdf" and netcdf.contents(path) == {"table"}:
        _no_other_quantity(path, name, quantity)
        return netcdf.read_table(path)
    return _samples(path, name, quantity)


def read_samples(path: str | Path, quantity: str | None = None) -> BRDFSamples:
    """As `read`, but a table becomes samples at its measured and interpolated nodes."""
    found = read(path, quantity)
    return found if isinstance(found, BRDFSamples) else found.samples()


def export(
    name: str,
    path: str | Path,
    *,
    samples: BRDFSamples | None = None,
    table: TabulatedBRDF | None = None,
    brdf: BRDF | None = None,
    attributes: Mapping[str, str] | None = None,
) -> None:
    """Write what there is of a run in one format.

    Parameters
    ----------
    name : str
        ``"merl"``: the table, else `brdf`. ``"netcdf"``: samples and table. ``"csv"``: samples.
    path : str or Path
        Replaced if it exists; never half written.
    samples, table, brdf : optional
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
    if form is None or not form.write:
        known = ", ".join(n for n, f in FORMATS.items() if f.write)
        raise ConfigurationError(f"gonio cannot write the format {name!r}; choose one of: {known}")
    if name == "merl":
        chosen = table.brdf() if table is not None else brdf
        if chosen is None:
            raise DatasetError(f"{path}: a MERL file needs a table or a fitted BRDF; run `gonio table` or `gonio fit` first")
        merl.write(path, chosen)
    elif name == "csv":
        if samples is None:
            raise DatasetError(f"{path}: a samples CSV needs samples; run `gonio reduce` or `gonio import` first")
        csv.write(path, samples, attributes)
    else:
        netcdf.write(path, samples=samples, table=table, attributes=attributes)


def _samples(path: Path, name: str, given: str | None) -> BRDFSamples:
    if name == "csv":
        return _signed(csv.read(path, given), path)
    readers: dict[str, Callable[[Path], BRDFSamples]] = {
        "netcdf": netcdf.read_samples,
        "merl": merl.read,
        "opticstudio": opticstudio.read,
        "cornell": cornell.read,
    }
    if name == "netcdf":
        _no_other_quantity(path, name, given)
        return netcdf.read_samples(path)
    found = readers[name](path)
    if given is not None and quantity.check(given) != "brdf":
        # the format says BRDF, the user knows that this file's author wrote something else
        factor = quantity.factor_to_brdf(given, found.theta_r)
        attributes = {**found.attributes, "source_quantity": f"{given}, as the user said; the format itself says brdf"}
        found = replace(found, f_r=found.f_r * factor, u_f_r=found.u_f_r * factor, attributes=attributes)
    return _signed(found, path)


def _signed(samples: BRDFSamples, path: Path) -> BRDFSamples:
    name = "".join(c for c in path.name if c.isprintable())
    return replace(samples, attributes={**samples.attributes, "source_file": name})


def _no_other_quantity(path: Path, name: str, given: str | None) -> None:
    if given is not None and quantity.check(given) != "brdf":
        raise DatasetError(f"{path}: a gonio {name} file states its quantity (brdf); leave --quantity {given} away")
