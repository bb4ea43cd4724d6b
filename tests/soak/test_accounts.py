"""How a soak counts: an ending for each due time, memory that grows or does not, processes below one."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from datetime import timedelta
from pathlib import Path

from flows.schedule_state import moment_words
from storage.archive import Archive
from tests.flows.schedule_days import NOON
from tests.soak.accounts import Account, clear
from tests.soak.processes import children_of, is_alive, listener_at
from tests.soak.resident_memory import Growth, resident_bytes

DUE = [NOON + timedelta(hours=number) for number in range(4)]


def ending(event: str, number: int, **facts: object) -> dict[str, object]:
    """A line of a ledger that ends a due time."""
    return {"event": event, "at": moment_words(NOON), "due": moment_words(DUE[number]), **facts}


def test_one_ending_for_each_due_time() -> None:
    """Done, resumed and done, skipped and failed are counted, and the failed ones are named with their reasons."""
    lines: list[dict[str, object]] = [
        {"event": "begun", "due": moment_words(DUE[0])}, ending("done", 0), ending("done", 1, attempts=2),
        ending("skipped", 2, reason="too late"), ending("failed", 3, reason="the mirror went away"),
    ]  # fmt: skip
    account = Account()
    account.add("north", lines, DUE)
    assert account.words() == "4 due: 2 done, 1 skipped, 1 failed (1 done after being resumed)"
    assert account.failed == {("north", moment_words(DUE[3])): "the mirror went away"}
    assert account.failed_by("disk", "went away") == 1


def test_missing_double_and_unexplained_endings_are_wrong() -> None:
    """A due time without an ending, one with two, and one that was skipped without a reason."""
    account = Account()
    account.add("north", [ending("done", 1), ending("failed", 1, reason="x"), ending("skipped", 2)], DUE[:3])
    assert account.wrong == [
        "north 12:00:00 has 0 endings", "north 13:00:00 has 2 endings", "north 14:00:00 skipped without a reason",
    ]  # fmt: skip


def test_spools_are_left_only_by_looks_that_failed(tmp_path: Path) -> None:
    """A spool of a failed look is explained, one of a look that is done, or of none, is not."""
    archive = Archive.open(tmp_path)
    for name in ("a", "b", "c"):
        (tmp_path / "spool" / name).mkdir(parents=True)
    left = clear(archive, {(1, "first")}, {"a": (1, "first"), "b": (2, "first")})
    assert left.kept["lines under way of a failed run"] == 1
    assert left.unexplained == ["spool/b of (2, 'first')", "spool/c of None"]


def test_memory_that_grows_is_told_from_memory_that_does_not() -> None:
    """The first quarter is warming up; the last is held against the second."""
    flat = Growth.of([*range(0, 100, 10), *[100] * 30])
    rising = Growth.of([1000 + 10 * number for number in range(40)])
    assert flat.is_flat
    assert flat.share == 0.0
    assert not rising.is_flat
    assert round(rising.each, 6) == 10.0


def test_processes_below_this_one_are_found() -> None:
    """A child that listens is found by its port, and is gone when it is."""
    listens = "import socket,sys; s = socket.create_server(('127.0.0.1', 0)); print(s.getsockname()[1], flush=True)"
    with subprocess.Popen(
        [sys.executable, "-c", f"{listens}; sys.stdin.read()"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as child:
        assert child.stdout is not None
        port = int(child.stdout.readline())
        assert listener_at(port, children_of(os.getpid())) == child.pid
        assert is_alive(child.pid)
        assert resident_bytes(child.pid) > 0
        child.kill()
    assert not is_alive(child.pid)
    with socket.create_server(("127.0.0.1", 0)) as own:
        assert listener_at(own.getsockname()[1], [os.getpid()]) == os.getpid()
