"""Blocks on other processes: a cluster of this machine, started for the work, or one that a dask scheduler leads.

For the same bytes to come out, code, threads of arithmetic and files have to be the same wherever blocks are made.
"""

from __future__ import annotations

import hashlib
import logging
import os
import pickle
import platform
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from multiprocessing import resource_tracker
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from pipeline.errors import SettingsError, WorkerError
from pipeline.lazy import deferred

if TYPE_CHECKING:
    import dask.distributed as dask_distributed
else:
    dask_distributed = deferred("dask.distributed")

ANSWER_S = 5.0  # a scheduler that is there answers at once
LOOK_S, MOST_WAIT_S = 0.02, 60.0  # how often, and how long at most, blocks are waited for that nobody wants any more
AHEAD = 2  # blocks sent to a worker: one in the making, one waiting
MOST_SENT = 2**18  # bytes that work or one of its items may take on its way to another process: paths, not arrays
ROOMS = ("pipeline", "models", "storage", "flows")  # blocks of regions are made in flows
LIBRARIES = ("numpy", "zarr", "numcodecs", "torch", "distributed")
ONE_THREAD = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
# one thread of arithmetic a worker, and freed memory kept: large arrays cost more page faults than arithmetic
_ENVIRONMENT = {
    **ONE_THREAD,
    "MALLOC_MMAP_THRESHOLD_": f"{2**30}",
    "MALLOC_TRIM_THRESHOLD_": f"{2**31 - 1}",
    "MALLOC_TOP_PAD_": f"{2**26}",
}
_QUIET = {
    "distributed.nanny.pre-spawn-environ": _ENVIRONMENT,
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
    "distributed.scheduler.work-stealing": False,
    "distributed.worker.memory.target": False,  # what blocks take is known before: nothing is spilled
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": False,
    "distributed.worker.profile.enabled": False,
}


def ahead_of_the_oldest(
    submit: Callable[[int], Any],
    wait: Callable[[list[Any]], Iterable[Any]],
    running: dict[Any, int],
    count: int,
    window: int,
) -> Iterator[tuple[int, Any]]:
    """Begin blocks 0 to ``count`` in order, and give number and future of each as it ends.

    None is begun ``window`` or more after the oldest unfinished one: neighbours share what they read. ``running`` holds
    the futures of those under way.
    """
    sent = 0
    while running or sent < count:
        while sent < count and sent - min(running.values(), default=sent) < window:
            running[submit(sent)] = sent
            sent += 1
        for future in sorted(wait(list(running)), key=running.__getitem__):
            yield running[future], future
            del running[future]


class ProcessTeam:
    """Workers that blocks can be sent to. Close it."""

    def __init__(self, client: Any, name: str, closing: ExitStack) -> None:
        self._client, self._name, self._closing = client, name, closing

    def close(self) -> None:
        """Let the workers go; those of a cluster started here end."""
        self._closing.close()

    def run(self, make: Callable[[Any], Any], items: Sequence[Any], ended: Callable[[int, Any], None]) -> None:
        """Send blocks a few ahead of the oldest unfinished one, and give each result to ``ended``.

        Raises WorkerError: workers died while they made the same block again and again, or all of them left.
        """
        name, running = f"block-{uuid4().hex}-", dict[Any, int]()

        def submit(number: int) -> Any:
            check_sendable("item", items[number])
            return self._client.submit(make, items[number], key=f"{name}{number}")

        try:
            blocks = ahead_of_the_oldest(submit, self._wait, running, len(items), AHEAD * self._threads())
            for number, future in blocks:
                ended(number, self._result(future))
        except BaseException as error:
            self._take_back(list(running), name, wait=isinstance(error, Exception))
            raise

    def _wait(self, futures: list[Any]) -> Iterable[Any]:
        """Those that have ended, none where all go on: a team without workers never ends one, and is refused."""
        waited: Callable[..., Any] = dask_distributed.wait
        try:
            with self._client.as_current():
                done: Iterable[Any] = waited(futures, timeout=ANSWER_S, return_when="FIRST_COMPLETED").done
                return done
        except TimeoutError:
            self._threads()
            return ()
        except CancelledError:
            raise self._gone() from None

    def _take_back(self, futures: Sequence[Any], name: str, *, wait: bool) -> None:
        """Cancel blocks, and ``wait`` until nobody makes one of them any more and could write."""
        end = time.monotonic() + MOST_WAIT_S * wait
        with suppress(OSError, RuntimeError, CancelledError):  # nobody is there any more
            self._client.cancel(futures, force=True)
            while time.monotonic() < end and any(self._client.run(is_making, name).values()):
                time.sleep(LOOK_S)

    def _gone(self) -> WorkerError:
        return WorkerError(f"{self._name}: the scheduler is gone; the same command goes on once it is there again")

    def _result(self, future: Any) -> Any:
        try:
            return future.result()
        except dask_distributed.KilledWorker as error:
            raise WorkerError(
                f"{self._name}: workers died {error.args[-1] if error.args else 'several'} times in the same block; "
                "were they out of memory? use fewer --workers, or --scheduler threads"
            ) from None
        except CancelledError:
            raise self._gone() from None

    def _threads(self) -> int:
        """Blocks that can be made at a time."""
        workers = self._client.scheduler_info(n_workers=-1)["workers"]
        if not workers:
            try:
                self._client.wait_for_workers(1, timeout=ANSWER_S)
            except TimeoutError:
                raise WorkerError(
                    f"{self._name} has no workers: expected at least one; start "
                    f"`dask worker {self._client.scheduler.address}`"
                ) from None
            workers = self._client.scheduler_info(n_workers=-1)["workers"]
        return max(1, sum(int(one["nthreads"]) for one in workers.values()))

    def check(self, paths: Sequence[Path]) -> None:
        """Ask the scheduler and every worker for their versions, and workers for their threads and some folders.

        Raises SettingsError: one differs from this process; names it, both values and what to do. WorkerError: a worker
        was lost meanwhile.
        """
        self._threads()
        folders = [str(path.absolute()) for path in paths]
        try:
            leader: Mapping[str, str] = self._client.run_on_scheduler(versions_here)
            theirs: Mapping[str, Mapping[str, str]] = self._client.run(about_here, folders)
        except OSError as error:
            raise WorkerError(f"{self._name}: a worker was lost ({error}); the same command goes on") from None
        except Exception as error:  # of any type: what cannot be unpickled there comes back as text
            raise SettingsError(
                f"{self._name}: the scheduler or a worker cannot import SpectralZoom ({error}); install the same "
                "version there, or use --scheduler processes"
            ) from None
        check_facts(f"{self._name}: the scheduler", leader, versions_here())
        for worker, facts in theirs.items():
            check_facts(f"{self._name}: worker {worker}", facts, {**about_here(folders), **ONE_THREAD})


def is_making(name: str, dask_worker: Any) -> bool:
    """Whether a worker, which dask gives, is at a block whose key begins like this."""
    return any(str(task.key).startswith(name) for task in dask_worker.state.executing)


def check_sendable(what: str, value: object) -> None:
    """Refuse what cannot be pickled, or is so large that it must hold arrays (TypeError)."""
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


# --- what has to be the same ------------------------------------------------------------------------------------------


def about_here(folders: Sequence[str]) -> dict[str, str]:
    """What this process runs, on how many threads, and what it sees in some folders, by name."""
    all_threads = os.environ.get("OMP_NUM_THREADS", "not set")  # which counts where the others do not stand
    threads = {name: os.environ.get(name, all_threads) for name in ONE_THREAD}
    return versions_here() | threads | {folder: _seen(Path(folder)) for folder in folders}


@cache
def versions_here() -> dict[str, str]:
    """What this process runs, by name, as it was when first asked: so it runs whatever changes on the disk."""
    facts = {"python": platform.python_version(), "spectralzoom": _code_digest()}
    for name in LIBRARIES:
        try:
            facts[name] = version(name)
        except PackageNotFoundError:
            facts[name] = "missing"
    return facts


def check_facts(who: str, facts: Mapping[str, str], expected: Mapping[str, str]) -> None:
    """Refuse a worker that differs (SettingsError): names it, the first thing that does, both values and what to do."""
    for what, value in expected.items():
        if facts.get(what) == value:
            continue
        if what in ONE_THREAD:
            cure = " in its environment, as dask's nannies set it: sums of several threads are rounded otherwise"
        elif what.startswith("/"):
            cure = (
                " as here; workers must see the same files under the same path: put the archive on a disk that all of"
                " them mount"
            )
        else:
            cure = " as here; install the same there"
        raise SettingsError(f"{who} has {what} {facts.get(what)}, expected {value}{cure}")


def _code_digest() -> str:
    """Hash of the source that blocks run: a version number does not tell one checkout from another."""
    root, found = Path(__file__).parents[2], hashlib.sha256()
    for path in sorted(path for room in ROOMS for path in (root / room).rglob("*.py")):
        found.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return f"of code {found.hexdigest()[:12]}"


def _seen(folder: Path) -> str:
    if not folder.is_dir():
        return "not there"
    names = sorted(path.name for path in folder.iterdir())
    return f"with {len(names)} names ({hashlib.sha256(repr(names).encode()).hexdigest()[:8]})"


# --- clusters ---------------------------------------------------------------------------------------------------------


def start(workers: int) -> ProcessTeam:
    """Start a cluster of one-thread processes on this machine (WorkerError: they do not start)."""
    import dask  # half a second, for crews of processes alone

    name = f"{workers} worker processes"
    with ExitStack() as closing:
        closing.enter_context(_quiet_logs())
        closing.enter_context(_environment_restored())
        # imported before our settings are set: with them would go what distributed adds to dask's, which xarray reads
        local_cluster = dask_distributed.LocalCluster
        closing.enter_context(dask.config.set(_QUIET))
        scratch = closing.enter_context(TemporaryDirectory(prefix="spectralzoom-", ignore_cleanup_errors=True))
        try:
            with _termination_held(), _interrupts_held():
                cluster = closing.enter_context(
                    local_cluster(  # type: ignore[no-untyped-call]
                        n_workers=workers,
                        threads_per_worker=1,
                        memory_limit=0,
                        local_directory=scratch,
                        silence_logs=logging.CRITICAL,
                        scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
                    )
                )
            client = closing.enter_context(dask_distributed.Client(cluster, set_as_default=False))  # type: ignore[no-untyped-call]
        except (OSError, RuntimeError, TimeoutError) as error:
            raise WorkerError(f"{name} do not start: {error}; use --scheduler threads") from error
        return ProcessTeam(client, name, closing.pop_all())
    raise AssertionError("an exit stack swallows nothing")


def connect(scheduler: str) -> ProcessTeam:
    """Find the scheduler at an address (SettingsError: none answers there)."""
    with ExitStack() as closing:
        closing.enter_context(_quiet_logs())
        try:
            client = closing.enter_context(
                dask_distributed.Client(scheduler, timeout=ANSWER_S, set_as_default=False)  # type: ignore[no-untyped-call]
            )
        except (OSError, TimeoutError, ValueError) as error:
            raise SettingsError(
                f"--scheduler {scheduler}: expected a dask scheduler there, none answered within {ANSWER_S:g} s "
                f"({type(error).__name__}); start `dask scheduler`, or use --scheduler processes"
            ) from None
        return ProcessTeam(client, f"--scheduler {scheduler}", closing.pop_all())
    raise AssertionError("an exit stack swallows nothing")


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Let threads and processes that begin meanwhile never see Ctrl-C: this process hears it, and ends them."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # where it starts later it lets signals through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _termination_held() -> Iterator[None]:
    """Have this process hear SIGTERM once its workers have begun: half a cluster cannot be ended in silence.

    It is not blocked, for that they would inherit, and they are to be ended by it.
    """
    heard = signal.getsignal(signal.SIGTERM)
    if threading.current_thread() is not threading.main_thread() or not callable(heard):
        yield
        return
    came: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, frame: came.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, heard)
        if came:
            signal.raise_signal(signal.SIGTERM)


@contextmanager
def _environment_restored() -> Iterator[None]:
    """Put back the variables that starting workers sets in this process."""
    before = {name: os.environ.get(name) for name in _ENVIRONMENT}
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def _quiet_logs() -> Iterator[None]:
    """Hold back what dask logs of lost connections: it is said once, by an error."""
    loggers = [logging.getLogger(name) for name in ("distributed", "distributed.client")]  # each has a level of its own
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
