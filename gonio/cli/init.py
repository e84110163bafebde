"""gonio init: commented files to start from."""

from __future__ import annotations

from pathlib import Path

import click

from gonio.cli.output import json_option, speaking
from gonio.errors import ConfigurationError


@click.command()
@click.argument("folder", type=click.Path(path_type=Path, file_okay=False))
@json_option
def init(folder: Path, as_json: bool) -> None:
    """Write rig.toml (a simulated rig), plan.toml, scene.toml and fit.toml into FOLDER. Nothing is overwritten."""
    from gonio.config import default_documents

    with speaking(as_json) as output:
        documents = default_documents()
        there = [name for name in documents if (folder / name).exists()]
        if there:
            raise ConfigurationError(f"{folder} has {', '.join(there)} already; give another folder or move them away")
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for name, text in documents.items():
                (folder / name).write_text(text, encoding="utf-8")
        except OSError as exc:
            raise ConfigurationError(f"{folder} cannot be written ({exc.strerror}); give another folder") from exc
        output.say(f"wrote {', '.join(documents)} into {folder}")
        output.say(f"next: gonio scan {folder}/plan.toml --rig {folder}/rig.toml --out runs/first --dry-run")
        output.result(folder=folder, files=list(documents))
