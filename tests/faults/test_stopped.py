"""A survey that SIGTERM or SIGKILL stops loses no stored data, and the same command resumes it.

After a kill at a random moment, published stores verify, and the rerun completes.

A run is published once, after its evaluation; a survey that is stopped before has no run yet.
"""

from __future__ import annotations

import os
import random
import signal
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from spectralzoom.flows.terminal.processes import TERMINATED
from tests.faults.small_survey import SETTINGS, Subject, problems, stored, words, wrong_after_fault, wrong_after_rerun
from tests.receipts import comparable, receipts

GOING_ON = "terminated; run the same command to resume"
SYNCED: dict[str, Any] = {"place": "spectralzoom.storage.store:sync", "call": 60}  # before which it is stopped
PLACES = {  # function, its call before which a survey with a map is stopped, and the signal
    "in the evaluation": ("spectralzoom.flows.stages.evaluate:confusion", 1, signal.SIGTERM),
    "before the publication": ("spectralzoom.flows.publish.publishing:publish_run", 1, signal.SIGKILL),
    "in the publication": ("spectralzoom.storage.store:Archive.manifest_hashes", 2, signal.SIGKILL),
}
SECOND_PASS = {
    "spectralzoom.storage.arrays.spool:Spool.open": 2,
    "spectralzoom.storage.arrays.spool:Spool.append": 20,
}  # as PLACES
KILLS = int(os.environ.get("KILLS", "0"))  # more moments, for `make soak`
MOMENTS = (0.28, *(random.Random(0).uniform(0.05, 1.05) for _ in range(KILLS)))  # as fractions of its time


def test_a_terminated_survey_is_resumed_by_the_same_command(subject: Subject, tmp_path: Path) -> None:
    """It prints progress and one sentence, its stores verify, and the rerun completes them as undisturbed."""
    out = tmp_path / "archive"
    ended = subject.nursery.run(words(out), "end_before", number=signal.SIGTERM, **SYNCED)
    assert (ended.code, ended.text.strip().splitlines()[-1]) == (TERMINATED, GOING_ON), ended.text
    assert not any(word in ended.text for word in ("error", "defect"))
    assert problems(out) == []
    assert wrong_after_rerun(subject, out, subject.nursery.run(words(out)), runs=1) == []


# --- while the map is evaluated and published -------------------------------------------------------------------------


def asked(out: Path) -> list[str]:
    """Return the command of the survey with controls."""
    return [*words(out), "--controls"]


@pytest.fixture(scope="module")
def whole(subject: Subject) -> Any:
    """Return the receipt of the same survey without a fault."""
    assert subject.nursery.run(asked(subject.folder / "judged")).code == 0
    (receipt,) = receipts(subject.folder / "judged")
    return receipt


def test_a_survey_stopped_before_its_publication_is_resumed(subject: Subject, whole: Any, tmp_path: Path) -> None:
    """Each stop leaves whole stores and no run; the rerun publishes the undisturbed receipt, once."""
    out = tmp_path / "archive"
    for place, call, number in PLACES.values():
        ended = subject.nursery.run(asked(out), "end_before", place=place, call=call, number=number)
        assert ended.code == (TERMINATED if number == signal.SIGTERM else -number), ended.text
        assert receipts(out) == []
        assert problems(out) == []
    again = subject.nursery.run(asked(out))
    assert again.code == 0, again.text
    (receipt,) = receipts(out)
    assert comparable(receipt) == comparable(whole)
    assert list(receipt) == list(whole)
    assert problems(out) == []
    assert not [*out.rglob("*.part"), *out.glob("spool/*")]


# --- killed around the second pass, or at random moments --------------------------------------------------------------


def test_a_survey_killed_before_and_in_its_second_pass_is_resumed(subject: Subject, tmp_path: Path) -> None:
    """After both kills the first pass and the scores stay, and the rerun ends in the stores of an undisturbed one."""
    (subject.folder / "quick.toml").write_text(SETTINGS + "[cost]\nreload_s = 0\n")  # leaves time for a second pass
    out, whole = tmp_path / "archive", tmp_path / "whole"
    asked, once = ([word.replace("camera.", "quick.") for word in words(folder)] for folder in (out, whole))
    assert subject.nursery.run(once).code == 0
    for place, call in SECOND_PASS.items():
        ended = subject.nursery.run(asked, "end_before", place=place, call=call, number=signal.SIGKILL)
        stages = [uri.split("/")[1] for uri in stored(out)]
        assert (ended.code, stages.count("capture"), stages.count("score")) == (-signal.SIGKILL, 1, 1), ended.text
        assert any(file.stat().st_size > 4096 for file in out.glob("spool/*/*.lines")) == place.endswith("append")
    assert wrong_after_rerun(replace(subject, truth=stored(whole)), out, subject.nursery.run(asked), runs=1) == []


@pytest.mark.parametrize("moment", MOMENTS)
def test_a_killed_survey_is_resumed(subject: Subject, tmp_path: Path, moment: float) -> None:
    """Every store verifies after the kill, and the rerun has the bytes of an undisturbed survey."""
    child = subject.nursery.start(words(tmp_path))
    time.sleep(moment * subject.whole_s)
    child.kill()
    assert child.wait().code in (-signal.SIGKILL, 0)  # a run that is faster than the first may have ended
    assert wrong_after_fault(subject, tmp_path) == []
    assert wrong_after_rerun(subject, tmp_path, subject.nursery.run(words(tmp_path))) == []
