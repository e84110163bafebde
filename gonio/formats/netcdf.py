"""Samples and tables as self-describing NetCDF-4, CF style: any netCDF or HDF5 tool shows what they are.

One root group. Samples have the dimension ``sample``: ``theta_i``, ``phi_i``, ``theta_r``, ``phi_r`` [rad], ``brdf``
[sr-1] with ``brdf_standard_error``, and the derivatives with respect to each shared error. Several channels are a second
dimension ``channel`` with ``channel_name`` and, for spectra, ``wavelength`` [nm]. A table has the dimensions ``theta_h``,
``theta_d``, ``phi_d``, before them ``phi_h`` if it has a grain and before all ``channel`` if it has several: ``brdf_table``
with its standard error and coverage flags. Either or both may be present. CF has no standard name for a BRDF, so
``long_name`` says it. Numbers come back bit for bit. docs/formats.md lists every variable.

A file is opened by a child process under limits; see `gonio.formats.hdf5`.

References
----------
.. [1] CF Conventions 1.11, sections 3.3 to 3.5 (standard error modifier, flags).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np

import gonio
from gonio import files
from gonio.channels import SINGLE, Channels, ChannelSamples, from_names, spectral
from gonio.errors import DatasetError
from gonio.formats import hdf5
from gonio.formats.hdf5 import Contents
from gonio.samples import BRDFSamples, SharedError

if TYPE_CHECKING:
    from gonio.brdf.tables import Table, Tables

CONVENTIONS = "CF-1.11 gonio-1"
BRDF_NAME = "bidirectional reflectance distribution function"
FRAME = (
    "polar angles from the surface normal, azimuths counter-clockwise from the tangent; "
    "mirror direction at phi_r = phi_i + pi; half and difference angles after Rusinkiewicz (1998)"
)
DIRECTIONS = {
    "theta_i": "polar angle of incidence",
    "phi_i": "azimuth of incidence",
    "theta_r": "polar angle of reflection",
    "phi_r": "azimuth of reflection",
}
AXIS_NAMES = {
    "phi_h": "azimuth of the half vector",
    "theta_h": "polar angle of the half vector",
    "theta_d": "polar angle of the difference vector",
    "phi_d": "azimuth of the difference vector",
}
AXES = tuple(AXIS_NAMES)  # of a table with a grain; without one it has no phi_h


def sniff(head: bytes) -> bool:
    """The HDF5 signature."""
    return head[:8] == hdf5.SIGNATURE


def write(
    path: Path,
    *,
    samples: BRDFSamples | ChannelSamples | None = None,
    table: Table | Tables | None = None,
    attributes: Mapping[str, str] | None = None,
) -> None:
    """Write samples, tables or both; where both have several channels, these must be the same.

    Parameters
    ----------
    path : Path
    samples : BRDFSamples or ChannelSamples, optional
    table : TabulatedBRDF, GrainedTable or Tables, optional
    attributes : mapping of str to str, optional
        More about the file; ``history`` extends the file's own.
    """
    if samples is None and table is None:
        raise DatasetError(f"{path}: there is neither a table nor a set of samples to write")

    def put(temporary: Path) -> None:
        import h5netcdf

        from gonio.brdf.tables import Tables

        with h5netcdf.File(temporary, "w") as file:
            given = dict(attributes or {})
            history = f"written by gonio {gonio.__version__}"
            file.attrs["Conventions"] = CONVENTIONS
            file.attrs["title"] = given.pop("title", BRDF_NAME)
            file.attrs["history"] = "; ".join(text for text in (given.pop("history", ""), history) if text)
            file.attrs["source"] = given.pop("source", f"gonio {gonio.__version__}")
            file.attrs["references"] = "F. E. Nicodemus et al., NBS Monograph 160, 1977, doi:10.6028/NBS.MONO.160"
            file.attrs["quantity"] = "brdf"
            file.attrs["frame_convention"] = FRAME
            file.attrs["uncertainty"] = "standard uncertainty (k = 1); errors shared by all samples are listed apart"
            if given:
                file.attrs["gonio_attributes"] = json.dumps(given, sort_keys=True)
            tables = None if table is None else Tables.of(table)
            named = [x.channels for x in (samples, tables) if isinstance(x, ChannelSamples) or _named(x)]
            if len({channels.names for channels in named}) > 1:
                raise DatasetError(f"{path}: samples and table have different channels; write them to two files")
            if named:
                _put_channels(file, named[0])
            if samples is not None:
                _put_samples(file, samples)
            if tables is not None:
                _put_tables(file, tables)

    files.replace_atomically(path, put)


def contents(path: Path) -> set[str]:
    """What the file holds: ``"samples"``, ``"table"`` (one or several channels) or both."""
    found = hdf5.read(path)
    return {kind for kind, name in (("samples", "brdf"), ("table", "brdf_table")) if name in found.arrays}


def read(path: Path) -> BRDFSamples | ChannelSamples | Tables:
    """Samples if there are any, else the tables."""
    found = hdf5.read(path)
    return _tables(path, found) if "brdf" not in found.arrays and "brdf_table" in found.arrays else _samples(path, found)


def read_samples(path: Path) -> BRDFSamples:
    """Samples of one channel of a file that `write` made, or `DatasetError`."""
    found = _samples(path, hdf5.read(path))
    return found if isinstance(found, BRDFSamples) else found.channel()


def read_tables(path: Path) -> Tables:
    """Tables of a file that `write` made, or `DatasetError`."""
    return _tables(path, hdf5.read(path))


def _samples(path: Path, file: Contents) -> BRDFSamples | ChannelSamples:
    _needed(path, file, "brdf", "samples")
    arrays = {name: _array(path, file, name) for name in (*DIRECTIONS, "brdf", "brdf_standard_error")}
    shape = arrays["brdf"].shape
    n = shape[0] if shape else -1
    for name, array in arrays.items():
        expected = (n,) if name in DIRECTIONS else shape
        if len(shape) not in (1, 2) or array.shape != expected:
            raise DatasetError(f"{path}: {name} has shape {array.shape}, brdf {shape}; it is damaged")
    attributes = _attributes(path, file, "brdf")
    theta_i, phi_i, theta_r, phi_r = (arrays[name] for name in DIRECTIONS)
    if len(shape) == 2:
        channels = _channels(path, file)
        if len(channels) != shape[1]:
            raise DatasetError(f"{path}: {len(channels)} channels are named, brdf has {shape[1]}; the file is damaged")
        u = arrays["brdf_standard_error"]
        return ChannelSamples(theta_i, phi_i, theta_r, phi_r, arrays["brdf"], u, channels, attributes)
    shared: tuple[SharedError, ...] = ()
    none = np.zeros((n, 3, 0))
    d_omega_i, d_omega_r, d_ln_f = none, none, np.zeros((n, 0))
    if "shared_error_u" in file.arrays:
        u, u_sample = _array(path, file, "shared_error_u"), _array(path, file, "shared_error_u_sample")
        names, units = _texts_of(path, file, "shared_error_name"), _texts_of(path, file, "shared_error_unit")
        if not (u.ndim == 1 and u.shape == u_sample.shape and len(names) == len(units) == len(u)):
            raise DatasetError(f"{path}: the shared errors have different lengths; the file is damaged")
        shared = tuple(SharedError(*row) for row in zip(names, u.tolist(), u_sample.tolist(), units, strict=True))
        d_omega_i, d_omega_r = _array(path, file, "d_omega_i"), _array(path, file, "d_omega_r")
        d_ln_f = _array(path, file, "d_ln_f")
    pose = _array(path, file, "pose", kind="i") if "pose" in file.arrays else np.full(n, -1, dtype=np.int64)
    try:
        return BRDFSamples(
            theta_i, phi_i, theta_r, phi_r, arrays["brdf"], arrays["brdf_standard_error"], pose.astype(np.int64), shared,
            d_omega_i, d_omega_r, d_ln_f, attributes,
        )  # fmt: skip
    except DatasetError as error:
        raise DatasetError(f"{path}: {error}") from None


def _channels(path: Path, file: Contents) -> Channels:
    if "wavelength" in file.arrays:
        return spectral(_array(path, file, "wavelength").ravel(), str(path))
    return from_names(tuple(_texts_of(path, file, "channel_name")), str(path))


def _tables(path: Path, file: Contents) -> Tables:
    from gonio.brdf import grained, tabulated
    from gonio.brdf.tables import Tables

    _needed(path, file, "brdf_table", "table")
    value = _array(path, file, "brdf_table")
    u = _array(path, file, "brdf_table_standard_error")
    coverage = _array(path, file, "brdf_table_coverage", kind="iu")
    kind = grained if "phi_h" in file.arrays else tabulated
    axes = AXES if kind is grained else AXES[1:]
    channels = SINGLE
    if value.ndim == len(axes) + 1:
        channels = _channels(path, file)
        if len(channels) != value.shape[0]:
            raise DatasetError(f"{path}: {len(channels)} channels are named, brdf_table has {value.shape[0]}; it is damaged")
    elif value.ndim == len(axes):
        value, u, coverage = value[None], u[None], coverage[None]
    else:
        raise DatasetError(
            f"{path}: brdf_table has {value.ndim} dimensions, a table over {len(axes)} angles has {len(axes)}, and one more "
            "for channels; the file is damaged"
        )
    if u.shape != value.shape or coverage.shape != value.shape:
        raise DatasetError(f"{path}: brdf_table, its standard error and its coverage have different shapes; it is damaged")
    try:
        scale = float(file.attributes["brdf_table"].get("theta_h_scale", "nan"))
    except ValueError:
        scale = math.nan
    attributes = _attributes(path, file, "brdf_table")
    if np.any((coverage < 0) | (coverage > 255)):
        raise DatasetError(f"{path}: a coverage flag is outside 0 to 255; the file is damaged")
    table = grained.GrainedTable if kind is grained else tabulated.TabulatedBRDF
    try:
        nodes = kind.nodes(value.shape[1:], scale)
        parts = zip(value, u, coverage.astype(np.uint8), strict=True)
        found = Tables(tuple(table(*part, attributes, scale) for part in parts), channels)
    except DatasetError as error:
        raise DatasetError(f"{path}: {error}") from None
    for name, expected in zip(axes, nodes, strict=True):
        axis = _array(path, file, name)
        if axis.shape != expected.shape or not np.allclose(axis, expected, rtol=0, atol=1e-9):
            raise DatasetError(f"{path}: the nodes of {name} are not those of a gonio table; tabulate the samples again")
    return found


def _named(tables: object) -> TypeGuard[Tables]:
    """Whether they are tables with a dimension for their channels."""
    from gonio.brdf.tables import Tables

    return isinstance(tables, Tables) and tables.channels != SINGLE


def _put_channels(file: Any, channels: Channels) -> None:
    file.dimensions["channel"] = len(channels)
    _texts(file, "channel_name", ("channel",), list(channels.names), long_name="name of the channel")
    if channels.wavelengths_nm is not None:
        waves = np.array(channels.wavelengths_nm)
        _variable(file, "wavelength", ("channel",), waves, long_name="radiation wavelength", units="nm")


def _put_samples(file: Any, samples: BRDFSamples | ChannelSamples) -> None:
    file.dimensions["sample"] = len(samples)
    dimensions: tuple[str, ...] = ("sample",)
    if isinstance(samples, ChannelSamples):
        dimensions = ("sample", "channel")
    for name, long_name in DIRECTIONS.items():
        _variable(file, name, ("sample",), getattr(samples, name), long_name=long_name, units="rad")
    _variable(
        file, "brdf", dimensions, samples.f_r, long_name=BRDF_NAME, units="sr-1", coordinates=" ".join(DIRECTIONS),
        ancillary_variables="brdf_standard_error", gonio_attributes=json.dumps(dict(samples.attributes), sort_keys=True),
    )  # fmt: skip
    _variable(
        file, "brdf_standard_error", dimensions, samples.u_f_r, long_name=f"standard uncertainty of the {BRDF_NAME}",
        units="sr-1", comment="random errors only, k = 1; NaN where unknown",
    )  # fmt: skip
    if isinstance(samples, ChannelSamples):
        return
    _variable(file, "pose", ("sample",), samples.pose, long_name="pose of the scan, -1 if none")
    if samples.shared:
        file.dimensions["shared_error"] = len(samples.shared)
        file.dimensions["component"] = 3
        for name, meaning in (("name", "name"), ("unit", "unit of the shared value")):
            texts = [getattr(e, name) for e in samples.shared]
            _texts(file, f"shared_error_{name}", ("shared_error",), texts, long_name=meaning)
        u, u_sample = (np.array([getattr(e, n) for e in samples.shared]) for n in ("u", "u_sample"))
        note = "in the unit that shared_error_unit gives"
        _variable(file, "shared_error_u", ("shared_error",), u, long_name="standard uncertainty of the value", comment=note)
        _variable(
            file, "shared_error_u_sample", ("shared_error",), u_sample,
            long_name="standard deviation of an independent error of the same kind in each sample", comment=note,
        )  # fmt: skip
        for name in ("d_omega_i", "d_omega_r"):
            _variable(
                file, name, ("sample", "component", "shared_error"), getattr(samples, name),
                long_name="derivative of the unit vector in the local frame with respect to the shared error",
            )  # fmt: skip
        _variable(
            file, "d_ln_f", ("sample", "shared_error"), samples.d_ln_f,
            long_name="derivative of ln(brdf) with respect to the shared error, directions held",
        )  # fmt: skip


def _put_tables(file: Any, tables: Tables) -> None:
    from gonio.brdf.tabulated import COVERAGE

    table = tables.main
    axes = AXES if tables.grained else AXES[1:]
    for name, size in zip(axes, table.shape, strict=True):
        file.dimensions[name] = size
    for name, axis in zip(axes, table.nodes(), strict=True):
        _variable(file, name, (name,), axis, long_name=f"{AXIS_NAMES[name]} (Rusinkiewicz)", units="rad")
    several = _named(tables)
    dimensions = (("channel",) if several else ()) + axes
    value, u, coverage = (
        np.stack([getattr(t, name) for t in tables.tables]) if several else getattr(table, name)
        for name in ("value", "u", "coverage")
    )
    folded = "phi_d covers half a turn: reciprocal" if tables.grained else (
        "phi_d is folded into 0..pi/2: reciprocal and mirror-symmetric"
    )  # fmt: skip
    _variable(
        file, "brdf_table", dimensions, value, long_name=BRDF_NAME, units="sr-1",
        ancillary_variables="brdf_table_standard_error brdf_table_coverage",
        comment=f"{folded}; beyond the horizon a continuation",
        theta_h_scale=repr(float(table.scale)), gonio_attributes=json.dumps(dict(tables.attributes), sort_keys=True),
    )  # fmt: skip
    _variable(
        file, "brdf_table_standard_error", dimensions, u, units="sr-1",
        long_name=f"standard uncertainty of the {BRDF_NAME}", comment="k = 1; shared errors are not included",
    )  # fmt: skip
    _variable(
        file, "brdf_table_coverage", dimensions, coverage, long_name="origin of the value",
        flag_values=np.array(list(COVERAGE), dtype=np.uint8), flag_meanings=" ".join(COVERAGE.values()),
    )  # fmt: skip


def _variable(file: Any, name: str, dimensions: tuple[str, ...], data: np.ndarray, **attributes: Any) -> None:
    variable = file.create_variable(name, dimensions, dtype=data.dtype, data=data)
    for key, value in attributes.items():
        variable.attrs[key] = value


def _texts(file: Any, name: str, dimensions: tuple[str, ...], texts: list[str], **attributes: Any) -> None:
    import h5py

    variable = file.create_variable(name, dimensions, dtype=h5py.string_dtype())
    variable[...] = np.array(texts, dtype=object)
    for key, value in attributes.items():
        variable.attrs[key] = value


def _needed(path: Path, file: Contents, name: str, kind: str) -> None:
    if name in file.others:
        raise DatasetError(f"{path}: {name} holds {file.others[name]}, which gonio does not write; the file is damaged")
    if name not in file.arrays and name not in file.texts:
        raise DatasetError(f"{path} holds no {kind} (variable {name}); make it with `gonio export` or `gonio table`")


def _array(path: Path, file: Contents, name: str, kind: str = "f") -> np.ndarray:
    _needed(path, file, name, name)
    data = file.arrays.get(name)
    if data is None or data.dtype.kind not in kind or data.ndim > 5:
        shown = "texts" if data is None else f"{data.ndim} dimensions of {data.dtype}"
        raise DatasetError(f"{path}: {name} has {shown}, which gonio does not write; the file is damaged")
    return data.astype(float) if kind == "f" else data


def _texts_of(path: Path, file: Contents, name: str) -> list[str]:
    _needed(path, file, name, name)
    if name not in file.texts:
        raise DatasetError(f"{path}: {name} is no list of names; the file is damaged")
    return file.texts[name]


def _attributes(path: Path, file: Contents, name: str) -> dict[str, str]:
    text = file.attributes[name].get("gonio_attributes", "{}")
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{path}: the attribute gonio_attributes is not JSON; the file is damaged") from error
    if not isinstance(found, dict):
        raise DatasetError(f"{path}: the attribute gonio_attributes is no mapping; the file is damaged")
    return {str(k): str(v) for k, v in found.items()}
