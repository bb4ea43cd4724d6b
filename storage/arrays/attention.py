"""Scores of seats and the order in which they were chosen."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ShapeError
from storage.arrays.layout import create_group, open_group, read_array, write_image


@dataclass(frozen=True)
class Attention:
    """Scores of all seats and the order in which seats were chosen."""

    score: NDArray[np.float64]  # (seat_y, seat_x), NaN where there is none
    rank: NDArray[np.int32]  # (seat_y, seat_x), 0 = chosen first, -1 = not chosen
    policy: str


def write_attention(path: Path, attention: Attention) -> None:
    """Store scores and ranks.

    Raises
    ------
    ShapeError : they have different shapes.
    """
    if attention.score.shape != attention.rank.shape or attention.score.ndim != 2:
        raise ShapeError(f"score {attention.score.shape} and rank {attention.rank.shape} must both be (seat_y, seat_x)")
    group = create_group(path, "attention", {"policy": attention.policy})
    dims = ("seat_y", "seat_x")
    about = {"long_name": f"worth of a fine look, policy {attention.policy}", "units": "1"}
    write_image(group, "score", dims, np.asarray(attention.score, np.float64), about)
    about = {"long_name": "order in which the seat was chosen, from 0; -1 where it was not", "units": "1"}
    write_image(group, "rank", dims, np.asarray(attention.rank, np.int32), about)


def load_attention(path: Path) -> Attention:
    """Read scores and ranks. Raises IncompleteStoreError where they are missing or damaged."""
    group = open_group(path)
    return Attention(read_array(group, "score"), read_array(group, "rank"), str(group.attrs.get("policy", "")))
