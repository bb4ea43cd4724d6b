"""One task a block, on threads of this process, on processes beside it, or on a cluster somewhere else.

A block is a whole shard (or reads whole shards): no two tasks ever touch one file, so nothing has to be locked and the
bytes do not depend on who made them. What processes and clusters need of their workers is in ``cluster_work``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import dask.threaded
from dask.callbacks import Callback

from pipeline.errors import WorkerError
from storage.archive.staging import PART_SUFFIX
from storage.parallel.crew import THREADS, Crew, Team, check_sendable

Item = TypeVar("Item")
Result = TypeVar("Result")
Report = Callable[[float], None]  # share done, 0..1, from the thread that asked


def run_blocks(
    make: Callable[[Item], Result],
    items: Sequence[Item],
    crew: Crew = THREADS,
    *,
    keep: bool = True,
    report: Report = lambda done: None,
    each: Callable[[Item, Result], None] | None = None,
    paths: Sequence[Path] = (),
) -> list[Result]:
    """Call ``make`` with every item, each in a dask task of its own.

    They are begun in order, none more than a few before the oldest unfinished one: neighbours share what they read.
    The first error is raised once no block is being made any more: none writes after that.

    Parameters
    ----------
    make
        On threads anything that may be called from several at once. Otherwise it and the items are pickled: they hold
        absolute paths, never arrays or open files, and writing a block twice must give the same bytes.
    keep
        Whether to return the results; False drops each once ``each`` has seen it.
    report
        Called with the share done after each block.
    each
        Called with an item and its result, one at a time, in the order in which they end.
    paths
        Folders that the work reads or writes: workers elsewhere are asked whether they see the same in them. From
        those in a staged store (``*.part``) goes what a killed worker left of a file that another wrote again.

    Returns
    -------
    Results in the order of the items; empty without ``keep``.

    Raises
    ------
    SettingsError : no scheduler answers, or its workers see other files or run other versions.
    WorkerError : workers died, more often than a block is tried again.
    TypeError : work or items that cannot be sent to another process, or hold arrays.
    """
    if not items:
        return []
    ended = _Ended(items, keep, report, each)
    if crew.shares_memory:
        _run_on_threads(make, items, min(crew.count, len(items)), ended)
        return ended.results
    check_sendable("work", make)
    with crew.open():
        team = crew.team(_start)
        if crew.elsewhere:
            team.check(paths)
        try:
            team.run(make, items, ended)
        except WorkerError:
            crew.dismiss()
            raise
    for folder in paths:
        if any(part.endswith(PART_SUFFIX) for part in folder.parts):
            _remove_unfinished(folder)
    return ended.results


class _Ended:
    """Takes what blocks gave as they end: called by one thread at a time."""

    def __init__(
        self, items: Sequence[Any], keep: bool, report: Report, each: Callable[[Any, Any], None] | None
    ) -> None:
        self._items, self._report, self._each = items, report, each
        self._kept: list[Any] | None = [None] * len(items) if keep else None
        self._count = 0

    def __call__(self, number: int, result: Any) -> None:
        if self._each is not None:
            self._each(self._items[number], result)
        if self._kept is not None:
            self._kept[number] = result
        self._count += 1
        self._report(self._count / len(self._items))

    @property
    def results(self) -> list[Any]:
        return self._kept or []


def _run_on_threads(
    make: Callable[[Any], Any], items: Sequence[Any], workers: int, ended: Callable[[int, Any], None]
) -> None:
    """Each once all that lie ``workers`` before it are done: tiles stay near each other."""
    if workers == 1:
        for number, item in enumerate(items):
            ended(number, make(item))
        return
    made: dict[int, Any] = {}  # between the thread that made it and this one, which takes it out at once

    def block(number: int, *before: int) -> int:
        made[number] = make(items[number])
        return number

    graph = block_graph(block, len(items), workers)
    told = Callback(posttask=lambda key, number, *about: ended(number, made.pop(number)))  # type: ignore[no-untyped-call]
    pool = ThreadPoolExecutor(workers)
    try:
        with told:
            dask.threaded.get(graph, list(graph), pool=pool)
    finally:
        pool.shutdown(cancel_futures=True)  # dask would leave the others at work after an error


def block_graph(block: Callable[..., int], count: int, workers: int) -> dict[str, tuple[Any, ...]]:
    """The dask graph of ``count`` blocks: one task each, that waits for all that lie ``workers`` before it."""
    return {
        f"block {number}": (block, number, *(f"block {at}" for at in _awaited(number, workers)))
        for number in range(count)
    }


def _awaited(number: int, workers: int) -> range:
    """Blocks to wait for: as many as there are workers, for the last of them has waited for all before."""
    return range(max(number - 2 * workers + 1, 0), number - workers + 1)


def _remove_unfinished(folder: Path) -> None:
    """Remove files beside those that they were to become: zarr gives a shard its name when it is whole."""
    for file in folder.rglob("*.partial"):
        file.unlink(missing_ok=True)


def _start(crew: Crew) -> Team:
    from storage.parallel import cluster_work  # loads dask.distributed

    return cluster_work.connect(crew) if crew.elsewhere else cluster_work.start(crew.count)
