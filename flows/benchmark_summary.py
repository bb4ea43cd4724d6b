"""From counts of frames to the figures of an evaluation: means over seeds, intervals over frames, costs beside all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.benchmark_rows import ORACLE
from flows.benchmark_timing import row_seconds
from models.bootstrap import paired_interval
from models.boundary import boundary_iou, mean_boundary_iou
from models.metrics import (
    frequency_weighted_iou,
    gap_closed,
    iou_per_class,
    mean_iou,
    miou_over_frame_classes,
    miou_over_frames,
    overall_accuracy,
)
from models.placement_metrics import captured_gain

Record = dict[str, Any]
Runs = Sequence[Sequence[Record]]  # of each weights, the records of its frames


@dataclass(frozen=True)
class Row:
    """One policy at one share over all frames; a run is one weights with one draw. Zeros where a run has no frame."""

    policy: str
    share: float
    counts: NDArray[np.int64]  # (run, frame, class, class)
    inside: NDArray[np.int64]
    boundary: NDArray[np.int64]  # (run, frame, class, 2)
    of_weights: NDArray[np.intp]  # (run,) which of the weights
    parts: list[Record]  # rows of the records

    def over_runs(self, figure: Any, what: str = "counts") -> NDArray[np.float64]:
        """A figure of each run's frames together, (run,) or (run, class)."""
        return np.array([figure(run.sum(axis=0)) for run in getattr(self, what)])


def collect_row(runs: Runs, policy: str, share: float) -> Row:
    """Gather the counts of one row from the records of all weights."""
    names = frame_names(runs)
    draws = sorted({row["draw"] for record in runs[0] for row in record["rows"] if row["policy"] == policy})
    classes = len(runs[0][0]["rows"][0]["counts"])
    shape = (len(runs) * len(draws), len(names), classes)
    counts, inside = (np.zeros((*shape, classes), np.int64) for _ in range(2))
    boundary, parts = np.zeros((*shape, 2), np.int64), []
    for number, records in enumerate(runs):
        for record in records:
            at = names.index(record["frame"])
            for row in record["rows"]:
                if (row["policy"], row["share"]) == (policy, share):
                    run = number * len(draws) + draws.index(row["draw"])
                    counts[run, at], inside[run, at], boundary[run, at] = row["counts"], row["inside"], row["boundary"]
                    parts.append(row)
    return Row(policy, share, counts, inside, boundary, np.repeat(np.arange(len(runs)), len(draws)), parts)


def frame_names(runs: Runs) -> list[str]:
    """Every frame that any of the weights was judged on, in order."""
    return sorted({record["frame"] for records in runs for record in records})


def summarise(runs: Runs, class_names: Sequence[str], trial: Record, timed: Runs, captured: list[Record]) -> Record:
    """Give the figures of every row.

    Parameters
    ----------
    runs
        Of each weights, the records of `judge_frame`.
    trial
        ``shares``, ``policies``, ``seed``, ``draws`` (of the bootstrap).
    timed
        Records of `time_frame`, of each weights.
    captured
        Records of `capture_seconds`.
    """
    every = [(policy, share) for policy in (*trial["policies"], ORACLE) for share in trial["shares"]]
    rows = {key: collect_row(runs, *key) for key in [("none", 0.0), *every, ("all", 1.0)]}
    whole, none = rows["all", 1.0], rows["none", 0.0]
    known = (_mean(none.over_runs(mean_iou)), _mean(whole.over_runs(mean_iou)))
    spent = [record for records in timed for record in records]
    table = []
    for (policy, share), row in rows.items():
        figures = {"policy": policy, "share": share, "uses_labels": policy == ORACLE, **_accuracy(row, class_names)}
        figures["gap_closed"] = gap_closed(figures["miou"], *known)
        figures["against_all"] = None if policy == "all" else _interval(row, whole, trial)
        rival = rows.get(("random", share)) if policy != "random" else None
        figures["against_random"] = None if rival is None else _interval(row, rival, trial)
        figures |= _placement(row, runs)
        figures["cost"] = _cost(row, whole, spent, captured)
        table.append(figures)
    return {"rows": table, "support": dict(zip(class_names, _support(whole).tolist(), strict=True))}


def _support(row: Row) -> NDArray[np.int64]:
    """Labelled pixels of each class over all frames, each frame once."""
    total: NDArray[np.int64] = row.counts.sum(axis=3).max(axis=0).sum(axis=0)
    return total


def _accuracy(row: Row, class_names: Sequence[str]) -> Record:
    each = row.over_runs(mean_iou)
    by_weights = np.array([_mean(each[row.of_weights == number]) for number in np.unique(row.of_weights)])
    classes = row.over_runs(iou_per_class)
    judged = [run[run.any(axis=(1, 2))] for run in row.counts]
    outside = [mean_iou((whole - part).sum(axis=0)) for whole, part in zip(row.counts, row.inside, strict=True)]
    return {
        "miou": _mean(each),
        "spread": float(by_weights.std(ddof=1)) if len(by_weights) > 1 else None,
        "draws_spread": _draws_spread(row, each),
        "by_weights": by_weights.tolist(),
        "classes_averaged": int((~np.isnan(classes)).any(axis=0).sum()),
        "miou_i": _mean([miou_over_frames(run) for run in judged]),
        "miou_c": _mean([miou_over_frame_classes(run) for run in judged]),
        "frequency_weighted": _mean(row.over_runs(frequency_weighted_iou)),
        "pixel_accuracy": _mean(row.over_runs(overall_accuracy)),
        "per_class_iou": dict(zip(class_names, [_mean(column) for column in classes.T], strict=True)),
        "boundary_iou": _mean(row.over_runs(mean_boundary_iou, "boundary")),
        "per_class_boundary_iou": dict(
            zip(class_names, [_mean(c) for c in row.over_runs(boundary_iou, "boundary").T], strict=True)
        ),
        "inside_miou": _mean(row.over_runs(mean_iou, "inside")),
        "outside_miou": _mean(outside),
    }


def _draws_spread(row: Row, each: NDArray[np.float64]) -> float | None:
    """Spread of a placement's draws, the mean over the weights."""
    groups = [each[row.of_weights == number] for number in np.unique(row.of_weights)]
    return _mean([group.std(ddof=1) for group in groups]) if len(groups[0]) > 1 else None


def _interval(row: Row, other: Row, trial: Record) -> Record:
    return dict(paired_interval(row.counts, other.counts, draws=trial["draws"], seed=trial["seed"]).as_dict())


def _placement(row: Row, runs: Runs) -> Record:
    if row.policy in ("none", "all"):
        return {"captured_gain": None, "ap_gain": None, "ap_top": None, "spearman": None, "undefined_scenes": None}
    ranks = [one for records in runs for record in records for one in record["ranking"] if one["policy"] == row.policy]
    tops = [part["ap_top"] for part in row.parts]
    return {
        "captured_gain": captured_gain(sum(p["gain"] for p in row.parts), sum(p["best_gain"] for p in row.parts)),
        "ap_gain": _mean_or_none([one["ap_gain"] for one in ranks]),
        "ap_top": _mean_or_none(tops),
        "spearman": _mean_or_none([one["spearman"] for one in ranks]),
        "undefined_scenes": sum(one["ap_gain"] is None for one in ranks),
    }


def _cost(row: Row, whole: Row, timed: Sequence[Record], captured: Sequence[Record]) -> Record:
    """The five columns, each the mean over frames, beside those of `all` (the capture beside a full scan)."""

    def of(part: str) -> Record:
        done, full = (_mean_or_none([one[part] for one in some.parts]) for some in (row, whole))
        return {"done": done, "full": full, "ratio": done / full if done is not None and full else None}

    seconds = [row_seconds(one, row.policy, row.share) for one in timed]
    most = _mean([row_seconds(one, "all", 1.0) for one in timed]) if timed else None
    mean_s = _mean(seconds) if seconds else None
    lines, rig_s = _rig(row, captured)
    full_s = _mean([one["full"] for one in captured]) if captured else None
    return {
        "samples": of("samples"),
        "bytes": of("bytes"),
        "multiply_adds": of("multiply_adds"),
        "cpu_s": {"done": mean_s, "full": most, "ratio": mean_s / most if mean_s is not None and most else None},
        "capture_s": {"done": rig_s, "full": full_s, "ratio": rig_s / full_s if rig_s is not None and full_s else None},
        "fine_lines": lines,
    }


def _rig(row: Row, captured: Sequence[Record]) -> tuple[float | None, float | None]:
    """Lines of the fine pass and seconds of both, the mean over frames; `all` is a full scan without a coarse pass."""
    if not captured or row.policy in ("none", "all"):
        key = "full" if row.policy == "all" else "none"
        return None, _mean([one[key] for one in captured]) if captured else None
    found = [
        part for one in captured for part in one["rows"] if (part["policy"], part["share"]) == (row.policy, row.share)
    ]
    return _mean([part["lines"] for part in found]), _mean([part["seconds"] for part in found])


def _mean(values: Sequence[float] | NDArray[np.float64]) -> float:
    """Mean of what is known; NaN where nothing is."""
    known = np.asarray(values, np.float64)
    known = known[~np.isnan(known)]
    return float(known.mean()) if known.size else float("nan")


def _mean_or_none(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
