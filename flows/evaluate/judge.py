"""Judge a frame by some weights, and summarise many: means over seeds, intervals over frames and seeds.

A record has the confusion counts and costs of every policy at each fraction of the patches. Weights without a common
frame are folds of one training and count as one seed. Weights that share a frame are different seeds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.evaluate.frames import EvaluateRequest, ObservedFrame
from models.evaluation.metrics import (
    average_accuracy,
    false_pixels,
    gap_closed,
    iou_per_class,
    kappa,
    mean_iou,
    overall_accuracy,
    paired_interval,
)
from models.network.sizes import multiply_adds
from models.policies.placement import RANDOM_DRAWS, ReadTwice, oracle_gain
from models.policies.policies import score_multiply_adds, score_patches
from models.reading.inference import segment
from models.weights.files import Weights
from pipeline.planning.coverage import frame_patches

ORACLE = "oracle"
ENDS = ("none", "all")  # no patch, every patch
Record = dict[str, Any]


def judge_frame(request: EvaluateRequest, frame: ObservedFrame, weights: Weights) -> Record:
    """Return the confusion counts, gain and multiply-adds of every policy and fraction."""
    grid = frame.seen.grid
    every = grid.every_patch()
    gain = oracle_gain(weights, frame.seen, frame.fine, frame.labels)
    overview, full = (segment(weights, frame.seen, frame.fine[some], some).classes for some in (every[:0], every))
    scene = ReadTwice(overview, full, {}, frame.labels, grid)
    rows: list[Record] = []
    for policy, draw, fraction, patch_index in _rows(request, frame, gain):
        scored = 0 if policy in (*ENDS, ORACLE) else score_multiply_adds(policy, weights.config, grid)
        chosen = np.isin(np.arange(gain.size), patch_index).reshape(grid.patch_shape)
        row = {
            "policy": policy,
            "draw": draw,
            "fraction": fraction,
            "patches": len(patch_index),
            "gain": float(gain[patch_index].sum()),
            "best_gain": float(np.sort(gain)[::-1][: len(patch_index)].sum()),  # of as many of the best
            "counts": scene.counts(chosen, weights.config.classes).tolist(),
            "multiply_adds": multiply_adds(weights.config, grid, len(patch_index), frame.bands, score=scored).total,
        }
        rows.append(row)
    return {"frame": frame.name, "shape": [grid.height, grid.width], "rows": rows}


def _rows(
    request: EvaluateRequest, frame: ObservedFrame, gain: NDArray[np.float64]
) -> Iterator[tuple[str, int, float, NDArray[np.intp]]]:
    """Yield policy, draw, fraction and patches of each row; the random policy has several draws."""
    yield "none", 0, 0.0, np.empty(0, np.intp)
    yield "all", 0, 1.0, frame.seen.grid.every_patch()
    for policy in (*request.policies, ORACLE):
        for draw in range(RANDOM_DRAWS if policy == "random" else 1):
            seed = request.seed + 1000 * (draw + 1)
            scores = gain if policy == ORACLE else score_patches(policy, frame.seen, seed=seed)
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


def difference(row: Row, other: Row | None, request: EvaluateRequest) -> Record | None:
    """Return the paired interval of one row minus another, over their frames; None without another."""
    if other is None or other is row:
        return None
    found = paired_interval(
        row.counts, other.counts, seeds=(row.of_seed, other.of_seed), draws=request.draws, seed=request.seed
    )
    return {**asdict(found), "frames": row.counts.shape[1]}


def summarise(runs: Runs, class_names: Sequence[str], request: EvaluateRequest) -> Record:
    """Return the figures of every row, compared with all patches and with the random policy.

    ``runs`` are the records of `judge_frame` of each of the weights.
    """
    seeds = [[record for number in members for record in runs[number]] for members in seeds_of(runs)]
    shared = [(policy, fraction) for policy in (*request.policies, ORACLE) for fraction in request.fractions]
    rows = {key: collect_row(seeds, *key) for key in (("none", 0.0), *shared, ("all", 1.0))}
    whole, none = rows["all", 1.0], rows["none", 0.0]
    ends = [_mean(row.over_runs(mean_iou)) for row in (none, whole)]
    support = whole.counts.sum(axis=3).max(axis=0).sum(axis=0)  # labelled pixels of each class, each frame once
    table = []
    for (policy, fraction), row in rows.items():
        accuracy = _accuracy(row, class_names)
        bought, best = (sum(part[name] for part in row.parts) for name in ("gain", "best_gain"))
        cost = {}  # means of a frame, and their ratio to those of all patches
        for name in ("patches", "multiply_adds"):
            done, full = (float(np.mean([one[name] for one in some.parts])) for some in (row, whole))
            cost[name] = {"done": done, "ratio": done / full if full else None}
        table.append(
            {
                "policy": policy,
                "fraction": fraction,
                "uses_labels": policy == ORACLE,
                **accuracy,
                "gap_closed": None if policy in ENDS else gap_closed(accuracy["miou"], *ends),
                "captured_gain": bought / best if best > 0 else None,
                "against_all": difference(row, whole, request),
                "against_random": difference(row, rows.get(("random", fraction)), request),
                "cost": cost,
            }
        )
    return {"rows": table, "support": dict(zip(class_names, support.tolist(), strict=True))}


def _accuracy(row: Row, class_names: Sequence[str]) -> Record:
    each = row.over_runs(mean_iou)
    drawn = [each[row.of_seed == number] for number in np.unique(row.of_seed)]
    seeds = np.array([_mean(some) for some in drawn])
    classes = row.over_runs(iou_per_class)
    false = row.over_runs(false_pixels).mean(axis=0).tolist()  # of a run
    return {
        "frames": row.counts.shape[1],
        "miou": _mean(each),
        "spread": float(seeds.std(ddof=1)) if len(seeds) > 1 else None,
        "draws_spread": _mean([some.std(ddof=1) for some in drawn]) if len(drawn[0]) > 1 else None,
        "by_seed": seeds.tolist(),
        "classes_averaged": int((~np.isnan(classes)).any(axis=0).sum()),
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
