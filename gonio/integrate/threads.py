"""Work on fixed tiles, in one thread or several.

How the work is cut never depends on the number of threads and every tile writes only what is its own, so results are the
same bit by bit for any number of threads. Kernels release the interpreter's lock.
"""

from __future__ import annotations

import functools
import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")
_local = threading.local()


def available() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@functools.cache
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="gonio")


def run(work: Callable[[T], R], tiles: Iterable[T], threads: int) -> list[R]:
    """`work` on every tile; results in the order of the tiles. Work on a tile must not call `run` with threads > 1."""
    tiles = list(tiles)
    if threads <= 1 or len(tiles) <= 1:
        return [work(tile) for tile in tiles]
    return list(_pool(os.getpid(), threads).map(work, tiles))


def scratch(name: str, make: Callable[[], T]) -> T:
    """An object of this thread's own, made at the first call: node arrays that live on from tile to tile."""
    kept = _local.__dict__
    if name not in kept:
        kept[name] = make()
    return kept[name]  # type: ignore[no-any-return]
