"""Initial weights of a training: linear discriminants of mean spectra."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
import torch
from numpy.typing import NDArray
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from torch import Tensor, nn

from models.evaluation.metrics import confusion, mean_iou
from models.network.sizes import AROUND_PX
from models.reading.inference import map_of_columns
from models.training.examples import Example
from models.weights.files import Weights
from pipeline.geometry.grid import UNLABELLED, SceneGrid

PIXELS = 60_000  # to fit classifiers to, of all scenes together
ABSENT = -20.0  # logit of a class without a pixel


@dataclass(frozen=True)
class LabelledPixels:
    """Features of labelled pixels and their classes."""

    features: NDArray[np.float32]  # (pixel, column) means of `AROUND_PX` x `AROUND_PX` px
    labels: NDArray[np.uint8]  # (pixel,)

    @staticmethod
    def drawn(examples: Sequence[Example], rng: np.random.Generator, most: int = PIXELS) -> LabelledPixels:
        """Draw labelled pixels at random, ``most`` together, from each scene in proportion to its number."""
        counts = [int(np.count_nonzero(one.labels != UNLABELLED)) for one in examples]
        fraction = min(1.0, most / max(sum(counts), 1))
        features, labels = [], []
        for example, count in zip(examples, counts, strict=True):
            places = np.flatnonzero(example.labels != UNLABELLED)
            places = np.sort(rng.choice(places, min(count, math.ceil(count * fraction)), replace=False))
            size = (AROUND_PX, AROUND_PX, 1)
            means = scipy.ndimage.uniform_filter(example.columns.astype(np.float32), size, mode="nearest")
            features.append(means.reshape(-1, means.shape[-1])[places])
            labels.append(example.labels.ravel()[places])
        return LabelledPixels(np.concatenate(features), np.concatenate(labels))


def linear_discriminants(pixels: LabelledPixels, classes: int) -> dict[str, Tensor]:
    """Fit linear discriminants with shrinkage; return them as tensors of the segmenter's ``spectral`` layer.

    A class without a pixel gets the logit `ABSENT`. With pixels of a single class all classes are equally likely.
    """
    weight, bias = np.zeros((classes, pixels.features.shape[1])), np.full(classes, ABSENT)
    known = np.unique(pixels.labels)
    if len(known) > 1:
        fitted = LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto").fit(pixels.features, pixels.labels)
        slope, offset = fitted.coef_, fitted.intercept_
        if len(known) == 2:  # one function separates both
            slope, offset = np.concatenate([0 * slope, slope]), np.concatenate([0 * offset, offset])
        weight[known], bias[known] = slope, offset
    else:
        bias[...] = 0.0
    return {
        "spectral.weight": torch.from_numpy(weight.astype(np.float32))[:, :, None, None],
        "spectral.bias": torch.from_numpy(bias.astype(np.float32)),
    }


def better_reading(
    weights: Weights, start: Mapping[str, Tensor], validation: Sequence[Example]
) -> tuple[Weights, dict[str, Any]]:
    """Choose the better of the trained network and its initial linear discriminants, by mIoU of validation scenes.

    Returns the better weights, and both scores.
    """
    plain = copy.deepcopy(weights.segmenter)
    plain.load_state_dict(dict(start), strict=False)
    for last in (plain.overview_classes, plain.full_classes):
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)  # type: ignore[arg-type]
    readings = {"network": weights, "linear discriminants": replace(weights, segmenter=plain)}
    scores = {name: _miou(one, validation) for name, one in readings.items()}
    kept = max(scores, key=lambda name: scores[name])  # the network on a tie
    return readings[kept], {"miou": scores, "kept": kept}


def _miou(weights: Weights, examples: Sequence[Example]) -> float:
    """Return the mIoU of all scenes together, by every line at the reference exposure."""
    counts = np.zeros((weights.config.classes,) * 2, np.int64)
    for example in examples:
        grid = SceneGrid(*example.shape, weights.config.patch, 1)
        drawn, _ = map_of_columns(weights, example.columns.astype(np.float32), grid)
        counts += confusion(example.labels[: grid.height, : grid.width], drawn.classes, weights.config.classes)
    return mean_iou(counts)
