"""Patches by their place alone: orders of which any first part is spread evenly, distance to the centre, and borders."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from models.policies.spacing import centre_scores, random_scores, stratified_scores, uniform_scores
from pipeline.geometry.grid import SceneGrid
from pipeline.planning.selection import select_patches

Place = Callable[[SceneGrid, int], NDArray[np.float64]]
even = pytest.mark.parametrize("place", [uniform_scores, stratified_scores])
SHAPES = [(1, 1), (1, 9), (7, 1), (2, 2), (5, 3), (8, 8), (13, 21)]


def _grid(rows: int, columns: int) -> SceneGrid:
    return SceneGrid(8 * rows, 8 * columns, 8, 1)


def _first(scores: NDArray[np.float64], count: int) -> NDArray[np.bool_]:
    """Where the best ``count`` patches lie."""
    chosen = np.zeros(scores.size, np.bool_)
    chosen[select_patches(scores.ravel(), count).patch_index] = True
    return chosen.reshape(scores.shape)


@even
@pytest.mark.parametrize("shape", SHAPES)
def test_scores_are_a_rank(place: Place, shape: tuple[int, int]):
    """The n patches have the scores 1, (n - 1) / n, ... 1 / n, each once: no ties, none worth nothing."""
    count = shape[0] * shape[1]
    scores = place(_grid(*shape), 5)
    assert scores.shape == shape
    assert np.sort(scores.ravel()) == pytest.approx(np.arange(1, count + 1) / count)


@even
def test_a_larger_choice_keeps_the_smaller(place: Place):
    """Nested: every patch of the best K is among the best K + 1."""
    scores = place(_grid(9, 14), 1)
    for count in range(126):
        assert not (_first(scores, count) & ~_first(scores, count + 1)).any()


@even
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("shape", [(16, 16), (16, 32)])
def test_every_cell_gets_its_part(place: Place, shape: tuple[int, int], seed: int):
    """Where halves are equal any first K differ by at most one patch between the halves and between the quarters."""
    scores = place(_grid(*shape), seed)
    for count in (1, 2, 3, 4, 17, 50, 64, 101, 200):
        chosen = _first(scores, count)
        quarters = chosen.reshape(2, shape[0] // 2, 2, shape[1] // 2).sum(axis=(1, 3))
        assert np.ptp(quarters) <= 1, (count, quarters)


@even
@pytest.mark.parametrize("shape", [(64, 80), (61, 79), (45, 150)])
@pytest.mark.parametrize("fraction", [0.02, 0.1, 0.35])
def test_no_hole_as_wide_as_chance_leaves(place: Place, shape: tuple[int, int], fraction: float):
    """Blocks of patches get more equal numbers than random patches give them, and no patch is as far from a chosen one."""
    grid, count = _grid(*shape), round(fraction * shape[0] * shape[1])

    def uneven(place: Place, seed: int) -> tuple[float, float]:
        chosen = _first(place(grid, seed), count)
        blocks = np.array_split(chosen, 4), np.array_split(chosen.T, 4)
        counts = [float(block.mean()) for part in blocks for block in part]
        return float(np.std(counts)), float(distance_transform_edt(~chosen).max())

    spread, hole = (np.mean([uneven(place, seed)[part] for seed in range(4)]) for part in (0, 1))
    assert spread < np.mean([uneven(random_scores, seed)[0] for seed in range(4)]) / 2
    assert hole < np.mean([uneven(random_scores, seed)[1] for seed in range(4)])


def test_uniform_is_a_regular_grid():
    """The first 4 and the first 16 of 64 patches lie on lattices of 4 and of 2 patches, none of them in a corner."""
    scores = uniform_scores(_grid(8, 8))
    assert np.argwhere(_first(scores, 4)).tolist() == [[2, 2], [2, 6], [6, 2], [6, 6]]
    first = np.argwhere(_first(scores, 16))
    assert first.tolist() == [[y, x] for y in range(0, 8, 2) for x in range(0, 8, 2)]


def test_stratified_follows_its_seed():
    """The same seed gives the same order, another another; over seeds every patch comes first about as often."""
    grid = _grid(3, 4)
    orders = [stratified_scores(grid, seed) for seed in range(600)]
    assert (stratified_scores(grid, 7) == orders[7]).all()
    assert (orders[0] != orders[1]).any()
    first = np.bincount([int(np.argmax(order)) for order in orders], minlength=12)
    assert first.min() > 25
    assert first.max() < 85  # 50 expected, standard deviation 7


def test_the_centre_comes_first():
    """By hand: of 3 x 3 patches 1 in the middle, by distance around it; four patches are level and the lowest wins."""
    scores = centre_scores(_grid(3, 3))
    side, corner = 1 - 8 / np.hypot(12, 12), 1 - 8 * np.sqrt(2) / np.hypot(12, 12)
    assert scores == pytest.approx(np.array([[corner, side, corner], [side, 1, side], [corner, side, corner]]))
    four = centre_scores(_grid(2, 2))
    assert four == pytest.approx(np.full((2, 2), 0.5))
    assert select_patches(four.ravel(), 1).patch_index.tolist() == [0]
