"""Kernels are cached on disk and never stale: a second process hits, an edit of a model misses, its undoing hits."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from gonio import jit

_SCRIPT = """
import numpy as np
from gonio import jit
import material
def build(f):
    def total(x):
        s = 0.0
        for k in range(x.size):
            s += f(x[k])
        return s
    return jit.kernel(total)
value = build(material.model)(np.arange(4.0))
print(value, jit.compiled_count())
"""
_MODEL = "from gonio import jit\nFACTOR = {factor}\n@jit.model\ndef model(x):\n    return FACTOR * x + {offset}\n"


def _run(folder: Path, factor: float, offset: float, cache: Path) -> tuple[float, int]:
    (folder / "material.py").write_text(_MODEL.format(factor=factor, offset=offset))
    root = Path(jit.__file__).parents[1]
    environment = os.environ | {
        "NUMBA_CACHE_DIR": str(cache),
        "PYTHONPATH": os.pathsep.join((str(folder), str(root))),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    done = subprocess.run([sys.executable, "-c", _SCRIPT], env=environment, capture_output=True, text=True, check=True)
    value, compiled = done.stdout.split()
    return float(value), int(compiled)


def test_cache_hits_and_is_never_stale(tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    assert _run(tmp_path, 2.0, 0.0, cache) == (12.0, 1)
    assert _run(tmp_path, 2.0, 0.0, cache) == (12.0, 0)  # a second process hits
    assert _run(tmp_path, 3.0, 0.0, cache) == (18.0, 1)  # a constant edited
    assert _run(tmp_path, 3.0, 1.0, cache) == (22.0, 1)  # the code edited
    assert _run(tmp_path, 2.0, 0.0, cache) == (12.0, 0)  # undone
    for file in (cache / "gonio").iterdir():
        file.write_bytes(b"damaged")
    assert _run(tmp_path, 2.0, 0.0, cache) == (12.0, 1)  # compiles again, does not fail


def test_objects_that_cannot_be_fingerprinted_are_refused() -> None:
    settings = {"gain": 2.0}

    def scaled(x):  # type: ignore[no-untyped-def]
        return settings["gain"] * x

    with pytest.raises(TypeError, match="a kernel may not use"):
        jit.kernel(scaled)
