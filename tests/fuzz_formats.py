"""Fuzzing of the readers from the good and malformed files of `tests.malformed`: bytes and numbers replaced, inserted,
removed, repeated, spliced.

Each mutant must give samples or a `DatasetError` of one line, in less than two seconds of processor, its children's
included; memory is watched.

    python -m tests.fuzz_formats --minutes 10                 # every reader whose row in docs/gates.md is shorter
    python -m tests.fuzz_formats --minutes 10 --reader ssdd
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gonio import formats
from gonio.brdf import grained
from gonio.brdf.tables import Tables
from gonio.channels import RGB
from gonio.errors import DatasetError
from gonio.formats import merl
from tests import gates, malformed, materials

MINUTES = float(os.environ.get("GONIO_FUZZ_MINUTES", "10"))
SLOW_S = 2.0
WORDS = [
    b"0",
    b"-1",
    b"1e308",
    b"nan",
    b"inf",
    b"9" * 40,
    b"\xff\xff\xff\xff",
    b"\0" * 8,
    b"#",
    b",",
    b"\n",
    b" ",
    b"[",
    b"{",
    b"<a>",
]
NUMBER = re.compile(rb"[-+]?[0-9][-+.0-9eE]*")


@dataclass
class Found:
    """Of one reader: files tried, how many were read, what went wrong, slowest file [s], peak memory [MB]."""

    name: str
    seed: int
    minutes: float = 0.0
    files: int = 0
    read: int = 0
    crashes: list[str] = field(default_factory=list)
    slowest_s: float = 0.0
    peak_mb: float = 0.0


def mutant(corpus: list[bytes], rng: np.random.Generator) -> bytes:
    """A file of the corpus, half the time the good one that stands first, after one to six edits."""
    data = bytearray(corpus[0 if rng.random() < 0.5 else int(rng.integers(len(corpus)))])
    for _ in range(int(rng.integers(1, 7))):
        at = int(rng.integers(0, len(data) + 1))
        kind = int(rng.integers(8))
        if kind == 0:
            data[at : at + int(rng.integers(1, 9))] = rng.bytes(int(rng.integers(1, 9)))
        elif kind == 1:
            data[at:at] = WORDS[int(rng.integers(len(WORDS)))]
        elif kind == 2:
            del data[at : at + int(rng.integers(1, 40))]
        elif kind == 3 and at < len(data):
            data[at] ^= 1 << int(rng.integers(8))
        elif kind == 4:
            other = corpus[int(rng.integers(len(corpus)))]
            start = int(rng.integers(0, len(other) + 1))
            data[at : at + 30] = other[start : start + int(rng.integers(1, 60))]
        elif kind == 5:
            data[at : at + 60] = data[at : at + 60] * int(rng.integers(2, 5))
        elif kind == 6:
            data[at : at + 8] = rng.bytes(len(data[at : at + 8]))  # the size stays
        elif number := NUMBER.search(data, at, at + 200):
            data[number.start() : number.end()] = WORDS[int(rng.integers(len(WORDS)))]
    return bytes(data)


def corpus_of(name: str, folder: Path) -> list[bytes]:
    """The good file of a format, then the malformed ones made of it."""
    good = malformed.GOOD[name](folder)
    bad = [edit(good) for other, edit, _ in malformed.BAD if other == name]
    if name == "merl":  # has one size; the malformed ones are heads of it
        good = merl.HEADER + np.linspace(0.0, 100.0, 3 * merl.CELLS).astype("<f8").tobytes()
    if name == "netcdf":
        table = grained.from_brdf(materials.paint(), (4, 4, 4, 4))
        Tables((table, table, table), RGB).save(folder / "table.nc")
        bad.append((folder / "table.nc").read_bytes())
    return [good, *(data for data in bad if len(data) < 3_000_000)]


def fuzz(name: str, folder: Path, *, seed: int, files: int | None = None, seconds: float | None = None) -> Found:
    """Read mutants of one format until so many files or seconds are done."""
    corpus = corpus_of(name, folder)
    rng, found = np.random.default_rng(seed), Found(name, seed)
    reader = formats.FORMATS[name].read
    path, begin = folder / "mutant", time.monotonic()
    while found.files < (files or 1e18) and time.monotonic() < begin + (seconds or 1e9):
        data = mutant(corpus, rng)
        path.write_bytes(data)
        start = _processor_s()
        for read in (formats.read, reader) if reader is not None else (formats.read,):
            try:
                read(path)
                found.read += 1
            except DatasetError as error:
                if "\n" in str(error):
                    found.crashes.append(f"two lines: {str(error)[:100]}")
            except Exception as error:  # noqa: BLE001  what fuzzing is for
                found.crashes.append(f"{type(error).__name__}: {str(error)[:100]}")
                (Path(tempfile.gettempdir()) / f"crash-{name}-{len(found.crashes)}").write_bytes(data)
        found.files += 1
        found.slowest_s = max(found.slowest_s, _processor_s() - start)
    found.minutes = (time.monotonic() - begin) / 60
    of = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    found.peak_mb = max(resource.getrusage(who).ru_maxrss for who in of) / 1024
    return found


def _processor_s() -> float:
    """Processor time of this process and of the children that ended [s]."""
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system


def record(found: Found) -> None:
    """Write the row of the gate and insist on it."""
    figure = (
        f"{found.minutes:.3g} min: {found.files} files, {found.read} readings, {len(found.crashes)} crashes; slowest "
        f"{found.slowest_s:.2f} s, peak memory of a process {found.peak_mb:.0f} MB"
    )
    command = f"python -m tests.fuzz_formats --minutes {found.minutes:.3g} --reader {found.name}"
    gates.record(_gate(found.name), figure, "0 crashes, no file above 2 s, 512 MB", str(found.seed), command)
    assert found.crashes == [], found.crashes[:5]
    assert found.slowest_s < SLOW_S and found.peak_mb < 512, found


def _gate(name: str) -> str:
    return f"fuzzed reader {name}"


def minutes_recorded(name: str) -> float:
    """How long a reader was fuzzed according to docs/gates.md."""
    row = re.search(rf"^\| {_gate(name)} \| ([0-9.]+) min:", gates.PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    return float(row.group(1)) if row else 0.0


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz_formats", description="Fuzz the readers of files.")
    parser.add_argument("--minutes", type=float, default=MINUTES)
    parser.add_argument("--reader", choices=list(malformed.GOOD), help="one only; else all whose row is shorter")
    given = parser.parse_args()
    for name in [given.reader] if given.reader else list(malformed.GOOD):
        if given.reader or minutes_recorded(name) < 0.99 * given.minutes:
            with tempfile.TemporaryDirectory() as folder:
                record(fuzz(name, Path(folder), seed=2, seconds=60 * given.minutes))


if __name__ == "__main__":
    main()
