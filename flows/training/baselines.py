"""Classifiers of single spectra beside a training: what anybody gets from the same pixels in seconds."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from sklearn.ensemble import RandomForestClassifier
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import LogisticRegression

from flows.training.data import Report
from models.evaluation.metrics import confusion, mean_iou
from models.training.examples import Example
from models.training.start import LabelledPixels


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
