"""Repair makes broken stores and runs again, and leaves alone those that it cannot make."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from pipeline.errors import ArchiveError, SceneError
from storage.archive.archive import Archive
from storage.archive.records import read_run
from storage.maintenance.verification import Repaired, plan_repair, repair
from storage.remote.opening import verify_archive
from tests.storage.small_archive import Small, flip, make_store, settings, small_survey

VERSIONS = {"capture": 1, "rectify": 1, "segment": 1}
NOW: dict[str, Any] = {"versions": VERSIONS, "can_capture": lambda run: run.simulated, "weights_of": lambda run: "w0"}


def _bad(archive: Archive) -> list[str]:
    return [one.uri for one in verify_archive(archive) if one.problem is not None]


def _repair(archive: Archive, how: Callable[[dict[str, Any]], str] | None = None) -> Repaired:
    def again(settings: dict[str, Any]) -> str:
        return _run(small_survey(archive, seed=settings["seed"], kernel=settings["kernel"]))

    return repair(archive, verify_archive(archive), how or again, **NOW)


def _run(small: Small) -> str:
    return f"runs/{small.run.name}"


def _pictured(archive: Archive, asked: dict[str, Any], **facts: Any) -> Path:
    """Publish a run of a receipt and a picture, and return its folder."""
    with archive.new_run("farm") as draft:
        draft.write_file("receipt.json", json.dumps({"settings": asked}))
        draft.write_file("quicklook.png", b"picture")
        return draft.publish(**facts)


def _moments(archive: Archive) -> dict[str, int]:
    return {ref.uri: (ref.path / "manifest.json").stat().st_mtime_ns for ref in archive.refs()}


def test_repair_makes_only_broken_stores_again(archive: Archive) -> None:
    """The inputs and dependents of a broken store stay, and so does the other survey."""
    small = small_survey(archive)
    small_survey(archive, kernel="nearest")
    before = _moments(archive)
    flip(small.mosaic.path / "data.bin")
    done = _repair(archive)
    assert done.complete
    assert done.remade == [small.mosaic.uri]
    after = _moments(archive)
    assert {uri for uri in after if after[uri] != before[uri]} == set(done.remade)
    assert len(archive.runs()) == 2  # the repeated run is removed
    assert _bad(archive) == []


def test_two_damaged_runs_of_one_command_keep_their_names(archive: Archive) -> None:
    """A repeated survey has two runs with the same settings; each is repaired under its own name and date."""
    runs = [_pictured(archive, settings(kernel="bilinear")) for _ in range(2)]
    for run in runs:
        flip(run / "quicklook.png")
    assert _repair(archive).complete
    assert archive.runs() == runs
    for run in runs:  # its date is that of its name
        assert re.sub(r"\D", "", read_run(run).created).startswith(run.name[:8] + run.name[9:15])
    assert _bad(archive) == []


def test_a_changed_scene_file_does_not_replace_a_run(archive: Archive) -> None:
    """The scene's file was overwritten, so the repeated survey made other stores; the run stays and is reported."""
    small = small_survey(archive, named=False)
    run = _pictured(archive, settings(), rests_on=archive.manifest_hashes([small.map]))
    flip(run / "quicklook.png")
    done = _repair(archive, lambda asked: _run(small_survey(archive, seed=7)))
    assert "its scene shows something else by now" in done.failed[f"runs/{run.name}"]
    assert archive.runs() == [run]


@pytest.mark.parametrize("how", ["flip", "manifest", "lost", "gone"])
def test_broken_raw_lines_of_the_simulator_are_made_again(archive: Archive, how: str) -> None:
    """A flipped bit, a damaged or lost manifest or a lost store: both surveys that name the lines run again."""
    small = small_survey(archive)
    small_survey(archive, kernel="nearest")
    if how == "flip":
        flip(small.raw.path / "data.bin")
    elif how == "manifest":
        flip(small.raw.path / "manifest.json", at=30)
    elif how == "lost":
        (small.raw.path / "manifest.json").unlink()
    else:
        archive.discard(small.raw)
    again = Mock(side_effect=lambda settings: _run(small_survey(archive, kernel=settings["kernel"])))
    done = _repair(archive, again)
    assert done.complete
    assert sorted(call.args[0]["kernel"] for call in again.call_args_list) == ["bilinear", "nearest"]
    assert done.remade == [small.raw.uri]
    assert _bad(archive) == []


def test_damaged_raw_lines_of_a_rig_stay(archive: Archive) -> None:
    """Raw lines cannot be captured again, and their dependents stay; a broken map of them is made again."""
    small = small_survey(archive, simulated=False)
    before = _moments(archive)
    flip(small.raw.path / "data.bin")
    done = _repair(archive, lambda settings: pytest.fail("nothing to run"))
    assert not done.complete
    assert "its lines cannot be captured again" in done.plan.hopeless[small.raw.uri]
    assert _moments(archive) == before
    assert _bad(archive) == [small.raw.uri]
    flip(small.map.path / "data.bin")
    done = _repair(archive, lambda settings: _run(small_survey(archive, simulated=False)))
    assert done.remade == [small.map.uri]
    assert _bad(archive) == [small.raw.uri]


@pytest.mark.parametrize("how", ["flip", "short", "manifest", "gone", "old"])
def test_condensed_lines_whose_raw_lines_were_cleared_stay(archive: Archive, how: str) -> None:
    """They are the only copy. A broken map is made from them only if a survey finds them; nothing is captured again."""
    light = {"scene": "farm", "source": "rig"}
    asked = settings(source="rig")
    raw = make_store(archive, "capture", light, [])
    signal = make_store(archive, "condense", {}, [raw])
    drawn = make_store(archive, "segment", {}, [signal])
    products = {"raw_coarse": raw.uri, "signal_coarse": signal.uri, "class_map": f"{drawn.uri}/class_map.zarr"}
    with archive.new_run("farm") as draft:
        draft.write_file("receipt.json", json.dumps({"settings": asked, "products": products}))
        draft.publish(settings=asked, rests_on=archive.manifest_hashes([drawn]))
    archive.clear(raw)
    flip(drawn.path / "data.bin")
    if how == "gone":
        shutil.rmtree(signal.path)
    elif how == "short":
        (signal.path / "data.bin").write_bytes(b"x")
    elif how != "old":
        flip(signal.path / {"flip": "data.bin", "manifest": "manifest.json"}[how], at=30)
    before = {path: path.read_bytes() for path in (archive.root / "stages").rglob("*.*")}
    again = Mock(side_effect=lambda asked: make_store(archive, "segment", {}, [signal]) and "runs/x")
    versions: Any = {**VERSIONS, "condense": 1 + (how == "old")}
    given = NOW | {"versions": versions, "can_capture": lambda run: False}
    done = repair(archive, verify_archive(archive), again, **given)
    assert how == "old" or "its lines cannot be captured again" in done.plan.hopeless[signal.uri]
    assert done.remade == ([drawn.uri] if how == "flip" else [])
    assert again.called == (how == "flip")
    if how != "flip":
        assert drawn.uri in done.plan.hopeless
        assert before == {path: path.read_bytes() for path in (archive.root / "stages").rglob("*.*")}


@pytest.mark.parametrize("error", [SceneError("no scene farm.png; give the file"), KeyboardInterrupt()])
def test_verify_names_a_store_that_repair_could_not_make(archive: Archive, error: BaseException) -> None:
    """The scene is missing, or repair was interrupted; the same command succeeds once the cause is removed."""
    small = small_survey(archive)
    flip(small.mosaic.path / "data.bin")
    fail = Mock(side_effect=error)
    if isinstance(error, KeyboardInterrupt):
        with pytest.raises(KeyboardInterrupt):
            _repair(archive, fail)
    else:
        assert _repair(archive, fail).failed[small.mosaic.uri] == "no scene farm.png; give the file"
    assert _bad(archive) == [small.mosaic.uri]
    assert _repair(archive).remade == [small.mosaic.uri]
    assert _bad(archive) == []


def test_equal_surveys_are_run_again_once(archive: Archive) -> None:
    """Runs with the same settings count as one survey, whatever their notes and output folders are."""
    small = small_survey(archive)
    for more in ({"notes": ["dull"]}, {"out": "elsewhere"}):
        asked = {"seed": 0, "kernel": "bilinear", "source": "sim", "scene": "farm", "budget": 0.5, **more}
        archive.new_run("farm").publish(settings=asked, rests_on=archive.manifest_hashes([small.map]))
    flip(small.mosaic.path / "data.bin")
    again = Mock(return_value=_run(small))
    _repair(archive, again)
    assert [call.args[0]["kernel"] for call in again.call_args_list] == ["bilinear"]


def test_a_run_without_a_manifest_is_not_repaired(archive: Archive) -> None:
    """Without the manifest's checksums its receipt cannot be trusted; the error says to run the survey by hand."""
    small = small_survey(archive)
    (small.run / "manifest.json").unlink()
    done = _repair(archive, lambda settings: pytest.fail("nothing to run"))
    assert not done.complete
    assert "run that survey again by hand" in done.failed[f"runs/{small.run.name}"]
    assert small.run.exists()


def test_stores_of_runs_without_settings_stay(archive: Archive) -> None:
    """Repair cannot run their survey again without its settings."""
    small = small_survey(archive, named=False)
    archive.new_run("farm").publish(rests_on=archive.manifest_hashes([small.map]))
    flip(small.mosaic.path / "data.bin")
    done = _repair(archive, lambda settings: pytest.fail("nothing to run"))
    assert "cannot be read: run that survey again by hand" in done.plan.hopeless[small.mosaic.uri]
    assert _bad(archive) == [small.mosaic.uri]


def test_repair_drops_broken_stores_that_no_run_names(archive: Archive) -> None:
    """No run needs the store; the next survey that requests it makes it again."""
    small = small_survey(archive, named=False)
    flip(small.mosaic.path / "data.bin")
    done = _repair(archive, lambda settings: pytest.fail("nothing to run"))
    assert done.complete
    assert done.dropped == [small.mosaic.uri]


def test_repair_keeps_folders_of_unknown_stages(tmp_path: Path, archive: Archive) -> None:
    """A folder that people put among the stages stays, and is reported."""
    notes = tmp_path / "stages" / "mine" / "notes.txt"
    small_survey(archive)
    notes.parent.mkdir()
    notes.mkdir()
    (notes / "a.txt").write_text("mine")
    done = _repair(archive, lambda settings: pytest.fail("nothing to run"))
    assert (notes / "a.txt").read_text() == "mine"
    assert done.dropped == []
    assert "there is no stage mine" in done.plan.hopeless["stages/mine/notes.txt"]
    assert not done.complete


@pytest.mark.parametrize(
    ("store", "newer", "why"),
    [
        ("raw", {"versions": VERSIONS | {"segment": 2}}, ""),
        ("raw", {"versions": VERSIONS | {"capture": 2}}, "made by version 1 of the stage capture, which is now 2"),
        ("map", {"versions": VERSIONS | {"capture": 2}}, "made by version 1 of the stage capture, which is now 2"),
        ("map", {"can_capture": lambda run: False}, "what its runs showed is gone or shows something else by now"),
        ("map", {"weights_of": lambda run: "w1"}, "made by weights that its survey does not find any more"),
        ("mosaic", {"weights_of": lambda run: "w1"}, ""),
    ],
)
def test_repair_keeps_stores_of_outdated_keys(archive: Archive, store: str, newer: dict[str, Any], why: str) -> None:
    """Other versions, also of inputs, and other weights make stores of other keys."""
    ref = getattr(small_survey(archive), store)
    flip(ref.path / "data.bin")
    plan = plan_repair(archive, verify_archive(archive), **NOW | newer)
    assert plan.remade == (() if why else (ref.uri,))
    assert why in plan.hopeless.get(ref.uri, "")


def test_a_damaged_run_is_run_again(archive: Archive) -> None:
    """The settings come from its receipt if only a picture is damaged; a damaged receipt is not used."""
    run = _pictured(archive, {"seed": 0, "kernel": "bilinear", "source": "sim"})
    flip(run / "quicklook.png")
    done = _repair(archive)
    assert done.complete
    assert done.remade == [f"runs/{run.name}"]
    assert archive.runs() == [run]  # later visits find their prior map by this name
    assert json.loads((run / "manifest.json").read_text())["run"] == run.name
    assert _bad(archive) == []
    flip(run / "receipt.json")
    done = _repair(archive)
    assert not done.complete
    assert "run that survey again by hand" in done.failed[f"runs/{run.name}"]
    assert run.exists()


def test_repair_refuses_an_archive_in_use(archive: Archive) -> None:
    """Repair does not wait: while a survey uses the archive, no store is moved."""
    small_survey(archive)
    with archive.in_use(), pytest.raises(ArchiveError, match="is in use; run verify --repair again"):
        _repair(archive)
