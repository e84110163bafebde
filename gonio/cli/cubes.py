"""Zarr folders of many pixels: readings in, estimates out, tile by tile.

A cube of readings is a Zarr group with

- ``brdf`` of shape (sample, ...): f_r [1/sr], NaN where there is none; the other axes are pixels, materials, wavelengths;
- ``theta_i``, ``phi_i``, ``theta_r``, ``phi_r`` of shape (sample,) [rad], the same for all pixels;
- ``brdf_standard_error``, if it is known: (sample,), or the shape of ``brdf``;
- shared errors, if any: the attribute ``shared_errors``, a list of ``{"name", "u", "u_sample", "unit"}``, and ``d_omega_i``,
  ``d_omega_r`` (sample, 3, shared_error) and ``d_ln_f`` (sample, shared_error), as in gonio's NetCDF.

Estimates go to a group with the arrays of `fitting.batch.Estimates`, pixels first, and ``done`` (tile, 2): checksums of a
tile's readings and estimates, written last. A tile whose checksums do not fit is computed again, so a torn write heals.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gonio.channels import ChannelSamples
from gonio.errors import ConfigurationError, DatasetError
from gonio.samples import BRDFSamples, SharedError

if TYPE_CHECKING:
    from fitting.batch import Estimates, Job
    from fitting.tiles import Source, Tile

Array = NDArray[np.float64]
FORMAT = "gonio batch 1"
_EACH_ITS_OWN = 1e-150  # uncertainty of a job whose pixels have theirs: its square adds nothing
_ANGLES = ("theta_i", "phi_i", "theta_r", "phi_r")
_DIRECTIONS = ("d_omega_i", "d_omega_r", "d_ln_f")


def zarr() -> Any:
    """The package, or a sentence on how to get it."""
    try:
        import zarr as package
    except ImportError as error:
        raise ConfigurationError("many fits are kept in Zarr, which is missing; pip install 'gonio[cluster]'") from error
    return package


def is_cube(path: Path) -> bool:
    """Whether a path is a Zarr folder."""
    return path.is_dir() and any((path / name).is_file() for name in ("zarr.json", ".zgroup"))


def _opened(path: str) -> Any:
    try:
        return zarr().open_group(path, mode="r")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DatasetError(f"{path}: this is no Zarr group, or it is damaged ({error})") from error


@dataclass(frozen=True)
class CubeSource:
    """Readings of a cube, opened wherever they are needed.

    Attributes
    ----------
    path : str
        Absolute; workers elsewhere must see it.
    """

    path: str

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the pixels."""
        return tuple(self._array("brdf").shape[1:])

    def _array(self, name: str) -> Any:
        group = _opened(self.path)
        if name not in group:
            raise DatasetError(f"{self.path}: there is no {name}; a cube has brdf (sample, ...), {', '.join(_ANGLES)}")
        return group[name]

    def read(self, start: int, stop: int) -> tuple[Array, Array | None]:
        """f_r (p, n) of rows start to stop of the first pixel axis, and the uncertainty if each pixel has its own."""
        readings = self._rows("brdf", start, stop)
        group = _opened(self.path)
        own = "brdf_standard_error" in group and group["brdf_standard_error"].ndim > 1
        return readings, self._rows("brdf_standard_error", start, stop) if own else None

    def _rows(self, name: str, start: int, stop: int) -> Array:
        block = np.asarray(self._array(name)[:, start:stop], dtype=float)
        return np.ascontiguousarray(block.reshape(len(block), -1).T)

    def samples(self) -> BRDFSamples:
        """Directions and shared errors; of the readings, the median over (at most 1024) pixels."""
        brdf = self._array("brdf")
        if brdf.ndim < 2:
            raise DatasetError(f"{self.path}: brdf has {brdf.ndim} axis; it needs sample and one or more of pixels")
        n = brdf.shape[0]
        theta_i, phi_i, theta_r, phi_r = (np.asarray(self._array(name)[...], dtype=float) for name in _ANGLES)
        group = _opened(self.path)
        u = np.full(n, np.nan)
        if "brdf_standard_error" in group:
            stated = group["brdf_standard_error"]
            if stated.shape not in ((n,), brdf.shape):
                wanted = f"{(n,)} or {brdf.shape}"
                raise DatasetError(f"{self.path}: brdf_standard_error has shape {stated.shape}, needed is {wanted}")
            u = np.asarray(stated[...], dtype=float) if stated.ndim == 1 else np.full(n, _EACH_ITS_OWN)
        rows = max(1, 1024 // max(1, int(np.prod(brdf.shape[2:]))))
        first = np.nan_to_num(_median(self.read(0, rows)[0]))
        shared = _shared(group.attrs.get("shared_errors", []), self.path)
        plain = BRDFSamples.plain(theta_i, phi_i, theta_r, phi_r, first, u)
        if not shared:
            return plain
        d_omega_i, d_omega_r, d_ln_f = (np.asarray(self._array(name)[...], dtype=float) for name in _DIRECTIONS)
        return replace(plain, shared=shared, d_omega_i=d_omega_i, d_omega_r=d_omega_r, d_ln_f=d_ln_f)


@dataclass(frozen=True)
class ChannelSource:
    """Channels of one file as pixels.

    Attributes
    ----------
    f_r, u_f_r : ndarray, shape (c, n)
    """

    f_r: Array
    u_f_r: Array | None

    @property
    def shape(self) -> tuple[int, ...]:
        return self.f_r.shape[:1]

    def read(self, start: int, stop: int) -> tuple[Array, Array | None]:
        return self.f_r[start:stop], None if self.u_f_r is None else self.u_f_r[start:stop]

    @classmethod
    def of(cls, channels: ChannelSamples) -> tuple[ChannelSource, BRDFSamples]:
        """The source and the directions of a file's channels."""
        f_r, u = channels.f_r.T.copy(), channels.u_f_r.T.copy()
        known = np.isfinite(u) & (u > 0)
        stated = bool(np.all(known[np.isfinite(f_r)]))
        samples = BRDFSamples.plain(
            channels.theta_i, channels.phi_i, channels.theta_r, channels.phi_r, np.nan_to_num(_median(f_r)),
            np.full(len(channels), _EACH_ITS_OWN) if stated else None, channels.attributes,
        )  # fmt: skip
        return cls(f_r, u if stated else None), samples


def _median(readings: Array) -> Array:
    """Over pixels, of (p, n); NaN where none has a reading."""
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.asarray(np.nanmedian(readings, axis=0))


def _shared(listed: Any, path: str) -> tuple[SharedError, ...]:
    try:
        return tuple(
            SharedError(str(e["name"]), float(e["u"]), float(e.get("u_sample", 0.0)), str(e.get("unit", "1")))
            for e in listed
        )
    except (TypeError, KeyError, ValueError, AttributeError) as error:
        raise DatasetError(f"{path}: shared_errors is a list of {{name, u, u_sample, unit}}; found {listed!r}") from error


class ZarrSink:
    """Estimates in a Zarr group; made if it is not there.

    Parameters
    ----------
    path : Path
    job : Job
    source : Source
    shape : sequence of int
        Of the pixels.
    tiles : sequence of (start, stop)
    attributes : mapping of str to str
        Provenance.

    Raises
    ------
    ConfigurationError
        If the folder holds something else, or another fit.
    """

    def __init__(
        self, path: Path, job: Job, source: Source, shape: Sequence[int], tiles: Sequence[Tile],
        attributes: Mapping[str, str],
    ) -> None:  # fmt: skip
        from fitting.batch import QUANTILES, STATUS

        self._source, self._shape = source, tuple(shape)
        self._place = {tile: k for k, tile in enumerate(tiles)}
        names = job.engine().names
        identity = {"format": FORMAT, "job": job.digest(), "pixels": list(self._shape), "tile_rows": tiles[0][1]}
        if path.exists():
            if not is_cube(path):
                raise ConfigurationError(f"{path} exists and holds no fit; choose another --out")
            self._group = zarr().open_group(path, mode="r+")
            found = {key: self._group.attrs.get(key) for key in identity}
            if found != identity:
                what = next(key for key in identity if found[key] != identity[key])
                raise ConfigurationError(
                    f"{path} holds another fit ({what} differs); take another --out, or the same options"
                )
            return
        self._group = zarr().create_group(path)
        d, chunk = len(names), (tiles[0][1], *self._shape[1:])
        layout: dict[str, tuple[tuple[int, ...], tuple[str, ...], Any]] = {
            **dict.fromkeys(("mean", "sd", "contraction"), ((d,), ("parameter",), np.float64)),
            "quantiles": ((d, len(QUANTILES)), ("parameter", "quantile"), np.float64),
            **dict.fromkeys(("chi2_per_n", "k_hat", "effective"), ((), (), np.float64)),
            "status": ((), (), np.int8),
        }
        pixel_names = ("y", "x") if len(self._shape) == 2 else tuple(f"pixel_{k}" for k in range(len(self._shape)))
        for name, (more, dimensions, dtype) in layout.items():
            self._group.create_array(
                name, shape=self._shape + more, chunks=chunk + more, dtype=dtype, dimension_names=pixel_names + dimensions,
                fill_value=np.nan if dtype is np.float64 else -1,
            )  # fmt: skip
        self._group.create_array("done", shape=(len(tiles), 2), chunks=(1, 2), dtype=np.int64, fill_value=-1)
        self._group.attrs.update(
            identity
            | {"model": job.model, "parameters": list(names), "quantiles": list(QUANTILES), "status": list(STATUS)}
            | {"fixed": dict(job.engine().space.fixed), "units": dict(job.engine().space.units)}
            | dict(attributes)
        )

    def _rows(self, start: int, stop: int) -> dict[str, NDArray[Any]]:
        return {name: np.asarray(array[start:stop]) for name, array in self._group.arrays() if name != "done"}

    def has(self, start: int, stop: int) -> bool:
        """Whether the tile is complete and its readings are still the same."""
        stored = np.asarray(self._group["done"][self._place[start, stop]])
        if stored[0] < 0:
            return False
        return bool(
            stored[0] == _checksum(self._source.read(start, stop)) and stored[1] == _checksum(self._ordered(start, stop))
        )

    def _ordered(self, start: int, stop: int) -> list[NDArray[Any]]:
        rows = self._rows(start, stop)
        return [rows[name] for name in sorted(rows)]

    def write(self, start: int, stop: int, estimates: Estimates) -> None:
        """Keep a tile; its checksums last."""
        for name, array in estimates.arrays().items():
            self._group[name][start:stop] = array.reshape(stop - start, *self._shape[1:], *array.shape[1:])
        sums = [_checksum(self._source.read(start, stop)), _checksum(self._ordered(start, stop))]
        self._group["done"][self._place[start, stop]] = np.array(sums, dtype=np.int64)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All estimates, pixels flattened."""
        pixels = len(self._shape)
        return {name: a.reshape(-1, *a.shape[pixels:]) for name, a in self._rows(0, self._shape[0]).items()}


def _checksum(arrays: Sequence[NDArray[Any] | None]) -> int:
    value = 0
    for array in arrays:
        if array is not None:
            value = zlib.crc32(np.ascontiguousarray(array).tobytes(), value)
    return value
