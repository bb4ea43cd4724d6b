"""Twenty small labelled tiles of a user: `spectralzoom train` against classifiers of scikit-learn.

Indian Pines is cut into 5 x 4 tiles of 29 x 36 px and 200 bands. Three times, a third of them is held out for testing,
and the rest trains, by the command with --validation 0. The peers read every band of the same camera's image, as means
of 5 x 5 px of a tile.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from bench_pines import SCENE, WINDOW, exposed
from measure import Row, data_folder, not_run
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.ensemble import RandomForestClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from flows.cli.model_verbs import TrainFlags
from flows.evaluate.frames import observe_frame
from flows.training.data import TrainingData, load_data_set, open_training_data
from flows.training.train import train_weights
from models.evaluation.metrics import confusion, mean_iou, overall_accuracy
from models.reading.inference import segment
from models.weights.files import Weights, load_weights
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import UNLABELLED

DOWN = 5
ACROSS = 4
FOLDS = 3
Counts = NDArray[np.int64]


def rows() -> list[Row]:
    """Return mIoU and overall accuracy of the network and the classifiers, for every fold and for all together."""
    folder = data_folder("indian_pines")
    if not (folder / SCENE).is_file():
        return [not_run("20 tiles of Indian Pines", folder)]
    found: list[dict[str, Counts]] = []
    table = []
    with tempfile.TemporaryDirectory() as name:
        write_tiles(folder, Path(name))
        for fold in range(FOLDS):
            began = time.process_time()
            found.append(judge_fold(Path(name), fold))
            table.append(_row(f"third {fold}", found[-1], f"{time.process_time() - began:.0f} s of processor"))
    return [*table, _row("all 20 tiles", {way: np.sum([one[way] for one in found], axis=0) for way in found[0]}, "")]


def _row(what: str, counts: dict[str, Counts], words: str) -> Row:
    figures = {way: f"{mean_iou(one):.1%} ({overall_accuracy(one):.1%})" for way, one in counts.items()}
    best = max((way for way in counts if way != "network"), key=lambda way: mean_iou(counts[way]))
    peers = ", ".join(f"{way} {figure}" for way, figure in figures.items() if way != "network")
    met = mean_iou(counts["network"]) >= mean_iou(counts[best])
    return Row(f"{what}: mIoU (right pixels)", figures["network"], f">= {best}", met, f"{peers}; {words}")


def write_tiles(folder: Path, out: Path) -> None:
    """Write the scene's tiles as files for `train`: ``images``, ``labels`` and ``scene.toml``."""
    cube, labels = np.load(folder / SCENE), np.load(folder / "Indian_pines_gt.npy")
    rows, columns = cube.shape[0] // DOWN, cube.shape[1] // ACROSS
    for name in ("images", "labels"):
        (out / name).mkdir()
    known = load_data_set(folder / SCENE).load(Path(SCENE).stem).wavelength_nm
    about = f"unlabelled = 0\nwavelengths_nm = {np.asarray(known).tolist()}\n"
    (out / "scene.toml").write_text(about, encoding="utf-8")
    for tile in range(DOWN * ACROSS):
        y, x = tile // ACROSS * rows, tile % ACROSS * columns
        np.save(out / "images" / f"{tile:02}.npy", cube[y : y + rows, x : x + columns])
        np.save(out / "labels" / f"{tile:02}.npy", labels[y : y + rows, x : x + columns].astype(np.uint8))


def judge_fold(tiles: Path, fold: int) -> dict[str, Counts]:
    """Train on two thirds of the tiles; return confusion counts of the others, by the network and each classifier."""
    held = tuple(f"{tile:02}" for tile in range(fold, DOWN * ACROSS, FOLDS))
    out = tiles.parent / f"{tiles.name}-{fold}.safetensors"
    train_weights(TrainFlags(seed=fold, hold_out=",".join(held), validation=0).request(str(tiles), out, "bench_tiles"))
    weights = load_weights(out)
    out.unlink()
    data = open_training_data(str(tiles), 0, None, LineCamera())
    classes = weights.config.classes
    found = {"network": np.zeros((classes, classes), np.int64)}
    for name in held:
        frame = observe_frame(data.scene(name), name, weights, LineCamera(), fold)
        every = np.arange(len(frame.fine))
        found["network"] += confusion(frame.labels, segment(weights, frame.seen, frame.fine, every).classes, classes)
    others = [name for name in data.train if name not in held]
    learnt, judged = (_pixels(data, some, weights, fold) for some in (others, held))
    for name, classifier in _classifiers().items():  # each learns every labelled pixel of the training tiles
        drawn = classifier.fit(*learnt).predict(judged[0]).astype(np.uint8)
        found[name] = confusion(judged[1], drawn, classes)
    return found


def _pixels(data: TrainingData, names: Sequence[str], weights: Weights, seed: int) -> tuple[Any, Any]:
    """Return (pixel, band) means of labelled pixels in the camera's image, and their classes (pixel,)."""
    values, classes = [], []
    for name in names:
        scene = data.scene(name)
        labels = scene.labels
        assert labels is not None
        assert scene.class_names == weights.class_names
        seen = uniform_filter(exposed(scene, [seed, int(name)]), (WINDOW, WINDOW, 1), mode="nearest")
        values.append(seen[labels != UNLABELLED])
        classes.append(labels[labels != UNLABELLED])
    return np.concatenate(values), np.concatenate(classes)


def _classifiers() -> dict[str, Any]:
    return {
        "LDA": LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto"),
        "logistic regression": make_pipeline(StandardScaler(), LogisticRegression(max_iter=1000)),
        "random forest": RandomForestClassifier(200, random_state=0),
    }
