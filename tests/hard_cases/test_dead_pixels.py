"""Numerical hard cases of what a camera did not see: rows 17 and 18 of the design's table are in the names.

Pixels that a survey's mirror missed take the first pass's columns before they come here; what these rows say holds for
dead pixels, whose captured values are not numbers. tests/models/reading has the rest: what fills them, what they are
told as; test_out_of_range_values that their content reaches nobody.
"""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import torch

from models.network.sizes import TOKEN_PX
from models.policies.policies import score_patches
from models.reading.inference import read_coarse_pass
from pipeline.geometry.grid import SceneGrid
from tests.models.conftest import coarse_prediction, plain_weights

NM = np.linspace(400, 1000, 9)


def _scene(height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.1, 0.5, (height, width, 9)).astype(np.float32)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(("dead", "lives"), [(1, True), (4, True), (5, False), (9, False)])
def test_17_a_pixel_dead_in_most_of_its_bands_is_dead(dead: int, lives: bool, bad: float):
    """Up to half of the bands may be lost: a flat spectrum stays flat; with more the pixel is nothing at all."""
    weights, values = plain_weights(), np.full((2, 9), 0.35, np.float32)
    values[1, np.random.default_rng(0).permutation(9)[:dead]] = bad
    whole, broken = weights.columns(values, NM)
    assert np.isnan(broken).tolist() == [not lives] * 4
    if lives:
        assert broken == pytest.approx(whole, abs=0.3)  # the columns are 0.5 from the median; exact where a band lives


@pytest.mark.parametrize("size", [8, 32])
def test_18_dead_pixels_show_within_a_token_alone_but_for_attention(size: int):
    """A dead patch or token, of a network whose tokens say nothing, changes nothing farther away than a token."""
    weights, grid, values = plain_weights(), SceneGrid(128, 128, 8), _scene(128, 128)
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


def test_18_holes_in_a_coarse_look_take_no_further_copy_of_it():
    """A look with a dead pixel in every patch is made in the memory of one without, but for a mask."""
    weights, peaks = plain_weights(), []
    for bad in (0.3, np.nan):
        values = _scene(256, 256)
        values[3::8, 4::8] = bad
        tracemalloc.start()
        seen = read_coarse_pass(
            weights, [values[row : row + 16] for row in range(0, 256, 16)], NM, SceneGrid(256, 256, 8)
        )
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert np.isfinite(seen.columns).all()
    assert peaks[1] < peaks[0] + 0.5 * seen.columns.nbytes


def test_18_a_scene_all_dead_still_has_scores():
    """Where nothing was seen at all every policy's scores are finite."""
    seen = coarse_prediction(plain_weights(), np.full((32, 32, 9), np.nan), NM, SceneGrid(32, 32, 8))
    for policy in ("gain", "entropy", "sobel"):
        assert np.isfinite(score_patches(policy, seen)).all()
