"""Numerical hard cases of dead pixels: the numbers in the names, 17 and 18, are rows of the design's table.

Pixels that a survey's mirror missed get the first pass's columns earlier. These rows cover dead pixels, whose captured
values are not finite. `tests/models/reading` checks how they are filled and labelled.
`test_out_of_range_values` checks that their values affect no result.
"""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import torch

from spectralzoom.models.network.sizes import TOKEN_PX
from spectralzoom.models.policies.policies import score_patches
from spectralzoom.models.reading.inference import read_coarse_pass
from spectralzoom.pipeline.geometry.grid import SceneGrid
from tests.models.conftest import coarse_prediction, plain_weights

NM = np.linspace(400, 1000, 9)


def _scene(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(0.1, 0.5, (height, width, 9)).astype(np.float32)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(("dead", "lives"), [(1, True), (4, True), (5, False), (9, False)])
def test_17_pixel_with_most_bands_dead_is_nan(dead: int, lives: bool, bad: float):
    """With up to half of the bands dead a flat spectrum keeps its columns to 0.3; with more the pixel is NaN."""
    values = np.full((2, 9), 0.35, np.float32)
    values[1, np.random.default_rng(0).permutation(9)[:dead]] = bad
    whole, broken = plain_weights().columns(values, NM)
    assert np.isnan(broken).tolist() == [not lives] * 4
    if lives:
        assert broken == pytest.approx(whole, abs=0.3)  # the columns are 0.5 from the median; exact with a live band


@pytest.mark.parametrize("size", [8, 32])
def test_18_dead_pixels_affect_at_most_the_next_token(size: int):
    """With the tokens' output set to 0, a dead patch or token changes nothing farther away than one token."""
    weights = plain_weights()
    grid = SceneGrid(128, 128, 8)
    values = _scene(128, 128)
    with torch.no_grad():
        for parameter in weights.segmenter.from_token.parameters():
            parameter.zero_()
    whole = coarse_prediction(weights, values, NM, grid).probability
    values[64 : 64 + size, 32 : 32 + size] = np.nan
    dead = coarse_prediction(weights, values, NM, grid).probability
    assert np.isfinite(dead).all()
    beside = np.ones((128, 128), bool)
    beside[64 - TOKEN_PX : 64 + size + TOKEN_PX, : 32 + size + TOKEN_PX] = False
    assert np.abs(dead - whole)[beside].max() <= 1e-5
    assert np.abs(dead - whole)[~beside].max() > 0.01


def test_18_dead_pixels_in_a_coarse_pass_need_no_copy():
    """A dead pixel in every patch adds less than half of the columns' size to the peak memory of a coarse pass."""
    weights = plain_weights()
    peaks = []
    for bad in (0.3, np.nan):
        values = _scene(256, 256)
        values[3::8, 4::8] = bad
        tracemalloc.start()
        seen = read_coarse_pass(weights, np.split(values, 16), NM, SceneGrid(256, 256, 8))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert np.isfinite(seen.columns).all()
    assert peaks[1] < peaks[0] + 0.5 * seen.columns.nbytes


def test_18_fully_dead_scene_has_finite_scores():
    """The policies gain, entropy and sobel score a scene without any valid pixel."""
    seen = coarse_prediction(plain_weights(), np.full((32, 32, 9), np.nan), NM, SceneGrid(32, 32, 8))
    for policy in ("gain", "entropy", "sobel"):
        assert np.isfinite(score_patches(policy, seen)).all()
