"""Numerical hard cases of what a camera did not see: rows 17, 18 and 21 of the design's table are in the names.

Fine pixels that a survey's mirror missed take the coarse pass's columns before they come here; what these rows say
holds for dead pixels, whose captured values are not numbers.
"""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from models.evaluation.placement import oracle_gain
from models.network.spectral import fill_dead
from models.policies.policies import score_patches
from models.reading.inference import CoarsePass, CoarsePrediction, coarse_prediction, read_coarse_pass, segment
from pipeline.geometry.grid import SceneGrid
from tests.models.conftest import plain_weights

NM = np.linspace(400, 1000, 9)


def _scene(height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.1, 0.5, (height, width, 9)).astype(np.float32)


def _patches(count: int) -> np.ndarray:
    return np.random.default_rng(1).normal(0, 1, (count, 8, 8, 4)).astype(np.float32)


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


@pytest.mark.parametrize("more", [0, 1])
@pytest.mark.parametrize(("patch", "token"), [(8, 8), (32, 16)])
def test_17_a_token_dead_in_most_of_its_pixels_is_not_read(patch: int, token: int, more: int):
    """With half of its pixels dead a coarse token is read; with one more it is left out, and still has a map."""
    weights, grid = plain_weights(patch=patch), SceneGrid(4 * patch, 2 * patch, patch, 2)
    values = _scene(2 * patch, patch)
    values[: token // 2, :token] = np.nan
    values[token // 2, :more] = np.nan
    seen = read_coarse_pass(weights, [values], NM, grid)
    assert np.isfinite(seen.columns).all()
    assert seen.living is not None
    assert np.flatnonzero(~seen.living).tolist() == [0] * more
    assert np.isfinite(coarse_prediction(weights, values, NM, grid).probability).all()


def test_17_dead_pixels_are_filled_by_the_mean_of_their_patch():
    """A coarse pixel without a value takes the mean column of the living ones of its patch."""
    weights, grid, values = plain_weights(), SceneGrid(32, 32, 8, 2), _scene(16, 16)
    whole = read_coarse_pass(weights, [values], NM, grid).columns
    values[2:4, 9:14] = np.nan
    seen = read_coarse_pass(weights, [values], NM, grid).columns
    hole = np.zeros((16, 16), bool)
    hole[2:4, 9:14] = True
    assert (seen[~hole] == whole[~hole]).all()
    expected = whole[:8, 8:][~hole[:8, 8:]].mean(axis=0)
    assert seen[hole] == pytest.approx(np.tile(expected, (10, 1)), abs=1e-5)


def test_18_a_dead_coarse_patch_is_as_if_the_scene_ended_there():
    """A scene whose last coarse patches are all dead reads outside them as one without them, but for one cell."""
    weights, values = plain_weights(), _scene(24, 32)
    values[:, 24:] = np.nan
    dead = coarse_prediction(weights, values, NM, SceneGrid(48, 64, 8, 2))
    shorter = coarse_prediction(weights, values[:, :24], NM, SceneGrid(48, 48, 8, 2))
    assert np.isfinite(dead.probability).all()
    assert np.abs(dead.probability[:, :20] - shorter.probability[:, :20]).max() <= 1e-5
    patch_index = np.array([0, 9, 20])
    columns, across = np.divmod(patch_index, 6)
    drawn = segment(weights, shorter, _patches(3), patch_index).confidence
    beside = segment(weights, dead, _patches(3), columns * 8 + across).confidence
    assert np.abs(drawn[:, :40] - beside[:, :40]).max() <= 1e-5


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_18_a_dead_fine_patch_is_as_if_not_captured(bad: float):
    """A captured patch that is all dead changes nothing anywhere: the map is that without its patch."""
    weights = plain_weights()
    seen = coarse_prediction(weights, _scene(24, 32), NM, SceneGrid(48, 64, 8, 2))
    patches, patch_index = _patches(5), np.array([3, 40, 11, 12, 30])
    patches[1] = bad
    drawn = segment(weights, seen, patches, patch_index)
    without = segment(weights, seen, np.delete(patches, 1, axis=0), np.delete(patch_index, 1))
    assert np.abs(drawn.confidence - without.confidence).max() <= 1e-5
    assert (drawn.classes == without.classes).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_18_what_a_look_showed_is_told_of_the_map_that_is_drawn(bad: float):
    """Holes in either scale: gain compares the map without patches with the one that has them."""
    weights, grid, values = plain_weights(classes=2), SceneGrid(48, 64, 8, 2), _scene(24, 32)
    values[:8, 8:16] = bad
    seen = coarse_prediction(weights, values, NM, grid)
    patch_index = np.arange(48)
    patches = _patches(48)
    patches[7], patches[20, :3] = bad, bad
    chances = [
        np.where(drawn.classes == 1, drawn.confidence, 1 - drawn.confidence).astype(np.float64)
        for drawn in (
            segment(weights, seen, _patches(0), patch_index[:0]),
            segment(weights, seen, patches, patch_index),
        )
    ]
    before, after = (np.stack([1 - chance, chance]).reshape(2, 6, 8, 8, 8).swapaxes(2, 3) for chance in chances)
    gained = np.log(after[1] / before[1]).mean(axis=(2, 3)).ravel()
    assert oracle_gain(weights, seen, patches, np.ones((48, 64), np.uint8)) == pytest.approx(gained, abs=1e-4)


def test_18_filling_holes_takes_the_memory_of_the_patches_once():
    """One copy is made, however many patches have a hole."""
    patches = np.ones((200, 16, 16, 8), np.float32)
    dead = np.zeros(patches.shape[:3], bool)
    dead[:, 3, 4] = True
    patches[dead] = np.nan
    tracemalloc.start()
    filled = fill_dead(patches, dead)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert (filled == 1).all()
    assert peak < 1.1 * patches.nbytes


def test_18_holes_in_a_coarse_look_take_no_further_copy_of_it():
    """A look with a dead pixel in every patch is made in the memory of one without, but for a mask."""
    weights, peaks = plain_weights(), []
    for bad in (0.3, np.nan):
        values = _scene(256, 256)
        values[3::8, 4::8] = bad
        tracemalloc.start()
        seen = read_coarse_pass(
            weights, [values[row : row + 16] for row in range(0, 256, 16)], NM, SceneGrid(512, 512, 8, 2)
        )
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert np.isfinite(seen.columns).all()
    assert peaks[1] < peaks[0] + 0.5 * seen.columns.nbytes


def test_18_what_is_dead_reaches_nobody():
    """Holes of any content give one map; a saturated column of pixels leaves every figure finite."""
    weights, grid = plain_weights(), SceneGrid(48, 64, 8, 2)
    maps = []
    for bad in (np.nan, np.inf, -np.inf):
        values = _scene(24, 32)
        values[8:16, 8:16], values[:, 29] = bad, bad
        maps.append(coarse_prediction(weights, values, NM, grid).probability)
    assert np.isfinite(maps[0]).all()
    assert all((other == maps[0]).all() for other in maps[1:])


def test_18_a_scene_all_dead_still_has_a_map():
    """Nothing seen at all gives finite probabilities, of every policy's score too, and captured patches still count."""
    weights, grid = plain_weights(), SceneGrid(32, 32, 8, 2)
    seen = coarse_prediction(weights, np.full((16, 16, 9), np.nan), NM, grid)
    assert np.isfinite(seen.probability).all()
    for policy in ("gain", "entropy", "sobel"):
        assert np.isfinite(score_patches(policy, seen)).all()
    drawn = segment(weights, seen, _patches(2), np.array([0, 5]))
    assert np.isfinite(drawn.confidence).all()


def test_18_a_scene_without_holes_is_read_as_ever():
    """Where every pixel lives no token is left out and nothing is filled."""
    weights, grid = plain_weights(), SceneGrid(30, 31, 8, 2)
    seen = read_coarse_pass(weights, [_scene(15, 16)], NM, grid)
    assert seen.living is None
    alone = CoarsePrediction(grid, seen.columns, np.empty((0, 0, 0), np.float32))
    assert alone.living is None
    assert CoarsePass(grid, seen.columns).living is None


def test_21_the_pad_is_a_mirror_image():
    """Scenes are padded by reflection, by the edge pixel where there is one row or column only.

    No patch of the pad is bought, its pixels have no label and no place on the map. Attention does read the part of a
    border patch that lies in it: it shows the scene once more, as the crops do that the weights are trained on.
    """
    weights = plain_weights()
    for height, width in ((40, 40), (2, 34), (1, 1)):
        grid = SceneGrid(height, width, 8, 2)
        values = _scene(*grid.coarse_shape)
        seen = read_coarse_pass(weights, [values], NM, grid)
        y, x = grid.coarse_shape
        inner = weights.columns(values, NM)
        assert seen.columns[:y, :x] == pytest.approx(inner, abs=1e-6)
        for axis, size in enumerate((y, x)):
            if size < seen.columns.shape[axis]:
                mirrored = size - 2 if size > 1 else 0
                one, other = (np.take(seen.columns, at, axis=axis) for at in (size, mirrored))
                assert (one == other).all()
        assert not (
            grid.valid_fraction().ravel()[np.setdiff1d(np.arange(grid.valid_fraction().size), grid.valid_patches())]
        ).any()


def test_18_what_was_filled_is_not_called_seen():
    """Columns are filled in where nothing was seen, so that the rest can be read; whoever compares looks gets NaN."""
    weights, grid = plain_weights(), SceneGrid(48, 64, 8, 2)
    values = _scene(24, 32)
    values[8:16, 8:16] = np.nan
    seen = read_coarse_pass(weights, [values], NM, grid)
    assert np.isfinite(seen.columns).all()
    unseen = np.isnan(seen.seen_columns).all(axis=-1)
    assert unseen[8:16, 8:16].all()
    assert unseen.sum() == 64
    assert np.array_equal(seen.seen_columns[~unseen], seen.columns[~unseen])
