"""Compare placements of patches with the ideal one and with other policies, and measure what a part of them loses.

This is evaluation only: it needs labels and the whole scene at full resolution.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from models.evaluation.metrics import Counts, agreement, confusion, gap_closed, mean_iou
from models.network.spectral import patches_of
from models.policies.policies import random_scores, score_patches
from models.reading.inference import CoarsePrediction, captured, overview_of, patch_logits, segment
from models.weights.files import Weights
from pipeline.geometry.grid import UNLABELLED, SceneGrid, patch_pixels
from pipeline.lazy import torch
from pipeline.planning.coverage import frame_patches

RANDOM_DRAWS = 5
COMPARED = ("gain", "entropy", "sobel")  # policies beside the random one
MOST_GAIN = 5.0  # gains are clipped to this [nat per px]; one confident error would outweigh a field
LEAST_GAINS = tuple(np.geomspace(0.005, 0.5, 25).round(4).tolist())  # thresholds of scores by ``gain``
CONTROL_FRACTION = 0.35  # of the patches: K = 35 % of surveys' receipts and of the weights' records


def oracle_gain(
    weights: Weights, seen: CoarsePrediction, fine: NDArray[np.floating], labels: NDArray[np.uint8]
) -> NDArray[np.float64]:
    """Return the loss without fine patches minus the loss with all of them, (patch,) [nat], mean over its pixels.

    The loss is the cross-entropy of the labelled pixels; other pixels add 0 to the mean. It is clipped to -5..5, and
    negative where the full network makes the map worse. A patch with too few valid pixels is left out, as in the map.

    ``fine`` (patch, p, p, column) are normalised columns of every patch of the padded grid, ``labels`` (y, x) class
    indices of the scene, 255 unlabelled.
    """
    p = seen.grid.patch
    truth = patch_pixels(seen.grid, labels, UNLABELLED)
    gain = np.zeros(len(truth))
    patches, patch_index = captured(fine, seen.grid.every_patch())
    with torch.inference_mode():
        overview = overview_of(weights, seen)
        before = patches_of(overview.logits[0].permute(1, 2, 0).cpu().numpy(), p).transpose(0, 3, 1, 2)
        first = 0
        for after in patch_logits(weights, overview, patches, patch_index, seen.capture):
            some = patch_index[first : first + len(after)]
            lower = _losses(before[some], truth[some]) - _losses(after.numpy(), truth[some])
            gain[some] = lower.sum(axis=(1, 2)) / p**2
            first += len(after)
    return np.clip(gain, -MOST_GAIN, MOST_GAIN)


def _losses(logits: NDArray[np.float32], truth: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return the cross-entropy of each pixel, (patch, class, y, x) -> (patch, y, x); 0 if unlabelled."""
    labelled = truth != UNLABELLED
    index = np.where(labelled, truth, 0).astype(np.intp)[:, None]
    exact = logits.astype(np.float64)
    loss = scipy.special.logsumexp(exact, axis=1) - np.take_along_axis(exact, index, axis=1)[:, 0]
    return np.where(labelled, loss, 0.0)


Placements = dict[str, list[Counts]]  # row -> confusion counts of its map; of ``random`` several


def placement_figures(rows: Placements) -> dict[str, dict[str, Any]]:
    """Return `agreement` and the fraction of the gap closed of every policy; mean and spread of the random one."""
    none, every = (mean_iou(rows[name][0]) for name in ("none", "all"))
    found: dict[str, dict[str, Any]] = {}
    for policy, draws in rows.items():
        if policy in ("none", "all"):
            continue
        each = [agreement(counts) for counts in draws]
        means = {name: float(np.mean([one[name] for one in each])) for name in each[0]}
        found[policy] = {
            **means,
            "spread": float(np.std([one["miou"] for one in each], ddof=1)) if len(each) > 1 else None,
            "gap_closed": gap_closed(means["miou"], none, every),
        }
    return found


def classes_by(weights: Weights, seen: CoarsePrediction, patch_index: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Return the class map (y, x) with these patches read in full."""
    return segment(weights, seen, seen.patches(patch_index), patch_index).classes


@dataclass(frozen=True)
class ReadTwice:
    """Maps of a scene by the overview, and by the full network everywhere. Any choice of patches is a mix of both."""

    overview: NDArray[np.uint8]  # (y, x) classes
    full: NDArray[np.uint8]  # (y, x)
    scores: Mapping[str, NDArray[np.float64]]  # (patch_y, patch_x) by policies
    labels: NDArray[np.uint8]  # (y, x) class indices, 255 unlabelled
    grid: SceneGrid

    @staticmethod
    def of(weights: Weights, seen: CoarsePrediction, labels: NDArray[np.uint8]) -> ReadTwice:
        """Segment a scene twice, and score its patches by the policies that are compared."""
        every = seen.grid.every_patch()
        overview, full = (classes_by(weights, seen, some) for some in (every[:0], every))
        scores = {policy: score_patches(policy, seen).reshape(seen.grid.patch_shape) for policy in COMPARED}
        return ReadTwice(overview, full, scores, labels, seen.grid)

    def counts(self, chosen: NDArray[np.bool_], classes: int) -> Counts:
        """Return the confusion of the map whose ``chosen`` (patch_y, patch_x) patches are read in full."""
        y, x = self.labels.shape
        pixels = chosen.repeat(self.grid.patch, 0).repeat(self.grid.patch, 1)[:y, :x]
        return confusion(self.labels, np.where(pixels, self.full, self.overview), classes)


def run_controls(
    scene: ReadTwice, classes: int, *, fraction: float, seed: int, among: NDArray[np.bool_] | None = None
) -> Placements:
    """Return the confusion with no patch, all patches, and a ``fraction`` of them by each policy and at random.

    ``among`` (patch,) says which patches count (None: all).
    """
    grid = scene.grid
    allowed = np.ones(len(grid.every_patch()), np.bool_) if among is None else among

    def placed(scores: NDArray[np.float64]) -> Counts:
        chosen = np.zeros(allowed.shape, np.bool_)
        chosen[frame_patches(scores.ravel(), fraction, allowed)] = True
        return scene.counts(chosen.reshape(grid.patch_shape), classes)

    return {
        "none": [scene.counts(np.zeros(grid.patch_shape, np.bool_), classes)],
        "all": [scene.counts(allowed.reshape(grid.patch_shape), classes)],
        **{policy: [placed(scores)] for policy, scores in scene.scores.items()},
        "random": [placed(random_scores(grid, seed + 1000 * (draw + 1))) for draw in range(RANDOM_DRAWS)],
    }


@dataclass(frozen=True)
class CascadeTable:
    """Mean losses of validation scenes, for each threshold of the expected gain."""

    least_gain: tuple[float, ...]  # ascending
    loss: tuple[float, ...]  # mIoU of the map read in full minus that of the part
    fraction: tuple[float, ...]  # of the patches that are read in full

    @staticmethod
    def read(content: Mapping[str, Any]) -> CascadeTable:
        """Read what `dataclasses.asdict` gave for a record."""
        return CascadeTable(*(tuple(map(float, content[name])) for name in ("least_gain", "loss", "fraction")))

    @staticmethod
    def judged(scenes: Sequence[ReadTwice], classes: int) -> CascadeTable:
        """Judge the map of each scene, for each threshold of the score by ``gain``."""
        losses, fractions = np.zeros((2, len(LEAST_GAINS), len(scenes)))
        for number, one in enumerate(scenes):
            every = one.counts(np.ones(one.grid.patch_shape, np.bool_), classes)
            for row, least in enumerate(LEAST_GAINS):
                chosen = one.scores["gain"] >= least
                losses[row, number] = mean_iou(every) - mean_iou(one.counts(chosen, classes))
                fractions[row, number] = chosen.mean()
        return CascadeTable(LEAST_GAINS, *(tuple(rows.mean(axis=1).tolist()) for rows in (losses, fractions)))

    def within(self, loss: float) -> float | None:
        """Return the highest threshold within a loss; None where all lose more.

        Between the last row within the loss and the first beyond it, logarithms of the gain are interpolated.
        """
        rows = int(np.cumprod(np.asarray(self.loss) <= loss).sum())
        if rows == 0:
            return None
        ends = slice(rows - 1, rows + 1)
        return float(np.exp(np.interp(loss, self.loss[ends], np.log(self.least_gain[ends]))))

    def fraction_at(self, least_gain: float) -> float:
        """Return the fraction of patches that a threshold reads, interpolated over logarithms of the gain."""
        return float(np.interp(np.log(least_gain), np.log(self.least_gain), self.fraction))
