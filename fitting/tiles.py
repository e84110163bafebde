"""Pixels by the tile: in this process, in several, or on a Dask cluster; the same numbers everywhere.

A tile is a pure function of the job and of its pixels, so a worker that dies costs the tile it was at, which another one
computes again, and what a sink holds already is skipped. Readings come from a source and go to a sink which the caller
brings; nothing is read or written here. Workers on a cluster need gonio and must reach the source.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from fitting.batch import Estimates, Job
from gonio.errors import DeviceError, ParameterError

Array = NDArray[np.float64]
SIZE = 1024  # pixels in a tile, about: a second or two
_AHEAD = 4  # tiles per worker that are under way: results of more would wait in memory


class Source(Protocol):
    """Readings by the row: anything that can be sent to another process."""

    def read(self, start: int, stop: int) -> tuple[Array, Array | None]:
        """f_r (p, n) of the pixels of rows start to stop, and their uncertainties or None."""


class Sink(Protocol):
    """Where estimates go; used by the calling process only."""

    def has(self, start: int, stop: int) -> bool:
        """Whether the tile of these rows is complete."""

    def write(self, start: int, stop: int, estimates: Estimates) -> None:
        """Keep a tile."""


Tile = tuple[int, int]


def cut(rows: int, row_size: int, size: int = SIZE) -> list[Tile]:
    """Tiles of whole rows, (start, stop) each, of at most `size` pixels or one row."""
    if size < 1:
        raise ParameterError(f"a tile of {size} pixels is none; choose 1 or more")
    step = max(1, size // max(row_size, 1))
    return [(a, min(a + step, rows)) for a in range(0, rows, step)]


def compute(job: Job, source: Source, tile: Tile) -> Estimates:
    """One tile."""
    return job.fit(*source.read(*tile))


def run(
    job: Job,
    source: Source,
    sink: Sink,
    tiles: Sequence[Tile],
    *,
    processes: int = 1,
    client: Any = None,
    progress: Callable[[int, int], None] | None = None,
) -> int:
    """Fit all tiles that the sink does not have.

    Parameters
    ----------
    job : Job
    source : Source
    sink : Sink
    tiles : sequence of (start, stop)
    processes : int
        Of this machine; 1 computes in the calling one.
    client : distributed.Client, optional
        A cluster to compute on instead.
    progress : callable, optional
        ``progress(done, total)`` in tiles.

    Returns
    -------
    int
        Tiles that were computed, not skipped.

    Raises
    ------
    DeviceError
        If workers die at the same tile again and again.
    """
    left = [tile for tile in tiles if not sink.has(*tile)]
    done = len(tiles) - len(left)
    if progress is not None:
        progress(done, len(tiles))
    if client is not None:
        results = _on_cluster(job, source, left, client)
    elif processes > 1 and len(left) > 1:
        results = _in_processes(job, source, left, min(processes, len(left)))
    else:
        results = ((tile, compute(job, source, tile)) for tile in left)
    for tile, estimates in results:
        sink.write(*tile, estimates)
        done += 1
        if progress is not None:
            progress(done, len(tiles))
    return len(left)


def _in_processes(job: Job, source: Source, tiles: Sequence[Tile], processes: int) -> Iterator[tuple[Tile, Estimates]]:
    import multiprocessing
    from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait

    job.engine()  # compiles what is missing, once
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, context, _begin, (job, source)) as pool:
        waiting = iter(tiles)
        under_way: dict[Any, Tile] = {}
        while True:
            for tile in islice(waiting, _AHEAD * processes - len(under_way)):
                under_way[pool.submit(_continue, tile)] = tile
            if not under_way:
                return
            for future in wait(under_way, return_when=FIRST_COMPLETED).done:
                yield under_way.pop(future), future.result()


_task: tuple[Job, Source] | None = None


def _begin(job: Job, source: Source) -> None:
    global _task
    _task = (job, source)


def _continue(tile: Tile) -> Estimates:
    assert _task is not None
    return compute(*_task, tile)


def _on_cluster(job: Job, source: Source, tiles: Sequence[Tile], client: Any) -> Iterator[tuple[Tile, Estimates]]:
    from distributed import KilledWorker, as_completed

    sent = client.scatter((job, source), broadcast=True, hash=False)
    waiting = iter(tiles)
    workers = max(1, len(client.scheduler_info(n_workers=-1)["workers"]))
    under_way: dict[Any, Tile] = {}
    finished = as_completed([], loop=client.loop)

    def submit(count: int) -> None:
        for tile in islice(waiting, count):
            future = client.submit(_compute_sent, sent, tile, pure=False, retries=2)
            under_way[future] = tile
            finished.add(future)

    submit(_AHEAD * workers)
    for future in finished:
        tile = under_way.pop(future)
        try:
            estimates = future.result()
        except KilledWorker as error:
            raise DeviceError(
                f"workers died at the tile of rows {tile[0]} to {tile[1]} again and again, mostly for want of memory; "
                "what is done is kept: take smaller tiles or larger workers and start again"
            ) from error
        submit(1)
        yield tile, estimates


def _compute_sent(sent: tuple[Job, Source], tile: Tile) -> Estimates:
    return compute(*sent, tile)
