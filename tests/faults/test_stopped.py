"""Stopped by SIGTERM or SIGKILL: one sentence where it can be said, nothing lost, and the same command goes on.

Killed at random moments, what was published verifies, what was spooled is there, and the rerun goes on.

A run is published once its map is drawn; stopped while the map is judged it is there, and its accuracy is added later.
"""

from __future__ import annotations

import json
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from flows.publish.receipt import check_receipt, is_pending
from flows.terminal.processes import TERMINATED
from storage.archive.archive import Archive
from storage.arrays.spool import Spool
from storage.remote.opening import verify_archive
from tests.faults.nursery import ROOT, Ended
from tests.faults.small_survey import Subject, problems, stored, words, wrong_after_fault, wrong_after_rerun
from tests.flows.small_fields import write_field
from tests.receipts import comparable

GOING_ON = "terminated; run the same command to resume"
SYNCS = (2, 60)  # of a survey's files, before which it is stopped
TAKEN = 9  # lines of a sweep
CODES = {signal.SIGKILL: -signal.SIGKILL, signal.SIGTERM: TERMINATED}
BEGUN = ("flows.tasks.stages.accuracy:load_class_map", 1)
PLACES = {  # function and call before which a survey is stopped that has its map, and with what
    "before the map is looked at": (*BEGUN, signal.SIGTERM),
    "in the controls": ("flows.tasks.stages.accuracy:run_controls", 1, signal.SIGKILL),
    "stored and not added": ("flows.publish.publishing:extend_with_accuracy", 1, signal.SIGKILL),
    "after the run has changed": ("storage.archive.run_folders:remove_tree", 2, signal.SIGKILL),
}
ADDED = "after the run has changed"
KILLS = 3
MOMENTS = (0.28, 0.98)  # of the time it takes; those between are of runs that die again and again
PATIENCE_S = 120.0


def told(ended: Ended) -> bool:
    """Whether a command ended by SIGTERM with its one sentence, and nothing else but progress."""
    lines = ended.text.strip().splitlines()
    return (
        ended.code == TERMINATED
        and lines[-1] == GOING_ON
        and not any("error" in line or "defect" in line for line in lines)
    )


@pytest.mark.parametrize("sync", SYNCS)
def test_a_survey_that_is_terminated(subject: Subject, tmp_path: Path, sync: int) -> None:
    """What was published verifies, and the same command ends as if nothing had been."""
    out = tmp_path / "archive"
    ended = subject.nursery.run(
        words(out), "end_before", place="storage.archive.manifests:sync_path", number=signal.SIGTERM, call=sync
    )
    assert told(ended), (ended.code, ended.text)
    assert problems(out) == []
    if sync == SYNCS[1]:
        assert wrong_after_rerun(subject, out, subject.nursery.run(words(out)), runs=1) == []


def test_a_capture_keeps_every_line(subject: Subject, tmp_path: Path) -> None:
    """Lines that were there when it came are in the spool, which was closed as at any end."""
    out = tmp_path / "archive"
    ended = subject.nursery.run(
        words(out), "end_before", place="storage.arrays.spool:Spool.append", number=signal.SIGTERM, call=TAKEN + 1
    )
    assert told(ended), ended.text
    (lines,) = out.glob("spool/*/*.lines")
    facts = json.loads(lines.read_bytes().split(b"\n")[0])
    header = facts["header"]
    with Spool.open(lines.parent, facts["samples"], facts["bands"], header=header, name=lines.stem) as spool:
        assert [line.valid for block in spool.blocks() for line in block] == [True] * TAKEN


def test_training_goes_on(subject: Subject, tmp_path: Path) -> None:
    """It is broken off in a step; the same command ends well."""
    field, out = write_field(tmp_path / "field", (16, 16)), tmp_path / "w.safetensors"
    sizes = "--validation 0 --steps 4 --crop 16 --patch 8 --dim 16 --layers 1 --batch 1"
    asked = ["train", str(field), "-o", str(out), *sizes.split()]
    ended = subject.nursery.run(asked, "end_before", place="models.training.train:_step", number=signal.SIGTERM, call=2)
    assert told(ended), ended.text
    assert not out.exists()
    assert subject.nursery.run(asked).code == 0
    assert out.exists()


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


def receipts(out: Path) -> list[Any]:
    """What the runs of an archive say, oldest first."""
    return [check_receipt(json.loads((run / "receipt.json").read_text())) for run in Archive.open(out).runs()]


@pytest.fixture(scope="module")
def whole(subject: Subject) -> Any:
    """The receipt of the same survey, left alone."""
    assert subject.nursery.run(asked(subject.folder / "whole")).code == 0
    (receipt,) = receipts(subject.folder / "whole")
    return receipt


def test_the_run_is_there_before_its_map_is_judged(mapped: Path, whole: Any) -> None:
    """With all that was made and spent, and that the map is not judged yet, in the receipt and in its report."""
    (receipt,) = receipts(mapped)
    assert problems(mapped) == []
    assert is_pending(receipt)
    assert "accuracy" not in receipt
    assert [row["name"] for row in receipt["stages"]] == [row["name"] for row in whole["stages"]][:-1]
    assert whole["savings"] == receipt["savings"]
    (run,) = Archive.open(mapped).runs()
    assert "The accuracy against the labels is added later" in (run / "report.html").read_text()


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


def test_evaluate_adds_it_as_the_survey_does(subject: Subject, whole: Any, mapped: Path) -> None:
    """The receipt is the same, but for times; asked again it is left as it is."""
    out = Path(shutil.copytree(mapped, subject.folder / "later"))
    (before,) = receipts(out)
    assert is_pending(before)
    ended = subject.nursery.run(["evaluate", str(out), "latest"])
    assert ended.code == 0, ended.text
    (receipt,) = receipts(out)
    assert comparable(receipt) == comparable(whole)
    assert receipt["finished"] == before["finished"]
    assert problems(out) == []
    (run,) = Archive.open(out).runs()
    manifest = (run / "manifest.json").read_bytes()
    again = subject.nursery.run(["evaluate", str(run)])
    assert (again.code, "has its accuracy already" in again.text) == (0, True)
    assert (run / "manifest.json").read_bytes() == manifest


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


def test_killed_again_and_again(subject: Subject, tmp_path: Path) -> None:
    """Runs that are killed as soon as one store more is published each start from what the one before it left."""
    published = 0
    for _ in range(KILLS):
        child = subject.nursery.start(words(tmp_path))
        latest = time.monotonic() + PATIENCE_S
        while len(stored(tmp_path)) <= published and time.monotonic() < latest:
            time.sleep(0.01)
        child.kill()
        assert child.wait().code == -signal.SIGKILL
        assert problems(tmp_path) == []
        assert len(stored(tmp_path)) > published
        published = len(stored(tmp_path))
    assert wrong_after_rerun(subject, tmp_path, subject.nursery.run(words(tmp_path))) == []


PUBLISH = """
import sys
from storage.archive.archive import Archive
archive = Archive.open(sys.argv[1])
made = 0
for number in range(10**6):
    def build(path):
        for name in range(4):
            (path / f"{name}.bin").write_bytes(bytes([number % 251]) * 20_000)
    made += archive.produce("stage", build, version=1, params={"number": number})[1]
    if made == 1:
        print("published one", flush=True)
"""


def test_killed_while_publishing(tmp_path: Path) -> None:
    """Every store with a final name is whole, what is torn has none, and the next run makes the rest."""
    delays = random.Random(1)
    seen = 0
    for _ in range(KILLS):
        command = [sys.executable, "-c", PUBLISH, str(tmp_path)]
        with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            assert process.stdout.readline().strip() == "published one"
            time.sleep(delays.uniform(0.005, 0.06))
            process.kill()
        archive = Archive.open(tmp_path, create=False)
        findings = verify_archive(archive)
        assert [finding.problem for finding in findings if finding.problem] == []
        assert len(findings) > seen
        seen = len(findings)
    archive.reclaim()
    assert not list(tmp_path.glob("stages/*/*.part"))
