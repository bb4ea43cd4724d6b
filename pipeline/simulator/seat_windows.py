"""Windows of a sweep that show single seats: only their lines and samples are rendered."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Sweep, scene_to_sweep
from pipeline.rectify.reach import TAPS
from pipeline.rectify.region import seat_pixels
from pipeline.simulator.simulated import SimulatedSource


@dataclass(frozen=True)
class SeatWindow:
    """Raw numbers (line, sample, band) of the lines and binned samples around one seat. [DN]"""

    seat: int
    lines: range
    samples: range
    raw: NDArray[np.uint16]


def seat_window(sweep: Sweep, camera: LineCamera, grid: SceneGrid, seat: int) -> tuple[range, range] | None:
    """Give the lines and binned samples that a planned sweep shows a seat's pixels with, kernel's taps included.

    None where it shows none of them.
    """
    points, _ = seat_pixels(grid, np.array([seat]))
    y, x = points[..., 0].ravel(), points[..., 1].ravel()
    along, scan = (x, y) if sweep.along == "x" else (y, x)
    line, sample = scene_to_sweep(sweep, camera, along, scan).T
    sizes = sweep.lines, camera.samples // sweep.binning
    seen = (line > -1) & (line < sizes[0]) & (sample > -1) & (sample < sizes[1])
    if not seen.any():
        return None
    lines, samples = (_around(place[seen], size) for place, size in zip((line, sample), sizes, strict=True))
    return lines, samples


def render_seats(source: SimulatedSource, sweep: Sweep, grid: SceneGrid, seats: Sequence[int]) -> Iterator[SeatWindow]:
    """Render what a sweep shows of some seats, one after the other; seats that it does not show are left out.

    The numbers are those of the whole lines.

    Raises
    ------
    ShapeError, PoseError : as `instrument.render_lines`.
    """
    for seat in seats:
        window = seat_window(sweep, source.camera, grid, seat)
        if window is not None:
            lines, samples = window
            yield SeatWindow(seat, lines, samples, source.render(sweep, lines, samples))


def _around(place: NDArray[np.float64], size: int) -> range:
    return range(max(int(np.floor(place.min())) - TAPS, 0), min(int(np.ceil(place.max())) + TAPS + 1, size))
