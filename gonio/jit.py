"""Kernels compiled from model functions, cached on disk and never stale.

Numba's own cache looks at the file of the kernel only: after an edit of a model that the kernel calls it loads the old
machine code. Here the key is a fingerprint of the loaded code of the kernel and of everything it calls, with its
constants, so an edit anywhere recompiles and an undone edit hits again. Each kernel has an index file of its own, and
symbols are named by content, so kernels of different processes cannot be taken for each other. A damaged or read-only
cache means compiling again.

A kernel that does much besides a model's values is compiled once for all models and calls by its address (`address`,
`calling`) what sums them.

This leans on private parts of numba (`FunctionCache`, `CFunc`, the flag of arrays that do not overlap);
tests/unit/test_jit.py shows that a second process hits, that edits miss and that the flag arrives.
"""

from __future__ import annotations

import hashlib
import os
import sys
import time
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba.core import caching, cgutils, sigutils
from numba.core.ccallback import CFunc
from numba.core.dispatcher import Dispatcher
from numba.core.types.containers import StarArgTuple
from numba.extending import _Intrinsic, intrinsic

# reassoc lets sums vectorise; no nnan and no ninf, so NaN and infinity stay what they are
FAST = {"reassoc", "nsz", "contract", "arcp"}
_BARE = {"no_cfunc_wrapper": True}  # nothing is passed as a function pointer; an eighth of the time to compile
_PURE = ("math", "numpy", "numba", "llvmlite", "builtins")
_FORMAT = 3  # of what is kept; a new number discards the old files
_compiled = 0  # kernels compiled, not loaded, by this process
_seconds = 0.0  # spent on loading and compiling them
_kept: list[CFunc] = []  # whose addresses are in use


def compiled_count() -> int:
    """How many kernels this process had to compile because the cache did not hold them."""
    return _compiled


def getting_ready_s() -> float:
    """Seconds that this process has spent on loading kernels from the cache and compiling them."""
    return _seconds


def model(function: Callable[..., Any]) -> Any:
    """Compile a scalar model function: IEEE order kept inside; inlined into the loops that call it, which so vectorise."""
    return part(function, forceinline=True)


def part(function: Callable[..., Any], **options: Any) -> Any:
    """Compile a function that kernels call, inlined where the compiler finds it worthwhile; options of ``numba.njit``."""
    key = hashlib.sha256(repr(_fingerprint(function, set())).encode()).hexdigest()
    return numba.njit(**{"error_model": "numpy", "fastmath": False} | _BARE | options)(_named(function, key))


def kernel(function: Callable[..., Any], *, apart: bool = False, **options: Any) -> Any:
    """Compile a kernel and keep its machine code on disk.

    Parameters
    ----------
    function : callable
        May close over functions compiled by `model` and `part`, numbers, strings, tuples and arrays.
    apart : bool, optional
        The promise that no array which is written shares memory with another argument. Loops that look numbers up at
        computed places, as in tables, vectorise by it alone; a broken promise gives wrong numbers.
    **options
        Passed to ``numba.njit``.

    Raises
    ------
    TypeError
        If the function uses an object whose content cannot be fingerprinted.
    """
    options = {"error_model": "numpy", "fastmath": FAST, "nogil": True} | options
    function, key = _keyed(function, options, apart)
    compiled = numba.njit(**_BARE, **options)(function)
    if apart:
        compiled._compiler._customize_flags = _apart
    compiled._cache = _Cache(function, key, cache_folder())
    return compiled


def _keyed(function: Callable[..., Any], options: dict[str, Any], *more: Any) -> tuple[Callable[..., Any], str]:
    """The function under a name that tells what its machine code depends on, and the key of the cache."""
    text = repr([_FORMAT, numba.__version__, _shown(options), *more, _fingerprint(function, set())])
    key = hashlib.sha256(text.encode()).hexdigest()
    return _named(function, key), key


def _apart(flags: Any) -> Any:
    flags.noalias = True
    return flags


def address(function: Callable[..., Any], signature: str, *, apart: bool = False) -> int:
    """Compile a function to be called by its address, for as long as the process lives; its code is kept like a kernel's.

    Parameters
    ----------
    function : callable
        As for `kernel`. It must not raise.
    signature : str
        As numba writes it: ``"float64(float64[:,::1], int64)"``.
    apart : bool, optional
        As for `kernel`.
    """
    options = {"error_model": "numpy", "fastmath": FAST}
    function, key = _keyed(function, options, signature, apart)
    compiled: Any = CFunc(function, sigutils.normalize_signature(signature), {}, options)
    compiled._cache = _Cache(function, key, cache_folder())
    if apart:
        customize = compiled._compiler._customize_flags
        compiled._compiler._customize_flags = lambda flags: _apart(customize(flags))
    compiled.compile()
    _kept.append(compiled)
    return int(compiled.address)


def calling(signature: str) -> Any:
    """For kernels: ``call(address, *arguments)`` calls what `address` compiled with this signature."""
    arguments, result = sigutils.normalize_signature(signature)

    @intrinsic
    def call(typing, at, *given):  # type: ignore[no-untyped-def]
        if len(given) != len(arguments) or not all(map(typing.can_convert, given, arguments)):
            return None

        def lower(context, builder, _, values):  # type: ignore[no-untyped-def]
            kind = ir.FunctionType(context.get_value_type(result), [context.get_value_type(a) for a in arguments])
            return builder.call(builder.inttoptr(values[0], kind.as_pointer()), cgutils.unpack_tuple(builder, values[1]))

        return result(numba.int64, StarArgTuple(arguments)), lower

    return call


def cache_folder() -> Path:
    """Where kernels are kept: ``$NUMBA_CACHE_DIR``, else ``$XDG_CACHE_HOME``, else ``~/.cache``, then ``gonio``."""
    home = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME")
    return (Path(home) if home else Path.home() / ".cache") / "gonio"


def _named(function: Callable[..., Any], key: str) -> Callable[..., Any]:
    """A copy of a function whose machine code will have a symbol that tells its content.

    numba names a symbol after the function's qualified name and a number counted in the process that compiled it. Closures
    of one factory, compiled by different processes and loaded from the cache into one, may so have the same symbol, and
    the linker would take the code of whichever came first for all of them.
    """
    assert isinstance(function, types.FunctionType)
    copy = types.FunctionType(
        function.__code__, function.__globals__, function.__name__, function.__defaults__, function.__closure__
    )
    copy.__qualname__ = f"{function.__qualname__}_{key[:24]}"
    copy.__module__ = function.__module__
    copy.__kwdefaults__ = function.__kwdefaults__
    return copy


def _shown(options: dict[str, Any]) -> list[tuple[str, str]]:
    """Options of numba as a text; the order of a set is another in each process."""
    return sorted((name, str(sorted(v) if isinstance(v, set | frozenset) else v)) for name, v in options.items())


def _fingerprint(value: Any, seen: set[Any]) -> Any:
    """What machine code made from `value` depends on: loaded code, constants and, recursively, the functions called."""
    if isinstance(value, Dispatcher):
        return ["jit", _shown(value.targetoptions), _fingerprint(value.py_func, seen)]
    if isinstance(value, _Intrinsic):
        return ["intrinsic", _fingerprint(value._defn, seen)]
    if isinstance(value, types.CodeType):
        constants = [_fingerprint(constant, seen) for constant in value.co_consts]
        return [value.co_code, value.co_names, value.co_varnames, value.co_freevars, constants]
    if isinstance(value, types.FunctionType):
        if value in seen:
            return "seen"
        seen.add(value)
        cells = (cell.cell_contents for cell in value.__closure__ or ())
        used = dict(zip(value.__code__.co_freevars, cells, strict=True))
        used |= {name: value.__globals__[name] for name in value.__code__.co_names if name in value.__globals__}
        return [
            value.__defaults__,
            _fingerprint(value.__code__, seen),
            [(n, _fingerprint(v, seen)) for n, v in sorted(used.items())],
        ]
    if isinstance(value, np.ndarray):
        return [value.dtype.str, value.shape, value.tobytes()]
    if isinstance(value, tuple):
        return ["tuple", [_fingerprint(item, seen) for item in value]]
    if isinstance(value, frozenset):  # whose order is another in each process
        return ["frozenset", sorted(repr(_fingerprint(item, seen)) for item in value)]
    if isinstance(value, bool | int | float | complex | str | bytes | types.NoneType):
        return value
    if str(getattr(value, "__module__", getattr(value, "__name__", ""))).split(".")[0] in _PURE:
        return repr(getattr(value, "__name__", value))
    raise TypeError(f"a kernel may not use {value!r}: import the function or the number by name")


class _Cache(caching.FunctionCache):  # type: ignore[misc]
    def __init__(self, function: Callable[..., Any], key: str, folder: Path) -> None:
        self._name, self._py_func, self._key = function.__qualname__, function, key
        self._cache_path = str(folder)
        self._impl = object.__new__(caching.CompileResultCacheImpl)
        ensure = types.SimpleNamespace(ensure_cache_path=lambda: folder.mkdir(parents=True, exist_ok=True))
        self._impl._locator = ensure
        index = f"{function.__name__}-{key[:24]}.{sys.implementation.cache_tag}"
        self._cache_file = caching.IndexDataCacheFile(self._cache_path, index, key)
        self.enable()

    def _index_key(self, sig: Any, codegen: Any) -> Any:
        return sig, codegen.magic_tuple(), self._key

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        global _compiled, _seconds
        self._since = time.perf_counter()
        try:
            loaded = super().load_overload(sig, target_context)
        except Exception:  # noqa: BLE001  whatever a damaged file raises: compile again
            loaded = None
        if loaded is None:
            _compiled += 1
        else:
            _seconds += time.perf_counter() - self._since
        return loaded

    def save_overload(self, sig: Any, data: Any) -> None:
        global _seconds
        _seconds += time.perf_counter() - self._since
        for _ in range(2):
            try:
                super().save_overload(sig, data)
                return
            except Exception:  # noqa: BLE001  damaged index: start it again
                try:
                    self.flush()
                except OSError:  # read-only or full disk: go on uncached
                    return
