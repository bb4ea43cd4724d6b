"""Map a function over blocks, one task for each, on threads, on processes, or on the workers of a dask scheduler.

Processes are a dask cluster of this machine. A block reads published stores and returns arrays; only the survey's own
process writes. The results are the same bytes everywhere if code, libraries and files are the same.
"""

from __future__ import annotations

import logging
import os
import signal
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor, wait
from contextlib import closing, contextmanager
from dataclasses import dataclass
from multiprocessing import resource_tracker
from operator import call
from typing import Any, TypeVar

from spectralzoom.pipeline.errors import SettingsError, WorkerError
from spectralzoom.pipeline.words import is_scheduler

ANSWER_S = 5.0  # time limit of a scheduler's answer
RESTART_S = 60.0  # time limit until a process of this machine replaces one that died
AHEAD = 2  # blocks sent to a worker: one running, one waiting
# one thread of arithmetic a worker, and freed memory kept: large arrays cost more page faults than arithmetic
_ENVIRONMENT = {
    **dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"),
    "MALLOC_MMAP_THRESHOLD_": f"{2**30}",
    "MALLOC_TRIM_THRESHOLD_": f"{2**31 - 1}",
    "MALLOC_TOP_PAD_": f"{2**26}",
}
GONE = "the scheduler is gone. Start it again and repeat the command: finished stages are kept"
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
    """Workers for blocks: ``threads``, ``processes``, or those of a dask scheduler at ``tcp://host:port``.

    With a ``bucket``, workers of a dask scheduler fetch the stores that their machines lack.
    """

    scheduler: str = "threads"
    workers: int | None = None  # None: one for each core; ignored with a dask scheduler
    bucket: str | None = None

    def __post_init__(self) -> None:
        if not is_scheduler(self.scheduler):
            raise SettingsError(
                f"scheduler must be threads, processes, or the address of a dask scheduler such as "
                f"tcp://192.168.1.5:8786; got {self.scheduler!r}"
            )
        if self.workers is not None and self.workers < 1:
            raise SettingsError(f"workers must be at least 1, got {self.workers}")
        if self.bucket is not None:
            if not self.elsewhere:
                raise SettingsError(
                    f"bucket {self.bucket} is for workers on other machines; give --scheduler tcp://host:port, or no "
                    "--bucket, and copy the archive by spectralzoom push"
                )
            from spectralzoom.storage.remote.objects import Objects  # imports obstore

            Objects(self.bucket)

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
        if self.shares_memory or self in _clusters:
            yield self
            return
        _clusters[self] = None
        try:
            yield self
        finally:
            if (cluster := _clusters.pop(self)) is not None:
                cluster.close()


THREADS = WorkerPool()

_clusters: dict[WorkerPool, Cluster | None] = {}  # of open pools, None until they are started


def run_blocks(
    make: Callable[[Item], Result],
    items: Sequence[Item],
    pool: WorkerPool = THREADS,
    *,
    take: Callable[[Item, Result], Any] | None = None,
    report: Report = lambda done: None,
) -> list[Any]:
    """Call ``make`` with every item, each in a task of its own, and ``take`` with each item and its result.

    Returns what ``take`` returns, or without it the results, in the order of the items. Blocks start in order, at most
    a few ahead of the oldest unfinished one, since neighbours share input. An error is raised when no block is running
    any more. ``report`` is called with the fraction done.

    On threads ``make`` and ``take`` must be safe to call from several at once. Otherwise ``make``, items and results
    are pickled, and ``take`` is called in this process. Workers of a dask scheduler read stores by the same paths:
    mounted or, with a bucket, fetched. Raises SettingsError: no scheduler answers, or its workers cannot import this
    code; WorkerError: workers died repeatedly, or none is left.
    """

    def whole(item: Item) -> Any:
        return make(item) if take is None else take(item, make(item))

    results: list[Any] = []
    away = bool(items) and not pool.shares_memory
    made = _run_away(pool, make, items) if away else _on_threads(whole, items, min(pool.count, len(items)))
    with pool.open(), closing(made):
        for item, one in zip(items, made, strict=True):
            results.append(take(item, one) if away and take is not None else one)
            report(len(results) / len(items))
    return results


def _on_threads(make: Callable[[Any], Any], items: Sequence[Any], workers: int) -> Generator[Any, None, None]:
    """Yield the results of blocks in this process."""
    if workers < 2:
        yield from map(make, items)
        return
    with ThreadPoolExecutor(workers) as team:
        yield from _in_order(lambda item: team.submit(make, item), items, workers)


def _in_order(
    submit: Callable[[Any], Future[Any]],
    items: Sequence[Any],
    window: int,
    alive: Callable[[], object] = lambda: None,
    lost: tuple[type[Exception], ...] = (),
) -> Generator[Any, None, None]:
    """Submit blocks in order, fewer than ``window`` ahead of the oldest unfinished one; yield results in order.

    An error is raised when the running blocks have ended. One of the types ``lost`` is raised at once: blocks of lost
    workers may never end. ``alive``, called while blocks do not end, raises one of them without workers.
    """
    running: deque[Future[Any]] = deque()

    def end(blocks: Sequence[Future[Any]]) -> None:
        while wait(blocks, timeout=ANSWER_S).not_done:
            alive()

    def oldest() -> Any:
        end([running[0]])
        return running.popleft().result()

    try:
        for item in items:
            if len(running) == window:
                yield oldest()
            running.append(submit(item))
        while running:
            yield oldest()
    except lost:
        raise
    except (Exception, GeneratorExit):
        end(running)
        raise


def _run_away(pool: WorkerPool, make: Callable[[Any], Any], items: Sequence[Any]) -> Generator[Any, None, None]:
    """Yield the results of blocks on the workers of dask, which runs blocks of a dead worker again on others."""
    import dask
    import dask.distributed as dask_distributed

    if pool.bucket is not None:
        from spectralzoom.storage.remote.worker_stores import fetching_work  # imports obstore

        make = fetching_work(make, pool.bucket)
    cluster = _clusters[pool] = _clusters[pool] or Cluster(pool)
    lost = (WorkerError, CancelledError, dask_distributed.KilledWorker)
    try:
        count = cluster.count()
        with dask.config.set({"distributed.admin.large-graph-warning-threshold": "1 GiB"}):
            shared = cluster.client.submit(_itself, make, pure=False)  # travels once to each worker
        team: Any = cluster.client.get_executor(pure=False)
        yield from _in_order(lambda item: team.submit(call, shared, item), items, AHEAD * count, cluster.count, lost)
    except lost as error:
        _clusters[pool] = None  # the next use starts others
        cluster.close()
        if isinstance(error, WorkerError):
            raise
        advice = (
            GONE
            if isinstance(error, CancelledError) and pool.elsewhere
            else "workers died several times in the same block, perhaps out of memory. Use fewer --workers, or "
            "--scheduler threads"
        )
        raise WorkerError(f"{cluster.name}: {advice}") from None
    except ImportError as error:
        raise SettingsError(
            f"{cluster.name}: a worker cannot import SpectralZoom ({error}); install the same version there, or use "
            "--scheduler processes"
        ) from None


def _itself(make: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return make


class Cluster:
    """The workers of a dask scheduler, on this machine or elsewhere."""

    def __init__(self, pool: WorkerPool) -> None:
        """Connect to the scheduler, or start processes (SettingsError: none answers, or none start)."""
        import dask.distributed as dask_distributed

        self.name = f"--scheduler {pool.scheduler}"
        # an error reports lost connections once
        for name in ("distributed", "distributed.client", "tornado.application"):
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

    def close(self) -> None:
        """Disconnect from the workers; those elsewhere keep running."""
        self.client.close()
        if self._own is not None:
            self._own.close()

    def count(self) -> int:
        """Return the number of blocks at a time. Raises WorkerError: there are no workers, or no scheduler."""
        try:
            self.client.wait_for_workers(1, timeout=ANSWER_S if self._own is None else RESTART_S)
        except TimeoutError:
            address = self.client.scheduler.address
            advice = f"start `dask worker {address}`" if self._own is None else "use --scheduler threads"
            raise WorkerError(f"{self.name} has no workers: expected at least one; {advice}") from None
        except OSError:  # the connection is lost
            raise WorkerError(f"{self.name}: {GONE}") from None
        return max(1, sum(int(threads) for threads in self.client.nthreads().values()))


def start(workers: int) -> Any:
    """Start a dask cluster of processes of this machine, with one arithmetic thread each, deaf to Ctrl-C."""
    import dask
    import dask.distributed as dask_distributed

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
