"""reprocess: fields of real, tiny surveys again: cached stages, new runs, and failures."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from spectralzoom.flows.archive import reprocess_command
from spectralzoom.flows.archive.commands import verify
from spectralzoom.flows.archive.reprocess_command import run_reprocess
from spectralzoom.flows.settings.settings import Settings
from spectralzoom.flows.survey_command import run_survey
from spectralzoom.flows.terminal.processes import DONE, FAILED, PARTLY
from spectralzoom.pipeline.errors import SettingsError, WeightsError
from spectralzoom.pipeline.rig.device_settings import SurveyRig
from spectralzoom.storage.runs import Catalogue
from spectralzoom.storage.store import Archive
from tests.conftest import QUIET, Survey, WeightsMaker
from tests.flows.conftest import be_version, turned
from tests.prior_work import without_effects
from tests.storage.small_archive import flip, publish_receipt

pytestmark = pytest.mark.usefixtures("no_effects")


@pytest.fixture(scope="module")
def surveyed(tmp_path_factory: pytest.TempPathFactory, survey_png: Survey, scene_files: Path) -> Path:
    """Return an archive of two fields, scene (two budgets) and turned; do not change it."""
    folder = tmp_path_factory.mktemp("reprocessed")
    scenes = [turned(scene_files / "scene.png", folder / "turned.png"), scene_files / "scene.png"]
    with without_effects():
        for scene, budget in ((scenes[0], "0.8"), (scenes[1], "0.8"), (scenes[1], "0.7")):
            survey_png(folder / "archive", scene=str(scene), labels=None, budget=budget)
    return folder / "archive"


@pytest.fixture
def archive(surveyed: Path, tmp_path: Path) -> Path:
    """Return a copy of it."""
    return Path(shutil.copytree(surveyed, tmp_path / "archive"))


@pytest.fixture
def other(make_weights: WeightsMaker) -> Path:
    """Return weights with other classes."""
    return make_weights(names=("class_0", "class_1", "class_2", "more"))


class Reprocess:
    """Runner of the command that reads its summary."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self.capsys = capsys

    def __call__(self, archive: Path, code: int = DONE, survey: Any = None, **wishes: Any) -> list[dict[str, Any]]:
        self.capsys.readouterr()
        with pytest.MonkeyPatch.context() as patch:
            if survey is not None:
                patch.setattr(reprocess_command, "run_survey", lambda *given: SimpleNamespace(folder=survey(*given)))
            assert run_reprocess(archive, QUIET, as_json=True, **wishes) == code
        fields: list[dict[str, Any]] = json.loads(self.capsys.readouterr().out)["fields"]
        return fields

    def states(self, *words: Any, **wishes: Any) -> list[tuple[str, str]]:
        """Return field and state of each row."""
        return [(row["field"], row["state"]) for row in self(*words, **wishes)]


@pytest.fixture
def reprocess(capsys: pytest.CaptureFixture[str]) -> Reprocess:
    """Return the command in this process."""
    return Reprocess(capsys)


@pytest.mark.parametrize("changes", [{"zones": {"area": "a.geojson"}}, {"optics": {"keystone_px": 0.1}}])
def test_settings_of_another_version_are_refused(surveyed: Path, changes: dict[str, Any]) -> None:
    """None is left out in silence: an area of interest would be surveyed as a whole field."""
    (run, *_) = Catalogue.read(Archive.open(surveyed, write=False)).runs
    other = dataclasses.replace(run, receipt={**run.receipt, "settings": {**run.settings, **changes}})
    with pytest.raises(SettingsError, match=r"another version: unknown setting '(zones|optics.keystone_px)'.*anew"):
        reprocess_command.asked_again(other, surveyed, None)


def test_settings_of_a_run_are_asked_again_without_devices(surveyed: Path) -> None:
    """A run without a rig has the usual table [rig], so that a raster or simulation is not refused for it."""
    for run in Catalogue.read(Archive.open(surveyed, write=False)).runs:
        assert reprocess_command.asked_again(run, surveyed, None).rig == SurveyRig()


def _captures(archive: Path) -> list[str]:
    return [ref.uri for ref in Archive.open(archive).refs("capture")]


def test_unchanged_fields_are_skipped(surveyed: Path, reprocess: Reprocess) -> None:
    """Fields are chosen by name, pattern or scene file; an unknown name is refused; the newest run counts."""
    rows = reprocess(surveyed)
    assert [(row["field"], row["state"]) for row in rows] == [("turned", "skipped"), ("scene", "skipped")]
    assert rows[1]["old"] == Archive.open(surveyed).runs()[-1].name
    run_reprocess(surveyed, QUIET)
    assert reprocess.capsys.readouterr().out.endswith("2 runs: 2 skipped\n")
    assert len(Archive.open(surveyed).runs()) == 3
    for field in ("turned", "tur*", "turned.png"):
        assert reprocess.states(surveyed, field=field) == [("turned", "skipped")]
    for wishes, words in (
        ({"field": "none"}, r"--field none.*turned, scene"),
        ({"weights": Path("nowhere.safetensors")}, "no weights at nowhere.safetensors"),
    ):
        with pytest.raises((SettingsError, WeightsError), match=words):
            run_reprocess(surveyed, QUIET, dry_run=True, **wishes)


def test_new_weights_add_runs_and_keep_old_ones(archive: Path, other: Path, reprocess: Reprocess) -> None:
    """Coarse lines are cached, and the same command again skips all fields."""
    before = [path.name for path in Archive.open(archive).runs()]
    coarse = {run.products["raw_coarse"] for run in Catalogue.read(Archive(archive)).runs}
    rows = reprocess(archive, weights=other)
    assert [row["state"] for row in rows] == ["ran", "ran"]
    assert all(row["seconds"] > 0 for row in rows)
    after = Catalogue.read(Archive(archive)).runs
    assert [run.folder.name for run in after] == before + [row["new"] for row in rows]
    assert {run.products["raw_coarse"] for run in after} == coarse
    assert [run.settings["budget"] for run in after[3:]] == [0.8, 0.7]
    for run in after[3:]:
        states = {row["name"]: row["state"] for row in run.stages}
        assert (states["condense_coarse"], states["locate"], states["segment"]) == ("cached", "cached", "ran")
    assert reprocess.states(archive, weights=other) == [("turned", "skipped"), ("scene", "skipped")]
    assert reprocess.states(archive) == [("turned", "skipped"), ("scene", "skipped")]
    assert verify(archive) == DONE


def test_a_new_stage_version_runs_again(archive: Path, reprocess: Reprocess, monkeypatch: pytest.MonkeyPatch) -> None:
    """The stage and those after it run again; no line is captured again."""
    light = _captures(archive)
    be_version(monkeypatch, "segment", 99)
    assert reprocess.states(archive, dry_run=True) == [("turned", "would run"), ("scene", "would run")]
    assert reprocess.states(archive, field="turned") == [("turned", "ran")]
    assert reprocess.states(archive) == [("scene", "ran"), ("turned", "skipped")]
    assert _captures(archive) == light


def test_a_failed_field_does_not_stop_the_others(archive: Path, other: Path, reprocess: Reprocess) -> None:
    """Its row has the message; the exit code tells if all fields failed."""

    def picky(settings: Settings, console: Console) -> Path:
        if "turned" in settings.scene:
            raise WeightsError("these do not fit")
        return run_survey(settings, console).folder

    rows = reprocess(archive, PARTLY, survey=picky, weights=other)
    assert [(row["state"], row["message"]) for row in rows] == [("failed", "these do not fit"), ("ran", None)]
    assert reprocess.states(archive, FAILED, survey=picky, weights=other, field="turned") == [("turned", "failed")]


def test_fields_with_missing_stores_are_surveyed_again(archive: Path, reprocess: Reprocess) -> None:
    """A missing store leads to a new run; a damaged one is left to gc --damaged."""
    newest = Catalogue.read(Archive(archive)).runs[-1]
    store = archive / newest.products["class_map"].rpartition("/")[0]
    manifest = (store / "manifest.json").read_bytes()
    (store / "manifest.json").unlink()
    (row,) = reprocess(archive, FAILED, field="scene")
    assert "gc --damaged" in row["message"]
    (store / "manifest.json").write_bytes(manifest)
    shutil.rmtree(store)
    assert reprocess.states(archive) == [("turned", "skipped"), ("scene", "ran")]


@pytest.mark.parametrize(
    ("file", "words"), {"manifest.json": "settings of .* cannot be read", "receipt.json": "is gone"}.items()
)
def test_a_damaged_run_is_reported(archive: Path, reprocess: Reprocess, file: str, words: str) -> None:
    """Without its manifest the settings are unknown, without its receipt the scene; other fields are processed."""
    run = Archive.open(archive).runs()[-1]
    flip(run / file, at=40)
    rows = {row["old"]: row for row in reprocess(archive, PARTLY)}
    assert re.search(words, rows.pop(run.name)["message"])
    assert [row["state"] for row in rows.values()] == ["skipped", "skipped"]  # also the run before it


def test_fields_differ_by_scene_and_name(surveyed: Path, tmp_path: Path) -> None:
    """Each run without a scene is a field of its own; only the star is a wildcard."""
    (one, _) = reprocess_command.newest_runs(Catalogue.read(Archive(surveyed)))
    odd = dataclasses.replace(one, receipt={**one.receipt, "survey": "field[1]?.png"})
    for pattern in ("field[1]?.png", "*[1]*", "*"):
        assert reprocess_command.is_called(odd, pattern)
    for pattern in ("field1?.png", "fiel?[1]?.png", "Field*"):
        assert not reprocess_command.is_called(odd, pattern)
    archive = Archive.open(tmp_path)
    for scene in (None, None, "farm@2/seed=1", "farm@2/seed=2", "farm@2/seed=1"):
        receipt = "" if scene is None else {"survey": "farm", "scene": scene, "settings": {"seed": 1}}
        publish_receipt(archive, receipt, survey="farm")
    runs = Catalogue.read(Archive(tmp_path)).runs
    assert reprocess_command.newest_runs(Catalogue.read(Archive(tmp_path))) == [runs[n] for n in (0, 1, 3, 4)]
