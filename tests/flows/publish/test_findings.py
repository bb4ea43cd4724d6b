"""Findings of a run: changes on the ground, and the score that a map expects of itself."""

from __future__ import annotations

import re
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from spectralzoom.flows.publish.findings import changed_hectares
from spectralzoom.flows.publish.receipt_table import finding_rows, format_score
from spectralzoom.models.evaluation.expected_scores import MapScores, expected_counts, expected_score
from spectralzoom.models.weights.files import (
    MAP_SCORES,
    TRAINED_ON,
    _add_part,
    add_spectra,
    load_weights,
    save_weights,
    with_record,
)
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.pipeline.ground.field_places import NoPlace
from spectralzoom.storage.arrays.class_maps import ClassMap, ClassNames
from tests.conftest import CLASSES, Survey
from tests.flows.surveys.test_unlike_training import FAR, SEEN

PLACE = NoPlace((2, 4), pixel_m=10.0)  # a pixel is a hundredth of a hectare
GROUND: dict[str, Any] = {"crs": "EPSG:32632", "resolution_m": 0.12}
BIAS = np.array([-0.4, 0.1, 0.0])
SCORES = MapScores((1,), (50.0, 100.0), np.stack([[0 * BIAS, BIAS]]), np.array([[0.02, 0.01]]), 4)


def test_changed_hectares_are_listed_by_pair_of_classes() -> None:
    """Largest ones come first, scaled by the part beyond chance; pixels without a class today are left out."""
    now = np.array([[0, 0, 1, 1], [2, UNLABELLED, 2, 2]], np.uint8)
    old = np.array([[1, 255, 0, 0], [0, 0, 255, 255]], np.uint8)
    names = "soil", "crop", "weed", *(f"class_{number}" for number in range(3, 16))  # one pair has the number 255
    legend = names, np.zeros((16, 3), np.uint8)
    beyond = {("soil", "crop"): 1.0, ("soil", "weed"): 0.5}
    found = changed_hectares(PLACE, old, ClassMap(now, np.ones(now.shape, np.float32), ClassNames(*legend)), beyond)
    assert [(round(area, 6), *pair) for area, *pair in found] == [(0.02, "soil", "crop"), (0.005, "soil", "weed")]


def test_findings_have_hectares_and_changes() -> None:
    """Classes of no area are left out; changes name both classes."""
    areas = {"px": {"bare_soil": 30}, "ha": {"bare_soil": 0.3, "crop": 0.1, "weed": 0.0}}
    assert finding_rows({"areas": areas}) == [("classes", "bare soil 0.3 ha, crop 0.1 ha")]
    later = {"changes_ha": [[0.5, "crop", "bare_soil"], [0.0004, "weed", "crop"]]}
    assert finding_rows({"ground": GROUND}) == []
    changed = "crop to bare soil 0.5 ha, weed to crop 4 m²"
    assert finding_rows({"ground": GROUND | later}) == [("changed", changed)]


def _judged(weights: Path, folder: Path, content: dict[str, Any], *, unlike: bool = False) -> Path:
    """Write a copy of the tiny weights with the calibration of their expected scores, and return its path."""
    path = folder / "judged.safetensors"
    known = with_record(load_weights(weights), **{TRAINED_ON: asdict(SEEN)})
    save_weights(known, path)
    if unlike:
        add_spectra(path, FAR)
    _add_part(path, path, MAP_SCORES, content, {})
    return path


def test_a_uniform_scan_has_the_expected_score_of_its_map(survey_png: Survey, weights: Path, tmp_path: Path):
    """It follows from the stored class probabilities, and the bias of an exposure that is as long in full light."""
    path = _judged(weights, tmp_path, SCORES.as_dict())
    flags = {"effects": "none", "budget": None, "scan_step": "1", "sky.light_fraction": "0.75"}
    receipt: Any = survey_png(tmp_path / "a", weights=str(path), **flags).receipt
    (store,) = (tmp_path / "a").glob("stages/segment/*/class_probabilities.zarr")
    said = xr.open_zarr(store, consolidated=False)["log_probability"].values
    said = said - np.log(np.exp(said).sum(axis=-1, keepdims=True))
    part = np.log(75 / 50) / np.log(100 / 50)  # between the exposures of the table
    told = expected_score(expected_counts([said], len(CLASSES)), part * BIAS, 0.02 - 0.01 * part, 1, 75.0)
    assert receipt["expected"]["miou"] == pytest.approx(told.miou, abs=1e-5)
    assert receipt["expected"]["error"] == pytest.approx(told.error, abs=1e-5)
    assert set(receipt["expected"]["per_class_iou"]) <= set(CLASSES)


def test_an_uncertain_expected_score_is_left_out(survey_png: Survey, weights: Path, tmp_path: Path) -> None:
    """Maps of these weights were off by 37 points: the receipt has no score, and the sentence on the score says why."""
    content = SCORES.as_dict() | {"error": [[0.371, 0.371]]}
    path = _judged(weights, tmp_path, content)
    receipt: Any = survey_png(tmp_path / "a", weights=str(path), effects="none", budget=None, scan_step="1").receipt
    assert "miou" not in receipt["expected"]
    words = format_score({name: part for name, part in receipt.items() if name != "accuracy"})
    assert re.search(
        r"^No expected score: it would be off by 3[78]\.\d points \(one .*\); judge the map by labels\.$", words
    )


@pytest.mark.parametrize(
    ("miou", "spread", "words"),
    [
        (0.927, 0.038, "every line, 25 ms, 9.0 s, expected mIoU 92.7 ± 3.8"),
        (0.927, 0.371, "every line, 25 ms, 9.0 s$"),
        (None, None, "every line, 25 ms, 9.0 s$"),
    ],
    ids=["known", "spread too wide", "under a warning"],
)
def test_scans_show_expected_miou_if_it_is_reliable(miou: float | None, spread: float | None, words: str) -> None:
    """It is left out if scenes differ too much, or if the weights do not know the field."""
    scan = {"step": 1, "exposure_ms": 25.0, "seconds": 9.0, "expected_miou": miou, "expected_spread": spread}
    found = {"scans": {"taken": scan, "reference": scan}}
    assert re.search(f"cheapest near the best: {words}", dict(finding_rows(found))["uniform scans"])


def test_changes_from_a_prior_map_exceed_the_expected_difference() -> None:
    """Two maps of unchanged ground differ in some pixels, and such a number is no change."""
    memory = {"run": "r", "days": 3.0, "differing_px": 950, "expected_differing_px": 810, "changed_px": 0}
    words = {"prior map": "r; 3.0 days earlier"}
    assert dict(finding_rows({"prior_map": memory})) == words
    changes = {"changed_px": 700, "changes": [[600, 650, "soil", "bare_weed"], [100, 120, "soil", "maize"]]}
    changed = dict(finding_rows({"prior_map": memory | changes}))["prior map"]
    assert changed == words["prior map"] + "; 700 px changed; soil to bare weed 600 px, soil to maize 100 px"


@pytest.mark.parametrize(
    ("unlike", "flags"),
    [
        (False, {"scan_step": "2"}),
        (False, {"scan_step": "1", "macs": "80%"}),
        (False, {"scan_step": "1", "wavelengths": "690,700,710"}),
        (True, {"scan_step": "1"}),
    ],
    ids=["another step", "read in part", "other bands", "other spectra"],
)
def test_maps_outside_of_the_calibration_have_no_expected_score(
    survey_png: Survey, weights: Path, tmp_path: Path, unlike: bool, flags: dict[str, str]
) -> None:
    """It covers full readings of scans of one step, with the training's bands and known spectra."""
    path = _judged(weights, tmp_path, SCORES.as_dict(), unlike=unlike)
    receipt: Any = survey_png(tmp_path / "a", weights=str(path), effects="none", budget=None, **flags).receipt
    assert "miou" not in receipt.get("expected", {})
    assert unlike == ("unlike" in receipt)
    beyond = any("outside of the training data" in warning for warning in receipt.get("warnings", ()))
    assert beyond == ("wavelengths" in flags)
