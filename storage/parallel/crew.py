"""One task a block, on threads of this process, on processes beside it, or on a cluster somewhere else.

A block is a whole shard (or reads whole shards): no two tasks ever touch one file, so nothing has to be locked and the
bytes do not depend on who made them. What processes and clusters need of their workers is in ``cluster_work``.
"""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pipeline.errors import SettingsError, WorkerError
from storage.archive.staging import PART_SUFFIX
from storage.parallel import cluster_work

_ADDRESS = re.compile(r"(tcp|tls)://[^\s/:]+:\d+|(tcp|tls)://\[[0-9a-fA-F:]+\]:\d+")

Item = TypeVar("Item")
Result = TypeVar("Result")
Report = Callable[[float], None]  # share done, 0..1, from the thread that asked


@dataclass(frozen=True)
class Crew:
    """Who makes blocks: ``threads``, ``processes``, or the workers of a dask scheduler at ``tcp://host:port``."""

    scheduler: str = "threads"
    workers: int | None = None  # at a time; None is one a core. A scheduler elsewhere has workers of its own

    def __post_init__(self) -> None:
        if self.scheduler not in ("threads", "processes") and not _ADDRESS.fullmatch(self.scheduler):
            raise SettingsError(
                f"scheduler must be threads, processes, or the address of a dask scheduler such as "
                f"tcp://192.168.1.5:8786; got {self.scheduler!r}"
            )
        if self.workers is not None and self.workers < 1:
            raise SettingsError(f"workers must be at least 1, got {self.workers}")

    @property
    def elsewhere(self) -> bool:
        """Whether the workers belong to a scheduler that somebody else started."""
        return "://" in self.scheduler

    @property
    def shares_memory(self) -> bool:
        """Whether work may hold open files and arrays; otherwise it holds paths and is pickled."""
        return self.scheduler == "threads"

    @property
    def count(self) -> int:
        """Blocks at a time on this machine."""
        return count_cores() if self.workers is None else self.workers

    @contextmanager
    def open(self) -> Iterator[Crew]:
        """Keep this crew's workers from one `run_blocks` to the next until the block ends.

        Costs nothing by itself: they are started by the first `run_blocks` that needs them. May be nested.
        """
        with _guard:
            held = _open.setdefault(self, _Open())
            held.users += 1
        try:
            yield self
        finally:
            with _guard:
                held.users -= 1
                last = held.users == 0
                if last:
                    del _open[self]
            if last and held.team is not None:
                held.team.close()

    def team(self) -> cluster_work.ProcessTeam:
        """The workers of an open crew, started now where nobody needed them before."""
        with _guard:
            held = _open[self]
            if held.team is None:
                at = self.scheduler
                held.team = cluster_work.connect(at) if self.elsewhere else cluster_work.start(self.count)
            return held.team

    def dismiss(self) -> None:
        """Let workers go that cannot be relied on any more: whoever needs the open crew next gets others."""
        with _guard:
            held = _open[self]
            team, held.team = held.team, None
        if team is not None:
            team.close()


THREADS = Crew()


@dataclass
class _Open:
    users: int = 0
    team: cluster_work.ProcessTeam | None = None


_guard = threading.RLock()
_open: dict[Crew, _Open] = {}


def count_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


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
    """Call ``make`` with every item, each in a task of its own.

    They are begun in order, none more than a few before the oldest unfinished one: neighbours share what they read.
    The first error is raised once no block is being made any more: none writes after that.

    On threads ``make`` is anything that may be called from several at once. Otherwise it and the items are pickled:
    they hold absolute paths, never arrays or open files, and writing a block twice must give the same bytes.
    ``each`` is called with an item and its result, one at a time, in the order in which they end, ``report`` with the
    share done after each. Workers elsewhere are asked whether they see the same in ``paths``, the folders that the work
    reads or writes; from those in a staged store (``*.part``) goes what a killed worker left of a file that another
    wrote again. Gives the results in the order of the items; none without ``keep``. Raises SettingsError: no scheduler
    answers, or its workers see other files or run other versions. WorkerError: workers died, more often than a block is
    tried again. TypeError: work or items that cannot be sent to another process, or hold arrays.
    """
    results: list[Any] = [None] * len(items) if keep else []
    count = 0

    def ended(number: int, result: Any) -> None:
        nonlocal count
        if each is not None:
            each(items[number], result)
        if keep:
            results[number] = result
        count += 1
        report(count / len(items))

    if not items:
        return []
    if crew.shares_memory:
        _run_on_threads(make, items, min(crew.count, len(items)), ended)
        return results
    cluster_work.check_sendable("work", make)
    with crew.open():
        team = crew.team()
        if crew.elsewhere:
            team.check(paths)
        try:
            team.run(make, items, ended)
        except WorkerError:
            crew.dismiss()
            raise
    for folder in paths:
        if any(part.endswith(PART_SUFFIX) for part in folder.parts):
            for file in folder.rglob("*.partial"):  # zarr gives a shard its name when it is whole
                file.unlink(missing_ok=True)
    return results


def _run_on_threads(
    make: Callable[[Any], Any], items: Sequence[Any], workers: int, ended: Callable[[int, Any], None]
) -> None:
    if workers == 1:
        for number, item in enumerate(items):
            ended(number, make(item))
        return
    pool = ThreadPoolExecutor(workers)
    try:
        blocks = cluster_work.ahead_of_the_oldest(
            lambda number: pool.submit(make, items[number]),
            lambda futures: wait(futures, return_when=FIRST_COMPLETED).done,
            {},
            len(items),
            workers,
        )
        for number, future in blocks:
            ended(number, future.result())
    finally:
        pool.shutdown(cancel_futures=True)
