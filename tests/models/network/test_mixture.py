"""Mixtures of classifiers of pixels: laws of their windows, probabilities, costs and files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy
import torch
from hypothesis import given
from hypothesis import strategies as st

from spectralzoom.models.network.mixture import LEAST, Mixture, window_means
from spectralzoom.models.network.segmenter import Segmenter
from spectralzoom.models.network.sizes import (
    AROUND,
    MEAN_WINDOWS,
    RELATIVE,
    SPREAD_WINDOWS,
    VALUES,
    SegmenterConfig,
    multiply_adds,
)
from spectralzoom.models.weights.files import load_weights, save_weights
from spectralzoom.pipeline.geometry.grid import SceneGrid
from tests.models.conftest import coarse_prediction, make_weights, noise, plain_weights

PARTS = ((VALUES, 0, 0.25), (RELATIVE, 0, 0.25), (AROUND, 0, 0.25), (AROUND, 6, 0.25))
MIXED: dict[str, Any] = {"classes": 3, "columns": 4, "components": (2, 3), "parts": PARTS, "corrected": False}
SIDES = st.integers(1, 40)


def _mixture(**sizes: Any) -> Mixture:
    """Return a mixture of random parts and components."""
    made: Mixture = make_weights(**MIXED | sizes).segmenter.mixture
    return made


@given(height=SIDES, width=SIDES, side=st.sampled_from(MEAN_WINDOWS))
def test_window_means_equal_those_of_scipy(height: int, width: int, side: int) -> None:
    """Borders are repeated, also where the window is larger than the image."""
    image = noise(height * width, 1, 2, height, width)
    expected = scipy.ndimage.uniform_filter(image.double().numpy(), (0, 0, side, side), mode="nearest")
    np.testing.assert_allclose(window_means(image, side).numpy(), expected, atol=1e-5)


@pytest.mark.parametrize("value", [0.0, 1.0, -3.3, 1e3, 1e5])
def test_spreads_of_constant_images_are_small_numbers(value: float) -> None:
    """Squares and means of a constant differ by rounding, and a root of that would be NaN."""
    mixture = _mixture()
    image = torch.full((1, 4, 9, 70), value)
    found = mixture.features(image, {AROUND})[AROUND]
    means, spreads = found.split([5 * len(MEAN_WINDOWS), 5 * len(SPREAD_WINDOWS)], dim=-1)
    assert torch.isfinite(found).all()
    assert spreads.min() >= 0
    assert (spreads <= 2e-3 * means[..., :5].abs().max() + 1e-6).all()


def test_features_are_means_and_standard_deviations_of_windows() -> None:
    """They equal those of whole windows by numpy, in an image that borders do not reach."""
    mixture = _mixture()
    image = noise(0, 1, 4, 61, 61)
    found = mixture.features(image, {AROUND})[AROUND][0, 30, 30].split(5)
    columns = image[0].movedim(0, -1)
    relative = (mixture.relative(columns) - mixture.relative_centre) @ mixture.relative_axes
    base = torch.cat([columns @ mixture.own_axes, relative], dim=-1).double().numpy()
    for own, (side, of) in zip(
        found, [(s, np.mean) for s in MEAN_WINDOWS] + [(s, np.std) for s in SPREAD_WINDOWS], strict=True
    ):
        half = side // 2
        window = base[30 - half : 31 + half, 30 - half : 31 + half]
        np.testing.assert_allclose(own.numpy(), of(window, axis=(0, 1)), rtol=1e-4, atol=1e-5)


def test_probabilities_are_weighted_means_of_the_parts() -> None:
    """They sum to 1 before the prior, which is added to their logarithms."""
    mixture, image = _mixture(), noise(1, 2, 4, 9, 11)
    probability = (mixture(image) - mixture.prior[:, None, None]).exp()
    parts = [0.25 * mixture.by_part(image, number).softmax(dim=1) for number in range(len(PARTS))]
    torch.testing.assert_close(probability, sum(parts).clamp_min(LEAST), atol=1e-6, rtol=1e-4)
    torch.testing.assert_close(probability.sum(dim=1), torch.ones(2, 9, 11), atol=1e-5, rtol=0)


def test_classes_in_another_order_have_the_same_probabilities() -> None:
    """No class is special."""
    mixture, image, order = _mixture(), noise(2, 1, 4, 9, 11), [2, 0, 1]
    before = mixture(image)
    with torch.no_grad():
        for part in mixture.parts:
            for own in (part.first if part.last is None else part.last).parameters():
                own.copy_(own[order])
        mixture.prior.copy_(mixture.prior[order])
    torch.testing.assert_close(mixture(image), before[:, order])


@pytest.mark.parametrize("turn", [lambda image: image.flip(2), lambda image: image.flip(3), lambda image: image.mT])
def test_a_turned_image_has_a_turned_map(turn: Any) -> None:
    """Windows are centred squares."""
    mixture, image = _mixture(), noise(3, 1, 4, 33, 70)
    torch.testing.assert_close(mixture(turn(image)), turn(mixture(image)), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize(
    ("parts", "pixel"),
    [
        (((VALUES, 0, 1.0),), 4 * 4 + 4 * 3),  # scene values, linear
        (((VALUES, 0, 0.4), (RELATIVE, 0, 0.6)), 4 * 4 + (4 + 5) * 3),
        (((AROUND, 0, 1.0),), 4 * 4 + 5 * 4 + 55 * 3),  # components, linear
        (PARTS, 4 * 4 + 5 * 4 + (4 + 5 + 55) * 3 + 55 * 6 + 6 * 3),
        (((VALUES, 0, 1.0), (AROUND, 6, 0.0)), 4 * 4 + 4 * 3),  # a part without weight is not computed
    ],
)
def test_multiply_adds_count_used_parts(parts: Any, pixel: int) -> None:
    """Bands to columns, columns to features, features to classes, for each pixel of the padded grid."""
    config = SegmenterConfig(**MIXED | {"parts": parts, "patch": 8})
    found = multiply_adds(config, SceneGrid(20, 30, 8), 4, 10)
    assert (found.total, found.detail) == (24 * 32 * (10 * 4 + pixel), 0)


@pytest.mark.parametrize("corrected", [False, True])
def test_mixtures_are_saved_as_plain_tensors(corrected: bool, tmp_path: Path) -> None:
    """The same weights draw the same map, and only numbers were written."""
    made = replace(plain_weights(**MIXED | {"corrected": corrected}), record={})
    save_weights(made, tmp_path / "w.safetensors")
    read = load_weights(tmp_path / "w.safetensors")
    assert read.config == made.config
    values, nm = noise(4, 20, 30, 6).numpy(), np.linspace(420, 980, 6)
    maps = [coarse_prediction(one, values, nm, SceneGrid(20, 30, 8)).probability for one in (made, read)]
    np.testing.assert_array_equal(*maps)
    assert isinstance(read.segmenter, Segmenter)
    assert {one.dtype for one in read.segmenter.state_dict().values()} == {torch.float32}
