"""Training as a flow: input refused before imaging, the record of the training data, and messages to the user."""

from __future__ import annotations

import io
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from rich.console import Console

from spectralzoom.flows.cli.main import main
from spectralzoom.flows.field import open_field
from spectralzoom.flows.settings.load import load_settings
from spectralzoom.flows.settings.model_flags import TrainFlags
from spectralzoom.flows.training import figures, train_scenes
from spectralzoom.flows.training import train as flow
from spectralzoom.flows.training.data import TrainingData
from spectralzoom.flows.training.figures import judge_baselines
from spectralzoom.flows.training.train import run_train, train_weights
from spectralzoom.flows.training.train_scenes import Common, TrainRequest, network_config, suggested_patch
from spectralzoom.models.evaluation.metrics import mean_iou
from spectralzoom.models.network.spectral import SpectralBasis
from spectralzoom.models.policies.placement import ReadTwice
from spectralzoom.models.training.examples import Example
from spectralzoom.models.weights.files import TrainedOn, describe_weights, load_weights
from spectralzoom.pipeline.errors import SceneError, SettingsError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene
from tests.conftest import QUIET
from tests.flows.small_fields import write_field

QUICK: dict[str, Any] = {"steps": 1, "batch": 1, "crop": 16, "patch": 8, "dim": 16}
NUMBERS = ("001", "002", "003", "004")  # of frames


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with four frames of 16 x 16 px and two classes."""
    return write_field(tmp_path_factory.mktemp("frames") / "field", (16, 16), NUMBERS)


@pytest.fixture(scope="module")
def first(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Return weights that were trained with one scene for validation, and their record; do not change them."""
    path = tmp_path_factory.mktemp("first") / "w.safetensors"
    return path, train_weights(_request(folder, path, validation=1))


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """Return the path for the weights of a test."""
    return tmp_path / "w.safetensors"


def _request(folder: Path, out: Path, command: str = "", **flags: Any) -> TrainRequest:
    return TrainRequest(str(folder), out, TrainFlags(**QUICK | flags), command)


def test_new_weights_have_a_training_record(out: Path, tmp_path: Path):
    """It has scenes (none of validation, none held out) and ranges of the training data, and the calibration."""
    field = write_field(tmp_path / "field", (32, 32), NUMBERS)
    record = train_weights(_request(field, out, validation=1, hold_out="003"))
    assert "scans" not in record  # of a single exposure
    assert describe_weights(out).map_scores is None
    split = record["split"]
    assert (len(split["train"]), len(split["validation"])) == (2, 1)
    assert not set(split["train"]) & {*split["validation"], "003"}
    assert (split["held_out"], record["training"]["steps"]) == (["003"], 1)
    assert load_weights(out).record["split"] == split
    told = TrainedOn.read(load_weights(out).record["trained_on"])
    assert (told.scenes, told.exposure_ms, told.day) == (2, (100.0, 100.0), None)
    assert 0 <= record["calibration"]["expected_error"] <= 1


@pytest.mark.parametrize("sizes", [{"patch": 24}, {"dim": 18}])
def test_impossible_network_sizes_are_refused_before_imaging(
    folder: Path, out: Path, sizes: dict[str, Any], monkeypatch: pytest.MonkeyPatch
):
    """No scene is imaged for sizes that do not fit together."""
    monkeypatch.setattr(train_scenes, "observe_scene", lambda *given, **named: pytest.fail("a scene was looked at"))
    with pytest.raises(SettingsError, match="choose another --patch, --dim or --heads"):
        train_weights(_request(folder, out, **sizes))


def test_a_folder_as_output_file_is_refused(out: Path, capsys: pytest.CaptureFixture[str]):
    """One message comes before any scene is read, with the exit code of a usage error."""
    out.mkdir()
    with pytest.raises(SystemExit) as left:
        main(["train", "nowhere", "-o", str(out)])
    assert left.value.code == SettingsError.exit_code
    assert "w.safetensors: expected the name of a file" in " ".join(capsys.readouterr().err.split())


def test_scenes_of_different_bands_are_not_mixed(folder: Path, out: Path, monkeypatch: pytest.MonkeyPatch):
    """One set of weights needs the bands of one camera; the message names the scene that differs."""
    load = flow.open_training_data(str(folder), 0, None, LineCamera()).scene
    known: set[str] = set()

    def scene(data: object, name: str) -> RasterScene:
        found = load(name)
        known.add(name)
        return replace(found, wavelength_nm=found.wavelength_nm + 10 * (len(known) > 1))

    monkeypatch.setattr(TrainingData, "scene", scene)
    with pytest.raises(SceneError, match=r"scene 002.* has other bands"):
        train_weights(_request(folder, out))


@pytest.mark.parametrize(
    ("shape", "built_in", "patch"),
    [((512, 640), True, 16), ((1024, 1280), False, 32), ((300, 900), False, 16), ((145, 145), False, 8)],
)
def test_patch_size_follows_the_scene_size(shape: tuple[int, int], built_in: bool, patch: int):
    """Small scenes get small patches, to have enough to choose from; large frames get the deep network."""
    nm = np.linspace(500, 800, 4)
    common = Common(SpectralBasis.spanning(nm), ("a", "b"), np.zeros((2, 3), np.uint8), patch, nm)
    assert suggested_patch(shape, built_in=built_in) == patch
    assert network_config(TrainFlags(), common).deep == (min(shape) >= 512 and not built_in)


def test_training_shows_the_figures_of_validation(folder: Path, out: Path):
    """The table has rows of no, some and all patches, the baselines and the readings with their mIoU."""
    shown = io.StringIO()
    rows = {"none", "gain", "all"}
    judged = run_train(_request(folder, out, validation=1), Console(file=shown, width=100))["validation"]
    assert set(judged) - {"scenes", "fraction"} == rows
    for name in rows:
        assert all(0 <= judged[name][figure] <= 1 for figure in ("miou", "overall_accuracy"))
        assert name in shown.getvalue()
    record = describe_weights(out).record
    assert set(record["baselines"]) == {"LDA", "logistic regression", "random forest"}
    assert set(record["readings"]["miou"]) == {"network", "mean of both", "linear classifier"}
    beside = record["baselines"] | record["readings"]["miou"]
    assert all(f"{name} {100 * miou:.1f}" in shown.getvalue() for name, miou in beside.items())


@pytest.mark.parametrize(("few", "validation", "kept"), [(2000, 1, "mean of both"), (0, 1, None), (0, 0, "network")])
def test_few_labels_give_the_mean_of_network_and_linear_classifier(
    folder: Path, out: Path, monkeypatch: pytest.MonkeyPatch, few: int, validation: int, kept: str | None
) -> None:
    """With more labels the reading with the best validation score is kept; without validation scenes, the network."""
    monkeypatch.setattr(figures, "FEW_PIXELS", few)
    readings = train_weights(_request(folder, out, validation=validation))["readings"]
    scores = readings["miou"]
    assert readings["kept"] == (kept or max(scores, key=lambda name: scores[name]))


def test_counts_of_validation_scenes_add_up() -> None:
    """A row's score uses the summed counts of all scenes."""
    labels = np.array([[0, 0, 1, 1]], np.uint8)
    maps = np.array([[[0, 1, 1, 0]], [[0, 0, 1, 0]]], np.uint8)  # by the overview, and in full
    scenes = [ReadTwice(*maps, gain, labels, SceneGrid(1, 4, 1)) for gain in (np.eye(4)[1], np.eye(4)[2])]
    found = figures.validate(scenes, 2)
    assert found is not None
    assert found["none"]["miou"] == mean_iou(np.array([[2, 2], [2, 2]]))
    assert found["gain"]["miou"] == mean_iou(np.array([[3, 1], [2, 2]]))  # one patch of four, by the highest gain
    assert found["all"]["miou"] == mean_iou(np.array([[4, 0], [2, 2]]))


@pytest.mark.parametrize("validation", [True, False])
def test_baselines_separate_classes_of_different_spectra(validation: bool) -> None:
    """Distant classes score above 0.95, those of one distribution near chance; a class or few pixels give none."""
    rng = np.random.default_rng(0)
    labels = np.repeat(np.arange(2, dtype=np.uint8), 20)[:, None].repeat(40, 1)
    values = rng.normal(0, 1, (40, 40, 3))

    def judged(spectra: np.ndarray, truth: np.ndarray) -> dict[str, float] | None:
        one = Example("e", np.asarray(spectra, np.float32), truth, truth.shape)
        return judge_baselines([one], [one] * validation, 2, 0, lambda what, done, figure: None)

    mixed = rng.permutation(labels.ravel()).reshape(labels.shape)
    far, alike = judged(values + 9 * labels[..., None], labels), judged(values, mixed)
    assert min(far.values()) > 0.95
    assert max(alike["LDA"], alike["logistic regression"]) < 0.45
    assert validation or alike["random forest"] < 0.45
    assert judged(values, np.zeros_like(labels)) is None
    assert judged(values[:1, :2], np.array([[0, 1]], np.uint8)) is None


def test_a_survey_warns_of_a_training_scene(folder: Path, out: Path) -> None:
    """A held-out scene gets no warning."""
    train_weights(_request(folder, out, hold_out="002", validation=0))
    notes = {}
    for number in ("001", "002"):
        scene = folder / "images" / f"{number}_image.png"
        flags = {"scene": str(scene), "source": "sim", "weights": str(out), "out": str(out.parent / "a"), "budget": 1}
        notes[number] = " ".join(open_field(load_settings(None, flags)).notes)
    assert "a training scene" in notes["001"]
    assert "a training scene" not in notes["002"]


def _masked(folder: Path, rows: slice | None, out: Path, **more: Any) -> TrainRequest:
    """Write a labelled cube of 40 x 40 px, and request a training on these rows of it."""
    labels = np.random.default_rng(4).integers(1, 3, (40, 40)).astype(np.uint8)
    np.save(folder / "cube.npy", (labels[..., None] * np.ones(4)).astype(np.float32))
    np.save(folder / "labels.npy", labels)
    given = {"labels": str(folder / "labels.npy"), "wavelengths": "500,600,700,800"}
    if rows is not None:
        mask = np.zeros_like(labels)
        mask[rows] = labels[rows]
        np.save(folder / "mask.npy", mask)
        given["train_mask"] = str(folder / "mask.npy")
    return _request(folder / "cube.npy", out, **given, **more)


def test_training_pixels_are_not_judged(out: Path, tmp_path: Path) -> None:
    """After training with a mask, the survey of the same file keeps the labels outside of the mask only."""
    train_weights(_masked(tmp_path, slice(10), out))
    flags = {"labels": str(tmp_path / "labels.npy"), "wavelengths": [500, 600, 700, 800], "source": "sim", "budget": 1}
    flags |= {"scene": str(tmp_path / "cube.npy"), "weights": str(out)}
    labels = open_field(load_settings(None, flags | {"out": str(tmp_path / "a")})).labels.read()
    assert (labels[:10] == 255).all()
    assert (labels[10:] != 255).all()


@pytest.mark.parametrize(
    ("factor", "bands", "note"),
    [
        (1.0, [500, 600, 700, 800], ""),
        (1e-3, [500, 600, 700, 800], r"values with a median of 0.002 \(training: "),
        (1.0, [500, 600, 700], "no band near 800 nm"),
    ],
)
def test_surveys_warn_of_unlike_scenes(factor: float, bands: list[int], note: str, out: Path, tmp_path: Path) -> None:
    """The unit or the bands differ; a scene like those of the training gets no note."""
    labels = np.random.default_rng(4).choice([1, 2], (40, 40), p=[0.3, 0.7]).astype(np.uint8)
    values = (labels[..., None] * np.ones(4)).astype(np.float32)
    np.save(tmp_path / "cube.npy", values)
    np.save(tmp_path / "labels.npy", labels)
    choices = {"labels": str(tmp_path / "labels.npy"), "wavelengths": "500,600,700,800"}
    train_weights(_request(tmp_path / "cube.npy", out, **choices))
    np.save(tmp_path / "other.npy", factor * values[..., : len(bands)])
    asked = {"scene": str(tmp_path / "other.npy"), "wavelengths": bands, "source": "raster", "weights": str(out)}
    notes = " ".join(open_field(load_settings(None, asked | {"out": str(tmp_path / "a")})).notes)
    assert re.search(note, notes)
    assert bool(note) == ("of the training" in notes)


def test_weights_for_short_exposures_have_scan_performance(folder: Path, out: Path):
    """It holds mIoU and expected scores by step and exposure."""
    record = train_weights(_request(folder, out, validation=2, min_exposure_ms=6.0))
    scans = describe_weights(out).record["scans"]
    assert scans == record["scans"]
    assert (scans["steps"], scans["exposures_ms"], scans["scenes"]) == ([1, 2, 4, 8], [100.0, 50.0, 25.0, 12.0, 6.0], 2)
    tables = [scans["miou"], *scans["per_class_iou"].values()]
    assert all(np.shape(table) == (4, 5) and np.min(table) >= 0 and np.max(table) <= 1 for table in tables)
    assert np.shape(scans["spread"]) == (4, 5)
    scores = describe_weights(out).map_scores
    assert (scores.steps, scores.exposures_ms, scores.scenes) == ((1, 2, 4, 8), (6.0, 12.0, 25.0, 50.0, 100.0), 2)
    assert np.abs(scores.bias).max() > 0.01


@pytest.mark.parametrize(("darkest_ms", "said"), [(3.0, True), (100.0, False)])
def test_missing_scan_performance_is_reported_after_training(folder: Path, out: Path, darkest_ms: float, said: bool):
    """Weights have none without validation scenes; after short exposures training reports that, and its baselines."""
    shown = io.StringIO()
    request = _request(folder, out, validation=0, min_exposure_ms=darkest_ms)
    assert "scans" not in run_train(request, Console(file=shown, width=100))
    assert ("the file has no scan performance" in shown.getvalue()) == said
    assert "of a random half of the training pixels, on the other half: LDA " in shown.getvalue()


def test_whitening_uses_the_noise_of_short_exposures(folder: Path, out: Path):
    """Weights for short exposures give less weight to directions in which noise dominates."""
    sizes = []
    for darkest_ms in (100.0, 3.0):
        train_weights(_request(folder, out, validation=0, min_exposure_ms=darkest_ms))
        sizes.append(np.linalg.norm(load_weights(out).normalisation.whitening, 2))
    assert sizes[1] < sizes[0]


def test_training_resumes_from_a_file(folder: Path, out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Normalisation stays and the first step starts at the old network; without validation the mean of both is kept."""
    train_weights(_request(folder, out, validation=0, command="first"))
    trained = flow.train
    ends: list[Any] = []
    monkeypatch.setattr(flow, "train", lambda *given, **options: ends.append(trained(*given, **options)) or ends[0])
    request = _request(folder, tmp_path / "b.safetensors", validation=0, start=out, seed=1)
    record = train_weights(request)
    first, second = load_weights(out), load_weights(tmp_path / "b.safetensors")
    assert record["started_from"] == "first"
    np.testing.assert_array_equal(second.normalisation.whitening, first.normalisation.whitening)
    networks = (one.parameters() for one in (first.segmenter, second.segmenter, ends[0][0]))
    for before, halfway, after in zip(*networks, strict=True):
        torch.testing.assert_close(after, before, atol=0.01, rtol=0)
        torch.testing.assert_close(halfway, (before + after) / 2)
    assert not torch.equal(after, before)


@pytest.mark.parametrize(("better", "kept"), [(0, "network"), (3, "mean with --start")])
def test_continued_training_keeps_the_best_by_validation(
    folder: Path, out: Path, first: tuple[Path, Any], monkeypatch: pytest.MonkeyPatch, better: int, kept: str
) -> None:
    """The candidates are the trained network and the mean of its weights and the old ones."""
    scores = iter(np.eye(4)[better])
    monkeypatch.setattr(figures, "_miou", lambda *judged: float(next(scores)))
    record = train_weights(_request(folder, out, validation=1, start=first[0]))
    assert record["readings"]["kept"] == kept


def test_continued_training_may_have_more_scenes(folder: Path, out: Path, first: tuple[Path, Any]) -> None:
    """Its record names the scenes of both trainings."""
    second = train_weights(_request(folder, out, validation=0, start=first[0]))["split"]
    assert second["train"].items() > first[1]["split"]["train"].items()


def test_continued_training_has_a_lower_learning_rate() -> None:
    """Its rate is a third unless a flag sets it."""
    anew, on = (TrainFlags(start=start).settings for start in (None, Path("first.safetensors")))
    assert 3 * on.learning_rate == pytest.approx(anew.learning_rate)
    assert TrainFlags(learning_rate=2e-3).settings.learning_rate == 2e-3


@pytest.mark.parametrize(
    ("changed", "what"),
    [
        ({}, "training scenes"),  # others of the same names
        ({"hold_out": "003"}, "training scenes"),
        ({"validation": 2}, "training scenes"),
        ({"dim": 8}, "sizes of the network"),
    ],
)
def test_continued_training_refuses_changed_input(
    tmp_path: Path, out: Path, first: tuple[Path, Any], changed: dict[str, Any], what: str
) -> None:
    """One message names the difference: training scenes, of which the content counts, bands or network sizes."""
    field = write_field(tmp_path / "field", (16, 16), NUMBERS, seed=0 if changed else 9)
    with pytest.raises(SettingsError, match=f"its training had other {what}; give its data set and options"):
        train_weights(_request(field, out, **{"validation": 1, "start": first[0], **changed}))


@pytest.mark.parametrize(("rows", "held"), [(8, False), (12, True), (None, True)])
def test_continued_training_needs_all_first_pixels(out: Path, tmp_path: Path, rows: int | None, held: bool) -> None:
    """A new mask must contain the first one; without a mask every pixel is trained on."""
    train_weights(_masked(tmp_path, slice(2, 10), out, validation=0))
    part = None if rows is None else slice(rows)
    again = _masked(tmp_path, part, tmp_path / "b.safetensors", validation=0, start=out)
    if held:
        train_weights(again)
    else:
        with pytest.raises(SettingsError, match="other training pixels"):
            train_weights(again)


@pytest.mark.parametrize("unfit", ["copy", "unlabelled"])
def test_scenes_that_cannot_validate_are_left_out(folder: Path, out: Path, tmp_path: Path, unfit: str) -> None:
    """A scene without labels cannot judge, and a copy of a training scene scores too high."""
    field = Path(shutil.copytree(folder, tmp_path / "field"))
    if unfit == "copy":
        shutil.copy(field / "images" / "002_image.png", field / "images" / "001_image.png")
    else:
        Image.fromarray(np.full((16, 16, 3), 9, np.uint8)).save(field / "annotations" / "001_annotation.png")
        about = (field / "scene.toml").read_text()
        (field / "scene.toml").write_text(f"unlabelled = [9, 9, 9]\n{about}")
    notes: list[str] = []
    record = train_weights(_request(field, out, validation=1), tell=notes.append)
    assert any("1 validation scene left out" in note and note.endswith(": 001") for note in notes)
    assert (record["validation"], record["split"]["validation"], len(record["split"]["train"])) == (None, {}, 3)


@pytest.mark.parametrize("darkest_ms", [0.0, -1.0, 200.0, float("nan")])
def test_impossible_minimum_exposures_are_refused(folder: Path, out: Path, darkest_ms: float):
    """One message gives the limits: above 0 and at most the 100 ms of the training images."""
    with pytest.raises(SettingsError, match=r"--min-exposure-ms must be above 0 and at most 100"):
        run_train(_request(folder, out, min_exposure_ms=darkest_ms), QUIET)
