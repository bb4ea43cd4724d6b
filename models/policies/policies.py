"""Policies that score each patch for capture at full resolution, from the coarse prediction alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple, get_args

import numpy as np
import scipy
from numpy.typing import NDArray

from spectralzoom.models.network.sizes import SegmenterConfig
from spectralzoom.models.network.spectral import patches_of
from spectralzoom.models.reading.inference import CoarsePrediction
from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.pipeline.geometry.grid import SceneGrid, patch_pixels

Scores = NDArray[np.float64]
Policy = Literal["gain", "entropy", "sobel", "random", "mask"]
LEAST_FRACTION = 0.005  # of a field: rarer classes count as if they had it
POLICIES: tuple[Policy, ...] = get_args(Policy)


def score_patches(
    policy: str, seen: CoarsePrediction, *, seed: int = 0, mask: NDArray[np.generic] | None = None
) -> Scores:
    """Score every patch of the padded grid, (patches,) float64, weighted by its fraction on the scene.

    ``policy`` is one of `POLICIES`:

    - ``gain``: Expected errors of the overview, weighted by the rarity of their classes (`gain_of`).
    - ``entropy``: Entropy of the class probabilities.
    - ``sobel``: Edges of the coarse image (the paper's ED).
    - ``random``: Random numbers by ``seed``.
    - ``mask``: A (y, x) image of the scene's size (the paper's fixed attention policy); NaN counts as 0.

    Raises SettingsError for an unknown policy.
    """
    grid = seen.grid
    if policy == "gain":
        found = class_errors(seen)
        return gain_of(found[:, 0], found[:, 1].sum(axis=0))
    if policy == "random":
        scores = np.random.default_rng([seed, 0x5EA7]).random(len(grid.every_patch()))
    elif policy == "mask":
        values = np.asarray(mask, np.float64).reshape(grid.height, grid.width, -1).mean(axis=-1)
        scores = _patch_means(np.nan_to_num(values), grid)
    elif policy in PIXEL_SCORES and (of := PIXEL_SCORES[policy].of) is not None:
        scores = _patch_means(of(seen)[: grid.height, : grid.width], grid)
    else:
        raise SettingsError(f"unknown policy {policy!r}; choose one of {', '.join(POLICIES)}")
    return scores * grid.valid_fraction().ravel()


def score_multiply_adds(policy: str, config: SegmenterConfig, grid: SceneGrid) -> int:
    """Return the multiply-adds of scoring every patch of a grid."""
    score = PIXEL_SCORES.get(policy)
    if score is None:  # random or mask
        return 0
    a_pixel = score.adds + score.per_class * config.classes + score.per_column * config.columns
    return a_pixel * grid.padded_shape[0] * grid.padded_shape[1]


def pixel_entropy(probability: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the entropy over the last axis [nat]; a probability of 0 adds 0."""
    exact = probability.astype(np.float64)
    return np.asarray(-scipy.special.xlogy(exact, exact).sum(axis=-1))


def class_errors(seen: CoarsePrediction) -> NDArray[np.float64]:
    """Return expected errors and expected pixels of each class in each patch, (patch, 2, class).

    A pixel with class probabilities p has the expected errors p (1 - p). Both are means over the pixels of a patch.
    Pixels outside of the scene count as 0. The expected pixels of a class are those with data.
    """
    grid = seen.grid
    shown = seen.probability.copy()
    shown[grid.height :] = 0
    shown[:, grid.width :] = 0
    known = shown if seen.filled is None else np.where(seen.filled[..., None], np.float32(0), shown)
    images = (shown * (1 - shown), known)
    return np.stack([patches_of(one, grid.patch).mean(axis=(1, 2), dtype=np.float64) for one in images], axis=1)


def gain_of(errors: NDArray[np.float64], pixels: NDArray[np.float64]) -> Scores:
    """Return the expected errors of patches, with more weight for rare classes, (patch,).

    ``errors`` (patch, class) are those of `class_errors`, ``pixels`` (class,) the expected pixels of each class in the
    whole field. A class's part of the errors is divided by its fraction of the field, at least `LEAST_FRACTION`, and by
    the number of classes. The mean over the field is then the expected fraction of wrong pixels of a class, averaged
    over the classes. In a field without data, all classes have the same fraction.
    """
    fraction = pixels / pixels.sum() if pixels.any() else np.full(pixels.shape, 1 / len(pixels))
    weight = 1 / np.maximum(fraction, LEAST_FRACTION) / np.minimum(fraction / LEAST_FRACTION, 1).sum()
    return np.asarray(errors @ weight)


def _edges(seen: CoarsePrediction) -> NDArray[np.float64]:
    brightness = np.einsum("yxc->yx", seen.columns, dtype=np.float64) / seen.columns.shape[-1]
    down, across = (scipy.ndimage.sobel(brightness, axis=axis, mode="nearest") for axis in (0, 1))
    return np.asarray(np.hypot(down, across))


class PixelScore(NamedTuple):
    """Score of coarse pixels, with its multiply-adds a pixel."""

    of: Callable[[CoarsePrediction], NDArray[np.float64]] | None  # None: `gain_of` scores whole patches
    adds: int
    per_column: int = 0
    per_class: int = 0


PIXEL_SCORES = {  # of the coarse prediction
    "gain": PixelScore(None, 0, per_class=2),
    "entropy": PixelScore(lambda seen: pixel_entropy(seen.probability), 2, per_class=1),
    "sobel": PixelScore(_edges, 19, per_column=1),
}
SEEING_POLICIES = tuple(PIXEL_SCORES)  # depend on the surroundings alone: a large field is scored in parts
GLANCING_POLICIES = ("gain", "entropy")  # depend on the network's prediction


def _patch_means(pixels: NDArray[np.float64], grid: SceneGrid) -> Scores:
    """Return the mean over the pixels (y, x) of the scene in each patch; 0 without a pixel."""
    total, count = (patch_pixels(grid, image).sum(axis=(1, 2)) for image in (pixels, np.ones(pixels.shape)))
    return np.asarray(np.divide(total, count, out=np.zeros(total.shape), where=count > 0))
