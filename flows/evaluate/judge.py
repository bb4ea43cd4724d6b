"""Judge a frame by some weights, and summarise many: means and standard deviations over weights."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.models.evaluation import metrics
from spectralzoom.models.network.sizes import multiply_adds
from spectralzoom.models.policies.placement import ReadTwice
from spectralzoom.models.policies.policies import score_multiply_adds, score_patches
from spectralzoom.models.reading.inference import CoarsePrediction, plain_classes
from spectralzoom.models.weights.files import PLAIN, Weights
from spectralzoom.pipeline.planning.coverage import frame_patches

POLICIES = {"gain": 1, "random": 5}  # policy: draws
NONE, ALL = ("none", 0.0), ("all", 1.0)  # no patch, every patch
ENDS = (NONE[0], ALL[0])
ALONE = (PLAIN, 0.0)  # the best classifier of single spectra
Choice = tuple[str, float]  # policy, and fraction of the patches
Counts = NDArray[np.int64]


@dataclass(frozen=True)
class Row:
    """A frame with the patches of one policy and fraction."""

    counts: Counts  # (draw, class, class); the random policy has several draws
    patches: int
    multiply_adds: int


Run = Mapping[str, Mapping[Choice, Row]]  # rows of each frame, by some weights


def judge_frame(
    seen: CoarsePrediction,
    labels: NDArray[np.uint8],
    bands: int,
    weights: Weights,
    fractions: Sequence[float],
    seed: int,
) -> dict[Choice, Row]:
    """Return the confusion counts and multiply-adds of every policy and fraction, by ``labels`` (y, x)."""
    grid, config = seen.grid, weights.config
    every = grid.every_patch()
    maps = ReadTwice.of(weights, seen, labels)
    chosen = {NONE: [every[:0]], ALL: [every]}  # patches of each draw
    for policy, draws in POLICIES.items():
        scores = [score_patches(policy, seen, seed=seed + 1000 * draw) for draw in range(1, draws + 1)]
        chosen |= {(policy, part): [frame_patches(one, part) for one in scores] for part in fractions}
    rows = {}
    for (policy, fraction), drawn in chosen.items():
        counts = np.array([maps.counts(np.isin(every, some), config.classes) for some in drawn])
        scored = 0 if policy in ENDS else score_multiply_adds(policy, config, grid)
        spent = multiply_adds(config, grid, len(drawn[0]), bands, score=scored).total
        rows[policy, fraction] = Row(counts, len(drawn[0]), spent)
    if (part := weights.record.get(PLAIN)) is not None:
        drawn_alone = metrics.confusion(labels, plain_classes(weights, seen, part), config.classes)
        alone = replace(config, parts=((*config.parts[part][:2], 1.0),), context=False, corrected=False)
        rows[ALONE] = Row(drawn_alone[None], 0, multiply_adds(alone, grid, 0, bands).total)
    return rows


def summarise(
    runs: Sequence[Run], class_names: Sequence[str], fractions: Sequence[float], patch: int
) -> dict[str, Any]:
    """Return the figures of every row, and in ``brief`` those of the weights and of the best plain classifier.

    ``runs`` are the rows of `judge_frame` by each of the weights, whose patches have ``patch`` px a side.
    """
    choices = [NONE, *((policy, fraction) for policy in POLICIES for fraction in fractions), ALL]
    table = [
        {"policy": one[0], "fraction": one[1], **_accuracy(runs, one, class_names), **_cost(runs, one)}
        for one in choices
    ]
    brief = {"weights": ALL}
    if all(ALONE in rows for run in runs for rows in run.values()):
        brief[PLAIN] = ALONE
    pixels = patch**2 * _cost(runs, ALL)["patches"]
    labelled = {name: rows[ALL].counts[0].sum(axis=1) for run in runs for name, rows in run.items()}
    return {
        "brief": {
            name: {
                "miou": _accuracy(runs, one, class_names)["miou"],
                "multiply_adds_a_pixel": _cost(runs, one)["multiply_adds"] / pixels,
            }
            for name, one in brief.items()
        },
        "rows": table,
        "support": dict(zip(class_names, np.sum([*labelled.values()], axis=0).tolist(), strict=True)),
    }


def _cost(runs: Sequence[Run], choice: Choice) -> dict[str, float]:
    """Return the mean patches and multiply-adds of a frame."""
    rows = [of_frame[choice] for run in runs for of_frame in run.values()]
    return {name: float(np.mean([getattr(row, name) for row in rows])) for name in ("patches", "multiply_adds")}


def _accuracy(runs: Sequence[Run], choice: Choice, class_names: Sequence[str]) -> dict[str, Any]:
    """Return means over weights and draws of the figures of all frames together.

    The spread of the mIoU is its standard deviation over the weights, for a single file over the draws.
    """
    totals = [np.sum([rows[choice].counts for rows in run.values()], axis=0) for run in runs]

    def each(figure: Callable[[Counts], Any]) -> NDArray[np.float64]:
        """Return a figure, (weights, draw) or (weights, draw, class)."""
        return np.array([[figure(draw) for draw in run] for run in totals])

    miou = each(metrics.mean_iou)
    by_weights = [_mean(draws) for draws in miou]
    repeats = by_weights if len(by_weights) > 1 else miou[0]
    classes = np.moveaxis(each(metrics.iou_per_class), 2, 0)
    false = each(metrics.false_pixels).mean(axis=(0, 1)).tolist()
    return {
        "miou": _mean(miou),
        "spread": float(np.std(repeats, ddof=1)) if len(repeats) > 1 else None,
        "by_weights": by_weights,
        "pixel_accuracy": _mean(each(metrics.overall_accuracy)),
        "average_accuracy": _mean(each(metrics.average_accuracy)),
        "kappa": _mean(each(metrics.kappa)),
        "per_class_iou": dict(zip(class_names, map(_mean, classes), strict=True)),
        "false_classes": {name: pixels for name, pixels in zip(class_names, false, strict=True) if pixels},
    }


def _mean(values: NDArray[np.float64]) -> float:
    """Return the mean without NaN; NaN for no value."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if known.size else float("nan")
