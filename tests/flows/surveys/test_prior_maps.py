"""Surveys with prior maps: their choice, their rejection when they do not fit, and their storage."""

from __future__ import annotations

import io
import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
import xarray as xr
from affine import Affine
from PIL import Image
from rich.console import Console

import spectralzoom.flows.opening.prior_maps as memory
from spectralzoom.flows.archive.reprocess_command import run_reprocess
from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.models.network.sizes import TemporalSizes
from spectralzoom.models.network.temporal_reader import TemporalReader
from spectralzoom.models.weights.files import add_reader, load_weights
from spectralzoom.pipeline.errors import SettingsError, WeightsError
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.storage.runs import read_run
from spectralzoom.storage.store import Archive
from tests.conftest import CLASSES, QUIET, Survey, WeightsMaker, patchy_scene
from tests.flows.conftest import problems
from tests.prior_work import without_effects
from tests.storage.readers.test_label_grids import write

pytestmark = pytest.mark.usefixtures("no_effects")

RASTER: dict[str, Any] = {"budget": None, "source": "raster", "name": "north", "accuracy": False}
FIRST, LATER = "2026-06-01T10:00:00Z", "2026-06-04T10:00:00Z"


@pytest.fixture(scope="module")
def twice(tmp_path_factory: pytest.TempPathFactory, survey_png: Survey) -> tuple[Path, Any, Any]:
    """Return an archive with two visits to one field, three days apart, and both runs; do not change it."""
    out = tmp_path_factory.mktemp("twice") / "archive"
    with without_effects():
        first = survey_png(out, **RASTER, visit=FIRST, prior="latest")
        return out, first, survey_png(out, **RASTER, visit=LATER, prior="latest")


@pytest.fixture
def visited(twice: tuple[Path, Any, Any], tmp_path: Path) -> Path:
    """Return a copy of that archive."""
    return Path(shutil.copytree(twice[0], tmp_path / "archive"))


def words_of(out: Path, survey_png: Survey, **flags: Any) -> tuple[str, Any]:
    """Return the terminal output of a survey, joined into one line, and the run."""
    text = io.StringIO()
    published = survey_png(out, console=Console(file=text, width=400), **{**RASTER, **flags})
    return " ".join(text.getvalue().split()), published


def test_a_first_visit_has_no_prior_map(twice: tuple[Path, Any, Any]) -> None:
    """With `latest` and no earlier visit a note says so; the stored class probabilities have age 0 and no changes."""
    out, first, _ = twice
    assert "prior_map" not in first.receipt
    assert first.receipt["settings"]["prior"] == "none"
    assert "north has no prior map: the archive has no earlier visit" in first.receipt["settings"]["notes"]
    probabilities = xr.open_zarr(out / first.receipt["products"]["class_probabilities"], consolidated=False)
    assert float(probabilities.age.max()) == 0.0
    assert "changed_from" not in probabilities
    drawn = xr.open_zarr(out / first.receipt["products"]["class_map"], consolidated=False).classes.values
    agree = np.nan_to_num(probabilities.log_probability.values, nan=-9).argmax(axis=-1) == drawn
    assert agree.mean() > 0.95  # except for classes closer than one step, which these weights often give


def test_a_later_visit_uses_the_one_before_as_prior_map(twice: tuple[Path, Any, Any]) -> None:
    """Receipt, page and manifest name the earlier run; its age is the days between the visits."""
    out, first, later = twice
    memory = later.receipt["prior_map"]
    assert (memory["run"], memory["days"]) == (first.folder.name, 3.0)
    assert later.receipt["settings"]["prior"] == first.folder.name
    assert memory["agreement"] > 0.9  # it is the same picture
    page = (later.folder / "report.html").read_text(encoding="utf-8")
    assert first.folder.name in page
    assert "3.0 days earlier" in page
    assert "Captured and differing" in page
    store = out / later.receipt["products"]["class_probabilities"]
    manifest = json.loads((store.parent / "manifest.json").read_text())
    assert Path(first.receipt["products"]["class_probabilities"]).parent.as_posix() in manifest["inputs"]
    probabilities = xr.open_zarr(store, consolidated=False)
    assert probabilities.changed_from.shape == (96, 128)


def test_a_survey_uses_no_prior_map_by_default(visited: Path, survey_png: Survey) -> None:
    """Its map is that of a first visit, so the stage is cached."""
    receipt = survey_png(visited, **RASTER, visit=LATER).receipt
    assert "prior_map" not in receipt
    assert "cached" in [stage["state"] for stage in receipt["stages"] if stage["name"] == "segment"]


@pytest.mark.parametrize(
    ("visit", "named", "before", "days"),
    [
        ("2026-06-02T22:00:00Z", False, 1, 1.5),  # captured before the later visit, but entered after it
        ("2026-06-04T12:00:00+02:00", False, 2, 0.0),  # at the same moment as the other
        ("2026-06-09T10:00:00Z", True, 1, 8.0),
        ("2026-06-03T00:00:00Z", False, 1, 38 / 24),
        ("2026-06-04", False, 2, 0.0),  # a date alone means the day and not its midnight
    ],
)
def test_the_prior_map_is_the_last_before_the_visit_or_the_named_one(
    twice: tuple[Path, Any, Any], visit: str, named: bool, before: int, days: float
) -> None:
    """The name of a missing run ends in one message."""
    run = twice[before].folder.name
    assert found_prior(twice[0], visit, run if named else "latest") == (run, days)
    with pytest.raises(SettingsError, match=r"--prior nobody: there is no such run in the archive; give another run"):
        found_prior(twice[0], visit, "nobody")


def test_a_run_captured_after_the_visit_is_refused(twice: tuple[Path, Any, Any]) -> None:
    """Plants do not shrink: a map of a later day would give away the field's future."""
    with pytest.raises(SettingsError, match=r"it was captured 2 days after this visit; give another run, latest or"):
        found_prior(twice[0], "2026-06-02", twice[2].folder.name)


def found_prior(out: Path, visit: str, prior: str) -> tuple[str, float] | None:
    """Return name and age in days of the prior map that a visit to north uses."""
    settings = load_settings(None, {"prior": prior, "visit": visit})
    scene: Any = Mock(key="scene", geobox=None)
    found, _ = memory.find_prior(Archive.open(out), settings, "north", SceneGrid(96, 128, 8), CLASSES, scene)
    return found and (found.run, found.days)


def test_a_changed_file_of_the_same_path_is_another_visit(survey_png: Survey, tmp_path: Path) -> None:
    """All settings are equal; a file that is surveyed again is not the prior map of itself."""
    flags: dict[str, Any] = {**RASTER, "scene": str(tmp_path / "week.png"), "labels": None, "prior": "latest"}
    for seed, earlier in ((1, False), (2, True), (2, True)):
        Image.fromarray(patchy_scene((96, 128), 3, seed=seed)[0].astype(np.uint8)).save(tmp_path / "week.png")
        _, published = words_of(tmp_path / "archive", survey_png, **flags)
        assert ("prior_map" in published.receipt) == earlier


def test_a_map_of_another_size_is_no_prior_map(visited: Path, survey_png: Survey, tmp_path: Path) -> None:
    """The field has the same name; a note says why, and the survey runs as a first visit."""
    Image.fromarray(patchy_scene((64, 96), 3, seed=1)[0].astype(np.uint8)).save(tmp_path / "small.png")
    flags = {"scene": str(tmp_path / "small.png"), "labels": None, "visit": "2026-06-07T10:00:00Z", "prior": "latest"}
    words, published = words_of(visited, survey_png, **flags)
    assert "cannot be the prior map: it has another grid than this field: 128 x 96 px and not 96 x 64" in words
    assert "north has no prior map" in words
    assert "prior_map" not in published.receipt


@pytest.mark.parametrize(
    ("east_m", "epsg", "why"),
    [
        (0.0, 32632, None),
        (0.1, 32632, None),  # rounded coordinates
        (40.0, 32632, "it has another grid than this field: its corner lies 4 px away"),
        (0.0, 32633, "it has another grid than this field: another coordinate system, pixel size or direction"),
    ],
)
def test_a_map_of_another_place_is_no_prior_map(
    visited: Path, survey_png: Survey, tmp_path: Path, east_m: float, epsg: int, why: str | None
) -> None:
    """Tiles of one mosaic look alike, so the coordinates in their files decide."""
    for name, east, code in (("here", 0.0, 32632), ("there", east_m, epsg)):
        values = patchy_scene((96, 128), 3, seed=1)[0].astype(np.uint8)
        write(tmp_path / f"{name}.tif", values, Affine(10.0, 0, 4e5 + east, 0, -10.0, 5e6), code, photometric="RGB")
    flags = {"labels": None, "name": "tile", "prior": "latest"}
    survey_png(visited, **{**RASTER, **flags}, scene=str(tmp_path / "here.tif"), visit=FIRST)
    words, run = words_of(visited, survey_png, **flags, scene=str(tmp_path / "there.tif"), visit=LATER)
    assert ("prior_map" in run.receipt) == (why is None)
    assert why is None or why in words


def test_cleared_prior_maps_are_skipped(visited: Path, twice: Any, survey_png: Survey) -> None:
    """The visit before is used instead; if none is left, the survey runs as a first visit. A note reports either."""
    _, first, later = twice
    shutil.rmtree((visited / later.receipt["products"]["class_probabilities"]).parent)
    words, published = words_of(visited, survey_png, visit="2026-06-07T10:00:00Z", prior="latest")
    assert f"{later.folder.name} cannot be the prior map: its stores were cleared" in words
    assert published.receipt["prior_map"]["run"] == first.folder.name
    shutil.rmtree((visited / first.receipt["products"]["class_probabilities"]).parent)
    shutil.rmtree((visited / published.receipt["products"]["class_probabilities"]).parent)
    words, published = words_of(visited, survey_png, visit="2026-06-08T10:00:00Z", prior="latest")
    assert "its stores were cleared; reprocess computes them again; 2 more likewise" in words
    assert "north has no prior map: none of its earlier runs can be one" in words


def test_prior_map_classes_are_matched_by_name(visited: Path, survey_png: Survey, make_weights: WeightsMaker) -> None:
    """Weights with another order and one more class use the prior map; weights without a common class do not."""
    other = make_weights(names=("class_2", "class_0", "class_1", "more"))
    flags = {"weights": str(other), "labels": None, "visit": "2026-06-07T10:00:00Z", "prior": "latest"}
    published = survey_png(visited, **{**RASTER, **flags})
    assert published.receipt["prior_map"]["days"] == 3.0
    strangers = make_weights(names=("a", "b", "c"))
    words, _ = words_of(visited, survey_png, **{**flags, "weights": str(strangers), "visit": "2026-06-06T10:00:00Z"})
    assert "it has none of the classes of these weights, but class_0, class_1, class_2" in words


def test_visits_are_reprocessed_in_order(visited: Path, twice: Any, make_weights: WeightsMaker) -> None:
    """With new weights, the prior map of the second visit is the reprocessed first visit."""
    weights = make_weights(width=4)
    run_reprocess(visited, QUIET, weights=weights)
    runs = [read_run(path) for path in sorted(visited.glob("runs/*"))]
    again = [run for run in runs if run.folder.name not in (twice[1].folder.name, twice[2].folder.name)]
    assert [run.settings["prior"] for run in again] == ["none", again[0].folder.name]
    assert again[1].receipt["prior_map"]["run"] == again[0].folder.name
    run_reprocess(visited, QUIET, weights=weights)
    assert len(list(visited.glob("runs/*"))) == 4  # nothing is left to do


def test_a_reader_in_the_weights_is_used(visited: Path, survey_png: Survey, weights: Path, tmp_path: Path) -> None:
    """Its key is in the receipt and its multiply-adds count; a reader for another network ends the survey at once."""
    own = Path(shutil.copy(weights, tmp_path / "own.safetensors"))
    config = load_weights(own).config
    reader = TemporalReader(TemporalSizes(config.classes, config.columns, 8, 4))
    torch.nn.init.normal_(reader.leave.weight, std=0.2)
    add_reader(own, own, reader, {})
    flags = {**RASTER, "visit": "2026-06-07T10:00:00Z", "prior": "latest", "weights": str(own)}
    published = survey_png(visited, **flags)
    assert len(published.receipt["prior_map"]["reader"]) == 20
    first = survey_png(tmp_path / "alone", **{**flags, "prior": "none"})
    decode = [one.receipt["savings"]["multiply_adds"]["detail"] for one in (published, first)]
    assert decode[0] - decode[1] == reader.sizes.multiply_adds(96 * 128)
    add_reader(own, own, TemporalReader(TemporalSizes(3, 7)), {})
    with pytest.raises(WeightsError, match=r"own\.safetensors.* temporal reader is for another network"):
        survey_png(visited, **flags)


def test_finding_a_prior_map_reads_the_newest_runs(visited: Path, twice: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """With 70 more visits, only the newest runs of this field are read."""
    _, first, later = twice
    for number in range(70):
        for name, source in (("north", later), ("south", first)):
            shutil.copytree(visited / "runs" / source.folder.name, visited / "runs" / f"20270101T{number:06d}-{name}")
    monkeypatch.setattr("spectralzoom.storage.store.CLOCK_S", 1e9)  # so that 2027 is no future
    counted = Mock(wraps=read_run)
    monkeypatch.setattr(memory, "read_run", counted)
    assert found_prior(visited, "2026-06-20T10:00:00Z", "latest")[1] == 16.0
    assert counted.call_count == memory.NEWEST_RUNS
    assert {call.args[0].name.rpartition("-")[2] for call in counted.call_args_list} == {"north"}


def test_two_simultaneous_visits_are_both_published(visited: Path, twice: Any, survey_png: Survey) -> None:
    """Neither waits for the other; the prior map of each is a finished run."""
    at = ["2026-06-09T10:00:00Z", "2026-06-09T11:00:00Z"]
    with ThreadPoolExecutor(2) as pool:
        both = list(pool.map(lambda visit: survey_png(visited, **RASTER, visit=visit, prior="latest"), at))
    assert both[0].folder != both[1].folder
    assert both[0].receipt["prior_map"]["run"] == twice[2].folder.name
    assert both[1].receipt["prior_map"]["run"] in {twice[2].folder.name, both[0].folder.name}
    assert not problems(visited)
