"""Round scores to whole steps, so that the means of blocks stay."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

MEAN_SIDE = 4  # of the blocks of spectra whose means are kept where scores are rounded coarsely


def whole_steps(scores: NDArray[np.floating], step: float) -> NDArray[np.floating]:
    """Round scores (line, sample, component) to whole steps; above the noise, blocks of 4 x 4 keep their means.

    Rounding each score alone loses signals below a coarse step, although many spectra show them. So the errors of a
    block are added, and as many scores as that sum are rounded the other way. Those nearest to the next number come
    first (controlled rounding of tables: Cox 1987). No score is off by more than one step, and the mean of a block by
    more than 1/32. Blocks that are incomplete, or have a score that is not finite, are rounded score by score.
    """
    side = MEAN_SIDE
    steps = scores / np.float32(step)
    rounded: NDArray[np.floating] = np.rint(steps)
    lines, samples, count = (*(size // side * side for size in steps.shape[:2]), steps.shape[2])
    if step <= 1 or not lines * samples * count:
        return rounded
    seen = np.isfinite(steps)

    def by_block(image: NDArray[Any]) -> NDArray[Any]:
        blocks = image[:lines, :samples].reshape(lines // side, side, samples // side, side, count)
        return blocks.transpose(0, 2, 4, 1, 3).reshape(-1, side**2)

    off = by_block(np.subtract(steps, rounded, out=np.zeros_like(steps), where=seen))
    excess = np.where(by_block(seen).all(axis=1), np.rint(off.sum(axis=1)), 0).astype(np.int64)[:, None]
    place = off.argsort(axis=1, kind="stable").argsort(axis=1, kind="stable")
    moved = (place >= side**2 - excess).astype(np.int8) - (place < -excess)
    moved = moved.reshape(lines // side, samples // side, count, side, side).transpose(0, 3, 1, 4, 2)
    rounded[:lines, :samples] += moved.reshape(lines, samples, count)
    return rounded
