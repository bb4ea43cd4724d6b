"""One frame judged by one set of weights: every policy at every share of the seats, as counts that add up."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.evaluate.frames import Look, Sight
from models.evaluation.metrics import boundary_counts, confusion
from models.evaluation.placement import (
    RANDOM_DRAWS,
    average_precision,
    gain_sums,
    oracle_gain,
    rank_correlation,
    top_seats,
)
from models.network.cost import MultiplyAdds, multiply_adds
from models.policies.policies import score_seats
from models.reading.inference import segment
from models.weights.files import Weights
from pipeline.geometry.grid import UNLABELLED
from pipeline.planning.savings import BYTES_PER_SAMPLE
from pipeline.planning.selection import frame_seats

ORACLE = "oracle"
Seats = NDArray[np.intp]


@dataclass(frozen=True)
class Trial:
    """What to try on every frame."""

    shares: tuple[float, ...]  # of the valid seats, above 0 and below 1: none and all are always there
    policies: tuple[str, ...]  # without the oracle, which is always there
    seed: int = 0


@dataclass(frozen=True)
class Placing:
    """Scores of one policy; ``draw`` tells random ones apart."""

    policy: str
    draw: int
    scores: NDArray[np.float64]


def placings(trial: Trial, look: Look, weights: Weights) -> list[Placing]:
    """Scores of every policy, of several random placements, and of the oracle."""
    found = []
    for policy in trial.policies:
        for draw in range(RANDOM_DRAWS if policy == "random" else 1):
            seed = trial.seed + 1000 * (draw + 1)
            found.append(Placing(policy, draw, score_seats(policy, look.seen, seed=seed)))
    return [*found, Placing(ORACLE, 0, oracle_gain(weights, look.seen, look.fine, look.labels))]


def judge_frame(
    trial: Trial, look: Look, weights: Weights, report: Callable[[float], None] = lambda done: None
) -> dict[str, Any]:
    """Judge the map of every row; what comes is plain lists and numbers, and `flows.evaluate.summary` adds it up."""
    grid = look.seen.grid
    valid = grid.valid_seats()
    placed = placings(trial, look, weights)
    gain = placed[-1].scores
    wanted = list(wanted_rows(trial, placed, look))
    rows = []
    for number, (policy, draw, share, seats) in enumerate(wanted):
        row = {"policy": policy, "draw": draw, "share": share, "seats": len(seats)}
        drawn = segment(weights, look.seen, look.fine[seats], seats).classes
        row |= judge_map(look, drawn, seats, weights.config.classes)
        row |= cost_of_seats(look, weights, seats, policy)
        row["gain"], row["best_gain"] = gain_sums(gain, seats, valid)
        row["ap_top"] = _ap_top(placed, policy, draw, gain, seats, valid)
        rows.append(row)
        report((number + 1) / len(wanted))
    return {
        "frame": look.name,
        "shape": [grid.height, grid.width],
        "seats": len(valid),
        "rows": rows,
        "ranking": [_ranking(one, gain, valid) for one in placed],
        "positive_seats": int((gain[valid] > 0).sum()),
    }


def wanted_rows(trial: Trial, placed: list[Placing], look: Look) -> Iterator[tuple[str, int, float, Seats]]:
    """Give (policy, draw, share, seats) of each row."""
    allowed = look.seen.grid.valid_share().ravel() > 0
    yield "none", 0, 0.0, np.empty(0, np.intp)
    yield "all", 0, 1.0, np.flatnonzero(allowed)
    for one in placed:
        for share in trial.shares:
            yield one.policy, one.draw, share, frame_seats(one.scores, share, allowed).seats


def judge_map(look: Sight, drawn: NDArray[np.uint8], seats: Seats, classes: int) -> dict[str, Any]:
    """Counts of the whole map, of the captured seats alone, and near borders."""
    inside = np.where(captured_px(look, seats), look.labels, np.uint8(UNLABELLED))
    return {
        "counts": confusion(look.labels, drawn, classes).tolist(),
        "inside": confusion(inside, drawn, classes).tolist(),
        "boundary": boundary_counts(look.labels, drawn, classes).tolist(),
    }


def captured_px(look: Sight, seats: Seats) -> NDArray[np.bool_]:
    """Pixels of the scene that lie in captured seats, (y, x)."""
    grid = look.seen.grid
    chosen = np.zeros(grid.seat_shape, bool)
    chosen.ravel()[seats] = True
    full = chosen.repeat(grid.patch, axis=0).repeat(grid.patch, axis=1)
    return full[: grid.height, : grid.width]


def cost_of_seats(look: Look, weights: Weights, seats: Seats, policy: str) -> dict[str, Any]:
    """Samples with those of the coarse pass, their bytes, and multiply-adds (`none` and `all`: the map alone)."""
    known = {"none": None, "all": None, ORACLE: "random"}.get(policy, policy)  # the oracle scores by labels
    adds = multiply_adds(weights.config, look.seen.grid, len(seats), look.bands, known)
    return cost_of(look, float(np.prod(look.seen.grid.coarse_shape)) + fine_samples(look, seats), adds)


def cost_of(look: Sight, samples: float, adds: MultiplyAdds) -> dict[str, Any]:
    """Samples, their bytes before compression, and multiply-adds, also told apart by what they are for."""
    return {
        "samples": samples,
        "bytes": samples * look.bands * BYTES_PER_SAMPLE,
        "multiply_adds": adds.total,
        "adds": asdict(adds),
    }


def fine_samples(look: Sight, seats: Seats) -> float:
    """Pixels of the scene in the seats."""
    return float(look.seen.grid.valid_share().ravel()[seats].sum() * look.seen.grid.patch**2)


def _ap_top(
    placed: list[Placing], policy: str, draw: int, gain: NDArray[np.float64], seats: Seats, valid: Seats
) -> float | None:
    """Average precision of the scores against as many of the oracle's best seats."""
    one = next((one for one in placed if (one.policy, one.draw) == (policy, draw)), None)
    return (
        None if one is None else known_or_none(average_precision(one.scores[valid], top_seats(gain[valid], len(seats))))
    )


def _ranking(one: Placing, gain: NDArray[np.float64], valid: Seats) -> dict[str, Any]:
    return {
        "policy": one.policy,
        "draw": one.draw,
        "ap_gain": known_or_none(average_precision(one.scores[valid], gain[valid] > 0)),
        "spearman": known_or_none(rank_correlation(one.scores[valid], gain[valid])),
    }


def known_or_none(value: float) -> float | None:
    """Turn NaN into None, which JSON knows."""
    return None if np.isnan(value) else float(value)
