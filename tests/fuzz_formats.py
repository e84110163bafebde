"""Fuzzing of the readers from the good and malformed files of `tests.malformed`: bytes replaced, inserted, removed, spliced.

Each mutant must give samples or a `DatasetError` of one line, in less than two seconds; memory is watched.

    python -m tests.fuzz_formats ssdd 600      # seconds
"""

from __future__ import annotations

import os
import resource
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gonio import formats
from gonio.errors import DatasetError
from tests import gates, malformed

GATE_SECONDS = float(os.environ.get("GONIO_FUZZ_SECONDS", "600"))
SLOW_S = 2.0  # for the in-process readers; NetCDF starts a process for each file
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


@dataclass
class Found:
    """Of one reader: files tried, how many were read, what went wrong, slowest file [s], peak memory [MB]."""

    name: str
    seed: int
    files: int = 0
    read: int = 0
    crashes: list[str] = field(default_factory=list)
    slowest_s: float = 0.0
    peak_mb: float = 0.0


def mutant(corpus: list[bytes], rng: np.random.Generator) -> bytes:
    """A file of the corpus after one to six edits."""
    data = bytearray(corpus[int(rng.integers(len(corpus)))])
    for _ in range(int(rng.integers(1, 7))):
        at = int(rng.integers(0, len(data) + 1))
        kind = int(rng.integers(6))
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
        else:
            data[at : at + 60] = data[at : at + 60] * int(rng.integers(2, 5))
    return bytes(data)


def fuzz(name: str, folder: Path, *, seed: int, files: int | None = None, seconds: float | None = None) -> Found:
    """Read mutants of one format until so many files or seconds are done."""
    good = malformed.GOOD[name](folder)
    corpus = [good, *(edit(good) for other, edit, _ in malformed.BAD if other == name)]
    corpus = [data for data in corpus if len(data) < 3_000_000] or [good]
    rng, found = np.random.default_rng(seed), Found(name, seed)
    reader = formats.FORMATS[name].read
    path, end = folder / "mutant", time.monotonic() + (seconds or 1e9)
    while found.files < (files or 1e18) and time.monotonic() < end:
        data = mutant(corpus, rng)
        path.write_bytes(data)
        start = time.process_time()
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
        found.slowest_s = max(found.slowest_s, time.process_time() - start)
    found.peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return found


def record(found: Found) -> None:
    """Write the row of the gate and insist on it."""
    figure = (
        f"{found.files} files, {found.read} readings, {len(found.crashes)} crashes; slowest {found.slowest_s:.2f} s, "
        f"peak memory of the process {found.peak_mb:.0f} MB"
    )
    command = f"pytest -m gate tests/unit/test_formats_hostile.py -k {found.name} (GONIO_FUZZ_SECONDS={GATE_SECONDS:.0f})"
    gates.record(f"fuzzed reader {found.name}", figure, "0 crashes, no file above 2 s, 512 MB", str(found.seed), command)
    assert found.crashes == []
    assert found.slowest_s < SLOW_S or found.name == "netcdf"
    assert found.peak_mb < 512


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as temporary:
        print(fuzz(sys.argv[1], Path(temporary), seed=3, seconds=float(sys.argv[2])))
