"""BRDF models that other packages bring along, by entry points of the group ``gonio.brdf_models``.

An entry point has the model's name and loads a `Model` or a `Family`. Nothing of it is imported until the name is asked for
or all models are listed. Built-in names cannot be replaced. Errors of integrals over these models are estimates, as for any
function that gonio has not been tested with.
"""

from __future__ import annotations

import functools
from dataclasses import replace
from importlib.metadata import EntryPoint, entry_points

from gonio.brdf.base import Model
from gonio.brdf.families import Family, single
from gonio.errors import ParameterError

GROUP = "gonio.brdf_models"


@functools.cache
def names() -> tuple[str, ...]:
    """Names of the entry points there are; nothing is loaded."""
    return tuple(dict.fromkeys(point.name for point in entry_points(group=GROUP)))


@functools.cache
def load(name: str) -> Family:
    """The family of an entry point.

    Raises
    ------
    ParameterError
        If it cannot be loaded, is no model, or its name is taken; the message names the package.
    """
    from gonio.brdf.families import FAMILIES

    points = [point for point in entry_points(group=GROUP) if point.name == name]
    owners = " and ".join(_owner(point) for point in points)
    if name in FAMILIES:
        raise ParameterError(f"{owners}: the name {name!r} of its BRDF model is one of gonio's own; rename it")
    if len({point.value for point in points}) != 1:
        raise ParameterError(f"there are several BRDF models {name!r}, by {owners}; uninstall all but one")
    try:
        loaded = points[0].load()
        loaded = single(loaded) if isinstance(loaded, Model) else loaded
        default = loaded.model() if isinstance(loaded, Family) else None
    except Exception as exc:  # whatever the code of others raises
        raise ParameterError(
            f"{owners}: its BRDF model {name!r} ({points[0].value}) cannot be loaded, {type(exc).__name__}: {exc}; repair "
            "or uninstall it"
        ) from exc
    if not isinstance(loaded, Family) or not isinstance(default, Model) or loaded.name != name or default.name != name:
        what = f"a model called {loaded.name!r}" if isinstance(loaded, Family) else f"a {type(loaded).__name__}"
        raise ParameterError(
            f"{owners}: the entry point {name!r} of {GROUP} loads {what}; let it load a gonio.brdf.Model or Family of "
            "that name"
        )
    build = loaded.build
    return replace(loaded, build=functools.cache(lambda **chosen: replace(build(**chosen), own=True)))


def _owner(point: EntryPoint) -> str:
    return f"package {point.dist.name} {point.dist.version}" if point.dist is not None else "a package"
