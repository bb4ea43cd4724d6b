"""Judge a frame by some weights, and summarise many: means and standard deviations over seeds.

Weights without a common frame are folds of one training and count as one seed. Weights that share a frame are different
seeds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
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


Run = Mapping[str, Mapping[Choice, Row]]  # rows of each frame, by some weights or by a seed


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


def seeds_of(runs: Sequence[Iterable[str]]) -> list[list[int]]:
    """Group weights without a common frame into seeds; return their indices. Weights without a frame are left out.

    ``runs`` are the names of the frames of each of the weights.
    """
    seeds: list[tuple[set[str], list[int]]] = []
    for number, names in enumerate(map(set, runs)):
        if not names:
            continue
        covered, members = next((one for one in seeds if not one[0] & names), (set(), []))
        if not members:
            seeds.append((covered, members))
        covered.update(names)
        members.append(number)
    return [members for _, members in seeds]


def counts_of(seeds: Sequence[Run], choice: Choice) -> Counts:
    """Return the counts of one policy and fraction, (seed, draw, frame, class, class).

    Frames without a labelled pixel are left out, those that a seed did not judge are zeros.
    """
    names = sorted({name for run in seeds for name, rows in run.items() if rows[choice].counts.any()})
    shape = next(iter(seeds[0].values()))[choice].counts.shape
    counts = np.zeros((len(seeds), shape[0], len(names), *shape[1:]), np.int64)
    for number, run in enumerate(seeds):
        for at, name in enumerate(names):
            if name in run:
                counts[number, :, at] = run[name][choice].counts
    return counts


def summarise(
    runs: Sequence[Run], class_names: Sequence[str], fractions: Sequence[float], patch: int
) -> dict[str, Any]:
    """Return the figures of every row, and in ``brief`` those of the weights and of the best plain classifier.

    ``runs`` are the rows of `judge_frame` by each of the weights, whose patches have ``patch`` px a side.
    """
    seeds = [{name: rows for number in members for name, rows in runs[number].items()} for members in seeds_of(runs)]
    shared = [(policy, fraction) for policy in POLICIES for fraction in fractions]
    whole = counts_of(seeds, ALL)
    known = all(ALONE in rows for run in seeds for rows in run.values())
    pixels = patch**2 * _cost(seeds, ALL)["patches"]
    brief = {
        name: {
            "miou": _accuracy(counts_of(seeds, choice), class_names)["miou"],
            "multiply_adds_a_pixel": _cost(seeds, choice)["multiply_adds"] / pixels,
        }
        for name, choice in (("weights", ALL), *([(PLAIN, ALONE)] if known else []))
    }
    support = whole.sum(axis=4).max(axis=(0, 1)).sum(axis=0)  # labelled pixels of each class, each frame once
    table = []
    for choice in (NONE, *shared, ALL):
        done, full = (_cost(seeds, one) for one in (choice, ALL))  # their ratio is that to all patches
        cost = {name: {"done": done[name], "ratio": done[name] / full[name] if full[name] else None} for name in done}
        figures = _accuracy(counts_of(seeds, choice), class_names)
        table.append({"policy": choice[0], "fraction": choice[1], **figures, "cost": cost})
    return {"brief": brief, "rows": table, "support": dict(zip(class_names, support.tolist(), strict=True))}


def _cost(seeds: Sequence[Run], choice: Choice) -> dict[str, float]:
    """Return the mean patches and multiply-adds of a frame."""
    rows = [of_frame[choice] for run in seeds for of_frame in run.values()]
    return {name: float(np.mean([getattr(row, name) for row in rows])) for name in ("patches", "multiply_adds")}


def _accuracy(counts: Counts, class_names: Sequence[str]) -> dict[str, Any]:
    """Return means over seeds and draws; the spread of the mIoU is that over seeds, for a single seed over draws."""

    def each(figure: Callable[[Counts], Any]) -> NDArray[np.float64]:
        """Return a figure of the summed counts, (seed, draw) or (seed, draw, class)."""
        return np.array([[figure(run.sum(axis=0)) for run in seed] for seed in counts])

    miou = each(metrics.mean_iou)
    seeds = [_mean(draws) for draws in miou]
    repeats = seeds if len(seeds) > 1 else miou[0]
    classes = np.moveaxis(each(metrics.iou_per_class), 2, 0)
    false = each(metrics.false_pixels).mean(axis=(0, 1)).tolist()
    return {
        "frames": counts.shape[2],
        "miou": _mean(miou),
        "spread": float(np.std(repeats, ddof=1)) if len(repeats) > 1 else None,
        "by_seed": seeds,
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
