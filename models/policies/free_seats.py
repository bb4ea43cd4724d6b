"""Controls: what other placements of the same number of seats would have given, seats free of each other.

None of this belongs to a survey's own cost: it needs labels and the whole scene at full resolution.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.evaluation.metrics import agreement, confusion, gap_closed, mean_iou
from models.policies.policies import score_seats
from models.reading.inference import Glance, segment
from models.weights.files import Weights
from pipeline.planning.selection import frame_seats

RANDOM_DRAWS = 5
CONTROL_SHARE = 0.35  # of the valid seats: K = 35 % of surveys' receipts and of the weights' records
Counts = NDArray[np.int64]


@dataclass(frozen=True)
class Controls:
    """Confusion counts of each placement at one share of the seats (mode ``frame``)."""

    share: float
    seats: int
    none: Counts
    every: Counts
    policies: dict[str, Counts]
    random: list[Counts]

    def as_dict(self) -> dict[str, dict[str, Any]]:
        """`agreement` of every row, the share of the gap that it closes, and mean and spread of the random placements.

        All rows are judged by the same labels, and so over the same classes.
        """
        none, every = mean_iou(self.none), mean_iou(self.every)
        placed = {name: [counts] for name, counts in self.policies.items()} | {"random": self.random}
        rows = {policy: agreement_of_draws(draws) for policy, draws in placed.items()}
        return {policy: {**row, "gap_closed": gap_closed(row["miou"], none, every)} for policy, row in rows.items()}


def agreement_of_draws(draws: Sequence[Counts]) -> dict[str, Any]:
    """Give the mean of `agreement` over the draws of a placement, and the spread of their mIoU; None of one alone."""
    each = [agreement(counts) for counts in draws]
    means = {name: float(np.mean([one[name] for one in each])) for name in each[0]}
    spread = float(np.std([one["miou"] for one in each], ddof=1)) if len(each) > 1 else None
    return {**means, "spread": spread}


def run_controls(
    weights: Weights,
    seen: Glance,
    fine: NDArray[np.floating],
    labels: NDArray[np.uint8],
    *,
    share: float,
    seed: int,
    policies: tuple[str, ...] = ("gain", "entropy", "sobel"),
    report: Callable[[str], None] = lambda row: None,
) -> Controls:
    """Segment with no seat, every seat, and ``share`` of the seats placed by each policy and at random.

    Parameters
    ----------
    fine
        (seat, p, p, column) normalised columns of every seat of the padded grid.
    labels
        (y, x) class indices, 255 unlabelled.
    share
        Of the valid seats.
    """
    valid = seen.grid.valid_share().ravel() > 0

    def counts(row: str, seats: NDArray[np.integer]) -> Counts:
        report(row)
        drawn = segment(weights, seen, fine[seats], seats)
        return confusion(labels, drawn.classes, weights.config.classes)

    def placed(policy: str, number: int = 0) -> NDArray[np.integer]:
        return frame_seats(score_seats(policy, seen, seed=seed + number), share, valid).seats

    return Controls(
        share,
        len(placed("random")),
        counts("none", np.empty(0, np.int64)),
        counts("all", np.flatnonzero(valid)),
        {policy: counts(policy, placed(policy)) for policy in policies},
        [counts("random", placed("random", 1000 * (draw + 1))) for draw in range(RANDOM_DRAWS)],
    )
