"""Mosaics whose components are the bands themselves, so that values go in and come out as they are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.signal.components import Components
from storage.arrays.layout import AngularGrid
from storage.arrays.mosaics import MosaicWriter

STEP = 2.0**-12  # of values: powers of two, so that what is a multiple of them comes back exactly


def band_components(bands: int) -> Components:
    """A component a band, of mean 0 and noise 1."""
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
    """Store (y, x, band) values, NaN where nothing was seen, and return them as they are stored."""
    writer = plain_writer(path, values.shape[:2], wavelength_nm, grid, **more)
    writer.write_rows(0, values, np.isfinite(values).all(axis=2))
    stored: NDArray[np.float32] = (np.rint(values / STEP) * STEP).astype(np.float32)
    stored[~np.isfinite(values).all(axis=2)] = np.nan
    return stored
