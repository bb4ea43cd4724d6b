"""Attention policies: their scores of patches, also at the border of the scene."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from spectralzoom.models.policies.policies import (
    LEAST_FRACTION,
    POLICIES,
    class_errors,
    gain_of,
    pixel_entropy,
    score_patches,
)
from spectralzoom.models.reading.inference import CoarsePrediction
from spectralzoom.pipeline.geometry.grid import SceneGrid


def _coarse_prediction(height: int = 32, width: int = 48, patch: int = 8) -> CoarsePrediction:
    """Return the coarse prediction of a flat scene, equally unsure everywhere."""
    grid = SceneGrid(height, width, patch)
    columns, probability = (np.full((*grid.padded_shape, n), 1 / n, np.float32) for n in (3, 4))
    return CoarsePrediction(grid, columns, probability)


@pytest.mark.parametrize("classes", [2, 5, 12])
def test_entropy_ranges_from_0_to_the_log_of_classes(classes: int):
    """Certainty gives 0 without a NaN, equal probabilities give ln(classes), and the order does not count."""
    sure, even = np.eye(classes)[0], np.full(classes, 1 / classes)
    assert pixel_entropy(np.stack([sure, even])) == pytest.approx([0, np.log(classes)])
    drawn = np.random.default_rng(0).dirichlet(np.ones(classes), 20)
    assert pixel_entropy(drawn[:, ::-1]) == pytest.approx(pixel_entropy(drawn))


def _of_classes(*probability: tuple[float, ...], filled: NDArray[np.bool_] | None = None) -> CoarsePrediction:
    """Return patches of one pixel in a row, each with its own probabilities."""
    shown = np.array([probability], np.float32)
    return CoarsePrediction(SceneGrid(1, len(probability), 1), shown, shown, filled=filled)


@given(st.integers(0, 2**32 - 1), st.integers(2, 6))
def test_the_mean_gain_is_the_mean_error_of_classes(seed: int, classes: int):
    """A class's error is the expected fraction of its pixels that has another class; no class is rare here."""
    shown = np.random.default_rng(seed).dirichlet(np.ones(classes), 400)
    of_class = (shown * (1 - shown)).sum(axis=0) / shown.sum(axis=0)
    assert score_patches("gain", _of_classes(*shown)).mean() == pytest.approx(of_class.mean(), rel=1e-4)


def test_an_error_in_a_rare_class_counts_more():
    """Errors are divided by their class's fraction of the scene; patches without doubt score 0."""
    seen = _of_classes(*[(1.0, 0.0, 0.0)] * 89, *[(0.0, 1.0, 0.0)] * 9, (0.5, 0.0, 0.5), (0.0, 0.5, 0.5))
    scores = score_patches("gain", seen)
    assert not scores[:-2].any()
    share = np.array([0.895, 0.095, 0.01])
    assert scores[-2:] == pytest.approx([np.sum(0.25 / share[[one, 2]]) / 3 for one in (0, 1)], rel=1e-4)


def test_the_weight_of_a_class_has_a_limit():
    """A class of a thousandth of the scene counts as one of `LEAST_FRACTION`, and as a part of a class in the mean."""
    scores = score_patches("gain", _of_classes(*[(1.0, 0.0)] * 499, (0.5, 0.5)))
    assert scores[-1] == pytest.approx((0.25 / 0.999 + 0.25 / LEAST_FRACTION) / (1 + 0.001 / LEAST_FRACTION), rel=1e-4)


def test_pixels_without_data_do_not_count_in_fractions():
    """Class fractions are those of pixels with data; without any, all classes have the same."""
    shown = [(0.5, 0.5), (0.5, 0.5), (1.0, 0.0)]
    alone, every = (_of_classes(*shown, filled=np.array([[False, False, lost]])) for lost in (True, False))
    assert score_patches("gain", alone)[0] == pytest.approx(0.5)
    assert score_patches("gain", every)[0] == pytest.approx((0.25 * 3 / 2 + 0.25 * 3) / 2)
    assert score_patches("gain", _of_classes(*shown, filled=np.ones((1, 3), np.bool_))) == pytest.approx([0.5, 0.5, 0])


def test_entropy_scores_unsure_pixels():
    """A patch scores by the mean over its own pixels; patches without unsure pixels score 0."""
    seen = _coarse_prediction()
    seen.probability[...] = [1, 0, 0, 0]
    seen.probability[8:16, 16:24] = [0.5, 0.5, 0, 0]  # the patch at row 1, column 2
    scores = score_patches("entropy", seen).reshape(4, 6)
    assert scores[1, 2] == pytest.approx(np.log(2))
    scores[1, 2] = 0
    assert not scores.any()


def test_sobel_scores_edges():
    """A step between two columns of patches scores in both and nowhere else."""
    seen = _coarse_prediction()
    seen.columns[:, :16] = 0.1
    scores = score_patches("sobel", seen).reshape(4, 6)
    assert (scores[:, [1, 2]] > 0.1).all()
    assert scores[:, [0, 3, 4, 5]] == pytest.approx(0, abs=1e-12)


def test_random_follows_its_seed():
    """The same seed gives the same scores, another seed others."""
    first, same, other = (score_patches("random", _coarse_prediction(), seed=seed) for seed in (1, 1, 2))
    assert (first == same).all()
    assert (first != other).all()


def test_a_mask_is_averaged_over_each_patch():
    """The mask may be grey or colour."""
    mask = np.random.default_rng(2).integers(0, 256, (32, 48), dtype=np.uint8)
    expected = mask.reshape(4, 8, 6, 8).mean(axis=(1, 3)).ravel()
    assert score_patches("mask", _coarse_prediction(), mask=mask) == pytest.approx(expected)
    colour = np.repeat(mask[..., None], 3, axis=-1)
    assert score_patches("mask", _coarse_prediction(), mask=colour) == pytest.approx(expected)


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("size", [(37, 53), (1, 1), (8, 8), (33, 16), (1, 40)])
def test_every_patch_has_a_finite_score(policy: str, size: tuple[int, int]):
    """Scores are the same each time, for any size of the scene."""
    seen = _coarse_prediction(*size)
    seen.columns[...] = np.random.default_rng(3).random(seen.columns.shape)
    scores = score_patches(policy, seen, mask=np.ones(size))
    assert (score_patches(policy, seen, mask=np.ones(size)) == scores).all()
    assert scores.dtype == np.float64
    assert scores.shape == (np.prod(seen.grid.patch_shape),)
    assert np.isfinite(scores).all()


@pytest.mark.parametrize("policy", ["entropy", "mask", "gain"])
def test_a_border_patch_scores_by_its_fraction(policy: str):
    """On a uniform scene a patch scores in proportion to its pixels on the scene."""
    seen = _coarse_prediction(37, 53)
    scores = score_patches(policy, seen, mask=np.full((37, 53), np.log(4)))
    level = 0.75 if policy == "gain" else np.log(4)
    assert scores == pytest.approx(level * seen.grid.valid_fraction().ravel(), abs=1e-6)


def test_class_fractions_are_those_of_the_field():
    """Parts of a field score as they do together; a class that is rare in one may be frequent in another."""
    shown = np.random.default_rng(1).dirichlet((8, 1, 1), 12)
    field = _of_classes(*shown)
    parts = [class_errors(_of_classes(*some)) for some in (shown[:4], shown[4:])]
    pixels = np.concatenate(parts)[:, 1].sum(axis=0)
    scores = np.concatenate([gain_of(part[:, 0], pixels) for part in parts])
    assert scores == pytest.approx(score_patches("gain", field))
    assert scores[:4] != pytest.approx(score_patches("gain", _of_classes(*shown[:4])))
