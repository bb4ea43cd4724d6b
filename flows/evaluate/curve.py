"""What a whole curve of mIoU over cost comes to: one number a policy, with its reference stated.

Costs are multiply-adds, which are the same on every machine; glance and scores are in them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

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
    return CurveFigures(_auc_gap(curve, none, every), _hypervolume(curve, none, every), min(reached, default=None))


def _auc_gap(curve: list[Point], none: Point, every: Point) -> float | None:
    if every[1] - none[1] < LEAST_GAP:
        return None
    inside = [(cost, miou) for cost, miou in curve if none[0] <= cost <= every[0]]
    place = np.log([cost for cost, _ in inside])
    closed = (np.array([miou for _, miou in inside]) - none[1]) / (every[1] - none[1])
    return float(np.trapezoid(closed, place) / (place[-1] - place[0]))


def _hypervolume(curve: list[Point], none: Point, every: Point) -> float:
    total, best, before = 0.0, none[1], 0.0
    for cost, miou in curve:
        if cost > every[0]:
            break
        total += (best - none[1]) * (cost / every[0] - before)
        best, before = max(best, miou), cost / every[0]
    return total


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
