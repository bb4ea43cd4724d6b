"""Partial scans: the lines of highest expected gain are captured, and the rest comes from the prior map."""

from __future__ import annotations

import io
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import xarray as xr
from rich.console import Console

from spectralzoom.flows.archive.reprocess_command import run_reprocess
from spectralzoom.flows.opening import prior_maps
from spectralzoom.flows.opening.open_field import open_field
from spectralzoom.flows.plan import ReadingPlan
from spectralzoom.flows.planning import extent_choice
from spectralzoom.flows.planning.extent_choice import ExtentGains
from spectralzoom.flows.planning.patch_budget import SHARD
from spectralzoom.flows.planning.plan_survey import compared_px
from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.flows.stages.drawing import Drawing
from spectralzoom.models.network.sizes import MultiplyAdds, TemporalSizes
from spectralzoom.models.network.temporal_reader import TemporalReader
from spectralzoom.models.reading.expected_errors import PatchExpectedErrors
from spectralzoom.models.reading.prior_map import ClassProbabilities, PriorMap, carried
from spectralzoom.models.reading.regions import plan_regions
from spectralzoom.pipeline.errors import BudgetError, PipelineError, SettingsError
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.planning.uniform_scans import ScanPerformance
from spectralzoom.storage.runs import read_run
from tests.conftest import QUIET, Flags, Survey, WeightsMaker
from tests.prior_work import without_effects

pytestmark = pytest.mark.usefixtures("no_effects")

RECORD = {
    "scenes": 3,
    "steps": [1, 2, 4],
    "exposures_ms": [25.0, 6.0],
    "miou": [[0.99, 0.98], [0.97, 0.95], [0.9, 0.8]],
    "per_class_iou": {"class_1": [[0.99, 0.97], [0.96, 0.94], [0.9, 0.8]]},
}
FIELD: dict[str, Any] = {"budget": None, "name": "north", "accuracy": False}
WHOLE = {**FIELD, "scan_step": "2", "scan_exposure_ms": "25"}
PART = {**FIELD, "extent": "part", "prior": "latest", "seconds": "1.98"}
FIRST, LATER, LAST = "2026-06-01T10:00:00Z", "2026-06-04T10:00:00Z", "2026-06-07T10:00:00Z"


@pytest.fixture(scope="module")
def recorded(make_weights: WeightsMaker) -> Path:
    """Return tiny weights with scan performance."""
    return make_weights(scans=RECORD)


@pytest.fixture(scope="module")
def visits(tmp_path_factory: pytest.TempPathFactory, survey_png: Survey, recorded: Path) -> tuple[Path, Any, Any]:
    """Return an archive, a visit to a whole field and a partial scan three days later; do not change it."""
    out = tmp_path_factory.mktemp("visits") / "archive"
    with without_effects():
        first = survey_png(out, **WHOLE, visit=FIRST, weights=str(recorded))
        return out, first, survey_png(out, **PART, visit=LATER, weights=str(recorded))


@pytest.fixture
def visited(visits: tuple[Path, Any, Any], tmp_path: Path) -> Path:
    """Return a copy of that archive."""
    return Path(shutil.copytree(visits[0], tmp_path / "archive"))


def product(out: Path, published: Any, name: str) -> xr.Dataset:
    """Return a store of a run."""
    return xr.open_zarr(out / published.receipt["products"][name], consolidated=False)


@pytest.mark.parametrize("later", [PART, {**WHOLE, "prior": "latest"}], ids=["part", "whole"])
@pytest.mark.parametrize("warned", [True, False], ids=["warned", "plain"])
def test_a_partial_scan_has_the_warning_of_its_prior_map(
    visits: tuple[Path, Any, Any],
    flags_png: Flags,
    recorded: Path,
    monkeypatch: pytest.MonkeyPatch,
    later: dict[str, Any],
    warned: bool,
) -> None:
    """A scan of the whole field captures every place again, and has none."""
    monkeypatch.setattr(prior_maps, "warnings_of", lambda receipt: ["dark"] if warned else [])
    field = open_field(load_settings(None, flags_png(visits[0], **later, visit=LAST, weights=str(recorded))))
    assert field.prior is not None
    inherited = [one for one in field.warnings if f"keep the prior map {field.prior.run}, which has a warning" in one]
    assert bool(inherited) == (warned and later is PART)


def test_a_partial_scan_maps_the_rest_from_the_prior_map(visits: tuple[Path, Any, Any]) -> None:
    """The scan keeps its seconds; captured patches have age 0, the others 3 days, and every pixel has a class."""
    out, first, part = visits
    scan_pass = part.receipt["extent"]
    age = product(out, part, "class_probabilities").age.values
    assert 0.1 < scan_pass["patches_touched"] < 0.9
    assert part.receipt["settings"]["scan_step"] < 4  # cheaper lines, and less accurate than the prior map
    assert part.receipt["savings"]["capture_s"]["done"] == pytest.approx(scan_pass["seconds"])
    assert scan_pass["seconds"] <= 2.1
    assert sorted(np.unique(age)) == [0.0, 3.0]
    assert (age == 0).mean() == pytest.approx(scan_pass["patches_touched"], abs=0.15)
    reached = product(out, part, "mosaic").coverage.values > 0
    assert reached[age == 0].all()  # pixels filled in at the edge of the part do not count as captured
    before, now = (product(out, one, "class_map").classes.values for one in (first, part))
    assert (now != 255).all()
    assert (now == before)[age > 0].mean() > 0.95  # ageing may flip two classes nearly as likely


def test_receipt_and_page_describe_the_captured_part(visits: tuple[Path, Any, Any]) -> None:
    """They hold its lines and expected gain; the plan's reason and the notes name the part."""
    _, _, part = visits
    scan_pass = part.receipt["extent"]
    assert part.receipt["settings"]["extent"] == scan_pass["lines"]
    assert scan_pass["expected_gain"] >= 0
    page = (part.folder / "report.html").read_text(encoding="utf-8")
    assert "a part of the field was scanned once: every" in part.receipt["plan"]["reason"]
    assert "this one: " not in page  # scan performance is of scans of the whole field, without prior map
    notes = part.receipt["settings"]["notes"]
    assert any("lines of highest expected gain" in note and "the prior map is wrong at" in note for note in notes)


def test_same_partial_visit_captures_nothing(visited: Path, visits: Any, survey_png: Survey, recorded: Path) -> None:
    """It has the same extent and the same prior map, and its stages are cached."""
    again = survey_png(visited, **PART, visit=LATER, weights=str(recorded))
    assert again.receipt["settings"]["extent"] == visits[2].receipt["settings"]["extent"]
    assert again.receipt["prior_map"]["run"] == visits[1].folder.name
    states = {stage["name"]: stage["state"] for stage in again.receipt["stages"]}
    assert states["capture_coarse"] == states["segment"] == "cached"


def test_reprocessing_a_partial_scan_uses_stored_lines(visited: Path, visits: Any, make_weights: WeightsMaker) -> None:
    """New weights change the map but not the lines, even if they would choose others."""
    run_reprocess(visited, QUIET, weights=make_weights(scans=RECORD, width=4))
    runs = [read_run(path) for path in sorted(visited.glob("runs/*"))]
    before, again = (run for run in runs if run.settings["extent"] == visits[2].receipt["settings"]["extent"])
    assert again.receipt["products"]["class_map"] != before.receipt["products"]["class_map"]
    assert again.receipt["products"]["raw_coarse"] == before.receipt["products"]["raw_coarse"]


def test_partial_scan_without_prior_map_scans_everything(survey_png: Survey, recorded: Path, tmp_path: Path) -> None:
    """A message says so, and the seconds pay for a uniform scan."""
    text = io.StringIO()
    flags = {**PART, "seconds": "5", "weights": str(recorded), "max_age": "14"}
    first = survey_png(tmp_path / "archive", console=Console(file=text, width=300), **flags)
    assert "there is no prior map: the whole field is captured" in text.getvalue()
    assert "extent" not in first.receipt
    assert first.receipt["settings"]["extent"] == "whole"
    again = Path(shutil.copy(recorded, tmp_path / "same.safetensors"))
    assert run_reprocess(tmp_path / "archive", QUIET, weights=again) == 0


def test_patches_beyond_max_age_come_first(visited: Path, visits: Any, survey_png: Survey, recorded: Path) -> None:
    """With --max-age, lines over patches that the visit before left out are captured; notes and page count them."""
    flags = {**PART, "seconds": "1.95", "max_age": "8", "weights": str(recorded)}
    part = survey_png(visited, **flags, visit=LAST)
    due = product(visited, visits[2], "class_probabilities").age.values == 3.0
    scan_pass = part.receipt["extent"]
    assert (product(visited, part, "class_probabilities").age.values[due] < 1).any()
    assert 0 < scan_pass["due"] - scan_pass["due_left"] < scan_pass["due"]
    notes = " ".join(part.receipt["settings"]["notes"])
    included = f"{scan_pass['due'] - scan_pass['due_left']} of {scan_pass['due']} included"
    assert f"patches beyond --max-age: {included}" in notes
    page = " ".join((part.folder / "report.html").read_text(encoding="utf-8").split())
    assert f"{scan_pass['due_left']} patches beyond --max-age left" in page


def test_patches_without_data_are_never_due(survey_png: Survey, recorded: Path, tmp_path: Path) -> None:
    """The field has values in 96 of 128 columns; yesterday's map is younger than --max-age there."""
    values = np.random.default_rng(0).uniform(50, 200, (96, 128, 3))
    values[:, 96:] = np.nan
    np.save(tmp_path / "scene.npy", values)
    given = {"scene": str(tmp_path / "scene.npy"), "labels": None, "weights": str(recorded)}
    given["wavelengths"] = "450,550,650"
    for flags, day in ((WHOLE, "2026-06-01"), ({**PART, "max_age": "30"}, "2026-06-02")):
        found = survey_png(tmp_path / "archive", **flags, **given, visit=day)
    assert found.receipt["extent"]["due"] == 0


def test_lines_that_cover_a_field_capture_its_border(recorded: Path) -> None:
    """Patches that cross the border count as captured if lines cover their part within the field."""
    covered = np.ones((100, 103), np.uint8)
    (region,) = plan_regions(SceneGrid(100, 103, 16), SHARD)
    mosaic: Any = SimpleNamespace(coverage=lambda rows, columns: covered[rows, columns])
    drawing = Drawing(None, None, None, None, part=True)
    assert drawing._shown(region, mosaic).all()
    covered[96:] = 0
    assert not drawing._shown(region, mosaic)[96:].any()


def test_a_prior_map_read_in_swaths_equals_the_whole_one(
    visits: tuple[Path, Any, Any], recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every second pixel is read, with the neighbours in the reader's window; each age belongs to its pixel."""
    reader = TemporalReader(TemporalSizes(2, 4, width=8, coarse_width=4)).eval()
    torch.nn.init.normal_(reader.leave.weight, std=0.3)
    monkeypatch.setattr(extent_choice, "load_reader", lambda path, described: reader)
    rng = np.random.default_rng(1)
    probabilities = np.log(rng.dirichlet(np.ones(2), (95, 63))).astype(np.float32)
    images = probabilities, rng.uniform(1, 9, (95, 63)).astype(np.float32), np.ones((95, 63), np.float32)
    store: Any = SimpleNamespace(read=lambda rows: tuple(image[rows] for image in images))
    monkeypatch.setattr(extent_choice, "ProbabilityStore", lambda path: store)
    prior: Any = SimpleNamespace(probabilities=SimpleNamespace(path=Path()), classes=(0, 1), days=5.0, day_of_year=None)
    weights: Any = SimpleNamespace(reader="there", config=SimpleNamespace(untaught=()))
    parts, ages = zip(*extent_choice._swaths(prior, SceneGrid(95, 63, 4), weights, recorded), strict=True)
    assert len(parts) > 1
    assert np.array_equal(np.concatenate(ages), images[1] + 5)
    every = ClassProbabilities(*(image[::2, ::2] for image in images))
    whole = carried(PriorMap(every, None, 5.0), reader).log_probability.repeat(2, axis=0).repeat(2, axis=1)
    np.testing.assert_allclose(np.concatenate(parts), whole[:95, :63], atol=1e-5)


def test_due_patches_have_the_highest_expected_gain() -> None:
    """A due patch outweighs ten times the sum of the others; without gains the oldest patches rank highest."""
    probabilities = np.log([0.6, 0.4]) * np.ones((4, 16, 1))
    age = np.repeat([[1.0, 2.0, 3.0, 4.0]], 4, axis=0).repeat(4, axis=1)
    expected_errors = PatchExpectedErrors.of([(probabilities, age)], SceneGrid(4, 16, 4), 2)
    due = np.array([False, True, False, False])
    record = ScanPerformance.read(RECORD)
    wanted = ExtentGains(record, ("class_0", "class_1"), expected_errors, due, np.ones(4, bool))
    gains = wanted.gains(1, 25.0)
    assert (gains > 0).all()
    assert wanted.expected_gain(gains)[1] > 10 * wanted.expected_gain(gains)[[0, 2, 3]].sum()
    darker = wanted.gains(4, 6.0)  # due patches count alike for every scan: the one with more of them is chosen
    assert wanted.expected_gain(gains)[1] - gains[1] == wanted.expected_gain(darker)[1] - darker[1]
    nobody = replace(wanted, due=np.zeros(4, bool))
    assert np.array_equal(nobody.expected_gain(gains), gains)
    assert np.argsort(nobody.expected_gain(np.zeros(4))).tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("flags", "error", "told"),
    [
        ({"seconds": None, "scan_step": "2"}, SettingsError, "'part' needs a time budget: give --seconds"),
        (
            {"extent": "0:5-9", "seconds": None},
            SettingsError,
            "names lines of a uniform scan: give its --scan-step too",
        ),
        ({"extent": "0:9-5"}, SettingsError, "must be whole, part, or lines as in receipts"),
        ({"extent": "somewhere"}, SettingsError, "must be whole, part, or lines"),
        (
            {"extent": "7:0-5", "seconds": None, "scan_step": "2"},
            SettingsError,
            "the extent names sweep 7, the scan has sweeps 0 to 0",
        ),
        ({"pointing_px": "4"}, SettingsError, "registration .* needs all"),
        ({"extent": "whole", "max_age": 14}, SettingsError, "--max-age is for a partial scan"),
        ({"max_age": "a while"}, SettingsError, "--max-age must be a number from 0.04 to 3660 d"),
        ({"seconds": "1"}, BudgetError, r"is below the minimum scan time of 1\.\d\d s"),  # this minimum suffices
    ],
)
def test_impossible_partial_scans_are_refused(
    visits: Any, survey_png: Survey, recorded: Path, flags: dict[str, Any], error: type[PipelineError], told: str
) -> None:
    """The error says what to do and comes before anything is captured."""
    before = sorted(visits[0].rglob("*"))
    with pytest.raises(error, match=told):
        survey_png(visits[0], **{**PART, "visit": LAST, "weights": str(recorded), **flags})
    assert sorted(visits[0].rglob("*")) == before


def test_the_reader_counts_for_the_choice_of_lines_and_for_the_map() -> None:
    """The choice reads a quarter of the prior map's pixels."""
    reader = SimpleNamespace(sizes=TemporalSizes(2, 4))
    costs = SimpleNamespace(of_map=lambda index: MultiplyAdds(5, 0, 7))
    map_px, choice_px = 95 * 63, 48 * 32
    for chosen, pixels in ((False, map_px), (True, map_px + choice_px)):
        compared = compared_px(SceneGrid(95, 63, 4), chosen=chosen)
        plan: Any = SimpleNamespace(costs=costs, reader=reader, least_gain=None, chooses=False, compared_px=compared)
        assert ReadingPlan.work_done(plan, np.arange(3)).detail == 7 + reader.sizes.multiply_adds(pixels)
