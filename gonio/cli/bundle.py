"""gonio bundle: a run ready for a data repository."""

from __future__ import annotations

import hashlib
import json
import platform
import secrets
import shutil
from pathlib import Path

import click

from gonio.cli import steps
from gonio.cli.output import json_option, speaking
from gonio.errors import ConfigurationError, DatasetError

EXPORTS = {"netcdf": "data.nc", "csv": "samples.csv", "bird": "samples.bird.json"}
LICENCES = {
    "CC-BY-4.0": "https://creativecommons.org/licenses/by/4.0/legalcode",
    "CC-BY-SA-4.0": "https://creativecommons.org/licenses/by-sa/4.0/legalcode",
    "CC0-1.0": "https://creativecommons.org/publicdomain/zero/1.0/legalcode",
    "MIT": "https://opensource.org/license/mit",
}


@click.command()
@click.argument("run", type=click.Path(path_type=Path))
@click.option("--out", required=True, type=click.Path(path_type=Path, file_okay=False), help="New folder.")
@click.option("--title", required=True, help="Title of the data set.")
@click.option("--author", "authors", multiple=True, required=True, metavar="'FAMILY, GIVEN'", help="May be repeated.")
@click.option("--licence", default="CC-BY-4.0", show_default=True, type=click.Choice(list(LICENCES)))
@json_option
def bundle(run: Path, out: Path, title: str, authors: tuple[str, ...], licence: str, as_json: bool) -> None:
    """Make a folder for publication from RUN: data, NetCDF, report, checksums, provenance, licence and citation file."""
    from gonio import __version__, formats

    people = [tuple(part.strip() for part in author.partition(",")[::2]) for author in authors]
    if any(not family for family, _ in people):
        raise ConfigurationError("--author: write it as --author 'Horn, Berthold'")
    if out.exists():
        raise DatasetError(f"{out} exists; give the name of a new folder")
    with speaking(as_json) as output, steps.open_run(run) as opened:
        if not opened.has_samples():
            raise DatasetError(f"{run} has no samples; run `gonio reduce {run}` first")
        samples = steps.all_samples(opened)
        table = steps.load_table(opened) if opened.table_path.exists() else None
        report = steps.report(opened, output)
        part = out.with_name(f".{out.name}.{secrets.token_hex(4)}.part")
        try:
            part.mkdir(parents=True)
            about = {"title": title, "licence": licence, "run": opened.path.name}
            for name, file in EXPORTS.items():
                formats.export(name, part / file, samples=samples, table=table, attributes=about)
            shutil.copy(report, part / "report.html")
            for path in (opened.posterior_path, *sorted(opened.path.glob("map*.nc"))):
                if path.exists():
                    shutil.copy(path, part / path.name)
            for name, text in opened.documents.items():
                (part / f"{Path(name).stem}.toml").write_text(text, encoding="utf-8")
            provenance = {
                "title": title,
                "quantity": "BRDF f_r [1/sr]",
                "samples": len(samples),
                "run": dict(opened.attributes),
                "gonio": __version__,
                "python": platform.python_version(),
            }
            (part / "provenance.json").write_text(json.dumps(provenance, indent=1, sort_keys=True) + "\n", encoding="utf-8")
            (part / "LICENSE").write_text(f"{title}\n\nLicensed under {licence}: {LICENCES[licence]}\n", encoding="utf-8")
            (part / "CITATION.cff").write_text(_citation(title, people, licence), encoding="utf-8")
            (part / "README.md").write_text(
                _readme(title, licence, sorted(p.name for p in part.iterdir())), encoding="utf-8"
            )
            files = sorted(p for p in part.rglob("*") if p.is_file())
            sums = "".join(
                f"{hashlib.sha256(p.read_bytes()).hexdigest()}  {p.relative_to(part).as_posix()}\n" for p in files
            )
            (part / "SHA256SUMS").write_text(sums, encoding="utf-8")
            part.rename(out)
        except OSError as error:
            raise DatasetError(f"{out} cannot be written: {error.strerror or error}; check folder and free space") from error
        finally:
            shutil.rmtree(part, ignore_errors=True)
        output.say(f"wrote {out}: {len(files) + 1} files; check them with: sha256sum -c SHA256SUMS")
        output.result(folder=out, files=[p.name for p in files] + ["SHA256SUMS"])


def _citation(title: str, people: list[tuple[str, ...]], licence: str) -> str:
    """Citation File Format 1.2; JSON strings are YAML strings."""
    lines = ["cff-version: 1.2.0", "message: If you use these data, please cite them as below.", "type: dataset"]
    lines += [f"title: {json.dumps(title)}", f"license: {licence}", "authors:"]
    for family, given in people:
        lines.append(f"  - family-names: {json.dumps(family)}")
        if given:
            lines.append(f"    given-names: {json.dumps(given)}")
    return "\n".join(lines) + "\n"


def _readme(title: str, licence: str, names: list[str]) -> str:
    listed = "\n".join(f"- `{name}`" for name in names)
    return (
        f"# {title}\n\nBRDF f_r [1/sr] after Nicodemus; angles from the surface normal, mirror direction at\n"
        "phi_r = phi_i + pi. Uncertainties are standard uncertainties (k = 1) of random errors; errors shared by all\n"
        f"samples are listed apart in `data.nc`. Licence: {licence}. Checksums are in `SHA256SUMS`.\n\n{listed}\n"
    )
