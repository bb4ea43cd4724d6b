"""`spectralzoom serve` on Prefect every minute while other processes take the machine: one process a due time, soon.

What each due time came to the ledgers say; how many flow runs it had, and which began, Prefect's server.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from datetime import timedelta
from pathlib import Path
from typing import Any

from flows.schedule.field_schedule import read_moment
from storage.archive.ledger import ledgers
from tests.faults.fault_table import Clock, Row
from tests.soak.prefect_schedule import free_port, serving

EVERY_S, FIELDS = 60, ("north",)
SERVED_S, QUICK_S = 17 * 60.0, 5 * 60.0
BURNERS = 6
LATEST_S = 30.0  # half of the interval: what begins later is skipped by rule
LEAST_DONE = 0.5


def rows(quick: bool) -> list[Row]:
    """Serve beside the load, ask Prefect what it ran, stop, and read the ledgers."""
    clock, served_s = Clock(), QUICK_S if quick else SERVED_S
    with tempfile.TemporaryDirectory(prefix="soak-loaded-") as name, burning(BURNERS):
        folder, port = Path(name), free_port()
        with serving(folder, port, EVERY_S, FIELDS) as process:
            end = time.monotonic() + served_s
            while time.monotonic() < end and process.poll() is None:
                time.sleep(5.0)
            runs = flow_runs(folder / "archive" / ".prefect" / "password", port)
            process.terminate()
            process.wait(120.0)
        lines = [line for ledger in ledgers(folder / "archive") for line in ledger.lines()]
    return judged(lines, runs, clock.seconds)


@contextmanager
def burning(number: int) -> Iterator[None]:
    """Have so many processes that never rest."""
    with ExitStack() as held:
        for _ in range(number):
            process = subprocess.Popen([sys.executable, "-c", "while True: pass"])
            held.callback(process.wait)
            held.callback(process.kill)
        yield


def flow_runs(password: Path, port: int) -> list[dict[str, Any]]:
    """All flow runs that the server knows."""
    import httpx

    user, _, word = password.read_text().strip().partition(":")
    answer = httpx.post(
        f"http://127.0.0.1:{port}/api/flow_runs/filter", json={"limit": 200}, auth=(user, word), timeout=60.0
    )
    return [dict(run) for run in answer.raise_for_status().json()]


def judged(lines: list[dict[str, Any]], runs: list[dict[str, Any]], seconds: float) -> list[Row]:
    """A row for each demand, and whether it was met."""
    ended = Counter(line["event"] for line in lines if line["event"] in ("done", "skipped", "failed"))
    delays = [
        (at - due).total_seconds()
        for line in lines
        if line["event"] == "begun" and (at := read_moment(line["at"])) and (due := read_moment(line["due"]))
    ]
    asked = Counter(run["parameters"].get("due") for run in runs)
    twice = [due for due, count in asked.items() if count > 1]
    skipped = {line["due"] for line in lines if line["event"] == "skipped"}
    started = [run for run in runs if run["parameters"].get("due") in skipped and late_start(run)]
    how = f"every {EVERY_S} s beside {BURNERS} processes that never rest"
    due = sum(ended.values())
    half = len(delays) // 2
    trend = f"{_mean(delays[:half]):.1f} s in the first half, {_mean(delays[half:]):.1f} s in the second"
    return [
        Row(
            "a loaded machine",
            how,
            due,
            f"at least {LEAST_DONE:.0%} of the due runs done, none failed",
            ", ".join(f"{count} {name}" for name, count in ended.items()),
            due > 0 and ended["done"] >= LEAST_DONE * due and not ended["failed"],
            seconds,
        ),
        Row("asked once", "flow runs of a due time", len(asked), "one", f"{len(twice)} had more", not twice, 0.0),
        Row(
            "nothing in vain",
            "processes started for what was skipped before",
            len(skipped),
            "none",
            str(len(started)),
            not started,
            0.0,
        ),
        Row(
            "delay",
            "from due to begun",
            len(delays),
            f"at most {LATEST_S:.0f} s, not growing",
            f"at most {max(delays, default=0.0):.1f} s; {trend}",
            max(delays, default=0.0) <= LATEST_S and _mean(delays[half:]) <= _mean(delays[:half]) + 5.0,
            0.0,
        ),
    ]


def late_start(run: dict[str, Any]) -> bool:
    """Whether a flow run's process began after its due time was over by rule."""
    due, began = read_moment(run["parameters"]["due"]), read_moment(run.get("start_time"))
    in_vain = run["state_type"] != "CANCELLED" or (run.get("total_run_time") or 0.0) > 0.0
    return due is not None and began is not None and in_vain and began > due + timedelta(seconds=LATEST_S + 15.0)


def _mean(values: list[float]) -> float:
    return sum(values) / len(values) if values else 0.0
