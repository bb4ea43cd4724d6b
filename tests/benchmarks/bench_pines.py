"""Indian Pines, trained and tested on halves of the same fields: the segmenter against LDA, SVM and random forest.

All methods read the spectra of the simulated camera with blur and noise, as in surveys and `spectralzoom train`. The
peers read every band, as single pixels and as means of 5 x 5 px. Their settings are chosen on the training pixels
alone, one half of each field against the other, like the test halves.
`bench_pines.py --weights FILE` evaluates given weights instead of training some. Set OMP_NUM_THREADS=1.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from measure import Row, data_folder, not_run, print_rows
from numpy.typing import NDArray
from scipy.ndimage import label, uniform_filter
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.ensemble import RandomForestClassifier
from sklearn.model_selection import GridSearchCV
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC

from spectralzoom.flows.evaluate.frames import observe_frame
from spectralzoom.flows.settings.model_flags import TrainFlags
from spectralzoom.flows.tasks.scene import scene_of_file
from spectralzoom.flows.training.data import load_data_set
from spectralzoom.flows.training.train import train_weights
from spectralzoom.flows.training.train_scenes import TrainRequest
from spectralzoom.models.evaluation.metrics import average_accuracy, confusion, kappa, overall_accuracy
from spectralzoom.models.network.machine import one_thread
from spectralzoom.models.policies.policies import score_patches
from spectralzoom.models.reading.inference import CoarsePrediction, coarse_prediction_of_columns, segment
from spectralzoom.models.training.examples import electrons_of
from spectralzoom.models.weights.files import Weights, load_weights
from spectralzoom.pipeline.geometry.camera import LineCamera, expose, footprint
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.pipeline.planning.coverage import frame_patches
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene

SCENE, MASK = "Indian_pines_corrected.npy", "indianpines_disjoint_dset.mat"
MASK_CLASSES = (2, 3, 5, 6, 8, 10, 11, 12, 14, 1, 4, 7, 9, 13, 15, 16)  # classes of the labels by the mask's numbers
WINDOW = 5  # px a side of the means in the second round of the peers
FRACTIONS = (0.0, 0.1, 0.2, 0.35, 1.0)  # of the patches, by entropy

Values = NDArray[np.float32]
Labels = NDArray[np.uint8]


@dataclass(frozen=True)
class Split:
    """The scene with training labels and test labels, 255 elsewhere."""

    values: Values  # (y, x, band)
    train: Labels
    test: Labels
    classes: int


@dataclass(frozen=True)
class Result:
    """Test counts of one method, and its processor time."""

    name: str
    counts: NDArray[np.int64]
    cpu_s: float
    words: str
    every: bool = False  # the segmenter with every patch

    @property
    def figures(self) -> tuple[float, float, float]:
        """Return overall accuracy, average accuracy and kappa."""
        return overall_accuracy(self.counts), average_accuracy(self.counts), kappa(self.counts)


def rows(weights: Sequence[Path] = ()) -> list[Row]:
    """Return a row for each method; our goal is the best peer on the same input. Without weights, ours is trained."""
    folder = data_folder("indian_pines")
    if not (folder / SCENE).is_file():
        return [not_run("Indian Pines, disjoint halves", folder)]
    split = replace(_open(folder), values=exposed(_scene(folder), 0))
    with tempfile.TemporaryDirectory() as name:
        found = [one for path in weights or (_trained(folder, Path(name)),) for one in _through_camera(folder, path)]
    peers = _peers(split)
    bars = [max(peer.figures[number] for peer in peers) for number in range(3)]
    goal = f"> {bars[0]:.1%} {bars[1]:.1%} {bars[2]:.3f}"
    shown = [
        _row(one, goal, all(a > b for a, b in zip(one.figures, bars, strict=True))) if one.every else _row(one)
        for one in found
    ]
    return [*shown, *map(_row, peers)]


def _row(one: Result, goal: str = "", met: bool | None = None) -> Row:
    overall, average, agreement = one.figures
    figure = f"{overall:.1%} {average:.1%} {agreement:.3f}"
    return Row(f"{one.name}: overall, average, kappa", figure, goal, met, f"{one.cpu_s:.1f} s CPU; {one.words}")


def _choices(folder: Path) -> dict[str, Any]:
    return {"train_mask": str(folder / MASK), "mask_classes": MASK_CLASSES}


def _open(folder: Path) -> Split:
    files = load_data_set(folder / SCENE, **_choices(folder))
    train, every = (files.load(Path(SCENE).stem, training=part) for part in (True, False))
    assert train.labels is not None
    assert every.labels is not None
    test = np.where(train.labels == UNLABELLED, every.labels, np.uint8(UNLABELLED))
    return Split(np.asarray(train.values, np.float32), train.labels, test, len(train.class_names))


def halves(labels: Labels) -> NDArray[np.int64]:
    """Cut each connected field of one class in two across its longer side: 0 and 1, -1 for unlabelled pixels."""
    half = np.full(labels.shape, -1)
    for number in np.unique(labels[labels != UNLABELLED]):
        fields, count = label(labels == number)
        for one in range(1, count + 1):
            y, x = np.nonzero(fields == one)
            along = y if np.ptp(y) >= np.ptp(x) else x
            half[y, x] = along > np.median(along)
    return half


def _peers(split: Split) -> list[Result]:
    smooth = np.asarray(uniform_filter(split.values, (WINDOW, WINDOW, 1), mode="reflect"), np.float32)
    scan_passes = {"single spectra": split.values, f"{WINDOW} x {WINDOW} px": smooth}
    return [
        _peer(f"{name}, {scan_pass}", values, split, *made)
        for scan_pass, values in scan_passes.items()
        for name, made in _classifiers().items()
    ]


def _classifiers() -> dict[str, tuple[Any, dict[str, list[Any]]]]:
    forest: dict[str, list[Any]] = {"max_features": ["sqrt", 40]}
    svm: dict[str, list[Any]] = {"svc__C": [10, 100, 1000], "svc__gamma": [3e-4, 1e-3, 3e-3, 1e-2]}
    return {
        "LDA": (LinearDiscriminantAnalysis(solver="lsqr"), {"shrinkage": [1e-6, 1e-5, 1e-4, 1e-3, 1e-2]}),
        "SVM": (make_pipeline(StandardScaler(), SVC()), svm),
        "random forest": (RandomForestClassifier(200, random_state=0), forest),
    }


def _peer(name: str, values: Values, split: Split, classifier: Any, grid: dict[str, list[Any]]) -> Result:
    began = time.process_time()
    taught = split.train != UNLABELLED
    half = halves(split.train)[taught]
    folds = [(np.flatnonzero(half == one), np.flatnonzero(half != one)) for one in (0, 1)]
    search = GridSearchCV(classifier, grid, cv=folds).fit(values[taught], split.train[taught])
    judged = split.test != UNLABELLED
    chosen = ", ".join(f"{key.rpartition('__')[2]} {value}" for key, value in search.best_params_.items())
    counts = confusion(split.test[judged], search.predict(values[judged]).astype(np.uint8), split.classes)
    return Result(name, counts, time.process_time() - began, f"{chosen} chosen on the training halves")


def _trained(folder: Path, out: Path) -> Path:
    path = out / "pines.safetensors"
    classes = ",".join(map(str, MASK_CLASSES))
    flags = TrainFlags(train_mask=str(folder / MASK), mask_classes=classes, steps=300, minutes=120)
    train_weights(TrainRequest(str(folder / SCENE), path, flags))
    return path


def _scene(folder: Path) -> RasterScene:
    return scene_of_file(load_data_set(folder / SCENE).load(Path(SCENE).stem), LineCamera())


def exposed(scene: RasterScene, seed: int | Sequence[int]) -> Values:
    """Return a fine exposure of a scene, (y, x, band), as the fine pass of the training before its columns."""
    camera = LineCamera()
    electrons = electrons_of(scene, footprint(np.asarray(scene.planes, np.float32), camera), camera)
    values = expose(electrons, camera, rng=np.random.default_rng(seed))
    return np.asarray(values * (scene.white_reference / scene.white_reference_electrons), np.float32)


def _through_camera(folder: Path, path: Path) -> list[Result]:
    weights = load_weights(path)
    scene = _scene(folder)
    if scene.key not in weights.record.get("split", {}).get("pixels", {}):
        raise ValueError(f"{path} was not trained with --train-mask on {SCENE}: its test pixels may have taught it")
    scan_pass = observe_frame(scene, scene.name, weights, LineCamera(), 0)
    return _judged(weights, scan_pass.seen, scan_pass.fine, scan_pass.labels)


def _judged(weights: Weights, seen: CoarsePrediction, fine: Values, labels: Labels) -> list[Result]:
    """Return the results with several fractions of the patches, chosen by entropy."""
    training = weights.record["training"]
    found = []
    words = f"a map; training {training.get('processor_seconds', 0)} s CPU, {training['steps']} steps"
    with one_thread():
        for fraction in FRACTIONS:
            began = time.process_time()
            observation = coarse_prediction_of_columns(weights, seen.columns, seen.grid)
            patch_index = frame_patches(score_patches("entropy", observation), fraction)
            drawn = segment(weights, observation, fine[patch_index], patch_index).classes
            spent = time.process_time() - began
            counts = confusion(labels, drawn, weights.config.classes)
            name = f"segmenter, {100 * fraction:.0f} % of patches"
            found.append(Result(name, counts, spent, words, fraction == 1))
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Indian Pines beside LDA, SVM and random forest.")
    parser.add_argument("--weights", type=Path, action="append", default=[], metavar="FILE", help="several are seeds")
    print_rows(rows(parser.parse_args().weights))
