"""Attention policies: what each sees, borders of the scene, images without contrast, and what stands out in one."""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from models.network.self_attention import TokenReading
from models.policies.policies import (
    NETWORK_POLICIES,
    POLICIES,
    fine_grained,
    pixel_entropy,
    score_patches,
    spectral_residual,
)
from models.reading.inference import CoarsePrediction
from pipeline.errors import SettingsError
from pipeline.geometry.grid import SceneGrid

Measure = Callable[[NDArray[np.floating]], NDArray[np.float64]]
both = pytest.mark.parametrize("measure", [fine_grained, spectral_residual])


def _coarse_prediction(height: int = 32, width: int = 48, patch: int = 8, factor: int = 2) -> CoarsePrediction:
    """A flat scene of which the coarse prediction is equally unsure everywhere."""
    grid = SceneGrid(height, width, patch, factor)
    y, x = (size // factor for size in grid.padded_shape)
    columns, probability = np.full((y, x, 3), 0.7, np.float32), np.full((y, x, 4), 0.25, np.float32)
    alike = np.ones((2, y * x // patch**2, 4), np.float32)
    gain, tokens = np.ones(grid.patch_shape, np.float32), TokenReading(alike, alike, side=1)
    return CoarsePrediction(grid, columns, probability, gain=gain, tokens=tokens)


@pytest.mark.parametrize("classes", [2, 5, 12])
def test_entropy_runs_from_none_to_the_log_of_classes(classes: int):
    """Certainty is 0 without a NaN, equal chances are ln(classes), and order does not count."""
    sure, even = np.eye(classes)[0], np.full(classes, 1 / classes)
    assert pixel_entropy(np.stack([sure, even])) == pytest.approx([0, np.log(classes)])
    drawn = np.random.default_rng(0).dirichlet(np.ones(classes), 20)
    assert pixel_entropy(drawn[:, ::-1]) == pytest.approx(pixel_entropy(drawn))


def test_entropy_looks_where_the_coarse_prediction_is_unsure():
    """The patch over unsure pixels scores highest, by the mean over its own pixels."""
    seen = _coarse_prediction()
    seen.probability[...] = [1, 0, 0, 0]
    seen.probability[4:8, 8:12] = [0.5, 0.5, 0, 0]  # the patch at row 1, column 2
    scores = score_patches("entropy", seen).reshape(4, 6)
    assert scores[1, 2] == pytest.approx(np.log(2))
    scores[1, 2] = 0
    assert not scores.any()


def test_sobel_looks_at_edges():
    """A step between two columns of patches scores in both and nowhere else."""
    seen = _coarse_prediction()
    seen.columns[:, :8] = 0.1
    scores = score_patches("sobel", seen).reshape(4, 6)
    assert (scores[:, [1, 2]] > 0.1).all()
    assert scores[:, [0, 3, 4, 5]] == pytest.approx(0, abs=1e-12)


def test_random_follows_its_seed():
    """The same seed gives the same scores, another seed others."""
    first, same, other = (score_patches("random", _coarse_prediction(), seed=seed) for seed in (1, 1, 2))
    assert (first == same).all()
    assert (first != other).all()


def test_a_mask_is_averaged_over_each_patch():
    """A mask of the scene's size, grey or colour, scores patches by its mean over their pixels on the scene."""
    mask = np.random.default_rng(2).integers(0, 256, (32, 48), dtype=np.uint8)
    expected = mask.reshape(4, 8, 6, 8).mean(axis=(1, 3)).ravel()
    assert score_patches("mask", _coarse_prediction(), mask=mask) == pytest.approx(expected)
    colour = np.repeat(mask[..., None], 3, axis=-1)
    assert score_patches("mask", _coarse_prediction(), mask=colour) == pytest.approx(expected)


@pytest.mark.parametrize("policy", [policy for policy in POLICIES if policy not in NETWORK_POLICIES])
@pytest.mark.parametrize("size", [(37, 53), (1, 1), (8, 8), (33, 16), (1, 40)])
def test_patches_off_the_scene_are_worth_nothing(policy: str, size: tuple[int, int]):
    """One finite score a patch of the padded grid; what lies wholly off the scene scores 0."""
    seen = _coarse_prediction(*size)
    seen.columns[...] = np.random.default_rng(3).random(seen.columns.shape)
    scores = score_patches(policy, seen, mask=np.ones(size))
    assert (score_patches(policy, seen, mask=np.ones(size)) == scores).all()
    assert scores.dtype == np.float64
    assert scores.shape == (np.prod(seen.grid.patch_shape),)
    assert np.isfinite(scores).all()
    assert not scores[seen.grid.valid_fraction().ravel() == 0].any()


def test_margin_is_how_little_the_likeliest_is_ahead():
    """1 where two classes are level, 0 where one is sure, and 1 less the difference between; order does not count."""
    seen = _coarse_prediction()
    seen.probability[...] = [1, 0, 0, 0]
    seen.probability[:4, :4] = [0.25, 0.5, 0.125, 0.125]  # the patch at row 0, column 0
    seen.probability[4:8, 8:12] = [0, 0.5, 0.5, 0]
    expected = np.zeros((4, 6))
    expected[0, 0], expected[1, 2] = 0.75, 1.0
    assert score_patches("margin", seen).reshape(4, 6).tolist() == expected.tolist()
    seen.probability[...] = seen.probability[..., ::-1].copy()
    assert score_patches("margin", seen).reshape(4, 6).tolist() == expected.tolist()


@pytest.mark.parametrize("policy", ["saliency", "spectral-residual"])
def test_saliency_looks_at_what_differs(policy: str):
    """One odd patch on a noisy ground scores highest, and what lies off the scene changes nothing."""
    seen = _coarse_prediction(120, 90, factor=4)
    seen.columns[...] = 0.5 + 0.01 * np.random.default_rng(4).random(seen.columns.shape)
    seen.columns[10:12, 12:14] = 0.9  # the patch at row 5, column 6
    scores = score_patches(policy, seen)
    assert np.argmax(scores) == 5 * seen.grid.patch_shape[1] + 6
    seen.columns[30:], seen.columns[:, 23:] = 9.0, np.nan
    assert (score_patches(policy, seen) == scores).all()


@pytest.mark.parametrize("policy", ["entropy", "margin", "mask", "gain", "self-attention"])
@pytest.mark.parametrize("factor", [1, 2, 4])
def test_a_border_patch_is_worth_its_fraction(policy: str, factor: int):
    """On a scene alike everywhere a patch scores in proportion to its pixels on the scene."""
    seen = _coarse_prediction(37, 53, factor=factor)
    scores = score_patches(policy, seen, mask=np.full((37, 53), np.log(4)))
    level = 1 if policy in ("margin", "gain", "self-attention") else np.log(4)
    assert scores == pytest.approx(level * seen.grid.valid_fraction().ravel(), abs=1e-6)


def _noise(shape: tuple[int, ...] = (40, 56, 5), seed: int = 0) -> NDArray[np.float64]:
    return np.random.default_rng(seed).random(shape)


@both
def test_the_order_of_bands_does_not_count(measure: Measure):
    """Any permutation gives the same numbers, to the bit."""
    image = _noise()
    assert (measure(image[..., [3, 0, 4, 2, 1]]) == measure(image)).all()


@both
def test_brightness_does_not_count(measure: Measure):
    """Each band times a factor of its own changes nothing; with an offset of its own only rounding."""
    image = _noise()
    assert (measure(image * 2.0 ** np.arange(-2, 3)) == measure(image)).all()
    np.testing.assert_allclose(measure(3.7 * image + np.arange(5)), measure(image), atol=0.02)


@both
def test_what_is_not_finite_takes_the_median(measure: Measure):
    """NaN and infinities do not spread: the result is that of their band's median in their place."""
    image, filled = _noise((41, 57, 1)), _noise((41, 57, 1))
    image[3, 4], image[20, 20], image[39, 1] = np.nan, np.inf, -np.inf
    filled[[3, 20, 39], [4, 20, 1]] = np.median(image[np.isfinite(image)])
    found = measure(image)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found, measure(filled), atol=0.02)


def test_opencv_without_contrib_is_said(monkeypatch: pytest.MonkeyPatch):
    """The message names the package to install and the policies that need it."""
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(SettingsError, match=r"saliency and spectral-residual need OpenCV .* opencv-contrib-py"):
        fine_grained(np.zeros((4, 4, 1)))
