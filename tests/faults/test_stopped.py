"""Stopped by SIGTERM or SIGKILL: one sentence where it can be said, nothing lost, and the same command goes on.

Killed at random moments, what was published verifies, what was spooled is there, and the rerun goes on.

A run is published once its map is drawn; stopped while the map is judged it is there, and its accuracy is added later.
"""

from __future__ import annotations

import os
import random
import shutil
import signal
import time
from pathlib import Path
from typing import Any

import pytest

from flows.publish.receipt import is_pending
from flows.terminal.processes import TERMINATED
from tests.faults.nursery import Ended
from tests.faults.small_survey import Subject, problems, stored, words, wrong_after_fault, wrong_after_rerun
from tests.receipts import comparable, receipts

GOING_ON = "terminated; run the same command to resume"
SYNC = 60  # of a survey's files, before which it is stopped
CODES = {signal.SIGKILL: -signal.SIGKILL, signal.SIGTERM: TERMINATED}
BEGUN = ("flows.tasks.stages.accuracy:load_class_map", 1)
PLACES = {  # function and call before which a survey is stopped that has its map, and with what
    "before the map is looked at": (*BEGUN, signal.SIGTERM),
    "in the controls": ("flows.tasks.stages.accuracy:run_controls", 1, signal.SIGKILL),
    "stored and not added": ("flows.publish.publishing:extend_with_accuracy", 1, signal.SIGKILL),
    "after the run has changed": ("storage.archive.run_folders:remove_tree", 2, signal.SIGKILL),
}
ADDED = "after the run has changed"
KILLS = int(os.environ.get("KILLS", "0"))  # at more moments, by `make soak`
MOMENTS = (0.28, 0.98, *(random.Random(0).uniform(0.05, 1.05) for _ in range(KILLS)))  # of the time it takes


def told(ended: Ended) -> bool:
    """Whether a command ended by SIGTERM with its one sentence, and nothing else but progress."""
    lines = ended.text.strip().splitlines()
    return (
        ended.code == TERMINATED
        and lines[-1] == GOING_ON
        and not any("error" in line or "defect" in line for line in lines)
    )


def test_a_survey_that_is_terminated(subject: Subject, tmp_path: Path) -> None:
    """What was published verifies, and the same command ends as if nothing had been."""
    out = tmp_path / "archive"
    ended = subject.nursery.run(
        words(out), "end_before", place="storage.archive.manifests:sync_path", number=signal.SIGTERM, call=SYNC
    )
    assert told(ended), (ended.code, ended.text)
    assert problems(out) == []
    assert wrong_after_rerun(subject, out, subject.nursery.run(words(out)), runs=1) == []


# --- while the map is judged ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def mapped(subject: Subject) -> Path:
    """The archive of a survey that was killed when it began to judge its map."""
    out = subject.folder / "mapped"
    ended = stopped(subject, out, *BEGUN, signal.SIGKILL)
    assert ended.code == -signal.SIGKILL, ended.text
    return out


def asked(out: Path) -> list[str]:
    """The survey, with controls."""
    return [word for word in words(out) if word != "--no-controls"]


def stopped(subject: Subject, out: Path, place: str, call: int, number: int) -> Ended:
    """The survey, stopped."""
    return subject.nursery.run(asked(out), "end_before", place=place, call=call, number=number)


@pytest.fixture(scope="module")
def whole(subject: Subject) -> Any:
    """The receipt of the same survey, left alone."""
    assert subject.nursery.run(asked(subject.folder / "whole")).code == 0
    (receipt,) = receipts(subject.folder / "whole")
    return receipt


@pytest.mark.parametrize("place", PLACES)
def test_its_accuracy_is_added(subject: Subject, whole: Any, mapped: Path, tmp_path: Path, place: str) -> None:
    """Stopped again anywhere, it verifies and is as it was or has it; then it says what an undisturbed one says."""
    out, (name, call, number) = tmp_path / "archive", PLACES[place]
    shutil.copytree(mapped, out)
    (first,) = receipts(out)
    ended = stopped(subject, out, name, call, number)
    assert ended.code == CODES[number], ended.text
    (before,) = receipts(out)
    assert problems(out) == []
    assert is_pending(before) == (place != ADDED) == ("accuracy" not in before)
    again = subject.nursery.run(asked(out))
    assert again.code == 0, again.text
    found = receipts(out)
    assert len(found) == (2 if place == ADDED else 1)  # a survey of which nothing is missing is a run of its own
    for receipt in found:
        assert comparable(receipt) == comparable(whole)
        assert list(receipt) == list(whole)
    assert found[0]["finished"] == first["finished"]
    assert problems(out) == []
    assert not [*out.rglob("*.part"), *out.glob("spool/*")]


# --- killed at random moments -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("moment", MOMENTS)
def test_killed_survey_goes_on(subject: Subject, tmp_path: Path, moment: float) -> None:
    """Killed at any moment: every store verifies; the same command ends with the bytes of an undisturbed run."""
    child = subject.nursery.start(words(tmp_path))
    time.sleep(moment * subject.whole_s)
    child.kill()
    assert child.wait().code in (-signal.SIGKILL, 0)  # a faster run than the first may have ended before
    before = stored(tmp_path)
    assert wrong_after_fault(subject, tmp_path) == []
    assert wrong_after_rerun(subject, tmp_path, subject.nursery.run(words(tmp_path))) == []
    assert set(before) <= set(stored(tmp_path))
