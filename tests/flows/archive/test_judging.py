"""The accuracy of a map: added after its run is published, later by `evaluate ARCHIVE RUN`, or left out."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from flows.archive.reprocess_command import run_reprocess
from flows.publish.receipt import is_pending
from flows.tasks.open_survey import STAGES
from flows.tasks.stages import accuracy as evaluation
from models.weights.files import save_weights
from storage.archive.archive import Archive
from tests.conftest import QUIET, RGB_NM, Survey, random_weights
from tests.flows.conftest import CommandLine, act_instead, be_version, problems, turned
from tests.receipts import comparable, receipts
from tests.storage.small_archive import flip

pytestmark = pytest.mark.usefixtures("no_effects")

ONE_SCAN = {"budget": None, "scan_step": "2"}
Refuse = Callable[[Path, Path, pytest.MonkeyPatch], None]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of scene, labels and weights, as receipts name it."""
    return tmp_path_factory.mktemp("files")


@pytest.fixture
def scene(folder: Path, scene_files: Path, weights: Path) -> Path:
    """Return the folder with its original files."""
    return lay_files(folder, scene_files, weights)


def lay_files(folder: Path, scene_files: Path, weights: Path) -> Path:
    """Copy scene, labels and weights into a folder, over existing files, and return the folder."""
    for path in (scene_files / "scene.png", scene_files / "labels.png"):
        shutil.copy(path, folder)
    shutil.copy(weights, folder / "w.safetensors")
    return folder


def words_of(folder: Path) -> dict[str, str]:
    """Return the settings of a survey."""
    files = {"scene": "scene.png", "labels": "labels.png", "weights": "w.safetensors"}
    return {name: str(folder / file) for name, file in files.items()}


@pytest.fixture
def survey(survey_png: Any, scene: Path, out: Path) -> Survey:
    """Return a function that surveys the scene of the folder, by one scan, into the archive of the test."""
    return lambda **flags: survey_png(out, **{**words_of(scene), **ONE_SCAN, **flags})


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """Return the archive of the test."""
    return tmp_path / "archive"


@pytest.fixture(scope="module")
def surveyed(survey_png: Any, folder: Path, scene_files: Path, weights: Path) -> Path:
    """Return the archive of a survey that left out its accuracy; do not change it."""
    survey_png(folder / "archive", **words_of(lay_files(folder, scene_files, weights)), accuracy=False)
    return folder / "archive"


@pytest.fixture
def unjudged(surveyed: Path, scene: Path, out: Path) -> Path:
    """Return a copy of it."""
    return Path(shutil.copytree(surveyed, out))


def break_off(survey: Survey, monkeypatch: pytest.MonkeyPatch, **flags: Any) -> None:
    """Survey, and interrupt it when the map is about to be judged."""
    with monkeypatch.context() as patch:
        patch.setattr(evaluation, "load_class_map", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            survey(**flags)


def test_a_run_is_published_before_it_is_judged(survey: Survey, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """During the evaluation the run is valid and its accuracy pending; afterwards the same run has it."""
    real = STAGES["evaluate"]
    seen: list[Any] = []

    def looking(*given: Any) -> Any:
        wanted = real.wants(*given)

        def building(path: Path) -> None:
            seen.append((Archive.open(out).runs(), *receipts(out)))
            assert problems(out) == []
            wanted.build(path)

        return replace(wanted, build=building)

    act_instead(monkeypatch, "evaluate", looking)
    published = survey()
    ((folders, receipt),) = seen
    assert folders == [published.folder]
    assert is_pending(receipt)
    assert receipt["savings"] == published.receipt["savings"]
    assert receipt["finished"] == published.receipt["finished"] <= published.receipt["judged"]
    assert published.receipt["accuracy_is"] == "judged"
    assert receipts(out) == [published.receipt]


def test_reprocess_judges_runs_of_stopped_surveys(survey: Survey, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It judges the existing run and makes no other."""
    break_off(survey, monkeypatch)
    for _ in range(2):
        assert run_reprocess(out, QUIET) == 0
        (receipt,) = receipts(out)
        assert receipt["accuracy_is"] == "judged"
    assert problems(out) == []


def test_a_run_under_evaluation_is_not_judged_twice(
    survey: Survey, out: Path, monkeypatch: pytest.MonkeyPatch, command_line: CommandLine
) -> None:
    """The same survey publishes another run, and `evaluate` reports the other process."""
    break_off(survey, monkeypatch)
    archive = Archive.open(out)
    (run,) = archive.runs()
    with archive.extend_run(run.name):
        ended = command_line("evaluate", out, run.name)
        assert ended.errors == [f"runs/{run.name} is being judged by another process; it adds the accuracy"]
        survey()
    assert [is_pending(one) for one in receipts(out)] == [True, False]


def test_evaluate_adds_accuracy_and_controls(unjudged: Path, survey: Survey, command_line: CommandLine) -> None:
    """The receipt then equals that of a survey with both."""
    (run,) = Archive.open(unjudged).runs()
    ended = command_line("evaluate", unjudged, run.name, "--json")
    assert (ended.code, ended.errors) == (0, [])
    (receipt,) = receipts(unjudged)
    assert json.loads(ended.out) == receipt
    assert receipt["settings"]["accuracy"]
    assert "none" not in receipt["accuracy"]
    assert command_line("evaluate", run, "--controls").code == 0
    (receipt,) = receipts(unjudged)
    assert {"none", "all"} <= {*receipt["accuracy"]}
    assert Archive.open(unjudged).runs() == [run]
    assert problems(unjudged) == []
    asked = survey(controls=True, budget="0.8", scan_step=None).receipt
    assert comparable(receipt) == comparable(asked)


def test_labels_may_come_later(
    survey: Survey, scene: Path, out: Path, command_line: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run without labels is judged with the given ones, and records their absolute path."""
    survey(labels=None)
    monkeypatch.chdir(scene)
    command_line("evaluate", out, "latest").refused(1, "there are no labels to judge runs/.* by; give --labels FILE")
    assert command_line("evaluate", out, "latest", "--labels", "labels.png").code == 0
    (receipt,) = receipts(out)
    assert receipt["accuracy_is"] == "judged"
    assert receipt["settings"]["labels"] == str(scene / "labels.png")
    assert comparable(receipt)["accuracy"] == survey().receipt["accuracy"]


def _mosaic_gone(scene: Path, out: Path, patch: pytest.MonkeyPatch) -> None:
    archive = Archive.open(out)
    archive.discard(archive.refs("rectify")[0])


REFUSED: dict[str, tuple[Refuse, str]] = {
    "another scene": (
        lambda scene, *_: turned(scene / "scene.png", scene / "scene.png"),
        "is not the one that runs/.* captured; restore it",
    ),
    "no scene": (lambda scene, *_: (scene / "scene.png").unlink(), "there is no file .*scene.png"),
    "a damaged receipt": (
        lambda scene, out, patch: flip(Archive.open(out).runs()[0] / "receipt.json"),
        "receipt.json has changed .*; run verify --repair",
    ),
    "a store that is gone": (_mosaic_gone, "the mosaic of runs/.* is missing or damaged; run verify --repair"),
    "an older version": (
        lambda scene, out, patch: be_version(patch, "segment", 99),
        r"version \d+ of the stage segment, which is now 99: `spectralzoom reprocess .*` makes a new run",
    ),
    "other weights": (
        lambda scene, *_: save_weights(random_weights(RGB_NM, dim=32), scene / "w.safetensors"),
        "w.safetensors are not those of the map of runs/.*; restore those",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_runs_that_cannot_be_judged_are_refused(
    case: str, unjudged: Path, scene: Path, command_line: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There is one message, and the run is unchanged."""
    spoil, message = REFUSED[case]
    spoil(scene, unjudged, monkeypatch)
    (run,) = Archive.open(unjudged).runs()
    before = (run / "manifest.json").read_bytes()
    command_line("evaluate", unjudged, run.name).refused(1, message)
    assert (run / "manifest.json").read_bytes() == before
    assert Archive.open(unjudged).runs() == [run]


WORDS = {
    "a data set without weights": (2, "farm", "give --weights FILE to judge weights on this data set, or a run"),
    "an archive without a run": (2, "ARCHIVE", "such as evaluate .*archive latest, to judge its map"),
    "a run with weights": (2, "ARCHIVE latest --weights w.safetensors", "--weights is for weights that are judged"),
    "a run by shares": (2, "ARCHIVE latest --fractions 0.1", "--fractions is for weights that are judged on a data"),
    "a run with a folder": (2, "ARCHIVE latest -o out", "--out is for weights"),
    "weights with controls": (2, "farm --weights w --controls", "--controls is for a run of an archive"),
    "no such run": (2, "ARCHIVE 2020-gone", "has no run '2020-gone'; its latest are "),
}


@pytest.mark.parametrize("case", WORDS)
def test_flags_of_the_other_form_are_refused(case: str, surveyed: Path, command_line: CommandLine) -> None:
    """One message names the form that takes the flag, or the existing runs."""
    code, words, message = WORDS[case]
    command_line("evaluate", *words.replace("ARCHIVE", str(surveyed)).split()).refused(code, message)
