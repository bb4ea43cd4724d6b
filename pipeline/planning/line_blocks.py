"""Two ways to spend seconds on lines that need no model: blocks evenly spaced over the field, or placed at random.

A block is as wide as some rows of patches need, taps and the line's rotation included, so that all it shows is used. Wide
blocks waste fewer lines and set-ups, narrow ones are spread better and leave fewer of the seconds unspent: the width
that shows most patches for the seconds is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Axis, CostModel, Sweep
from pipeline.planning.scan_runs import ScanRun, cut_swath, joined
from pipeline.planning.swaths import Views, covered_patches, edges_from, swaths_at_patches

WIDTHS = (1, 2, 3, 4, 6, 8, 16)  # rows of patches in a block


@dataclass(frozen=True)
class Lines:
    """Lines of the fine pass and the patches they show, ascending."""

    sweeps: list[Sweep]
    patch_index: NDArray[np.intp]


@dataclass(frozen=True)
class LineBlocks:
    """All blocks of a field, strip by strip in the order of the scan, and what they cost."""

    grid: SceneGrid
    camera: LineCamera
    cost: CostModel
    swaths: tuple[Sweep, ...]
    blocks: tuple[ScanRun, ...]

    def sweeps(self, chosen: Sequence[ScanRun]) -> list[Sweep]:
        """Blocks as sweeps; those closer than a second set-up takes are scanned through."""
        setup = int(self.cost.setup_seconds(self.camera) / (self.camera.frame_ms * 1e-3))
        return [cut_swath(self.swaths[run.swath], run, f"block-{run.swath}") for run in joined(chosen, setup)]

    def seconds(self, chosen: Sequence[ScanRun]) -> float:
        """Price of some blocks [s]."""
        return self.cost.seconds(self.sweeps(chosen), self.camera)

    def patch_index(self, chosen: Sequence[ScanRun]) -> NDArray[np.intp]:
        """Give the patches that blocks show, ascending."""
        return covered_patches(self.grid, self.camera, self.sweeps(chosen))

    def evenly(self, budget_s: float) -> list[ScanRun]:
        """Choose the most evenly spaced blocks that the seconds pay for."""
        total = len(self.blocks)

        def spaced(count: int) -> list[ScanRun]:
            return [self.blocks[int((number + 0.5) * total / count)] for number in range(count)]

        for count in range(total, 0, -1):
            if self.seconds(spaced(count)) <= budget_s:
                return spaced(count)
        return []

    def at_random(self, budget_s: float, rng: np.random.Generator) -> list[ScanRun]:
        """Choose blocks in a random order, leaving out those that the seconds do not pay for any more."""
        chosen: list[ScanRun] = []
        for number in rng.permutation(len(self.blocks)):
            grown = [*chosen, self.blocks[number]]
            if self.seconds(grown) <= budget_s:
                chosen = grown
        return chosen


def most_shown(options: Sequence[LineBlocks], choose: Callable[[LineBlocks], list[ScanRun]]) -> Lines:
    """Choose blocks of every width, and give the lines of the one that shows the most patches."""
    chosen = [Lines(blocks.sweeps(some), blocks.patch_index(some)) for blocks in options for some in [choose(blocks)]]
    return max(chosen, key=lambda lines: len(lines.patch_index))


def line_blocks(grid: SceneGrid, camera: LineCamera, cost: CostModel, along: Axis, rows: int = 1) -> LineBlocks:
    """Cut the field into blocks of ``rows`` rows of patches, on the fewest strips that show every patch that can be."""
    valid = grid.valid_fraction().ravel() > 0
    views = edges_from(grid, camera, swaths_at_patches(grid, camera, along), valid)
    row, column = np.divmod(np.arange(len(valid)), grid.patch_shape[1])
    across, down = (column, row) if along == "x" else (row, column)
    swaths = _fewest_swaths(views, across)
    blocks = []
    for number, swath in enumerate(swaths):
        own = slice(views.edges[swath], views.edges[swath + 1])
        place, first, stop = down[views.patch_number[own]] // rows, views.first[own], views.stop[own]
        blocks += [
            ScanRun(number, int(first[place == at].min()), int(stop[place == at].max())) for at in np.unique(place)
        ]
    return LineBlocks(grid, camera, cost, tuple(views.swaths[swath] for swath in swaths), tuple(blocks))


def _fewest_swaths(views: Views, across: NDArray[np.intp]) -> list[int]:
    """Go along the line: of the strips that show the first patches not shown yet, take the one that shows farthest."""
    shown = [
        np.unique(across[views.patch_number[views.edges[number] : views.edges[number + 1]]])
        for number in range(len(views.swaths))
    ]
    left = set(np.concatenate(shown).tolist()) if shown else set()
    chosen: list[int] = []
    while left:
        first = min(left)
        able = [number for number, places in enumerate(shown) if first in places]
        best = max(able, key=lambda number: len(left & set(shown[number].tolist())))
        chosen.append(best)
        left -= set(shown[best].tolist())
    return chosen
