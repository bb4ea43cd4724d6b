"""Training as a flow: input refused before imaging, the record of the training data, and messages to the user."""

from __future__ import annotations

import io
import re
import shutil
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from rich.console import Console

from spectralzoom.flows.cli.main import main
from spectralzoom.flows.evaluate.command import evaluate_weights
from spectralzoom.flows.opening.open_field import open_field
from spectralzoom.flows.settings.model_flags import EvaluateFlags, TrainFlags
from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.flows.training import figures
from spectralzoom.flows.training import train as flow
from spectralzoom.flows.training.data import TrainingData
from spectralzoom.flows.training.train import run_train, train_weights
from spectralzoom.flows.training.train_scenes import Common, Imaged, TrainRequest, network_config, patch_of
from spectralzoom.models.evaluation.metrics import mean_iou
from spectralzoom.models.network.spectral import SpectralBasis
from spectralzoom.models.policies.placement import ReadTwice
from spectralzoom.models.weights.files import TrainedOn, describe_weights, load_weights
from spectralzoom.pipeline.errors import SceneError, SettingsError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.simulator.render import USUAL
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene
from tests.conftest import QUIET
from tests.flows.small_fields import write_field

NUMBERS = ("001", "002", "003", "004")  # of frames


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with four frames of 16 x 16 px and two classes."""
    return write_field(tmp_path_factory.mktemp("frames") / "field", (16, 16), NUMBERS)


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """Return the path for the weights of a test."""
    return tmp_path / "w.safetensors"


def _request(folder: Path | str, out: Path, command: str = "", **flags: Any) -> TrainRequest:
    return TrainRequest(str(folder), out, TrainFlags(**{"steps": 1} | flags), command)


def test_new_weights_have_a_training_record(out: Path, tmp_path: Path):
    """It has scenes (those of validation, none held out) and ranges of the training data, and the calibration."""
    field = write_field(tmp_path / "field", (32, 32), NUMBERS)
    record = train_weights(_request(field, out, validation=1, hold_out=("003",)))
    assert "scans" not in record  # of a single exposure
    assert describe_weights(out).map_scores is None
    split = record["split"]
    assert (len(split["train"]), len(split["validation"])) == (3, 1)
    assert set(split["validation"]) < set(split["train"]) == {"001", "002", "004"}  # classifiers learn from all
    assert split["held_out"] == ["003"]
    assert load_weights(out).record["split"] == split
    told = TrainedOn.read(load_weights(out).record["trained_on"])
    assert (told.scenes, told.exposure_ms, told.day) == (3, (100.0, 100.0), None)
    assert 0 <= record["calibration"]["expected_error"] <= 1


def test_two_of_eight_scenes_judge_a_network(out: Path, tmp_path: Path):
    """A fraction of its correction is chosen, and classifiers learn from all scenes; fewer scenes have no network."""
    field = write_field(tmp_path / "field", (16, 16), tuple(f"{number:03d}" for number in range(8)))
    record = train_weights(_request(field, out))
    assert (len(record["split"]["train"]), len(record["split"]["validation"])) == (8, 2)
    scores = record["corrections"]
    assert list(scores) == ["0", "0.25", "0.5", "0.75", "1"]
    best = max(scores, key=lambda part: scores[part])
    kept = load_weights(out).config
    assert kept.corrected == (best != "0")
    assert kept.parts
    few = train_weights(_request(field, out, validation=1, hold_out=("002", "003", "004", "005", "006", "007")))
    assert "corrections" not in few
    config = load_weights(out).config
    assert not config.corrected
    parts = [(one["name"].partition(",")[0], one["weight"]) for one in few["candidates"] if one["weight"]]
    assert parts == [(kind, weight) for kind, _, weight in config.parts if weight]  # of both scenes


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
    assert patch_of(shape, built_in=built_in) == patch
    assert network_config(common).deep == (min(shape) >= 512 and not built_in)


def test_training_shows_the_figures_of_validation(folder: Path, out: Path):
    """Tables have rows of no, some and all patches, and of each classifier; the mixture is that of the weights."""
    shown = io.StringIO()
    rows = {"none", "gain", "all"}
    judged = run_train(_request(folder, out, validation=1), Console(file=shown, width=100))["validation"]
    assert set(judged) - {"scenes", "fraction"} == rows
    for name in rows:
        assert all(0 <= judged[name][figure] <= 1 for figure in ("miou", "overall_accuracy"))
        assert name in shown.getvalue()
    candidates = describe_weights(out).record["candidates"]
    assert candidates[-1]["name"].startswith("mixture")
    assert re.search(rf"{candidates[-1]['name']} +\S+% +\S+% +\d+\.\d\s", shown.getvalue())  # without a weight
    assert sum(one["weight"] for one in candidates) == pytest.approx(1)
    assert all(f"{one['name']} " in shown.getvalue() for one in candidates)


def test_counts_of_validation_scenes_add_up() -> None:
    """A row's score uses the summed counts of all scenes."""
    labels = np.array([[0, 0, 1, 1]], np.uint8)
    maps = np.array([[[0, 1, 1, 0]], [[0, 0, 1, 0]]], np.uint8)  # by the overview, and in full
    scenes = [ReadTwice(*maps, gain, labels, SceneGrid(1, 4, 1)) for gain in (np.eye(4)[1], np.eye(4)[2])]
    found = figures.validate(scenes, 2)
    assert found["none"]["miou"] == mean_iou(np.array([[2, 2], [2, 2]]))
    assert found["gain"]["miou"] == mean_iou(np.array([[3, 1], [2, 2]]))  # one patch of four, by the highest gain
    assert found["all"]["miou"] == mean_iou(np.array([[4, 0], [2, 2]]))


def test_a_survey_warns_of_a_training_scene(folder: Path, out: Path) -> None:
    """A held-out scene gets no warning."""
    train_weights(_request(folder, out, hold_out=("002",), validation=0))
    notes = {}
    for number in ("001", "002"):
        scene = folder / "images" / f"{number}_image.png"
        flags = {"scene": str(scene), "source": "sim", "weights": str(out), "out": str(out.parent / "a"), "budget": 1}
        notes[number] = " ".join(open_field(load_settings(None, flags)).notes)
    assert "a training scene" in notes["001"]
    assert "a training scene" not in notes["002"]


def _cube(root: Path) -> dict[str, Any]:
    """Write a cube of 40 x 40 px with labels of its upper 10 rows, and with all; return the flags of its training."""
    labels = np.random.default_rng(4).integers(1, 3, (40, 40)).astype(np.uint8)
    np.save(root / "cube.npy", (labels[..., None] * np.ones(4)).astype(np.float32))
    np.save(root / "every.npy", labels)
    np.save(root / "some.npy", np.where(np.arange(40)[:, None] < 10, labels, 0).astype(np.uint8))
    (root / "scene.toml").write_text("unlabelled = 0\nwavelengths_nm = [500, 600, 700, 800]\n")
    return {"labels": str(root / "some.npy")}


def test_trained_pixels_are_not_judged(out: Path, tmp_path: Path) -> None:
    """Evaluations and surveys by a file of more labels keep the others only; the same labels are refused."""
    train_weights(_request(tmp_path / "cube.npy", out, **_cube(tmp_path)))
    asked = {"labels": str(tmp_path / "every.npy"), "scene": str(tmp_path / "cube.npy"), "weights": str(out)}
    labels = open_field(load_settings(None, asked | {"out": str(tmp_path / "a")})).labels.read()
    assert (labels[:10] == 255).all()
    assert (labels[10:] != 255).all()
    cube, flags = str(tmp_path / "cube.npy"), EvaluateFlags(weights=(out,), fractions="")
    content = evaluate_weights(cube, replace(flags, labels=asked["labels"], bands="0-2"))
    assert sum(content["support"].values()) == 30 * 40
    assert "trained pixels are left out of cube" in " ".join(content["data_notes"])
    with pytest.raises(SceneError, match=r"w.safetensors was trained on these labels.*or by other labelled pixels"):
        evaluate_weights(cube, replace(flags, labels=str(tmp_path / "some.npy")))


def test_copies_of_a_scene_with_other_labels_are_one_scene(out: Path, tmp_path: Path) -> None:
    """The pixels of both are trained on, so that no labelled one is left to judge."""
    _cube(tmp_path)
    (tmp_path / "cubes").mkdir()
    every, some = (np.load(tmp_path / f"{name}.npy") for name in ("every", "some"))
    for name, labels in {"a": some, "b": np.where(some > 0, 0, every)}.items():
        shutil.copy(tmp_path / "cube.npy", tmp_path / "cubes" / f"{name}.npy")
        np.save(tmp_path / "cubes" / f"{name}_gt.npy", labels)
    shutil.copy(tmp_path / "scene.toml", tmp_path / "cubes")
    train_weights(_request(tmp_path / "cubes", out))
    flags = EvaluateFlags(weights=(out,), labels=str(tmp_path / "every.npy"))
    with pytest.raises(SceneError, match="was trained on these labels"):
        evaluate_weights(str(tmp_path / "cube.npy"), flags)


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
    settings = load_settings(None, asked | {"out": str(tmp_path / "a")})
    for planning in (False, True):
        notes = " ".join(open_field(settings, planning=planning).warnings)
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


def test_scenes_of_several_laws_have_a_table_of_each(folder: Path, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The table of all is the mean of those of the laws, here of one scene each."""
    monkeypatch.setattr("spectralzoom.flows.training.train.built_in_laws", lambda dataset: ("a", "b"))
    monkeypatch.setattr("spectralzoom.flows.training.train.law_of", lambda name: name)
    scans = train_weights(_request(folder, out, validation=2, min_exposure_ms=6.0))["scans"]
    tables = list(scans["by_law"].values())
    assert [table["scenes"] for table in tables] == [1, 1]
    assert tables[0]["miou"] != tables[1]["miou"]
    np.testing.assert_allclose(np.mean([table["miou"] for table in tables], axis=0), scans["miou"])


@pytest.mark.parametrize(("darkest_ms", "said"), [(3.0, True), (100.0, False)])
def test_missing_scan_performance_is_reported_after_training(folder: Path, out: Path, darkest_ms: float, said: bool):
    """Weights have none without validation scenes; after short exposures training reports that."""
    shown = io.StringIO()
    request = _request(folder, out, validation=0, min_exposure_ms=darkest_ms)
    assert "scans" not in run_train(request, Console(file=shown, width=100))
    assert ("the file has no scan performance" in shown.getvalue()) == said


def test_whitening_uses_the_noise_of_short_exposures(folder: Path, out: Path):
    """Weights for short exposures give less weight to directions in which noise dominates."""
    sizes = []
    for darkest_ms in (100.0, 3.0):
        train_weights(_request(folder, out, validation=0, min_exposure_ms=darkest_ms))
        sizes.append(np.linalg.norm(load_weights(out).normalisation.whitening, 2))
    assert sizes[1] < sizes[0]


def test_continued_training_is_for_built_in_scenes(folder: Path, out: Path) -> None:
    """On files a training takes seconds."""
    with pytest.raises(SettingsError, match=r"--start is for built-in scenes; .*: train anew on all of them together"):
        train_weights(_request(folder, out, start=Path("first.safetensors")))


def test_training_continues_on_built_in_scenes(out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Normalisation stays; without validation scenes the mean of both networks is kept."""
    monkeypatch.setattr("spectralzoom.flows.training.data.FARM_SHAPE", (32, 48))
    # choosing takes seconds
    monkeypatch.setattr("spectralzoom.models.training.examples.chosen_effects", lambda *_: USUAL)
    train_weights(_request("farm", out, "first", scenes=1, validation=0))
    trained = flow.train
    ends: list[Any] = []
    monkeypatch.setattr(flow, "train", lambda *given, **options: ends.append(trained(*given, **options)) or ends[0])
    more: dict[str, Any] = {"scenes": 1, "validation": 0, "start": out, "seed": 1}
    record = train_weights(_request("farm", tmp_path / "b.safetensors", **more))
    first, second = load_weights(out), load_weights(tmp_path / "b.safetensors")
    assert record["started_from"] == "first"
    np.testing.assert_array_equal(second.normalisation.whitening, first.normalisation.whitening)
    networks = (one.parameters() for one in (first.segmenter, second.segmenter, ends[0][0]))
    for before, halfway, after in zip(*networks, strict=True):
        torch.testing.assert_close(after, before, atol=0.01, rtol=0)
        torch.testing.assert_close(halfway, (before + after) / 2)


@pytest.mark.parametrize(
    ("what", "common", "scenes", "dim"),
    [
        ("classes", {"names": ("a", "c")}, {}, 64),
        ("classes", {}, {"untaught": (0,)}, 64),
        ("training scenes", {}, {"train": Imaged(keys={"2": "other"})}, 64),
        ("bands", {"basis": SpectralBasis.spanning(np.linspace(500, 700, 4))}, {}, 64),
        ("sizes of the network", {}, {}, 32),
        (None, {}, {"train": Imaged(keys={"1": "one", "2": "other"})}, 64),
    ],
)
def test_continued_training_names_what_differs(
    what: str | None, common: dict[str, Any], scenes: dict[str, Any], dim: int
) -> None:
    """Classes, scenes, bands and sizes are those of the first training; more scenes are allowed."""
    nm = np.linspace(500, 800, 4)
    known = Common(SpectralBasis.spanning(nm), ("a", "b"), np.zeros((2, 3), np.uint8), 8, nm)
    begun: Any = SimpleNamespace(
        class_names=known.names,
        config=replace(network_config(known), dim=dim),
        basis=known.basis,
        record={"split": {"train": {"1": "one"}}},
    )
    usual = {"common": replace(known, **common), "untaught": (), "train": Imaged(keys={"1": "one"})}
    request = _request("farm", Path("w.safetensors"), start=Path("first"))
    with nullcontext() if what is None else pytest.raises(SettingsError, match=f"its training had other {what}; give"):
        flow.check_start(request, begun, SimpleNamespace(**usual | scenes))


def test_continued_training_has_a_lower_learning_rate() -> None:
    """Its rate is a third unless a flag sets it."""
    anew, on = (TrainFlags(start=start).settings for start in (None, Path("first.safetensors")))
    assert 3 * on.learning_rate == pytest.approx(anew.learning_rate)
    assert TrainFlags(learning_rate=2e-3).settings.learning_rate == 2e-3


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
