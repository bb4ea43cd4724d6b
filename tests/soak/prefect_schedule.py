"""`spectralzoom serve` on Prefect's own scheduler for ten minutes, every 30 s, with the server killed in the midst.

`serve` is a process of its own with a server of its own. What became of every due time the ledgers say.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any

from flows.schedule.field_schedule import FieldSchedule, read_moment
from flows.schedule.times import parse_timetable
from storage.archive.archive import Archive
from storage.archive.ledger import Ledger, ledgers
from storage.archive.records import read_run
from tests.faults.fault_table import Clock, Row
from tests.faults.nursery import ROOT
from tests.flows.schedule.schedule_days import HandClock
from tests.soak.accounts import Account, problems_of
from tests.soak.processes import children_of, is_alive, listener_at, words_of
from tests.soak.resident_memory import MB, Growth, resident_bytes

EVERY_S = 30
TIMETABLE = parse_timetable(None, f"{EVERY_S}s", "UTC")
FIELDS = ("north", "south")
SERVED_S, QUICK_S = 600.0, 180.0
KILLED_AT = 0.4  # of the time
EARLY = 0.2  # of the time: when memory is looked at first
LOOK_S = 5.0
LONGEST_GAP_S = 180.0  # without a done run: the server's death, the watcher's look, the start of server and runner
BEGUN_WITHIN_S, ENDED_WITHIN_S = 180.0, 60.0
SETTINGS = """name = "{name}"
scene = "farm"
seed = {seed}
size = "64x64"
bands = [40, 90, 150, 200]
effects = "none"
budget = 0.8
controls = false
"""


@dataclass
class Watched:
    """What was seen of the processes: resident memory [bytes] by seconds served."""

    serve: dict[float, int] = field(default_factory=dict)
    server: dict[float, int] = field(default_factory=dict)
    others: set[int] = field(default_factory=set)  # every process seen below serve
    killed: int | None = None
    away_s: float | None = None  # until another server listened
    back: datetime | None = None  # when it did
    code: int | None = None  # of serve


def rows(quick: bool) -> list[Row]:
    """Serve, kill the server, stop, and look at ledgers and archive."""
    clock, served_s = Clock(), QUICK_S if quick else SERVED_S
    with tempfile.TemporaryDirectory(prefix="soak-serve-") as name:
        folder, port = Path(name), free_port()
        with serving(folder, port) as process:
            watched = watch(process, port, folder / "archive", served_s)
        time.sleep(1.0)
        left = sorted(filter(None, (words_of(pid) for pid in watched.others if is_alive(pid))))
        archive = Archive.open(folder / "archive")
        served = account_of(archive.root, watched.back)
        found = judged(watched, served, (left, problems_of(archive)), clock.seconds, quick=quick)
        return [*found, remembered(archive)]


def free_port() -> int:
    """A port of this machine that nothing listens at."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


@contextmanager
def serving(
    folder: Path, port: int, every_s: int = EVERY_S, fields: Sequence[str] = FIELDS
) -> Iterator[subprocess.Popen[bytes]]:
    """Have `serve` run while the block does, with nothing of Prefect's from around it; killed where it still runs."""
    files = []
    for seed, name in enumerate(fields, 1):
        files.append(folder / f"{name}.toml")
        files[-1].write_text(SETTINGS.format(name=name, seed=seed))
    words = [sys.executable, "-m", "flows.cli.main", "serve", *map(str, files), "--every", f"{every_s}s"]
    words += ["--limit", str(len(fields)), "--out", str(folder / "archive"), "--port", str(port)]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    process = subprocess.Popen(words, cwd=ROOT, env=environment, stdin=subprocess.DEVNULL, stdout=sys.stderr)
    try:
        yield process
    finally:
        below = children_of(process.pid)
        if process.poll() is None:
            process.kill()
            process.wait()
            for pid in filter(is_alive, below):
                os.kill(pid, signal.SIGKILL)


def watch(process: subprocess.Popen[bytes], port: int, archive: Path, served_s: float) -> Watched:
    """Look at the processes until they have served for so long; kill the server on the way; then stop with SIGTERM."""
    seen, end = Watched(), time.monotonic() + BEGUN_WITHIN_S
    while not any(one.lines() for one in ledgers(archive)):
        if process.poll() is not None or time.monotonic() > end:
            raise RuntimeError(f"serve did not begin (exit code {process.poll()})")
        time.sleep(0.2)
    began, died = time.monotonic(), 0.0
    while (now_s := time.monotonic() - began) < served_s and process.poll() is None:
        below = children_of(process.pid)
        seen.others.update(below)
        server = listener_at(port, below)
        seen.serve[now_s] = resident_bytes(process.pid)
        if server is not None:
            seen.server[now_s] = resident_bytes(server)
        if seen.killed is None and now_s > KILLED_AT * served_s and server is not None:
            os.kill(server, signal.SIGKILL)
            seen.killed, died = server, now_s
            print(f"  {now_s:.0f} s: the server, process {server}, is killed", file=sys.stderr, flush=True)
        elif seen.killed is not None and seen.away_s is None and server not in (None, seen.killed):
            seen.away_s, seen.back = now_s - died, datetime.now(UTC)
        time.sleep(LOOK_S)
    process.terminate()
    seen.code = process.wait(ENDED_WITHIN_S)
    return seen


@dataclass
class Served:
    """What the ledgers say of the time that was served."""

    account: Account = field(default_factory=Account)
    under_way: int = 0  # runs at the stop
    gap_s: float = 0.0  # the longest time without a done run of a field
    after: dict[str, int] = field(default_factory=dict)  # done runs of each field that began with the other server


def account_of(root: Path, back: datetime | None) -> Served:
    """Look at the ledgers; ``back`` is when another server listened, None where none did.

    A run that was under way is ended as the next `serve` would end it that comes after its next due time.
    """
    found = Served()
    account = found.account
    for ledger in ledgers(root):
        lines = ledger.lines()
        opened = next(moment for line in lines if line["event"] == "opened" and (moment := read_moment(line["at"])))
        closed = [moment for line in lines if line["event"] == "closed" and (moment := read_moment(line["at"]))]
        if not closed:
            account.wrong.append(f"{ledger.field} was not closed")
            continue
        found.under_way += _reap(root, ledger.field, closed[-1])
        lines = ledger.lines()
        account.add(ledger.field, lines, TIMETABLE.due_between(opened, closed[-1]))
        done = [moment for line in lines if line["event"] == "done" and (moment := read_moment(line["at"]))]
        gaps = [(later - one).total_seconds() for one, later in pairwise([opened, *done, closed[-1]])]
        found.gap_s = max(found.gap_s, *gaps)
        found.after[ledger.field] = done_since(lines, back)
    return found


def done_since(lines: Sequence[Mapping[str, Any]], back: datetime | None) -> int:
    """How many of the runs of a ledger that began after a moment are done; none where there is no such moment."""
    if back is None:
        return 0
    begun = {line["due"] for line in lines if line["event"] == "begun" and (read_moment(line["at"]) or back) > back}
    return sum(line["event"] == "done" and line["due"] in begun for line in lines)


def _reap(root: Path, name: str, closed: datetime) -> int:
    later = HandClock(closed + timedelta(seconds=2 * EVERY_S))
    schedule = FieldSchedule(Ledger(root, name), TIMETABLE, 0.5, later)
    count = len(schedule.state().open)
    schedule.reap()
    return count


def judged(
    seen: Watched, served: Served, after: tuple[list[str], list[str]], seconds: float, *, quick: bool
) -> list[Row]:
    """A row for each demand, and whether it was met."""
    account, (left, problems) = served.account, after
    grown = Growth.of(list(seen.serve.values()))
    early = max(seen.serve) * EARLY
    memory = "; ".join(
        f"{name} {_at(values, early) / MB:.0f} MB at {early / 60:.1f} min, {_at(values, 1e9) / MB:.0f} at the end"
        for name, values in (("serve", seen.serve), ("server", seen.server))
    )
    away = "none came" if seen.away_s is None else f"another listens after {seen.away_s:.0f} s"
    return [
        Row(
            "Prefect's scheduler",
            f"{len(FIELDS)} fields every {EVERY_S} s for {max(seen.serve) / 60:.0f} min",
            account.due,
            "each due run done, skipped by rule, or failed with a reason; of each field one done at the "
            f"latest {LONGEST_GAP_S:.0f} s after the last",
            f"{account.words()}; {served.under_way} under way at the stop; longest time without a done one "
            f"{served.gap_s:.0f} s",
            not account.wrong and account.endings["done"] > 0 and served.gap_s <= LONGEST_GAP_S,
            seconds,
        ),
        Row(
            "server killed",
            "SIGKILL of the Prefect server",
            int(seen.killed is not None),
            "started again, and runs that begin then are done",
            f"{away}; done since: {', '.join(f'{count} {name}' for name, count in served.after.items())}",
            seen.away_s is not None and sum(served.after.values()) > 0,
            0.0,
        ),
        Row(
            "stopped",
            "SIGTERM",
            1,
            "exit code 0, no process left",
            f"exit code {seen.code}, {len(left)} processes left{': ' + left[0][:80] if left else ''}",
            seen.code == 0 and not left,
            0.0,
        ),
        Row(
            "the archive",
            "verify",
            1,
            "whole",
            f"{len(problems)} problems{': ' + problems[0] if problems else ''}",
            not problems,
            0.0,
        ),
        Row(
            "memory of serve",
            f"resident, every {LOOK_S:g} s",
            len(seen.serve),
            "not judged: too short" if quick else "last quarter within 5 % of the second",
            f"{memory}; serve: {grown.words()}",
            quick or grown.is_flat,
            0.0,
        ),
    ]


def remembered(archive: Archive) -> Row:
    """How many runs went on from an earlier one of their field, which served surveys do unless they are told not to."""
    runs = [read_run(folder, {}) for folder in archive.runs()]
    memories = [memory for run in runs if (memory := run.receipt.get("memory")) is not None]
    aside = sum(memory["put_aside"] is not None for memory in memories)
    first = len({run.receipt.get("survey") for run in runs})
    return Row(
        "memories",
        "published runs that go on from an earlier one",
        len(runs),
        "all but the first of each field, none put aside",
        f"{len(memories)} do, {first} are first looks, {aside} put theirs aside",
        len(memories) == len(runs) - first > 0 and not aside,
        0.0,
    )


def _at(values: dict[float, int], moment: float) -> int:
    """The value seen nearest to a moment; 0 where nothing was seen."""
    return values[min(values, key=lambda one: abs(one - moment))] if values else 0
