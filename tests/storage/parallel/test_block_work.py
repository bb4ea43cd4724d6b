"""Blocks on threads and processes: order, results, bounds, what cannot be sent, workers that die."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
from dask.distributed import LocalCluster

from pipeline.errors import SettingsError, ShapeError, WorkerError
from storage.archive.keys import StageRef
from storage.parallel import pool as pool_module
from storage.parallel.pool import THREADS_OF, WorkerPool, run_blocks

ROOT = Path(__file__).parents[3]
PROCESSES = WorkerPool("processes", 2)
# dask leaves its half of a handshake with a worker that dies
pytestmark = pytest.mark.filterwarnings("ignore:unclosed <ssl.SSLSocket:ResourceWarning")


def square(number: int) -> int:
    """What is sent to other processes stands in a module."""
    return number * number


def square_unless(refused: int, number: int) -> int:
    """Fail for one number."""
    if number == refused:
        raise ShapeError(f"no {number}")
    return number * number


def die_once(folder: Path, number: int) -> int:
    """Be killed in the middle of block 3, the first time."""
    if number == 3 and not (folder / "died").exists():
        (folder / "died").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def die(number: int) -> int:
    """Be killed in every block 1."""
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def threads_here(number: int) -> tuple[int, str | None]:
    """Whose process this is, and how many threads arithmetic may take."""
    return os.getpid(), os.environ.get("OMP_NUM_THREADS")


@pytest.fixture(scope="module")
def processes() -> Iterator[WorkerPool]:
    """Two worker processes for all tests here."""
    with PROCESSES.open() as pool:
        yield pool


@pytest.mark.parametrize("workers", [1, 3])
@pytest.mark.parametrize("count", [0, 1, 7])
def test_threads_give_results_in_order(workers: int, count: int) -> None:
    """However many threads, each item is made once, results stand in the items' order, and progress ends at 1."""
    fractions: list[float] = []
    found = run_blocks(lambda item: item * 10, range(count), WorkerPool(workers=workers), report=fractions.append)
    assert found == [10 * item for item in range(count)]
    assert fractions == [(number + 1) / count for number in range(count)]


def test_processes_give_results_in_order(processes: WorkerPool) -> None:
    """Other processes give what threads give, and what all blocks share may be large."""
    assert run_blocks(square, range(20), processes) == [square(item) for item in range(20)]
    assert run_blocks(bytes(12 * 2**20).__getitem__, [1, 2], processes) == [0, 0]


def test_workers_are_kept_and_have_one_thread(processes: WorkerPool) -> None:
    """While a worker pool is open the same processes work for every call, none of them this one, one thread each."""
    seen = {one for _ in range(4) for one in run_blocks(threads_here, range(8), processes)}
    assert len({process for process, _ in seen}) <= processes.count  # one may do all blocks of a call
    assert {threads for _, threads in seen} == {"1"}
    assert os.getpid() not in {process for process, _ in seen}


@pytest.mark.parametrize("workers", [2, 5])
def test_few_blocks_are_begun_ahead_of_the_oldest(workers: int) -> None:
    """A slow block holds up those far behind it: what is in memory at a time does not grow with the blocks."""
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
def test_an_error_of_a_block_is_raised_here(processes: WorkerPool, pool: WorkerPool | None) -> None:
    """What a block raises ends the work with its type and message, and the workers serve the next call."""
    pool = processes if pool is None else pool
    with pytest.raises(ShapeError, match="no 3"):
        run_blocks(partial(square_unless, 3), range(9), pool)
    assert run_blocks(square, range(3), pool) == [0, 1, 4]


def test_a_killed_worker_costs_only_time(tmp_path: Path, processes: WorkerPool) -> None:
    """kill -9 of a worker in the middle of a block: the block is made again, by another."""
    assert run_blocks(partial(die_once, tmp_path), range(8), processes) == list(range(8))
    assert (tmp_path / "died").exists()


def test_a_block_that_kills_its_workers_is_one_error() -> None:
    """Where every try kills the worker, the error says so and what to do; an open worker pool gets other workers."""
    with WorkerPool("processes", 1).open() as pool:
        (before, _), *_ = run_blocks(threads_here, [0], pool)
        with pytest.raises(
            WorkerError, match=r"--scheduler processes: workers died .* in the same block.*--scheduler threads"
        ):
            run_blocks(die, range(3), pool)
        (after, _), *_ = run_blocks(threads_here, [0], pool)
        assert before != after


@pytest.mark.parametrize("scheduler", ["thread", "tcp://", "tcp://host", "http://host:80", "tcp://host:port"])
def test_an_unknown_scheduler_is_refused(scheduler: str) -> None:
    """A word that is none, or an address without a port, is refused with what is expected."""
    with pytest.raises(SettingsError, match="threads, processes, or the address of a dask scheduler such as tcp://"):
        WorkerPool(scheduler)


def test_workers_are_counted() -> None:
    """None is a worker for each core; fewer than one is refused."""
    assert WorkerPool().count == len(os.sched_getaffinity(0))
    with pytest.raises(SettingsError, match="at least 1, got 0"):
        WorkerPool(workers=0)


def test_nobody_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    """No scheduler at the address: one error that says where, what was expected and what to do."""
    monkeypatch.setattr(pool_module, "ANSWER_S", 0.3)
    with pytest.raises(SettingsError, match=r"tcp://127.0.0.1:9: expected a dask scheduler .*start `dask scheduler`"):
        run_blocks(square, [1], WorkerPool("tcp://127.0.0.1:9"))


@pytest.fixture(scope="module")
def elsewhere() -> Iterator[WorkerPool]:
    """A scheduler with one worker, found by its address."""
    with LocalCluster(n_workers=1, threads_per_worker=2, dashboard_address="127.0.0.1:0") as cluster:
        pool = WorkerPool(cluster.scheduler_address)
        with pool.open():
            yield pool


def test_workers_of_a_scheduler_elsewhere_give_the_same(elsewhere: WorkerPool, tmp_path: Path) -> None:
    """By the address of a scheduler its workers make the blocks, once they have shown that they see the store."""
    store = StageRef("rectify", "key", tmp_path)
    assert run_blocks(square, range(6), elsewhere, inputs=[store]) == [square(item) for item in range(6)]


@pytest.mark.parametrize(
    ("here", "words"),
    [
        ({"numpy": "0.1"}, r"has numpy \d.*, expected 0.1 as here; install the same there"),
        ({"spectralzoom": "of code abc"}, r"has spectralzoom of code \w+, expected of code abc as here"),
        ({"stages/a/b": "with 7 names"}, r"has stages/a/b None, expected with 7 names as here.*mount the archive"),
    ],
)
def test_workers_that_differ_are_refused(
    elsewhere: WorkerPool, monkeypatch: pytest.MonkeyPatch, here: dict[str, str], words: str
) -> None:
    """Other code, another numpy or other files would give other bytes: the first that differs is named."""
    run, true = pool_module.dask_distributed.Client.run, pool_module.about_here([])
    monkeypatch.setattr(pool_module.dask_distributed.Client, "run", lambda self, ask, inputs: run(self, _true, true))
    monkeypatch.setattr(pool_module, "about_here", lambda inputs: {**true, **here})
    with pytest.raises(SettingsError, match=rf"worker tcp:.* {words}"):
        run_blocks(square, [1], elsewhere)


def _true(facts: dict[str, str]) -> dict[str, str]:
    return {**facts, THREADS_OF: os.environ[THREADS_OF]}


STALE_S = 0.6


def fail_or_write(folder: Path, number: int) -> None:
    """Fail in block 0 while block 1 is still to write."""
    if number == 0:
        while not (folder / "begun").exists():
            time.sleep(0.01)
        raise ShapeError("no 0")
    (folder / "begun").touch()
    time.sleep(STALE_S)
    (folder / f"late {number}").touch()


@pytest.mark.parametrize("scheduler", ["threads", "processes"])
def test_nobody_writes_after_an_error(tmp_path: Path, processes: WorkerPool, scheduler: str) -> None:
    """Once an error is raised whoever asked may take the folder away: no block comes back to it, none is begun."""
    pool = processes if scheduler == "processes" else WorkerPool(workers=2)
    with pytest.raises(ShapeError, match="no 0"):
        run_blocks(partial(fail_or_write, tmp_path), range(6), pool)
    left = sorted(path.name for path in tmp_path.iterdir())
    time.sleep(2 * STALE_S)
    assert sorted(path.name for path in tmp_path.iterdir()) == left


GONE = """
import subprocess, sys, time
from contextlib import suppress
from pipeline.errors import PipelineError, WorkerError
from storage.parallel import pool as pool_module
from storage.parallel.pool import WorkerPool, run_blocks
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
    pool_module.ANSWER_S = 1.0
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
    """A short block."""
    time.sleep(0.05)
    return number


def test_a_scheduler_that_goes_away_is_one_error(tmp_path: Path) -> None:
    """In the middle of the work: one message, no traceback of dask's; a scheduler that comes back serves the pool."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    with run_script(tmp_path, GONE, address) as started:
        printed, said = started.communicate(timeout=60)
    gone = (
        f"--scheduler {address}: the scheduler is gone. Start it again and repeat the command: finished stages are kept"
    )
    assert (started.returncode, printed.splitlines(), said) == (0, [gone, "[0, 1, 2]"], "")


INTERRUPTED = """
import signal, sys, time
from functools import partial
from pathlib import Path
from storage.parallel.pool import WorkerPool, run_blocks
from tests.storage.parallel.test_block_work import touch_slowly
if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs have it ignored
    try:
        run_blocks(partial(touch_slowly, Path(sys.argv[1])), range(1000), WorkerPool("processes", 1))
    except KeyboardInterrupt:
        sys.exit(130)
"""


def run_script(folder: Path, text: str, *words: str) -> subprocess.Popen[str]:
    """A program in a process, and a session, of its own."""
    (script := folder / "script.py").write_text(text)
    command, environment = [sys.executable, str(script), *words], {**os.environ, "PYTHONPATH": str(ROOT)}
    said = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, env=environment, start_new_session=True, **said)  # type: ignore[call-overload, no-any-return]


def touch_slowly(folder: Path, number: int) -> None:
    """Show that a block has begun, and take a while."""
    (folder / f"{number}-{os.getpid()}").touch()
    time.sleep(0.3)


def is_running(process: int) -> bool:
    """Whether a process is there and no zombie that nobody has asked for."""
    try:
        return ") Z " not in Path(f"/proc/{process}/stat").read_text()
    except OSError:
        return False


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGKILL])
def test_no_worker_outlives_its_pool(tmp_path: Path, sent: signal.Signals) -> None:
    """Ctrl-C ends the workers without a word of theirs; after kill -9 of the process that started them they end too."""
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
