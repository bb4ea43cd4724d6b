"""Classifiers of single spectra beside a training: what the same pixels give in seconds."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence

import numpy as np
import scipy
from numpy.typing import NDArray
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.ensemble import RandomForestClassifier
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import LogisticRegression

from flows.training.data import Report
from models.evaluation.metrics import confusion, mean_iou
from models.training.examples import Example
from pipeline.geometry.grid import UNLABELLED

AROUND_PX = 5  # pixels a side whose mean spectrum the classifiers read
PIXELS = 60_000  # that they are fitted and judged on, of all scenes together


def judge_baselines(
    train: Sequence[Example], validation: Sequence[Example], classes: int, seed: int, report: Report
) -> dict[str, float] | None:
    """Return the mIoU of linear discriminants, logistic regression and a random forest on scenes kept for validation.

    All read the mean spectra of 5 x 5 px. None without a scene to judge on, or with one class to learn.
    """
    rng = np.random.default_rng([seed, 0xBA5])
    if not validation or len(np.unique((learnt := labelled_pixels(train, rng))[1])) < 2:
        return None
    features, labels = labelled_pixels(validation, rng)
    found = dict[str, float]()
    for name, classifier in {
        "linear discriminants": LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto"),
        "logistic regression": LogisticRegression(max_iter=200),
        "random forest": RandomForestClassifier(100, min_samples_leaf=2, random_state=seed),
    }.items():
        report("fitting classifiers to stand beside", len(found) / 3, name)
        with warnings.catch_warnings(action="ignore", category=ConvergenceWarning):  # nearly there is as good
            classifier.fit(*learnt)
        found[name] = mean_iou(confusion(labels, classifier.predict(features).astype(np.uint8), classes))
    return found


def labelled_pixels(
    examples: Sequence[Example], rng: np.random.Generator, most: int = PIXELS
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Draw labelled pixels by chance, the same fraction of each scene: mean spectra (pixel, column) and classes."""
    counts = [int(np.count_nonzero(one.labels != UNLABELLED)) for one in examples]
    fraction = min(1.0, most / max(sum(counts), 1))
    features, labels = [], []
    for example, count in zip(examples, counts, strict=True):
        places = np.flatnonzero(example.labels != UNLABELLED)
        places = np.sort(rng.choice(places, min(count, math.ceil(count * fraction)), replace=False))
        size = (AROUND_PX, AROUND_PX, 1)
        means = scipy.ndimage.uniform_filter(example.fine.astype(np.float32), size, mode="nearest")
        features.append(means.reshape(-1, means.shape[-1])[places])
        labels.append(example.labels.ravel()[places])
    return np.concatenate(features), np.concatenate(labels)
