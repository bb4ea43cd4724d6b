"""Classifiers of single spectra beside a training: what anybody gets from the same pixels in seconds."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from sklearn.ensemble import RandomForestClassifier
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import LogisticRegression
from torch import Tensor, nn

from flows.training.data import Report
from models.evaluation.metrics import confusion, mean_iou
from models.reading.inference import map_of_columns
from models.training.examples import Example
from models.training.spectral_start import LabelledPixels
from models.weights.files import Weights
from pipeline.geometry.grid import SceneGrid


def judge_baselines(
    train: Sequence[Example], validation: Sequence[Example], classes: int, seed: int, report: Report
) -> dict[str, float] | None:
    """Return the mIoU of logistic regression and a random forest on pixels of validation scenes.

    Both read what `linear_discriminants` does. None without a scene to judge on, or with one class to learn.
    """
    rng = np.random.default_rng([seed, 0xBA5])
    if not validation or len(np.unique((learnt := LabelledPixels.drawn(train, rng)).labels)) < 2:
        return None
    judged = LabelledPixels.drawn(validation, rng)
    found = dict[str, float]()
    for name, classifier in {
        "logistic regression": LogisticRegression(max_iter=200),
        "random forest": RandomForestClassifier(100, min_samples_leaf=2, random_state=seed),
    }.items():
        report("fitting classifiers to stand beside", len(found) / 2, name)
        with warnings.catch_warnings(action="ignore", category=ConvergenceWarning):  # nearly there is as good
            classifier.fit(learnt.features, learnt.labels)
        drawn = classifier.predict(judged.features).astype(np.uint8)
        found[name] = mean_iou(confusion(judged.labels, drawn, classes))
    return found


def better_reading(
    weights: Weights, start: Mapping[str, Tensor], validation: Sequence[Example]
) -> tuple[Weights, dict[str, Any]]:
    """Choose between the network and the linear discriminants that it began as, by the mIoU of validation scenes.

    The second are the same network with nothing added to them. Returns the better, and both scores.
    """
    plain = copy.deepcopy(weights.segmenter)
    plain.load_state_dict(dict(start), strict=False)
    for last in (plain.overview_classes, plain.full_classes):
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)  # type: ignore[arg-type]
    readings = {"network": weights, "linear discriminants": replace(weights, segmenter=plain)}
    scores = {name: _miou(one, validation) for name, one in readings.items()}
    kept = max(scores, key=lambda name: scores[name])  # the network where both are as good
    return readings[kept], {"miou": scores, "kept": kept}


def _miou(weights: Weights, examples: Sequence[Example]) -> float:
    """Return the mIoU of all scenes' maps together, by every line of the reference exposure."""
    counts = np.zeros((weights.config.classes,) * 2, np.int64)
    for example in examples:
        grid = SceneGrid(*example.shape, weights.config.patch, 1)
        drawn, _ = map_of_columns(weights, example.columns.astype(np.float32), grid)
        counts += confusion(example.labels[: grid.height, : grid.width], drawn.classes, weights.config.classes)
    return mean_iou(counts)
