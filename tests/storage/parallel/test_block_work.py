"""Blocks on threads, processes and dask: order, results, memory bounds, errors, and workers that die."""

from __future__ import annotations

import os
import pickle
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import pytest
from dask.distributed import Client, LocalCluster
from distributed.comm import CommClosedError

from spectralzoom.pipeline.errors import IncompleteStoreError, SettingsError, ShapeError, WorkerError
from spectralzoom.storage.parallel import pool as pool_module
from spectralzoom.storage.parallel.pool import WorkerPool, run_blocks
from spectralzoom.storage.remote.worker_stores import FetchingWork
from spectralzoom.storage.store import Archive, Ref, digest_of
from tests.source_paths import PYTHON_PATH
from tests.storage.small_archive import make_store

ROOT = Path(__file__).parents[3]
# dask does not close its handshake with a worker that dies
pytestmark = pytest.mark.filterwarnings("ignore:unclosed <ssl.SSLSocket:ResourceWarning")


def square(number: int) -> int:
    """Return the square; functions for other processes must be at module level."""
    return number * number


def square_unless(refused: int, number: int) -> int:
    """Return the square; raise ShapeError for one number."""
    if number == refused:
        raise ShapeError(f"no {number}")
    return number * number


def die_once(folder: Path, number: int) -> int:
    """Kill the process in block 3, the first time only."""
    if number == 3 and not (folder / "died").exists():
        (folder / "died").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def die(number: int) -> int:
    """Kill the process in block 1."""
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def threads_here(number: int) -> tuple[int, str | None]:
    """Return the process and the number of threads that arithmetic may take."""
    return os.getpid(), os.environ.get("OMP_NUM_THREADS")


@pytest.fixture(scope="module")
def processes() -> Iterator[WorkerPool]:
    """Yield two worker processes for all tests of this module."""
    with WorkerPool("processes", 2).open() as pool:
        yield pool


@pytest.mark.parametrize("workers", [1, 3])
@pytest.mark.parametrize("count", [0, 1, 7])
def test_threads_give_results_in_order(workers: int, count: int) -> None:
    """With any number of threads results are in the items' order, and progress ends at 1."""
    fractions: list[float] = []
    found = run_blocks(lambda item: item * 10, range(count), WorkerPool(workers=workers), report=fractions.append)
    assert found == [10 * item for item in range(count)]
    assert fractions == [(number + 1) / count for number in range(count)]


def test_processes_give_results_in_order(processes: WorkerPool) -> None:
    """Processes give the same results as threads, and the shared part may be large (12 MiB)."""
    assert run_blocks(square, range(20), processes) == [square(item) for item in range(20)]
    assert run_blocks(bytes(12 * 2**20).__getitem__, [1, 2], processes) == [0, 0]


def test_an_open_pool_keeps_its_processes(processes: WorkerPool) -> None:
    """Several calls use the same processes, none of them this one, and each has one arithmetic thread."""
    seen = {one for _ in range(4) for one in run_blocks(threads_here, range(8), processes)}
    assert len({process for process, _ in seen}) <= processes.count  # one process may do all blocks of a call
    assert {threads for _, threads in seen} == {"1"}
    assert os.getpid() not in {process for process, _ in seen}


@pytest.mark.parametrize("workers", [2, 5])
def test_a_slow_block_limits_the_blocks_started_after_it(workers: int) -> None:
    """Blocks in memory are limited by the number of workers, not by the number of blocks."""
    begun: list[int] = []
    go_on = threading.Event()

    def make(number: int) -> None:
        begun.append(number)
        if number == 0:
            go_on.wait(0.3)
            assert max(begun) < workers

    run_blocks(make, range(24), WorkerPool(workers=workers))
    assert sorted(begun) == list(range(24))


@pytest.mark.parametrize("pool", [WorkerPool(workers=1), WorkerPool(workers=2), None], ids=["here", "two", "processes"])
def test_an_error_of_a_block_is_raised_in_the_caller(processes: WorkerPool, pool: WorkerPool | None) -> None:
    """The error keeps its type and message, and the workers serve the next call."""
    pool = processes if pool is None else pool
    with pytest.raises(ShapeError, match="no 3"):
        run_blocks(partial(square_unless, 3), range(9), pool)
    assert run_blocks(square, range(3), pool) == [0, 1, 4]


def test_a_block_of_a_killed_worker_is_repeated(tmp_path: Path, processes: WorkerPool) -> None:
    """Another worker repeats the block after kill -9."""
    assert run_blocks(partial(die_once, tmp_path), range(8), processes) == list(range(8))
    assert (tmp_path / "died").exists()


def test_a_block_that_always_kills_its_worker_raises_an_error() -> None:
    """The error says what to do, and the open pool gets new workers."""
    with WorkerPool("processes", 1).open() as pool:
        (before, _), *_ = run_blocks(threads_here, [0], pool)
        died = r"--scheduler processes: workers died .* in the same block.*--scheduler threads"
        with pytest.raises(WorkerError, match=died):
            run_blocks(die, range(3), pool)
        (after, _), *_ = run_blocks(threads_here, [0], pool)
        assert before != after


@pytest.mark.parametrize("scheduler", ["thread", "tcp://", "tcp://host", "http://host:80", "tcp://host:port"])
def test_an_unknown_scheduler_is_refused(scheduler: str) -> None:
    """The value is an unknown word, or an address without a port; the error says what is expected."""
    with pytest.raises(SettingsError, match="threads, processes, or the address of a dask scheduler such as tcp://"):
        WorkerPool(scheduler)


def test_pool_has_a_worker_for_each_core_by_default() -> None:
    """Fewer than one worker is refused."""
    assert WorkerPool().count == len(os.sched_getaffinity(0))
    with pytest.raises(SettingsError, match="at least 1, got 0"):
        WorkerPool(workers=0)


def test_a_missing_scheduler_raises_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error names the address, what was expected and what to do."""
    monkeypatch.setattr(pool_module, "ANSWER_S", 0.3)
    with pytest.raises(SettingsError, match=r"tcp://127.0.0.1:9: expected a dask scheduler .*start `dask scheduler`"):
        run_blocks(square, [1], WorkerPool("tcp://127.0.0.1:9"))


@pytest.fixture(scope="module")
def elsewhere() -> Iterator[WorkerPool]:
    """Yield the pool of a dask scheduler with one worker, found by its address."""
    with LocalCluster(n_workers=1, threads_per_worker=2, dashboard_address="127.0.0.1:0") as cluster:
        pool = WorkerPool(cluster.scheduler_address)
        with pool.open():
            yield pool


def test_workers_of_a_dask_scheduler_give_the_same_results(elsewhere: WorkerPool) -> None:
    """Results are in the order of the items."""
    assert run_blocks(square, range(6), elsewhere) == [square(item) for item in range(6)]


@dataclass(frozen=True)
class ReadStore:
    """Work that reads a store."""

    store: Ref

    def read(self, item: int) -> bytes:
        """Return one byte of its file."""
        return (self.store.path / "data.bin").read_bytes()[item : item + 1]


def test_workers_without_the_archive_fetch_stores_from_a_bucket(
    elsewhere: WorkerPool, bucket: str, tmp_path: Path
) -> None:
    """The survey has sent the stores that the work names, wherever they stand in it."""
    archive = Archive.open(tmp_path / "archive")
    store = make_store(archive, "capture", {}, [])
    there = (store.path / "data.bin").read_bytes()
    work = ReadStore(store).read
    assert run_blocks(work, range(3), WorkerPool(elsewhere.scheduler, bucket=bucket)) == [b"[", b'"', b"c"]
    digest = digest_of(store.path)
    shutil.rmtree(archive.root)
    elsewhere_work = pickle.loads(pickle.dumps(FetchingWork(work, {store: digest}, bucket)))
    assert [elsewhere_work(item) for item in range(3)] == [b"[", b'"', b"c"]
    assert (store.path / "data.bin").read_bytes() == there


def test_a_worker_with_other_bytes_is_refused(bucket: str, tmp_path: Path) -> None:
    """Its folder, or the bucket, has a store of the same key from another machine: both digests are named."""
    archive = Archive.open(tmp_path / "archive")
    store = make_store(archive, "capture", {}, [])
    work = FetchingWork(ReadStore(store).read, {store: "0123456789ab"}, bucket)
    with pytest.raises(
        IncompleteStoreError, match=rf"has digest {digest_of(store.path)}, .* survey 0123456789ab; remove"
    ):
        work(0)


@pytest.mark.parametrize(
    ("scheduler", "bucket", "words"),
    [("threads", "s3://bucket/x", "for workers on other machines"), ("tcp://host:1", "bucket", "no archive on S3")],
)
def test_a_bucket_for_workers_is_checked_before_a_survey(scheduler: str, bucket: str, words: str) -> None:
    """Without a dask scheduler it would do nothing."""
    with pytest.raises(SettingsError, match=words):
        WorkerPool(scheduler, bucket=bucket)


STALE_S = 0.6


def fail_or_write(folder: Path, number: int) -> None:
    """Fail in block 0 while block 1 has still to write."""
    if number == 0:
        while not (folder / "begun").exists():
            time.sleep(0.01)
        raise ShapeError("no 0")
    (folder / "begun").touch()
    time.sleep(STALE_S)
    (folder / f"late {number}").touch()


def test_blocks_of_lost_workers_are_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """A block whose workers are gone may never end: the error is raised at once."""
    monkeypatch.setattr(pool_module, "ANSWER_S", 0.01)
    block: Future[None] = Future()
    gone = Mock(side_effect=WorkerError("gone"))
    with pytest.raises(WorkerError, match="gone"):
        list(pool_module._in_order(lambda _: block, [0], 1, gone, (WorkerError,)))
    assert not block.done()


def import_missing(number: int) -> int:
    """Import a package that the workers lack."""
    import missing_package  # type: ignore[import-not-found]

    return number + int(missing_package.one)


def test_a_worker_without_the_code_raises_one_error(elsewhere: WorkerPool) -> None:
    """The message names the missing module and what to do."""
    with pytest.raises(SettingsError, match=r"a worker cannot import SpectralZoom .*missing_package.*install the same"):
        run_blocks(import_missing, [1], elsewhere)


@pytest.mark.parametrize("scheduler", ["threads", "processes"])
def test_no_block_writes_after_an_error_is_raised(tmp_path: Path, processes: WorkerPool, scheduler: str) -> None:
    """The caller may then delete the folder: running blocks have ended, and no new one starts."""
    pool = processes if scheduler == "processes" else WorkerPool(workers=2)
    with pytest.raises(ShapeError, match="no 0"):
        run_blocks(partial(fail_or_write, tmp_path), range(6), pool)
    left = sorted(path.name for path in tmp_path.iterdir())
    time.sleep(2 * STALE_S)
    assert sorted(path.name for path in tmp_path.iterdir()) == left


def fail_or_stay(number: int) -> None:
    """Fail in block 0; stay for some seconds in others."""
    if number == 0:
        raise ShapeError("no 0")
    time.sleep(3)


@pytest.mark.parametrize("items", [(1, 2), (0, 1)], ids=["in a block", "after an error of a block"])
def test_nothing_waits_for_blocks_of_a_lost_scheduler(
    elsewhere: WorkerPool, monkeypatch: pytest.MonkeyPatch, items: tuple[int, ...]
) -> None:
    """A lost connection, which dask reports in several ways, ends the wait: such blocks may never end."""
    monkeypatch.setattr(pool_module, "ANSWER_S", 0.2)
    answers = [None]
    monkeypatch.setattr(Client, "wait_for_workers", lambda *_, **__: answers.pop() if answers else lose_connection())
    began = time.monotonic()
    with pytest.raises(WorkerError, match="the scheduler is gone"):
        run_blocks(fail_or_stay, items, elsewhere)
    assert time.monotonic() - began < 3


def lose_connection() -> None:
    """Raise dask's error of a connection that is closed."""
    raise CommClosedError("in connect")


GONE = """
import subprocess, sys, time
from contextlib import suppress
from spectralzoom.pipeline.errors import PipelineError, WorkerError
from spectralzoom.storage.parallel.pool import WorkerPool, run_blocks
from tests.storage.parallel.test_block_work import nap

def dask(*words):
    command = [sys.executable, "-m", f"distributed.cli.dask_{words[0]}", *words[1:], "--no-dashboard"]
    return subprocess.Popen(command, stderr=subprocess.DEVNULL)

def begin(pool):
    started = dask("scheduler", "--host", pool.scheduler), dask("worker", pool.scheduler, "--nthreads", "1")
    while True:
        with suppress(PipelineError):
            run_blocks(nap, range(1), pool)
            return started
        time.sleep(0.1)

def end(started):
    for one in started:
        one.terminate()
        one.wait()

if __name__ == "__main__":
    with WorkerPool(sys.argv[1]).open() as pool:
        started = begin(pool)
        try:
            run_blocks(nap, range(9), pool, report=lambda done: started[0].kill())
        except WorkerError as error:
            print(error)
        end(started)
        started = begin(pool)
        print(run_blocks(nap, range(3), pool))
        end(started)
"""


def nap(number: int) -> int:
    """Sleep for a short block."""
    time.sleep(0.05)
    return number


def test_a_lost_scheduler_raises_one_error(tmp_path: Path) -> None:
    """There is one message and no traceback of dask; a restarted scheduler serves the pool again."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        at = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    with run_script(tmp_path, GONE, at) as started:
        printed, said = started.communicate(timeout=300)
    gone = f"--scheduler {at}: the scheduler is gone. Start it again and repeat the command: finished stages are kept"
    assert (started.returncode, printed.splitlines(), said) == (0, [gone, "[0, 1, 2]"], "")


INTERRUPTED = """
import signal, sys, time
from functools import partial
from pathlib import Path
from spectralzoom.storage.parallel.pool import WorkerPool, run_blocks
from tests.storage.parallel.test_block_work import touch_slowly
if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs have it ignored
    try:
        run_blocks(partial(touch_slowly, Path(sys.argv[1])), range(1000), WorkerPool("processes", 1))
    except KeyboardInterrupt:
        sys.exit(130)
"""


def run_script(folder: Path, text: str, *words: str) -> subprocess.Popen[str]:
    """Start a program in a process and a session of its own."""
    (script := folder / "script.py").write_text(text)
    command = [sys.executable, str(script), *words]
    environment = {**os.environ, "PYTHONPATH": PYTHON_PATH}
    said = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, env=environment, start_new_session=True, **said)  # type: ignore[call-overload, no-any-return]


def touch_slowly(folder: Path, number: int) -> None:
    """Show that a block has begun, and take a while."""
    (folder / f"{number}-{os.getpid()}").touch()
    time.sleep(0.3)


def is_running(process: int) -> bool:
    """Return whether a process exists and is no zombie."""
    try:
        return ") Z " not in Path(f"/proc/{process}/stat").read_text()
    except OSError:
        return False


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGKILL])
def test_no_worker_outlives_its_pool(tmp_path: Path, sent: signal.Signals) -> None:
    """Ctrl-C ends the workers without output; after kill -9 of their parent process they end too."""
    begun = tmp_path / "begun"
    begun.mkdir()
    with run_script(tmp_path, INTERRUPTED, str(begun)) as started:
        while len(list(begun.iterdir())) < 3:
            assert started.poll() is None
            time.sleep(0.02)
        (os.killpg if sent == signal.SIGINT else os.kill)(started.pid, sent)
        said = started.stderr.read()
        assert started.wait(30) == (130 if sent == signal.SIGINT else -sent)
    workers = {int(path.name.split("-")[1]) for path in begun.iterdir()}
    assert len(workers) == 1
    end = time.monotonic() + 20
    while any(map(is_running, workers)):
        assert time.monotonic() < end
        time.sleep(0.05)
    if sent == signal.SIGINT:
        assert said == ""
