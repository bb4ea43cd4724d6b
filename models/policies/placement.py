"""Mix the maps of a scene by the overview and by the full network, and measure what reading a part of it loses.

This is evaluation only: it needs labels and the whole scene at full resolution.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.models.evaluation.metrics import Counts, confusion, mean_iou
from spectralzoom.models.policies.policies import score_patches
from spectralzoom.models.reading.inference import CoarsePrediction, segment
from spectralzoom.models.weights.files import Weights
from spectralzoom.pipeline.geometry.grid import SceneGrid

LEAST_GAINS = tuple(np.geomspace(0.005, 0.5, 25).round(4).tolist())  # thresholds of scores by ``gain``


def classes_by(weights: Weights, seen: CoarsePrediction, patch_index: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Return the class map (y, x) with these patches read in full."""
    return segment(weights, seen, seen.patches(patch_index), patch_index).classes


def mixed(
    overview: NDArray[np.uint8], full: NDArray[np.uint8], chosen: NDArray[np.bool_], grid: SceneGrid
) -> NDArray[np.uint8]:
    """Return the map (y, x) of the overview, and of the full network in the ``chosen`` (patch,) patches."""
    y, x = overview.shape
    pixels = chosen.reshape(grid.patch_shape).repeat(grid.patch, 0).repeat(grid.patch, 1)[:y, :x]
    return np.where(pixels, full, overview)


@dataclass(frozen=True)
class ReadTwice:
    """Maps of a scene by the overview, and by the full network everywhere. Any choice of patches is a mix of both."""

    overview: NDArray[np.uint8]  # (y, x) classes
    full: NDArray[np.uint8]  # (y, x)
    gain: NDArray[np.float64]  # (patch,) scores by the policy
    labels: NDArray[np.uint8]  # (y, x) class indices, 255 unlabelled
    grid: SceneGrid

    @staticmethod
    def of(weights: Weights, seen: CoarsePrediction, labels: NDArray[np.uint8]) -> ReadTwice:
        """Segment a scene twice, and score its patches."""
        every = seen.grid.every_patch()
        overview, full = (classes_by(weights, seen, some) for some in (every[:0], every))
        return ReadTwice(overview, full, score_patches("gain", seen), labels, seen.grid)

    def counts(self, chosen: NDArray[np.bool_], classes: int) -> Counts:
        """Return the confusion of the map whose ``chosen`` (patch,) patches are read in full."""
        return confusion(self.labels, mixed(self.overview, self.full, chosen, self.grid), classes)


@dataclass(frozen=True)
class CascadeTable:
    """Mean losses and readings of validation scenes, for each threshold of the expected gain."""

    least_gain: tuple[float, ...]  # ascending
    loss: tuple[float, ...]  # mIoU of the map read in full minus that of the part
    fraction: tuple[float, ...]  # of the patches that are read in full, median of the scenes
    fewest: tuple[float, ...] = ()  # of the scene that needs fewest; empty if not known
    most: tuple[float, ...] = ()

    @staticmethod
    def read(content: Mapping[str, Any]) -> CascadeTable:
        """Read what `dataclasses.asdict` gave for a record."""
        known = (one.name for one in fields(CascadeTable) if one.name in content)
        return CascadeTable(**{name: tuple(map(float, content[name])) for name in known})

    @staticmethod
    def of_overview() -> CascadeTable:
        """Return the table of weights whose overview is all: a full reading adds nothing."""
        zeros = (0.0,) * len(LEAST_GAINS)
        return CascadeTable(LEAST_GAINS, zeros, zeros)

    @staticmethod
    def judged(scenes: Sequence[ReadTwice], classes: int) -> CascadeTable:
        """Judge the map of each scene, for each threshold of the score by ``gain``."""
        losses, fractions = np.zeros((2, len(LEAST_GAINS), len(scenes)))
        for number, one in enumerate(scenes):
            every = one.counts(np.ones(one.gain.shape, np.bool_), classes)
            for row, least in enumerate(LEAST_GAINS):
                chosen = one.gain >= least
                losses[row, number] = mean_iou(every) - mean_iou(one.counts(chosen, classes))
                fractions[row, number] = chosen.mean()
        rows = (losses.mean(axis=1), np.median(fractions, axis=1), fractions.min(axis=1), fractions.max(axis=1))
        return CascadeTable(LEAST_GAINS, *(tuple(row.tolist()) for row in rows))

    def within(self, loss: float) -> float | None:
        """Return the highest threshold within a loss; None where all lose more.

        Between the last row within the loss and the first beyond it, logarithms of the gain are interpolated.
        """
        rows = int(np.cumprod(np.asarray(self.loss) <= loss).sum())
        if rows == 0:
            return None
        ends = slice(rows - 1, rows + 1)
        return float(np.exp(np.interp(loss, self.loss[ends], np.log(self.least_gain[ends]))))

    def fractions_at(self, least_gain: float) -> list[float]:
        """Return usual, fewest and most patches that a threshold reads [fraction], by logarithms of the gain."""
        columns = (self.fraction, self.fewest or self.fraction, self.most or self.fraction)
        return [float(np.interp(np.log(least_gain), np.log(self.least_gain), column)) for column in columns]
