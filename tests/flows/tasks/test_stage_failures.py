"""Each stage of a survey fails once, with an error or a bug: message, exit code, archive, and the next run."""

from __future__ import annotations

import io
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from spectralzoom.flows.cli.main import main
from spectralzoom.flows.publish import run_folder as publish
from spectralzoom.flows.tasks import prefect_tasks
from spectralzoom.flows.tasks.open_survey import STAGES
from spectralzoom.flows.tasks.stage import Stage, Wanted
from spectralzoom.pipeline.errors import ArchiveError, RigError
from spectralzoom.storage.store import Archive
from tests.flows.conftest import Ended, class_map, newest_run, problems

pytestmark = pytest.mark.usefixtures("no_effects")

NOT_HERE = ("register_coarse", "register_fine", "ground", "condense_raster")
OF_THIS = [name for name in STAGES if name not in NOT_HERE]  # a survey in two passes without pointing errors
NO_REPLY = "no reply from the camera after 2 s; is it on?"
BUG = "rectify"  # the stage that fails with a bug
FULL_DISK = "cannot write to the archive: no space left; make room"


def refusal(stage: str) -> RigError | ArchiveError:
    """Return the error of a device for a capture, and that of a full disk for any other stage."""
    return RigError(NO_REPLY) if stage in ("capture_coarse", "capture_fine") else ArchiveError(FULL_DISK)


def altered(stage: str, built: Callable[[], None], tried: Callable[[], None] = lambda: None) -> Stage:
    """Return the stage with one call at its start, and one when its files are written but not yet published."""
    real = STAGES[stage]

    def wants(*given: Any) -> Wanted:
        tried()
        wanted = real.wants(*given)

        def build(path: Path) -> None:
            wanted.build(path)
            built()

        return replace(wanted, build=build)

    return replace(real, wants=wants)


def failing(stage: str, error: Exception, tried: Callable[[], None] = lambda: None) -> Stage:
    """Return the stage with a failure when its files are written but not yet published."""

    def broken() -> None:
        raise error

    return altered(stage, broken, tried)


@dataclass(frozen=True)
class Trial:
    """Result of a failed stage: the end of the command, the keys of the stores, and the problems in the archive."""

    ended: Ended
    keys: frozenset[str]
    problems: list[Any]


@dataclass
class Walk:
    """Archive with a survey that was repeated until every stage had failed once, and then completed."""

    undisturbed: Path
    out: Path
    keys: dict[str, str]  # of each stage that makes a store, of the undisturbed survey
    trials: dict[str, Trial]
    builds: Counter[str]
    last: dict[str, str]  # states of the completed run


@pytest.fixture(scope="module")
def walk(
    tmp_path_factory: pytest.TempPathFactory, survey_png: Any, surveyed_png: Any, scene_files: Path, weights: Path
) -> Walk:
    """Repeat one command while each stage fails in turn, one with a bug, the others with errors; return the result."""
    folder = tmp_path_factory.mktemp("failures")
    receipt = surveyed_png(folder / "undisturbed").receipt
    keys = {stage["name"]: stage["key"] for stage in receipt["stages"] if stage["state"] == "ran"}
    found = Walk(folder / "undisturbed", folder / "archive", keys, {}, Counter(), {})
    files = ["--scene", scene_files / "scene.png", "--labels", scene_files / "labels.png", "--weights", weights]
    flags = ["--source", "sim", "--engine", "plain", "--budget", "0.8"]
    words = ["survey", *files, *flags, "--out", found.out]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tempfile, "tempdir", str(folder))
        for stage in OF_THIS:
            patch.setitem(STAGES, stage, altered(stage, partial(found.builds.update, [stage])))
        for stage in OF_THIS:
            with pytest.MonkeyPatch.context() as broken:
                broken.setitem(STAGES, stage, failing(stage, KeyError("north") if stage == BUG else refusal(stage)))
                ended = command(words)
            stores = frozenset(ref.key for ref in Archive.open(found.out).refs())
            found.trials[stage] = Trial(ended, stores, problems(found.out))
        receipt = survey_png(found.out).receipt
        found.last.update({stage["name"]: stage["state"] for stage in receipt["stages"]})
    return found


def command(words: list[Any]) -> Ended:
    """Run ``spectralzoom`` in this process."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as exit_:
        main([str(word) for word in words])
    return Ended(int(exit_.value.code or 0), out.getvalue(), err.getvalue())


@pytest.mark.parametrize("stage", OF_THIS)
def test_a_failed_stage_gives_one_message(stage: str, walk: Walk) -> None:
    """It is the error, or for a bug the file with the traceback; the archive has the stores of earlier stages."""
    before = OF_THIS[: OF_THIS.index(stage)]
    trial = walk.trials[stage]
    assert (trial.ended.code, trial.ended.out, len(trial.ended.errors)) == (1, "", 1)
    assert "Traceback" not in trial.ended.err
    assert trial.problems == []
    assert trial.keys == {walk.keys[name] for name in before if name in walk.keys}
    told, _, file = trial.ended.errors[0].partition("please report ")
    if stage == BUG:
        assert told == "KeyError: 'north'; this is a defect of SpectralZoom: "
        assert "in broken" in Path(file).read_text()
    else:
        assert told == str(refusal(stage))


def test_a_survey_completes_after_failures(walk: Walk) -> None:
    """Each store was built twice, once to fail; the last run computes only the evaluation."""
    assert walk.builds == dict.fromkeys(walk.keys, 2)
    assert {name for name, state in walk.last.items() if state == "ran"} == {"evaluate"}
    np.testing.assert_array_equal(class_map(walk.out), class_map(walk.undisturbed))
    archive = Archive.open(walk.out)
    assert {ref.key for ref in archive.refs()} == set(walk.keys.values())
    assert (len(archive.runs()), problems(walk.out)) == (1, [])
    assert not [*walk.out.rglob("*.part"), *walk.out.glob("spool/*")]


def test_a_run_without_a_quicklook_is_not_published(
    walk: Walk, tmp_path: Path, survey_png: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Quicklook and receipt follow the last stage; the next run reads every store."""
    out = Path(shutil.copytree(walk.undisturbed, tmp_path / "archive"))
    before = Archive.open(out).runs()
    with monkeypatch.context() as broken:
        broken.setattr(publish, "draw_quicklook", Mock(side_effect=ArchiveError(FULL_DISK)))
        with pytest.raises(ArchiveError, match="no space left"):
            survey_png(out)
    assert (Archive.open(out).runs(), problems(out)) == (before, [])
    assert {stage["state"] for stage in survey_png(out).receipt["stages"]} == {"cached"}
    assert (len(Archive.open(out).runs()), problems(out)) == (len(before) + 1, [])


@pytest.mark.parametrize(
    ("stage", "after", "tries"), [("capture_coarse", "choose_effects", 3), ("condense_coarse", "capture_coarse", 1)]
)
def test_a_stage_that_fails_in_prefect_has_a_failed_task(
    stage: str, after: str, tries: int, server: str, survey_png: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Task and flow are Failed with the message; a device gets three tries.

    Prefect draws an arrow to the task from its input.
    """
    tried: list[str] = []
    error = refusal(stage)
    monkeypatch.setitem(STAGES, stage, failing(stage, error, lambda: tried.append(stage)))
    monkeypatch.setattr(prefect_tasks, "RETRY_DELAY_S", 0.0)
    prefect_tasks._task.cache_clear()
    with pytest.raises(type(error), match=str(error)[:20]):
        survey_png(tmp_path, engine="prefect", **{"camera.samples": 160})
    before = OF_THIS[: OF_THIS.index(stage)]
    run, tasks = newest_run("survey", len(before) + 2)
    assert (run.name, run.state.type.value) == ("survey-scene", "FAILED")
    assert str(error) in run.state.message
    assert tasks.keys() == {f"{name}-scene" for name in ("plan_capture", *before, stage)}
    assert {tasks[f"{name}-scene"].state.type.value for name in before} == {"COMPLETED"}
    failed = tasks[f"{stage}-scene"]
    assert failed.state.type.value == "FAILED"
    assert str(error) in failed.state.message
    assert (len(tried), failed.run_count) == (tries, tries)
    assert tasks[f"{after}-scene"].id in [given.id for given in failed.task_inputs["inputs"]]
    assert problems(tmp_path) == []


def test_failed_reprocessing_resumes(server: str, walk: Walk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The flow is Failed with the reason; the next one makes the missing store and completes."""
    from spectralzoom.flows.archive.reprocess_flow import reprocess

    out = Path(shutil.copytree(walk.undisturbed, tmp_path / "archive"))
    archive = Archive.open(out)
    (missing,) = archive.refs("segment")
    archive.discard(missing.uri)
    with monkeypatch.context() as broken:
        broken.setitem(STAGES, "segment", failing("segment", refusal("segment")))
        state = reprocess(archive=str(out), return_state=True)
    run, _ = newest_run("reprocess", 0)
    assert (state.is_failed(), run.name, run.state.message) == (True, f"reprocess-{out}", state.message)
    assert "no field could be reprocessed: scene: " in state.message
    assert FULL_DISK in state.message
    assert archive.find("segment", missing.key) is None
    state = reprocess(archive=str(out), return_state=True)
    assert (state.is_completed(), problems(out)) == (True, [])
    np.testing.assert_array_equal(class_map(out), class_map(walk.undisturbed))
