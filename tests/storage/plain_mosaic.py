"""Helpers that write mosaics and condensed sweeps whose components are the bands: values are read as written."""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import line_positions
from spectralzoom.pipeline.rectify.region import Place, TileMaker
from spectralzoom.pipeline.signal.components import Components
from spectralzoom.storage.arrays.cubes import SweepHeader
from spectralzoom.storage.arrays.georeference import AngularGrid
from spectralzoom.storage.arrays.mosaics import MosaicWriter
from spectralzoom.storage.arrays.signal_cubes import LineRows, SignalCubeWriter

STEP = 2.0**-12  # of values: a power of two, so that its multiples are stored exactly


def band_components(bands: int) -> Components:
    """Return one component per band, of mean 0 and noise 1."""
    return Components(np.zeros(bands), np.eye(bands), np.ones(bands))


def plain_writer(
    path: Path, shape: tuple[int, int], wavelength_nm: NDArray[np.float64], grid: AngularGrid | None = None, **more: Any
) -> MosaicWriter:
    """Begin a mosaic of scene values, in steps of 2^-12."""
    components = band_components(len(wavelength_nm))
    return MosaicWriter(path, shape, components, wavelength_nm, step=STEP, largest=1e3, grid=grid, **more)


def write_values(
    path: Path,
    values: NDArray[np.floating],
    wavelength_nm: NDArray[np.float64],
    grid: AngularGrid | None = None,
    **more: Any,
) -> NDArray[np.float32]:
    """Store (y, x, band) values, NaN where nothing was captured, and return them as they are stored."""
    writer = plain_writer(path, values.shape[:2], wavelength_nm, grid, **more)
    writer.write_rows(0, values, np.isfinite(values).all(axis=2))
    stored: NDArray[np.float32] = (np.rint(values / STEP) * STEP).astype(np.float32)
    stored[~np.isfinite(values).all(axis=2)] = np.nan
    return stored


def write_plain_sweep(path: Path, header: SweepHeader, values: NDArray[np.floating], step: float) -> None:
    """Store a condensed sweep of (line, sample, band) values that are multiples of ``step``; its path is exact."""
    writer = SignalCubeWriter(path, header, band_components(values.shape[2]), step=step, largest=1e3)
    for first in range(0, len(values), 64):
        part = values[first : first + 64]
        writer.write(first, part, np.zeros(part.shape[:2], np.uint8))
    count = len(values)
    x_y = line_positions(header.sweep, LineCamera())
    facts = LineRows(np.arange(count) * 0.1, *x_y.T, np.full(count, 100.0), np.ones(count, np.bool_))
    writer.close(facts, np.zeros((0, 2), np.intp), np.zeros((0, values.shape[2]), np.int16))


@dataclass(frozen=True)
class KillOnce(TileMaker):
    """Tile maker that kills its own process at the first call."""

    folder: str = ""

    def __call__(self, place: Place) -> tuple[np.ndarray, np.ndarray]:
        """Kill the process if none was killed yet; then make the tile."""
        if not (Path(self.folder) / "killed").exists():
            (Path(self.folder) / "killed").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().__call__(place)
