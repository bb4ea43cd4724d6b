"""Policies that see nothing: scores of patches by where they lie on the scene alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.grid import SceneGrid

Scores = NDArray[np.float64]
Whole = NDArray[np.int64]
Scalar = TypeVar("Scalar", bound=np.generic)
STEPS = 4096  # of the phase that says which half of a cell begins; keeps the comparison in whole numbers
BEGINS = (3 * STEPS // 8, 5 * STEPS // 8)  # the half with the first; the larger of two and one patches still begins


def random_scores(grid: SceneGrid, seed: int) -> Scores:
    """Draw every patch's score by itself, (rows, columns) in 0..1."""
    return np.random.default_rng([seed, 0x5EA7]).random(grid.patch_shape)


def stratified_scores(grid: SceneGrid, seed: int) -> Scores:
    """Score patches so that the best K, for every K, are one at random in each of K cells of about equal area.

    The scene is halved again and again; the halves of a cell take turns, in an order drawn by ``seed``.
    """
    return _by_rank(grid, np.random.default_rng([seed, 0x57A7]))


def uniform_scores(grid: SceneGrid, seed: int = 0) -> Scores:
    """Score patches so that the best K lie on a regular grid, the finer the larger K is; ``seed`` does nothing.

    The order is that of an ordered dither: of the quarters of a cell the opposite one comes second.
    """
    return _by_rank(grid, None)


def centre_scores(grid: SceneGrid, seed: int = 0) -> Scores:
    """Score patches by how near the middle of their part of the scene lies to that of the scene; ``seed`` does nothing.

    1 is the middle of the scene, 0 its corners.
    """
    down, across = (
        (np.minimum(np.arange(1, count + 1) * grid.patch, size) + np.arange(count) * grid.patch - size) / 2
        for count, size in zip(grid.patch_shape, (grid.height, grid.width), strict=True)
    )
    distance = np.hypot(down[:, None], across[None, :])
    scores: Scores = 1.0 - distance / (np.hypot(grid.height, grid.width) / 2)
    return scores


@dataclass(frozen=True)
class _Axis:
    """Cells along one axis: for every patch the start and the end of its cell, and where the last split put it."""

    start: Whole
    end: Whole
    upper: NDArray[np.bool_]
    splits: int

    @staticmethod
    def whole(size: int) -> _Axis:
        """One cell of all patches."""
        return _Axis(np.zeros(size, np.int64), np.full(size, size), np.zeros(size, np.bool_), 0)

    @property
    def length(self) -> Whole:
        """Patches of each patch's cell along this axis."""
        return self.end - self.start

    def halved(self) -> _Axis:
        """Give the halves of every cell; the lower one is the larger, and all there is of a cell of one patch."""
        middle = (self.start + self.end + 1) // 2
        upper = np.arange(len(middle)) >= middle
        start, end = np.where(upper, middle, self.start), np.where(upper, self.end, middle)
        return _Axis(start, end, upper, self.splits + 1)


def _by_rank(grid: SceneGrid, random: np.random.Generator | None) -> Scores:
    """Spread scores from 1 down to 1/n by nested rank over the n patches that hold a pixel; the others get 0."""
    rows, columns = -(-grid.height // grid.patch), -(-grid.width // grid.patch)
    scores = np.zeros(grid.patch_shape)
    scores[:rows, :columns] = 1.0 - _nested_ranks((rows, columns), random) / (rows * columns)
    return scores


def _nested_ranks(shape: tuple[int, int], random: np.random.Generator | None) -> Whole:
    """Ranks 0..n-1, (rows, columns), of which any first K hold of every cell its part of K, to within about a patch.

    Cells are halved across their longer side, down to single patches; from there up the ranks of halves are merged.
    """
    axes = [_Axis.whole(size) for size in shape]
    levels = []
    while max(axis.length.max() for axis in axes) > 1:
        split = int(axes[1].length.max() > axes[0].length.max())
        phase, halves = _phases(axes, split, random), axes[split].halved()
        across = _along(axes[1 - split].length, 1 - split)
        own, other = (_along(n, split) * across for n in (halves.length, axes[split].length - halves.length))
        levels.append((own, other, _along(halves.upper, split), phase))
        axes[split] = halves
    ranks = np.zeros(shape, np.int64)
    for own, other, upper, phase in reversed(levels):
        ranks += _patches_before(ranks, own, other, upper, phase)
    return ranks


def _phases(axes: list[_Axis], split: int, random: np.random.Generator | None) -> Whole:
    """Give which half of each cell begins: drawn, or so that its first patch lies a third into it, not at a corner.

    For that the lower and the upper half take turns from split to split; of quarters the opposite one comes second.
    """
    if random is not None:
        (_, row), (_, column) = (np.unique(axis.start, return_inverse=True) for axis in axes)
        return random.integers(1, STEPS, (row[-1] + 1, column[-1] + 1))[np.ix_(row, column)]
    across = axes[1 - split]
    opposite = (across.upper != (across.splits % 2 == 0)) & (across.splits > axes[split].splits)
    turned = opposite != (axes[split].splits % 2 == 1)
    return _along(np.where(turned, *BEGINS[::-1]), 1 - split)


def _along(values: NDArray[Scalar], axis: int) -> NDArray[Scalar]:
    return values[:, None] if axis == 0 else values[None, :]


def _patches_before(ranks: Whole, own: Whole, other: Whole, upper: NDArray[np.bool_], phase: Whole) -> Whole:
    """Count the patches of the other half of a cell that come before the patch of each rank in its own half.

    Patch i of n comes at (i + u) / n: halves are used up at the same rate, and u, the phase, says which begins.
    """
    here, there = np.where(upper, STEPS - phase, phase), np.where(upper, phase, STEPS - phase)
    lead = (ranks * STEPS + here) * other - there * own
    step = own * STEPS
    counted = np.where(upper, lead // step + 1, -(-lead // step))  # at the same time the lower half comes first
    return np.maximum(counted, 0)
