"""Each stage of a survey fails once, with an error or a bug: message, exit code, archive, and the next run."""

from __future__ import annotations

import io
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from functools import partial, wraps
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from spectralzoom.flows import stage as stage_module
from spectralzoom.flows.cli.main import main
from spectralzoom.flows.publish import run_folder as publish
from spectralzoom.flows.stage import Output, Stage
from spectralzoom.pipeline.errors import ArchiveError, RigError
from spectralzoom.storage.store import Archive
from tests.flows.conftest import Ended, act_instead, class_map, newest_run, problems, stages

pytestmark = pytest.mark.usefixtures("no_effects")

OF_THIS = [  # of a survey in two passes without pointing errors
    *("choose_effects", "capture_coarse", "condense_coarse", "locate", "rectify", "read_overview", "score"),
    *("capture_fine", "condense_fine", "rectify_fine", "segment", "evaluate"),
]
NO_REPLY = "no reply from the camera after 2 s; is it on?"
BUG = "rectify"  # the stage that fails with a bug
FULL_DISK = "cannot write to the archive: no space left; make room"


def refusal(stage: str) -> RigError | ArchiveError:
    """Return the error of a device for a capture, and that of a full disk for any other stage."""
    return RigError(NO_REPLY) if stage in ("capture_coarse", "capture_fine") else ArchiveError(FULL_DISK)


def altered(name: str, then: Callable[[], object]) -> Stage[Any]:
    """Return the stage with one call when its files are written but not yet published."""
    real = stages()[name]

    @wraps(real.build)
    def build(out: Output, *given: Any, **facts: Any) -> None:
        real.build(out, *given, **facts)
        then()

    return replace(real, build=build)


def broken(error: Exception) -> Callable[[], None]:
    """Return a function that raises an error."""

    def fail() -> None:
        raise error

    return fail


@dataclass
class Walk:
    """Archive with a survey that was repeated until every stage had failed once, and then completed."""

    undisturbed: Path
    out: Path
    keys: dict[str, str]  # of each stage, of the undisturbed survey
    trials: dict[str, tuple[Ended, set[str], list[str]]]  # by the stage that fails: its end, stores and problems
    builds: Counter[str]
    last: dict[str, str]  # states of the completed run


@pytest.fixture(scope="module")
def walk(
    tmp_path_factory: pytest.TempPathFactory, survey_png: Any, surveyed_png: Any, scene_files: Path, weights: Path
) -> Walk:
    """Repeat one command while each stage fails in turn, one with a bug, the others with errors; return the result."""
    folder = tmp_path_factory.mktemp("failures")
    receipt = surveyed_png(folder / "undisturbed").receipt
    keys = {stage["name"]: stage["key"] for stage in receipt["stages"]}
    found = Walk(folder / "undisturbed", folder / "archive", keys, {}, Counter(), {})
    files = ["--scene", scene_files / "scene.png", "--labels", scene_files / "labels.png", "--weights", weights]
    flags = ["--source", "sim", "--engine", "plain", "--budget", "0.8"]
    words = ["survey", *files, *flags, "--out", found.out]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tempfile, "tempdir", str(folder))
        for stage in OF_THIS:
            act_instead(patch, stage, altered(stage, partial(found.builds.update, [stage])))
        for stage in OF_THIS:
            with pytest.MonkeyPatch.context() as once:
                act_instead(once, stage, altered(stage, broken(KeyError("north") if stage == BUG else refusal(stage))))
                ended = command(words)
            stores = {ref.key for ref in Archive.open(found.out).refs()}
            found.trials[stage] = ended, stores, problems(found.out)
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
    ended, stores, damaged = walk.trials[stage]
    assert (ended.code, ended.out, len(ended.errors)) == (1, "", 1)
    assert "Traceback" not in ended.err
    assert damaged == []
    assert stores == {walk.keys[name] for name in OF_THIS[: OF_THIS.index(stage)]}
    told, _, file = ended.errors[0].partition("please report ")
    if stage == BUG:
        assert told == "KeyError: 'north'; this is a defect of SpectralZoom: "
        assert "in fail" in Path(file).read_text()
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
    with monkeypatch.context() as patch:
        patch.setattr(publish, "draw_quicklook", Mock(side_effect=ArchiveError(FULL_DISK)))
        with pytest.raises(ArchiveError, match="no space left"):
            survey_png(out)
    assert (Archive.open(out).runs(), problems(out)) == (before, [])
    assert {stage["state"] for stage in survey_png(out).receipt["stages"]} == {"cached"}
    assert (len(Archive.open(out).runs()), problems(out)) == (len(before) + 1, [])


def test_a_stage_that_fails_in_prefect_has_a_failed_task(
    server: str, survey_png: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Task and flow are Failed with the message after three tries; the task has the edge of its input."""
    stage = "capture_coarse"
    tried = Mock(side_effect=refusal(stage))
    act_instead(monkeypatch, stage, altered(stage, tried))
    monkeypatch.setattr(stage_module, "RETRY_DELAY_S", 0.0)
    stage_module._task.cache_clear()
    with pytest.raises(RigError, match=NO_REPLY[:20]):
        survey_png(tmp_path, engine="prefect", **{"camera.samples": 160})
    run, tasks = newest_run("survey", 2)
    assert (run.name, run.state.type.value) == ("survey-scene", "FAILED")
    assert tasks.keys() == {"choose_effects-scene", "capture_coarse-scene"}
    before, failed = tasks["choose_effects-scene"], tasks["capture_coarse-scene"]
    assert (before.state.type.value, failed.state.type.value) == ("COMPLETED", "FAILED")
    assert all(NO_REPLY in one.state.message for one in (run, failed))
    assert (tried.call_count, failed.run_count) == (3, 3)
    assert before.id in [given.id for given in failed.task_inputs["inputs"]]
    assert problems(tmp_path) == []


def test_failed_reprocessing_resumes(server: str, walk: Walk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The flow is Failed with the reason; the next one makes the missing store and completes."""
    from spectralzoom.flows.archive.reprocess_flow import reprocess

    out = Path(shutil.copytree(walk.undisturbed, tmp_path / "archive"))
    archive = Archive.open(out)
    (missing,) = archive.refs("segment")
    archive.discard(missing.uri)
    with monkeypatch.context() as patch:
        act_instead(patch, "segment", altered("segment", broken(refusal("segment"))))
        state = reprocess(archive=str(out), return_state=True)
    run, _ = newest_run("reprocess", 0)
    assert (state.is_failed(), run.name, run.state.message) == (True, f"reprocess-{out}", state.message)
    assert "no field could be reprocessed: scene: " in state.message
    assert FULL_DISK in state.message
    assert archive.find("segment", missing.key) is None
    state = reprocess(archive=str(out), return_state=True)
    assert (state.is_completed(), problems(out)) == (True, [])
    np.testing.assert_array_equal(class_map(out), class_map(walk.undisturbed))
