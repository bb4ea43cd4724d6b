"""SIGTERM at random moments of a survey, as a service manager sends it: ``python tests/faults terminations``.

It goes to all processes of the survey's session, Prefect's server among them, as systemd ends a service. Every other
survey is told to end while its map is judged, after its run is published. Then the same command runs again.
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

from flows.publish.receipt import comparable, is_pending
from flows.terminal.termination import EXIT_CODE
from storage.archive.archive import Archive
from tests.faults.fault_table import Clock, Row
from tests.faults.small_survey import problems

ROOT = Path(__file__).resolve().parents[2]
BANDS = ",".join(str(band) for band in range(4, 268, 8))
SURVEY = ("--scene", "farm", "--size", "256x256", "--bands", BANDS, "--seed", "5", "--budget", "0.8")
GOING_ON = "terminated; the same command goes on from here"
IMPORTING_S = 0.5  # in which nothing has begun, and nobody hears
ENDS_WITHIN_S = 60.0
COUNTS = {"plain": (20, 2), "prefect": (10, 1)}  # in full and quickly


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
            f"{self.told} ended with {EXIT_CODE} and the sentence, in {self.longest_s:.1f} s at most, {self.ended} by "
            f"themselves; {self.pending} left a run to be judged; {len(self.wrong)} wrong"
            f"{': ' + '; '.join(self.wrong[:3]) if self.wrong else ''}"
        )


@dataclass(frozen=True)
class Under:
    """A survey under way, in a session of its own."""

    process: subprocess.Popen[str]

    @classmethod
    def way(cls, out: Path, engine: str) -> Under:
        """Begin it."""
        command = [sys.executable, "-m", "flows.cli.main", "survey", *SURVEY, "--engine", engine, "--out", str(out)]
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
        say = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
        return cls(subprocess.Popen(command, cwd=ROOT, env=environment, start_new_session=True, text=True, **say))

    def terminate(self) -> None:
        """Tell all of the session to end."""
        os.killpg(self.process.pid, signal.SIGTERM)

    def wait(self) -> tuple[int, str]:
        """Exit code and words, once it has ended."""
        _, said = self.process.communicate(timeout=ENDS_WITHIN_S)
        return self.process.returncode, said

    def left(self) -> list[str]:
        """Processes of the session that run on."""
        found = subprocess.run(
            ["ps", "-s", str(self.process.pid), "-o", "stat=,args="], capture_output=True, text=True, check=False
        )
        return [line for line in found.stdout.splitlines() if line.strip() and not line.startswith("Z")]


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
        survey.terminate()
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
        if (code, last) != (EXIT_CODE, [GOING_ON]) or "error" in said or "Traceback" in said:
            yield f"exit {code}, {said[-300:]}"
    yield from (f"a process is left: {one}" for one in survey.left())
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


def rows(quick: bool = False) -> list[Row]:
    found = []
    for engine, counts in COUNTS.items():
        clock, count = Clock(), counts[quick]
        with tempfile.TemporaryDirectory(prefix="terminations-") as name:
            done = terminate_surveys(Path(name), engine, count, random.Random(0))
        row = Row(
            f"SIGTERM, {engine}",
            "to all processes of a survey, at a random moment or while its map is judged",
            count,
            f"one sentence, exit {EXIT_CODE}, no process left, archive verifies, the rerun goes on and adds accuracy "
            "to the run that is there",
            done.words(),
            not done.wrong and done.told > count // 2,
            clock.seconds,
        )
        found.append(row)
    return found
