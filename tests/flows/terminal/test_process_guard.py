"""Processes: bound to this one, they end with it; what a machine refuses them is one message."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from flows.terminal import processes
from flows.terminal.processes import KeptProcess, end_with_us, refusal_words
from tests.flows.conftest import python
from tests.soak.processes import children_of, is_alive

SLEEPS = [sys.executable, "-c", "import time; print('up', flush=True); time.sleep(60)"]
DEAF = [
    sys.executable,
    "-c",
    "import signal, time; signal.signal(15, signal.SIG_IGN); print('up', flush=True); time.sleep(5); print('over')",
]
ENDS = """
import os, signal, subprocess, sys
from flows.terminal.processes import end_with_us
child = subprocess.Popen(["sleep", "60"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
let_go = end_with_us(child.pid)
if "let go" in sys.argv:
    let_go()
print(child.pid, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


def killed_beside_a_child(*words: str) -> int:
    """Have a process killed that bound another to itself; gives the other."""
    ended = python(ENDS, *words)
    assert ended.returncode == -signal.SIGKILL
    return int(ended.stdout)


def wait_until_gone(pid: int, patience_s: float = 5.0) -> bool:
    """Whether a process ends soon."""
    end = time.monotonic() + patience_s
    while is_alive(pid) and time.monotonic() < end:
        time.sleep(0.02)
    return not is_alive(pid)


@pytest.fixture
def kept(tmp_path: Path) -> Iterator[KeptProcess]:
    """A process that sleeps."""
    process = KeptProcess(SLEEPS, tmp_path / "logs" / "kept.log", 5.0)
    yield process
    process.stop()


def held() -> tuple[int, list[int]]:
    """How many files this process has open, and its children."""
    return len(list(Path("/proc/self/fd").iterdir())), children_of(os.getpid())


def test_a_killed_process_leaves_none_behind_but_what_it_let_go_of() -> None:
    """What was bound to it ends with it; a number that was let go of may be a stranger's."""
    assert wait_until_gone(killed_beside_a_child())
    stranger = killed_beside_a_child("let go")
    try:
        assert not wait_until_gone(stranger, 0.5)
    finally:
        os.kill(stranger, signal.SIGKILL)


def test_nothing_is_held_of_what_was_let_go_of() -> None:
    """No process and no open file stays, also where the guard itself was killed."""
    before = held()
    for kill in (False, True):
        with subprocess.Popen(["sleep", "60"]) as child:
            others = set(children_of(os.getpid()))
            let_go = end_with_us(child.pid)
            child.kill()
            child.wait()
            if kill:
                (guard,) = set(children_of(os.getpid())) - others
                os.kill(guard, signal.SIGKILL)
            let_go()
    assert held() == before


def test_a_kept_process_is_started_again_and_nothing_piles_up(kept: KeptProcess) -> None:
    """Started where it does not run, after a death and on request; after the end nothing of it is there."""
    before = held()
    assert kept.keep_up()
    assert not kept.keep_up()
    once = held()
    assert len(once[1]) == len(before[1]) + 2  # it and its guard
    for pid in set(once[1]) - set(before[1]):
        os.kill(pid, signal.SIGKILL)
        wait_until_gone(pid)
    assert not kept.runs()
    assert held() == before
    assert kept.keep_up()
    kept.restart()
    kept.restart()
    assert (held()[0], len(held()[1])) == (once[0], len(once[1]))
    kept.stop()
    kept.stop()
    assert held() == before


def test_a_kept_process_is_ended_and_its_log_begun_anew(
    tmp_path: Path, kept: KeptProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What does not listen is ended all the same; what was said is kept until it is too much."""
    deaf = KeptProcess(DEAF, tmp_path / "log", 0.1)
    before = held()
    deaf.keep_up()
    while "up" not in deaf.log.read_text():
        time.sleep(0.02)
    deaf.stop()
    assert held() == before
    assert "over" not in deaf.log.read_text()
    kept.log.parent.mkdir()
    kept.log.write_text("before\n")
    kept.keep_up()
    kept.stop()
    assert kept.log.read_text().startswith("before\n")
    monkeypatch.setattr(processes, "LARGEST_LOG", 3)
    kept.keep_up()
    kept.stop()
    assert "before" not in kept.log.read_text()


ROOT = Path(__file__).parents[3]


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (MemoryError("Unable to allocate 25.3 MiB for an array"), "memory ran out: Unable to allocate 25.3 MiB"),
        (MemoryError(), "memory ran out: the machine has no more"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes."), "ask for less"),
        (RuntimeError("can't start new thread"), "memory ran out: can't start new thread"),
        (OSError(errno.EFBIG, "File too large", "/a/b"), "read or write /a/b: a file may not grow so large here"),
        (OSError(errno.ENOSPC, "No space left on device"), "the disk is full"),
        (OSError(errno.ENOENT, "No such file"), None),
        (ImportError("libx.so: failed to map segment from shared object"), None),
        (ZeroDivisionError("division by zero"), None),
    ],
)
def test_words(error: Exception, words: str | None) -> None:
    """What was refused and what to do; other errors stay what they are."""
    found = refusal_words(error)
    assert found is None if words is None else words in str(found)


@pytest.mark.parametrize(
    ("limit", "words"),
    [
        ("ulimit -v 1000000", "error: memory ran out: "),
        ("ulimit -f 100", "may not grow so large here: raise ulimit -f"),
    ],
)
def test_a_survey_within_narrow_limits(tmp_path: Path, limit: str, words: str) -> None:
    """An address space of 1 GB, files of 100 kB: one message, exit code 1, and no report of a defect."""
    survey = (
        f"{sys.executable} -m flows.cli.main survey --scene farm --size 64x64 --effects all --engine plain "
        f"--out {tmp_path / 'a'}"
    )
    command = ["sh", "-c", f"{limit}; exec {survey}"]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    errors = [line for line in ended.stderr.splitlines() if line.startswith("error: ")]
    assert (ended.returncode, len(errors)) == (1, 1), ended.stderr
    assert words in errors[0]
    assert "defect" not in ended.stderr
