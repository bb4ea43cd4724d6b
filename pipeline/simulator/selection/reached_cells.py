"""How far the parts of a scene lie from what sweeps see."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep, points_of_scan, scene_to_sweep

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
_CELLS = 40_000  # at which it is asked whether a sweep looks there
_LOOKS = 65  # lines and samples of a sweep that tell where it sees the scene's repeated edge


@dataclass(frozen=True)
class ReachedCells:
    """Square cells of a scene: how far each lies from what sweeps see, never more than it does, 0 where they see it.

    Between neighbouring cells lies nothing.
    """

    apart_px: Floats  # (row, column)
    cell_px: int
    shape: tuple[int, int]  # of the scene [px]

    @property
    def covers(self) -> bool:
        """Whether sweeps see all of the scene."""
        return not self.apart_px.any()

    def rows_within(self, first: int, last: int, nearest_px: float, farthest_px: float) -> Mask:
        """Give which pixels of rows lie farther than the one and no farther than the other, (row, column)."""
        rows = np.arange(first, min(last, self.shape[0])) // self.cell_px
        apart = self.apart_px[rows]
        within: Mask = np.repeat((apart > nearest_px) & (apart <= farthest_px), self.cell_px, axis=1)
        return within[:, : self.shape[1]]


def reached_cells(shape: tuple[int, int], camera: LineCamera, sweeps: Sequence[Sweep]) -> ReachedCells:
    """Ask for every cell of a scene whether any sweep sees some of it; what lies outside shows the scene's edge."""
    cell = max(2, math.ceil(math.sqrt(shape[0] * shape[1] / _CELLS)))
    y, x = (np.arange(0, size, cell) + (cell - size) / 2 for size in shape)
    reached = np.zeros((len(y), len(x)), np.bool_)
    for sweep in sweeps:
        along, scan = (y[:, None], x[None]) if sweep.along == "y" else (x[None], y[:, None])
        held = replace(sweep, step=1, lines=sweep.lines * sweep.step, binning=1)
        line, sample = np.moveaxis(scene_to_sweep(held, camera, along, scan), -1, 0)
        slack = 1 + cell / 2
        reached |= (np.abs(line - (held.lines - 1) / 2) <= held.lines / 2 + slack) & (
            np.abs(sample - (camera.samples - 1) / 2) <= camera.samples / 2 + slack
        )
        reached[_edge_cells(held, camera, shape, cell)] = True
    if reached.all():
        return ReachedCells(np.zeros(reached.shape), cell, shape)
    if not reached.any():
        return ReachedCells(np.full(reached.shape, np.inf), cell, shape)
    apart = scipy.ndimage.distance_transform_edt(~reached)
    return ReachedCells(np.where(reached, 0.0, np.maximum((apart - 1) * cell, 1e-3)), cell, shape)


def _edge_cells(
    sweep: Sweep, camera: LineCamera, shape: tuple[int, int], cell: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Cells at the scene's edge that a sweep sees repeated outside of it."""
    count = max(_LOOKS, 2 * max(shape) // cell)
    lines = sweep.start_px + np.linspace(0, sweep.lines - 1, count)
    slopes = np.linspace(-0.5, 0.5, count) * camera.samples * camera.ifov_rad
    along, scan = points_of_scan(sweep.strip_px, camera, lines[:, None], slopes)
    places = np.stack([scan, along] if sweep.along == "x" else [along, scan]).reshape(2, -1)
    places += (np.array(shape)[:, None] - 1) / 2
    last = np.array(shape)[:, None] - 1
    outside = ((places < 0) | (places > last)).any(axis=0)
    row, column = (np.clip(places[:, outside], 0, last).astype(np.intp)) // cell
    return row, column
