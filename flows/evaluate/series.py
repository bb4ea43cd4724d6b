"""Records of several weights as rows of counts: which weights make up one seed, and which run judged which frame.

Weights of frames left out in turn have no frame in common; together they are one seed of the training, judged on all
of their frames. Weights that share a frame are different seeds. And what a whole curve of mIoU over cost comes to.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.evaluation.metrics import paired_interval

Record = dict[str, Any]
Runs = Sequence[Sequence[Record]]  # of each weights, or of each seed, the records of its frames


@dataclass(frozen=True)
class Row:
    """One policy at one share over all frames; a run is one seed with one draw. Zeros where a run has no frame."""

    policy: str
    share: float
    counts: NDArray[np.int64]  # (run, frame, class, class)
    inside: NDArray[np.int64]
    boundary: NDArray[np.int64]  # (run, frame, class, 2)
    of_seed: NDArray[np.intp]  # (run,)
    parts: list[Record]  # rows of the records

    def over_runs(self, figure: Callable[[Any], Any], what: str = "counts") -> NDArray[np.float64]:
        """A figure of each run's frames together, (run,) or (run, class)."""
        return np.array([figure(run.sum(axis=0)) for run in getattr(self, what)])

    @property
    def judged(self) -> NDArray[np.bool_]:
        """Frames that any run has, (frame,)."""
        found: NDArray[np.bool_] = self.counts.sum(axis=(0, 2, 3)) > 0
        return found


def seeds_of(runs: Runs) -> list[list[int]]:
    """Numbers of the weights of each seed: those with no frame in common, in the order given; without a frame none."""
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


def by_seed(runs: Runs) -> list[list[Record]]:
    """Records of each seed."""
    return [[record for number in members for record in runs[number]] for members in seeds_of(runs)]


def frame_names(runs: Runs) -> list[str]:
    """Every frame that any of the weights was judged on, in order."""
    return sorted({record["frame"] for records in runs for record in records})


def collect_row(runs: Runs, policy: str, share: float, names: Sequence[str] | None = None) -> Row | None:
    """Gather the counts of one row from the records of all seeds; None where no record has it."""
    order = list(frame_names(runs) if names is None else names)
    found = [
        (number, order.index(record["frame"]), row)
        for number, records in enumerate(runs)
        for record in records
        for row in record["rows"]
        if (row["policy"], row["share"]) == (policy, share)
    ]
    if not found:
        return None
    draws = sorted({row["draw"] for _, _, row in found})
    classes = len(found[0][2]["counts"])
    shape = (len(runs) * len(draws), len(order), classes)
    counts, inside = (np.zeros((*shape, classes), np.int64) for _ in range(2))
    boundary = np.zeros((*shape, 2), np.int64)
    for number, at, row in found:
        run = number * len(draws) + draws.index(row["draw"])
        counts[run, at] = row["counts"]
        inside[run, at], boundary[run, at] = row.get("inside", 0), row.get("boundary", 0)
    of_seed = np.repeat(np.arange(len(runs)), len(draws))
    return Row(policy, share, counts, inside, boundary, of_seed, [row for _, _, row in found])


def difference(row: Row, other: Row, trial: Record) -> Record:
    """Paired interval of one row less another, over the frames that both have; their number stands beside it."""
    both = row.judged & other.judged
    if not both.any():
        return {"difference": None, "low": None, "high": None, "frames": 0}
    found = paired_interval(
        row.counts[:, both],
        other.counts[:, both],
        seeds=(row.of_seed, other.of_seed),
        draws=trial["draws"],
        seed=trial["seed"],
    )
    return {**found.as_dict(), "frames": int(both.sum())}


def mean_of(values: Sequence[float] | NDArray[np.float64]) -> float:
    """Mean of what is known; NaN where nothing is."""
    known = np.asarray(values, np.float64)
    known = known[~np.isnan(known)]
    return float(known.mean()) if known.size else float("nan")


def mean_or_none(values: Sequence[float | None]) -> float | None:
    """Mean of what is known; None where nothing is."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


ENOUGH = 0.95  # of the mIoU of K = all
LEAST_GAP = 0.01  # of mIoU between none and all, for a share of it to be said
REFERENCE = "cost of K = all, mIoU of K = 0"
Point = tuple[float, float]  # cost, mIoU


@dataclass(frozen=True)
class CurveFigures:
    """Figures of one policy's curve."""

    auc_gap: float | None  # mean of the gap closed over the logarithm of cost, from none to all
    hypervolume: float | None  # mIoU x share of the cost that the curve dominates, from the reference
    cost_to_enough: float | None  # least cost tried that reaches 95 % of the mIoU of all, over that of all


def curve_figures(none: Point, points: Sequence[Point], every: Point) -> CurveFigures:
    """Sum up a curve from ``none`` by its points to ``every``.

    ``auc_gap`` goes straight from point to point in the logarithm of cost; 1 would be all of the gap closed at no cost
    more than none's, and None where the gap is under one point. The hypervolume counts what lies below the best point
    of at most that cost: reference (cost of all, mIoU of none), costs over that of all.
    """
    if not 0 < none[0] < every[0]:
        return CurveFigures(None, None, None)
    curve = sorted([none, *points, every])
    reached = [cost / every[0] for cost, miou in curve if miou >= ENOUGH * every[1]]
    gap, auc_gap = every[1] - none[1], None
    if gap >= LEAST_GAP:
        cost, miou = np.array([one for one in curve if none[0] <= one[0] <= every[0]]).T
        place = np.log(cost)
        auc_gap = float(np.trapezoid((miou - none[1]) / gap, place) / (place[-1] - place[0]))
    volume, best, before = 0.0, none[1], 0.0
    for share, reaches in ((cost / every[0], miou) for cost, miou in curve if cost <= every[0]):
        volume += (best - none[1]) * (share - before)
        best, before = max(best, reaches), share
    return CurveFigures(auc_gap, volume, min(reached, default=None))


def summarise_curves(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Give the figures of every policy, the oracle's among them, and of a control that buys seats."""

    def point(row: dict[str, Any]) -> Point | None:
        cost = row["cost"]["multiply_adds"]["done"]
        return None if cost is None or row["miou"] is None else (cost, row["miou"])

    ends = {row["policy"]: point(row) for row in rows if row["policy"] in ("none", "all")}
    none, every = ends["none"], ends["all"]
    found = []
    for policy in dict.fromkeys(row["policy"] for row in rows if row["policy"] not in ends and not row["control"]):
        points = [point(row) for row in rows if row["policy"] == policy]
        known = [one for one in points if one is not None]
        if none is not None and every is not None and known:
            found.append({"policy": policy, **asdict(curve_figures(none, known, every))})
    return found
