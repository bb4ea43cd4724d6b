"""The mosaic: (y, x, band) float32 on the scene grid, with its coverage and a picture for viewers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ChunkError, ShapeError
from storage.layout import (
    SHARD_ROWS,
    AngularGrid,
    create_array,
    create_group,
    grid_of,
    grid_record,
    image_spec,
    open_group,
    read_array,
    read_bands,
    round_bits,
    write_bands,
    write_image,
)


@dataclass(frozen=True)
class Mosaic:
    """A stored mosaic, in memory."""

    values: NDArray[np.float32]  # (y, x, band), NaN where no line reached
    coverage: NDArray[np.float32]  # (y, x) weight of what was seen, 0 where nothing
    wavelength_nm: NDArray[np.float64]
    fwhm_nm: NDArray[np.float64] | None = None
    grid: AngularGrid | None = None
    quicklook: NDArray[np.uint8] | None = None  # (y, x, 3) at any smaller size, for viewers


class MosaicWriter:
    """Write a mosaic block of rows by block of rows, so that it never has to be in memory as a whole.

    Values are rounded to 11 bits.
    """

    def __init__(
        self,
        path: Path,
        shape: tuple[int, int],
        wavelength_nm: NDArray[np.float64],
        *,
        fwhm_nm: NDArray[np.float64] | None = None,
        grid: AngularGrid | None = None,
    ) -> None:
        place = {} if grid is None else grid.attributes(shape)
        self.group = create_group(path, "mosaic", {**place, **grid_record(grid)})
        bands = write_bands(self.group, wavelength_nm, fwhm_nm)
        self._shape = (*shape, len(wavelength_nm))
        about = {"long_name": "scene value", "units": "1", "coordinates": bands, **place}
        self._values = create_array(self.group, "values", image_spec(("y", "x", "band"), self._shape, "<f4"), about)
        about = {"long_name": "weight of the samples seen", "units": "1", **place}
        self._coverage = create_array(self.group, "coverage", image_spec(("y", "x"), shape, "<f4"), about)

    def write_rows(self, first: int, values: NDArray[np.floating], coverage: NDArray[np.floating]) -> None:
        """Store (row, x, band) values and (row, x) coverage from row ``first`` on.

        Raises
        ------
        ChunkError : the block splits a shard of 64 rows.
        ShapeError : the block does not fit the mosaic.
        """
        last = first + len(values)
        if values.shape[1:] != self._shape[1:] or coverage.shape != values.shape[:2] or last > self._shape[0]:
            raise ShapeError(
                f"rows {first}:{last} have shapes {values.shape} and {coverage.shape}; the mosaic is {self._shape}"
            )
        if first % SHARD_ROWS or (last % SHARD_ROWS and last != self._shape[0]):
            raise ChunkError(
                f"rows {first}:{last} split the mosaic's shards of {SHARD_ROWS} rows; start and end at their multiples"
            )
        self._values[first:last] = round_bits(values)
        self._coverage[first:last] = coverage.astype(np.float32)

    def write_quicklook(self, image: NDArray[np.uint8]) -> None:
        """Store a small colour picture, (y, x, 3) uint8, beside the mosaic."""
        about = {"long_name": "picture for viewers, red green blue"}
        write_image(self.group, "quicklook", ("quicklook_y", "quicklook_x", "rgb"), image, about)


def load_mosaic(path: Path) -> Mosaic:
    """Read a mosaic. Raises IncompleteStoreError where it is missing or damaged."""
    group = open_group(path)
    wavelength, fwhm = read_bands(group)
    return Mosaic(
        values=read_array(group, "values"),
        coverage=read_array(group, "coverage"),
        wavelength_nm=wavelength,
        fwhm_nm=fwhm,
        grid=grid_of(dict(group.attrs)),
        quicklook=read_array(group, "quicklook") if "quicklook" in group else None,
    )
