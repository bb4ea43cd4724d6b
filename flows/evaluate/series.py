"""Records of several weights as rows of counts: which weights make up one seed, and which run judged which frame.

Weights of frames left out in turn have no frame in common; together they are one seed of the training, judged on all
of their frames. Weights that share a frame are different seeds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.evaluation.bootstrap import paired_interval

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
    """Put weights together that have no frame in common, in the order given: of each seed, the numbers of its weights.

    Weights without a frame are left out.
    """
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
