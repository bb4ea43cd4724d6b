"""What reading a frame costs the processor on one thread: glance, scores and map, each by the median of a few runs."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from flows.benchmark_frames import Look
from flows.benchmark_rows import Trial
from models.inference import glance_of_columns, segment
from models.policies import score_seats
from models.threads import one_thread
from models.weights import Weights
from pipeline.selection import frame_seats


def time_frame(trial: Trial, look: Look, weights: Weights, runs: int) -> dict[str, Any]:
    """CPU seconds of a frame from its spectral columns: glance, each policy's scores, the map at each share.

    ``all`` needs neither glance nor scores: its map alone is its fastest path. A warm-up goes before every median.
    """
    with one_thread():
        seen, grid = look.seen, look.seen.grid
        valid = grid.valid_share().ravel() > 0
        scores = score_seats("random", seen, seed=trial.seed)
        segments = {}
        for share in (0.0, *trial.shares, 1.0):
            seats = frame_seats(scores, share, valid).seats
            fine = np.ascontiguousarray(look.fine[seats])
            segments[f"{share:g}"] = cpu_seconds(lambda f=fine, s=seats: segment(weights, seen, f, s), runs)  # type: ignore[misc]
        return {
            "frame": look.name,
            "glance": cpu_seconds(lambda: glance_of_columns(weights, seen.columns, grid), runs),
            "score": {
                policy: cpu_seconds(lambda name=policy: score_seats(name, seen, seed=trial.seed), runs)  # type: ignore[misc]
                for policy in trial.policies
            },
            "segment": segments,
        }


def cpu_seconds(work: Callable[[], object], runs: int) -> float:
    """Median CPU time of the process over some runs, after one that is not counted [s]."""
    work()
    taken = []
    for _ in range(runs):
        start = time.process_time()
        work()
        taken.append(time.process_time() - start)
    return statistics.median(taken)


def row_seconds(timed: dict[str, Any], policy: str, share: float) -> float:
    """Glance, scores and map of a row [s]. `none` and `all` are the map alone; the oracle's scores cost nothing."""
    segment_s = float(timed["segment"][f"{share:g}"])
    if policy in ("none", "all"):
        return segment_s
    return float(timed["glance"]) + float(timed["score"].get(policy, 0.0)) + segment_s
