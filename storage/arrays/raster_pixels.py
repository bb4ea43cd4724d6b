"""Define the pixels of a raster, which are read some rows at a time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.storage.parallel.pool import RESERVED_BYTES, memory_refusal

COPIES = 6  # of a block in memory while it is read and processed
FRACTION = 4  # of the free memory for a block: larger ones are no faster


@dataclass(frozen=True)
class RasterPixels:
    """The pixels of a raster: ``read`` returns rows (y, x, band) in float32, NaN without a value."""

    read: Callable[[int, int], NDArray[np.float32]]
    missing: NDArray[np.bool_]  # (y, x) without a value
    bands: int
    grid: SceneGrid

    def rows(self, start: int, stop: int) -> NDArray[np.float32]:
        """Read rows of the raster, NaN in every band of the missing pixels."""
        values = self.read(start, stop)
        values[self.missing[start:stop]] = np.nan
        return values

    def rows_at_once(self, memory: int) -> int:
        """Return the rows to read at a time: whole rows of patches (SettingsError: one does not fit the memory)."""
        deep = self.grid.patch
        block = deep * COPIES * self.grid.width * self.bands * 4
        least = RESERVED_BYTES + block
        if least > memory:
            why = f"{deep} rows of a raster of {self.grid.width} px and {self.bands} bands are read at a time"
            raise memory_refusal(least, memory, why)
        return deep * max(1, (memory - RESERVED_BYTES) // FRACTION // block)
