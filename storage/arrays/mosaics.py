"""The mosaic: (y, x, band) float32 on the scene grid, with its coverage and a picture for viewers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from pipeline.errors import ShapeError
from storage.arrays.layout import (
    SHARD_ROWS,
    AngularGrid,
    create_array,
    create_group,
    damage_named,
    grid_of,
    grid_record,
    image_spec,
    open_group,
    read_array,
    read_bands,
    round_bits,
    whole_shards,
    write_bands,
)
from storage.arrays.quicklooks import Quicklook, write_quicklook

BLOCK_VALUES = 1 << 16


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
    """Write a mosaic in rows or tiles of whole shards, so that it never has to be in memory as a whole.

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
        simulation: Mapping[str, Any] | None = None,
    ) -> None:
        place = {} if grid is None else grid.attributes(shape)
        simulated = {} if simulation is None else {"simulation": dict(simulation)}
        self.path = path
        self.group = create_group(path, "mosaic", {**place, **grid_record(grid), **simulated})
        bands = write_bands(self.group, wavelength_nm, fwhm_nm)
        self._shape = (*shape, len(wavelength_nm))
        about = {"long_name": "scene value", "units": "1", "coordinates": bands, **place}
        self._values = create_array(self.group, "values", image_spec(("y", "x", "band"), self._shape, "<f4"), about)
        about = {"long_name": "weight of the samples seen", "units": "1", **place}
        self._coverage = create_array(self.group, "coverage", image_spec(("y", "x"), shape, "<f4"), about)

    @classmethod
    def reopen(cls, path: Path) -> MosaicWriter:
        """Go on writing tiles of a mosaic that another writer has begun, in this process or another.

        Raises IncompleteStoreError: no mosaic has been begun there.
        """
        writer = cls.__new__(cls)
        writer.path = path
        with damage_named(str(path)):
            writer.group = zarr.open_group(path, mode="r+", zarr_format=3, use_consolidated=False)
            values, coverage = (writer.group[name] for name in ("values", "coverage"))
            if not isinstance(values, zarr.Array) or not isinstance(coverage, zarr.Array):
                raise KeyError("values and coverage are no arrays")
            y, x, bands = values.shape
        writer._values, writer._coverage, writer._shape = values, coverage, (y, x, bands)
        return writer

    @property
    def tile_shape(self) -> tuple[int, int]:
        """(y, x) of a shard, the least that can be written by itself: 64 rows of at most 640 columns."""
        rows, columns = image_spec(("y", "x"), self._shape[:2], "<f4").shard or self._shape[:2]
        return rows, columns

    def write_rows(self, first: int, values: NDArray[np.floating], coverage: NDArray[np.floating]) -> None:
        """Store (row, x, band) values and (row, x) coverage from row ``first`` on.

        Raises ChunkError: the block splits a shard of 64 rows. ShapeError: the block does not fit the mosaic.
        """
        last = first + len(values)
        if values.shape[1:] != self._shape[1:] or coverage.shape != values.shape[:2] or last > self._shape[0]:
            raise ShapeError(
                f"rows {first}:{last} have shapes {values.shape} and {coverage.shape}; the mosaic is {self._shape}"
            )
        self.write_tile(first, 0, values, coverage)

    def write_tile(
        self, first_row: int, first_column: int, values: NDArray[np.floating], coverage: NDArray[np.generic]
    ) -> None:
        """Store (y, x, band) values and (y, x) coverage of whole shards; threads may write different ones at once.

        Raises ChunkError: the tile splits a shard. ShapeError: the tile does not fit the mosaic.
        """
        rows = slice(first_row, first_row + values.shape[0])
        columns = slice(first_column, first_column + values.shape[1])
        beyond = rows.stop > self._shape[0] or columns.stop > self._shape[1]
        if values.shape[2:] != self._shape[2:] or coverage.shape != values.shape[:2] or beyond:
            raise ShapeError(
                f"the tile at row {first_row}, column {first_column} has shapes {values.shape} and {coverage.shape}; "
                f"the mosaic is {self._shape}"
            )
        whole_shards("the mosaic", (rows, columns), self._shape[:2], self.tile_shape)
        flat = np.ascontiguousarray(values, np.float32).reshape(-1)
        rounded = np.empty_like(flat)
        for first in range(0, len(flat), BLOCK_VALUES):  # stays in cache: in one go it costs more than the codec
            rounded[first : first + BLOCK_VALUES] = round_bits(flat[first : first + BLOCK_VALUES])
        self._values[rows, columns] = rounded.reshape(values.shape)
        self._coverage[rows, columns] = coverage.astype(np.float32)

    def write_quicklook(self, image: NDArray[np.uint8]) -> None:
        """Store a small colour picture, (y, x, 3) uint8, beside the mosaic."""
        write_quicklook(self.group, Quicklook(image))


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


def mosaic_strips(path: Path, rows: slice = slice(None), columns: slice = slice(None)) -> Iterator[NDArray[np.float32]]:
    """Read a window of a mosaic from the top down, (y, x, band) strips that end where shards do.

    Raises IncompleteStoreError: the mosaic is missing or damaged.
    """
    group = open_group(path)
    with damage_named(f"{path}/values"):
        first, last, _ = rows.indices(group["values"].shape[0])  # type: ignore[union-attr]
    while first < last:
        below = min((first // SHARD_ROWS + 1) * SHARD_ROWS, last)
        yield read_array(group, "values", (slice(first, below), columns))
        first = below


def mosaic_wavelengths(path: Path) -> NDArray[np.float64]:
    """(band,) wavelengths of a mosaic [nm]. Raises IncompleteStoreError where it is missing or damaged."""
    return read_bands(open_group(path))[0]


def mosaic_brightness(path: Path) -> NDArray[np.float32]:
    """Mean over the bands, (y, x). Raises IncompleteStoreError where the mosaic is missing or damaged."""
    return np.concatenate([strip.mean(axis=-1) for strip in mosaic_strips(path)])
