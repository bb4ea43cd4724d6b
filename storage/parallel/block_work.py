"""One task a block, on threads of this process, on processes beside it, or on a cluster somewhere else.

A block is a whole shard (or reads whole shards): no two tasks ever touch one file, so nothing has to be locked and the
bytes do not depend on who made them. What processes and clusters need of their workers is in ``cluster_work``.
"""

from __future__ import annotations

import os
import pickle
import re
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import dask.threaded
from dask.callbacks import Callback

from pipeline.errors import SettingsError, WorkerError
from storage.archive.staging import PART_SUFFIX

if TYPE_CHECKING:
    from storage.parallel.cluster_work import Team

MOST_SENT = 2**18  # bytes that work or one of its items may take on its way to another process: paths, not arrays
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
            held = _kept.setdefault(self, _Kept())
            held.users += 1
        try:
            yield self
        finally:
            with _guard:
                held.users -= 1
                team = held.team if held.users == 0 else None
                if held.users == 0:
                    del _kept[self]
            if team is not None:
                team.close()


THREADS = Crew()


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
        try:
            _team_of(crew, paths).run(make, items, ended)
        except WorkerError:
            _dismiss(crew)
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


def check_sendable(what: str, value: object) -> None:
    """Refuse what cannot travel to another process.

    Raises
    ------
    TypeError : it cannot be pickled, or is so large that it must hold arrays.
    """
    try:
        size = len(pickle.dumps(value))
    except Exception as error:
        raise TypeError(
            f"the {what} of blocks cannot be sent to other processes: expected a function of a module, or a dataclass "
            f"of paths and settings; got {type(value).__name__} ({error})"
        ) from None
    if size > MOST_SENT:
        raise TypeError(
            f"the {what} of blocks takes {size} bytes on its way to another process, at most {MOST_SENT} are allowed; "
            f"give {type(value).__name__} paths to open instead of arrays"
        )


def _remove_unfinished(folder: Path) -> None:
    """Remove files beside those that they were to become: zarr gives a shard its name when it is whole."""
    for file in folder.rglob("*.partial"):
        file.unlink(missing_ok=True)


def count_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass
class _Kept:
    """A crew that is open, and its workers once they were needed."""

    users: int = 0
    team: Team | None = None


_guard = threading.RLock()
_kept: dict[Crew, _Kept] = {}


def _team_of(crew: Crew, paths: Sequence[Path]) -> Team:
    """The workers of an open crew, started now where nobody needed them before."""
    from storage.parallel import cluster_work

    with _guard:
        held = _kept[crew]
        if held.team is None:
            held.team = cluster_work.connect(crew) if crew.elsewhere else cluster_work.start(crew.count)
        team = held.team
    if crew.elsewhere:
        team.check(paths)
    return team


def _dismiss(crew: Crew) -> None:
    """Let workers go that cannot be relied on any more: whoever needs the open crew next gets others."""
    with _guard:
        held = _kept[crew]
        team, held.team = held.team, None
    if team is not None:
        team.close()
