"""One threshold for the scores of all frames: bare frames buy fewer seats, rich ones more, together the same share.

It takes a second pass, for the scores of all frames are needed before the first of these maps. Frames that were left
out in turn are scored by different weights; the scores of these policies are nats on every frame, whoever gave them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from flows.evaluate.frames import Look
from flows.evaluate.rows import cost_of_seats, judge_map, known_or_none
from flows.evaluate.series import Record, Runs, seeds_of
from models.policies.policies import score_seats
from models.reading.inference import segment
from models.weights.files import Weights
from pipeline.planning.selection import frame_seats, select_seats

POOLED = ("gain", "entropy")  # scores that mean the same on every frame [nat]
_MARK = ", pooled"
Bought = dict[tuple[int, str], list[Record]]  # (weights, frame) -> policy, share, seats, threshold


def pooled_name(policy: str) -> str:
    """What a policy's rows with one threshold for all frames are called."""
    return policy + _MARK


def is_pooled(name: str) -> bool:
    """Whether rows of this name have one threshold for all frames."""
    return name.endswith(_MARK)


def own_policy(name: str) -> str:
    """Give the policy whose scores a row goes by."""
    return name.removesuffix(_MARK)


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
        row = {**one, "policy": pooled_name(one["policy"]), "draw": 0}
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
