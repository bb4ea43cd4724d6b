"""Trade-off of the lookup's ties: exact at every pixel, or at every few and bilinear between."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flows.tradeoff.entries import Level, Setting, Tradeoff, register
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep, line_positions, scene_to_sweep
from pipeline.rectify.tie_points import tie_table
from pipeline.rectify.tracks import Track, make_tracks

SWEEP = Sweep("ties", "fine", "x", strip_px=2500.0, start_px=-2000.0, lines=620)  # turned by 13 to 15 deg
ORIGIN_PX, SHAPE = (-1930.0, 2230.0), (480, 540)  # of a grid that the sweep covers
ROWS = 64  # handed on at a time
GOAL_PX = 2e-3


@dataclass(frozen=True)
class TiesLookedUp:
    """A sweep over a grid, and the exact line and sample of every pixel."""

    camera: LineCamera
    track: Track
    exact: NDArray[np.float64]  # (y, x, 2)


def _prepare(_seed: int) -> TiesLookedUp:
    camera = LineCamera()
    (track,) = make_tracks(line_positions(SWEEP, camera), camera)
    y, x = (origin + np.arange(size) for origin, size in zip(ORIGIN_PX, SHAPE, strict=True))
    return TiesLookedUp(camera, track, scene_to_sweep(SWEEP, camera, *np.broadcast_arrays(x[None, :], y[:, None])))


def _run(state: TiesLookedUp, spacing: Setting) -> list[NDArray[np.float64]]:
    table = tie_table(
        state.track,
        state.camera,
        along=SWEEP.along,
        binning=SWEEP.binning,
        origin_px=ORIGIN_PX,
        spacing_px=1.0,
        shape=SHAPE,
        tie=int(spacing),
        tolerance_px=np.inf,
    )
    columns = slice(0, SHAPE[1])
    return [table.coordinates(slice(row, min(row + ROWS, SHAPE[0])), columns) for row in range(0, SHAPE[0], ROWS)]


def _judge(state: TiesLookedUp, _spacing: Setting, out: list[NDArray[np.float64]]) -> float:
    return float(np.abs(np.concatenate(out) - state.exact).max())


TIE_SPACING = register(
    Tradeoff(
        stage="rectify",
        knob="tie spacing",
        error="greatest error of line and sample [px]",
        unit="px",
        reference=f"closed form over {SHAPE[1]} x {SHAPE[0]} px; 1: no ties",
        settings=(1, 8, 16, 32, 64),
        prepare=_prepare,
        run=_run,
        judge=_judge,
        work=lambda state, _spacing: float(state.exact.size / 2),
        levels=lambda _state: (Level(f"goal of {GOAL_PX:g} px", GOAL_PX),),
        moved_bytes=16.0,
    )
)
