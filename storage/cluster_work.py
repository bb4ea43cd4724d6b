"""Blocks on other processes: a cluster of this machine, started for the work, or one that a dask scheduler leads."""

from __future__ import annotations

import hashlib
import logging
import os
import platform
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager
from importlib.metadata import PackageNotFoundError, version
from multiprocessing import resource_tracker
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from uuid import uuid4

import dask

from pipeline.errors import SettingsError, WorkerError
from storage.block_work import Crew, check_sendable

ANSWER_S = 5.0  # a scheduler that is there answers at once
AHEAD = 2  # blocks sent to a worker: one in the making, one waiting
ROOMS = ("pipeline", "models", "storage", "flows")  # blocks of regions are made in flows
LIBRARIES = ("numpy", "zarr", "numcodecs", "torch", "distributed")
# one thread of arithmetic a worker, and freed memory kept: large arrays cost more page faults than arithmetic
_ENVIRONMENT = {
    "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1",
    "MALLOC_MMAP_THRESHOLD_": f"{2**30}", "MALLOC_TRIM_THRESHOLD_": f"{2**31 - 1}", "MALLOC_TOP_PAD_": f"{2**26}",
}  # fmt: skip
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


class Team:
    """Workers that blocks can be sent to. Close it."""

    def __init__(self, client: Any, name: str, closing: ExitStack) -> None:
        self._client, self._name, self._closing = client, name, closing

    def close(self) -> None:
        """Let the workers go; those of a cluster started here end."""
        self._closing.close()

    def run(self, make: Callable[[Any], Any], items: Sequence[Any], ended: Callable[[int, Any], None]) -> None:
        """Send blocks a few ahead of the oldest unfinished one, and give each result to ``ended``.

        Raises
        ------
        WorkerError : workers died while they made the same block again and again, or all of them left.
        """
        from dask.distributed import wait

        waited: Callable[..., Any] = wait
        window, name = AHEAD * self._threads(), f"block-{uuid4().hex}"
        running: dict[Any, int] = {}
        sent = 0
        try:
            while running or sent < len(items):
                while sent < len(items) and sent - min(running.values(), default=sent) < window:
                    check_sendable("item", items[sent])
                    running[self._client.submit(make, items[sent], key=f"{name}-{sent}")] = sent
                    sent += 1
                try:
                    with self._client.as_current():
                        done = waited(list(running), timeout=ANSWER_S, return_when="FIRST_COMPLETED").done
                except TimeoutError:
                    self._threads()  # a block may take long; a team without workers never ends one
                    continue
                for future in sorted(done, key=running.__getitem__):
                    ended(running[future], self._result(future))
                    del running[future]
        finally:
            if running:
                self._client.cancel(list(running), force=True)

    def _result(self, future: Any) -> Any:
        """What a block gave, or why it did not."""
        from dask.distributed import KilledWorker

        try:
            return future.result()
        except KilledWorker as error:
            raise WorkerError(
                f"{self._name}: workers died {error.args[-1] if error.args else 'several'} times in the same block; "
                "were they out of memory? use fewer --workers, or --scheduler threads"
            ) from None
        except CancelledError:
            raise WorkerError(
                f"{self._name}: the scheduler is gone; the same command goes on once it is there again"
            ) from None

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
        """Ask every worker for its versions and what it sees in some folders.

        Raises
        ------
        SettingsError : a worker differs from this process; names the worker, both values and what to do.
        """
        self._threads()
        folders = [str(path.absolute()) for path in paths]
        mine = about_here(folders)
        try:
            theirs: Mapping[str, Mapping[str, str]] = self._client.run(about_here, folders)
        except (ImportError, AttributeError) as error:
            raise SettingsError(
                f"{self._name}: a worker cannot import SpectralZoom ({error}); install the same version there, or use "
                "--scheduler processes"
            ) from None
        for worker, facts in theirs.items():
            for what, expected in mine.items():
                if facts.get(what) != expected:
                    raise SettingsError(
                        f"{self._name}: worker {worker} has {what} {facts.get(what)}, expected {expected} as here; "
                        + (_SAME_FILES if what in folders else "install the same there")
                    )


_SAME_FILES = "workers must see the same files under the same path: put the archive on a disk that all of them mount"


def about_here(folders: Sequence[str]) -> dict[str, str]:
    """What this process runs, and what it sees in some folders, by name."""
    facts = {"python": platform.python_version(), "spectralzoom": _code_digest()}
    for name in LIBRARIES:
        try:
            facts[name] = version(name)
        except PackageNotFoundError:
            facts[name] = "missing"
    return facts | {folder: _seen(Path(folder)) for folder in folders}


def _code_digest() -> str:
    """Hash of the source that blocks run: a version number does not tell one checkout from another."""
    root, found = Path(__file__).parents[1], hashlib.sha256()
    for path in sorted(path for room in ROOMS for path in (root / room).rglob("*.py")):
        found.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return f"of code {found.hexdigest()[:12]}"


def _seen(folder: Path) -> str:
    """What a folder holds, in a few letters."""
    if not folder.is_dir():
        return "not there"
    names = sorted(path.name for path in folder.iterdir())
    return f"with {len(names)} names ({hashlib.sha256(repr(names).encode()).hexdigest()[:8]})"


def start(workers: int) -> Team:
    """Start a cluster of one-thread processes on this machine.

    Raises
    ------
    WorkerError : the processes do not start.
    """
    from dask.distributed import Client, LocalCluster

    name = f"{workers} worker processes"
    with ExitStack() as closing:
        closing.enter_context(_quiet_logs())
        closing.enter_context(_environment_restored())
        closing.enter_context(dask.config.set(_QUIET))
        scratch = closing.enter_context(TemporaryDirectory(prefix="spectralzoom-", ignore_cleanup_errors=True))
        try:
            with _interrupts_held():
                cluster = closing.enter_context(
                    LocalCluster(  # type: ignore[no-untyped-call]
                        n_workers=workers,
                        threads_per_worker=1,
                        memory_limit=0,
                        local_directory=scratch,
                        silence_logs=logging.CRITICAL,
                        scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
                    )
                )
            client = closing.enter_context(Client(cluster, set_as_default=False))  # type: ignore[no-untyped-call]
        except (OSError, RuntimeError, TimeoutError) as error:
            raise WorkerError(f"{name} do not start: {error}; use --scheduler threads") from error
        return Team(client, name, closing.pop_all())
    raise AssertionError("an exit stack swallows nothing")


def connect(crew: Crew) -> Team:
    """Find the scheduler of a crew that is elsewhere.

    Raises
    ------
    SettingsError : none answers there.
    """
    from dask.distributed import Client

    with ExitStack() as closing:
        closing.enter_context(_quiet_logs())
        try:
            client = closing.enter_context(
                Client(crew.scheduler, timeout=ANSWER_S, set_as_default=False)  # type: ignore[no-untyped-call]
            )
        except (OSError, TimeoutError, ValueError) as error:
            raise SettingsError(
                f"--scheduler {crew.scheduler}: expected a dask scheduler there, none answered within {ANSWER_S:g} s "
                f"({type(error).__name__}); start `dask scheduler`, or use --scheduler processes"
            ) from None
        return Team(client, f"--scheduler {crew.scheduler}", closing.pop_all())
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
    logger = logging.getLogger("distributed")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)
