"""Surveys killed at random moments and run again: ``python tests/soak kills``.

After every kill each published store must verify and none published before may be gone; what a run that ends leaves
must be what an undisturbed one leaves, byte by byte. A run that ended is followed by one in a new archive.
"""

from __future__ import annotations

import os
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.faults.fault_table import Clock, Row, reported_wrong
from tests.faults.nursery import ROOT
from tests.faults.small_survey import Stored, problems, stored

BANDS = ",".join(str(band) for band in range(4, 268, 8))
SURVEY = f"survey --scene farm --size 256x256 --bands {BANDS} --seed 5 --budget 0.8 --keep raw --no-controls"
IMPORTING_S = 0.5  # in which nothing has begun
ENDS_WITHIN_S = 60.0
KILLS = (100, 3)  # in full and quickly


def survey(out: Path) -> subprocess.Popen[bytes]:
    """Begin a survey in a process and a session of its own."""
    command = [sys.executable, "-m", "flows.cli.main", *SURVEY.split(), "--engine", "plain", "--out", str(out)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    return subprocess.Popen(command, cwd=ROOT, env=environment, start_new_session=True, **quiet)


def kill_surveys(folder: Path, kills: int, rng: random.Random) -> tuple[int, list[str]]:
    """Kill surveys in a folder; how many archives were brought to an end, and what was lost or wrong."""
    began = time.monotonic()
    assert survey(folder / "undisturbed").wait(ENDS_WITHIN_S) == 0, "the undisturbed survey failed"
    whole_s, truth = time.monotonic() - began, stored(folder / "undisturbed")
    wrong, ended, archive, before = list[str](), 0, folder / "0", Stored()
    for kill in range(kills):
        process = survey(archive)
        time.sleep(rng.uniform(IMPORTING_S, 1.05 * whole_s))
        process.kill()
        finished, now = process.wait() == 0, stored(archive)
        wrong += [*problems(archive), *other(now, truth), *(f"{uri} was lost" for uri in set(before) - set(now))]
        before = now
        if finished or kill == kills - 1:
            assert survey(archive).wait(ENDS_WITHIN_S) == 0, "the survey does not go on"
            last = stored(archive)
            wrong += [*other(last, truth), *(f"{uri} was not made" for uri in set(truth) - set(last))]
            ended, archive, before = ended + 1, folder / str(ended + 1), {}
    return ended, wrong


def other(now: Stored, truth: Stored) -> list[str]:
    """What is stored with other bytes than undisturbed."""
    return [f"{uri} is other than undisturbed" for uri, files in now.items() if truth.get(uri) != files]


def rows(quick: bool = False) -> list[Row]:
    clock, count = Clock(), KILLS[quick]
    with tempfile.TemporaryDirectory(prefix="kills-") as name:
        ended, wrong = kill_surveys(Path(name), count, random.Random(0))
    injected = "SIGKILL at random moments of a survey of 256 x 256 px and 33 bands"
    demanded = "archive verifies, nothing published is lost, rerun bit-identical"
    found = f"{ended} archives brought to an end; {reported_wrong(wrong)}"
    return [Row("survey killed", injected, count, demanded, found, not wrong, clock.seconds)]
