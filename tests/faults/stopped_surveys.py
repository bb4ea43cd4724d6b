"""Surveys ended at random moments, run again, and what the archive says: ``python tests/faults kills terminations``.

SIGKILL: after every kill each published store must verify and none published before may be gone; what a run that ends
leaves must be what an undisturbed one leaves, byte by byte. A run that ended is followed by one in a new archive.

SIGTERM goes to all processes of the survey's session, Prefect's server among them, as systemd ends a service. Every
other survey is told to end while its map is judged, after its run is published. Then the same command runs again.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from flows.publish.receipt import is_pending
from flows.terminal.processes import TERMINATED
from storage.archive.archive import Archive
from tests.faults.fault_table import Clock, Row, reported_wrong
from tests.faults.nursery import ROOT
from tests.faults.small_survey import problems, stored
from tests.receipts import comparable

BANDS = ",".join(str(band) for band in range(4, 268, 8))
SURVEY = f"survey --scene farm --size 256x256 --bands {BANDS} --seed 5 --budget 0.8 --keep raw"
GOING_ON = "terminated; run the same command to resume"
IMPORTING_S = 0.5  # in which nothing has begun, and nobody hears
ENDS_WITHIN_S = 60.0
KILLS = (100, 3)  # in full and quickly
COUNTS = {"plain": (20, 2), "prefect": (10, 1)}


@dataclass(frozen=True)
class Under:
    """A survey under way, in a session of its own."""

    process: subprocess.Popen[str]

    @classmethod
    def way(cls, out: Path, engine: str, *more: str) -> Under:
        """Begin it."""
        command = [
            sys.executable,
            "-m",
            "flows.cli.main",
            *SURVEY.split(),
            "--engine",
            engine,
            "--out",
            str(out),
            *more,
        ]
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
        say = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
        return cls(subprocess.Popen(command, cwd=ROOT, env=environment, start_new_session=True, text=True, **say))

    def wait(self) -> tuple[int, str]:
        """Exit code and words, once it has ended."""
        _, said = self.process.communicate(timeout=ENDS_WITHIN_S)
        return self.process.returncode, said


def kill_surveys(folder: Path, kills: int, rng: random.Random) -> tuple[int, list[str]]:
    """Kill surveys in a folder; how many archives were brought to an end, and what was lost or wrong."""

    def survey(out: Path) -> Under:
        return Under.way(out, "plain", "--no-controls")

    def other(now: dict[str, Any]) -> list[str]:
        return [f"{uri} is other than undisturbed" for uri, files in now.items() if truth.get(uri) != files]

    began = time.monotonic()
    assert survey(folder / "undisturbed").wait()[0] == 0, "the undisturbed survey failed"
    whole_s = time.monotonic() - began
    truth, wrong, ended, archive, before = (
        stored(folder / "undisturbed"),
        list[str](),
        0,
        folder / "0",
        dict[str, Any](),
    )
    for kill in range(kills):
        under = survey(archive)
        time.sleep(rng.uniform(IMPORTING_S, 1.05 * whole_s))
        under.process.kill()
        finished = under.wait()[0] == 0
        now = stored(archive)
        wrong += [*problems(archive), *other(now), *(f"{uri} was lost" for uri in set(before) - set(now))]
        before = now
        if finished or kill == kills - 1:
            assert survey(archive).wait()[0] == 0, "the survey does not go on"
            last = stored(archive)
            wrong += [*other(last), *(f"{uri} was not made" for uri in set(truth) - set(last))]
            ended, archive, before = ended + 1, folder / str(ended + 1), {}
    return ended, wrong


def kill_rows(quick: bool = False) -> list[Row]:
    clock, count = Clock(), KILLS[quick]
    with tempfile.TemporaryDirectory(prefix="kills-") as name:
        ended, wrong = kill_surveys(Path(name), count, random.Random(0))
    injected = "SIGKILL at random moments of a survey of 256 x 256 px and 33 bands"
    demanded = "archive verifies, nothing published is lost, rerun bit-identical"
    found = f"{ended} archives brought to an end; {reported_wrong(wrong)}"
    return [Row("survey killed", injected, count, demanded, found, not wrong, clock.seconds)]


@dataclass
class Terminations:
    """What came of them."""

    told: int = 0  # the sentence and its exit code
    ended: int = 0  # by itself, before
    pending: int = 0  # left a run that was not judged yet
    longest_s: float = 0.0  # from the signal to the end
    wrong: list[str] = field(default_factory=list)

    def words(self) -> str:
        """The figures."""
        return (
            f"{self.told} ended with {TERMINATED} and the sentence, in {self.longest_s:.1f} s at most, {self.ended} by "
            f"themselves; {self.pending} left a run to be judged; {reported_wrong(self.wrong)}"
        )


def terminate_surveys(folder: Path, engine: str, count: int, rng: random.Random) -> Terminations:
    """Terminate ``count`` surveys, each in an archive of its own, and run each again."""
    found, began = Terminations(), time.monotonic()
    whole = Under.way(folder / "undisturbed", engine)
    assert whole.wait()[0] == 0, "the undisturbed survey failed"
    seconds = time.monotonic() - began
    truth = _receipts(folder / "undisturbed")[0]
    for number in range(count):
        out = folder / f"{number}"
        found.wrong += [f"{number}: {one}" for one in _terminate(out, engine, number, seconds, truth, found, rng)]
        shutil.rmtree(out, ignore_errors=True)
    return found


def _terminate(
    out: Path, engine: str, number: int, seconds: float, truth: Any, found: Terminations, rng: random.Random
) -> Iterator[str]:
    """Terminate one survey and run it again; gives what is not as it should be."""
    survey = Under.way(out, engine)
    _wait(survey, out, rng.uniform(IMPORTING_S, seconds) if number % 2 else None)
    told = time.monotonic()
    try:
        os.killpg(survey.process.pid, signal.SIGTERM)
        code, said = survey.wait()
    except (ProcessLookupError, subprocess.TimeoutExpired) as error:
        survey.process.kill()
        yield f"it did not end as told: {type(error).__name__}"
        return
    found.ended += code == 0
    if code != 0:
        found.told += 1
        found.longest_s = max(found.longest_s, time.monotonic() - told)
        last = said.strip().splitlines()[-1:]
        if (code, last) != (TERMINATED, [GOING_ON]) or "error" in said or "Traceback" in said:
            yield f"exit {code}, {said[-300:]}"
    command = ["ps", "-s", str(survey.process.pid), "-o", "stat=,args="]
    left = subprocess.run(command, capture_output=True, text=True, check=False).stdout.splitlines()
    yield from (f"a process is left: {one}" for one in left if one.strip() and not one.startswith("Z"))
    yield from problems(out)
    before = _receipts(out)
    found.pending += any(map(is_pending, before))
    again = Under.way(out, engine).wait()
    if again[0] != 0:
        yield f"the same command ended with {again[0]}: {again[1][-300:]}"
    after = _receipts(out)
    if len(after) != (2 if code == 0 else 1) or any(comparable(one) != comparable(truth) for one in after):
        yield f"{len(after)} runs, not as undisturbed"
    yield from problems(out)


def _wait(survey: Under, out: Path, delay: float | None) -> None:
    """Wait for a while; without one, until a run is published, and a little."""
    until = time.monotonic() + (ENDS_WITHIN_S if delay is None else delay)
    while time.monotonic() < until and survey.process.poll() is None:
        if delay is None and list((out / "runs").glob("*/manifest.json")):
            time.sleep(0.1)
            return
        time.sleep(0.02)


def _receipts(out: Path) -> list[Any]:
    """What the runs of an archive say; none where there is no archive yet."""
    if not (out / "stages").is_dir():
        return []
    return [json.loads((run / "receipt.json").read_text()) for run in Archive.open(out).runs()]


def termination_rows(quick: bool = False) -> list[Row]:
    found = []
    injected = "to all processes of a survey, at a random moment or while its map is judged"
    demanded = (
        f"one sentence, exit {TERMINATED}, no process left, archive verifies, the rerun goes on and adds accuracy to "
        "the run that is there"
    )
    for engine, counts in COUNTS.items():
        clock, count = Clock(), counts[quick]
        with tempfile.TemporaryDirectory(prefix="terminations-") as name:
            done = terminate_surveys(Path(name), engine, count, random.Random(0))
        met = not done.wrong and done.told > count // 2
        found.append(Row(f"SIGTERM, {engine}", injected, count, demanded, done.words(), met, clock.seconds))
    return found
