"""Resampling: the cost of each kernel beside a copy of the same rows.

`spectralzoom tradeoff rectify` measures the errors of the kernels.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, get_args

import numpy as np
from measure import Row, ratio, time_in_turn
from numpy.typing import NDArray

from flows.tradeoff.stages import draw_waves
from models.network.machine import one_thread
from pipeline.rectify.kernels import Kernel
from pipeline.rectify.resample import resample

SIDE, BANDS, EDGE = 256, 270, 176  # of the sweep, of the output grid inside it
TURN_DEG = 14.0
BLOCK = 2048
TILES, ROUNDS = 3, 7
MOST = 3.0  # of the time of a copy, for Catmull-Rom


def rows() -> list[Row]:
    """Time all kernels and a copy of the nearest rows, on a grid turned by 14 degrees against the sweep."""
    samples, coordinates = turned_grid()
    out = np.empty((len(coordinates), BANDS), np.float32)
    valid = np.ones(samples.shape[:2], bool)
    calls: dict[str, Callable[[], Any]] = {"take": _take(samples, coordinates, out)}
    for kernel in get_args(Kernel):
        calls[kernel] = lambda kernel=kernel: resample(samples, valid, coordinates, kernel, out=out)
    with one_thread():
        clocks = time_in_turn({name: _repeated(call) for name, call in calls.items()}, ROUNDS)
    ns = {name: clock.cpu_min_s / (TILES * out.size) * 1e9 for name, clock in clocks.items()}
    found = []
    for kernel in get_args(Kernel):
        times, goal = ratio(clocks, kernel, "take"), MOST if kernel == "catmull-rom" else None
        found.append(
            Row(
                f"{kernel}, {BANDS} bands, over np.take of the same rows",
                f"{times:.2f} x",
                f"<= {goal:g} x" if goal else "",
                times <= goal if goal else None,
                f"{ns[kernel]:.2f} ns/(px*band), np.take {ns['take']:.2f}",
            )
        )
    return found


def turned_grid() -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Return samples (line, sample, band) of waves of 4 to 40 px, and coordinates (y * x, 2) of the turned grid."""
    cos, sin = np.cos(np.deg2rad(TURN_DEG)), np.sin(np.deg2rad(TURN_DEG))
    turn, middle = np.array([[cos, -sin], [sin, cos]]), np.array([SIDE / 2 + 0.2, SIDE / 2 - 0.3])
    coordinates = (np.argwhere(np.ones((EDGE, EDGE), bool)) - (EDGE - 1) / 2) @ turn.T + middle
    lines = np.argwhere(np.ones((SIDE, SIDE), bool)).astype(np.float64)
    return draw_waves(0, BANDS, (4.0, 40.0)).at(lines).astype(np.float32).reshape(SIDE, SIDE, BANDS), coordinates


def _take(samples: NDArray[np.float32], coordinates: NDArray[np.float64], out: NDArray[np.float32]) -> Any:
    """Copy each point's nearest row in blocks; mode="clip" avoids a second copy by numpy."""
    table = samples.reshape(-1, samples.shape[2])
    line, sample = np.rint(coordinates).astype(np.intp).T
    index = line * samples.shape[1] + sample

    def call() -> None:
        for start in range(0, len(index), BLOCK):
            np.take(table, index[start : start + BLOCK], axis=0, out=out[start : start + BLOCK], mode="clip")

    return call


def _repeated(call: Callable[[], Any]) -> Callable[[], None]:
    def repeated() -> None:
        for _ in range(TILES):
            call()

    return repeated
