"""Stopped by SIGTERM or SIGKILL: one sentence where it can be said, nothing lost, and the same command goes on.

A run is published once its map is drawn; stopped while the map is judged it is there, and its accuracy is added later.
"""

from __future__ import annotations

import json
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from flows.publish.receipt import check_receipt, comparable, is_pending
from flows.terminal.processes import TERMINATED
from storage.archive.archive import Archive
from storage.arrays.spool import Spool
from tests.faults.nursery import Ended, Nursery
from tests.faults.small_survey import Subject, prepare, problems, words, wrong_after_rerun
from tests.flows.small_fields import write_field, write_weights

GOING_ON = "terminated; the same command goes on from here"
SYNCS = (2, 30, 60, 110)  # of a survey's files, before which it is stopped
TAKEN = 20  # lines of a sweep
CODES = {signal.SIGKILL: -signal.SIGKILL, signal.SIGTERM: TERMINATED}
BEGUN = ("flows.survey.stages.accuracy:load_class_map", 1)
PLACES = {  # function and call before which a survey is stopped that has its map, and with what
    "before the map is looked at": (*BEGUN, signal.SIGTERM),
    "in the controls": ("flows.survey.stages.accuracy:run_controls", 1, signal.SIGKILL),
    "stored and not added": ("flows.publish.survey_command:add_accuracy", 1, signal.SIGKILL),
    "drawn anew": ("flows.publish.run_folder:draw_quicklook", 1, signal.SIGTERM),
    "after the run has changed": ("storage.archive.run_folders:remove_tree", 1, signal.SIGKILL),
}
ADDED = "after the run has changed"


@pytest.fixture(scope="module")
def subject(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Subject]:
    """A small survey, and where to run it."""
    with Nursery(tmp_path_factory.mktemp("stopped")) as nursery:
        yield prepare(nursery)


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
    """What was published verifies, no lock is held, and the same command ends as if nothing had been."""
    out = tmp_path / "archive"
    ended = subject.nursery.run(
        words(out), "end_before", place="storage.archive.manifests:sync_path", number=signal.SIGTERM, call=sync
    )
    assert told(ended), (ended.code, ended.text)
    assert problems(out) == []
    assert {path.name for path in (out / ".locks").glob("*")} <= {"use.lock"}
    if sync == SYNCS[1]:
        assert wrong_after_rerun(subject, out, subject.nursery.run(words(out)), runs=1) == []


def test_a_capture_keeps_every_line(subject: Subject, tmp_path: Path) -> None:
    """Lines that were there when it came are in the spool, which was closed as at any end."""
    out = tmp_path / "archive"
    ended = subject.nursery.run(
        words(out), "end_before", place="storage.arrays.spool:Spool.append", number=signal.SIGTERM, call=TAKEN + 1
    )
    assert told(ended), ended.text
    (index,) = out.glob("spool/*/*.index")
    head = json.loads(index.read_text().splitlines()[0])
    assert len(index.read_text().splitlines()) == 1 + TAKEN
    assert f"lines = {TAKEN}" in index.with_suffix(".hdr").read_text()
    with Spool.open(index.parent, head["samples"], head["bands"], header=head["header"], name=index.stem) as spool:
        assert spool.count == TAKEN


def test_training_goes_on(subject: Subject, tmp_path: Path) -> None:
    """It is broken off in a step; the same command ends well."""
    field, out = write_field(tmp_path / "field", (16, 16)), tmp_path / "w.safetensors"
    asked = [
        "train",
        str(field),
        "-o",
        str(out),
        "--validation",
        "0",
        "--steps",
        "4",
        "--crop",
        "16",
        "--patch",
        "8",
        "--factor",
        "2",
        "--dim",
        "16",
        "--layers",
        "1",
        "--batch",
        "1",
    ]
    ended = subject.nursery.run(asked, "end_before", place="models.training.train:_step", number=signal.SIGTERM, call=2)
    assert told(ended), ended.text
    assert not out.exists()
    assert subject.nursery.run(asked).code == 0
    assert out.exists()


def test_an_evaluation_goes_on(subject: Subject, tmp_path: Path) -> None:
    """Frames that were judged are kept, and not judged again."""
    field, file, out = write_field(tmp_path / "field"), tmp_path / "w.safetensors", tmp_path / "out"
    asked = [
        "evaluate",
        str(field),
        "--weights",
        str(write_weights(file)),
        "-o",
        str(out),
        "--shares",
        "0.5",
        "--policies",
        "random",
        "--timed-frames",
        "0",
        "--draws",
        "20",
        "--no-rig",
        "--no-pooled",
    ]
    place = {"place": "flows.evaluate.work:judge_frame", "number": signal.SIGTERM}
    ended = subject.nursery.run(asked, "end_before", call=3, **place)
    assert told(ended), ended.text
    again = subject.nursery.run(asked, "end_before", call=2, **place)  # one frame is left
    assert (again.code, (out / "evaluation.json").is_file()) == (0, True), again.text


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
    assert {name: one for name, one in whole["savings"].items() if name != "segment_wall_s"} == receipt["savings"]
    (run,) = Archive.open(mapped).runs()
    assert "The map is not judged yet" in (run / "report.html").read_text()


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
