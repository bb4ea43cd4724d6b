"""Judge a frame by some weights, and summarise many: means and standard deviations over seeds.

A record has the confusion counts and costs of every policy at each fraction of the patches. Weights without a common
frame are folds of one training and count as one seed. Weights that share a frame are different seeds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.flows.evaluate.frames import EvaluateRequest, ObservedFrame
from spectralzoom.models.evaluation.metrics import (
    average_accuracy,
    confusion,
    false_pixels,
    iou_per_class,
    kappa,
    mean_iou,
    overall_accuracy,
)
from spectralzoom.models.network.sizes import multiply_adds
from spectralzoom.models.policies.placement import mixed
from spectralzoom.models.policies.policies import score_multiply_adds, score_patches
from spectralzoom.models.reading.inference import segment
from spectralzoom.models.weights.files import Weights
from spectralzoom.pipeline.planning.coverage import frame_patches

RANDOM_DRAWS = 5
ENDS = ("none", "all")  # no patch, every patch
Record = dict[str, Any]


def judge_frame(request: EvaluateRequest, frame: ObservedFrame, weights: Weights) -> Record:
    """Return the confusion counts and multiply-adds of every policy and fraction."""
    grid = frame.seen.grid
    every = grid.every_patch()
    overview, full = (segment(weights, frame.seen, frame.fine[some], some).classes for some in (every[:0], every))
    rows: list[Record] = []
    for policy, draw, fraction, patch_index in _rows(request, frame):
        scored = 0 if policy in ENDS else score_multiply_adds(policy, weights.config, grid)
        drawn = mixed(overview, full, np.isin(every, patch_index), grid)
        row = {
            "policy": policy,
            "draw": draw,
            "fraction": fraction,
            "patches": len(patch_index),
            "counts": confusion(frame.labels, drawn, weights.config.classes).tolist(),
            "multiply_adds": multiply_adds(weights.config, grid, len(patch_index), frame.bands, score=scored).total,
        }
        rows.append(row)
    return {"frame": frame.name, "rows": rows}


def _rows(request: EvaluateRequest, frame: ObservedFrame) -> Iterator[tuple[str, int, float, NDArray[np.intp]]]:
    """Yield policy, draw, fraction and patches of each row; the random policy has several draws."""
    yield "none", 0, 0.0, np.empty(0, np.intp)
    yield "all", 0, 1.0, frame.seen.grid.every_patch()
    for policy in request.policies:
        for draw in range(RANDOM_DRAWS if policy == "random" else 1):
            scores = score_patches(policy, frame.seen, seed=request.seed + 1000 * (draw + 1))
            for fraction in request.fractions:
                yield policy, draw, fraction, frame_patches(scores, fraction)


Runs = Sequence[Sequence[Record]]  # records of the frames, of each of the weights or seeds


@dataclass(frozen=True)
class Row:
    """Counts of one policy and fraction; a run is a seed and a draw. Frames that a run did not judge are zeros."""

    counts: NDArray[np.int64]  # (run, frame, class, class)
    of_seed: NDArray[np.intp]  # (run,)
    parts: list[Record]  # rows of the records

    def over_runs(self, figure: Callable[[Any], Any]) -> NDArray[np.float64]:
        """Return a figure of the summed counts of each run, (run,) or (run, class)."""
        return np.array([figure(run.sum(axis=0)) for run in self.counts])


def seeds_of(runs: Runs) -> list[list[int]]:
    """Group weights without a common frame into seeds; return their indices. Weights without a frame are left out."""
    seeds: list[tuple[set[str], list[int]]] = []
    for number, records in enumerate(runs):
        names = {record["frame"] for record in records}
        if not names:
            continue
        for covered, members in seeds:
            if not covered & names:
                covered |= names
                members.append(number)
                break
        else:
            seeds.append((set(names), [number]))
    return [members for _, members in seeds]


def collect_row(seeds: Runs, policy: str, fraction: float) -> Row:
    """Collect the counts of one row from the records of all seeds; frames without a labelled pixel are left out."""
    found = [
        (number, record["frame"], row)
        for number, records in enumerate(seeds)
        for record in records
        for row in record["rows"]
        if (row["policy"], row["fraction"]) == (policy, fraction)
    ]
    order = sorted({frame for _, frame, row in found if np.any(row["counts"])})
    draws = 1 + max(row["draw"] for _, _, row in found)
    classes = len(found[0][2]["counts"])
    counts = np.zeros((len(seeds) * draws, len(order), classes, classes), np.int64)
    for number, frame, row in found:
        if frame in order:
            counts[number * draws + row["draw"], order.index(frame)] = row["counts"]
    return Row(counts, np.repeat(np.arange(len(seeds)), draws), [row for _, _, row in found])


def summarise(runs: Runs, class_names: Sequence[str], request: EvaluateRequest) -> Record:
    """Return the figures of every row. ``runs`` are the records of `judge_frame` of each of the weights."""
    seeds = [[record for number in members for record in runs[number]] for members in seeds_of(runs)]
    shared = [(policy, fraction) for policy in request.policies for fraction in request.fractions]
    rows = {key: collect_row(seeds, *key) for key in (("none", 0.0), *shared, ("all", 1.0))}
    whole = rows["all", 1.0]
    support = whole.counts.sum(axis=3).max(axis=0).sum(axis=0)  # labelled pixels of each class, each frame once
    table = []
    for (policy, fraction), row in rows.items():
        cost = {}  # means of a frame, and their ratio to those of all patches
        for name in ("patches", "multiply_adds"):
            done, full = (float(np.mean([one[name] for one in some.parts])) for some in (row, whole))
            cost[name] = {"done": done, "ratio": done / full if full else None}
        table.append({"policy": policy, "fraction": fraction, **_accuracy(row, class_names), "cost": cost})
    return {"rows": table, "support": dict(zip(class_names, support.tolist(), strict=True))}


def _accuracy(row: Row, class_names: Sequence[str]) -> Record:
    """Return means over the runs; the spread of the mIoU is that over seeds, for a single seed that over draws."""
    each = row.over_runs(mean_iou)
    seeds = np.array([_mean(each[row.of_seed == number]) for number in np.unique(row.of_seed)])
    repeats = seeds if len(seeds) > 1 else each
    classes = row.over_runs(iou_per_class)
    false = row.over_runs(false_pixels).mean(axis=0).tolist()  # of a run
    return {
        "frames": row.counts.shape[1],
        "miou": _mean(each),
        "spread": float(repeats.std(ddof=1)) if len(repeats) > 1 else None,
        "by_seed": seeds.tolist(),
        "pixel_accuracy": _mean(row.over_runs(overall_accuracy)),
        "average_accuracy": _mean(row.over_runs(average_accuracy)),
        "kappa": _mean(row.over_runs(kappa)),
        "per_class_iou": dict(zip(class_names, [_mean(column) for column in classes.T], strict=True)),
        "false_classes": {name: pixels for name, pixels in zip(class_names, false, strict=True) if pixels},
    }


def _mean(values: Sequence[float] | NDArray[np.float64]) -> float:
    """Return the mean without NaN; NaN for no value."""
    known = np.asarray(values, np.float64)
    known = known[~np.isnan(known)]
    return float(known.mean()) if known.size else float("nan")
