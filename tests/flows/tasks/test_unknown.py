"""The class `unknown` in a survey: its pixels, their score, and equal results without the detector."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from flows.publish.receipt_table import finding_rows
from flows.settings.load import load_settings
from flows.tasks.survey_model import beyond_training
from models.network.ood import Limits, OodDetector
from models.weights.files import TrainedOn, add_ood, describe_weights
from pipeline.errors import WeightsError
from pipeline.geometry.grid import UNLABELLED
from tests.conftest import CLASSES, RGB_NM, Survey

SEEN = TrainedOn(3, (460.0, 640.0), (3.0, 100.0), 2, CLASSES, (96, 300), (24.0, 60.0), 0.12)
Maker = Callable[[float], Path]
RASTER: dict[str, Any] = {"source": "raster", "budget": None, "unknown": "0.1%"}  # by default a raster has no unknown
OFF: dict[str, Any] = {**RASTER, "unknown": "off"}


def add_judgement(weights: Path, path: Path, limit: float, tables: dict[str, Any]) -> Path:
    """Write a copy of weights whose detector accepts squared distances to a limit, with tables; return its path."""
    shutil.copy(weights, path)
    one = np.eye(3)
    limits = Limits(np.array([0.001, 0.05]), np.ones(1), (1,), np.full((1, 1, 2), limit))
    ood_detector = OodDetector(np.zeros((1, 3)), one[None], 1e-9 * one[None], 1e-9 * one, limits, 3)
    add_ood(path, ood_detector, SEEN, tables)
    return path


@pytest.fixture(scope="module")
def judging(weights: Path, tmp_path_factory: pytest.TempPathFactory) -> Maker:
    """Return a maker of copies of the tiny weights whose detector accepts spectra within a squared distance."""
    return lambda limit: add_judgement(weights, tmp_path_factory.mktemp("judging") / "w.safetensors", limit, {})


def _stored(out: Path, name: str) -> xr.Dataset:
    (path,) = out.glob(f"stages/segment/*/{name}.zarr")
    return xr.open_zarr(path, consolidated=False)


def _files(out: Path, kind: str) -> dict[str, bytes]:
    (store,) = out.glob(f"stages/{kind}/*")
    return {str(path.relative_to(store.parent)): path.read_bytes() for path in store.rglob("c*") if path.is_file()}


@pytest.fixture(scope="module")
def both(
    tmp_path_factory: pytest.TempPathFactory, survey_png: Survey, judging: Maker
) -> tuple[Path, Path, dict[str, Any]]:
    """Return archives of the same survey with and without the class unknown, and the receipt of the first."""
    path = judging(0.5)
    out, plain = (tmp_path_factory.mktemp(name) for name in ("with", "without"))
    receipt = survey_png(out, weights=str(path), **RASTER).receipt
    survey_png(plain, weights=str(path), **OFF)
    return out, plain, dict(receipt)


def test_out_of_distribution_pixels_are_unknown(both: tuple[Path, Path, dict[str, Any]]) -> None:
    """Unknown comes after the classes of the weights and has no confidence; the other pixels keep their classes."""
    out, plain, receipt = both
    found, before = (_stored(one, "class_map") for one in (out, plain))
    classes, shown = found["classes"].values, before["classes"].values
    unknown = classes == 3
    assert found["classes"].attrs["flag_meanings"].split() == [*CLASSES, "unknown"]
    assert before["classes"].attrs["flag_meanings"].split() == list(CLASSES)
    assert 0.02 < unknown.mean() < 0.98
    np.testing.assert_array_equal(classes[~unknown], shown[~unknown])
    assert np.isnan(found["confidence"].values[unknown]).all()
    assert np.isfinite(found["confidence"].values[~unknown]).all()
    assert receipt["unknown"] == {"pixels": int(unknown.sum()), "fraction": float(unknown.mean()), "rate": 0.001}


def test_unknown_pixels_count_as_wrong_and_not_in_the_mean(both: tuple[Path, Path, dict[str, Any]]) -> None:
    """The labels have three classes, and the mIoU is over these."""
    accuracy = both[2]["accuracy"]
    assert list(accuracy["per_class_iou"]) == list(CLASSES)
    assert accuracy["miou"] == pytest.approx(np.mean(list(accuracy["per_class_iou"].values())))
    assert accuracy["unknown_px"] == both[2]["unknown"]["pixels"]
    assert "unknown" not in accuracy["false_classes"]
    assert accuracy["overall_accuracy"] <= 1 - accuracy["unknown_px"] / accuracy["pixels"]


def test_maps_without_a_detector_keep_every_byte(
    both: tuple[Path, Path, dict[str, Any]], survey_png: Survey, weights: Path, tmp_path: Path
) -> None:
    """Keys and bytes are equal with the detector switched off and with weights that have none."""
    survey_png(tmp_path, weights=str(weights), **OFF)
    assert _files(tmp_path, "segment") == _files(both[1], "segment")
    assert not set(_files(both[0], "segment")) & set(_files(both[1], "segment"))


def test_unknown_pixels_have_no_class_probabilities(both: tuple[Path, Path, dict[str, Any]]) -> None:
    """Their probabilities are NaN, so a later visit uses its own."""
    probabilities = _stored(both[0], "class_probabilities")
    classes = _stored(both[0], "class_map")["classes"].values
    np.testing.assert_array_equal(np.isnan(probabilities["log_probability"].values).all(axis=-1), classes == 3)


def test_a_prior_map_gives_unknown_pixels_no_class(
    both: tuple[Path, Path, dict[str, Any]], survey_png: Survey, judging: Maker, tmp_path: Path
) -> None:
    """A pixel unknown today is so whatever the prior map has; it has no probabilities, and its age is 0."""
    shutil.copytree(both[1], tmp_path, dirs_exist_ok=True)
    before = set(tmp_path.glob("stages/segment/*"))
    flags = {"visit": "later", "seed": "1", "prior": "latest", **RASTER}
    receipt = survey_png(tmp_path, weights=str(judging(0.5)), **flags).receipt
    (store,) = set(tmp_path.glob("stages/segment/*")) - before
    found = xr.open_zarr(store / "class_map.zarr", consolidated=False)["classes"].values
    assert (found == 3).sum() == receipt["unknown"]["pixels"] > 0
    after = xr.open_zarr(store / "class_probabilities.zarr", consolidated=False)
    np.testing.assert_array_equal(np.isnan(after["log_probability"].values[..., 0]), found == 3)
    assert not after["age"].values.any()


def test_an_entirely_unknown_map_names_the_remedy(survey_png: Survey, judging: Maker, tmp_path: Path) -> None:
    """Receipt and report advise training or --unknown off, by default after a scan; the mIoU is 0."""
    scan: dict[str, Any] = {"effects": "none", "camera.samples": 160, "budget": None, "scan_step": 1}
    published = survey_png(tmp_path, weights=str(judging(1e-6)), **scan)
    receipt: Any = published.receipt
    assert receipt["unknown"]["fraction"] == 1
    assert receipt["accuracy"]["miou"] == 0
    words = dict(finding_rows(receipt))
    assert "100 % of the pixels" in words["unknown"]
    assert "These weights do not know this field: train" in words["weights"]
    assert "--unknown off" in (published.folder / "report.html").read_text(encoding="utf-8")
    assert json.loads((published.folder / "receipt.json").read_text())["unknown"]["pixels"] == 96 * 128


def test_pixels_without_a_value_are_nodata_and_not_unknown(
    survey_png: Survey, judging: Maker, scene_files: Path, tmp_path: Path
) -> None:
    """All other pixels of the map are unknown."""
    values = np.load(scene_files / "cube.npy")[..., :3]
    values[:8, :8] = np.nan
    np.save(tmp_path / "holes.npy", values)
    flags = {"scene": str(tmp_path / "holes.npy"), "labels": None, "wavelengths": ",".join(map(str, RGB_NM))}
    survey_png(tmp_path / "out", weights=str(judging(1e-6)), **RASTER, **flags)
    classes = _stored(tmp_path / "out", "class_map")["classes"].values
    assert (classes[:8, :8] == UNLABELLED).all()
    assert (classes[8:, 8:] == 3).all()


@pytest.mark.parametrize(("flags", "rate"), [({}, None), ({"unknown": "1%"}, 0.01), ({"zoom": "never"}, 0.001)])
def test_unknown_is_off_by_default_in_zoomed_surveys(flags: dict[str, str], rate: float | None) -> None:
    """The detector is not fitted to merged passes; an explicit rate still applies."""
    assert load_settings(None, {"zoom": "always", "seconds": "9", **flags}).unknown_rate == rate


def test_an_unknown_rate_needs_weights_with_a_detector(survey_png: Survey, weights: Path, tmp_path: Path) -> None:
    """The message has the training option that fits one; no archive is made."""
    with pytest.raises(WeightsError, match=r"--unknown 1%: .* has no out-of-distribution detector.* --validation 3"):
        survey_png(tmp_path / "out", weights=str(weights), unknown="1%")
    assert not (tmp_path / "out").exists()


def _notes(weights: Path, nm: tuple[float, ...] = RGB_NM, seen: TrainedOn = SEEN, **flags: Any) -> tuple[str, ...]:
    scene: Any = SimpleNamespace(wavelength_nm=np.array(nm), shape=(96, 128), light_fraction=1.0)
    return beyond_training(load_settings(None, flags), scene, describe_weights(weights), seen, weights)


@given(st.integers(96, 300), st.floats(3.0, 100.0))
def test_a_survey_within_the_training_range_has_no_note(weights: Path, day: int, exposure_ms: float) -> None:
    """Days 96 to 300 and exposures of 3 to 100 ms are within the training's."""
    assert _notes(weights, day=day, hour=12, scan_step=1, scan_exposure_ms=exposure_ms) == ()


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        ({"day": 20, "hour": 12}, r"day 20 of the year \(January; training: April to October\); a sun"),
        ({"scan_step": 1, "scan_exposure_ms": 1}, r"exposures of 1 ms \(training: 3 ms and more, by --min-"),
        ({"coarse_exposure_ms": 2}, "exposures of 2 ms"),
        ({"nm": (460.0, 470.0, 480.0)}, "the bands cover 2 of the weights' 3 spectral features"),
        ({"nm": (460.0, 900.0, 1500.0, 1600.0)}, "bands outside of 460-640 nm: 3 of 4"),
        ({"seen": replace(SEEN, ground_pixel_m=0.01)}, r"GSD of 12 cm \(training: 1 cm\)"),
    ],
)
def test_conditions_beyond_the_training_get_one_note(weights: Path, flags: dict[str, Any], words: str) -> None:
    """It gives the training's range and the command to train."""
    (note,) = _notes(weights, **flags)
    assert re.search(words, note), note
    assert "spectralzoom train DATASET -o" in note
