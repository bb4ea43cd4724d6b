"""One frame judged by one set of weights or a control: every policy at each share of the seats, as counts that add up.

Controls are networks of other designs, trained for themselves: the paper's reads the seats that the Sobel policy
chooses at each share, the others read the whole frame once. Pooled rows have one threshold for the scores of all
frames: bare frames buy fewer seats, rich ones more, together the same share. That takes a second pass, for the scores
of all frames are needed first. Frames left out in turn are scored by different weights; these scores are nats on every
frame, whoever gave them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.evaluate.frames import Candidate, Look, Sight
from flows.evaluate.series import Record, Runs, seeds_of
from models.evaluation.metrics import boundary_counts, confusion
from models.evaluation.placement import (
    RANDOM_DRAWS,
    average_precision,
    gain_sums,
    oracle_gain,
    rank_correlation,
    top_seats,
)
from models.network.sizes import MultiplyAdds, control_multiply_adds, multiply_adds
from models.policies.policies import score_multiply_adds, score_seats
from models.reading.control_maps import draw_with_control
from models.reading.inference import Glance, segment
from models.weights.files import AnyWeights, Weights
from pipeline.errors import SettingsError
from pipeline.geometry.grid import UNLABELLED
from pipeline.planning.prices import BYTES_PER_SAMPLE
from pipeline.planning.selection import frame_seats, select_seats

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
    gain, scores_of = placed[-1].scores, {(one.policy, one.draw): one.scores for one in placed}
    wanted = list(wanted_rows(trial, placed, look))
    rows = []
    for number, (policy, draw, share, seats) in enumerate(wanted):
        row = {"policy": policy, "draw": draw, "share": share, "seats": len(seats)}
        drawn = segment(weights, look.seen, look.fine[seats], seats).classes
        row |= judge_map(look, drawn, seats, weights.config.classes)
        row |= cost_of_seats(look, weights, seats, policy)
        row["gain"], row["best_gain"] = gain_sums(gain, seats, valid)
        scores, best = scores_of.get((policy, draw)), top_seats(gain[valid], len(seats))  # as many of the oracle's best
        row["ap_top"] = None if scores is None else known_or_none(average_precision(scores[valid], best))
        rows.append(row)
        report((number + 1) / len(wanted))
    return {
        "frame": look.name,
        "shape": [grid.height, grid.width],
        "seats": len(valid),
        "rows": rows,
        "ranking": [
            {
                "policy": one.policy,
                "draw": one.draw,
                "ap_gain": known_or_none(average_precision(one.scores[valid], gain[valid] > 0)),
                "spearman": known_or_none(rank_correlation(one.scores[valid], gain[valid])),
            }
            for one in placed
        ],
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
    score = 0 if known is None else score_multiply_adds(known, weights.config, look.seen.grid)
    adds = multiply_adds(weights.config, look.seen.grid, len(seats), look.bands, score=score)
    return _cost_of(look, float(np.prod(look.seen.grid.coarse_shape)) + fine_samples(look, seats), adds)


def _cost_of(look: Sight, samples: float, adds: MultiplyAdds) -> dict[str, Any]:
    return {
        "samples": samples,
        "bytes": samples * look.bands * BYTES_PER_SAMPLE,
        "multiply_adds": adds.total,
        "adds": asdict(adds),
    }


def fine_samples(look: Sight, seats: Seats) -> float:
    """Pixels of the scene in the seats."""
    return float(look.seen.grid.valid_share().ravel()[seats].sum() * look.seen.grid.patch**2)


def known_or_none(value: float) -> float | None:
    """Turn NaN into None, which JSON knows."""
    return None if np.isnan(value) else float(value)


ENDS = ("none", "all")  # of a scale: no seat, every seat
DENSE = "dense"  # the control that may be the baseline
BUYS_SEATS = "paper"
POLICY = "sobel"  # of the paper's network


def open_controls(paths: tuple[Path, ...], weights: list[Candidate]) -> list[Candidate]:
    """Describe the controls; none of their tensors is read yet.

    Raises SettingsError: weights of two scales, of other classes or another camera than the weights they stand beside,
    two files of one design that differ in sizes, or one file twice; WeightsError: a file that cannot be read.
    """
    found = [Candidate.of(path) for path in paths]
    first: dict[str, Candidate] = {}
    for one in found:
        name = design_of(one)
        if name == "two-scale":
            raise SettingsError(f"{one.path} is of two scales, and no control; judge it by itself, with --weights")
        if one.described.class_names != weights[0].described.class_names:
            raise SettingsError(f"the control {one.path} has other classes than {weights[0].path}")
        if one.camera != weights[0].camera:
            raise SettingsError(f"the control {one.path} was trained through another camera than {weights[0].path}")
        other = first.setdefault(name, one)
        if one.described.config != other.described.config:
            raise SettingsError(
                f"the controls {one.path} and {other.path} are both {name} and differ in sizes; several of one design "
                "are seeds of one training"
            )
    if len({one.key for one in found}) < len(found):
        raise SettingsError("the same weights are given twice in --control, which would count as two seeds")
    return found


def design_of(control: Candidate) -> str:
    """Name of the kind of network: what its rows are called."""
    return str(control.described.config.preset)


def control_shares(design: str, shares: tuple[float, ...]) -> tuple[float, ...]:
    """Shares of the seats at which a control is judged: the paper's at each, the others as a whole."""
    return shares if design == BUYS_SEATS else (0.0,) if design == "upsampled" else (1.0,)


def seats_of_control(sight: Sight, design: str, share: float) -> Seats:
    """Seats that a control reads."""
    grid = sight.seen.grid
    if design != BUYS_SEATS:
        return grid.valid_seats() if share else np.empty(0, np.intp)
    return frame_seats(score_by_image(sight), share, grid.valid_share().ravel() > 0).seats


def score_by_image(sight: Sight) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Scores of the paper's policy, which asks the coarse image alone."""
    seen = sight.seen
    return score_seats(POLICY, Glance(seen.grid, seen.columns, np.empty((0, 0, 0), np.float32)))


def judge_control(
    trial: Trial, sight: Sight, weights: AnyWeights, report: Callable[[float], None] = lambda done: None
) -> dict[str, Any]:
    """Judge a control's map at each of its shares, by what its own camera takes; rows like `judge_frame`'s."""
    config, grid, rows = weights.config, sight.seen.grid, []
    design = config.preset
    shares = control_shares(design, trial.shares)
    for number, share in enumerate(shares):
        seats = seats_of_control(sight, design, share)
        drawn = draw_with_control(weights, sight.seen, sight.fine[seats], seats).classes
        row = {"policy": design, "draw": 0, "share": share, "seats": len(seats)}
        row |= judge_map(sight, drawn, seats, config.classes)
        samples = fine_samples(sight, seats) + (0.0 if design == DENSE else float(np.prod(grid.coarse_shape)))
        if design == "coarser":
            samples = float(-(-grid.height // 2) * -(-grid.width // 2))
        adds = control_multiply_adds(config, grid, len(seats), sight.bands)
        if design == BUYS_SEATS:
            adds = replace(adds, score=adds.score + score_multiply_adds(POLICY, config, grid))
        row |= _cost_of(sight, samples, adds)
        rows.append(row | {"gain": None, "best_gain": None, "ap_top": None})
        report((number + 1) / len(shares))
    return {
        "frame": sight.name,
        "shape": [grid.height, grid.width],
        "seats": len(grid.valid_seats()),
        "rows": rows,
        "ranking": [],
        "positive_seats": None,
    }


POOLED = ("gain", "entropy")  # scores that mean the same on every frame [nat]
POOLED_MARK = ", pooled"
Bought = dict[tuple[int, str], list[Record]]  # (weights, frame) -> policy, share, seats, threshold


def is_pooled(name: str) -> bool:
    """Whether rows of this name have one threshold for all frames."""
    return name.endswith(POOLED_MARK)


def own_policy(name: str) -> str:
    """Give the policy whose scores a row goes by."""
    return name.removesuffix(POOLED_MARK)


def pooled_policies(policies: Sequence[str]) -> tuple[str, ...]:
    """Give those of the policies that are judged with one threshold for all frames as well."""
    return tuple(policy for policy in policies if policy in POOLED)


def score_frame(policies: Sequence[str], look: Look) -> Record:
    """Scores of a frame's valid seats by every policy that is pooled."""
    valid = look.seen.grid.valid_seats()
    scores = {policy: score_seats(policy, look.seen)[valid].tolist() for policy in pooled_policies(policies)}
    return {"frame": look.name, "scores": scores}


def buy_together(scores: Sequence[Record], shares: Sequence[float]) -> list[list[Record]]:
    """Of each frame, how many seats it buys where the best of all frames together are bought, at each share of them.

    Equal scores go to the earlier frame, and there to the lowest number. ``threshold`` is the last score bought.
    """
    found: list[list[Record]] = [[] for _ in scores]
    for policy in scores[0]["scores"]:
        each = [np.array(record["scores"][policy], np.float64) for record in scores]
        together = np.concatenate(each)
        of_frame = np.repeat(np.arange(len(each)), [len(own) for own in each])
        for share in shares:
            bought = frame_seats(together, share).seats
            threshold = known_or_none(together[bought[-1]]) if len(bought) else None
            counts = np.bincount(of_frame[bought], minlength=len(each)).tolist()
            for own, count in zip(found, counts, strict=True):
                own.append({"policy": policy, "share": share, "seats": count, "threshold": threshold})
    return found


def buy_by_seed(scores: Runs, shares: Sequence[float]) -> Bought:
    """Let the frames of each seed of the training buy together. ``scores``: of each weights, those of its frames."""
    found: Bought = {}
    for members in seeds_of(scores):
        frames = [(number, record) for number in members for record in scores[number]]
        bought = buy_together([record for _, record in frames], shares)
        found |= {(number, record["frame"]): own for (number, record), own in zip(frames, bought, strict=True)}
    return found


def judge_pooled(
    bought: Sequence[Record], look: Look, weights: Weights, report: Callable[[float], None] = lambda done: None
) -> dict[str, Any]:
    """Judge the map of every number of seats that a frame buys; rows like `judge_frame`'s, without placement."""
    allowed = look.seen.grid.valid_share().ravel() > 0
    rows = []
    for number, one in enumerate(bought):
        seats = select_seats(score_seats(one["policy"], look.seen), one["seats"], allowed).seats
        drawn = segment(weights, look.seen, look.fine[seats], seats).classes
        row = {**one, "policy": one["policy"] + POOLED_MARK, "draw": 0}
        row |= judge_map(look, drawn, seats, weights.config.classes)
        row |= cost_of_seats(look, weights, seats, one["policy"])
        rows.append(row | {"gain": None, "best_gain": None, "ap_top": None})
        report((number + 1) / len(bought))
    return {"frame": look.name, "rows": rows}


def joined_rows(runs: Runs, pooled: Runs) -> list[list[Record]]:
    """Give the records of all weights with the rows that were pooled among their own."""
    joined = []
    for records, more in zip(runs, pooled, strict=True):
        further = {record["frame"]: record["rows"] for record in more}
        joined.append([{**one, "rows": [*one["rows"], *further.get(one["frame"], [])]} for one in records])
    return joined
