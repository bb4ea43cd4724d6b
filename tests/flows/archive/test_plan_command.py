"""The plan of a survey: it predicts the states of stages and changes nothing."""

from __future__ import annotations

import io
import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
from rich.console import Console

from spectralzoom.flows.archive.plan_command import plan_content, scan_table, show_plan
from spectralzoom.flows.opening.open_field import open_field
from spectralzoom.flows.settings.settings import Settings, load_settings
from spectralzoom.flows.survey_command import run_survey
from spectralzoom.flows.terminal.figures import format_seconds
from spectralzoom.pipeline.errors import ArchiveError, IncompleteStoreError, SettingsError
from spectralzoom.pipeline.simulator.simulated import SimulatedSource
from tests.conftest import QUIET, Flags, Survey
from tests.flows.conftest import be_version, python
from tests.prior_work import with_effects

pytestmark = pytest.mark.usefixtures("no_effects")


@pytest.fixture(scope="module")
def settings(scene_files: Path, flags_png: Flags) -> Settings:
    """Return settings of the small picture with labels; each plan names its own archive."""
    labels = str(scene_files / "labels.png")
    flags = flags_png("archive", labels=labels, engine="plain", budget="0.8")
    return load_settings(None, flags)


@pytest.fixture
def archive(surveyed_png: Survey, tmp_path: Path) -> Path:
    """Return an archive with one survey."""
    surveyed_png(tmp_path / "archive")
    return tmp_path / "archive"


def _plan(settings: Settings, out: Path, **changes: Any) -> dict[str, SimpleNamespace]:
    content = plan_content(settings.but(out=str(out), **changes))
    return {row["stage"]: SimpleNamespace(**row) for row in content["stages"]}


def _tree(root: Path) -> dict[str, tuple[int, int]]:
    return {str(path): (path.stat().st_size, path.stat().st_mtime_ns) for path in root.rglob("*")}


def test_the_survey_follows_the_plan(settings: Settings, archive: Path, survey_png: Any) -> None:
    """Cached stages are found by the survey, with the same key; the others run."""
    planned = _plan(settings, archive, resampling="nearest")
    receipt = survey_png(archive, resampling="nearest").receipt
    done = {stage["name"]: stage for stage in receipt["stages"]}
    assert list(planned) == list(done)
    for name, row in planned.items():
        assert row.key in (None, done[name]["key"]), name
        assert row.state == done[name]["state"].replace("ran", "to run"), name
    assert all(row.state == "cached" for row in _plan(settings, archive, resampling="nearest").values())


def test_a_plan_makes_no_archive(settings: Settings, tmp_path: Path) -> None:
    """All stages of two passes are to run; those that need a missing store have no key."""
    planned = _plan(settings, tmp_path / "none")
    assert not list(tmp_path.iterdir())
    assert {row.state for row in planned.values()} == {"to run"}
    assert [name for name, row in planned.items() if row.key is None] == [  # open until the patches have scores
        *("capture_fine", "condense_fine", "rectify_fine", "segment", "evaluate")
    ]
    assert {"capture_coarse", "capture_fine", "rectify_fine", "segment", "evaluate"} <= set(planned)


def test_half_of_the_stores_are_made_again_as_planned(settings: Settings, archive: Path, survey_png: Any) -> None:
    """Only missing stores are to run: what was made of them is found by its key."""
    for product in ("effects", "condense", "locate", "condense_fine", "segment"):
        shutil.rmtree(archive / "stages" / product)
    planned = _plan(settings, archive)
    with with_effects():  # as the archive was made: the stores are those that were there, to the bit
        done = {stage["name"]: stage["state"] for stage in survey_png(archive).receipt["stages"]}
    assert {name: row.state.replace("to run", "ran") for name, row in planned.items()} == done
    found = {name for name, state in done.items() if state == "cached"}
    assert found >= {"score", "rectify_fine", "evaluate"}


def test_a_plan_stops_where_the_survey_would(settings: Settings, tmp_path: Path) -> None:
    """Stages after the last one are no part of it."""
    planned = _plan(settings, tmp_path / "none", until="capture")
    assert list(planned)[-1] == "condense_fine"


def test_a_plan_changes_no_file(settings: Settings, archive: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The spool of an interrupted capture stays too, and no line is captured."""
    key = _plan(settings, archive)["capture_coarse"].key
    (archive / "spool" / str(key)).mkdir(parents=True)
    (archive / "spool" / str(key) / "lines").write_bytes(b"light")
    before = _tree(archive)
    _plan(settings, archive)
    _plan(settings, archive, seed=9)
    assert _tree(archive) == before
    monkeypatch.setattr(SimulatedSource, "lines", Mock(side_effect=AssertionError("the plan asked for light")))
    assert _plan(settings, archive, seed=9)["capture_coarse"].state == "to run"


def test_a_plan_has_only_changed_stages_to_run(
    settings: Settings, archive: Path, make_weights: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Other weights need the cleared mosaic of the first pass; a new stage version keeps the stages before it."""
    other = _plan(settings, archive, weights=str(make_weights(layers=2)))
    assert [other[name].state for name in ("locate", "rectify", "score")] == ["cached", "to run", "to run"]
    be_version(monkeypatch, "rectify_fine", 99)
    planned = _plan(settings, archive)
    assert [planned[name].state for name in ("locate", "score", "rectify_fine")] == ["cached", "cached", "to run"]


def test_a_field_beyond_memory_is_planned(settings: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The plan renders no field and no spectra, and shows the survey's refusal."""
    refuse = Mock(side_effect=AssertionError("the plan looked at the field"))
    monkeypatch.setattr("spectralzoom.pipeline.simulator.scenes.farm.farm_scene._draw", refuse)
    monkeypatch.setattr("spectralzoom.pipeline.simulator.scenes.farm.farm_scene.spectral_library", refuse)
    memory = {"SC_PAGE_SIZE": 4096, "SC_PHYS_PAGES": 2**18}
    monkeypatch.setattr("spectralzoom.storage.readers.cube_sources.os.sysconf", memory.__getitem__)
    asked = settings.but(scene="farm", size=(4096, 4096), labels=None, weights=None, out=str(tmp_path / "a"))
    found = plan_content(asked)
    assert {row["state"] for row in found["stages"]} == {"to run"}
    with pytest.raises(SettingsError, match="this machine has 1; take a smaller one") as refused:
        open_field(asked)
    assert found["refused"] == str(refused.value)
    shown = io.StringIO()
    show_plan(found, Console(file=shown, width=200))
    assert f"refused here: {refused.value}" in shown.getvalue()
    assert not list(tmp_path.iterdir())


def test_a_plan_imports_no_heavy_library() -> None:
    """Their import takes seconds, so it is deferred to their first use."""
    heavy = {"torch", "matplotlib", "xarray", "rasterio", "scipy.stats", "pandas", "prefect", "distributed"}
    code = "import sys, spectralzoom.flows.cli.main, spectralzoom.flows.archive.plan_command; print(*sys.modules)"
    assert not heavy & set(python(code).stdout.split())


def test_a_damaged_store_blocks_its_stage(settings: Settings, archive: Path, tmp_path: Path, survey_png: Any) -> None:
    """The reason is the archive's own message, with which a survey stops; a file in place of an archive is refused."""
    (path,) = archive.glob("stages/score/*/plan.json")
    path.write_text(path.read_text().replace("1", "2"))
    planned = _plan(settings, archive)
    assert (planned["score"].state, planned["segment"].state, planned["segment"].key) == ("blocked", "to run", None)
    with pytest.raises(IncompleteStoreError, match=r"plan\.json has changed.*gc --damaged") as stopped:
        survey_png(archive)
    assert planned["score"].why == str(stopped.value)
    (tmp_path / "file").write_text("no archive")
    with pytest.raises(ArchiveError, match="is a file"):
        _plan(settings, tmp_path / "file")


def test_a_raster_has_estimates(settings: Settings, tmp_path: Path) -> None:
    """Each has its source; without scan performance the mIoU is None; multiply-adds are those of the survey."""
    asked = settings.but(source="raster", budget=None, out=str(tmp_path / "archive"))
    found = plan_content(asked)["estimate"]
    assert list(found) == ["multiply_adds", "miou"]
    assert found["miou"]["value"] is None
    assert found["miou"]["known_from"] == "no scene was kept for validation when the weights were trained"
    receipt = run_survey(asked, QUIET).receipt
    assert found["multiply_adds"]["value"] == receipt["savings"]["multiply_adds"]["done"]


def test_estimates_of_a_capture_are_upper_bounds(settings: Settings, archive: Path, tmp_path: Path) -> None:
    """They hold for seconds, bytes and multiply-adds of two passes, and are exact once the fine pass is planned."""
    (folder,) = (archive / "runs").iterdir()
    receipt = json.loads((folder / "receipt.json").read_text())
    told = {
        "capture_s": receipt["savings"]["capture_s"]["done"],
        "bytes_captured": receipt["data_bytes"]["captured"],
        "multiply_adds": receipt["savings"]["multiply_adds"]["done"],
    }
    ahead = plan_content(settings.but(out=str(tmp_path / "new")))["estimate"]
    planned = plan_content(settings.but(out=str(archive)))["estimate"]
    for name, value in told.items():
        assert ahead[name]["at_most"]
        assert value <= ahead[name]["value"] * (1 + 1e-9), name
        assert (planned[name]["value"], planned[name]["at_most"]) == (pytest.approx(value), False), name
    shown = io.StringIO()
    show_plan(plan_content(settings.but(out=str(tmp_path / "new"))), Console(file=shown, width=160))
    assert "Estimates: nothing of this has run" in shown.getvalue()
    assert f"at most {format_seconds(ahead['capture_s']['value'])}" in shown.getvalue()


def test_a_zoomed_farm_may_take_every_line_and_read_every_patch(tmp_path: Path) -> None:
    """With short exposures 8 s suffice for all lines in the second pass; patches are an expectation."""
    farm = {"scene": "farm", "size": "160x128", "zoom": "always", "seconds": "8", "out": str(tmp_path)}
    found = plan_content(load_settings(None, farm))
    captured, work = found["estimate"]["bytes_captured"], found["estimate"]["multiply_adds"]
    assert captured["at_most"]
    assert captured["value"] == pytest.approx(found["scans"]["candidates"][-1]["bytes_raw"], rel=0.03)
    assert not work["at_most"]
    assert work["known_from"].endswith("million with every patch")
    show_plan(found, Console(file=(shown := io.StringIO()), width=160))
    assert "cheapest near the best" in shown.getvalue()  # not the reference, which is every line at 100 ms


@pytest.mark.parametrize(("seconds", "taken"), [("27", True), ("14", False)])
def test_a_plan_shows_two_passes_beside_uniform_scans(tmp_path: Path, seconds: str, taken: bool) -> None:
    """Their expected mIoU is a lower bound, also if the planner takes a uniform scan; they need more multiply-adds."""
    wide = {"scene": "farm", "size": "640x512", "camera.samples": "80", "out": str(tmp_path), "seconds": seconds}
    found = plan_content(load_settings(None, wide))
    zoomed = found["scans"]["two_passes"]
    assert (zoomed["taken"], zoomed["miou"] == found["estimate"]["miou"]) == (taken, taken)
    assert zoomed["miou"]["at_least"]
    assert zoomed["multiply_adds"]["value"] > found["scans"]["candidates"][0]["multiply_adds"] > 0
    show_plan(found, Console(file=(shown := io.StringIO()), width=160))
    for mark in ("this survey, two passes", "best uniform scan in this time"):
        assert (mark in shown.getvalue()) == taken
    Console(file=shown, width=160).print(scan_table(found["scans"] | {"at_most": True}))
    assert ["at most 9" in one for one in shown.getvalue().split("mIoU, about")[1:]] == [False, True]


def test_a_partial_scan_has_no_expected_miou_and_reads_captured_patches(settings: Settings, tmp_path: Path) -> None:
    """Other patches keep the prior map, and scan performance does not cover their accuracy."""
    one_scan = {"budget": None, "scan_step": 1, "out": str(tmp_path)}
    whole, part = (plan_content(settings.but(extent=one, **one_scan))["estimate"] for one in ("whole", "0:0-20"))
    assert part["multiply_adds"]["value"] < 0.5 * whole["multiply_adds"]["value"]
    assert part["miou"]["value"] is None
    assert "a part of the field" in part["miou"]["known_from"]
