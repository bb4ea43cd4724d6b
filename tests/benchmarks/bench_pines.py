"""Indian Pines, trained and tested on halves of the same fields: `train` against LDA, SVM and random forest.

The peers read every band, of single pixels and as means of 5 x 5 px. Their settings are chosen on the training pixels
alone, one half of each field against the other, like the test halves. Set OMP_NUM_THREADS=1.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from measure import Row, data_folder, not_run, print_rows
from numpy.typing import NDArray
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.ensemble import RandomForestClassifier
from sklearn.model_selection import GridSearchCV
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC

from spectralzoom.flows.evaluate.command import evaluate_weights
from spectralzoom.flows.settings.model_flags import EvaluateFlags, TrainFlags
from spectralzoom.flows.training.train import train_weights
from spectralzoom.flows.training.train_scenes import TrainRequest

SCENE, LABELS, MASK = "Indian_pines_corrected.npy", "Indian_pines_gt.npy", "indianpines_disjoint_dset.mat"
MASK_CLASSES = (0, 2, 3, 5, 6, 8, 10, 11, 12, 14, 1, 4, 7, 9, 13, 15, 16)  # the labels' number of each of the mask's
SEEDS = (0, 1, 2)
WINDOW = 5  # px
PEERS: dict[str, tuple[Any, dict[str, list[Any]]]] = {
    "LDA": (LinearDiscriminantAnalysis(solver="lsqr"), {"shrinkage": [1e-6, 1e-5, 1e-4, 1e-3, 1e-2]}),
    "SVM": (
        make_pipeline(StandardScaler(), SVC()),
        {"svc__C": [10, 100, 1000], "svc__gamma": [3e-4, 1e-3, 3e-3, 1e-2]},
    ),
    "random forest": (RandomForestClassifier(200, random_state=0), {"max_features": ["sqrt", 40]}),
}
Labels = NDArray[np.uint8]  # (y, x), 0 unlabelled


def rows() -> list[Row]:
    """Return a row for each seed and peer; our goal is the best peer."""
    folder = data_folder("indian_pines")
    if not (folder / SCENE).is_file():
        return [not_run("Indian Pines, disjoint halves", folder)]
    every = np.load(folder / LABELS)
    (mask,) = (one for one in scipy.io.loadmat(folder / MASK).values() if np.shape(one) == every.shape)
    train = np.where(np.array(MASK_CLASSES)[mask] == every, every, 0).astype(np.uint8)
    peers = [_peer(name, folder, train, np.where(train, 0, every)) for name in PEERS]
    best = max(float(peer.figure.split()[0]) for pair in peers for peer in pair)
    return [*(_ours(folder, train, seed, best) for seed in SEEDS), *(row for pair in peers for row in pair)]


def _ours(folder: Path, train: Labels, seed: int, goal: float) -> Row:
    with tempfile.TemporaryDirectory() as name:
        labels, out = Path(name, "train.npy"), Path(name, "pines.safetensors")
        np.save(labels, train)
        began = time.process_time()
        train_weights(TrainRequest(str(folder / SCENE), out, TrainFlags(labels=str(labels), seed=seed)))
        spent = time.process_time() - began
        every = evaluate_weights(str(folder / SCENE), EvaluateFlags(weights=(out,), fractions=""))["rows"][-1]
    right = 100 * every["pixel_accuracy"]
    figure = f"{right:.1f} {100 * every['miou']:.1f}"
    return Row(f"seed {seed}: right, mIoU [%]", figure, f"> {goal:.1f}", right > goal, f"{spent:.0f} s CPU")


def _peer(name: str, folder: Path, train: Labels, test: Labels) -> list[Row]:
    values = np.load(folder / SCENE).astype(np.float32)
    half, (classifier, grid) = _halves(train)[train > 0], PEERS[name]
    folds = [(np.flatnonzero(half == one), np.flatnonzero(half != one)) for one in (0, 1)]
    found = []
    for side in (1, WINDOW):
        image = scipy.ndimage.uniform_filter(values, (side, side, 1), mode="reflect")
        search = GridSearchCV(classifier, grid, cv=folds).fit(image[train > 0], train[train > 0])
        right = 100 * search.score(image[test > 0], test[test > 0])
        found.append(Row(f"{name}, {side} x {side} px: right [%]", f"{right:.1f}", peers=str(search.best_params_)))
    return found


def _halves(labels: Labels) -> NDArray[np.int64]:
    """Cut each connected field of one class in two across its longer side: 0 and 1, -1 for unlabelled pixels."""
    half = np.full(labels.shape, -1)
    for number in np.unique(labels[labels > 0]):
        fields, count = scipy.ndimage.label(labels == number)
        for one in range(1, count + 1):
            y, x = np.nonzero(fields == one)
            along = y if np.ptp(y) >= np.ptp(x) else x
            half[y, x] = along > np.median(along)
    return half


if __name__ == "__main__":
    print_rows(rows())
