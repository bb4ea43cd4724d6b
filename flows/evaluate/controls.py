"""Controls of an evaluation: networks of other designs, trained for themselves, on the same frames.

The paper's network reads the seats that the Sobel policy chooses at each share; the others read the whole frame once.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from flows.evaluate.frames import Candidate, Sight
from flows.archive.stale_runs import file_key
from flows.evaluate.rows import Seats, Trial, cost_of, fine_samples, judge_map
from models.network.cost import MultiplyAdds, control_multiply_adds, multiply_adds
from models.policies.policies import score_seats
from models.reading.control_maps import draw_with_control
from models.reading.inference import Glance
from models.weights.files import AnyWeights, describe_weights
from pipeline.errors import SettingsError
from pipeline.planning.selection import frame_seats

DENSE = "dense"  # the control that may be the baseline
BUYS_SEATS = "paper"
POLICY = "sobel"  # of the paper's network


def open_controls(paths: tuple[Path, ...], weights: list[Candidate]) -> list[Candidate]:
    """Describe the controls; none of their tensors is read yet.

    Raises
    ------
    SettingsError : weights of two scales, of other classes or another camera than the weights they stand beside, two
        files of one design that differ in sizes, or one file twice.
    WeightsError : a file that cannot be read.
    """
    found = [Candidate(path, describe_weights(path), file_key(path)) for path in paths]
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
    """Judge a control's map of a frame at each of its shares; a record like `judge_frame`'s, without placement."""
    design, rows = weights.config.preset, []
    shares = control_shares(design, trial.shares)
    for number, share in enumerate(shares):
        seats = seats_of_control(sight, design, share)
        drawn = draw_with_control(weights, sight.seen, sight.fine[seats], seats).classes
        row = {"policy": design, "draw": 0, "share": share, "seats": len(seats)}
        row |= judge_map(sight, drawn, seats, weights.config.classes)
        row |= cost_of(sight, control_samples(sight, design, seats), control_adds(sight, weights, design, seats))
        rows.append(row | {"gain": None, "best_gain": None, "ap_top": None})
        report((number + 1) / len(shares))
    grid = sight.seen.grid
    return {
        "frame": sight.name,
        "shape": [grid.height, grid.width],
        "seats": len(grid.valid_seats()),
        "rows": rows,
        "ranking": [],
        "positive_seats": None,
    }


def control_samples(sight: Sight, design: str, seats: Seats) -> float:
    """Samples that a control's camera takes: coarse ones, fine ones of the seats, or those of a grid coarser by two."""
    grid = sight.seen.grid
    if design == "coarser":
        return float(-(-grid.height // 2) * -(-grid.width // 2))
    coarse = 0.0 if design == DENSE else float(np.prod(grid.coarse_shape))
    return coarse + fine_samples(sight, seats)


def control_adds(sight: Sight, weights: AnyWeights, design: str, seats: Seats) -> MultiplyAdds:
    """Multiply-adds of a control's map, and of its policy where it has one."""
    config, grid = weights.config, sight.seen.grid
    own = control_multiply_adds(config, grid, len(seats), sight.bands)
    score = multiply_adds(config, grid, 0, sight.bands, POLICY).score if design == BUYS_SEATS else 0
    return MultiplyAdds(own.glance, own.score + score, own.encode, own.decode)
