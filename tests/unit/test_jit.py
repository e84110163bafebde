"""Kernels are cached on disk and never stale: a second process hits, an edit of a model misses, its undoing hits."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba import TypingError

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
_BY_ADDRESS = """
import numpy as np
from gonio import jit
from material import model
def weigh(x):
    s = 0.0
    for k in range(x.size):
        s += model(x[k])
    return s
call = jit.calling("float64(float64[::1])")
@jit.kernel
def total(at, x):
    return call(at, x)
value = total(jit.address(weigh, "float64(float64[::1])"), np.arange(4.0))
print(value, jit.compiled_count())
"""
_MODEL = "from gonio import jit\nFACTOR = {factor}\n@jit.model\ndef model(x):\n    return FACTOR * x + {offset}\n"


def _run(folder: Path, factor: float, offset: float, cache: Path, script: str = _SCRIPT) -> tuple[float, int]:
    (folder / "material.py").write_text(_MODEL.format(factor=factor, offset=offset))
    root = Path(jit.__file__).parents[1]
    environment = os.environ | {
        "NUMBA_CACHE_DIR": str(cache),
        "PYTHONPATH": os.pathsep.join((str(folder), str(root))),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True)
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


def test_what_a_kernel_calls_by_address_is_cached_like_a_kernel(tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    assert _run(tmp_path, 2.0, 0.0, cache, _BY_ADDRESS) == (12.0, 2)
    assert _run(tmp_path, 2.0, 0.0, cache, _BY_ADDRESS) == (12.0, 0)  # a second process hits
    assert _run(tmp_path, 3.0, 1.0, cache, _BY_ADDRESS) == (22.0, 1)  # the kernel itself stays as it is
    for file in (cache / "gonio").iterdir():
        file.write_bytes(b"damaged")
    assert _run(tmp_path, 2.0, 0.0, cache, _BY_ADDRESS) == (12.0, 2)


def test_arguments_of_another_kind_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory would be read in the wrong order, or a constant written to."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    call = jit.calling("float64(float64[:,::1])")

    @jit.kernel
    def first(at, x):  # type: ignore[no-untyped-def]
        return call(at, x)

    @jit.kernel
    def short(at):  # type: ignore[no-untyped-def]
        return call(at)

    def corner(x):  # type: ignore[no-untyped-def]
        return x[0, 0]

    at, x = jit.address(corner, "float64(float64[:,::1])"), np.arange(3.0, 9.0).reshape(2, 3)
    assert first(at, x) == 3.0
    constant = x.copy()
    constant.flags.writeable = False
    for other in (x.T, x[0], constant):
        with pytest.raises(TypingError):
            first(at, other)
    with pytest.raises(TypingError):
        short(at)


_KEYS = """
from gonio.brdf import families
from gonio.integrate import cut_disk, disk, grid, quadrature, ring_kernel
functions = [m.function for m in (f.model() for f in families.FAMILIES.values()) if m.function is not None]
for build in (quadrature._compiled_sums, grid._beam, ring_kernel.ring_kernel):
    print(*(build(f).py_func.__qualname__ for f in functions))
print(*(kernel.py_func.__qualname__ for kernel in (disk._disks, cut_disk._cut_disks)))
"""


def test_keys_are_the_same_in_every_process() -> None:
    """Python orders sets of strings anew in each process; a key that hung on it would compile now and then for ever."""
    environment = os.environ | {"PYTHONPATH": str(Path(jit.__file__).parents[1])}
    keys = {
        subprocess.run(
            [sys.executable, "-c", _KEYS], env=environment | {"PYTHONHASHSEED": s}, capture_output=True, text=True,
            check=True,
        ).stdout
        for s in ("1", "2", "3")
    }
    assert len(keys) == 1 and len(keys.pop().split()) > 50


def test_objects_that_cannot_be_fingerprinted_are_refused() -> None:
    settings = {"gain": 2.0}

    def scaled(x):  # type: ignore[no-untyped-def]
        return settings["gain"] * x

    with pytest.raises(TypeError, match="a kernel may not use"):
        jit.kernel(scaled)


_FACTORY = """
import sys
import numpy as np
from gonio import jit

def build(power):
    @jit.model
    def inner(x):
        total = 0.0
        for k in range(x.size):  # long enough to stay a function of its own
            y = x[k]
            for _ in range(power):
                y = np.sin(y) * x[k] + np.cos(y) + np.exp(-y * y) + np.sqrt(y * y + 1.0) + np.log(y * y + 2.0)
            total += y
        return total
    def outer(x):
        return inner(x) + inner(x[1:]) + inner(x[2:]) + inner(x[::2].copy())
    return inner, jit.kernel(outer)

x = np.linspace(0.1, 2.0, 7)
for power in map(int, sys.argv[1:]):
    inner, outer = build(power)
    by_hand = inner.py_func(x) + inner.py_func(x[1:]) + inner.py_func(x[2:]) + inner.py_func(x[::2].copy())
    assert abs(outer(x) - by_hand) < 1e-9, (power, outer(x), by_hand)
print(jit.compiled_count())
"""


def test_closures_of_one_factory_from_different_processes_keep_their_own_code(tmp_path: Path) -> None:
    """numba names symbols by qualified name and a counter: two processes give the same one to different closures."""
    root = Path(jit.__file__).parents[1]
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(root)}
    for powers, compiled in ((["1"], "1"), (["2"], "1"), (["1", "2"], "0"), (["2", "1"], "0")):
        done = subprocess.run(
            [sys.executable, "-c", _FACTORY, *powers], env=environment, capture_output=True, text=True, check=False
        )
        assert (done.returncode, done.stdout.strip()) == (0, compiled), done.stderr[-500:]


def test_arrays_that_are_kept_apart_are_known_to_be(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))

    def double(x, out):  # type: ignore[no-untyped-def]
        for k in range(out.size):
            out[k] = 2.0 * x[k]

    marked = {}
    for apart in (False, True):
        kernel, out = jit.kernel(double, apart=apart), np.zeros(1)
        kernel(np.ones(1), out)
        assert out[0] == 2.0
        lines = kernel.inspect_llvm(kernel.signatures[0]).splitlines()
        marked[apart] = next(line for line in lines if line.startswith("define") and "double" in line).count("noalias")
    # two pointers to data, two to their owners, two to what counts the owners
    assert marked[True] == marked[False] + 6
