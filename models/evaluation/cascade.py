"""Measure the loss of reading only the patches in full whose expected gain reaches a threshold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.evaluation.metrics import confusion, mean_iou

LEAST_GAINS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2)  # thresholds [nat per px]


@dataclass(frozen=True)
class CascadeTable:
    """Losses on validation scenes, for each threshold of the expected gain."""

    least_gain: tuple[float, ...]  # ascending [nat per px]
    loss: tuple[float, ...]  # mIoU of the map read in full minus that of the part
    fraction: tuple[float, ...]  # of the patches that are read in full

    @staticmethod
    def read(content: Mapping[str, Any]) -> CascadeTable:
        """Read what `dataclasses.asdict` gave for a record."""
        return CascadeTable(*(tuple(map(float, content[name])) for name in ("least_gain", "loss", "fraction")))

    @staticmethod
    def judged(scenes: Sequence[ReadTwice], classes: int) -> CascadeTable:
        """Judge the maps of all scenes together."""
        whole = mean_iou(np.sum([one.counts(0.0, classes)[0] for one in scenes], axis=0))
        losses, fractions = [], []
        for least in LEAST_GAINS:
            counts, read = zip(*(one.counts(least, classes) for one in scenes), strict=True)
            losses.append(whole - mean_iou(np.sum(counts, axis=0)))
            fractions.append(sum(read) / sum(one.gain.size for one in scenes))
        return CascadeTable(LEAST_GAINS, tuple(losses), tuple(fractions))

    def within(self, loss: float) -> tuple[float, float] | None:
        """Return the highest threshold within a loss, and the fraction of patches read by it; None where all lose more.

        Between the last row within the loss and the first beyond it, logarithms of the gain are interpolated.
        """
        rows = int(np.cumprod(np.asarray(self.loss) <= loss).sum())
        if rows == 0:
            return None
        ends = slice(rows - 1, rows + 1)
        gain = np.interp(loss, self.loss[ends], np.log(self.least_gain[ends]))
        return float(np.exp(gain)), float(np.interp(loss, self.loss[ends], self.fraction[ends]))


@dataclass(frozen=True)
class ReadTwice:
    """The map of a scene by the overview, and by the full network everywhere."""

    overview: NDArray[np.uint8]  # (y, x) classes
    full: NDArray[np.uint8]  # (y, x)
    gain: NDArray[np.float64]  # (patch_y, patch_x) expected [nat per px]
    labels: NDArray[np.uint8]  # (y, x)
    patch: int

    def counts(self, least_gain: float, classes: int) -> tuple[NDArray[np.int64], int]:
        """Return the confusion of the map with patches of at least this gain read in full, and their number.

        A threshold of 0 reads all of them.
        """
        chosen = (self.gain >= least_gain) | (least_gain == 0)
        y, x = self.labels.shape
        pixels = chosen.repeat(self.patch, 0).repeat(self.patch, 1)[:y, :x]
        return confusion(self.labels, np.where(pixels, self.full, self.overview), classes), int(chosen.sum())
