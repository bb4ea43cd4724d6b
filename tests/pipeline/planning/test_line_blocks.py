"""Lines spent without a model: blocks that cover the field, evenly or at random, never above the seconds given."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Axis, CostModel
from pipeline.planning.line_blocks import WIDTHS, LineBlocks, line_blocks, most_shown

CAMERA, COST = LineCamera(samples=64), CostModel()


def _blocks(rows: int = 1, along: Axis = "x") -> LineBlocks:
    return line_blocks(SceneGrid(128, 160, 8, 2), CAMERA, COST, along, rows)


@pytest.mark.parametrize("along", ["x", "y"])
@pytest.mark.parametrize("rows", [1, 4])
def test_all_blocks_show_every_patch(along: Axis, rows: int):
    """Every strip shows whole patches, and together all of them."""
    blocks = _blocks(rows, along)
    assert blocks.patch_index(blocks.blocks).tolist() == list(range(16 * 20))


def test_a_block_shows_a_row_of_its_swath():
    """One block alone shows as many patches as a line is wide, and its lines are priced with a set-up."""
    blocks = _blocks()
    one = [blocks.blocks[3]]
    patch_index = blocks.patch_index(one)
    assert len(patch_index) == 8
    assert len(np.unique(patch_index // 20)) == 1
    assert blocks.seconds(one) == pytest.approx(COST.seconds(blocks.sweeps(one), CAMERA))


@pytest.mark.parametrize("fraction", [0.1, 0.4, 0.9])
def test_no_choice_exceeds_its_seconds(fraction: float):
    """Even and random choices cost at most what is given, and one more evenly spaced block would be too dear."""
    blocks = _blocks()
    budget = fraction * blocks.seconds(blocks.blocks)
    even, drawn = blocks.evenly(budget), blocks.at_random(budget, np.random.default_rng(0))
    assert 0 < blocks.seconds(even) <= budget
    assert 0 < blocks.seconds(drawn) <= budget
    assert len(set(even)) == len(even)


def test_neighbouring_blocks_are_one_sweep():
    """A second set-up is not paid where scanning on is cheaper."""
    blocks = _blocks()
    both, first = blocks.blocks[:2], blocks.blocks[:1]
    assert len(blocks.sweeps(both)) == 1
    assert blocks.seconds(both) < 2 * blocks.seconds(first)
    assert len(blocks.sweeps([blocks.blocks[0], blocks.blocks[8]])) == 2


def test_wide_blocks_are_tried_where_they_show_more():
    """Lines without a model are no weaker than they can be: on a frame of 1296 x 966 px wide blocks show most."""
    grid, camera = SceneGrid(966, 1296, 32, 4), LineCamera()
    narrow, wide = (
        most_shown([line_blocks(grid, camera, COST, "y", rows) for rows in widths], lambda blocks: blocks.evenly(23.0))
        for widths in ((1, 2), WIDTHS)
    )
    assert len(wide.patch_index) > 1.5 * len(narrow.patch_index)
