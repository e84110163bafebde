"""What the command line shows: sentences, progress bars and tables for people, or one JSON object for programs."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import click

Progress = Callable[[int, int], None]
logging.getLogger("gonio").addHandler(logging.NullHandler())  # a log goes to a run or nowhere


class Output:
    """Where a verb speaks. With `as_json` it is silent until `result`.

    Parameters
    ----------
    as_json : bool
        Print one JSON object on standard output and nothing else there.
    """

    def __init__(self, as_json: bool = False) -> None:
        self.as_json = as_json
        self.results: dict[str, Any] = {}
        self._console: Any = None

    @property
    def console(self) -> Any:
        """The rich console, made when first used."""
        if self._console is None:
            from rich.console import Console

            self._console = Console(highlight=False, quiet=self.as_json, soft_wrap=True)
            if not self._console.is_terminal:
                self._console.width = 160  # a file or a pipe has no edge
        return self._console

    def say(self, text: str) -> None:
        """A sentence."""
        self.console.print(text, markup=False)

    def warn(self, text: str) -> None:
        """A sentence that must not be missed; on standard error."""
        logging.getLogger("gonio").warning(text)
        click.echo(f"warning: {text}", err=True)

    def table(self, title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """A table; the first column left, the others right."""
        from rich.box import SIMPLE_HEAD
        from rich.console import Console
        from rich.table import Table
        from rich.text import Text

        shown = Table(title=Text(title), title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
        for k, name in enumerate(header):
            shown.add_column(Text(name), justify="left" if k == 0 else "right", no_wrap=True)
        for row in rows:
            shown.add_row(*(Text(cell) for cell in row))
        natural = self.console.measure(shown, options=self.console.options.update(max_width=1000)).maximum
        if natural <= self.console.width:
            self.console.print(shown)
        else:  # a narrow terminal breaks the lines, but nothing is cut off
            Console(highlight=False, quiet=self.as_json, soft_wrap=True, width=natural).print(shown)

    @contextlib.contextmanager
    def stage(self, description: str) -> Iterator[Progress]:
        """A progress bar; call what it yields with (done, total)."""
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

        start = time.perf_counter()
        columns = (
            TextColumn("{task.description:<26}"), BarColumn(30), MofNCompleteColumn(), TimeElapsedColumn(),
            TextColumn("eta"), TimeRemainingColumn(),
        )  # fmt: skip
        live = self.console.is_terminal and not self.as_json
        with Progress(*columns, console=self.console, disable=not live, transient=True) as bars:
            task = bars.add_task(description, total=None)

            def advance(done: int, total: int) -> None:
                bars.update(task, completed=done, total=total)

            yield advance
        self.say(f"{description:<26} {time.perf_counter() - start:6.1f} s")

    def result(self, **values: Any) -> None:
        """Add to what --json prints."""
        self.results.update(values)

    def finish(self) -> None:
        """Print the JSON object, if asked for."""
        if self.as_json:
            click.echo(json.dumps(_plain(self.results), allow_nan=False))

    @staticmethod
    def close_stdout() -> None:
        """Point standard output to nowhere, so that the interpreter's last flush does not complain."""
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextlib.contextmanager
def speaking(as_json: bool) -> Iterator[Output]:
    """The output of a verb; its JSON object is printed if the verb succeeds."""
    output = Output(as_json)
    yield output
    output.finish()


def json_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """The option --json."""
    return click.option("--json", "as_json", is_flag=True, help="Print one JSON object on standard output.")(function)


def fail(sentence: str, code: int, as_json: bool) -> int:
    """Tell an error: on standard error, and as JSON too where that was asked for."""
    text = " ".join(sentence.split())
    logging.getLogger("gonio").error(text)
    if as_json:
        click.echo(json.dumps({"error": text, "exit_code": code}))
    click.echo(f"error: {text}" if code != 130 else text, err=True)
    return code


def log_to(path: Path) -> None:
    """Send the log of this process to a run's file, appending."""
    logger = logging.getLogger("gonio")
    resolved = str(path.resolve())
    if any(getattr(handler, "baseFilename", None) == resolved for handler in logger.handlers):
        return
    handler = logging.FileHandler(resolved, encoding="utf-8", delay=True)
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    logger.propagate = False
    for name in ("drivers", "sim", "fitting"):
        other = logging.getLogger(name)
        other.addHandler(handler)
        other.setLevel(logging.INFO)
        other.propagate = False


def _plain(value: Any) -> Any:
    """JSON has no NaN and no arrays."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, str | bool | int | None):
        return value
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, list | tuple | set):
        return [_plain(v) for v in value]
    if isinstance(value, float):
        return value if value == value and abs(value) != float("inf") else None
    return str(value)
