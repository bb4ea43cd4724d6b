"""Map a function over blocks, one task for each, on threads, on processes, or on the workers of a dask scheduler.

Threads are those of `concurrent.futures`; processes are a dask cluster of this machine. A block reads published stores
and returns arrays; only the survey's own process writes. The results are the same bytes everywhere if code, files and
the number of arithmetic threads are the same.
"""

from __future__ import annotations

import asyncio
import hashlib
import logging
import os
import pickle
import platform
import re
import signal
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from multiprocessing import resource_tracker
from operator import call
from pathlib import Path
from typing import Any, TypeVar

from pipeline.errors import PipelineError, SettingsError, WorkerError
from pipeline.lazy import dask, dask_distributed
from storage.archive.keys import StageRef

ANSWER_S = 5.0  # time limit of a scheduler's answer
RESTART_S = 60.0  # time limit until a process of this machine replaces one that died
AHEAD = 2  # blocks sent to a worker: one running, one waiting
ROOMS = ("pipeline", "models", "storage", "flows")  # blocks of regions are made in flows
LIBRARIES = ("numpy", "zarr", "numcodecs", "torch", "distributed")
THREADS_OF = "OMP_NUM_THREADS"
# one thread of arithmetic a worker, and freed memory kept: large arrays cost more page faults than arithmetic
_ENVIRONMENT = {
    **dict.fromkeys((THREADS_OF, "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"),
    "MALLOC_MMAP_THRESHOLD_": f"{2**30}",
    "MALLOC_TRIM_THRESHOLD_": f"{2**31 - 1}",
    "MALLOC_TOP_PAD_": f"{2**26}",
}
_ADDRESS = re.compile(r"(tcp|tls)://[^\s/:]+:\d+|(tcp|tls)://\[[0-9a-fA-F:]+\]:\d+")
RESERVED_BYTES = 512 * 2**20  # a process before its first block: interpreter, torch, zarr

Item = TypeVar("Item")
Result = TypeVar("Result")
Report = Callable[[float], None]  # share done, 0..1, from the thread that asked


def mib(size: int) -> str:
    """Return bytes in whole MiB, rounded up, as in the setting ``memory``."""
    return f"{-(-size // 2**20)} MiB"


def memory_refusal(least: int, memory: int, why: str) -> SettingsError:
    """Return the error for work that needs more than the setting ``memory`` [bytes], with the least that it needs."""
    return SettingsError(
        f"projected memory {mib(least)} exceeds --memory {mib(memory)}: {why}; give at least --memory {mib(least)}"
    )


@dataclass(frozen=True)
class WorkerPool:
    """Workers for blocks: ``threads``, ``processes``, or those of a dask scheduler at ``tcp://host:port``."""

    scheduler: str = "threads"
    workers: int | None = None  # None: one for each core; ignored with a dask scheduler

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
        """Return whether the workers belong to a scheduler that was started elsewhere."""
        return "://" in self.scheduler

    @property
    def shares_memory(self) -> bool:
        """Return whether blocks run in this process; otherwise their work and their results are pickled."""
        return self.scheduler == "threads"

    @property
    def count(self) -> int:
        """Number of blocks at a time on this machine."""
        if self.workers is not None:
            return self.workers
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

    @contextmanager
    def open(self) -> Iterator[WorkerPool]:
        """Keep the workers from one `run_blocks` to the next while the block runs; may be nested.

        The first `run_blocks` starts them.
        """
        with _guard:
            _users[self] += 1
        try:
            yield self
        finally:
            with _guard:
                _users[self] -= 1
                if not _users[self]:
                    _dismiss(self)


THREADS = WorkerPool()

_guard = threading.RLock()
_users: Counter[WorkerPool] = Counter()  # blocks that keep a pool open
_teams: dict[WorkerPool, Cluster] = {}  # the workers of open pools, once they are started


def _dismiss(pool: WorkerPool) -> None:
    """Abandon the workers of a pool; the next use starts others."""
    if (team := _teams.pop(pool, None)) is not None:
        team.close()


def run_blocks(
    make: Callable[[Item], Result],
    items: Sequence[Item],
    pool: WorkerPool = THREADS,
    *,
    take: Callable[[Item, Result], Any] | None = None,
    report: Report = lambda done: None,
    inputs: Sequence[StageRef] = (),
) -> list[Any]:
    """Call ``make`` with every item, each in a task of its own, and ``take`` with each item and its result.

    Returns what ``take`` returns, or without it the results, in the order of the items. Blocks start in order, at most
    a few ahead of the oldest unfinished one, since neighbours share input. The first error is raised when no block is
    running any more. ``report`` is called with the fraction done.

    On threads ``make`` and ``take`` must be safe to call from several at once. Otherwise ``make``, items and results
    are pickled, and ``take`` is called in this process. Workers of a dask scheduler read the stores ``inputs`` by the
    same paths. Raises SettingsError: no scheduler answers, or its workers lack the stores or run
    other versions; WorkerError: workers died repeatedly.
    """
    results: dict[int, Any] = {}

    def ended(number: int, result: Any) -> None:
        results[number] = result
        report(len(results) / len(items))

    def whole(item: Item) -> Any:
        return make(item) if take is None else take(item, make(item))

    workers = min(pool.count, len(items))
    if pool.shares_memory and workers < 2:
        for number, item in enumerate(items):
            ended(number, whole(item))
    elif pool.shares_memory:
        with ThreadPoolExecutor(workers) as team:
            _send(lambda item: team.submit(whole, item), items, workers, ended)
    elif items:
        with pool.open():
            _send_away(
                pool, make, items, inputs, lambda at, made: ended(at, made if take is None else take(items[at], made))
            )
    return [results[number] for number in range(len(items))]


def _send_away(
    pool: WorkerPool,
    make: Callable[[Any], Any],
    items: Sequence[Any],
    inputs: Sequence[StageRef],
    ended: Callable[[int, Any], None],
) -> None:
    """Run blocks in processes; dask runs blocks whose worker died again on others."""
    with _guard:
        team = _teams.get(pool) or Cluster(pool)
        _teams[pool] = team
    lost = (WorkerError, CancelledError, dask_distributed.KilledWorker)
    try:
        count = team.check(inputs)
        with dask.config.set({"distributed.admin.large-graph-warning-threshold": "1 GiB"}):
            shared = team.client.submit(_itself, make, pure=False)  # travels once to each worker
        _send(partial(team.submit, call, shared), items, AHEAD * count, ended, alive=team.count, lost=lost)
    except lost as error:
        _dismiss(pool)
        if isinstance(error, WorkerError):
            raise
        if isinstance(error, CancelledError):
            advice = "the scheduler is gone. Start it again and repeat the command: finished stages are kept"
        else:
            advice = (
                "workers died several times in the same block, perhaps out of memory. Use fewer --workers, or "
                "--scheduler threads"
            )
        raise WorkerError(f"{team.name}: {advice}") from None


def _itself(make: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return make


def _send(
    submit: Callable[[Any], Future[Any]],
    items: Sequence[Any],
    window: int,
    ended: Callable[[int, Any], None],
    alive: Callable[[], object] = lambda: None,
    lost: tuple[type[Exception], ...] = (),
) -> None:
    """Send blocks in order, fewer than ``window`` ahead of the oldest unfinished one; ``ended`` takes each result.

    An error is raised when the running blocks have ended. One of the types ``lost`` is raised at once: blocks of lost
    workers may never end. ``alive``, called while none ends, raises without workers.
    """
    running: dict[Future[Any], int] = {}
    sent = 0
    try:
        while running or sent < len(items):
            while sent < len(items) and sent - min(running.values(), default=sent) < window:
                running[submit(items[sent])] = sent
                sent += 1
            done = wait(running, timeout=ANSWER_S, return_when=FIRST_COMPLETED).done
            if not done:
                alive()
            for future in sorted(done, key=running.__getitem__):
                ended(running[future], future.result())
                del running[future]
    except lost:
        raise
    except Exception:
        wait(running)
        raise


class Cluster:
    """The workers of a dask scheduler, on this machine or elsewhere."""

    def __init__(self, pool: WorkerPool) -> None:
        """Connect to the scheduler, or start processes (SettingsError: none answers, or none start)."""
        self.name = f"--scheduler {pool.scheduler}"
        for name in ("distributed", "distributed.client"):  # an error reports lost connections once
            logging.getLogger(name).setLevel(logging.CRITICAL)
        try:
            self._own: Any = None if pool.elsewhere else start(pool.count)
            place = pool.scheduler if pool.elsewhere else self._own
            self.client: Any = dask_distributed.Client(place, timeout=ANSWER_S, set_as_default=False)
        except (OSError, TimeoutError, ValueError, RuntimeError) as error:
            expected = "expected a dask scheduler there, none answered" if pool.elsewhere else "no processes start"
            raise SettingsError(
                f"{self.name}: {expected} ({type(error).__name__}); start `dask scheduler`, or use --scheduler threads"
            ) from None

    def submit(self, make: Callable[..., Any], *given: Any) -> Future[Any]:
        """Send one block.

        dask's own executor fails where a block is lost with its worker between its end and its delivery.
        """
        sent = self.client.submit(make, *given, pure=False)
        return asyncio.run_coroutine_threadsafe(
            self.client.gather(sent, asynchronous=True), self.client.loop.asyncio_loop
        )

    def close(self) -> None:
        """Disconnect from the workers; those elsewhere keep running."""
        self.client.close()
        if self._own is not None:
            self._own.close()

    def count(self) -> int:
        """Return the number of blocks at a time. Raises WorkerError: there are no workers."""
        try:
            self.client.wait_for_workers(1, timeout=ANSWER_S if self._own is None else RESTART_S)
        except TimeoutError:
            address = self.client.scheduler.address
            advice = f"start `dask worker {address}`" if self._own is None else "use --scheduler threads"
            raise WorkerError(f"{self.name} has no workers: expected at least one; {advice}") from None
        return max(1, sum(int(threads) for threads in self.client.nthreads().values()))

    def check(self, inputs: Sequence[StageRef]) -> int:
        """Compare versions, threads and stores of every worker with this process; return `count`.

        Raises SettingsError: a worker differs, or cannot read the archive; WorkerError: there is none, or one was lost
        meanwhile.
        """
        expected = {**about_here(inputs), THREADS_OF: "1"}
        count = self.count()
        try:
            theirs = self.client.run(_about_there, pickle.dumps(inputs))
        except PipelineError as error:
            raise SettingsError(f"{self.name}: a worker cannot read the archive. {error}") from None
        except OSError as error:
            raise WorkerError(
                f"{self.name}: a worker was lost ({error}). Repeat the command: finished stages are kept"
            ) from None
        except Exception as error:  # of any type: errors of unpickling come back as text
            raise SettingsError(
                f"{self.name}: a worker cannot import SpectralZoom ({error}); install the same version there, or use "
                "--scheduler processes"
            ) from None
        for worker, facts in theirs.items():
            for what, value in expected.items():
                if facts.get(what) != value:
                    raise SettingsError(
                        f"{self.name}: worker {worker} has {what} {facts.get(what)}, expected {value} as here; install "
                        f"the same there, mount the archive under the same path, and set "
                        f"{THREADS_OF}=1"
                    )
        return count


def start(workers: int) -> Any:
    """Start a dask cluster of processes of this machine, with one arithmetic thread each, deaf to Ctrl-C."""
    make_cluster = dask_distributed.LocalCluster  # imported before its settings are changed for a while
    resource_tracker.ensure_running()  # started later it would unblock signals
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        with dask.config.set({"distributed.nanny.pre-spawn-environ": _ENVIRONMENT}):
            return make_cluster(
                n_workers=workers,
                threads_per_worker=1,
                memory_limit=None,
                dashboard_address="127.0.0.1:0",
                security=True,  # other users of this machine may not send work
                silence_logs=logging.CRITICAL,
            )
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def about_here(inputs: Sequence[StageRef]) -> dict[str, str]:
    """Return versions, threads and the content of stores as this process sees them, by name."""
    threads = {THREADS_OF: os.environ.get(THREADS_OF, "not set")}
    return versions_here() | threads | {one.uri: _seen(one.path) for one in inputs}


async def _about_there(inputs: bytes) -> dict[str, str]:
    """Return `about_here` of a worker, which answers its scheduler while it fetches stores."""
    return await asyncio.to_thread(lambda: about_here(pickle.loads(inputs)))


@cache
def versions_here() -> dict[str, str]:
    """Return the versions of code and libraries in this process, as they were at the first call."""
    root = Path(__file__).parents[2]
    found = hashlib.sha256()
    for path in sorted(path for room in ROOMS for path in (root / room).rglob("*.py")):
        found.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    facts = {"python": platform.python_version(), "spectralzoom": f"of code {found.hexdigest()[:12]}"}
    for name in LIBRARIES:
        try:
            facts[name] = version(name)
        except PackageNotFoundError:
            facts[name] = "missing"
    return facts


def _seen(folder: Path) -> str:
    if not folder.is_dir():
        return "not there"
    names = sorted(path.name for path in folder.iterdir())
    return f"with {len(names)} names ({hashlib.sha256(repr(names).encode()).hexdigest()[:8]})"
