"""What is to be fitted, from the options of a verb and a fit.toml."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from gonio.errors import ConfigurationError


def fit_choices(function: Callable[..., Any]) -> Callable[..., Any]:
    """The options --model, --config, --free, --fix."""
    for option in reversed((
        click.option("--model", help="Sum of models, such as lambertian+ggx."),
        click.option("--config", type=click.Path(path_type=Path, dir_okay=False), help="A fit.toml."),
        click.option("--free", multiple=True, metavar="NAME", help="Free a parameter that its model holds, e.g. ggx.k_s."),
        click.option("--fix", multiple=True, metavar="NAME=VALUE", help="Hold a parameter."),
    )):  # fmt: skip
        function = option(function)
    return function


def chosen_fit(
    model: str | None, config: Path | None, free: tuple[str, ...], fix: tuple[str, ...]
) -> tuple[str, int, dict[str, Any]]:
    """Model, seed and the other options of `fitting.fit`, angles as a user writes them.

    Raises
    ------
    ConfigurationError
        If there is no model, or an option cannot be read.
    """
    from gonio.config import load_fit

    chosen = load_fit(config) if config is not None else None
    model = model or (chosen.model if chosen else None)
    if model is None:
        raise ConfigurationError("no model: give --model lambertian+ggx or --config fit.toml")
    held = (dict(chosen.fix) if chosen else {}) | held_values(fix)
    options: dict[str, Any] = {"free": tuple(free) + (chosen.free if chosen else ()), "fix": held}
    if chosen and chosen.priors:
        options["priors"] = dict(chosen.priors)
    if chosen and chosen.max_steps:
        options["max_steps"] = chosen.max_steps
    if chosen and chosen.student:
        options["student"] = chosen.student
    return model, chosen.seed if chosen else 1, options


def held_values(fix: tuple[str, ...]) -> dict[str, float]:
    """Values of --fix NAME=VALUE by name."""
    held = {}
    for item in fix:
        name, separator, value = item.partition("=")
        try:
            held[name] = float(value)
        except ValueError:
            separator = ""
        if not separator:
            raise ConfigurationError(f"--fix {item}: write it as --fix NAME=VALUE, for example --fix ggx.f_0=0.04")
    return held
