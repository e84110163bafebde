"""Angles where a user writes them: a name ends in ``_deg`` and the value is in degrees; inside, radians."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from gonio.errors import ConfigurationError

if TYPE_CHECKING:
    from gonio.channels import ChannelSamples
    from gonio.samples import BRDFSamples

DEG = "_deg"
_DEGREE = math.radians(1.0)


def angles_of_fit(model: str, samples: BRDFSamples | ChannelSamples) -> set[str]:
    """Names of a fit's parameters that are angles [rad], such as ``"oren_nayar.sigma"`` and ``"shared.arm"``."""
    from gonio.brdf import parse, term_names

    models = parse(model)
    found = {
        f"{t}.{p.name}" for t, m in zip(term_names(models), models, strict=True) for p in m.parameters if p.unit == "rad"
    }
    shared = getattr(samples, "shared", ())  # several channels have none
    return found | {f"shared.{error.name}" for error in shared if error.unit == "rad"}


def fit_options(written: Mapping[str, Any], angles: set[str]) -> dict[str, Any]:
    """Options of a fit as a user wrote them, with the names and units that the fit knows.

    Parameters
    ----------
    written : mapping
        ``free`` (names), ``fix`` (name to value) and ``priors`` (name to prior) are changed, others are kept.
    angles : set of str
        Names of angles.

    Raises
    ------
    ConfigurationError
        If an angle has a value without its unit.
    """
    options = dict(written)
    if "free" in options:
        options["free"] = tuple(_own_name(name, angles) for name in options["free"])
    for key, convert in (("fix", lambda value: value * _DEGREE), ("priors", _prior)):
        given: Mapping[str, Any] = options.get(key, {})
        _insist(key, given, angles)
        if given:
            options[key] = {
                _own_name(name, angles): convert(value) if _own_name(name, angles) != name else value
                for name, value in given.items()
            }
    return options


def _own_name(name: str, angles: set[str]) -> str:
    bare = name.removesuffix(DEG)
    return bare if bare in angles else name


def _insist(key: str, names: Iterable[str], angles: set[str]) -> None:
    for name in names:
        if name in angles:
            raise ConfigurationError(f"{key}: {name} has no unit; write {name}{DEG}, in degrees")


def _prior(prior: tuple[Any, ...]) -> tuple[Any, ...]:
    kind, *numbers = prior
    if kind == "log_normal":
        return kind, numbers[0] + math.log(_DEGREE), numbers[1]
    return kind, *(number * _DEGREE for number in numbers)
