"""How a soak counts: an ending for each due time, memory that grows or does not, processes below one."""

from __future__ import annotations

import os
import random
import socket
import subprocess
import sys
from collections import Counter, defaultdict
from datetime import timedelta
from pathlib import Path
from typing import cast

import pytest

from flows.schedule.field_schedule import moment_words
from storage.archive.archive import Archive
from tests.flows.schedule.schedule_days import NOON
from tests.soak.accounts import Account, Leftovers, clear
from tests.soak.day_of_surveys import Day
from tests.soak.day_of_surveys import judged as judge_day
from tests.soak.prefect_schedule import Served, Watched, done_since
from tests.soak.prefect_schedule import judged as judge_schedule
from tests.soak.processes import children_of, is_alive, listener_at
from tests.soak.resident_memory import Growth, resident_bytes
from tests.soak.serving import Serving

DUE = [NOON + timedelta(hours=number) for number in range(4)]


def ending(event: str, number: int, **facts: object) -> dict[str, object]:
    """A line of a ledger that ends a due time."""
    return {"event": event, "at": moment_words(NOON), "due": moment_words(DUE[number]), **facts}


def test_one_ending_for_each_due_time() -> None:
    """Done, resumed and done, skipped and failed are counted, and the failed ones are named with their reasons."""
    lines: list[dict[str, object]] = [
        {"event": "begun", "due": moment_words(DUE[0])},
        ending("done", 0),
        ending("done", 1, attempts=2),
        ending("skipped", 2, reason="too late"),
        ending("failed", 3, reason="the mirror went away"),
    ]
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
        "north 12:00:00 has 0 endings",
        "north 13:00:00 has 2 endings",
        "north 14:00:00 skipped without a reason",
    ]


def test_an_ending_of_what_was_never_due_is_wrong() -> None:
    """A due time that the timetable does not have, and one that cannot be read."""
    account = Account()
    account.add("north", [ending("done", 0), ending("done", 3), ending("skipped", 1, due="then", reason="x")], DUE[:1])
    assert account.wrong == [
        "north 2026-06-01T15:00:00Z done, which was never due",
        "north then skipped, which was never due",
    ]


def test_what_became_of_the_run_that_trouble_struck() -> None:
    """Begun again is said of that due time only, and a reason must name the device that was pulled."""
    lines = [
        ending("done", 0, attempts=2),
        ending("failed", 1, attempts=1, reason="its process was gone"),
        ending("failed", 2, attempts=2, reason="/rig/mirror went away"),
        ending("skipped", 3, reason="too late"),
    ]
    account = Account()
    account.add("north", lines, DUE)
    assert [account.begun_again("north", due) for due in DUE] == [True, False, True, False]
    assert not account.begun_again("south", DUE[0])
    assert [account.names("north", due, "/mirror", ["went away"]) for due in DUE] == [False, False, True, False]
    assert not account.names("north", DUE[2], "127.0.0.1:", ["went away"])
    assert not account.names("north", DUE[2], "/mirror", ["no answer"])


def struck_day(tmp_path: Path, **struck: list[int]) -> Day:
    """A day on which trouble struck the runs of these due times."""
    runs = {trouble: [("north", DUE[number]) for number in numbers] for trouble, numbers in struck.items()}
    plan = dict(enumerate(trouble for trouble, numbers in runs.items() for _ in numbers))
    return Day(cast(Serving, None), tmp_path, random.Random(0), plan, samples=[1] * 4, struck=defaultdict(list, runs))


@pytest.mark.parametrize(
    ("lines", "missed"),
    [
        (
            [
                ending("done", 0, attempts=2),
                ending("failed", 1, reason="/rig/mirror went away"),
                ending("failed", 2, reason="no connection to 127.0.0.1:5000 within 3 s"),
            ],
            [],
        ),
        (
            [
                ending("failed", 0, reason="its process was gone"),
                ending("failed", 1, reason="/rig/mirror went away"),
                ending("failed", 2, reason="127.0.0.1:5000 hung up"),
            ],
            [],
        ),
        (
            [
                ending("done", 0, attempts=1),
                ending("failed", 1, reason="/rig/mirror went away"),
                ending("failed", 2, reason="127.0.0.1:5000 hung up"),
            ],
            ["kills"],
        ),
        (
            [
                ending("done", 0, attempts=2),
                ending("failed", 1, reason="/rig/mirror went away"),
                ending("failed", 2, reason="/rig/mirror went away"),
            ],
            ["pulled cables"],
        ),
        (
            [ending("done", 0, attempts=2), ending("done", 1), ending("failed", 2, reason="127.0.0.1:5000 hung up")],
            ["pulled cables"],
        ),
    ],
)
def test_a_day_is_judged_by_the_runs_that_trouble_struck(
    tmp_path: Path, lines: list[dict[str, object]], missed: list[str]
) -> None:
    """What other runs came to makes up for none of them, and one device not for the other."""
    account = Account()
    account.add("north", [*lines, ending("done", 3, attempts=2)], DUE)
    day = struck_day(tmp_path, kill=[0], mirror=[1], camera=[2])
    left = Leftovers(Counter(), Counter(), [])
    assert [row.fault for row in judge_day(day, account, left, ([], []), 0.0, quick=True) if not row.met] == missed


def test_a_run_done_after_the_server_came_back_began_after_it() -> None:
    """A run that began before and ends later says nothing of the other server, nor does one that was skipped."""
    begun = [{**ending("begun", number), "at": moment_words(DUE[number])} for number in range(3)]
    lines = [*begun, *(ending("done", number) for number in range(2)), ending("failed", 2), ending("skipped", 3)]
    assert [done_since(lines, moment) for moment in (None, NOON - timedelta(hours=1), *DUE[:2])] == [0, 2, 1, 0]


@pytest.mark.parametrize(("done", "gap_s", "met"), [(20, 170.0, [True, True]), (1, 570.0, [False, False])])
def test_a_schedule_that_stands_still_is_not_met(done: int, gap_s: float, met: list[bool]) -> None:
    """One done run and nineteen skipped are endings for all, but no serving: the gap and the time after count."""
    account = Account(due=20, endings=Counter(done=done, skipped=20 - done))
    served = Served(account, 0, gap_s, {"north": done - 1, "south": done - 1})
    seen = Watched({150.0 * number: 1 for number in range(5)}, {0.0: 1}, killed=1, away_s=20.0, back=NOON, code=0)
    rows = judge_schedule(seen, served, ([], []), 0.0, quick=True)
    assert [row.met for row in rows if row.fault in ("Prefect's scheduler", "server killed")] == met


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
