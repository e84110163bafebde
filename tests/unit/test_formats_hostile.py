"""Malformed files: each gives one sentence of its own, no reader crashes, hangs or takes memory; a slice of the fuzzing."""

from __future__ import annotations

from pathlib import Path

import pytest

from gonio import formats
from gonio.errors import DatasetError
from tests import fuzz_formats, malformed


def test_the_good_files_are_good(tmp_path: Path) -> None:
    for name, make in malformed.GOOD.items():
        if name == "merl":  # its one size is 35 MB; tests/conformance/test_merl_binary.py reads whole ones
            continue
        path = tmp_path / name
        path.write_bytes(make(tmp_path))
        assert formats.sniff(path) == name and len(formats.read_channels(path)) > 0


def test_each_malformed_file_gives_a_sentence_of_its_own(tmp_path: Path) -> None:
    good = {name: make(tmp_path) for name, make in malformed.GOOD.items()}
    path = tmp_path / "file.bsdf"
    sentences = []
    for name, edit, expected in malformed.BAD:
        path.write_bytes(edit(good[name]))
        with pytest.raises(DatasetError) as caught:
            formats.read(path)
        sentence = str(caught.value)
        assert any(part in sentence for part in expected.split("|")), (name, expected, sentence)
        assert "\n" not in sentence and "file.bsdf" in sentence and len(sentence) < 500, sentence
        sentences.append(f"{name}: {sentence}")
    assert len(malformed.BAD) >= 100
    assert len(set(sentences)) == len(sentences)
    print(f"{len(sentences)} malformed files, {len(set(sentences))} sentences")


@pytest.mark.parametrize("name", list(malformed.GOOD))
def test_fuzzed_a_little(tmp_path: Path, name: str) -> None:
    """The same fuzzing that `make gates` runs for ten minutes a reader, for a fixed number of files."""
    files = {"netcdf": 4, "utia": 40, "merl": 20}.get(name, 400)
    found = fuzz_formats.fuzz(name, tmp_path, seed=1, files=files)
    assert found.crashes == [] and found.files == files


@pytest.mark.gate
@pytest.mark.parametrize("name", list(malformed.GOOD))
def test_fuzzed_for_long(tmp_path: Path, name: str) -> None:
    fuzz_formats.record(fuzz_formats.fuzz(name, tmp_path, seed=2, seconds=60 * fuzz_formats.MINUTES))
