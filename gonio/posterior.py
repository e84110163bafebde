r"""Draws from a posterior, and their file: NetCDF in the layout of ArviZ.

The file has the groups ``posterior`` (one variable per parameter, dimensions chain and draw) and ``sample_stats``
(``lp``, the log density up to a constant), so ``arviz.from_netcdf`` and ``xarray.open_dataset(path, group="posterior")``
read it; model, held parameters and diagnostics are attributes. A chain is one independent ensemble. A group ``walk`` is
there if chains that have not converged can go on.

This module draws nothing and judges nothing; it holds what `fitting` found. A file that is not a posterior, or holds a
value that is not finite, is refused.

References
----------
.. [1] ArviZ, "InferenceData schema specification", https://python.arviz.org/en/stable/schema/schema.html
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gonio import brdf as brdfs
from gonio.errors import DatasetError, ParameterError

Array = NDArray[np.float64]
FORMAT = "gonio posterior 1"
_LARGEST = 100_000_000  # numbers in a file that is read
_QUANTILES = {"q025": 0.025, "q16": 0.16, "median": 0.5, "q84": 0.84, "q975": 0.975}


@dataclass(frozen=True)
class Posterior:
    """Draws from the posterior of a BRDF model.

    Attributes
    ----------
    model : str
        ``"lambertian+ggx"``.
    names : tuple of str
        Free parameters: those of the model (``"ggx.alpha"``), then ``"shared.scale"``, ..., ``"noise.relative"``, ...
    draws : ndarray, shape (chain, draw, len(names))
        In natural units, burn-in removed.
    log_probability : ndarray, shape (chain, draw)
        Log posterior density of the draws in natural units, up to a constant.
    fixed : mapping of str to float
        Held parameters.
    diagnostics : mapping
        method, converged, status, ess, rhat, acceptance, chi2_per_n, n_samples, advice, ...; made JSON-compatible
        (infinity and NaN become None).
    walk : mapping of str to ndarray, optional
        All steps of chains that have not converged, and the state of their random numbers, for `fitting.fit` to go on with.

    Raises
    ------
    DatasetError
        If shapes and names do not fit together or a value is not finite.
    """

    model: str
    names: tuple[str, ...]
    draws: Array
    log_probability: Array
    fixed: Mapping[str, float] = field(default_factory=dict)
    diagnostics: Mapping[str, Any] = field(default_factory=dict)
    walk: Mapping[str, NDArray[Any]] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "diagnostics", _plain(self.diagnostics))
        if self.draws.ndim != 3 or self.draws.shape[2] != len(self.names) or not self.names:
            raise DatasetError(
                f"posterior: draws have shape {self.draws.shape}, needed is (chain, draw, {len(self.names)})"
            )
        if self.draws.shape[0] * self.draws.shape[1] == 0:
            raise DatasetError("posterior: there are no draws")
        if self.log_probability.shape != self.draws.shape[:2]:
            raise DatasetError(
                f"posterior: log_probability has shape {self.log_probability.shape}, needed is {self.draws.shape[:2]}"
            )
        if len(set(self.names)) != len(self.names):
            raise DatasetError("posterior: a parameter name occurs twice")
        for name, value in (("draws", self.draws), ("log_probability", self.log_probability)):
            if not np.all(np.isfinite(value)):
                raise DatasetError(f"posterior: {name} hold a value that is not finite; fit again")
        if not all(math.isfinite(value) for value in self.fixed.values()):
            raise DatasetError("posterior: a fixed parameter is not finite; fit again")

    @property
    def converged(self) -> bool:
        """The sampler's own verdict."""
        return bool(self.diagnostics.get("converged", False))

    def flat(self) -> Array:
        """All draws, shape (chain * draw, len(names))."""
        return self.draws.reshape(-1, len(self.names))

    def thin(self, n: int, rng: np.random.Generator) -> Array:
        """`n` draws picked at random, shape (n, len(names)); with repetition only if there are fewer than `n`."""
        flat = self.flat()
        return flat[rng.choice(len(flat), size=n, replace=n > len(flat))]

    def values(self, draw: ArrayLike | Mapping[str, float] | None = None) -> dict[str, float]:
        """All parameters by name, the held ones too; the posterior median of each by default."""
        if isinstance(draw, Mapping):
            unknown = [name for name in draw if name not in self.names]
            if unknown:
                raise ParameterError(f"posterior: {unknown[0]!r} is no free parameter; it has: {', '.join(self.names)}")
            return self.values() | {name: float(value) for name, value in draw.items()}
        row = np.median(self.flat(), axis=0) if draw is None else np.asarray(draw, dtype=float)
        if row.shape != (len(self.names),):
            raise ParameterError(f"posterior: a draw has {len(self.names)} numbers, got an array of shape {row.shape}")
        return dict(self.fixed) | {name: float(value) for name, value in zip(self.names, row, strict=True)}

    def brdf(self, draw: ArrayLike | Mapping[str, float] | None = None) -> brdfs.BRDF:
        """The BRDF at one draw.

        Parameters
        ----------
        draw : array_like, shape (len(names),), or mapping, optional
            Shared errors and noise in it are ignored. By default the posterior median of each parameter.
        """
        values, models = self.values(draw), brdfs.parse(self.model)
        terms = []
        for term, model in zip(brdfs.term_names(models), models, strict=True):
            names = {parameter.name: f"{term}.{parameter.name}" for parameter in model.parameters}
            missing = [name for name in names.values() if name not in values]
            if missing:
                raise DatasetError(f"posterior: {missing[0]} of {self.model} is neither free nor fixed; fit again")
            terms.append(brdfs.Term(model, model.values({short: values[name] for short, name in names.items()})))
        return brdfs.BRDF(terms)

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels of a fit to several, in order; empty for a fit to one."""
        found = (n[n.index("[") + 1 : -1] for n in (*self.names, *self.fixed) if n.endswith("]"))
        return tuple(dict.fromkeys(found))

    def channel(self, name: str) -> Posterior:
        """Of one channel of a fit to several: its parameters without the channel's name, and those that all have in common.

        Raises
        ------
        ParameterError
            If there is no such channel; the message lists them.
        """
        ending = f"[{name}]"
        if name not in self.channels:
            raise ParameterError(f"the posterior has no channel {name!r}; it has: {', '.join(self.channels) or 'one only'}")
        kept = [i for i, n in enumerate(self.names) if n.endswith(ending) or not n.endswith("]")]
        fixed = {n.removesuffix(ending): v for n, v in self.fixed.items() if n.endswith(ending) or not n.endswith("]")}
        names = tuple(self.names[i].removesuffix(ending) for i in kept)
        per = {"tau", "ess", "rhat", "contraction", "optimum", "units", "priors"}
        diagnostics = {
            key: {n.removesuffix(ending): v for n, v in value.items() if n.endswith(ending) or not n.endswith("]")}
            if key in per and isinstance(value, Mapping) else value
            for key, value in self.diagnostics.items()
        }  # fmt: skip
        return Posterior(self.model, names, self.draws[..., kept], self.log_probability, fixed, diagnostics)

    def summary(self) -> dict[str, dict[str, float]]:
        """Mean, standard deviation and quantiles of each free parameter.

        Returns
        -------
        dict
            ``{name: {"mean", "sd", "q025", "q16", "median", "q84", "q975"}}``; q16 to q84 is the 68 % interval.
        """
        flat = self.flat()
        quantiles = np.quantile(flat, list(_QUANTILES.values()), axis=0)
        return {
            name: {"mean": float(np.mean(flat[:, i])), "sd": float(np.std(flat[:, i], ddof=min(1, len(flat) - 1)))}
            | {key: float(q) for key, q in zip(_QUANTILES, quantiles[:, i], strict=True)}
            for i, name in enumerate(self.names)
        }

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the file: complete under its name, or not at all."""
        from gonio.files import replace_atomically

        replace_atomically(Path(path), self._write)

    def _write(self, path: Path) -> None:
        import h5netcdf

        with h5netcdf.File(path, "w") as file:
            file.attrs["format"] = FORMAT
            file.attrs["model"] = self.model
            file.attrs["names"] = json.dumps(list(self.names))
            file.attrs["fixed"] = json.dumps(dict(self.fixed), sort_keys=True)
            file.attrs["diagnostics"] = json.dumps(self.diagnostics, sort_keys=True, allow_nan=False)
            self._write_group(file, "posterior", dict(zip(self.names, np.moveaxis(self.draws, 2, 0), strict=True)))
            self._write_group(file, "sample_stats", {"lp": self.log_probability})
            if self.walk is not None:
                group = file.create_group("walk")
                for name, array in self.walk.items():
                    group.dimensions.update({f"{name}_{i}": n for i, n in enumerate(array.shape)})
                    axes = tuple(f"{name}_{i}" for i in range(array.ndim))
                    group.create_variable(name, axes, data=array, compression="gzip", compression_opts=1, shuffle=True)
            units = self.diagnostics.get("units")
            for name, unit in units.items() if isinstance(units, Mapping) else ():
                if name in self.names:
                    file["posterior"][name].attrs["units"] = str(unit)

    def _write_group(self, file: Any, name: str, variables: Mapping[str, Array]) -> None:
        group = file.create_group(name)
        group.dimensions = dict(zip(("chain", "draw"), self.draws.shape[:2], strict=True))
        for axis, size in zip(("chain", "draw"), self.draws.shape[:2], strict=True):
            group.create_variable(axis, (axis,), data=np.arange(size, dtype=np.int64))
        for key, value in variables.items():
            data = np.ascontiguousarray(value)
            group.create_variable(key, ("chain", "draw"), data=data, compression="gzip", compression_opts=1, shuffle=True)
        group.attrs["inference_library"] = str(self.diagnostics.get("method", "gonio"))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Posterior:
        """Read a file written by `save`.

        Raises
        ------
        DatasetError
            If it cannot be read, is not a posterior, is larger than 10^8 numbers, or holds a value that is not finite.
        """
        import h5netcdf

        if not Path(path).is_file():
            raise DatasetError(f"{path}: there is no such file; fit first")
        try:
            with h5netcdf.File(path, "r") as file:
                return cls._read(file, path)
        except DatasetError:
            raise
        except (OSError, KeyError, ValueError, TypeError, AttributeError, RuntimeError, RecursionError) as error:
            raise DatasetError(f"{path}: this is no posterior of gonio, or it is damaged ({error})") from error

    @classmethod
    def _read(cls, file: Any, path: str | os.PathLike[str]) -> Posterior:
        found = file.attrs.get("format")
        if found != FORMAT:
            raise DatasetError(f"{path}: this is no posterior of gonio (its format is {found!r}, not {FORMAT!r})")
        names = json.loads(file.attrs["names"])
        fixed = json.loads(file.attrs["fixed"])
        diagnostics = json.loads(file.attrs["diagnostics"])
        if not (isinstance(names, list) and all(isinstance(name, str) for name in names) and names):
            raise DatasetError(f"{path}: its list of parameters is damaged")
        if not (isinstance(fixed, dict) and isinstance(diagnostics, dict)):
            raise DatasetError(f"{path}: its attributes are damaged")
        variables = [file["posterior"][name] for name in names]
        lp = file["sample_stats"]["lp"]
        shape = tuple(lp.shape)
        for name, variable in (*zip(names, variables, strict=True), ("lp", lp)):
            fits = tuple(variable.dimensions) == ("chain", "draw") and tuple(variable.shape) == shape
            if not fits or variable.dtype.kind != "f":
                raise DatasetError(f"{path}: {name} has shape {tuple(variable.shape)}, needed are numbers of shape {shape}")
        if math.prod(shape) * (len(names) + 1) > _LARGEST:
            raise DatasetError(f"{path}: {math.prod(shape) * (len(names) + 1)} numbers are more than {_LARGEST} allowed")
        draws = np.stack([np.asarray(variable[...], dtype=np.float64) for variable in variables], axis=2)
        walk = {name: np.asarray(v[...]) for name, v in file["walk"].variables.items()} if "walk" in file.groups else None
        if walk is not None and sum(array.size for array in walk.values()) > _LARGEST:
            raise DatasetError(f"{path}: its chains hold more than {_LARGEST} numbers")
        fixed = {str(name): float(value) for name, value in fixed.items()}
        log_probability = np.asarray(lp[...], dtype=np.float64)
        return cls(str(file.attrs["model"]), tuple(names), draws, log_probability, fixed, diagnostics, walk)


def _plain(value: Any) -> Any:
    """JSON-compatible copy: NumPy scalars as numbers, NaN and infinity as null."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(item) for item in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value if value is None or isinstance(value, str) else str(value)
