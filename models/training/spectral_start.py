"""The classifier that training begins from: linear discriminants on mean spectra of 5 x 5 px, fitted in seconds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
import torch
from numpy.typing import NDArray
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from torch import Tensor

from models.network.sizes import AROUND_PX
from models.training.examples import Example
from pipeline.geometry.grid import UNLABELLED

PIXELS = 60_000  # that classifiers are fitted on, of all scenes together
ABSENT = -20.0  # logit of a class that no scene has


@dataclass(frozen=True)
class LabelledPixels:
    """Features of labelled pixels and their classes."""

    features: NDArray[np.float32]  # (pixel, column) means of `AROUND_PX` x `AROUND_PX` px
    labels: NDArray[np.uint8]  # (pixel,)

    @staticmethod
    def drawn(examples: Sequence[Example], rng: np.random.Generator, most: int = PIXELS) -> LabelledPixels:
        """Draw labelled pixels of scenes by chance, of each as many as it has beside the others, ``most`` together."""
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
    """Fit shrunken linear discriminants; give them as tensors of the segmenter's ``spectral`` layer.

    A class without a pixel is as good as impossible. With one class alone nothing is told apart: all are as likely.
    """
    weight, bias = np.zeros((classes, pixels.features.shape[1])), np.full(classes, ABSENT)
    known = np.unique(pixels.labels)
    if len(known) > 1:
        fitted = LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto").fit(pixels.features, pixels.labels)
        slope, offset = fitted.coef_, fitted.intercept_
        if len(known) == 2:  # one function that tells both apart
            slope, offset = np.concatenate([0 * slope, slope]), np.concatenate([0 * offset, offset])
        weight[known], bias[known] = slope, offset
    else:
        bias[...] = 0.0
    return {
        "spectral.weight": torch.from_numpy(weight.astype(np.float32))[:, :, None, None],
        "spectral.bias": torch.from_numpy(bias.astype(np.float32)),
    }
