"""scene.toml: a surface, its light, the viewer, and the reflectance map that is wanted of them.

The light is read in `gonio.config.sources`. What a BRDF model accepts is known to `gonio.brdf`, which is asked when the
scene is built. It loads no numerical package.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from gonio.config.reader import Document, Table, read_document, suggestion
from gonio.config.sources import SourceConfig, read_source
from gonio.errors import ConfigurationError, ParameterError

if TYPE_CHECKING:
    from gonio.brdf import BRDF, Model

DEG = "_deg"
Value = float | str | bool


@dataclass(frozen=True)
class BRDFConfig:
    """A BRDF: of a run (its table or its fit), or of a model with its parameters.

    Attributes
    ----------
    run : str or None
    use : str
    model : str or None
        A sum such as ``"lambertian+ggx"``.
    parameters : mapping
        As they are written: numbers, those of angles with ``_deg`` and in degrees; texts and flags choose a form of a model.
    where : str
        What messages call it.
    """

    run: str | None
    use: Literal["table", "fit"]
    model: str | None
    parameters: Mapping[str, Value]
    where: str = field(default="[brdf]", compare=False)

    def build(self) -> BRDF:
        """The BRDF of the model.

        A parameter may be written ``albedo`` instead of ``lambertian.albedo`` where no other term has one of that name.

        Raises
        ------
        ConfigurationError
            If it is a run's, or the model or a parameter is unknown, missing or out of range.
        """
        from gonio import brdf

        if self.model is None:
            raise ConfigurationError(f"the BRDF of the run {self.run} is in its files; load them instead of building it")
        try:
            models = brdf.parse(self.model)
        except ParameterError as exc:
            raise ConfigurationError(f"{self.where} model: {exc}") from exc
        names = brdf.term_names(models)
        written = self._by_term(dict(zip(names, models, strict=True)))
        return brdf.BRDF(self._term(name, model, written[name]) for name, model in zip(names, models, strict=True))

    def _by_term(self, models: Mapping[str, Model]) -> dict[str, dict[str, Value]]:
        """Keys and values of each term."""
        from gonio.brdf.families import find

        values: dict[str, dict[str, Value]] = {name: {} for name in models}
        for key, value in self.parameters.items():
            term, _, parameter = key.rpartition(".")
            if not term:
                keys = {
                    name: [*map(written_name, model.parameters), *(p.name for p in model.parameters),
                           *find(model.name).choices]
                    for name, model in models.items()
                }  # fmt: skip
                having = [name for name, known in keys.items() if key in known] or list(models)
                if len(having) != 1:
                    known = [f"{name}.{written_name(p)}" for name, model in models.items() for p in model.parameters]
                    count = sum(key in own for own in keys.values())
                    raise ConfigurationError(
                        f"{self.where} {key} fits {count} terms{suggestion(key, known)}; write one of: {', '.join(known)}"
                    )
                term, parameter = having[0], key
            if term not in values:
                raise ConfigurationError(
                    f"{self.where} {key}: the model has no term {term!r}{suggestion(term, values)}; it has: "
                    f"{', '.join(values)}"
                )
            values[term][parameter] = value
        return values

    def _term(self, name: str, model: Model, written: Mapping[str, Value]) -> Any:
        from gonio import brdf
        from gonio.brdf.families import find

        where = f"{self.where} {name}"
        family = find(model.name)
        chosen: dict[str, object] = {}
        numbers: dict[str, float] = {}
        for key, value in written.items():
            if key in family.choices:
                chosen[key] = value if isinstance(value, str | bool) else f"{value:g}"  # a year may be written as a number
            elif isinstance(value, str | bool):
                known = [*family.choices, *map(written_name, model.parameters)]
                if key in known:
                    raise ConfigurationError(f"{where}: {key} is {value!r}; it must be a number without quotes")
                raise ConfigurationError(
                    f"{where} has no {key!r}{suggestion(key, known)}; it has: {', '.join(known) or 'nothing to set'}"
                )
            else:
                numbers[key] = value
        if chosen:
            try:
                model = family.model(**{**model.choices, **chosen})
            except ParameterError as exc:
                raise ConfigurationError(f"{where}: {exc}") from exc
        values = read_parameters(numbers, model, where)
        try:
            return brdf.Term(model, model.values(values))
        except ParameterError as exc:
            raise ConfigurationError(f"{where}: {exc}") from exc


def written_name(parameter: Any) -> str:
    """What a parameter is called where a user writes it: an angle ends in ``_deg``."""
    return f"{parameter.name}{DEG}" if parameter.unit == "rad" else str(parameter.name)


def read_parameters(written: Mapping[str, float], model: Model, where: str) -> dict[str, float]:
    """Parameters of a model in its own units from what a user wrote, angles in degrees as ``sigma_deg``.

    Raises
    ------
    ConfigurationError
        If one is unknown, missing, without its unit or outside its range.
    """
    known = {written_name(parameter): parameter for parameter in model.parameters}
    values: dict[str, float] = {}
    for key, value in written.items():
        parameter = known.get(key)
        if parameter is None:
            if f"{key}{DEG}" in known:
                raise ConfigurationError(f"{where}: {key} has no unit; write {key}{DEG}, in degrees")
            raise ConfigurationError(
                f"{where} has no parameter {key!r}{suggestion(key, known)}; it has: {', '.join(known) or 'none'}"
            )
        scale = math.radians(1.0) if parameter.unit == "rad" else 1.0
        lower, upper = parameter.lower / scale, parameter.upper / scale
        if not lower <= value <= upper * (1.0 + 1e-15):  # 90 degrees, say, to the last bit
            unit = {"rad": " degrees", "1": ""}.get(parameter.unit, f" {parameter.unit}")
            raise ConfigurationError(
                f"{where}: {key} = {value:g} is outside [{lower:g}, {upper:g}]{unit}; choose one inside"
            )
        values[parameter.name] = min(value * scale, parameter.upper)
    missing = [key for key, p in known.items() if p.name not in values and p.default is None]
    if missing:
        raise ConfigurationError(f"{where} needs {', '.join(missing)} as well; its parameters are: {', '.join(known)}")
    return values


@dataclass(frozen=True)
class SceneConfig:
    """A reflectance map to compute.

    Attributes
    ----------
    brdf : BRDFConfig
    sources : tuple of SourceConfig
        Their sum is the light.
    p, q : (float, float)
        Ranges of the gradient.
    n : (int, int)
        Points on the axes of p and q.
    rtol, atol : float
        Relative and absolute [W m^-2 sr^-1] error asked of the integrator.
    viewer : (theta, phi) or None
        Direction of a viewer off the z axis [rad].
    tangent : float or None
        Rotation of a grained surface's x axis about its normal [rad].
    map, plot : Path or None
        Files to write.
    """

    brdf: BRDFConfig
    sources: tuple[SourceConfig, ...]
    p: tuple[float, float]
    q: tuple[float, float]
    n: tuple[int, int]
    rtol: float
    atol: float = 0.0
    viewer: tuple[float, float] | None = None
    tangent: float | None = None
    map: Path | None = None
    plot: Path | None = None


def load_scene(path: str | Path) -> SceneConfig:
    """Read a scene file; see `parse_scene`. Files that it names are looked for in its folder."""
    return parse_scene(read_document(path), str(path), folder=Path(path).absolute().parent)


def parse_scene(text: str, name: str = "scene.toml", *, folder: Path | None = None) -> SceneConfig:
    """The scene that a text describes.

    Parameters
    ----------
    text : str
    name : str, optional
        What messages call it.
    folder : Path, optional
        To which the paths in it are relative; by default the one in which the process runs.

    Raises
    ------
    ConfigurationError
        With every problem of the document at once.
    """
    document = Document(text, name)
    root, folder = document.root, folder or Path()
    brdf = _brdf(root.table("brdf"))
    sources = tuple(read_source(table, folder) for table in root.tables("source"))
    if not sources:
        document.report("", "source", "is missing; write at least one [[source]]")
    grid = root.table("grid", required=False)
    viewer = root.table("viewer", required=False) if "viewer" in root else None
    surface = root.table("surface", required=False)
    output = root.table("output", required=False)
    n = (
        grid.integers("n", count=2, lower=2, upper=20_000) if grid.holds_list("n")
        else (grid.integer("n", 256, lower=2, upper=20_000, unit="points"),) * 2
    )  # fmt: skip
    config = SceneConfig(
        brdf=brdf,
        sources=sources,
        p=_range(grid, "p"),
        q=_range(grid, "q"),
        n=(n[0], n[1]),
        rtol=(root if "rtol" in root else grid).number("rtol", 1e-6, lower=1e-14, upper=0.1),
        atol=(root if "atol" in root else grid).number("atol", 0.0, lower=0.0, unit="W m^-2 sr^-1"),
        viewer=None if viewer is None else (
            viewer.angle("theta_deg", lower=0.0, upper=180.0), viewer.angle("phi_deg", 0.0)
        ),
        tangent=surface.angle("rotation_deg") if "rotation_deg" in surface else None,
        map=_path(output, "map", folder, (".nc",)),
        plot=_path(output, "plot", folder, (".png",)),
    )  # fmt: skip
    for table in (grid, viewer, surface, output, root):
        if table is not None:
            table.finish()
    document.finish()
    return config


def _brdf(table: Table) -> BRDFConfig:
    run = table.text("run") if "run" in table else None
    model = table.text("model") if "model" in table else None
    use = table.text("use", "fit", choices=("table", "fit"))
    where = f"{table.document.name}: [brdf]"
    if model is None:
        if run is None:
            table.report("", 'needs run = "..." or model = "..."')
        table.finish()
        return BRDFConfig(run, use, None, {}, where)  # type: ignore[arg-type]
    if run is not None:
        table.report("model", "does not go with run; write one of them")
    written = table.table("parameters", required=False).free_values()
    return BRDFConfig(None, use, model, written | table.free_values(), where)  # type: ignore[arg-type]


def _range(table: Table, key: str) -> tuple[float, float]:
    low, high = table.numbers(key, (-3.0, 3.0), count=2, lower=-1e150, upper=1e150)
    if not low < high and key in table:
        table.report(key, f"= [{low:g}, {high:g}] must ascend")
    return low, high


def _path(table: Table, key: str, folder: Path, suffixes: tuple[str, ...]) -> Path | None:
    if key not in table:
        return None
    text = table.text(key)
    if text and Path(text).suffix.lower() not in suffixes:
        table.report(key, f"= {text!r} is no file that can be written; its name ends in {' or '.join(suffixes)}")
    return folder / text
