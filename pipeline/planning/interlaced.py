"""Interlaced capture: a first pass of every n-th line, and later sweeps of the lines between, so that none comes twice.

The mirror stares at one position a line. Line numbers count the positions of the full scan, 1 px apart.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import CostModel, Sweep
from pipeline.planning.coverage import field_px
from pipeline.planning.prices import prices_of

FIRST_STEP = 4  # full scan's positions from line to line of the first pass
FIRST_STEPS = (4, 8)  # that may be chosen


def merged_ms(first_ms: float, later_ms: float, first_fraction: float) -> float:
    """Return the exposure [ms] whose noise is the mean of that of lines of two exposures."""
    return 1 / (first_fraction / first_ms + (1 - first_fraction) / later_ms)


def every_nth(full: Sequence[Sweep], step: int = FIRST_STEP, exposure_ms: float | None = None) -> list[Sweep]:
    """Return the first pass: every ``step``-th line of the sweeps of a full scan, to its last line or just beyond."""
    return [
        replace(
            sweep,
            name=f"coarse-{number}",
            kind="coarse",
            step=step,
            held=1,
            lines=-(-(sweep.lines - 1) // step) + 1,
            exposure_ms=exposure_ms,
        )
        for number, sweep in enumerate(full)
    ]


def lines_between(
    runs: Sequence[Sweep], first_pass: Sequence[Sweep], *, step: int = 1, exposure_ms: float | None = None
) -> list[Sweep]:
    """Return the sweeps that fill runs of a full scan's lines up to ``step``, by the lines that are missing.

    A run on the swath of a sweep of the first pass begins and ends at lines of that, and takes the lines between: of a
    first pass of every fourth line those halfway, then the odd ones. Any other run takes all of its own lines.
    """
    taken = {(sweep.along, sweep.swath_px): sweep for sweep in first_pass}
    found: list[Sweep] = []
    for run in runs:
        coarse = taken.get((run.along, run.swath_px))
        if coarse is None:
            held = None if step == 1 else 1
            found.append(replace(run, lines=-(-run.lines // step), step=step, held=held, exposure_ms=exposure_ms))
        else:
            found += _filling(run, coarse, step, exposure_ms)
    return found


def _filling(run: Sweep, coarse: Sweep, step: int, exposure_ms: float | None) -> Iterator[Sweep]:
    """Yield the sweeps that halve the distance of a pass's lines along a run until it is ``step``."""
    low = round(run.start_px - coarse.start_px)
    first = max(low // coarse.step, 0)
    stop = min(-(-(low + run.lines - 1) // coarse.step), coarse.lines - 1)  # the coarse line that the run ends at
    apart, spaces = coarse.step, stop - first
    while apart > step and spaces > 0:
        start = coarse.start_px + first * coarse.step + apart / 2
        name = f"{run.name}-{apart // 2}"
        yield replace(run, name=name, start_px=start, lines=spaces, step=apart, held=1, exposure_ms=exposure_ms)
        apart, spaces = apart // 2, 2 * spaces


def most_within(
    seconds: float,
    values: NDArray[np.floating],
    grid: SceneGrid,
    first_pass: Sequence[Sweep],
    camera: LineCamera,
    cost: CostModel,
    *,
    step: int,
    exposure_ms: float,
    interlaced: bool = True,
) -> float:
    """Return how much of (patch,) values rows of patches along the lines show at most, were runs of lines free.

    The rows are filled up to lines ``step`` px apart in so many ``seconds``; set-ups are left out.
    """
    along, apart = first_pass[0].along, first_pass[0].step
    lines = grid.patch * (1 / step - (1 / apart if interlaced else 0.0))
    price = lines * prices_of(replace(camera, exposure_ms=exposure_ms), cost).even_line_s
    row, column = np.divmod(np.arange(len(values)), grid.patch_shape[1])
    across, down = (column, row) if along == "x" else (row, column)
    middle = (across + 0.5) * grid.patch - field_px(grid, along)[0] / 2
    centres = np.array(sorted({sweep.swath_px for sweep in first_pass}))
    swath = np.abs(middle[:, None] - centres).argmin(axis=1)
    rows = np.bincount(swath * (int(down.max()) + 1) + down, np.maximum(values, 0.0))
    return float(np.sort(rows)[::-1][: int(seconds / price)].sum())
