"""The whole scene at full resolution, as spectral columns of every seat: what controls compare with."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from models.weights.files import Weights
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Sweep
from pipeline.rectify.kernels import Kernel
from pipeline.rectify.region import read_seats
from pipeline.simulator.simulated import SimulatedSource, SimulatedSweep

MEMORY_SHARE = 32  # a band of seats may take this part of the memory


def columns_of_all_seats(
    source: SimulatedSource,
    full: Sequence[Sweep],
    grid: SceneGrid,
    weights: Weights,
    *,
    memory: int,
    kernel: Kernel,
    report: Callable[[float], None] = lambda done: None,
) -> NDArray[np.float32]:
    """Scan the scene in full, a band of seats at a time, and keep the normalised columns only.

    Parameters
    ----------
    full
        Sweeps of the full scan.
    memory
        What the survey may take. [bytes]

    Returns
    -------
    (seat, p, p, column) float32 of the padded grid; seats beyond the scene are 0.
    """
    sweeps = [SimulatedSweep(source, sweep) for sweep in full]
    p, valid = grid.patch, grid.valid_seats()
    columns = np.zeros((int(np.prod(grid.seat_shape)), p, p, weights.basis.columns), np.float32)
    band_bytes = memory // MEMORY_SHARE
    done = 0
    for seats in _bands_of_seats(grid, full[0].along == "x", band_bytes, len(source.wavelength_nm)):
        values, _ = read_seats(sweeps, source.camera, grid, seats, kernel)
        columns[seats] = weights.columns(values, source.wavelength_nm)
        done += len(seats)
        report(done / len(valid))
    return columns


def _bands_of_seats(grid: SceneGrid, rows: bool, most_bytes: int, bands: int) -> list[NDArray[np.intp]]:
    """Valid seats in bands across the scan, as many rows (or columns) a band as fit."""
    valid = grid.valid_seats()
    row, column = np.divmod(valid, grid.seat_shape[1])
    place = row if rows else column
    one = int(np.count_nonzero(place == 0)) * grid.patch**2 * bands * 4
    deep = max(1, most_bytes // one)
    return [valid[place // deep == band] for band in range(int(place.max()) // deep + 1)]
